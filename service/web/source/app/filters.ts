/** Which items the list and the scene show. */

import { deviceWords, percent } from "./format.ts";
import type { Item } from "./items.ts";
import { KINDS, STATUSES } from "./words.ts";

export interface Filters {
  kinds: string[]; // empty: all
  statuses: string[]; // empty: all
  device: string; // empty: all
  since: string; // "", "today", "monday", "7d", "30d", or a day as 2026-03-01
  minScore: number; // 0..1
  inSection: boolean; // only what the section shows
}

export const NO_FILTERS: Filters = {
  kinds: [],
  statuses: [],
  device: "",
  since: "",
  minScore: 0,
  inSection: false,
};

export const PERIODS: readonly (readonly [string, string])[] = [
  ["", "any time"],
  ["today", "today"],
  ["monday", "since Monday"],
  ["7d", "last 7 days"],
  ["30d", "last 30 days"],
];

/** Write a day: `Mon 16 Nov`, with its year where that is not this one. */
export function dayWords(day: Date, now = new Date()): string {
  const year = day.getFullYear() === now.getFullYear() ? undefined : "numeric";
  const words = day.toLocaleDateString("en-GB", { weekday: "short", day: "numeric", month: "short", year });
  return words.replace(",", "");
}

/** Say from when on something was first seen, with its day: `since Mon 16 Nov`. */
export function periodWords(since: string, now = new Date()): string {
  const begin = beginOf(since, now);
  if (begin && (since === "monday" || !PERIODS.some(([value]) => value === since)))
    return `since ${dayWords(begin, now)}`;
  return PERIODS.find(([value]) => value === since)?.[1] ?? "any time";
}

/** Return the days of instants in local time as filters have them, each once, the latest first. */
export function daysOf(instants: readonly string[]): string[] {
  const days = instants.map((text) => {
    const at = new Date(text);
    return [at.getFullYear(), at.getMonth() + 1, at.getDate()]
      .map((part) => String(part).padStart(2, "0"))
      .join("-");
  });
  return [...new Set(days)].sort().reverse();
}

/** One thing that is filtered by: in words, and what takes it away again. */
export interface SetFilter {
  words: string;
  without: Partial<Filters>;
}

/** Return what is filtered by, each with its words: `first seen since Mon 16 Nov`. */
export function setFilters(filters: Filters, now = new Date()): SetFilter[] {
  const { kinds, statuses, device, since, minScore, inSection } = filters;
  const named = (values: string[], words: Record<string, string>) =>
    values.map((value) => (words[value] ?? value).toLowerCase()).join(" or ");
  const period = beginOf(since, now) ? periodWords(since, now) : "at any time";
  const all: SetFilter[] = [
    { words: named(kinds, KINDS), without: { kinds: [] } },
    { words: named(statuses, STATUSES), without: { statuses: [] } },
    { words: since && `first seen ${period}`, without: { since: "" } },
    { words: device && deviceWords(device), without: { device: "" } },
    { words: minScore > 0 ? `at least ${percent(minScore)}` : "", without: { minScore: 0 } },
    { words: inSection ? "at the heights that are shown" : "", without: { inSection: false } },
  ];
  return all.filter(({ words }) => words);
}

/** Say what is filtered by, for people: `moved, first seen since Mon 16 Nov`; empty where nothing is. */
export function filterWords(filters: Filters, now = new Date()): string {
  return setFilters(filters, now)
    .map(({ words }) => words)
    .join(", ");
}

/** Return the instant at which a period begins, in local time; null where it has no beginning. */
export function beginOf(since: string, now = new Date()): Date | null {
  const day = new Date(now.getFullYear(), now.getMonth(), now.getDate());
  if (since === "today") return day;
  if (since === "monday") return daysBefore(day, (day.getDay() + 6) % 7);
  const days = /^(\d{1,4})d$/.exec(since);
  if (days) return new Date(now.getTime() - Number(days[1]) * 86_400_000);
  const date = /^(\d{4})-(\d\d)-(\d\d)$/.exec(since);
  return date ? new Date(Number(date[1]), Number(date[2]) - 1, Number(date[3])) : null;
}

/** Return the day that a date field holds once it is typed to its end, from 1900 on; null before that. */
export function wholeDay(typed: string): string | null {
  const day = /^(\d{4})-\d\d-\d\d$/.exec(typed);
  return day && Number(day[1]) >= 1900 ? typed : null;
}

function daysBefore(day: Date, days: number): Date {
  return new Date(day.getFullYear(), day.getMonth(), day.getDate() - days);
}

/** Return the items that the filters let through; `section` is what the scene shows, metres above and below. */
export function filtered(
  items: readonly Item[],
  filters: Filters,
  section: readonly [number, number] | null = null,
  now = new Date(),
): Item[] {
  const begin = beginOf(filters.since, now);
  return items.filter(
    (item) =>
      (!filters.kinds.length || filters.kinds.some((kind) => isKind(item, kind))) &&
      (!filters.statuses.length || item.status === null || filters.statuses.includes(item.status)) &&
      (!filters.device || item.device === filters.device) &&
      (!begin || new Date(item.firstSeen) >= begin) &&
      item.probability >= filters.minScore &&
      (!filters.inSection || !section || (item.box.max[2] > section[0] && item.box.min[2] < section[1])),
  );
}

const LEAST_SECTION = 0.1; // metres

/** Return a section from another height; its end goes along where it would be lower. Metres, map frame. */
export function withLow([, high]: readonly [number, number], low: number): [number, number] {
  return [low, Math.max(high, low + LEAST_SECTION)];
}

/** Return a section to another height; its beginning goes along where it would be higher. Metres, map frame. */
export function withHigh([low]: readonly [number, number], high: number): [number, number] {
  return [Math.min(low, high - LEAST_SECTION), high];
}

/** Tell whether an item is of a kind; a tile where things appeared and disappeared is of both. */
function isKind({ kind }: Item, wanted: string): boolean {
  return kind === wanted || (kind === "both" && (wanted === "appeared" || wanted === "disappeared"));
}

/** Count how many filters are set. */
export function active(filters: Filters): number {
  return setFilters(filters).length;
}

/** Return `chosen` with a value added, or without it where it was there. */
export function toggled(chosen: readonly string[], value: string): string[] {
  return chosen.includes(value) ? chosen.filter((one) => one !== value) : [...chosen, value];
}

/** Return the different values in a stable order, with how often each comes. */
export function tally(values: readonly (string | null)[]): [string, number][] {
  const counts = new Map<string, number>();
  for (const value of values) if (value) counts.set(value, (counts.get(value) ?? 0) + 1);
  return [...counts].sort(([one], [other]) => (one < other ? -1 : 1));
}
