/** What the page knows: everything that is shown follows from it. */

import type { Box, TileMark } from "../scene/types.ts";
import type {
  FgTileFeature,
  JobDocument,
  MapDocument,
  MapSummaryDocument,
  ObjectHistory,
  ProblemDocument,
  SurveyDocument,
  SurveySummaryDocument,
  TileProperties,
  VersionSummaryDocument,
} from "./documents.ts";
import { filtered, type Filters } from "./filters.ts";
import type { Line } from "./follow.ts";
import { itemOfTile, tileMarkOf, type Item } from "./items.ts";
import { NOWHERE, type Place, type Show } from "./link.ts";

/** Something that is asked of the service; an older value stays while it is asked for again. */
export interface Loaded<T> {
  value: T | null;
  problem: ProblemDocument | null;
  busy: boolean;
}

export const NOT_ASKED: Loaded<never> = { value: null, problem: null, busy: false };

/** How far a cloud is. */
export interface LayerState {
  url: string | null;
  share: number; // 0..1
  loaded: boolean;
  problem: string | null;
}

export interface StageState {
  problem: string | null; // why nothing is drawn
  reference: LayerState;
  survey: LayerState;
  drawn: boolean; // a first picture with points is there
  extent: Box | null;
  ceiling: number | null; // metres, map frame; just under it
}

export const NO_LAYER: LayerState = { url: null, share: 0, loaded: false, problem: null };
const EMPTY_STAGE: StageState = {
  problem: null,
  reference: NO_LAYER,
  survey: NO_LAYER,
  drawn: false,
  extent: null,
  ceiling: null,
};

/** How much of an object's place a survey that did not tell it had seen. */
export interface Look {
  survey: SurveySummaryDocument;
  share: number | null; // 0..1; null: not known
}

export interface ObjectLooks {
  id: string;
  history: ObjectHistory;
  looks: Look[]; // of surveys that did not see it, since it was first seen
  tiles: TileProperties[]; // that it lies in, as the latest survey which saw it has them
}

/** The survey of a map that was captured last, and the last that has a result; null: there is none. */
export interface Latest {
  survey: SurveySummaryDocument | null;
  result: SurveySummaryDocument | null;
}

export interface Sending {
  name: string;
  size: number; // bytes
  sent: number;
  waiting: string | null; // why it does not go on at this moment
  problem: ProblemDocument | null;
  scan: string | null;
}

export interface UploadState {
  map: string | null; // a survey of this map; null: a new map
  files: Sending[];
  refused: { name: string; why: string }[];
  phase: "choosing" | "sending" | "asking" | "failed";
  problem: ProblemDocument | null;
}

export interface Question {
  title: string;
  text: string;
  yes: string;
  act: () => Promise<void>;
}

/** Something that is said for a while. */
export interface Notice {
  text: string;
  tone: "plain" | "bad";
  to: { map: string; survey: string } | null; // the survey that it is about
}

export type Theme = "system" | "light" | "dark";

export interface State {
  place: Place;
  theme: Theme;
  line: Line | null; // how events come; null: not yet
  hasKey: boolean;
  asksKey: ProblemDocument | null; // of the request that was refused
  maps: Loaded<MapSummaryDocument[]>;
  latest: Record<string, Latest>; // by map
  jobs: JobDocument[]; // that wait or run, and those that failed last
  map: Loaded<MapDocument>;
  versions: Loaded<VersionSummaryDocument[]>;
  surveys: Loaded<SurveySummaryDocument[]>; // by captured_at, the earliest first
  survey: Loaded<SurveyDocument>; // that is in focus
  objects: Loaded<Item[]>; // over all surveys
  sightings: Loaded<Item[]>; // of the chosen survey
  changes: Loaded<Item[]>; // changed tiles over all surveys, or of the chosen one
  tiles: Record<string, FgTileFeature[]>; // of the survey in focus, by state
  looks: Loaded<ObjectLooks>;
  names: Record<string, string>; // file names of scans
  stage: StageState;
  dialog: "help" | "key" | "share" | null;
  upload: UploadState | null;
  question: Question | null;
  filtersOpen: boolean;
  sectionOpen: boolean;
  panel: "low" | "half" | "full"; // of a small screen
  notice: Notice | null;
}

export function firstState(place: Place, theme: Theme, hasKey: boolean): State {
  return {
    place,
    theme,
    line: null,
    hasKey,
    asksKey: null,
    maps: NOT_ASKED,
    latest: {},
    jobs: [],
    ...nothingOfAMap(),
    dialog: null,
    upload: null,
    question: null,
    filtersOpen: false,
    sectionOpen: false,
    panel: "half",
    notice: null,
  };
}

/** Return the part of the state that is of one map, empty. */
export function nothingOfAMap() {
  return {
    map: NOT_ASKED,
    versions: NOT_ASKED,
    surveys: NOT_ASKED,
    survey: NOT_ASKED,
    objects: NOT_ASKED,
    sightings: NOT_ASKED,
    changes: NOT_ASKED,
    tiles: {},
    looks: NOT_ASKED,
    names: {},
    stage: EMPTY_STAGE,
  } satisfies Partial<State>;
}

/** Return all items of the list, before the filters. */
export function allItems(state: State): Item[] {
  const { place, objects, sightings, changes } = state;
  if (place.list === "tiles") return changes.value ?? [];
  return (place.survey ? sightings.value : objects.value) ?? [];
}

/** Return the survey that the list is of; null where it is of all surveys. */
export function listedSurvey({ place, surveys }: State): SurveySummaryDocument | null {
  return surveys.value?.find(({ survey_id }) => survey_id === place.survey) ?? null;
}

/** Return a function that gives the same answer for as long as its parts are the same. */
function remembered<T>(): (parts: unknown[], make: () => T) => T {
  let kept: { parts: unknown[]; value: T } | null = null;
  return (parts, make) => {
    const same = kept?.parts.length === parts.length && kept.parts.every((part, n) => part === parts[n]);
    if (!kept || !same) kept = { parts, value: make() };
    return kept.value;
  };
}

const keptItems = remembered<Item[]>();
const keptTiles = remembered<TileMark[]>();

/** Return the items that the filters let through; the same array for as long as nothing of it changed. */
export function shownItems(state: State): Item[] {
  const section = sectionOf(state);
  const { filters } = state.place;
  return keptItems([allItems(state), filters, ...(section ?? [])], () =>
    filtered(allItems(state), filters, section),
  );
}

/** Return the tiles that are boxes, filtered as the list is and cut by the section; the same array as above. */
export function shownTiles(state: State): TileMark[] {
  const section = sectionOf(state);
  const { filters, tiles } = state.place;
  return keptTiles([state.tiles, filters, ...tiles, ...(section ?? [])], () =>
    tiles
      .flatMap((name) => state.tiles[name] ?? [])
      .filter((one) => isThrough(one, filters))
      .map(tileMarkOf)
      .flatMap((mark) => cut(mark, section)),
  );
}

/** Tell whether the filters let a tile through; they are for what changed alone. */
function isThrough(tile: FgTileFeature, filters: Filters): boolean {
  return tile.properties.state !== "changed" || filtered([itemOfTile(tile)], filters).length > 0;
}

/** Return the part of a tile that lies between two heights, if there is one. */
function cut(mark: TileMark, section: readonly [number, number] | null): TileMark[] {
  if (!section) return [mark];
  const { min, max } = mark.box;
  const [low, high] = [Math.max(min[2], section[0]), Math.min(max[2], section[1])];
  if (low >= high) return [];
  return [{ ...mark, box: { min: [min[0], min[1], low], max: [max[0], max[1], high] } }];
}

/** Return the chosen item, also where a filter hides it. */
export function chosenItem(state: State): Item | null {
  const { item } = state.place;
  if (!item) return null;
  const lists = [state.sightings, state.objects, state.changes];
  for (const { value } of lists) {
    const found = value?.find(({ id }) => id === item);
    if (found) return found;
  }
  return null;
}

/** Return the survey that is compared: the chosen one, else that of the chosen item, else the latest with a result. */
export function focusOf(state: State): SurveySummaryDocument | null {
  const surveys = state.surveys.value ?? [];
  const wanted = state.place.survey ?? chosenItem(state)?.surveyId;
  if (wanted) return surveys.find(({ survey_id }) => survey_id === wanted) ?? null;
  return surveys.findLast(({ status }) => status === "ready") ?? null;
}

/** Return which clouds are asked for: of a survey without a result there is none beside the map's. */
export function showOf(state: State): Show {
  const focus = focusOf(state);
  if (focus && focus.status !== "ready") return "reference";
  return state.place.show ?? (state.place.item ? "split" : state.place.survey ? "both" : "reference");
}

/** Return the heights between which points are shown; null before a cloud is there. */
export function sectionOf({ place, stage }: State): [number, number] | null {
  if (place.section) return place.section;
  if (!stage.extent) return null;
  return [stage.extent.min[2], stage.ceiling ?? stage.extent.max[2]];
}

/** Return the job of a map or survey, while it is known. */
export function jobOf(state: State, jobId: string): JobDocument | undefined {
  return state.jobs.find(({ jobID }) => jobID === jobId);
}

export function isOpen({ status }: JobDocument): boolean {
  return status === "accepted" || status === "running";
}

/** Return a place of the list of maps, or of one map, with all else as at the beginning. */
export function placeOf(map: string | null): Place {
  return { ...NOWHERE, map };
}
