/** The keyboard: what each key does, where no field and no dialog has it. */

import type { Controller } from "./controller.ts";
import type { Stage } from "./stage.ts";
import { sectionOf, shownItems } from "./state.ts";
import { newUpload, nextTheme, share } from "./views/page.tsx";
import { rowId } from "./views/changes.tsx";
import { openFilters, openSection, seesFilters } from "./views/panels.ts";
import { neighbour } from "./views/timeline.tsx";

export const KEYS: readonly (readonly [string, string])[] = [
  ["j ↓", "next in the list"],
  ["k ↑", "the one before"],
  ["Enter", "look at it again"],
  ["Esc", "close the details, then the survey"],
  ["[ ]", "survey before, survey after"],
  ["1 2 3 4", "reference, survey, both, split"],
  ["t", "look from above"],
  ["/", "filters: open and close"],
  ["x", "section, which cuts by height: open and close"],
  ["c", "cut the ceiling, or not"],
  ["u", "add a survey, or a map in the list of maps"],
  ["s", "copy a link to this view"],
  ["g", "list of maps"],
  ["d", "light or dark"],
  ["?", "these keys"],
];

/** Do what a key stands for. Returns whether it stands for something. */
export function act(key: string, app: Controller, stage: Stage): boolean {
  const { state } = app;
  const always: Record<string, () => void> = {
    "?": () => app.update({ dialog: "help" }),
    d: () => app.useTheme(nextTheme(state)),
    g: () => app.open(null),
    u: () => app.update({ upload: newUpload(state.place.map) }),
  };
  const ofMap: Record<string, () => void> = {
    j: () => step(app, 1),
    ArrowDown: () => step(app, 1),
    k: () => step(app, -1),
    ArrowUp: () => step(app, -1),
    Enter: () => stage.lookAtItem(),
    f: () => stage.lookAtItem(),
    Escape: () => back(app),
    "[": () => app.go({ survey: neighbour(state, -1), item: null }),
    "]": () => app.go({ survey: neighbour(state, 1), item: null }),
    "1": () => app.go({ show: "reference" }),
    "2": () => app.go({ show: "survey" }),
    "3": () => app.go({ show: "both" }),
    "4": () => app.go({ show: "split" }),
    t: () => stage.topDown(),
    "/": () => openFilters(app, !seesFilters(state)),
    x: () => openSection(app, !state.sectionOpen),
    c: () => cutCeiling(app),
    s: () => void share(app),
  };
  const found = (state.place.map ? ofMap[key] : undefined) ?? always[key];
  found?.();
  return found !== undefined;
}

/** Listen to the keys of the page. Keys that a field, a control or a dialog needs itself are left to it. */
export function listen(app: Controller, stage: Stage): void {
  addEventListener("keydown", (event) => {
    if (event.ctrlKey || event.metaKey || event.altKey || event.defaultPrevented) return;
    const target = event.target as HTMLElement;
    if (target.closest("dialog, input:not([type=checkbox], [type=range]), select, textarea")) return;
    if (target.matches("[type=range]") && event.key.length > 1) return; // arrows move it
    const isControl = target.closest("button, a, input, summary") !== null;
    if (isControl && (event.key === "Enter" || event.key === " ")) return;
    if (
      event.key.startsWith("Arrow") &&
      target !== document.body &&
      !target.closest("#items, #main, .details")
    )
      return;
    if (act(event.key, app, stage)) event.preventDefault();
  });
}

/** Choose the next or the one before in the list. */
function step(app: Controller, by: 1 | -1): void {
  const items = shownItems(app.state);
  const at = items.findIndex(({ id }) => id === app.state.place.item);
  const next = items[at < 0 ? (by > 0 ? 0 : items.length - 1) : at + by];
  if (!next) return;
  app.go({ item: next.id, view: null, tab: "changes" });
  queueMicrotask(() => document.getElementById(rowId(next.id))?.scrollIntoView({ block: "nearest" }));
}

function back(app: Controller): void {
  const { item, survey } = app.state.place;
  if (item) app.go({ item: null });
  else if (survey) app.go({ survey: null });
}

function cutCeiling(app: Controller): void {
  const { place, stage } = app.state;
  const { extent } = stage;
  if (!extent || !sectionOf(app.state)) return;
  app.go({ section: place.section === null ? [extent.min[2], extent.max[2]] : null });
}
