/** What the heights of a cloud's points tell: where its floor and its ceiling are. */

import type { Box } from "./types.ts";

const BIN = 0.05; // metres
const LEAST_ROOM = 1.8; // metres between a floor and its ceiling
const LEAST_PEAK = 0.15; // of the highest peak's points, for a ceiling
const OVER_USUAL = 4; // times the points of a usual height, for a ceiling
const SKIRT = 0.35; // of a peak's points: where the ceiling, which is never quite level, begins
const BELOW = 0.1; // metres that the cut lies under that
const DEEPEST = 0.6; // metres under the ceiling's peak that the cut may lie

/** Return the bounds of points (x y z each); those that are no numbers are left out. Null: none is left. */
export function boundsOf(positions: Float32Array): Box | null {
  const min: Box["min"] = [Infinity, Infinity, Infinity];
  const max: Box["max"] = [-Infinity, -Infinity, -Infinity];
  for (let i = 0; i + 2 < positions.length; i += 3) {
    for (let axis = 0; axis < 3; axis++) {
      const value = positions[i + axis] as number;
      if (value < (min[axis] as number)) min[axis] = value;
      if (value > (max[axis] as number)) max[axis] = value;
    }
  }
  return Number.isFinite(min[0]) && Number.isFinite(min[1]) && Number.isFinite(min[2]) ? { min, max } : null;
}

/** Heights of a cloud, metres. */
export interface Levels {
  /** Of the lowest floor, or of the lowest point where none stands out. */
  floor: number;
  /** Just under the topmost ceiling; null: there is none. */
  ceiling: number | null;
}

/**
 * Return where the lowest floor and the topmost ceiling are.
 *
 * Each is a height that has many more points than others; a ceiling is a room's height over the floor at least.
 */
export function levelsOf(positions: Float32Array, bounds: Box): Levels {
  const low = bounds.min[2];
  const counts = smooth(histogram(positions, low, Math.floor((bounds.max[2] - low) / BIN) + 1));
  const filled = counts.filter((count) => count > 0).sort();
  const [usual, highest] = [filled[filled.length >> 1] ?? 0, filled[filled.length - 1] ?? 0];
  const enough = Math.max(LEAST_PEAK * highest, Math.min(OVER_USUAL * usual, highest));
  const [bottom, top] = [counts.findIndex((count) => count >= enough), counts.findLastIndex((count) => count >= enough)];
  const floor = low + Math.max(bottom, 0) * BIN;
  return { floor, ceiling: (top - bottom) * BIN < LEAST_ROOM ? null : low + undersideOf(counts, top) * BIN - BELOW };
}

/** Return the bin where the ceiling with its highest bin at `top` or below begins, from below. */
function undersideOf(counts: Float64Array, top: number): number {
  const peak = highestAround(counts, top);
  let bin = peak;
  while (bin > 0 && (counts[bin] as number) > SKIRT * (counts[peak] as number) && (peak - bin) * BIN < DEEPEST) bin--;
  return bin + 1;
}

function histogram(positions: Float32Array, low: number, bins: number): Float64Array {
  const counts = new Float64Array(Math.min(Math.max(bins, 1), 100_000));
  for (let i = 2; i < positions.length; i += 3) {
    const bin = Math.floor(((positions[i] as number) - low) / BIN);
    if (bin >= 0 && bin < counts.length) counts[bin] = (counts[bin] as number) + 1;
  }
  return counts;
}

function smooth(counts: Float64Array): Float64Array {
  return counts.map((count, i) => ((counts[i - 1] ?? 0) + 2 * count + (counts[i + 1] ?? 0)) / 4);
}

/** Return the bin with most points from `top` on downwards for as long as there are more. */
function highestAround(counts: Float64Array, top: number): number {
  let peak = top;
  while (peak > 0 && (counts[peak - 1] as number) >= (counts[peak] as number)) peak--;
  return peak;
}
