import assert from "node:assert/strict";
import { test } from "node:test";

import { Api } from "../../../../service/web/source/app/api.ts";
import { follow, type Follower } from "../../../../service/web/source/app/follow.ts";

const event = (sequence: number) =>
  `data: {"type":"survey.ready","subject":"s","sequence":"${sequence}","data":{}}\nid: ${sequence}\n\n`;

function stream(text: string): Response {
  return new Response(text, { headers: { "Content-Type": "text/event-stream" } });
}

/** Follow with scripted answers; ends with the last of them. Returns what was asked and what was told. */
async function followed(answers: ((headers: Headers, signal: AbortSignal) => Response)[]) {
  const ended = new AbortController();
  const asked: { url: string; after: string | null }[] = [];
  const told: string[] = [];
  const fetcher = async (input: RequestInfo | URL, init: RequestInit = {}) => {
    const headers = init.headers as Headers;
    asked.push({ url: String(input), after: headers.get("Last-Event-ID") });
    const answer = answers.shift();
    if (!answer) {
      ended.abort();
      throw new DOMException("gone", "AbortError");
    }
    return answer(headers, init.signal as AbortSignal);
  };
  const follower: Follower = {
    onEvents: (events) => told.push(...events.map(({ sequence }) => sequence)),
    onLine: (line) => told.at(-1) !== line && told.push(line),
    onGap: () => told.push("gap"),
  };
  await follow(new Api("http://host/", fetcher as typeof fetch), follower, ended.signal);
  return { asked, told };
}

test("a stream that ends goes on behind its last event", async () => {
  const { asked, told } = await followed([
    () => stream(`id: 3\nretry: 2000\n\n${event(4)}${event(5)}`),
    () => stream(event(6)),
  ]);
  assert.deepEqual(told, ["live", "4", "5", "live", "6"]);
  assert.deepEqual(
    asked.map(({ after }) => after),
    [null, "5", "6"],
  );
});

test("a cursor that is kept no more is told as a gap, and begins anew", async () => {
  const gone = () =>
    Response.json(
      { type: "urn:spicd:problem:gone", title: "", detail: "gone", status: 410 },
      { status: 410 },
    );
  const { asked, told } = await followed([() => stream(event(4)), gone, () => stream("id: 90\n\n")]);
  assert.deepEqual(told, ["live", "4", "gap", "live"]);
  assert.deepEqual(
    asked.map(({ after }) => after),
    [null, "4", null, "90"],
  );
});

test("a service that does not answer is told, and asked again", async () => {
  const { told } = await followed([
    () => {
      throw new TypeError("failed");
    },
    () => stream(event(1)),
  ]);
  assert.deepEqual(told, ["offline", "live", "1"]);
});

test("without a key that is known it stops until there is one", async () => {
  const refused = () =>
    Response.json(
      { type: "urn:spicd:problem:unauthorized", title: "", detail: "no", status: 401 },
      { status: 401 },
    );
  const { asked, told } = await followed([refused, () => stream(event(1))]);
  assert.equal(asked.length, 1);
  assert.deepEqual(told, []);
});

test("where something holds the stream back it asks again and again, and misses nothing", async (context) => {
  context.mock.timers.enable({ apis: ["setTimeout"] });
  const heldBack = (headers: Headers, signal: AbortSignal) => {
    assert.equal(headers.get("Accept"), "text/event-stream");
    setImmediate(() => context.mock.timers.tick(6000));
    const nothing = new ReadableStream({
      start: (controller) =>
        signal.addEventListener("abort", () => controller.error(new DOMException("gone", "AbortError"))),
    });
    return new Response(nothing);
  };
  const list = (cursor: string, ...sequences: string[]) =>
    Response.json({
      cursor,
      events: sequences.map((sequence) => ({ type: "survey.ready", subject: "s", sequence, data: {} })),
      links: [],
    });
  const { asked, told } = await followed([heldBack, () => list("7"), () => list("8", "8")]);
  assert.deepEqual(told, ["polling", "8"]);
  assert.deepEqual(
    asked.slice(1).map(({ url }) => new URL(url).search),
    ["?limit=1", "?after=7&wait=20", "?after=8&wait=20"],
  );
});
