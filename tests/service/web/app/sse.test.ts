import assert from "node:assert/strict";
import { test } from "node:test";

import { SseParser } from "../../../../service/web/source/app/sse.ts";

const STREAM = 'id: 7\nretry: 2000\n\n: keep\nid: 8\n\ndata: {"a":1}\ndata: {"b":2}\nid: 9\n\n';
const READ = [
  { id: "7", data: "" },
  { id: "8", data: "" },
  { id: "9", data: '{"a":1}\n{"b":2}' },
];

test("a stream is read as it stands", () => {
  assert.deepEqual(new SseParser().feed(STREAM), READ);
});

test("wherever a chunk ends, and whichever line ends are used, the messages are the same", () => {
  for (const ends of ["\n", "\r\n", "\r"]) {
    const stream = STREAM.replaceAll("\n", ends);
    for (const size of [1, 2, 3, 7]) {
      const parser = new SseParser();
      const messages = [];
      for (let at = 0; at < stream.length; at += size)
        messages.push(...parser.feed(stream.slice(at, at + size)));
      messages.push(...parser.feed("\n").filter(({ data }) => data)); // an end that a lone CR left open
      assert.deepEqual(
        messages.filter(({ id }, n) => n === 0 || messages[n - 1]?.id !== id),
        READ,
      );
    }
  }
});

test("a message that is not complete waits", () => {
  const parser = new SseParser();
  assert.deepEqual(parser.feed("data: half"), []);
  assert.deepEqual(parser.feed("\n\n"), [{ id: "", data: "half" }]);
});
