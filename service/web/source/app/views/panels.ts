/** What opens and closes by a button or a key, with the focus where it goes on. */

import type { Controller } from "../controller.ts";
import type { State } from "../state.ts";

/** Whether the filters are to be seen, which are a part of the list. */
export function seesFilters({ filtersOpen, panel, place }: State): boolean {
  return filtersOpen && place.tab === "changes" && panel !== "low" && !place.embed;
}

/** Open the filters and go there, or close them and go back to their button. */
export function openFilters(app: Controller, open: boolean): void {
  const { panel } = app.state;
  app.update({ filtersOpen: open, panel: open && panel === "low" ? "half" : panel });
  if (open) app.go({ tab: "changes" });
  focusOn(open ? "#filters :is(input, select)" : "#filters-button");
}

/** Open the section and go there, or close it and go back to its button. */
export function openSection(app: Controller, open: boolean): void {
  app.update({ sectionOpen: open });
  focusOn(open ? ".section input" : "#section-button");
}

/** Close by Escape what has the focus; the key then does nothing else. */
export function closedByEscape(event: KeyboardEvent, close: () => void): void {
  if (event.key !== "Escape") return;
  event.preventDefault();
  event.stopPropagation();
  close();
}

/** Give the focus to the list, else to what the page is about, where nothing has it. */
export function keepFocus(): void {
  if (document.activeElement !== document.body) return;
  const next = document.getElementById("items") ?? document.getElementById("main");
  next?.focus({ preventScroll: true });
}

/** Give the focus to what a selector names, once the page is drawn. */
function focusOn(selector: string): void {
  queueMicrotask(() => document.querySelector<HTMLElement>(selector)?.focus());
}
