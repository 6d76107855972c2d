/** A layer of 3D Tiles 1.1 (OGC 22-025r4): GLB points, of which as many are fetched as the eye can tell apart. */

import { TilesRenderer } from "3d-tiles-renderer/three";
import { Box3, BufferAttribute, Group, Matrix4, Points, Vector3 } from "three";
import type { BufferGeometry, Object3D, PerspectiveCamera, RawShaderMaterial, WebGLRenderer } from "three";

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
const SRGB = Uint8Array.from({ length: 256 }, (_, byte) => 255 * encoded(byte / 255) + 0.5);

interface Tile {
  geometricError: number;
}

/** Open a tileset. Resolves once its extent is known; rejects where it cannot be had. */
export async function openTileset(
  source: CloudSource,
  layer: Layer,
  fetched: typeof fetch,
  uniforms: PointUniforms,
  changed: () => void,
  signal: AbortSignal | undefined,
): Promise<TilesetLayer> {
  const tiles = new TilesRenderer(new URL(source.url, document.baseURI).href);
  tiles.registerPlugin({ name: "fetch", fetchData: (url: string, options: RequestInit) => fetched(url, options) });
  signal?.addEventListener("abort", () => tiles.dispose(), { once: true });
  await new Promise<void>((resolve, reject) => {
    tiles.addEventListener("load-root-tileset", () => resolve());
    tiles.addEventListener("load-error", ({ error }) => reject(new Error(`the tileset cannot be had: ${error.message}`)));
    signal?.addEventListener("abort", () => reject(signal.reason), { once: true });
    tiles.update(); // asks for the root
  });
  return new TilesetLayer(tiles, source, layer, uniforms, changed);
}

/** A tileset that is open; its points come and go with `update`. */
export class TilesetLayer implements LoadedLayer {
  readonly group = new Group();
  readonly ready: Promise<void>;
  readonly bounds: Box;
  readonly spacing = 0;
  levels: Levels;
  drawable = false;
  readonly #tiles: TilesRenderer;
  readonly #uniforms: PointUniforms;
  readonly #layer: Layer;
  readonly #materials = new Map<Object3D, RawShaderMaterial>();
  readonly #parts = { value: 3 };
  readonly #cap = { value: COARSE };
  #share = 1;

  constructor(tiles: TilesRenderer, source: CloudSource, layer: Layer, uniforms: PointUniforms, changed: () => void) {
    [this.#tiles, this.#uniforms, this.#layer] = [tiles, uniforms, layer];
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
    tiles.addEventListener("dispose-model", ({ scene }) => this.#undress(scene));
    for (const event of ["needs-update", "tile-visibility-change", "tiles-load-end"] as const) tiles.addEventListener(event, changed);
  }

  update(camera: PerspectiveCamera, renderer: WebGLRenderer): void {
    const canvas = renderer.domElement;
    this.#tiles.setCamera(camera);
    this.#tiles.setResolution(camera, canvas.width, canvas.height);
    this.#tiles.errorTarget = (NEIGHBOURS * renderer.getPixelRatio()) / Math.sqrt(this.#share);
    this.#tiles.update();
    this.#cap.value = this.#tiles.loadProgress < 1 ? COARSE : Math.max(1.6 * this.#tiles.errorTarget, 2);
  }

  thin(share: number): void {
    this.#share = share;
  }

  show(present: boolean, lost: boolean): void {
    this.group.visible = present || lost;
    this.#parts.value = (present ? 1 : 0) + (lost ? 2 : 0);
  }

  paintMoved(): void {}

  dispose(): void {
    this.#tiles.dispose();
  }

  /** Give the points of a tile that has come our material. */
  #dress(scene: Object3D, tile: Tile, matrix: Matrix4): void {
    scene.updateMatrixWorld(true);
    const all: Points<BufferGeometry>[] = [];
    scene.traverse((object) => {
      if (object instanceof Points) all.push(object);
    });
    for (const points of all) {
      const geometry = points.geometry as BufferGeometry;
      const tints = tintsOf(geometry, this.#layer);
      if (tints !== null) geometry.setAttribute("tint", new BufferAttribute(tints, 4, true));
      const leaf = tile.geometricError === 0;
      const spacing = leaf || !this.drawable ? this.#measure(points, matrix) : tile.geometricError;
      const material = pointMaterial(this.#uniforms, spacing, tints !== null);
      material.uniforms["cap"] = leaf ? { value: LARGEST } : this.#cap;
      material.uniforms["parts"] = this.#parts;
      points.material = material;
      this.#materials.set(points, material);
    }
  }

  #undress(scene: Object3D): void {
    scene.traverse((object) => {
      this.#materials.get(object)?.dispose();
      this.#materials.delete(object);
    });
  }

  /** Return the spacing of a tile's points, metres; the first tile, a sample of all, tells floor and ceiling as well. */
  #measure(points: Points, matrix: Matrix4): number {
    const place = new Matrix4().multiplyMatrices(matrix, points.matrixWorld);
    const given = points.geometry.getAttribute("position");
    const positions = new Float32Array(3 * given.count);
    const point = new Vector3();
    for (let i = 0; i < given.count; i++) point.fromBufferAttribute(given, i).applyMatrix4(place).toArray(positions, 3 * i);
    const bounds = boundsOf(positions);
    if (bounds === null) return 0.05;
    if (!this.drawable) [this.levels, this.drawable] = [levelsOf(positions, bounds), true];
    return spacingOf(positions, bounds);
  }
}

/** Return the upright box around the root, in the tileset's frame. Throws an Error where there is none. */
function rootBox(tiles: TilesRenderer): Box {
  const box = new Box3();
  if (!tiles.getBoundingBox(box)) throw new Error("the tileset does not tell where it is");
  return { min: box.min.toArray(), max: box.max.toArray() };
}

/** Return tints of colours, which glTF has linear (Section 3.7.2.1); null where there are none. */
function tintsOf(geometry: BufferGeometry, layer: Layer): Uint8Array | null {
  const colours = geometry.getAttribute("color");
  if (colours === undefined) return null;
  const bytes = new Uint8Array(3 * colours.count);
  for (let i = 0; i < colours.count; i++) {
    bytes[3 * i] = SRGB[Math.round(255 * colours.getX(i))] as number;
    bytes[3 * i + 1] = SRGB[Math.round(255 * colours.getY(i))] as number;
    bytes[3 * i + 2] = SRGB[Math.round(255 * colours.getZ(i))] as number;
  }
  return tintsOfBytes(bytes, layer);
}

/** IEC 61966-2-1, 0..1. */
function encoded(linear: number): number {
  return linear <= 0.0031308 ? 12.92 * linear : 1.055 * linear ** (1 / 2.4) - 0.055;
}
