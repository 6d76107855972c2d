/** Boxes: what is around them, in them, and in the way of a ray. No three.js here. */

import type { Box, Point } from "./types.ts";

/** A box that may stand at an angle: its middle, half of its sides, and its turn around z. */
export interface Solid {
  centre: Point;
  half: Point;
  /** Radians, anti-clockwise seen from above. */
  yaw: number;
}

/** Return what a box encloses, `margin` metres larger on each side. */
export function solidOf(box: Box, margin = 0): Solid {
  const size = box.turned?.size ?? across(box);
  return { centre: box.turned?.centre ?? centreOf(box), half: size.map((side) => side / 2 + margin) as Point, yaw: box.turned?.yaw ?? 0 };
}

export function centreOf({ min, max }: Box): Point {
  return [(min[0] + max[0]) / 2, (min[1] + max[1]) / 2, (min[2] + max[2]) / 2];
}

/** Return the lengths of the sides, metres. */
export function across({ min, max }: Box): Point {
  return [max[0] - min[0], max[1] - min[1], max[2] - min[2]];
}

/** Return the diagonal, metres. */
export function sizeOf(box: Box): number {
  return Math.hypot(...across(box));
}

/** Return the upright box that is `margin` metres larger on each side. */
export function grown({ min, max }: Box, margin: number): Box {
  return { min: min.map((value) => value - margin) as Point, max: max.map((value) => value + margin) as Point };
}

/** Return the upright box around boxes, of which there is one at least. */
export function around(boxes: readonly Box[]): Box {
  const along = (pick: (...values: number[]) => number, corner: "min" | "max") =>
    [0, 1, 2].map((axis) => pick(...boxes.map((box) => box[corner][axis] as number))) as Point;
  return { min: along(Math.min, "min"), max: along(Math.max, "max") };
}

/** Return the 12 edges. */
export function edgesOf(solid: Solid): { start: Point; end: Point }[] {
  const edges: { start: Point; end: Point }[] = [];
  for (let bits = 0; bits < 8; bits++) {
    for (const axis of [1, 2, 4]) {
      if ((bits & axis) === 0) edges.push({ start: cornerOf(solid, bits), end: cornerOf(solid, bits | axis) });
    }
  }
  return edges;
}

/** Return a corner by its number, whose bits say on which side of x, y and z it is. */
function cornerOf({ centre, half, yaw }: Solid, bits: number): Point {
  const [x, y, z] = half.map((side, axis) => ((bits >> axis) & 1 ? side : -side)) as Point;
  const [cos, sin] = [Math.cos(yaw), Math.sin(yaw)];
  return [centre[0] + cos * x - sin * y, centre[1] + sin * x + cos * y, centre[2] + z];
}

/** Return a vector as the box has it, which stands straight there. */
function untwisted([x, y, z]: Point, yaw: number): Point {
  const [cos, sin] = [Math.cos(yaw), Math.sin(yaw)];
  return [cos * x + sin * y, cos * y - sin * x, z];
}

/** Tell whether a point is inside. */
export function holds({ centre, half, yaw }: Solid, x: number, y: number, z: number): boolean {
  const [a, b, c] = untwisted([x - centre[0], y - centre[1], z - centre[2]], yaw);
  return Math.abs(a) <= half[0] && Math.abs(b) <= half[1] && Math.abs(c) <= half[2];
}

/** Return how far along a ray it enters (0 where it begins inside), in lengths of `direction`; null where it misses. */
export function entryOf({ centre, half, yaw }: Solid, origin: Point, direction: Point): number | null {
  const from = untwisted([origin[0] - centre[0], origin[1] - centre[1], origin[2] - centre[2]], yaw);
  const along = untwisted(direction, yaw);
  let [near, far] = [0, Infinity];
  for (const axis of [0, 1, 2] as const) {
    if (along[axis] === 0) {
      if (Math.abs(from[axis]) > half[axis]) return null;
      continue;
    }
    const [a, b] = [(-half[axis] - from[axis]) / along[axis], (half[axis] - from[axis]) / along[axis]];
    near = Math.max(near, Math.min(a, b));
    far = Math.min(far, Math.max(a, b));
  }
  return near <= far ? near : null;
}
