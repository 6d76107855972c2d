/** The members of the API's documents that the page reads; openapi/openapi.json has all of them. A test compares. */

export type Vector = [number, number, number];

export interface Link {
  href: string;
  rel: string;
}

/** RFC 9457. */
export interface ProblemDocument {
  type: string;
  title: string;
  status?: number | null;
  detail: string;
  errors?: InvalidValue[] | null;
  instance?: string | null;
}

export interface InvalidValue {
  place: string;
  detail: string;
}

export type Counts = Record<string, number>;

export interface Bounds {
  min: Vector;
  max: Vector;
}

export interface ScanWarning {
  reason: string;
  detail: string;
}

export interface ScanOutcome {
  scan_id: string;
  accepted: boolean | null;
  fitness: number | null;
  rmse: number | null; // metres
  translation_sigma: number | null; // metres
  rotation_sigma: number | null; // radians
  confidence: number | null;
  reason: string | null;
  detail: string | null;
  warnings: ScanWarning[];
}

export interface ScanDocument {
  scan_id: string;
  filename: string;
}

export interface MapSummaryDocument {
  map_id: string;
  name: string | null;
  version: number;
  status: "building" | "ready" | "failed";
  model: string;
  scan_count: number;
  bounds: Bounds | null; // metres, map frame
  counts: Counts;
  objects: Counts; // by status
  job_id: string;
  problem: ProblemDocument | null;
  created: string;
  updated: string;
  links: Link[];
}

export interface MapDocument extends MapSummaryDocument {
  scans: ScanOutcome[];
}

export interface MapList {
  maps: MapSummaryDocument[];
  links: Link[];
}

export interface VersionSummaryDocument {
  version: number;
  status: "building" | "ready" | "failed";
  survey_id: string | null;
  base_version: number | null;
  counts: Counts;
  links: Link[];
  created: string;
  problem: ProblemDocument | null;
}

export interface VersionList {
  versions: VersionSummaryDocument[];
  links: Link[];
}

export interface Placement {
  state: "confirmed" | "in_doubt" | "refused";
  confidence: number | null;
}

export interface SurveySummaryDocument {
  survey_id: string;
  map_id: string;
  map_version: number;
  status: "running" | "ready" | "failed";
  model: string;
  threshold: number | null;
  device_id: string | null;
  captured_at: string;
  warnings: ScanWarning[];
  scan_count: number;
  placement: Placement | null;
  counts: Counts; // of tiles, by state
  objects: Counts | null; // by kind; null: the model tells tiles alone, or the placement is in doubt
  moving: number | null;
  job_id: string;
  problem: ProblemDocument | null;
  created: string;
  links: Link[];
}

export interface SurveyDocument extends SurveySummaryDocument {
  scans: ScanOutcome[];
}

export interface SurveyList {
  surveys: SurveySummaryDocument[];
  links: Link[];
}

export interface JobDocument {
  jobID: string;
  processID: string;
  status: "accepted" | "running" | "successful" | "failed" | "dismissed";
  message: string;
  progress: number; // 0..100
  queue_position: number | null;
  map_id: string;
  survey_id: string | null;
  problem: ProblemDocument | null;
  created: string;
}

export interface JobList {
  jobs: JobDocument[];
  links: Link[];
}

/** An upright box, map frame, metres. */
export interface Box {
  center: Vector;
  size: Vector; // along its own axes
  yaw_degrees: number; // of its first axis, counter-clockwise from x
  footprint: [number, number][]; // closed
  height_over_floor: number | null;
  volume: number; // cubic metres
  points: number;
  tiles: string[];
}

export interface Move {
  translation: Vector; // metres
  yaw_degrees: number | null;
}

export interface SightingProperties {
  object_id: string | null;
  number: number;
  kind: string;
  now: Box | null;
  before: Box | null;
  motion: Move | null;
  probability: number;
  observed_share: number;
  scans_seen_through: number;
  map_version: number;
  survey_id: string;
  device_id: string | null;
  model: string;
  captured_at: string;
  first_seen: string | null;
}

export interface ObjectProperties extends SightingProperties {
  status: string;
  last_known: string;
  transient: boolean;
  last_seen: string;
  last_looked: string;
  accepted_in_version: number | null;
  sightings: number;
}

export interface TileProperties {
  tile_id: string;
  center: Vector; // metres, map frame
  z_min: number;
  z_max: number;
  state: string;
  score: number | null;
  threshold: number | null;
  n_reference: number;
  n_current: number;
  observed_share: number | null;
  appeared: number | null; // voxels
  disappeared: number | null;
  map_version: number;
  survey_id: string;
  device_id: string | null;
  captured_at: string;
  first_seen: string | null;
  last_seen: string | null;
  max_score: number | null;
  change_id: string | null;
}

export interface Feature<P> {
  id: string;
  properties: P;
}

export interface Collection<F> {
  features: F[];
  numberMatched: number;
  links: Link[];
}

export interface ObjectHistory extends Feature<ObjectProperties> {
  sightings: Feature<SightingProperties>[];
}

/** A tile with `profile=jsonfg`, which tells its corners. */
export interface FgTileFeature extends Feature<TileProperties> {
  place: Prism;
}

/** An upright solid, map frame, metres. */
export interface Prism {
  base: { coordinates: [number, number][][] };
  lower: number;
  upper: number;
}

export interface CloudEvent {
  type: string;
  subject: string;
  sequence: string;
  data: { map_id?: string; survey_id?: string; [name: string]: unknown };
}

export interface EventList {
  events: CloudEvent[];
  cursor: string;
}
