/** What the scene is given and what it tells: the seam between drawing (`scene/`) and the page (`app/`). */

/** The kind of a change, as the API names it. */
export type Kind = "appeared" | "disappeared" | "moved" | (string & {});

/** A point in metres, map frame, z up. */
export type Point = [number, number, number];

/** An upright box: metres, map frame, z up. */
export interface Box {
  min: Point;
  max: Point;
  /** What stands at an angle in it: its middle, its sides along its own axes, and its turn around z, radians. */
  turned?: { centre: Point; size: Point; yaw: number };
}

/** An object that changed. */
export interface Mark {
  id: string;
  box: Box;
  kind: Kind;
  label: string;
  /** Drawn faintly: what was confirmed or dismissed already. */
  muted?: boolean;
  /** Where it was, of what was moved. */
  from?: Box;
}

/** A tile of the map with what a survey said of it. */
export interface TileMark {
  id: string;
  box: Box;
  /** As the API names it: unchanged, changed, inconsistent, unobserved. */
  state: string;
  /** Probability of change, 0..1. */
  score: number | null;
}

/** Where the camera is and what it looks at; metres, map frame. */
export interface View {
  position: Point;
  target: Point;
}

/** A cloud to load: a binary PLY file, or a 3D Tiles tileset. */
export interface CloudSource {
  url: string;
  /** Of the file, where it is known before. */
  bytes?: number;
  kind: "ply" | "tileset";
  /** 4 x 4, row by row: from the cloud's frame to the map's; left out: they are the same. */
  target_from_cloud?: number[];
}

/** The map as it was, and what the survey saw. */
export type Layer = "reference" | "survey";

/** What is to be seen; `split`: the map on the left, the survey on the right, under one camera. */
export type Shown = Layer | "both" | "split";

export type Theme = "light" | "dark";

export interface SceneOptions {
  /** Fetches clouds; adds the API key where one is needed. */
  fetch: typeof fetch;
}
