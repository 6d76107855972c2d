/** What the list shows, be it an object over all surveys, what one survey saw of it, or a changed tile. */

import type { Box as SceneBox, Mark, TileMark } from "../scene/types.ts";
import type {
  Box,
  Feature,
  FgTileFeature,
  ObjectProperties,
  SightingProperties,
  TileProperties,
} from "./documents.ts";
import { height, metres } from "./format.ts";

export interface Item {
  id: string; // of the object, and of a tile with `tile:` before it; what the link and the scene call it
  what: "object" | "tile";
  kind: string;
  status: string | null; // of an object over all surveys
  device: string | null;
  surveyId: string; // that the evidence is of: the latest which saw it
  mapVersion: number; // that this survey was compared with
  probability: number; // 0..1; of a tile its score
  firstSeen: string;
  lastSeen: string;
  title: string; // its size, or the tile's name
  box: SceneBox; // where it is, or was where it is gone; metres, map frame
  from?: SceneBox; // where it was before it moved
  place: Box | null;
  sighting: SightingProperties | null;
  history: ObjectProperties | null;
  tile: TileProperties | null;
}

/** Return the axis-aligned box around a place, and how it stands in that; metres, map frame. */
export function boxOf(place: Box): SceneBox {
  const xs = place.footprint.map(([x]) => x);
  const ys = place.footprint.map(([, y]) => y);
  const half = place.size[2] / 2;
  return {
    min: [Math.min(...xs), Math.min(...ys), place.center[2] - half],
    max: [Math.max(...xs), Math.max(...ys), place.center[2] + half],
    turned: { centre: place.center, size: place.size, yaw: (place.yaw_degrees * Math.PI) / 180 },
  };
}

/** Return an object of `/maps/{id}/objects`, as it stands. */
export function itemOfObject(feature: Feature<ObjectProperties>): Item {
  const known = feature.properties;
  const item = itemOfSighting(feature);
  return {
    ...item,
    status: known.status,
    history: known,
    firstSeen: known.first_seen ?? known.captured_at,
    lastSeen: known.last_seen,
  };
}

/** Return an object of `/surveys/{id}/objects`. */
export function itemOfSighting(feature: Feature<SightingProperties>): Item {
  const seen = feature.properties;
  const place = (seen.now ?? seen.before) as Box;
  return {
    id: seen.object_id ?? feature.id,
    what: "object",
    kind: seen.kind,
    status: null,
    device: seen.device_id,
    surveyId: seen.survey_id,
    mapVersion: seen.map_version,
    probability: seen.probability,
    firstSeen: seen.first_seen ?? seen.captured_at,
    lastSeen: seen.captured_at,
    title: place.size.map((side) => side.toFixed(1)).join(" × ") + " m",
    box: boxOf(place),
    ...(seen.now && seen.before ? { from: boxOf(seen.before) } : {}),
    place,
    sighting: seen,
    history: null,
    tile: null,
  };
}

/** Return what a survey saw, of an object whose places it told as two things one item: it moved. */
export function joinSides(items: readonly Item[]): Item[] {
  const known = new Map<string, Item>();
  for (const item of items) {
    const other = known.get(item.id);
    const [shown, left] = other && !item.sighting?.now ? [other, item] : [item, other];
    known.set(item.id, left ? { ...shown, kind: "moved", from: left.box } : shown);
  }
  return [...known.values()];
}

/** Return a changed tile of `/maps/{id}/changes` or `/surveys/{id}/tiles`. */
export function itemOfTile(feature: FgTileFeature): Item {
  const tile = feature.properties;
  return {
    id: `tile:${tile.tile_id}`,
    what: "tile",
    kind: kindOfTile(tile),
    status: null,
    device: tile.device_id,
    surveyId: tile.survey_id,
    mapVersion: tile.map_version,
    probability: tile.max_score ?? tile.score ?? 0,
    firstSeen: tile.first_seen ?? tile.captured_at,
    lastSeen: tile.last_seen ?? tile.captured_at,
    title: tile.tile_id.replace("tile_", "Tile ").replaceAll("_", " "),
    box: boxOfTile(feature),
    place: null,
    sighting: null,
    history: null,
    tile,
  };
}

/** Return the box of a tile, metres, map frame. */
export function boxOfTile({ place }: FgTileFeature): SceneBox {
  const ring = place.base.coordinates[0] ?? [];
  const xs = ring.map(([x]) => x);
  const ys = ring.map(([, y]) => y);
  return {
    min: [Math.min(...xs), Math.min(...ys), place.lower],
    max: [Math.max(...xs), Math.max(...ys), place.upper],
  };
}

/** Return what the voxels of a tile did: `appeared`, `disappeared`, `both`, or `changed` where none are told. */
export function kindOfTile(tile: TileProperties): string {
  if (tile.appeared && tile.disappeared) return "both";
  if (tile.appeared) return "appeared";
  return tile.disappeared ? "disappeared" : "changed";
}

/** Return an item as the scene marks it; what is there no more is muted. */
export function markOf(item: Item): Mark {
  const muted = item.status === "gone_again" || item.status === "accepted";
  return {
    id: item.id,
    box: item.box,
    kind: item.kind,
    label: `${item.kind}, ${item.title}`,
    ...(muted ? { muted } : {}),
    ...(item.from ? { from: item.from } : {}),
  };
}

/** Return a tile as the scene marks it. */
export function tileMarkOf(feature: FgTileFeature): TileMark {
  const { tile_id, state, score } = feature.properties;
  return { id: `tile:${tile_id}`, box: boxOfTile(feature), state, score };
}

/** Say where an item is: the middle of its box, and how high over the floor. */
export function whereOf(item: Item): string {
  const at = [0, 1].map((axis) => ((item.box.min[axis]! + item.box.max[axis]!) / 2).toFixed(1)).join(", ");
  const over = item.place?.height_over_floor;
  if (over == null) return `at ${at}, ${height(item.box.min[2])} to ${height(item.box.max[2])}`;
  return over < 0.2 ? `at ${at}, on the floor` : `at ${at}, ${metres(over)} over the floor`;
}
