/** Reads binary PLY as the service writes it (Greg Turk, "The PLY Polygon File Format", 1994): one pass, no copies of rows. */

/** The columns of a file's points that the scene makes use of; n values each, or 3 n. */
export interface PlyPoints {
  n: number;
  /** x y z of each point, metres. */
  positions: Float32Array;
  /** Red, green, blue of each point, 0..255; null: the file has none. */
  colours: Uint8Array | null;
  /** `scalar_kind`: what a survey says of each point (`PointKind` of the service); null: the file does not tell. */
  kinds: Uint8Array | null;
  /** `scalar_tile_state`: the state of the tile that it lies in; null likewise. */
  states: Uint8Array | null;
}

interface Field {
  offset: number;
  type: string;
}

interface Header {
  n: number;
  /** Bytes of a row. */
  stride: number;
  /** Bytes before the first row. */
  start: number;
  fields: ReadonlyMap<string, Field>;
}

const SIZES: Readonly<Record<string, number>> = {
  char: 1, int8: 1, uchar: 1, uint8: 1,
  short: 2, int16: 2, ushort: 2, uint16: 2,
  int: 4, int32: 4, uint: 4, uint32: 4, float: 4, float32: 4,
  double: 8, float64: 8,
};
const HEADER_LIMIT = 1 << 16;

/** Read the points of a file. Throws an Error that says what is wrong with it. */
export function readPly(file: ArrayBuffer): PlyPoints {
  const header = readHeader(file);
  const { n, stride, start } = header;
  if (start + n * stride > file.byteLength) {
    throw new Error(`the cloud ends after ${file.byteLength} bytes, and its header promises ${start + n * stride}`);
  }
  const rows = new DataView(file, start, n * stride);
  return {
    n,
    positions: readPositions(rows, header),
    colours: readBytes(rows, header, ["red", "green", "blue"]),
    kinds: readBytes(rows, header, ["scalar_kind"]),
    states: readBytes(rows, header, ["scalar_tile_state"]),
  };
}

function readHeader(file: ArrayBuffer): Header {
  const text = new TextDecoder("latin1").decode(new Uint8Array(file, 0, Math.min(HEADER_LIMIT, file.byteLength)));
  const end = /^end_header\r?\n/m.exec(text);
  if (!/^ply\r?\n/.test(text) || end === null) throw new Error("the cloud is no PLY file");
  const lines = text.slice(0, end.index).split(/\r?\n/);
  if (!lines.some((line) => /^format binary_little_endian 1\.0\s*$/.test(line))) {
    throw new Error("the cloud is no binary little endian PLY file");
  }
  return { ...vertexOf(lines), start: end.index + end[0].length };
}

/** Return the element `vertex`, which is the first of the file and has no lists. */
function vertexOf(lines: string[]): Omit<Header, "start"> {
  const fields = new Map<string, Field>();
  let [n, stride, inside] = [-1, 0, false];
  for (const words of lines.map((line) => line.trim().split(/\s+/))) {
    if (words[0] === "element") {
      if (inside) break;
      if (words[1] !== "vertex") throw new Error(`the cloud begins with ${words[1]}, not with its points`);
      [n, inside] = [Number(words[2]), true];
    } else if (words[0] === "property" && inside) {
      const [type, name] = [words[1] ?? "", words[2] ?? ""];
      const size = SIZES[type];
      if (size === undefined) throw new Error(`the points have the property ${name} of the type ${type}`);
      fields.set(name, { offset: stride, type });
      stride += size;
    }
  }
  if (!Number.isSafeInteger(n) || n < 0) throw new Error("the cloud does not tell how many points it has");
  return { n, stride, fields };
}

function readPositions(rows: DataView, { n, stride, fields }: Header): Float32Array {
  const positions = new Float32Array(3 * n);
  for (const [axis, name] of ["x", "y", "z"].entries()) {
    const field = fields.get(name);
    if (field === undefined) throw new Error(`the points have no ${name}`);
    const double = SIZES[field.type] === 8;
    if (!double && !field.type.startsWith("float")) throw new Error(`${name} is of the type ${field.type}`);
    for (let i = 0, at = field.offset, to = axis; i < n; i++, at += stride, to += 3) {
      positions[to] = double ? rows.getFloat64(at, true) : rows.getFloat32(at, true);
    }
  }
  return positions;
}

/** Return columns of bytes side by side; null where the file lacks one of them, or has it in another type. */
function readBytes(rows: DataView, { n, stride, fields }: Header, names: string[]): Uint8Array | null {
  const offsets = names.map((name) => fields.get(name)).map((field) => (field?.type.match(/^u(char|int8)$/) ? field.offset : -1));
  if (offsets.includes(-1)) return null;
  const values = new Uint8Array(names.length * n);
  for (const [column, offset] of offsets.entries()) {
    for (let i = 0, at = offset, to = column; i < n; i++, at += stride, to += names.length) values[to] = rows.getUint8(at);
  }
  return values;
}
