/** Documents as the service answers with them, with what a test sets. */

import type {
  Box,
  Feature,
  FgTileFeature,
  ObjectProperties,
  SightingProperties,
  SurveySummaryDocument,
  TileProperties,
} from "../../../../service/web/source/app/documents.ts";

export function box(x: number, y: number, size = 1): Box {
  const half = size / 2;
  const corners: [number, number][] = [
    [x - half, y - half],
    [x + half, y - half],
    [x + half, y + half],
    [x - half, y + half],
  ];
  return {
    center: [x, y, half],
    size: [size, size, size],
    yaw_degrees: 0,
    footprint: [...corners, corners[0]!],
    height_over_floor: 0,
    volume: size ** 3,
    points: 100,
    tiles: ["tile_000_000_000"],
  };
}

export function sighting(known: Partial<SightingProperties> = {}): Feature<SightingProperties> {
  return {
    id: "survey-1.object_1",
    properties: {
      object_id: "object-1",
      number: 1,
      kind: "appeared",
      now: box(2, 3),
      before: null,
      motion: null,
      probability: 0.9,
      observed_share: 0.8,
      scans_seen_through: 2,
      map_version: 1,
      survey_id: "survey-1",
      device_id: "robot-7",
      model: "voxel-net/1",
      captured_at: "2026-03-04T12:00:00Z",
      first_seen: "2026-03-02T12:00:00Z",
      ...known,
    },
  };
}

export function object(known: Partial<ObjectProperties> = {}): Feature<ObjectProperties> {
  return {
    id: "object-1",
    properties: {
      ...sighting().properties,
      status: "new",
      last_known: "new",
      transient: false,
      last_seen: "2026-03-04T12:00:00Z",
      last_looked: "2026-03-04T12:00:00Z",
      accepted_in_version: null,
      sightings: 1,
      ...known,
    },
  };
}

export function tile(known: Partial<TileProperties> = {}): FgTileFeature {
  return {
    id: "survey-1.tile_000_001_000",
    place: {
      base: {
        coordinates: [
          [
            [0, 1.5],
            [1.5, 1.5],
            [1.5, 3],
            [0, 3],
            [0, 1.5],
          ],
        ],
      },
      lower: -0.1,
      upper: 0.9,
    },
    properties: {
      tile_id: "tile_000_001_000",
      center: [0.75, 2.25, 0.4],
      z_min: -0.1,
      z_max: 0.9,
      state: "changed",
      score: 0.93,
      threshold: 0.5,
      n_reference: 100,
      n_current: 120,
      observed_share: 0.9,
      appeared: 20,
      disappeared: 0,
      map_version: 1,
      survey_id: "survey-1",
      device_id: null,
      captured_at: "2026-03-04T12:00:00Z",
      first_seen: "2026-03-02T12:00:00Z",
      last_seen: "2026-03-04T12:00:00Z",
      max_score: 0.97,
      change_id: "change-1",
      ...known,
    },
  };
}

export function survey(known: Partial<SurveySummaryDocument> = {}): SurveySummaryDocument {
  return {
    survey_id: "survey-1",
    map_id: "lobby",
    map_version: 1,
    status: "ready",
    model: "voxel-net/1",
    threshold: 0.5,
    device_id: "robot-7",
    captured_at: "2026-03-04T12:00:00Z",
    warnings: [],
    scan_count: 4,
    placement: { state: "confirmed", confidence: 0.98 },
    counts: { tiles: 125, unchanged: 107, changed: 18, inconsistent: 0, unobserved: 0 },
    objects: { appeared: 2, disappeared: 1, moved: 0 },
    moving: 0,
    job_id: "job-1",
    problem: null,
    created: "2026-03-04T13:00:00Z",
    links: [],
    ...known,
  };
}
