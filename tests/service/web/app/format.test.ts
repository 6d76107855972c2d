import assert from "node:assert/strict";
import { test } from "node:test";

import {
  ago,
  bytes,
  count,
  extent,
  height,
  heights,
  instant,
  metres,
  ordinal,
  percent,
  whole,
} from "../../../../service/web/source/app/format.ts";

const NOW = new Date("2026-03-05T12:00:00Z");

test("lengths are metres, centimetres and their tenths", () => {
  assert.deepEqual([12.34, 1.26, 0.5, 0.021].map(metres), ["12 m", "1.3 m", "50 cm", "2.1 cm"]);
  assert.equal(height(-0.054), "−0.05 m");
});

test("nearly sure does not read as sure, nor nearly nothing as nothing", () => {
  assert.deepEqual([1, 0.9999, 0.5, 0.004, 0].map(percent), ["100 %", ">99 %", "50 %", "<1 %", "0 %"]);
  assert.equal(percent(null), "not told");
});

test("counts have their noun, whole numbers their thousands", () => {
  assert.equal(count(1, "tile"), "1 tile");
  assert.equal(count(0, "tile"), "0 tiles");
  assert.equal(whole(1243861).replace(/\s/gu, " "), "1 243 861");
  assert.deepEqual([1, 2, 3, 4, 11, 22].map(ordinal), ["1st", "2nd", "3rd", "4th", "11th", "22nd"]);
});

test("sizes of files and of maps", () => {
  assert.deepEqual([999, 1500, 12_400_000, 3e9].map(bytes), ["999 B", "1.5 kB", "12 MB", "3.0 GB"]);
  assert.equal(extent({ min: [0, 0, 0], max: [10.1, 8.06, 2.67] }), "10 × 8.1 m, 2.7 m high");
  assert.equal(extent(null), "");
});

test("instants are told in local time, and how long ago", () => {
  assert.equal(instant("2026-03-02T09:30:00Z", NOW, "UTC"), "Mon 2 Mar, 09:30");
  assert.match(instant("2025-03-02T09:30:00Z", NOW, "UTC"), /2025/);
  assert.deepEqual(
    [
      "2026-03-05T11:59:50Z",
      "2026-03-05T11:20:00Z",
      "2026-03-05T07:00:00Z",
      "2026-03-04T07:00:00Z",
      "2026-02-20T12:00:00Z",
      "2026-03-06T12:00:00Z",
    ].map((text) => ago(text, NOW)),
    ["just now", "40 min ago", "5 h ago", "a day ago", "13 days ago", "in the future"],
  );
});

test("heights of a section are told to the centimetre, and without zeros that say nothing", () => {
  assert.equal(heights([0, 1.0349]), "0 to 1.03 m");
  assert.equal(heights([-0.05, 2.5]), "−0.05 to 2.5 m");
});
