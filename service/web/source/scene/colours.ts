/** One colour for each kind and state: those of the picture and the coloured cloud (Okabe and Ito, 2008). */

import type { Kind, Theme } from "./types.ts";

/** As in `worker/pipeline/results/object_marks.py`; for CSS and for the scene. */
export const KIND_COLOURS: Readonly<Record<string, string>> = {
  appeared: "#d55e00",
  disappeared: "#0072b2",
  moved: "#aa4482",
};

/** As `STATE_COLORS` in `worker/pipeline/results/export.py`. */
export const STATE_COLOURS: Readonly<Record<string, string>> = {
  unchanged: "#aaaaaa",
  changed: "#d55e00",
  inconsistent: "#cc79a7",
  unobserved: "#56b4e9",
};

/** Of a tile as a box: that of a changed one is no object's, so that it is not taken for what appeared. */
export const TILE_COLOURS: Readonly<Record<Theme, Readonly<Record<string, string>>>> = {
  light: { changed: "#2b3038" },
  dark: { changed: "#b9c0c9", unchanged: "#666d76" },
};

/** Of a kind or state that this release does not know. */
export const OTHER_COLOUR = "#999999";

/** Return the colour of a kind, as CSS has it. */
export function colourOfKind(kind: Kind): string {
  return KIND_COLOURS[kind] ?? OTHER_COLOUR;
}

/** Return the colour of the box of a tile in that state, as CSS has it. */
export function colourOfState(state: string, theme: Theme): string {
  return TILE_COLOURS[theme][state] ?? STATE_COLOURS[state] ?? OTHER_COLOUR;
}

/** Of points that moved while the visit lasted: `PointKind.MOVING` in `worker/pipeline/results/export.py`. */
export const MOVING_COLOUR = "#f0e442";

/** Return red, green and blue, 0..255, of a colour `#rrggbb`. */
export function bytesOf(colour: string): [number, number, number] {
  const value = Number.parseInt(colour.slice(1), 16);
  return [value >> 16, (value >> 8) & 255, value & 255];
}
