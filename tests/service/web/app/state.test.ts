import assert from "node:assert/strict";
import { test } from "node:test";

import { NO_FILTERS } from "../../../../service/web/source/app/filters.ts";
import { NOWHERE } from "../../../../service/web/source/app/link.ts";
import { firstState, shownTiles, type State } from "../../../../service/web/source/app/state.ts";
import { tile } from "./samples.ts";

const STATES = ["changed", "unobserved"];

function withTiles(change: Partial<State["place"]>): State {
  const place = { ...NOWHERE, map: "lobby", tiles: STATES, ...change };
  const unseen = tile({ tile_id: "unseen", state: "unobserved", score: null, max_score: null });
  return { ...firstState(place, "light", false), tiles: { changed: [tile()], unobserved: [unseen] } };
}

test("the boxes of changed tiles are filtered as the list is; tiles that nobody saw have no kind", () => {
  const states = (change: Partial<State["place"]>) => shownTiles(withTiles(change)).map(({ state }) => state);
  assert.deepEqual(states({}), STATES);
  assert.deepEqual(states({ tiles: ["unobserved"] }), ["unobserved"]);
  assert.deepEqual(states({ filters: { ...NO_FILTERS, kinds: ["moved"] } }), ["unobserved"]);
  assert.deepEqual(states({ filters: { ...NO_FILTERS, since: "2026-03-03" } }), ["unobserved"]);
});

test("the section cuts the boxes of tiles as it cuts the points", () => {
  const [changed] = shownTiles(withTiles({ section: [0.2, 0.5] }));
  assert.deepEqual([changed?.box.min[2], changed?.box.max[2]], [0.2, 0.5]);
  assert.deepEqual(shownTiles(withTiles({ section: [1, 2] })), []);
});

test("the boxes are the same for as long as nothing of them changes", () => {
  const state = withTiles({});
  assert.equal(shownTiles({ ...state, sectionOpen: true }), shownTiles(state));
});
