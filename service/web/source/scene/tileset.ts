/** A layer of 3D Tiles 1.1 (OGC 22-025r4): GLB points, of which as many are fetched as the eye can tell apart. */

import { Scheduler } from "3d-tiles-renderer/core";
import { TilesRenderer } from "3d-tiles-renderer/three";
import { Box3, BufferAttribute, BufferGeometry, Group, Loader, Matrix4, Points, Vector3 } from "three";
import type { Object3D, PerspectiveCamera, RawShaderMaterial, WebGLRenderer } from "three";

import { readGlb } from "./glb.ts";
import { boundsOf, levelsOf } from "./heights.ts";
import type { Levels } from "./heights.ts";
import { matrixOf, transformed } from "./layers.ts";
import type { LoadedLayer } from "./layers.ts";
import { spacingOf, tintsOfBytes } from "./points.ts";
import { LARGEST, pointMaterial } from "./shading.ts";
import type { PointUniforms } from "./shading.ts";
import type { Box, CloudSource, Layer } from "./types.ts";

const NEIGHBOURS = 2.2; // pixels between points where all has come that is wanted
const COARSE = 12; // pixels of a point while more is on its way
const AT_ONCE = 4; // contents under way; a browser has six connections to a host, and the page asks for other things too
/** Bytes of a picture of linear ones, which glTF has (Section 3.7.2.1). */
const SRGB = Uint8Array.from({ length: 256 }, (_, byte) => 255 * encoded(byte / 255) + 0.5);

/** Has the queues of the tiles' renderer go on between frames, which are far apart where the processor draws them. */
const BETWEEN_FRAMES = { requestAnimationFrame: (done: () => void) => setTimeout(done), cancelAnimationFrame: (handle: number) => clearTimeout(handle) };

interface Tile {
  geometricError: number;
  content?: { uri?: string };
  children?: Tile[];
}

/**
 * Open a tileset. Resolves once its extent is known; rejects where it cannot be had.
 *
 * Until its coarsest points have been drawn nothing else is asked for: they are of all of the cloud, and whatever came
 * beside them would have the first picture wait. Then what is finer comes, where it is missed most: by its error on the screen.
 */
export async function openTileset(
  source: CloudSource,
  layer: Layer,
  fetched: typeof fetch,
  uniforms: PointUniforms,
  changed: () => void,
  signal: AbortSignal | undefined,
): Promise<TilesetLayer> {
  Scheduler.setXRSession(BETWEEN_FRAMES as unknown as XRSession);
  const tiles = new TilesRenderer(new URL(source.url, document.baseURI).href);
  tiles.manager.addHandler(/\.glb$/, new PointsLoader(layer, uniforms));
  tiles.registerPlugin({ name: "fetch", fetchData: (url: string, options: RequestInit) => fetched(url, options) });
  tiles.downloadQueue.maxJobsPerOrigin = AT_ONCE;
  tiles.maxDepth = 1;
  tiles.addEventListener("load-tileset", () => {
    if (tiles.maxDepth < Infinity) tiles.maxDepth = levelsToPoints(tiles.root as Tile | null);
  });
  signal?.addEventListener("abort", () => tiles.dispose(), { once: true });
  await new Promise<void>((resolve, reject) => {
    tiles.addEventListener("load-root-tileset", () => resolve());
    tiles.addEventListener("load-error", ({ error }) => reject(new Error(`the tileset cannot be had: ${error.message}`)));
    signal?.addEventListener("abort", () => reject(signal.reason), { once: true });
    tiles.update(); // asks for the root
  });
  return new TilesetLayer(tiles, source, changed);
}

/** Makes points with our material of the content of a tile; the renderer of tiles asks it in place of three's own loader. */
class PointsLoader extends Loader<unknown> {
  readonly #layer: Layer;
  readonly #uniforms: PointUniforms;

  constructor(layer: Layer, uniforms: PointUniforms) {
    super();
    [this.#layer, this.#uniforms] = [layer, uniforms];
  }

  async parseAsync(file: ArrayBuffer): Promise<{ scene: Object3D }> {
    const { positions, colours } = readGlb(file);
    const geometry = new BufferGeometry();
    geometry.setAttribute("position", new BufferAttribute(positions, 3));
    if (colours !== null) {
      const tints = tintsOfBytes(colours.map((byte) => SRGB[byte] as number), this.#layer);
      geometry.setAttribute("tint", new BufferAttribute(tints, 4, true));
    }
    const scene = new Group();
    scene.add(new Points(geometry, pointMaterial(this.#uniforms, 0.05, colours !== null)));
    return { scene };
  }
}

/** A tileset that is open; its points come and go with `update`. */
export class TilesetLayer implements LoadedLayer {
  readonly group = new Group();
  readonly ready: Promise<void>;
  readonly bounds: Box;
  spacing = 0;
  levels: Levels;
  drawable = false;
  readonly #tiles: TilesRenderer;
  readonly #parts = { value: 3 };
  readonly #cap = { value: COARSE };
  readonly #changed: () => void;
  #share = 1;

  constructor(tiles: TilesRenderer, source: CloudSource, changed: () => void) {
    [this.#tiles, this.#changed] = [tiles, changed];
    const matrix = matrixOf(source);
    this.bounds = transformed(rootBox(tiles), matrix);
    this.levels = { floor: this.bounds.min[2], ceiling: null };
    this.group.matrixAutoUpdate = false;
    this.group.matrix.copy(matrix);
    this.group.add(tiles.group);
    this.ready = new Promise((resolve, reject) => {
      tiles.addEventListener("load-model", ({ scene, tile }) => {
        this.#dress(scene, tile as unknown as Tile, matrix);
        if (this.drawable) resolve();
      });
      tiles.addEventListener("load-error", ({ error }) => reject(new Error(`the tileset cannot be had: ${error.message}`)));
    });
    this.ready.catch(() => {}); // whoever waits for it is told
    for (const event of ["needs-update", "tile-visibility-change", "tiles-load-end"] as const) tiles.addEventListener(event, changed);
  }

  update(camera: PerspectiveCamera, renderer: WebGLRenderer): void {
    const canvas = renderer.domElement;
    this.#tiles.setCamera(camera);
    this.#tiles.setResolution(camera, canvas.width, canvas.height);
    this.#tiles.errorTarget = (NEIGHBOURS * renderer.getPixelRatio()) / Math.sqrt(this.#share);
    this.#tiles.update();
    this.#cap.value = this.#coarse || this.#tiles.loadProgress < 1 ? COARSE : Math.max(1.6 * this.#tiles.errorTarget, 2);
  }

  drawn(): void {
    if (!this.drawable || !this.#coarse) return;
    this.#tiles.maxDepth = Infinity;
    this.#changed();
  }

  /** Tiles come and go by halves of the share, for those of a share that wavers would flicker. */
  thin(share: number): void {
    this.#share = 2 ** Math.round(Math.log2(share));
  }

  show(present: boolean, lost: boolean): void {
    this.group.visible = present || lost;
    this.#parts.value = (present ? 1 : 0) + (lost ? 2 : 0);
  }

  paintMoved(): void {}

  dispose(): void {
    this.#tiles.dispose();
  }

  /** Whether the coarsest points alone are asked for. */
  get #coarse(): boolean {
    return this.#tiles.maxDepth < Infinity;
  }

  /** Say of the points of a tile that has come how large they are. */
  #dress(scene: Object3D, tile: Tile, matrix: Matrix4): void {
    const points = scene.children[0];
    if (!(points instanceof Points)) return;
    const leaf = tile.geometricError === 0;
    const spacing = leaf || !this.drawable ? this.#measure(points, matrix) : tile.geometricError;
    const { uniforms } = points.material as RawShaderMaterial;
    Object.assign(uniforms, { spacing: { value: spacing }, cap: leaf ? { value: LARGEST } : this.#cap, parts: this.#parts });
  }

  /** Return the spacing of a tile's points, metres; the first tile, a sample of all, tells floor and ceiling as well. */
  #measure(points: Points, matrix: Matrix4): number {
    points.parent?.updateMatrixWorld(true);
    const place = new Matrix4().multiplyMatrices(matrix, points.matrixWorld);
    const given = points.geometry.getAttribute("position");
    const positions = new Float32Array(3 * given.count);
    const point = new Vector3();
    for (let i = 0; i < given.count; i++) point.fromBufferAttribute(given, i).applyMatrix4(place).toArray(positions, 3 * i);
    const bounds = boundsOf(positions);
    if (bounds === null) return 0.05;
    if (!this.drawable) [this.levels, this.drawable] = [levelsOf(positions, bounds), true];
    const spacing = spacingOf(positions, bounds);
    this.spacing = this.spacing === 0 ? spacing : Math.min(this.spacing, spacing);
    return spacing;
  }
}

/** Return how many levels of a tree lead to its first points: above them are tiles of no content, or of a further tileset. */
function levelsToPoints(root: Tile | null): number {
  let levels = 1;
  for (let tile = root; tile !== null && !/\.glb\b/.test(tile.content?.uri ?? ""); levels++) tile = tile.children?.[0] ?? null;
  return levels;
}

/** Return the upright box around the root, in the tileset's frame. Throws an Error where there is none. */
function rootBox(tiles: TilesRenderer): Box {
  const box = new Box3();
  if (!tiles.getBoundingBox(box)) throw new Error("the tileset does not tell where it is");
  return { min: box.min.toArray(), max: box.max.toArray() };
}

/** IEC 61966-2-1, 0..1. */
function encoded(linear: number): number {
  return linear <= 0.0031308 ? 12.92 * linear : 1.055 * linear ** (1 / 2.4) - 0.055;
}
