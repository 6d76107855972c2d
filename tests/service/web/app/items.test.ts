import assert from "node:assert/strict";
import { test } from "node:test";

import {
  boxOf,
  itemOfObject,
  itemOfSighting,
  itemOfTile,
  joinSides,
  kindOfTile,
  markOf,
  tileMarkOf,
  whereOf,
} from "../../../../service/web/source/app/items.ts";
import { box, object, sighting, tile } from "./samples.ts";

test("the box of a place goes around its outline, from floor to top", () => {
  const { min, max } = boxOf(box(2, 3, 1));
  assert.deepEqual({ min, max }, { min: [1.5, 2.5, 0], max: [2.5, 3.5, 1] });
});

test("what stands at an angle keeps it", () => {
  const { turned } = boxOf({ ...box(2, 3, 1), yaw_degrees: 90 });
  assert.deepEqual(turned, { centre: [2, 3, 0.5], size: box(2, 3, 1).size, yaw: Math.PI / 2 });
});

test("an object has its status and its history, and is where its latest sighting saw it", () => {
  const item = itemOfObject(object({ status: "still_there", last_seen: "2026-03-05T00:00:00Z" }));
  assert.equal(item.id, "object-1");
  assert.equal(item.status, "still_there");
  assert.equal(item.firstSeen, "2026-03-02T12:00:00Z");
  assert.equal(item.lastSeen, "2026-03-05T00:00:00Z");
  assert.equal(item.title, "1.0 × 1.0 × 1.0 m");
  assert.equal(whereOf(item), "at 2.0, 3.0, on the floor");
});

test("what moved is marked where it is and where it was; what is gone again is muted", () => {
  const moved = markOf(itemOfSighting(sighting({ kind: "moved", now: box(5, 5), before: box(2, 3) })));
  assert.deepEqual(moved.box, boxOf(box(5, 5)));
  assert.deepEqual(moved.from, boxOf(box(2, 3)));
  assert.equal(moved.muted, undefined);
  assert.equal(markOf(itemOfObject(object({ status: "gone_again" }))).muted, true);
});

test("two places that a survey told of one object are one item, which moved", () => {
  const here = itemOfSighting(sighting({ now: box(5, 5), before: null }));
  const gone = itemOfSighting(sighting({ kind: "disappeared", now: null, before: box(2, 3) }));
  const another = itemOfSighting(sighting({ object_id: "object-2" }));
  for (const told of [
    [here, another, gone],
    [gone, another, here],
  ]) {
    const [item, ...others] = joinSides(told);
    assert.deepEqual(item, { ...here, kind: "moved", from: boxOf(box(2, 3)) });
    assert.deepEqual(others, [another]);
  }
});

test("what disappeared is where it was", () => {
  const item = itemOfSighting(sighting({ kind: "disappeared", now: null, before: box(7, 8) }));
  assert.deepEqual(item.box, boxOf(box(7, 8)));
  assert.equal(item.from, undefined);
});

test("a tile has the corners of its place, and the kind of its voxels", () => {
  const item = itemOfTile(tile());
  assert.deepEqual(item.box, { min: [0, 1.5, -0.1], max: [1.5, 3, 0.9] });
  assert.equal(item.id, "tile:tile_000_001_000");
  assert.equal(item.probability, 0.97);
  assert.deepEqual(tileMarkOf(tile()), { id: item.id, box: item.box, state: "changed", score: 0.93 });
  const kinds = [
    { appeared: 3, disappeared: 0 },
    { appeared: 0, disappeared: 4 },
    { appeared: 1, disappeared: 1 },
    { appeared: null, disappeared: null },
  ];
  assert.deepEqual(
    kinds.map((known) => kindOfTile(tile(known).properties)),
    ["appeared", "disappeared", "both", "changed"],
  );
});
