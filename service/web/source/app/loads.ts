/** What is asked of the service for what is shown. */

import { ApiError } from "./api.ts";
import type { Controller } from "./controller.ts";
import type {
  Box,
  Collection,
  FgTileFeature,
  Feature,
  JobDocument,
  JobList,
  MapDocument,
  MapList,
  ObjectHistory,
  ObjectProperties,
  ScanDocument,
  SightingProperties,
  SurveyDocument,
  SurveyList,
  SurveySummaryDocument,
  TileProperties,
  VersionList,
  VersionSummaryDocument,
} from "./documents.ts";
import { boxOf, itemOfObject, itemOfSighting, itemOfTile, joinSides, type Item } from "./items.ts";
import type { Place } from "./link.ts";
import { focusOf, isOpen, NOT_ASKED, type Look } from "./state.ts";

const AT_ONCE = 4;
const MOST_LOOKS = 8; // surveys that are asked whether they saw the place of an object
const MOST_LATE = 20; // surveys that came last, of which the latest is looked for
const MOST_NAMES = 100; // as many scans as a document has
const FAILED_FOR_MS = 24 * 3_600_000; // for so long a failed job is shown

/** Ask for the list of maps, then for the latest survey of each. */
export async function maps(app: Controller): Promise<void> {
  await app.load("maps", () => app.api.pages("maps?limit=200", (list: MapList) => list.maps, 1000));
  const ids = (app.state.maps.value ?? []).map(({ map_id }) => map_id);
  await eachOf(ids, async (id) => {
    const { surveys } = await app.api.get<SurveyList>(`maps/${id}/surveys?limit=${MOST_LATE}`);
    const inOrder = byTime(surveys);
    const found = {
      survey: inOrder.at(-1) ?? null,
      result: inOrder.findLast(({ status }) => status === "ready") ?? null,
    };
    app.update({ latest: { ...app.state.latest, [id]: found } });
  });
}

/** Ask for all of the map that is shown; what is there already stays until the answers are. */
export async function map(app: Controller): Promise<void> {
  const id = app.state.place.map as string;
  await app.load("map", () => app.api.get<MapDocument>(`maps/${id}`));
  if (!app.state.map.value || app.state.place.map !== id) return;
  await Promise.all([
    app.load("surveys", () => surveysOf(app, id)),
    app.load("versions", () => versionsOf(app, id)),
  ]);
  if (app.state.map.value.status === "ready") await Promise.all([objects(app), ofSurvey(app), ofItem(app)]);
  else await namesShown(app);
}

/** Ask for what another survey, object, tab or filter needs. */
export function follow(app: Controller, before: Place): void {
  const { place } = app.state;
  if (place.survey !== before.survey) app.update({ sightings: NOT_ASKED, changes: NOT_ASKED });
  if (place.filters.device !== before.filters.device) void objects(app);
  if (place.item !== before.item) void ofItem(app);
  void ofSurvey(app);
}

async function surveysOf(app: Controller, id: string): Promise<SurveySummaryDocument[]> {
  const all = await app.api.pages(`maps/${id}/surveys?limit=500`, (list: SurveyList) => list.surveys, 2000);
  return byTime(all);
}

/** Sort surveys by the time they were captured, which is not the order in which they came. */
function byTime(surveys: SurveySummaryDocument[]): SurveySummaryDocument[] {
  return surveys.sort((one, other) => Date.parse(one.captured_at) - Date.parse(other.captured_at));
}

async function versionsOf(app: Controller, id: string): Promise<VersionSummaryDocument[]> {
  return (await app.api.get<VersionList>(`maps/${id}/versions?limit=100`)).versions;
}

/** Ask for the objects over all surveys; of a device those that any survey of it saw. */
async function objects(app: Controller): Promise<void> {
  const { map: id, filters } = app.state.place;
  const device = filters.device ? `&device_id=${encodeURIComponent(filters.device)}` : "";
  await app.load("objects", () =>
    items(app, `maps/${id}/objects?limit=1000${device}`, (feature: Feature<ObjectProperties>) => {
      const item = itemOfObject(feature);
      return filters.device ? { ...item, device: filters.device } : item;
    }),
  );
}

async function items<F>(app: Controller, path: string, read: (feature: F) => Item): Promise<Item[]> {
  const features = await app.api.pages(path, (collection: Collection<F>) => collection.features);
  return features.map(read);
}

/** Ask for what the survey in focus tells: itself, what it saw, its tiles, and the names of its scans. */
async function ofSurvey(app: Controller): Promise<void> {
  const { place, surveys, survey } = app.state;
  const focus = focusOf(app.state);
  const jobs: Promise<void>[] = [];
  if (focus && (survey.value?.survey_id !== focus.survey_id || survey.value.status !== focus.status)) {
    app.update({ survey: NOT_ASKED, tiles: {} });
    jobs.push(app.load("survey", () => app.api.get<SurveyDocument>(`surveys/${focus.survey_id}`)));
  }
  const chosen = place.survey ? surveys.value?.find(({ survey_id }) => survey_id === place.survey) : null;
  if (chosen?.objects) {
    const path = `surveys/${chosen.survey_id}/objects?limit=1000`;
    jobs.push(
      app.load("sightings", async () =>
        joinSides(await items(app, path, (one: Feature<SightingProperties>) => itemOfSighting(one))),
      ),
    );
  }
  if (place.list === "tiles" && (!place.survey || chosen?.status === "ready")) jobs.push(changes(app));
  if (focus?.status === "ready") jobs.push(...place.tiles.map((state) => tiles(app, focus.survey_id, state)));
  await Promise.all(jobs);
  await namesShown(app);
}

async function changes(app: Controller): Promise<void> {
  const { map: id, survey } = app.state.place;
  const path = survey ? `surveys/${survey}/tiles?state=changed&` : `maps/${id}/changes?`;
  await app.load("changes", () =>
    items(app, `${path}profile=jsonfg&limit=1000`, (one: FgTileFeature) => itemOfTile(one)),
  );
}

async function tiles(app: Controller, survey: string, state: string): Promise<void> {
  if (app.state.tiles[state]) return;
  await app.attempt(async () => {
    const path = `surveys/${survey}/tiles?state=${state}&profile=jsonfg&limit=5000`;
    const features = await app.api.pages(
      path,
      (collection: Collection<FgTileFeature>) => collection.features,
    );
    if (focusOf(app.state)?.survey_id !== survey) return;
    app.update({ tiles: { ...app.state.tiles, [state]: features } });
  });
}

/** Ask for the history of the chosen object, and whether surveys that did not tell it had looked there. */
async function ofItem(app: Controller): Promise<void> {
  const { map: id, item } = app.state.place;
  if (!item || item.startsWith("tile:")) return app.update({ looks: NOT_ASKED });
  if (app.state.looks.value && app.state.looks.value.id !== item) app.update({ looks: NOT_ASKED });
  await app.load("looks", async () => {
    const history = await app.api.get<ObjectHistory>(`maps/${id}/objects/${encodeURIComponent(item)}`);
    const [looks, tiles] = await Promise.all([looksAt(app, history), tilesOf(app, history)]);
    return { id: item, history, looks, tiles };
  });
}

/** Return the tiles that an object lies in, as the latest survey that saw it has them. */
async function tilesOf(app: Controller, { properties }: ObjectHistory): Promise<TileProperties[]> {
  const wanted = properties.now ?? properties.before;
  return wanted ? tilesAt(app, properties.survey_id, wanted) : [];
}

async function tilesAt(app: Controller, survey: string, place: Box): Promise<TileProperties[]> {
  const { min, max } = boxOf(place);
  const path = `surveys/${survey}/tiles?bbox=${[min[0], min[1], max[0], max[1]].join(",")}&bbox-crs=map`;
  const { features } = await app.api.get<Collection<Feature<TileProperties>>>(path);
  return features.map(({ properties }) => properties).filter(({ tile_id }) => place.tiles.includes(tile_id));
}

async function looksAt(app: Controller, { properties, sightings }: ObjectHistory): Promise<Look[]> {
  const saw = new Set(sightings.map((sighting) => sighting.properties.survey_id));
  const since = Date.parse(properties.first_seen ?? properties.captured_at);
  const others = (app.state.surveys.value ?? []).filter(
    (survey) =>
      survey.status === "ready" &&
      survey.objects &&
      !saw.has(survey.survey_id) &&
      Date.parse(survey.captured_at) > since,
  );
  const place = properties.now ?? properties.before;
  const looks = new Map<string, number | null>();
  if (place) {
    await eachOf(others.slice(-MOST_LOOKS), async ({ survey_id }) => {
      const tiles = await tilesAt(app, survey_id, place);
      looks.set(
        survey_id,
        tiles.reduce((total, tile) => total + (tile.observed_share ?? 0), 0) / place.tiles.length,
      );
    });
  }
  return others.map((survey) => ({ survey, share: looks.get(survey.survey_id) ?? null }));
}

/** Ask for the names of the scans that are listed: the map's, also where it could not be built, or the survey's. */
async function namesShown(app: Controller): Promise<void> {
  const { place, map: shown, survey } = app.state;
  const ofMap = place.tab === "map" || shown.value?.status !== "ready";
  const scans = ofMap ? shown.value?.scans : place.tab === "survey" ? survey.value?.scans : [];
  await names(
    app,
    (scans ?? []).map(({ scan_id }) => scan_id),
  );
}

/** Ask for the file names of scans, of each once; a scan that cannot be looked at keeps its id. */
export async function names(app: Controller, ids: string[]): Promise<void> {
  const missing = ids.filter((id) => !(id in app.state.names) && !asked.has(id)).slice(0, MOST_NAMES);
  for (const id of missing) asked.add(id);
  await eachOf(missing, async (id) => {
    const scan = await app.api.get<ScanDocument>(`scans/${id}`).catch(() => null);
    asked.delete(id);
    app.update({ names: { ...app.state.names, [id]: scan?.filename ?? id } });
  });
}

const asked = new Set<string>(); // scans whose names are on their way

/** Ask for the jobs that wait or run, and those that failed lately. */
export async function jobs(app: Controller): Promise<void> {
  const { map: id } = app.state.place;
  const filter = id ? `&map_id=${id}` : "";
  try {
    const { jobs: known } = await app.api.get<JobList>(`jobs?limit=50${filter}`);
    const before = new Set(app.state.jobs.filter(isOpen).map(({ jobID }) => jobID));
    app.update({ jobs: known.filter((job) => isOpen(job) || failedLately(job)) });
    if (known.some((job) => !isOpen(job) && before.has(job.jobID)) && app.state.line !== "live")
      app.jobsChanged();
  } catch (error) {
    // a broken stream may tell later
    if (error instanceof ApiError && error.code === "no_answer") app.unreachable();
  }
}

function failedLately(job: JobDocument): boolean {
  return job.status === "failed" && Date.now() - Date.parse(job.created) < FAILED_FOR_MS;
}

/** Do something for each, a few at once; one that fails is left out. */
async function eachOf<T>(all: readonly T[], act: (one: T) => Promise<void>): Promise<void> {
  const rest = [...all];
  const worker = async () => {
    for (let one = rest.shift(); one !== undefined; one = rest.shift()) await act(one).catch(() => {});
  };
  await Promise.all(Array.from({ length: AT_ONCE }, worker));
}
