/**
 * Reads points of GLB (glTF 2.0, ISO/IEC 12113:2022) as the service writes its tiles: one node, POINTS, positions that
 * may be quantised (KHR_mesh_quantization), colours that may be there. Normals are not made use of.
 */

/** Points of a tile. */
export interface GlbPoints {
  n: number;
  /** x y z each, metres, in the axes of glTF: y is up. */
  positions: Float32Array;
  /** Red, green, blue of each point, 0..255, linear; null: the tile has none. */
  colours: Uint8Array | null;
}

interface Accessor {
  bufferView: number;
  byteOffset?: number;
  componentType: number;
  count: number;
  type: string;
}

interface Document {
  nodes: { matrix?: number[]; mesh?: number }[];
  meshes: { primitives: { attributes: Record<string, number>; mode?: number }[] }[];
  accessors: Accessor[];
  bufferViews: { byteOffset?: number; byteLength: number; byteStride?: number }[];
}

const [MAGIC, JSON_CHUNK, BINARY_CHUNK] = [0x46546c67, 0x4e4f534a, 0x004e4942];
const [UNSIGNED_BYTE, UNSIGNED_SHORT, FLOAT, POINTS] = [5121, 5123, 5126, 0];
const SIZES: Readonly<Record<number, number>> = { [UNSIGNED_BYTE]: 1, [UNSIGNED_SHORT]: 2, [FLOAT]: 4 };
const WIDTHS: Readonly<Record<string, number>> = { VEC3: 3, VEC4: 4 };

/** Read the points of a tile. Throws an Error where it holds something else. */
export function readGlb(file: ArrayBuffer): GlbPoints {
  const { document, binary } = chunksOf(file);
  const node = document.nodes.find(({ mesh }) => mesh !== undefined);
  const primitive = document.meshes[node?.mesh ?? -1]?.primitives[0];
  if (primitive === undefined || primitive.mode !== POINTS) throw new Error("the tile has no points");
  const read = (name: string) => {
    const index = primitive.attributes[name];
    return index === undefined ? null : columnsOf(document, binary, document.accessors[index] as Accessor);
  };
  const places = read("POSITION");
  if (places === null) throw new Error("the points of the tile have no positions");
  const colours = read("COLOR_0");
  return {
    n: places.length / 3,
    positions: node?.matrix === undefined ? places : placed(places, node.matrix),
    colours: colours === null ? null : Uint8Array.from(colours),
  };
}

/** Return the two chunks (Section 4.4.3). */
function chunksOf(file: ArrayBuffer): { document: Document; binary: DataView } {
  const head = new DataView(file);
  if (file.byteLength < 20 || head.getUint32(0, true) !== MAGIC || head.getUint32(16, true) !== JSON_CHUNK) {
    throw new Error("the tile is no GLB");
  }
  const length = head.getUint32(12, true);
  const document = JSON.parse(new TextDecoder().decode(new Uint8Array(file, 20, length))) as Document;
  if (head.getUint32(24 + length, true) !== BINARY_CHUNK) throw new Error("the tile has nothing but its description");
  return { document, binary: new DataView(file, 28 + length, head.getUint32(20 + length, true)) };
}

/** Return the first three values of each point, as they are stored. */
function columnsOf(document: Document, binary: DataView, accessor: Accessor): Float32Array {
  const { componentType, count, type, byteOffset = 0 } = accessor;
  const [size, width] = [SIZES[componentType], WIDTHS[type]];
  const view = document.bufferViews[accessor.bufferView];
  if (size === undefined || width === undefined || view === undefined) throw new Error(`the tile has ${type} of the type ${componentType}`);
  const stride = view.byteStride ?? size * width;
  const start = (view.byteOffset ?? 0) + byteOffset;
  const values = new Float32Array(3 * count);
  const get = (at: number) =>
    size === 1 ? binary.getUint8(at) : size === 2 ? binary.getUint16(at, true) : binary.getFloat32(at, true);
  for (let i = 0; i < count; i++) {
    for (let column = 0; column < 3; column++) values[3 * i + column] = get(start + i * stride + column * size);
  }
  return values;
}

/** Return points (x y z each) under a matrix, column by column (Section 3.5.3). */
function placed(points: Float32Array, matrix: number[]): Float32Array {
  const m = Float64Array.from(matrix);
  const result = new Float32Array(points.length);
  for (let i = 0; i < points.length; i += 3) {
    const [x, y, z] = [points[i] as number, points[i + 1] as number, points[i + 2] as number];
    for (let row = 0; row < 3; row++) {
      result[i + row] = (m[row] as number) * x + (m[4 + row] as number) * y + (m[8 + row] as number) * z + (m[12 + row] as number);
    }
  }
  return result;
}
