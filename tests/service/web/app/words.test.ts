import assert from "node:assert/strict";
import { test } from "node:test";

import type { JobDocument } from "../../../../service/web/source/app/documents.ts";
import {
  coverage,
  isCompared,
  nothingChanged,
  objectsOf,
  progressOf,
  sayingOf,
  statusOf,
  whyStatus,
} from "../../../../service/web/source/app/words.ts";
import { survey } from "./samples.ts";

const QUIET = { tiles: 125, unchanged: 116, changed: 0, inconsistent: 0, unobserved: 9 };
const NONE = { appeared: 0, disappeared: 0, moved: 0 };

test("a quiet survey says in how many judged tiles nothing changed, and how many were not seen", () => {
  const saying = sayingOf(survey({ counts: QUIET, objects: NONE }));
  assert.equal(saying.tone, "quiet");
  assert.equal(saying.long, "Nothing changed in 116 judged tiles; 9 were not seen.");
});

test("a survey of half a map does not say that nothing changed in all of it", () => {
  const saying = sayingOf(survey({ counts: { ...QUIET, unchanged: 60, unobserved: 65 }, objects: NONE }));
  assert.equal(saying.short, "nothing changed in part");
  assert.match(
    saying.more ?? "",
    /52 % of the map was not seen \(65 of 125 tiles\): nothing is said about it/,
  );
});

test("where no tile could be judged nothing is said about change", () => {
  const saying = sayingOf(
    survey({
      counts: { tiles: 10, unchanged: 0, changed: 0, inconsistent: 0, unobserved: 10 },
      objects: NONE,
    }),
  );
  assert.equal(saying.tone, "doubt");
  assert.match(saying.long, /Nothing is said about change/);
  assert.doesNotMatch(saying.long, /^Nothing changed/);
});

test("what was found is counted by kind, and what walked about is not counted", () => {
  const saying = sayingOf(survey({ moving: 2 }));
  assert.equal(saying.long, "3 objects changed: 2 appeared, 1 disappeared.");
  assert.match(saying.more ?? "", /2 things moved during the visit and are not counted/);
});

test("a model that tells tiles alone counts tiles", () => {
  const saying = sayingOf(survey({ objects: null }));
  assert.equal(saying.short, "18 changed");
  assert.match(saying.long, /18 tiles of 125 changed; this model tells tiles and no objects/);
});

test("a survey without a scan that is placed is no quiet one", () => {
  const problem = {
    type: "urn:spicd:problem:registration_failed",
    title: "No scan could be registered",
    detail: "scan a.pcd: ...",
  };
  const saying = sayingOf(
    survey({
      status: "failed",
      placement: { state: "refused", confidence: null },
      problem,
      counts: {},
      objects: null,
    }),
  );
  assert.equal(saying.short, "not registered");
  assert.match(saying.long, /not the same as no change/);
});

test("only a survey that is ready and not in doubt was compared", () => {
  assert.equal(isCompared(survey()), true);
  assert.equal(isCompared(survey({ status: "failed" })), false);
  assert.equal(isCompared(survey({ status: "running", placement: null })), false);
  assert.equal(isCompared(survey({ placement: { state: "in_doubt", confidence: 0.4 } })), false);
});

test("a survey in doubt says nothing about change", () => {
  const saying = sayingOf(survey({ placement: { state: "in_doubt", confidence: 0.42 }, objects: null }));
  assert.equal(saying.tone, "doubt");
  assert.match(saying.long, /confidence 42 %.*nothing is said about change/);
});

test("inconsistent tiles are neither changed nor unchanged", () => {
  assert.equal(
    nothingChanged({ ...QUIET, unchanged: 110, inconsistent: 6 }),
    "Nothing changed in 110 judged tiles; 9 were not seen; 6 are in doubt.",
  );
  assert.match(coverage({ ...QUIET, inconsistent: 6 }), /6 tiles in doubt/);
});

test("a job tells its stage, how far it is, and its place in the queue", () => {
  const job = {
    status: "running",
    message: "registering",
    progress: 40,
    queue_position: null,
  } as JobDocument;
  assert.equal(progressOf(job), "Registering, 40 %");
  assert.equal(progressOf({ ...job, message: "waiting", queue_position: 1 }), "Waiting, next in the queue");
  assert.equal(
    progressOf({ ...job, message: "waiting", queue_position: 4 }),
    "Waiting, number 4 in the queue",
  );
});

test("objects of a map are told by status, those that count now first", () => {
  assert.equal(
    objectsOf({ objects: { new: 2, still_there: 5, gone_again: 1, unknown: 0, accepted: 0 } }),
    "2 new, 5 still changed, 1 as in the map again",
  );
});

test("a status is told in the words of the kind: what disappeared is not still there", () => {
  const looked = "2026-03-04T12:00:00Z";
  assert.equal(statusOf("still_there", "disappeared"), "Still missing");
  assert.match(whyStatus("still_there", "disappeared", looked), /^Wed.*4 Mar.* looked and it was gone$/);
  assert.equal(statusOf("still_there", "moved"), "Still in its new place");
  assert.equal(statusOf("still_there", "appeared"), "Still there");
  assert.equal(statusOf("gone_again", "disappeared"), "Back again");
  for (const kind of ["appeared", "disappeared", "moved"])
    assert.equal(statusOf("unknown", kind), "Not looked at since");
  assert.match(whyStatus("unknown", "moved", looked), /latest survey that could be compared did not$/);
});
