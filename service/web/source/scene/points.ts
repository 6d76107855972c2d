/** From what a file holds to what is drawn: order, colours by kind, spacing, what was lost. No three.js here. */

import { KIND_COLOURS, MOVING_COLOUR, STATE_COLOURS, bytesOf } from "./colours.ts";
import { boundsOf, levelsOf } from "./heights.ts";
import type { Levels } from "./heights.ts";
import type { PlyPoints } from "./ply.ts";
import type { Box, Layer } from "./types.ts";

/** Alpha of a tint: the point takes the colour of its height, a faint one, that of its object, or one that it brings. */
export const RAMP = 0;
export const FAINT = 64;
export const MARKED = 128;
/** As MARKED, of what the map has and the survey has not. */
export const GONE = 160;
export const OWN = 255;

/** Points ready to be drawn, in an order of which each beginning is a fair sample. */
export interface DrawnPoints {
  n: number;
  /** x y z each, metres. */
  positions: Float32Array;
  /** Red, green, blue, and RAMP, FAINT, MARKED or OWN; null: all by their height. */
  tints: Uint8Array | null;
}

/** A cloud: what is there, and of a survey also what the map has and the survey has not. */
export interface Cloud {
  present: DrawnPoints;
  lost: DrawnPoints | null;
  bounds: Box;
  levels: Levels;
  /** Metres between neighbours. */
  spacing: number;
}

const LOST = 2; // `PointKind.DISAPPEARED` of the service
const CELL = 0.25; // metres: cells that a cloud's surface is measured by
const MOST_CELLS = 1 << 25;
const SURFACE_PER_CELL = 0.65; // of a cell's side squared: a plane at any angle goes through more cells than it has area

/** Make a cloud of a file's points. Throws an Error where it has none. */
export function cloudOf(points: PlyPoints): Cloud {
  const bounds = boundsOf(points.positions);
  if (bounds === null) throw new Error("the cloud has no points");
  const lost = rowsOf(points.n, (row) => points.kinds?.[row] === LOST);
  return {
    present: drawn(points, lost.length === 0 ? spread(points.n) : spreadOf(rowsOf(points.n, (row) => points.kinds?.[row] !== LOST))),
    lost: lost.length === 0 ? null : drawn(points, spreadOf(lost)),
    bounds,
    levels: levelsOf(points.positions, bounds),
    spacing: spacingOf(points.positions, bounds),
  };
}

/** Return 0..n-1 in an order of which each beginning is spread over all: steps of the golden ratio (n and step coprime). */
export function spread(n: number): Uint32Array {
  let step = Math.max(1, Math.round(n * 0.6180339887));
  while (n > 1 && divisor(n, step) !== 1) step++;
  const rows = new Uint32Array(n);
  for (let i = 0, row = 0; i < n; i++, row = (row + step) % n) rows[i] = row;
  return rows;
}

function divisor(a: number, b: number): number {
  while (b !== 0) [a, b] = [b, a % b];
  return a;
}

function spreadOf(rows: Uint32Array): Uint32Array {
  return spread(rows.length).map((at) => rows[at] as number);
}

function rowsOf(n: number, holds: (row: number) => boolean): Uint32Array {
  const rows = new Uint32Array(n);
  let count = 0;
  for (let row = 0; row < n; row++) if (holds(row)) rows[count++] = row;
  return rows.slice(0, count);
}

function drawn(points: PlyPoints, rows: Uint32Array): DrawnPoints {
  const positions = new Float32Array(3 * rows.length);
  for (let i = 0; i < rows.length; i++) {
    const row = 3 * (rows[i] as number);
    positions[3 * i] = points.positions[row] as number;
    positions[3 * i + 1] = points.positions[row + 1] as number;
    positions[3 * i + 2] = points.positions[row + 2] as number;
  }
  return { n: rows.length, positions, tints: tintsOf(points, rows) };
}

/** Return a tint for each row: by what a survey says of it, else by the file's colours, else none. */
function tintsOf(points: PlyPoints, rows: Uint32Array): Uint8Array | null {
  const tints = new Uint8Array(4 * rows.length);
  const words = new Uint32Array(tints.buffer);
  if (points.kinds !== null) dye(words, rows, points.kinds, kindTints());
  else if (points.states !== null) dye(words, rows, points.states, stateTints());
  else if (points.colours !== null) copy(tints, rows, points.colours);
  else return null;
  return tints;
}

/** Give each row the tint of its code. */
function dye(tints: Uint32Array, rows: Uint32Array, codes: Uint8Array, table: Uint32Array): void {
  for (let i = 0; i < rows.length; i++) tints[i] = table[codes[rows[i] as number] as number] as number;
}

function copy(tints: Uint8Array, rows: Uint32Array, colours: Uint8Array): void {
  for (let i = 0; i < rows.length; i++) {
    const row = 3 * (rows[i] as number);
    tints[4 * i] = colours[row] as number;
    tints[4 * i + 1] = colours[row + 1] as number;
    tints[4 * i + 2] = colours[row + 2] as number;
    tints[4 * i + 3] = OWN;
  }
}

/** Return (256) the tint of each value of `scalar_kind`. */
function kindTints(): Uint32Array {
  return tableOf([
    ["#000000", RAMP],
    [KIND_COLOURS["appeared"], MARKED],
    [KIND_COLOURS["disappeared"], MARKED],
    ["#000000", FAINT],
    [MOVING_COLOUR, OWN],
  ]);
}

/** Return (256) the tint of each value of `scalar_tile_state`; 255, outside every tile, by its height. */
function stateTints(): Uint32Array {
  const states = ["unchanged", "changed", "inconsistent", "unobserved"];
  return tableOf(states.map((state, code) => [STATE_COLOURS[state], code === 0 ? RAMP : MARKED]));
}

/** Return tints of colours (red, green, blue each), of which a survey's are those of `scalar_kind` and tell of it. */
export function tintsOfBytes(colours: Uint8Array, layer: Layer): Uint8Array {
  const tints = new Uint8Array((4 * colours.length) / 3);
  copy(tints, Uint32Array.from({ length: colours.length / 3 }, (_, row) => row), colours);
  if (layer === "reference") return tints;
  const told: [string | undefined, number][] = [["#969696", RAMP], ["#aaaaaa", RAMP], ["#e1e1e1", RAMP], ["#d7d7d7", FAINT]];
  told.push([KIND_COLOURS["appeared"], MARKED], [KIND_COLOURS["disappeared"], GONE]);
  for (const [colour, alpha] of told) {
    const [r, g, b] = bytesOf(colour ?? "#000000");
    for (let i = 0; i < tints.length; i += 4) {
      if (near(tints[i], r) && near(tints[i + 1], g) && near(tints[i + 2], b)) tints[i + 3] = alpha;
    }
  }
  return tints;
}

/** Tell whether a channel is another one, give or take what is lost where colours are kept linear in bytes. */
function near(channel: number | undefined, wanted: number): boolean {
  return Math.abs((channel ?? 0) - wanted) <= 4;
}

function tableOf(tints: [string | undefined, number][]): Uint32Array {
  const table = new Uint8Array(4 * 256);
  for (const [code, [colour, alpha]] of tints.entries()) table.set([...bytesOf(colour ?? "#000000"), alpha], 4 * code);
  return new Uint32Array(table.buffer);
}

/** Return the distance of neighbours, metres: the root of the surface that each point has to itself. */
export function spacingOf(positions: Float32Array, { min, max }: Box): number {
  const n = positions.length / 3;
  const across = ([0, 1, 2] as const).map((axis) => max[axis] - min[axis]);
  const cell = Math.max(CELL, Math.cbrt(across.reduce((product, side) => product * (side + CELL), 1) / MOST_CELLS));
  const [nx, ny, nz] = across.map((side) => Math.floor(side / cell) + 1) as [number, number, number];
  const taken = new Uint8Array(nx * ny * nz);
  let cells = 0;
  const step = Math.max(1, Math.floor(n / 200_000));
  for (let i = 0; i < n; i += step) {
    const x = Math.floor(((positions[3 * i] as number) - min[0]) / cell);
    const y = Math.floor(((positions[3 * i + 1] as number) - min[1]) / cell);
    const z = Math.floor(((positions[3 * i + 2] as number) - min[2]) / cell);
    const at = x + nx * (y + ny * z);
    if (taken[at] === 0) [taken[at], cells] = [1, cells + 1];
  }
  return Math.min(Math.max(cell * Math.sqrt((SURFACE_PER_CELL * cells) / n), 0.005), 0.5);
}
