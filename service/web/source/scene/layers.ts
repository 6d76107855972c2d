/** What a layer holds once it is loaded: a cloud of one file, or a tileset, with one face towards the scene. */

import { Box3, BufferAttribute, BufferGeometry, Group, Matrix4, Points, Sphere, Vector3 } from "three";
import type { PerspectiveCamera, RawShaderMaterial, WebGLRenderer } from "three";

import { holds, solidOf } from "./boxes.ts";
import { KIND_COLOURS, bytesOf } from "./colours.ts";
import type { Levels } from "./heights.ts";
import { readPly } from "./ply.ts";
import { MARKED, cloudOf } from "./points.ts";
import type { DrawnPoints } from "./points.ts";
import { pointMaterial } from "./shading.ts";
import type { PointUniforms } from "./shading.ts";
import type { Box, CloudSource, Mark, Point } from "./types.ts";

const NEARLY = 0.05; // metres that a point of an object may lie outside of its box

/** A layer that is loaded. */
export interface LoadedLayer {
  readonly group: Group;
  readonly bounds: Box;
  readonly levels: Levels;
  /** Metres between neighbouring points, of a tileset where they are closest. */
  readonly spacing: number;
  /** Resolves once there are points to draw. */
  readonly ready: Promise<void>;
  readonly drawable: boolean;
  /** Fetch and drop parts for what a camera sees. */
  update(camera: PerspectiveCamera, renderer: WebGLRenderer): void;
  /** Take note that a frame is on the screen, with all that had come. */
  drawn(): void;
  /** Draw what the visit saw; and, of a survey, what the map has and the survey has not. */
  show(present: boolean, lost: boolean): void;
  /** Draw a part of the points alone, 0..1. */
  thin(share: number): void;
  /** Paint the points of objects that were moved as such. */
  paintMoved(marks: Mark[]): void;
  dispose(): void;
}

/** Return the matrix from a cloud's frame to the map's. */
export function matrixOf({ target_from_cloud: rows }: CloudSource): Matrix4 {
  return rows === undefined || rows.length !== 16 ? new Matrix4() : new Matrix4().fromArray(rows).transpose();
}

/** Fetch a file whole; tells `progress` which share has come. Rejects where the answer is none. */
export async function fetchWhole(
  source: CloudSource,
  fetched: typeof fetch,
  progress: (share: number) => void,
  signal: AbortSignal | undefined,
): Promise<ArrayBuffer> {
  const answer = await fetched(source.url, signal === undefined ? {} : { signal });
  if (!answer.ok || answer.body === null) throw new Error(`the cloud cannot be had: ${answer.status} ${answer.statusText}`);
  const bytes = Number(answer.headers.get("content-length") ?? source.bytes ?? 0);
  const pieces: Uint8Array[] = [];
  let have = 0;
  for await (const piece of answer.body) {
    pieces.push(piece);
    have += piece.length;
    if (bytes > 0) progress(Math.min(have / bytes, 1));
  }
  progress(1);
  return joined(pieces, have);
}

function joined(pieces: Uint8Array[], bytes: number): ArrayBuffer {
  const whole = new Uint8Array(bytes);
  let at = 0;
  for (const piece of pieces) {
    whole.set(piece, at);
    at += piece.length;
  }
  return whole.buffer;
}

/** The cloud of one PLY file. */
export class FileLayer implements LoadedLayer {
  readonly group = new Group();
  readonly bounds: Box;
  readonly levels: Levels;
  readonly spacing: number;
  readonly ready = Promise.resolve();
  readonly drawable = true;
  readonly #present = new Group();
  readonly #lost = new Group();
  readonly #parts: Part[];

  constructor(file: ArrayBuffer, source: CloudSource, uniforms: PointUniforms) {
    const cloud = cloudOf(readPly(file));
    const matrix = matrixOf(source);
    this.bounds = transformed(cloud.bounds, matrix);
    this.levels = cloud.levels;
    this.spacing = cloud.spacing;
    const parts = [[cloud.present, this.#present], [cloud.lost, this.#lost]] as const;
    this.#parts = parts.flatMap(([points, group]) => (points === null ? [] : [new Part(points, cloud.spacing, cloud.bounds, group, uniforms)]));
    this.group.add(this.#present, this.#lost);
    this.group.matrixAutoUpdate = false;
    this.group.matrix.copy(matrix);
  }

  update(): void {}

  drawn(): void {}

  show(present: boolean, lost: boolean): void {
    [this.#present.visible, this.#lost.visible] = [present, lost];
  }

  thin(share: number): void {
    for (const part of this.#parts) part.thin(share);
  }

  paintMoved(marks: Mark[]): void {
    for (const part of this.#parts) part.paintMoved(marks);
  }

  dispose(): void {
    for (const part of this.#parts) part.dispose();
  }
}

/** Points of a file that are drawn at once. */
class Part {
  readonly #points: DrawnPoints;
  readonly #geometry = new BufferGeometry();
  readonly #material: RawShaderMaterial;
  readonly #marked: number[] = []; // rows of objects
  readonly #kinds: Uint32Array | null; // the tints as they came

  constructor(points: DrawnPoints, spacing: number, bounds: Box, group: Group, uniforms: PointUniforms) {
    this.#points = points;
    const { n, positions, tints } = points;
    this.#geometry.setAttribute("position", new BufferAttribute(positions, 3));
    if (tints !== null) this.#geometry.setAttribute("tint", new BufferAttribute(tints, 4, true));
    this.#geometry.boundingSphere = new Box3(new Vector3(...bounds.min), new Vector3(...bounds.max)).getBoundingSphere(new Sphere());
    this.#material = pointMaterial(uniforms, spacing, tints !== null);
    this.#kinds = tints === null ? null : new Uint32Array(tints.buffer.slice(0));
    if (tints !== null) for (let row = 0; row < n; row++) if (tints[4 * row + 3] === MARKED) this.#marked.push(row);
    group.add(new Points(this.#geometry, this.#material));
  }

  thin(share: number): void {
    this.#geometry.setDrawRange(0, Math.ceil(this.#points.n * share));
    this.#material.uniforms["share"] = { value: share };
    this.#material.uniformsNeedUpdate = true;
  }

  paintMoved(marks: Mark[]): void {
    const { positions, tints } = this.#points;
    if (tints === null || this.#kinds === null || this.#marked.length === 0) return;
    const words = new Uint32Array(tints.buffer);
    const moved = new Uint32Array(new Uint8Array([...bytesOf(KIND_COLOURS["moved"] ?? "#000000"), MARKED]).buffer)[0] as number;
    const solids = marks.flatMap(({ box, from }) => (from === undefined ? [box] : [box, from])).map((box) => solidOf(box, NEARLY));
    for (const row of this.#marked) {
      const [x, y, z] = positions.subarray(3 * row, 3 * row + 3) as unknown as Point;
      words[row] = solids.some((solid) => holds(solid, x, y, z)) ? moved : (this.#kinds[row] as number);
    }
    const attribute = this.#geometry.getAttribute("tint");
    attribute.needsUpdate = true;
  }

  dispose(): void {
    this.#geometry.dispose();
    this.#material.dispose();
  }
}

/** Return the upright box around a box that was transformed. */
export function transformed({ min, max }: Box, matrix: Matrix4): Box {
  const box = new Box3(new Vector3(...min), new Vector3(...max)).applyMatrix4(matrix);
  return { min: box.min.toArray(), max: box.max.toArray() };
}
