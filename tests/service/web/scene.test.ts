// Run by test_scene.py with Node's own test runner; FILES names a folder with files that the service's exporter wrote.

import assert from "node:assert/strict";
import { readFileSync } from "node:fs";
import { join } from "node:path";
import { test } from "node:test";

import { around, edgesOf, entryOf, holds, solidOf } from "../../../service/web/source/scene/boxes.ts";
import { KIND_COLOURS, STATE_COLOURS } from "../../../service/web/source/scene/colours.ts";
import { readGlb } from "../../../service/web/source/scene/glb.ts";
import { boundsOf, levelsOf } from "../../../service/web/source/scene/heights.ts";
import { Pace } from "../../../service/web/source/scene/pace.ts";
import { readPly } from "../../../service/web/source/scene/ply.ts";
import { FAINT, GONE, MARKED, OWN, RAMP, cloudOf, spacingOf, spread, tintsOfBytes } from "../../../service/web/source/scene/points.ts";

const FILES = process.env["FILES"] ?? "";
const EXPECTED = JSON.parse(readFileSync(join(FILES, "expected.json"), "utf8"));

function bytesOf(name: string): ArrayBuffer {
  return new Uint8Array(readFileSync(join(FILES, name))).buffer;
}

/** A room of 6 x 4 x 2.5 m with points 5 cm apart on floor, ceiling and walls, and a table. */
function room(ceiling = true): Float32Array {
  const points: number[] = [];
  for (let x = 0; x <= 6; x += 0.05) for (let y = 0; y <= 4; y += 0.05) points.push(x, y, 0, ...(ceiling ? [x, y, 2.5] : []));
  for (let z = 0; z <= 2.5; z += 0.05) for (let x = 0; x <= 6; x += 0.05) points.push(x, 0, z, x, 4, z);
  for (let x = 2; x <= 3; x += 0.05) for (let y = 1; y <= 2; y += 0.05) points.push(x, y, 0.75);
  return new Float32Array(points);
}

test("the map's cloud is read as the exporter wrote it", () => {
  const cloud = readPly(bytesOf("map.ply"));
  assert.equal(cloud.n, EXPECTED.map.n);
  assert.deepEqual([...cloud.positions.slice(0, 6)], EXPECTED.map.first);
  assert.equal(cloud.colours, null);
});

test("colours of a map are its own", () => {
  const { present } = cloudOf(readPly(bytesOf("coloured.ply")));
  assert.equal(present.n, EXPECTED.map.n);
  assert.deepEqual([...(present.tints ?? []).slice(0, 4)], [10, 20, 30, OWN]);
});

test("a survey's points are told apart by their kind, and what was lost is not among those that are there", () => {
  const { present, lost } = cloudOf(readPly(bytesOf("survey.ply")));
  assert.equal(present.n + (lost?.n ?? 0), EXPECTED.survey.n);
  assert.equal(lost?.n, EXPECTED.survey.lost);
  const alphas = new Map<number, number>();
  for (let i = 3; i < (present.tints ?? []).length; i += 4) {
    const alpha = (present.tints ?? [])[i] as number;
    alphas.set(alpha, (alphas.get(alpha) ?? 0) + 1);
  }
  assert.deepEqual(Object.fromEntries(alphas), { [RAMP]: EXPECTED.survey.unchanged, [MARKED]: EXPECTED.survey.appeared, [FAINT]: EXPECTED.survey.unjudged, [OWN]: EXPECTED.survey.moving });
});

test("a survey that a detector of tiles made is painted by their states", () => {
  const { present } = cloudOf(readPly(bytesOf("tiles.ply")));
  const seen = new Set<string>();
  for (let i = 0; i < present.n; i++) {
    const [r, g, b, alpha] = (present.tints ?? []).slice(4 * i, 4 * i + 4) as unknown as [number, number, number, number];
    if (alpha === MARKED) seen.add(`#${[r, g, b].map((byte) => byte.toString(16).padStart(2, "0")).join("")}`);
  }
  assert.deepEqual([...seen], [STATE_COLOURS["changed"]]);
});

test("a file that ends early, is text or is no PLY at all is refused with a sentence", () => {
  const whole = bytesOf("map.ply");
  assert.throws(() => readPly(whole.slice(0, whole.byteLength - 1)), /ends after \d+ bytes, and its header promises/);
  const text = new TextEncoder().encode("ply\nformat ascii 1.0\nelement vertex 1\nproperty float x\nend_header\n0\n");
  assert.throws(() => readPly(text.buffer), /no binary little endian PLY/);
  assert.throws(() => readPly(new TextEncoder().encode('{"type": "problem"}').buffer), /no PLY file/);
  const lists = "ply\nformat binary_little_endian 1.0\nelement vertex 1\nproperty list uchar int x\nend_header\n";
  assert.throws(() => readPly(new TextEncoder().encode(lists).buffer), /of the type list/);
});

test("points in doubles are read too", () => {
  const header = "ply\nformat binary_little_endian 1.0\nelement vertex 1\nproperty double x\nproperty double y\nproperty double z\nend_header\n";
  const file = new Uint8Array(header.length + 24);
  file.set(new TextEncoder().encode(header));
  [1.5, -2.25, 3].forEach((value, i) => new DataView(file.buffer).setFloat64(header.length + 8 * i, value, true));
  assert.deepEqual([...readPly(file.buffer).positions], [1.5, -2.25, 3]);
});

test("a cloud without points, and one of points that are no numbers, is refused", () => {
  const none = { n: 0, positions: new Float32Array(), colours: null, kinds: null, states: null };
  assert.throws(() => cloudOf(none), /no points/);
  assert.throws(() => cloudOf({ ...none, n: 1, positions: new Float32Array([NaN, NaN, NaN]) }), /no points/);
});

test("the cut lies just under the ceiling of a room, and the floor is found", () => {
  const positions = room();
  const { floor, ceiling } = levelsOf(positions, boundsOf(positions)!);
  assert.ok(Math.abs(floor) < 0.06, `floor ${floor}`);
  assert.ok(ceiling !== null && ceiling > 2.2 && ceiling < 2.46, `ceiling ${ceiling}`);
});

test("a place without a ceiling has none to cut", () => {
  const positions = room(false);
  assert.equal(levelsOf(positions, boundsOf(positions)!).ceiling, null);
});

test("of two storeys the upper ceiling is cut", () => {
  const lower = room();
  const both = new Float32Array(2 * lower.length);
  both.set(lower);
  both.set(lower.map((value, i) => (i % 3 === 2 ? value + 3 : value)), lower.length);
  const { ceiling } = levelsOf(both, boundsOf(both)!);
  assert.ok(ceiling !== null && ceiling > 5.2 && ceiling < 5.46, `ceiling ${ceiling}`);
});

test("the spacing of points is about what it is", () => {
  const positions = room();
  const spacing = spacingOf(positions, boundsOf(positions)!);
  assert.ok(spacing > 0.035 && spacing < 0.07, `spacing ${spacing}`);
});

test("each beginning of the order of drawing is spread over all points, and none is drawn twice", () => {
  for (const n of [0, 1, 2, 7, 1000, 99_991]) {
    const rows = spread(n);
    assert.equal(new Set(rows).size, n);
    const tenths = new Set([...rows.slice(0, Math.floor(n / 10))].map((row) => Math.floor((10 * row) / n)));
    if (n >= 1000) assert.equal(tenths.size, 10);
  }
});

test("a survey's tiles of colours alone are told apart by these, also after they were linear bytes", () => {
  const colours = new Uint8Array([150, 150, 150, 215, 215, 215, 213, 94, 0, 1, 114, 178, 12, 200, 30]);
  const alphas = (layer: "reference" | "survey") => [3, 7, 11, 15, 19].map((at) => tintsOfBytes(colours, layer)[at]);
  assert.deepEqual(alphas("survey"), [RAMP, FAINT, MARKED, GONE, OWN]);
  assert.deepEqual(alphas("reference"), [OWN, OWN, OWN, OWN, OWN]);
});

test("quantised points of a tile are placed by the matrix of their node", () => {
  const { n, positions, colours } = readGlb(bytesOf("tile.glb"));
  assert.equal(n, 2);
  EXPECTED.glb.positions.forEach((value: number, i: number) => assert.ok(Math.abs(value - (positions[i] as number)) < 1e-4));
  assert.deepEqual([...(colours ?? [])], EXPECTED.glb.colours);
});

test("what is no tile of points is refused", () => {
  assert.throws(() => readGlb(new TextEncoder().encode("<html>no tile, but a page of a proxy</html>").buffer), /no GLB/);
  assert.throws(() => readGlb(new ArrayBuffer(4)), /no GLB/);
});

test("a box at an angle holds what is in it and is met where it stands", () => {
  const turned = { centre: [0, 0, 0.5] as [number, number, number], size: [2, 0.2, 1] as [number, number, number], yaw: Math.PI / 4 };
  const solid = solidOf({ min: [-0.8, -0.8, 0], max: [0.8, 0.8, 1], turned });
  assert.ok(holds(solid, 0.6, 0.6, 0.5));
  assert.ok(!holds(solid, 0.6, -0.6, 0.5)); // in the upright box around it alone
  assert.equal(entryOf(solid, [0.6, -0.6, 5], [0, 0, -1]), null);
  assert.ok(Math.abs((entryOf(solid, [0.6, 0.6, 5], [0, 0, -1]) ?? 0) - 4) < 1e-9);
  assert.equal(entryOf(solid, [0, 0, 0.5], [1, 0, 0]), 0); // from inside
  assert.equal(entryOf(solid, [0, 0, 5], [0, 0, 1]), null); // behind
  assert.equal(edgesOf(solid).length, 12);
});

test("the box around boxes reaches as far as they do", () => {
  const box = around([{ min: [0, 1, 2], max: [1, 2, 3] }, { min: [-1, 5, 0], max: [0, 6, 1] }]);
  assert.deepEqual(box, { min: [-1, 1, 0], max: [1, 6, 3] });
});

test("kinds have the colours that the picture and the coloured cloud have", () => {
  assert.deepEqual(KIND_COLOURS, EXPECTED.kinds);
  assert.deepEqual(STATE_COLOURS, EXPECTED.states);
});

test("where frames are slow, less is drawn while the camera moves; where they are fast, everything", () => {
  const slow = new Pace();
  slow.begins();
  for (let frame = 0; frame < 4; frame++) slow.took(900);
  assert.ok(slow.share < 0.03, `${slow.share}`);
  assert.equal(slow.sharpness, 0.5);
  for (let frame = 0; frame < 60; frame++) slow.took(10);
  assert.deepEqual([slow.share, slow.sharpness], [1, 0.5]); // the number of pixels does not rise within a move
  slow.begins();
  assert.deepEqual([slow.share, slow.sharpness], [1, 1]);
  const fast = new Pace();
  fast.begins();
  for (let frame = 0; frame < 4; frame++) fast.took(16);
  assert.deepEqual([fast.share, fast.sharpness], [1, 1]);
});
