import assert from "node:assert/strict";
import { test } from "node:test";

import {
  active,
  beginOf,
  daysOf,
  filtered,
  filterWords,
  NO_FILTERS,
  periodWords,
  setFilters,
  tally,
  toggled,
  wholeDay,
  withHigh,
  withLow,
} from "../../../../service/web/source/app/filters.ts";
import { itemOfObject, itemOfTile } from "../../../../service/web/source/app/items.ts";
import { box, object, tile } from "./samples.ts";

const THURSDAY = new Date(2026, 2, 5, 15, 30); // 5 March 2026, local time

const items = [
  itemOfObject(
    object({
      object_id: "old",
      first_seen: "2026-02-20T12:00:00Z",
      status: "still_there",
      probability: 0.6,
    }),
  ),
  itemOfObject(
    object({
      object_id: "late",
      first_seen: "2026-03-03T12:00:00Z",
      kind: "moved",
      before: box(0, 0),
      device_id: "robot-8",
    }),
  ),
  itemOfObject(
    object({
      object_id: "upstairs",
      first_seen: "2026-03-05T10:00:00Z",
      now: { ...box(2, 2), center: [2, 2, 4.5] },
    }),
  ),
];

function ids(filters: Partial<typeof NO_FILTERS>, section: [number, number] | null = null): string[] {
  return filtered(items, { ...NO_FILTERS, ...filters }, section, THURSDAY).map(({ id }) => id);
}

test("no filter lets everything through", () => {
  assert.deepEqual(ids({}), ["old", "late", "upstairs"]);
});

test("kinds, statuses, device and probability each keep what they name", () => {
  assert.deepEqual(ids({ kinds: ["moved"] }), ["late"]);
  assert.deepEqual(ids({ kinds: ["moved", "appeared"] }), ["old", "late", "upstairs"]);
  assert.deepEqual(ids({ statuses: ["still_there"] }), ["old"]);
  assert.deepEqual(ids({ device: "robot-8" }), ["late"]);
  assert.deepEqual(ids({ minScore: 0.7 }), ["late", "upstairs"]);
});

test("a tile where something appeared and something disappeared is of both kinds", () => {
  const both = [itemOfTile(tile({ appeared: 3, disappeared: 4 }))];
  for (const kind of ["appeared", "disappeared", "both"])
    assert.equal(filtered(both, { ...NO_FILTERS, kinds: [kind] }).length, 1);
  assert.equal(filtered(both, { ...NO_FILTERS, kinds: ["moved"] }).length, 0);
});

test("since Monday is since the night to this week's Monday", () => {
  assert.deepEqual(beginOf("monday", THURSDAY), new Date(2026, 2, 2));
  assert.deepEqual(beginOf("monday", new Date(2026, 2, 2, 8)), new Date(2026, 2, 2));
  assert.deepEqual(beginOf("monday", new Date(2026, 2, 8, 23)), new Date(2026, 2, 2));
  assert.deepEqual(ids({ since: "monday" }), ["late", "upstairs"]);
});

test("periods begin where they say, and one that cannot be read has no beginning", () => {
  assert.deepEqual(beginOf("today", THURSDAY), new Date(2026, 2, 5));
  assert.deepEqual(beginOf("7d", THURSDAY), new Date(THURSDAY.getTime() - 7 * 86_400_000));
  assert.deepEqual(beginOf("2026-03-01", THURSDAY), new Date(2026, 2, 1));
  assert.equal(beginOf("", THURSDAY), null);
  assert.equal(beginOf("yesterday", THURSDAY), null);
});

test("a period is told with its day, and a day of another year with its year", () => {
  assert.equal(periodWords("monday", THURSDAY), "since Mon 2 Mar");
  assert.equal(periodWords("2026-03-03", THURSDAY), "since Tue 3 Mar");
  assert.equal(periodWords("2025-03-03", THURSDAY), "since Mon 3 Mar 2025");
  assert.equal(periodWords("7d", THURSDAY), "last 7 days");
});

test("the days of visits are local, each once, the latest first", () => {
  const visits = ["2026-03-02T10:00:00Z", "2026-03-03T23:30:00Z", "2026-03-04T08:00:00Z"];
  assert.deepEqual(daysOf(visits), ["2026-03-04", "2026-03-02"]);
});

test("what is filtered by is said", () => {
  assert.equal(filterWords(NO_FILTERS), "");
  const filters = { ...NO_FILTERS, kinds: ["moved", "appeared"], since: "monday", minScore: 0.5 };
  assert.equal(
    filterWords({ ...filters, device: "robot-7" }, THURSDAY),
    "moved or appeared, first seen since Mon 2 Mar, device robot-7, at least 50 %",
  );
});

test("each filter that is set says what it lets through, and is taken away alone", () => {
  const filters = { ...NO_FILTERS, kinds: ["moved"], since: "2026-03-03", inSection: true };
  const set = setFilters(filters, THURSDAY);
  assert.deepEqual(
    set.map(({ words }) => words),
    ["moved", "first seen since Tue 3 Mar", "at the heights that are shown"],
  );
  assert.deepEqual({ ...filters, ...set[1]!.without }, { ...filters, since: "" });
  assert.deepEqual(
    set.reduce((rest, { without }) => ({ ...rest, ...without }), filters),
    NO_FILTERS,
  );
});

test("a day that is half typed is none", () => {
  assert.equal(wholeDay("2026-03-04"), "2026-03-04");
  for (const typed of ["", "0202-03-04", "0020-03-04", "2026-03"]) assert.equal(wholeDay(typed), null);
});

test("the second floor is what the section shows", () => {
  assert.deepEqual(ids({ inSection: true }, [3, 6]), ["upstairs"]);
  assert.deepEqual(ids({ inSection: true }, [0, 2.5]), ["old", "late"]);
  assert.deepEqual(ids({ inSection: false }, [3, 6]), ["old", "late", "upstairs"]);
});

test("one end of a section takes the other along where they would cross", () => {
  assert.deepEqual(withLow([0, 2], 1), [1, 2]);
  assert.deepEqual(withLow([0, 2], 3), [3, 3.1]);
  assert.deepEqual(withHigh([0, 2], 1), [0, 1]);
  assert.deepEqual(withHigh([1, 2], 0.5), [0.4, 0.5]);
});

test("filters that are set are counted", () => {
  assert.equal(active(NO_FILTERS), 0);
  assert.equal(active({ ...NO_FILTERS, kinds: ["moved"], since: "today", minScore: 0.5 }), 3);
});

test("a value is toggled, values are tallied in order", () => {
  assert.deepEqual(toggled(["a"], "b"), ["a", "b"]);
  assert.deepEqual(toggled(["a", "b"], "a"), ["b"]);
  assert.deepEqual(tally(["b", null, "a", "b"]), [
    ["a", 1],
    ["b", 2],
  ]);
});
