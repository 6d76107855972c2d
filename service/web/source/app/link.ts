/** The state of the page as its address has it: `#map=lobby&survey=...&object=...&view=...`. */

import type { View } from "../scene/types.ts";
import { NO_FILTERS, type Filters } from "./filters.ts";

export type Show = "reference" | "survey" | "both" | "split";
export type Tab = "changes" | "survey" | "map";

export interface Place {
  map: string | null;
  survey: string | null; // null: all of them together
  item: string | null; // an object's id, or `tile:` and a tile's
  show: Show | null; // null: as the page thinks best
  view: View | null; // of the camera
  section: [number, number] | null; // metres, map frame; null: the ceiling cut
  tiles: string[]; // states of the tiles that are shown as boxes
  tab: Tab;
  list: "objects" | "tiles";
  filters: Filters;
  embed: boolean; // in a frame of another page: the scene and the timeline alone
}

export const NOWHERE: Place = {
  map: null,
  survey: null,
  item: null,
  show: null,
  view: null,
  section: null,
  tiles: [],
  tab: "changes",
  list: "objects",
  filters: NO_FILTERS,
  embed: false,
};

/** States of the tiles that are boxes where nobody chose: the changed ones, where tiles are listed. */
export const TILES_OF: Readonly<Record<Place["list"], string[]>> = { objects: [], tiles: ["changed"] };

const ID = /^[\w-]{1,64}$/; // of anything, as the API takes it: nothing else becomes part of a path
const SHOWS = ["reference", "survey", "both", "split"];
const TABS = ["changes", "survey", "map"];
const STATES = ["changed", "inconsistent", "unobserved"];

/** Read a fragment, with or without its `#`; what cannot be read counts as left out. */
export function readPlace(fragment: string): Place {
  const said = new URLSearchParams(fragment.replace(/^#/, ""));
  const id = (name: string) => (ID.test(said.get(name) ?? "") ? said.get(name) : null);
  const oneOf = <T extends string>(name: string, known: string[]) =>
    known.includes(said.get(name) ?? "") ? (said.get(name) as T) : null;
  const list = (name: string) => (said.get(name) ?? "").split(",").filter(Boolean);
  const tile = id("tile");
  const listed = said.get("list") === "tiles" ? "tiles" : "objects";
  return {
    map: id("map"),
    survey: id("survey"),
    item: id("object") ?? (tile && `tile:${tile}`),
    show: oneOf<Show>("show", SHOWS),
    view: readView(said.get("view")),
    section: readSection(said.get("section")),
    tiles: said.has("tiles") ? list("tiles").filter((state) => STATES.includes(state)) : TILES_OF[listed],
    tab: oneOf<Tab>("tab", TABS) ?? "changes",
    list: listed,
    filters: {
      kinds: list("kind"),
      statuses: list("status"),
      device: said.get("device") ?? "",
      since: said.get("since") ?? "",
      minScore: share(said.get("min_score")),
      inSection: said.has("in_section"),
    },
    embed: said.has("embed"),
  };
}

/** Write a fragment without its `#`; what is as at the beginning is left out. */
export function writePlace(place: Place): string {
  const { item, filters } = place;
  const tile = item?.startsWith("tile:") ? item.slice(5) : null;
  const words: [string, string | null | undefined][] = [
    ["map", place.map],
    ["survey", place.survey],
    ["object", tile ? null : item],
    ["tile", tile],
    ["show", place.show],
    ["view", place.view && numbers([...place.view.position, ...place.view.target])],
    ["section", place.section && numbers(place.section)],
    ["tab", place.tab === "changes" ? null : place.tab],
    ["list", place.list === "tiles" ? "tiles" : null],
    ["kind", filters.kinds.join(",")],
    ["status", filters.statuses.join(",")],
    ["device", filters.device],
    ["since", filters.since],
    ["min_score", filters.minScore ? String(filters.minScore) : null],
    ["in_section", filters.inSection ? "1" : null],
    ["embed", place.embed ? "1" : null],
  ];
  const said = words.filter(([, value]) => value).map(([name, value]) => `${name}=${plain(value as string)}`);
  if (place.map && place.tiles.join() !== TILES_OF[place.list].join()) said.push(`tiles=${place.tiles.join(",")}`);
  return said.join("&");
}

function plain(value: string): string {
  return encodeURIComponent(value).replaceAll("%2C", ",").replaceAll("%3A", ":");
}

function numbers(values: readonly number[]): string {
  return values.map((value) => String(Math.round(value * 100) / 100)).join(",");
}

function readNumbers(text: string | null, length: number): number[] | null {
  const values = (text ?? "").split(",").map(Number);
  return text && values.length === length && values.every(Number.isFinite) ? values : null;
}

function readView(text: string | null): View | null {
  const values = readNumbers(text, 6);
  if (!values) return null;
  return { position: values.slice(0, 3) as View["position"], target: values.slice(3) as View["target"] };
}

function readSection(text: string | null): [number, number] | null {
  const values = readNumbers(text, 2);
  return values && values[0]! < values[1]! ? [values[0]!, values[1]!] : null;
}

function share(text: string | null): number {
  const value = Number(text);
  return value > 0 && value <= 1 ? value : 0;
}
