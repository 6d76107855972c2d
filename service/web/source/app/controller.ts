/** Holds the state, changes it, and keeps the address of the page the same as what is shown. */

import { Api, ApiError, problemOf } from "./api.ts";
import type { CloudEvent, Counts } from "./documents.ts";
import { follow, type Line } from "./follow.ts";
import { count, instant } from "./format.ts";
import { NOWHERE, readPlace, TILES_OF, writePlace, type Place, type Show } from "./link.ts";
import * as loads from "./loads.ts";
import { scansIn, sentenceOf, withNames } from "./problems.ts";
import {
  firstState,
  isOpen,
  nothingOfAMap,
  type Loaded,
  type Notice,
  type Question,
  type State,
  type Theme,
} from "./state.ts";
import { kinds } from "./words.ts";

const KEY = "spicd-key"; // in sessionStorage: it goes with the tab
const THEME = "spicd-theme"; // in localStorage
const JOBS_BUSY_MS = 1500;
const JOBS_IDLE_MS = 15_000;
const SETTLE_MS = 300; // events come in bunches
const SAID_MS = { plain: 5000, bad: 12_000, link: 30_000 }; // for so long a notice stays

export class Controller {
  state: State;
  readonly api: Api;
  readonly #render: (state: State) => void;
  #planned = false;
  #showBefore: Show | null = null; // which clouds were chosen when the first object of a row was opened
  #followed: AbortController | null = null;
  #refresh: ReturnType<typeof setTimeout> | undefined;
  #jobs: ReturnType<typeof setTimeout> | undefined;
  #notice: ReturnType<typeof setTimeout> | undefined;

  constructor(api: Api, render: (state: State) => void) {
    this.api = api;
    this.api.key = sessionStorage.getItem(KEY);
    this.#render = render;
    const theme = localStorage.getItem(THEME) as Theme | null;
    this.state = firstState(readPlace(location.hash), theme ?? "system", this.api.key !== null);
    api.onUnauthorized = (problem) => this.update({ asksKey: problem, dialog: "key" });
  }

  /** Show what the address says, and go on doing so. */
  start(): void {
    addEventListener("hashchange", () => this.#arrive(readPlace(location.hash)));
    addEventListener("popstate", () => this.#arrive(readPlace(location.hash)));
    document.addEventListener("visibilitychange", () => this.#watchJobs(0));
    this.#begin();
  }

  /** Change the state; it is drawn once for all changes of one turn. */
  update(change: Partial<State>): void {
    this.state = { ...this.state, ...change };
    if (this.#planned) return;
    this.#planned = true;
    queueMicrotask(() => {
      this.#planned = false;
      this.#render(this.state);
    });
  }

  /** Go elsewhere in the page; the browser's way back leads over maps, surveys and the first object of a row. */
  go(change: Partial<Place>): void {
    const before = this.state.place;
    const place = { ...before, ...change };
    if (!change.tiles && before.tiles.join() === TILES_OF[before.list].join()) place.tiles = TILES_OF[place.list];
    if (before.item === null && place.item !== null) this.#showBefore = before.show;
    else if (before.item !== null && place.item === null && change.show === undefined)
      place.show = this.#showBefore;
    const address = `#${writePlace(place)}`;
    if (!isStep(before, place)) history.replaceState(null, "", address);
    else history.pushState(null, "", address);
    this.#arrive(place);
  }

  /** Go to a map, or to the list of maps. */
  open(map: string | null): void {
    this.go({ ...NOWHERE, map, embed: this.state.place.embed });
  }

  #arrive(place: Place): void {
    const before = this.state.place;
    if (writePlace(before) === writePlace(place)) return;
    this.update({ place });
    if (place.map !== before.map) {
      this.#showBefore = null;
      this.update(nothingOfAMap());
      this.#begin();
    } else if (place.map) {
      loads.follow(this, before);
    }
  }

  /** Ask for all that the place shows, and follow what happens to it. */
  #begin(): void {
    const { map } = this.state.place;
    if (map) void loads.map(this);
    else void loads.maps(this);
    this.#watchJobs(0);
    this.#followed?.abort();
    this.#followed = new AbortController();
    const follower = {
      onEvents: (events: CloudEvent[]) => this.#happened(events),
      onLine: (line: Line) => this.#onLine(line),
      onGap: () => this.#again(),
    };
    void follow(this.api, follower, this.#followed.signal);
  }

  #onLine(line: Line): void {
    if (line === this.state.line) return;
    if (this.state.line === "offline") this.#again(); // what was missed meanwhile, jobs above all
    this.update({ line });
  }

  /** Say that the service does not answer; the next event, or sign of life, says that it does. */
  unreachable(): void {
    this.#onLine("offline");
  }

  #happened(events: CloudEvent[]): void {
    const { map } = this.state.place;
    if (map && !events.some(({ data }) => data.map_id === map)) return;
    if (map && events.some(({ type, subject }) => type === "map.deleted" && subject === map)) {
      this.tell("This map was deleted.", "bad");
    }
    for (const { type, data } of events) {
      if (type === "survey.ready" || type === "survey.failed") this.#ended(type, data);
      if (type === "version.ready" && map)
        this.tell(`Version ${String(data["version"])} of the map is ready.`);
    }
    clearTimeout(this.#refresh);
    this.#refresh = setTimeout(() => this.#again(), SETTLE_MS);
  }

  /** Say that a comparison has ended, with the way to its survey. */
  #ended(type: string, data: CloudEvent["data"]): void {
    const { map_id: map, survey_id: survey } = data;
    const which = this.state.place.map ? "The" : `${nameOf(this.state, map)}: the`;
    const what = `${which} survey of ${instant(String(data["captured_at"]))}`;
    const to = map && survey ? { map, survey } : null;
    if (type === "survey.ready") this.tell(`${what} is compared${foundBy(data)}.`, "plain", to);
    else this.tell(`${what} could not be compared.`, "bad", to);
  }

  #again(): void {
    if (this.state.place.map) void loads.map(this);
    else void loads.maps(this);
    this.#watchJobs(0);
  }

  /** Ask for the jobs now and then: soon again while one is open, seldom else, and not while nobody looks. */
  #watchJobs(after: number): void {
    clearTimeout(this.#jobs);
    if (document.hidden) return;
    this.#jobs = setTimeout(() => {
      void loads
        .jobs(this)
        .then(() => this.#watchJobs(this.state.jobs.some(isOpen) ? JOBS_BUSY_MS : JOBS_IDLE_MS));
    }, after);
  }

  /** Look at the jobs at once, for one was made, stopped or run again. */
  jobsChanged(): void {
    this.#watchJobs(0);
    if (this.state.place.map) void loads.map(this);
    else void loads.maps(this);
  }

  /** Ask for something and keep it under its name; what was there stays meanwhile, and where it fails. */
  async load<Name extends LoadedName>(name: Name, ask: () => Promise<ValueOf<Name>>): Promise<void> {
    const before = this.state[name] as Loaded<unknown>;
    this.update({ [name]: { ...before, busy: true } } as Partial<State>);
    const { map } = this.state.place;
    const turn = (this.#turns[name] = (this.#turns[name] ?? 0) + 1);
    let loaded: Loaded<unknown>;
    try {
      loaded = { value: await ask(), problem: null, busy: false };
    } catch (error) {
      const gone = error instanceof ApiError && (error.code === "not_found" || error.code === "forbidden");
      loaded = { value: gone ? null : before.value, problem: problemOf(error), busy: false };
    }
    if (map === this.state.place.map && turn === this.#turns[name])
      this.update({ [name]: loaded } as Partial<State>);
  }
  #turns: Record<string, number> = {};

  /** Do something of the API, and tell what it refuses. */
  async attempt(act: () => Promise<void>): Promise<void> {
    try {
      await act();
    } catch (error) {
      const said = sentenceOf(problemOf(error));
      await loads.names(this, scansIn(said));
      this.tell(withNames(said, this.state.names), "bad");
    }
  }

  ask(question: Question): void {
    this.update({ question });
  }

  /** Say something for a while, also to who does not see the page. */
  tell(text: string, tone: Notice["tone"] = "plain", to: Notice["to"] = null): void {
    clearTimeout(this.#notice);
    this.update({ notice: { text, tone, to } });
    this.#notice = setTimeout(() => this.unsay(), to ? SAID_MS.link : SAID_MS[tone]);
  }

  /** Take away what was said last. */
  unsay(): void {
    this.update({ notice: null });
  }

  /** Take a key, or forget it, and ask for everything again. */
  useKey(key: string | null): void {
    if (key) sessionStorage.setItem(KEY, key);
    else sessionStorage.removeItem(KEY);
    this.api.key = key;
    this.update({ hasKey: key !== null, asksKey: null, dialog: null, ...nothingOfAMap() });
    this.#begin();
  }

  useTheme(theme: Theme): void {
    localStorage.setItem(THEME, theme);
    this.update({ theme });
  }
}

/** Say in short what an event tells that a survey found; a survey in doubt tells no objects. */
function foundBy({ objects, counts }: CloudEvent["data"]): string {
  if (objects) return `: ${kinds(objects as Counts) || "no object changed"}`;
  const { changed = 0 } = (counts ?? {}) as Counts;
  return changed ? `: ${count(changed, "changed tile")}` : "";
}

function nameOf({ maps }: State, id: string | undefined): string {
  return maps.value?.find(({ map_id }) => map_id === id)?.name ?? id ?? "a map";
}

function isStep(from: Place, to: Place): boolean {
  return from.map !== to.map || from.survey !== to.survey || (from.item === null && to.item !== null);
}

type LoadedName = { [Name in keyof State]: State[Name] extends Loaded<infer _> ? Name : never }[keyof State];
type ValueOf<Name extends LoadedName> = State[Name] extends Loaded<infer Value> ? Value : never;
