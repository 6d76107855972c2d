/** Boxes over the cloud: outlines of objects and tiles in the colours of their kinds, and which one a ray meets first. */

import {
  AlwaysDepth,
  BufferAttribute,
  Color,
  DoubleSide,
  GLSL3,
  GreaterDepth,
  InstancedBufferAttribute,
  InstancedBufferGeometry,
  LessEqualDepth,
  Mesh,
  RawShaderMaterial,
  Scene as Group,
  Vector2,
} from "three";
import type { DepthModes, PerspectiveCamera, Ray, WebGLRenderer } from "three";

import { centreOf, edgesOf, entryOf, solidOf } from "./boxes.ts";
import type { Solid } from "./boxes.ts";
import { colourOfKind, colourOfState } from "./colours.ts";
import type { Box, Mark, Point, Theme, TileMark } from "./types.ts";

/** Halves of the split view that a box is drawn in, as bits. */
const BEFORE = 1;
const AFTER = 2;
const BOTH = BEFORE | AFTER;

const MARGIN = 0.04; // metres between an object and its outline
const HIDDEN = 0.25; // of its strength, of what is behind something
const DIMMED = 0.25; // of its strength, of what is not selected

interface Line {
  start: Point;
  end: Point;
  colour: string;
  alpha: number;
  /** CSS pixels. */
  width: number;
  dashed: boolean;
  sides: number;
}

interface Face {
  solid: Solid;
  colour: string;
  alpha: number;
  sides: number;
}

const LINE_VERTEX = /* glsl */ `
precision highp float;
uniform mat4 viewMatrix, projectionMatrix;
uniform vec2 size;
uniform float ratio;
uniform int side;
in vec2 corner;
in vec3 start, end;
in vec4 tone;
in vec3 style;
out vec4 colour;
out vec3 across;
out float dashed;

void main() {
  vec4 a = viewMatrix * vec4(start, 1.0), b = viewMatrix * vec4(end, 1.0);
  float near = -0.05;
  if ((int(style.z) & side) == 0 || (a.z > near && b.z > near)) { gl_Position = vec4(2.0, 2.0, 2.0, 1.0); return; }
  if (a.z > near) a = mix(a, b, (a.z - near) / (a.z - b.z));
  if (b.z > near) b = mix(b, a, (b.z - near) / (b.z - a.z));
  vec4 from = projectionMatrix * a, to = projectionMatrix * b;
  vec2 first = from.xy / from.w * size * 0.5, second = to.xy / to.w * size * 0.5;
  vec2 along = second - first;
  float pixels = max(length(along), 0.001);
  vec2 normal = vec2(-along.y, along.x) / pixels;
  float half_width = 0.5 * style.x * ratio + 1.0;
  gl_Position = corner.x < 0.5 ? from : to;
  gl_Position.xy += (normal * corner.y + along / pixels * (2.0 * corner.x - 1.0) * 0.5) * half_width / (size * 0.5) * gl_Position.w;
  gl_Position.z -= 0.0006 * gl_Position.w;
  colour = tone;
  across = vec3(corner.y * half_width, 0.5 * style.x * ratio, corner.x * pixels / ratio);
  dashed = style.y;
}`;

const LINE_FRAGMENT = /* glsl */ `
precision mediump float;
uniform float strength;
in vec4 colour;
in vec3 across;
in float dashed;
out vec4 painted;
void main() {
  if (dashed > 0.5 && fract(across.z / 10.0) > 0.6) discard;
  float edge = clamp(across.y + 0.5 - abs(across.x), 0.0, 1.0);
  painted = vec4(colour.rgb, colour.a * edge * strength);
}`;

const FACE_VERTEX = /* glsl */ `
precision highp float;
uniform mat4 viewMatrix, projectionMatrix;
uniform int side;
in vec3 position;
in vec3 centre, reach;
in vec4 tone;
in vec2 style;
out vec4 colour;
void main() {
  float c = cos(style.x), s = sin(style.x);
  vec3 corner = reach * (2.0 * position - 1.0);
  vec4 world = vec4(centre + vec3(c * corner.x - s * corner.y, s * corner.x + c * corner.y, corner.z), 1.0);
  gl_Position = (int(style.y) & side) == 0 ? vec4(2.0, 2.0, 2.0, 1.0) : projectionMatrix * viewMatrix * world;
  colour = tone;
}`;

const FACE_FRAGMENT = /* glsl */ `
precision mediump float;
in vec4 colour;
out vec4 painted;
void main() { painted = colour; }`;

/** Draws marks and tiles over what the eye-dome pass has left, and picks among them. */
export class Marks {
  #marks: Mark[] = [];
  #tiles: TileMark[] = [];
  #selected: string | null = null;
  #theme: Theme = "light";
  readonly #group = new Group();
  readonly #shared = { size: { value: new Vector2() }, ratio: { value: 1 }, side: { value: BOTH } };
  readonly #meshes: Mesh<InstancedBufferGeometry, RawShaderMaterial>[];

  constructor() {
    const materials = [this.#faceMaterial(), this.#lineMaterial(GreaterDepth, HIDDEN), this.#lineMaterial(LessEqualDepth, 1)];
    this.#meshes = materials.map((material) => new Mesh(new InstancedBufferGeometry(), material));
    for (const [order, mesh] of this.#meshes.entries()) {
      mesh.frustumCulled = false;
      mesh.renderOrder = order;
      this.#group.add(mesh);
    }
    this.#rebuild();
  }

  set(marks: Mark[]): void {
    this.#marks = marks;
    this.#rebuild();
  }

  setTiles(tiles: TileMark[]): void {
    this.#tiles = tiles;
    this.#rebuild();
  }

  select(id: string | null): void {
    this.#selected = id;
    this.#rebuild();
  }

  setTheme(theme: Theme): void {
    this.#theme = theme;
    this.#rebuild();
  }

  /** The boxes of what is selected: where it is, and where it was; none: nothing is. */
  get selectedBoxes(): Box[] {
    const chosen = this.#marks.find(({ id }) => id === this.#selected) ?? this.#tiles.find(({ id }) => id === this.#selected);
    if (chosen === undefined) return [];
    return "from" in chosen && chosen.from !== undefined ? [chosen.box, chosen.from] : [chosen.box];
  }

  /** Marks of objects that were moved, whose points take the colour of that. */
  get moved(): Mark[] {
    return this.#marks.filter(({ kind }) => kind === "moved");
  }

  /** Return the id of the mark that a ray meets first, else of the tile; null: of none. Metres, map frame. */
  pick(ray: Ray): string | null {
    const marks = this.#marks.flatMap(({ id, box, from }) => (from === undefined ? [{ id, box }] : [{ id, box }, { id, box: from }]));
    const tiles = this.#tiles.filter(({ state }) => state !== "unchanged");
    return nearest(ray, marks, 2 * MARGIN) ?? nearest(ray, tiles, 0);
  }

  /** Draw over the canvas; `half`: of the split view, the left (before) or the right (after); pixels of the drawing area. */
  draw(renderer: WebGLRenderer, camera: PerspectiveCamera, half: "before" | "after" | null, width: number, height: number): void {
    this.#shared.size.value.set(width, height);
    this.#shared.ratio.value = renderer.getPixelRatio();
    this.#shared.side.value = half === null ? BOTH : half === "before" ? BEFORE : AFTER;
    renderer.render(this.#group, camera);
  }

  dispose(): void {
    for (const { geometry, material } of this.#meshes) [geometry, material].map((part) => part.dispose());
  }

  #rebuild(): void {
    const strength = (id: string) => (this.#selected === null || this.#selected === id ? 1 : DIMMED);
    const marks = this.#marks.map((mark) => partsOf(mark, strength(mark.id), mark.id === this.#selected));
    const tiles = this.#tiles.map((tile) =>
      partsOfTile(tile, colourOfState(tile.state, this.#theme), strength(tile.id), tile.id === this.#selected),
    );
    const faces = facesOf([...tiles, ...marks].flatMap((part) => part.faces));
    const lines = linesOf([...tiles, ...marks].flatMap((part) => part.lines));
    for (const [i, mesh] of this.#meshes.entries()) {
      mesh.geometry.dispose(); // a renderer keeps how many instances a geometry had first
      mesh.geometry = i === 0 ? faces : lines;
      mesh.visible = mesh.geometry.instanceCount > 0;
    }
  }

  #lineMaterial(depthFunc: DepthModes, strength: number): RawShaderMaterial {
    return new RawShaderMaterial({
      glslVersion: GLSL3,
      vertexShader: LINE_VERTEX,
      fragmentShader: LINE_FRAGMENT,
      uniforms: { ...this.#shared, strength: { value: strength } },
      transparent: true,
      depthWrite: false,
      depthFunc,
      side: DoubleSide,
    });
  }

  #faceMaterial(): RawShaderMaterial {
    return new RawShaderMaterial({
      glslVersion: GLSL3,
      vertexShader: FACE_VERTEX,
      fragmentShader: FACE_FRAGMENT,
      uniforms: { ...this.#shared },
      transparent: true,
      depthWrite: false,
      depthFunc: AlwaysDepth,
    });
  }
}

interface Parts {
  lines: Line[];
  faces: Face[];
}

/** Return what is drawn of an object: its outline (dashed where it no longer is), and the way that it took. */
function partsOf({ box, kind, from, muted }: Mark, strength: number, selected: boolean): Parts {
  const colour = colourOfKind(kind);
  const alpha = strength * (muted === true && !selected ? 0.4 : 1);
  const [width, fill] = selected ? [3.5, 0.22] : [2, 0.1];
  const gone = kind === "disappeared";
  const sides = gone ? BEFORE : kind === "appeared" || from !== undefined ? AFTER : BOTH;
  const now = edgesOf(solidOf(box, MARGIN)).map((edge) => ({ ...edge, colour, alpha, width, dashed: gone, sides }));
  const faces: Face[] = [{ solid: solidOf(box, MARGIN), colour, alpha: fill * alpha, sides }];
  if (from === undefined) return { lines: now, faces };
  const before = edgesOf(solidOf(from, MARGIN)).map((edge) => ({ ...edge, colour, alpha, width, dashed: true, sides: BEFORE }));
  const way: Line = { start: centreOf(from), end: centreOf(box), colour, alpha, width, dashed: true, sides: BOTH };
  return { lines: [...now, ...before, way], faces };
}

/** Return what is drawn of a tile: nothing where nothing changed, else a faint box. */
function partsOfTile({ box, state, score }: TileMark, colour: string, strength: number, selected: boolean): Parts {
  if (state === "unchanged" && !selected) return { lines: [], faces: [] };
  const alpha = strength * (state === "changed" ? 0.5 + 0.5 * (score ?? 0.5) : 0.5);
  const [width, fill] = selected ? [3, 0.16] : [1.2, 0.06];
  const lines = edgesOf(solidOf(box, -0.02)).map((edge) => ({ ...edge, colour, alpha, width, dashed: state !== "changed", sides: BOTH }));
  return { lines, faces: [{ solid: solidOf(box, -0.02), colour, alpha: fill * alpha, sides: BOTH }] };
}

function linesOf(lines: Line[]): InstancedBufferGeometry {
  const geometry = new InstancedBufferGeometry();
  geometry.setAttribute("corner", new BufferAttribute(new Float32Array([0, -1, 1, -1, 1, 1, 0, 1]), 2));
  geometry.setIndex([0, 1, 2, 0, 2, 3]);
  fill(geometry, "start", 3, lines.map(({ start }) => start));
  fill(geometry, "end", 3, lines.map(({ end }) => end));
  fill(geometry, "tone", 4, lines.map(({ colour, alpha }) => toneOf(colour, alpha)));
  fill(geometry, "style", 3, lines.map(({ width, dashed, sides }) => [width, dashed ? 1 : 0, sides]));
  geometry.instanceCount = lines.length;
  return geometry;
}

function facesOf(faces: Face[]): InstancedBufferGeometry {
  const geometry = new InstancedBufferGeometry();
  geometry.setAttribute("position", new BufferAttribute(cube(), 3));
  geometry.setIndex(CUBE_FACES);
  fill(geometry, "centre", 3, faces.map(({ solid }) => solid.centre));
  fill(geometry, "reach", 3, faces.map(({ solid }) => solid.half));
  fill(geometry, "tone", 4, faces.map(({ colour, alpha }) => toneOf(colour, alpha)));
  fill(geometry, "style", 2, faces.map(({ solid, sides }) => [solid.yaw, sides]));
  geometry.instanceCount = faces.length;
  return geometry;
}

/** Put the values of each instance into an attribute, of which at least one entry stands there (WebGL wants a buffer). */
function fill(geometry: InstancedBufferGeometry, name: string, size: number, rows: number[][]): void {
  const values = new Float32Array(Math.max(rows.length, 1) * size);
  for (const [i, row] of rows.entries()) values.set(row, i * size);
  geometry.setAttribute(name, new InstancedBufferAttribute(values, size));
}

function toneOf(colour: string, alpha: number): number[] {
  const { r, g, b } = new Color(colour);
  return [r, g, b, alpha];
}

/** Return the id of the box, `margin` metres larger on each side, that a ray meets first; null: of none. */
function nearest(ray: Ray, boxes: { id: string; box: Box }[], margin: number): string | null {
  let [best, distance]: [string | null, number] = [null, Infinity];
  for (const { id, box } of boxes) {
    const near = entryOf(solidOf(box, margin), ray.origin.toArray(), ray.direction.toArray());
    if (near !== null && near < distance) [best, distance] = [id, near];
  }
  return best;
}

function cube(): Float32Array {
  return new Float32Array(Array.from({ length: 8 }, (_, bits) => [bits & 1, (bits >> 1) & 1, (bits >> 2) & 1]).flat());
}

/** Triangles of the unit cube, seen from outside; corners are numbered by the bits x, y, z. */
const CUBE_FACES = [0, 2, 3, 0, 3, 1, 4, 5, 7, 4, 7, 6, 0, 1, 5, 0, 5, 4, 2, 6, 7, 2, 7, 3, 0, 4, 6, 0, 6, 2, 1, 3, 7, 1, 7, 5];
