import assert from "node:assert/strict";
import { test } from "node:test";

import {
  adviceOn,
  plainOf,
  scansIn,
  sentenceOf,
  withNames,
} from "../../../../service/web/source/app/problems.ts";

const REFUSED =
  "no scan could be registered to the map: scan hall 1.ply: 73.7% lie on each other (inlier ratio), at least 85% is " +
  "needed; give an initial pose [no_fit]; scan hall 2.ply: nothing [no_fit]; scan stairs.e57: its mirror fits [mirrored]";

function problem(code: string, detail = "", status?: number) {
  return { type: `urn:spicd:problem:${code}`, title: code, detail, ...(status ? { status } : {}) };
}

test("problems come with what to do", () => {
  assert.match(adviceOn(problem("disk_full")), /Delete surveys/);
  assert.equal(adviceOn(problem("conflict", "", 409)), "");
  assert.equal(adviceOn(problem("who_knows", "", 503)), "Try again in a moment.");
});

test("what experts say is said plainly, with the files that each reason is for", () => {
  assert.deepEqual(plainOf(problem("registration_failed", REFUSED)), [
    "None of the scans could be placed.",
    "Lies nowhere on the map: hall 1.ply, hall 2.ply.",
    "Its mirror image fits: stairs.e57.",
  ]);
  assert.doesNotMatch(sentenceOf(problem("registration_failed", REFUSED)), /inlier|%/);
});

test("a detail without a reason is not taken apart, and a plain one stays as it is", () => {
  assert.deepEqual(plainOf(problem("map_failed", "no tile holds 30 points [of 4]")), ["The scans do not make a map."]);
  assert.equal(plainOf(problem("conflict", "the id 'lobby' is taken")), null);
  assert.equal(sentenceOf(problem("conflict", "the id 'lobby' is taken")), "the id 'lobby' is taken");
});

test("the name of a file stands in place of the id of its scan, where it is known", () => {
  const [one, other] = [`scan-${"a1".repeat(16)}`, `scan-${"b2".repeat(16)}`];
  const text = `scan '${one}' and scan '${other}' are in version 1`;
  assert.deepEqual(scansIn(text), [one, other]);
  assert.deepEqual(scansIn("no scan"), []);
  assert.equal(withNames(text, { [one]: "hall.ply" }), `scan 'hall.ply' and scan '${other}' are in version 1`);
});
