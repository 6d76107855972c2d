/** The page: its head, the list of maps or one map, and what lies over it. */

import { Fragment, h } from "preact";

import type { Controller } from "../controller.ts";
import { shownTheme, type Stage } from "../stage.ts";
import { placeOf, type Notice, type State, type Theme } from "../state.ts";
import { Dialogs } from "./dialogs.tsx";
import { MapPage } from "./map.tsx";
import { MapsPage } from "./maps.tsx";
import { Names } from "./parts.tsx";
import { UploadDialog } from "./upload.tsx";

export interface Props {
  app: Controller;
  stage: Stage;
  state: State;
}

export function Page(props: Props) {
  const { state } = props;
  return (
    <Names.Provider value={namesOf(state)}>
      <div class={`page ${state.place.embed ? "embedded" : ""}`}>
        <a class="skip" href="#main" onClick={(event) => focusMain(event)}>
          Skip to the content
        </a>
        <Head {...props} />
        {state.place.map ? <MapPage {...props} /> : <MapsPage {...props} />}
        <div class="notices" role="status" aria-live="polite">
          {state.notice && <Said app={props.app} notice={state.notice} />}
        </div>
        <UploadDialog {...props} />
        <Dialogs {...props} />
      </div>
    </Names.Provider>
  );
}

/** Return the names of files by the ids of their scans: of those that were looked at, and of those just sent. */
function namesOf({ names, upload }: State): Record<string, string> {
  const sent = upload?.files.filter(({ scan }) => scan).map(({ scan, name }) => [scan, name]) ?? [];
  return { ...names, ...Object.fromEntries(sent) };
}

/** What is said for a while; of a survey with the way to it. */
function Said({ app, notice: { text, tone, to } }: { app: Controller; notice: Notice }) {
  const show = () => {
    app.unsay();
    app.go({ ...(to!.map === app.state.place.map ? {} : placeOf(to!.map)), survey: to!.survey, item: null, tab: "survey" });
  };
  return (
    <div class={`notice ${tone}`}>
      <span>{text}</span>
      {to && (
        <>
          <a href={`#map=${to.map}&survey=${to.survey}&tab=survey`} onClick={(event) => follow(event, show)}>
            Show it
          </a>
          <button class="small" aria-label="Close this message" onClick={() => app.unsay()}>
            ✕
          </button>
        </>
      )}
    </div>
  );
}

function focusMain(event: Event): void {
  event.preventDefault();
  document.getElementById("main")?.focus();
}

const LINES = {
  live: ["Live", "Changes show by themselves"],
  polling: [
    "Live",
    "Changes show by themselves; something in between holds streams back, so the page asks again and again",
  ],
  offline: ["No connection", "The service does not answer; the page tries again by itself"],
} as const;

function Head({ app, state }: Props) {
  const { map, place, line } = state;
  const [word, title] = line ? LINES[line] : ["Connecting", "Asking the service"];
  const name = map.value?.name ?? place.map;
  return (
    <header class="head">
      <nav aria-label="Where you are">
        <a class="brand" href="#" onClick={(event) => follow(event, () => app.open(null))}>
          SPICD
        </a>
        {place.map && (
          <span class="crumb">
            <span aria-hidden="true">/</span> <h1>{name}</h1>
          </span>
        )}
      </nav>
      <span class={`line line-${line ?? "none"}`} role="status" title={title}>
        {word}
      </span>
      <div class="actions">
        {place.map && map.value?.status === "ready" && (
          <button aria-label="Add survey" onClick={() => app.update({ upload: newUpload(place.map) })}>
            Add<span class="wide-only"> survey</span>
          </button>
        )}
        {!place.map && <button onClick={() => app.update({ upload: newUpload(null) })}>New map</button>}
        {place.map && <button onClick={() => share(app)}>Share</button>}
        <ThemeButton app={app} state={state} />
        {state.hasKey && <button onClick={() => app.useKey(null)}>Forget key</button>}
        <button
          aria-label="Keys and help"
          title="Keys and help (?)"
          onClick={() => app.update({ dialog: "help" })}
        >
          ?
        </button>
      </div>
    </header>
  );
}

/** Switches between light and dark; on a small screen a sign says so in the head. */
export function ThemeButton({ app, state, always }: Pick<Props, "app" | "state"> & { always?: boolean }) {
  const word = shownTheme(state) === "dark" ? "Light" : "Dark";
  return (
    <button
      type="button"
      aria-label={word}
      title={themeTitle(state.theme)}
      onClick={() => app.useTheme(nextTheme(state))}
    >
      {!always && (
        <span class="narrow-only" aria-hidden="true">
          ◐
        </span>
      )}
      <span class={always ? "" : "wide-only"}>{word}</span>
    </button>
  );
}

/** Do in the page what a link stands for; a new tab stays a new tab. */
export function follow(event: MouseEvent, act: () => void): void {
  if (event.metaKey || event.ctrlKey || event.shiftKey || event.button) return;
  event.preventDefault();
  act();
}

export function newUpload(map: string | null): State["upload"] {
  return { map, files: [], refused: [], phase: "choosing", problem: null };
}

/** Copy the address of what is shown; where the browser does not let it, show it. */
export async function share(app: Controller): Promise<void> {
  try {
    await navigator.clipboard.writeText(location.href);
    app.tell("The link to this view is copied.");
  } catch {
    app.update({ dialog: "share" });
  }
}

export function nextTheme(state: State): Theme {
  return shownTheme(state) === "dark" ? "light" : "dark";
}

function themeTitle(theme: Theme): string {
  return theme === "system"
    ? "Light or dark as the system has it; press to switch (d)"
    : `Chosen: ${theme} (d switches)`;
}
