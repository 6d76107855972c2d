import assert from "node:assert/strict";
import { test } from "node:test";

import { NOWHERE, readPlace, writePlace, type Place } from "../../../../service/web/source/app/link.ts";

test("an empty fragment is the list of maps", () => {
  assert.deepEqual(readPlace(""), NOWHERE);
  assert.equal(writePlace(NOWHERE), "");
});

test("a place is the same after it was written and read", () => {
  const place: Place = {
    map: "lobby-2",
    survey: "survey-91c4",
    item: "object-7d21",
    show: "split",
    view: { position: [1.25, -4, 7.5], target: [0, 0.01, 1] },
    section: [-0.1, 2.35],
    tiles: ["changed", "unobserved"],
    tab: "survey",
    list: "tiles",
    filters: {
      kinds: ["appeared", "moved"],
      statuses: ["new"],
      device: "robot 7/ä",
      since: "monday",
      minScore: 0.5,
      inSection: true,
    },
    embed: true,
  };
  assert.deepEqual(readPlace(`#${writePlace(place)}`), place);
});

test("a tile is linked by its own name", () => {
  const place = readPlace("#map=lobby&tile=tile_004_002_000");
  assert.equal(place.item, "tile:tile_004_002_000");
  assert.equal(writePlace(place), "map=lobby&tile=tile_004_002_000");
});

test("no tiles at all is not the same as left out", () => {
  assert.deepEqual(readPlace("#map=lobby&list=tiles").tiles, ["changed"]);
  assert.deepEqual(readPlace("#map=lobby&list=tiles&tiles=").tiles, []);
  const none = { ...NOWHERE, map: "lobby", list: "tiles", tiles: [] } as Place;
  assert.equal(writePlace(none), "map=lobby&list=tiles&tiles=");
});

test("changed tiles are no boxes where objects are listed, unless they are asked for", () => {
  assert.deepEqual(readPlace("#map=lobby").tiles, []);
  assert.equal(writePlace({ ...NOWHERE, map: "lobby", tiles: ["changed"] }), "map=lobby&tiles=changed");
});

test("what cannot be read counts as left out", () => {
  const place = readPlace(
    "#map=lobby&show=upside&view=1,2,x&section=3,1&tiles=changed,purple&tab=9&min_score=7",
  );
  assert.deepEqual(place, { ...NOWHERE, map: "lobby", tiles: ["changed"] });
});

test("an id that is none does not become part of a path", () => {
  for (const id of ["../jobs", "a/b", "a?b", "%2e%2e", "x".repeat(65), "a b"]) {
    const place = readPlace(`#map=${encodeURIComponent(id)}&survey=${id}&object=${id}`);
    assert.deepEqual([place.map, place.survey, place.item], [null, null, null]);
  }
});

test("a camera is kept to the centimetre", () => {
  const place = {
    ...NOWHERE,
    map: "lobby",
    view: { position: [1.23456, 2, 3], target: [0, 0, 0] },
  } as Place;
  assert.equal(writePlace(place), "map=lobby&view=1.23,2,3,0,0,0");
});
