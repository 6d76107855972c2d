/** Keeps the scene the same as the state: clouds, marks, tiles, section, camera. */

import type { Scene } from "../scene/scene.ts";
import type { Box, CloudSource, Layer, View } from "../scene/types.ts";
import type { Controller } from "./controller.ts";
import type { MapDocument } from "./documents.ts";
import { itemOfTile, markOf, type Item } from "./items.ts";
import {
  chosenItem,
  focusOf,
  NO_LAYER,
  sectionOf,
  showOf,
  shownItems,
  shownTiles,
  type LayerState,
  type State,
} from "./state.ts";

const MOST_POINTS = 1_000_000; // of a cloud that is loaded whole, where there is a tileset of it
const PADDING = 0.2; // metres around an object that are never out of the picture

/** Fetch what draws; asked for early, it is there when the map is known. */
export function drawing(): Promise<typeof import("../scene/scene.ts")> {
  return import("../scene/scene.ts");
}

export class Stage {
  #scene: Scene | null = null;
  #container: HTMLElement | null = null;
  #done: Partial<Record<string, unknown>> = {}; // what the scene was told last
  #told: View | null = null; // by the scene or to it
  #flown: string | null = null; // the item that the camera went to
  readonly #loading: Partial<Record<Layer, AbortController>> = {};
  readonly #app: Controller;

  constructor(app: Controller) {
    this.#app = app;
  }

  get scene(): Scene | null {
    return this.#scene;
  }

  /** Make a scene in an element, or end it where there is none any more; the same function for every drawing. */
  readonly attach = (container: HTMLElement | null): void => {
    if (container === this.#container) return;
    this.#end();
    this.#container = container;
    if (container) void this.#begin(container);
  };

  async #begin(container: HTMLElement): Promise<void> {
    try {
      const { Scene } = await drawing();
      if (container !== this.#container) return;
      const scene = new Scene(container, { fetch: this.#app.api.fetch as typeof fetch });
      this.#scene = scene;
      window.spicd = { scene };
      scene.on("pick", (id) => this.#app.go({ item: id, view: null }));
      scene.on("view", () => {
        this.#told = scene.view;
        this.#app.go({ view: this.#told });
      });
      scene.on("drawn", () => this.#drawn(scene));
      this.sync(this.#app.state);
    } catch (error) {
      const why = (error as Error).message;
      const problem = `This browser cannot draw in 3D (${why}). The lists and their details are all there.`;
      this.#app.update({ stage: { ...this.#app.state.stage, problem } });
    }
  }

  #drawn({ extent, suggestedCeiling }: Scene): void {
    this.#app.update({
      stage: { ...this.#app.state.stage, drawn: true, extent, ceiling: suggestedCeiling },
    });
  }

  #end(): void {
    for (const loading of Object.values(this.#loading)) loading.abort();
    this.#scene?.dispose();
    this.#scene = null;
    this.#done = {};
    this.#told = this.#flown = null;
    delete window.spicd;
  }

  /** Tell the scene what changed since it was told last. */
  sync(state: State): void {
    const scene = this.#scene;
    if (!scene || !state.map.value) return;
    this.#once("theme", shownTheme(state), (theme) => scene.setTheme(theme as "light" | "dark"));
    this.#load("reference", referenceOf(state));
    this.#load("survey", this.#asksSurvey(state) ? surveyOf(state) : this.#kept(state));
    const show = state.stage.survey.loaded ? showOf(state) : "reference";
    const lost = isOfSurvey(state) || showOf(state) !== "reference";
    this.#once("show", `${show} ${lost}`, () => scene.show(show, lost));
    this.#once("marks", shownItems(state), () =>
      scene.setMarks(state.place.list === "tiles" ? [] : shownItems(state).map(markOf)),
    );
    this.#syncTiles(scene, state);
    const section = sectionOf(state);
    if (section) this.#once("section", section.join(), () => scene.setSection(...section));
    this.#syncCamera(scene, state);
  }

  #syncTiles(scene: Scene, state: State): void {
    const tiles = shownTiles(state);
    this.#once("tiles", tiles, () => scene.setTiles(tiles));
  }

  #syncCamera(scene: Scene, state: State): void {
    const item = lookedAt(state);
    this.#once("item", item?.id ?? null, () => scene.select(item?.id ?? null));
    if (!state.stage.reference.loaded) return;
    const { view, item: id } = state.place;
    if (view && view !== this.#told) {
      scene.view = this.#told = view; // a link says where to look from
      this.#flown = id;
    } else if (item && this.#flown !== id) {
      scene.flyTo(around(item.box, item.from));
      this.#flown = id;
    } else if (!id) this.#flown = null;
  }

  #once(name: string, value: unknown, act: (value: unknown) => void): void {
    if (name in this.#done && this.#done[name] === value) return;
    this.#done[name] = value;
    act(value);
  }

  /** Whether the survey's cloud is wanted: with the map shown alone for what is gone, which comes after the map. */
  #asksSurvey(state: State): boolean {
    if (showOf(state) !== "reference") return true;
    return isOfSurvey(state) && state.stage.reference.loaded;
  }

  /** Return the survey's cloud that is loaded, if it is still that of the survey in focus. */
  #kept(state: State): CloudSource | null {
    const source = surveyOf(state);
    return source && source.url === state.stage.survey.url ? source : null;
  }

  #load(layer: Layer, source: CloudSource | null): void {
    const name = `cloud-${layer}`;
    if ((this.#done[name] ?? null) === (source?.url ?? null)) return;
    this.#done[name] = source?.url ?? null;
    this.#loading[layer]?.abort();
    if (!source) {
      this.#scene?.unload(layer);
      return this.#tell(layer, NO_LAYER);
    }
    const aborted = (this.#loading[layer] = new AbortController());
    void this.#follow(layer, source, aborted.signal);
  }

  async #follow(layer: Layer, source: CloudSource, signal: AbortSignal): Promise<void> {
    const scene = this.#scene as Scene;
    this.#tell(layer, { ...NO_LAYER, url: source.url });
    let shown = 0;
    const progress = (share: number) => {
      if (signal.aborted || share - shown < 0.02) return;
      shown = share;
      this.#tell(layer, { ...NO_LAYER, url: source.url, share });
    };
    try {
      await scene.load(layer, source, progress, signal);
      if (signal.aborted) return;
      const { extent, suggestedCeiling } = scene;
      const found = layer === "reference" ? { extent, ceiling: suggestedCeiling } : {};
      this.#tell(layer, { url: source.url, share: 1, loaded: true, problem: null }, found);
    } catch (error) {
      if (!signal.aborted)
        this.#tell(layer, { ...NO_LAYER, url: source.url, problem: (error as Error).message });
    }
  }

  #tell(layer: Layer, layerState: LayerState, more: Partial<State["stage"]> = {}): void {
    const { stage } = this.#app.state;
    this.#app.update({ stage: { ...stage, ...more, [layer]: layerState } });
  }

  /** Look at the chosen item again. */
  lookAtItem(): void {
    const item = lookedAt(this.#app.state);
    if (item) this.#scene?.flyTo(around(item.box, item.from));
  }

  topDown(): void {
    this.#scene?.topDown();
  }
}

/** Return the chosen item; also a tile that is no item of a list, but is shown as a box. */
export function lookedAt(state: State): Item | null {
  const item = chosenItem(state);
  const { item: id } = state.place;
  if (item || !id?.startsWith("tile:")) return item;
  const found = Object.values(state.tiles)
    .flat()
    .find(({ properties }) => `tile:${properties.tile_id}` === id);
  if (!found) return null;
  const { state: kind } = found.properties;
  return { ...itemOfTile(found), ...(kind === "changed" ? {} : { kind }) };
}

/** Return the theme that is shown, the system's where nobody chose. */
export function shownTheme({ theme }: State): "light" | "dark" {
  if (theme !== "system") return theme;
  return matchMedia("(prefers-color-scheme: dark)").matches ? "dark" : "light";
}

/** Return the version of the map that is looked at: what the survey in focus was compared with, else the one in use. */
export function referenceVersion(state: State): number {
  const focus = isOfSurvey(state) ? focusOf(state) : null;
  return focus?.map_version ?? (state.map.value as MapDocument).version;
}

/** Whether a survey is looked at, and not all of them together. */
function isOfSurvey({ place }: State): boolean {
  return place.survey !== null || place.item !== null;
}

/** Return the cloud of the map, of the version that is looked at; null until it is known which it is. */
function referenceOf(state: State): CloudSource | null {
  const map = state.map.value as MapDocument;
  if (map.status !== "ready") return null;
  const version = referenceVersion(state);
  const base = `maps/${map.map_id}`;
  if (version === map.version) return cloudOf(map, `${base}/cloud.ply`);
  if (!state.versions.value) return null;
  const older = state.versions.value.find((one) => one.version === version);
  const path = `${base}/versions/${version}/cloud.ply`;
  return older ? cloudOf(older, path) : { url: path, kind: "ply" };
}

/** Return the tileset of a large cloud that has one, else its PLY, which is loaded whole. */
function cloudOf({ links, counts }: Pick<MapDocument, "links" | "counts">, ply: string): CloudSource {
  const tileset = links.find(({ rel }) => rel === "tileset");
  return tileset && (counts["points"] ?? 0) > MOST_POINTS
    ? { url: tileset.href, kind: "tileset" }
    : { url: ply, kind: "ply" };
}

function surveyOf(state: State): CloudSource | null {
  const focus = focusOf(state);
  if (focus?.status !== "ready") return null;
  const tileset = focus.links.find(({ rel }) => rel === "tileset"); // a survey has one where its cloud is large
  if (tileset) return { url: tileset.href, kind: "tileset" };
  return { url: `surveys/${focus.survey_id}/cloud.ply`, kind: "ply" };
}

/** Return a box around an item, and where it was, with some room. */
function around(box: Box, from?: Box): Box {
  const boxes = from ? [box, from] : [box];
  const edge = (side: "min" | "max", axis: number) =>
    side === "min"
      ? Math.min(...boxes.map(({ min }) => min[axis]!)) - PADDING
      : Math.max(...boxes.map(({ max }) => max[axis]!)) + PADDING;
  return {
    min: [edge("min", 0), edge("min", 1), edge("min", 2)],
    max: [edge("max", 0), edge("max", 1), edge("max", 2)],
  };
}
