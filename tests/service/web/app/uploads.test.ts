import assert from "node:assert/strict";
import { test } from "node:test";

import { Api, ApiError } from "../../../../service/web/source/app/api.ts";
import { base64, batchOf, sendScan, type Memory } from "../../../../service/web/source/app/uploads.ts";

/** A service that takes uploads in pieces; `refuse` may answer in its place. */
class Tus {
  stored = new Uint8Array();
  metadata = "";
  asked: string[] = [];
  refuse: (method: string) => Response | null = () => null;

  readonly fetch = async (input: RequestInfo | URL, init: RequestInit = {}): Promise<Response> => {
    const method = init.method ?? "GET";
    this.asked.push(`${method} ${new URL(String(input)).pathname}`);
    const refused = this.refuse(method);
    if (refused) return refused;
    const headers = init.headers as Headers;
    assert.equal(headers.get("Tus-Resumable"), "1.0.0");
    if (method === "POST") {
      this.metadata = headers.get("Upload-Metadata") ?? "";
      return new Response(null, {
        status: 201,
        headers: { Location: "/uploads/abc", "Upload-Offset": "0" },
      });
    }
    if (method === "PATCH") {
      assert.equal(headers.get("Upload-Offset"), String(this.stored.length));
      this.stored = new Uint8Array([
        ...this.stored,
        ...new Uint8Array(await (init.body as Blob).arrayBuffer()),
      ]);
    }
    const done = this.stored.length === 9 << 20;
    return new Response(null, {
      status: method === "PATCH" ? 204 : 200,
      headers: {
        "Upload-Offset": String(this.stored.length),
        ...(done ? { "Scan-Id": "scan-1" } : {}),
      },
    });
  };
}

const memory = (): Memory & { kept: Map<string, string> } => {
  const kept = new Map<string, string>();
  return {
    kept,
    getItem: (name) => kept.get(name) ?? null,
    setItem: (name, value) => void kept.set(name, value),
    removeItem: (name) => void kept.delete(name),
  };
};
const file = () => new File([new Uint8Array(9 << 20)], "hall ä.ply", { lastModified: 1 });
const problem = (code: string, status: number) =>
  Response.json({ type: `urn:spicd:problem:${code}`, title: "", detail: code, status }, { status });

test("a file goes in pieces and becomes a scan; nothing of it is remembered then", async () => {
  const tus = new Tus();
  const kept = memory();
  const seen: number[] = [];
  const scan = await sendScan(
    new Api("http://host/", tus.fetch as typeof fetch),
    file(),
    { device_id: "robot-7" },
    (sent) => seen.push(sent),
    kept,
    new AbortController().signal,
  );
  assert.equal(scan, "scan-1");
  assert.deepEqual(seen, [0, 4 << 20, 8 << 20, 9 << 20]);
  assert.equal(tus.metadata, `filename ${base64("hall ä.ply")},device_id ${base64("robot-7")}`);
  assert.equal(Buffer.from(base64("hall ä.ply"), "base64").toString(), "hall ä.ply");
  assert.equal(kept.kept.size, 0);
});

test("what was begun on a page that was closed goes on where it was", async () => {
  const tus = new Tus();
  const kept = memory();
  const api = new Api("http://host/", tus.fetch as typeof fetch);
  const closed = new AbortController();
  tus.refuse = (method) => {
    if (method !== "PATCH" || tus.stored.length < 8 << 20) return null;
    closed.abort();
    throw new DOMException("closed", "AbortError");
  };
  await assert.rejects(sendScan(api, file(), {}, () => {}, { ...kept, removeItem: () => {} }, closed.signal));
  tus.refuse = () => null;
  tus.asked = [];
  assert.equal(await sendScan(api, file(), {}, () => {}, kept, new AbortController().signal), "scan-1");
  assert.deepEqual(tus.asked, ["HEAD /uploads/abc", "PATCH /uploads/abc"]);
});

test("a service that is away for a moment is waited for", async (context) => {
  context.mock.timers.enable({ apis: ["setTimeout"] });
  const tus = new Tus();
  let failures = 2;
  tus.refuse = (method) => (method === "PATCH" && failures-- > 0 ? problem("unavailable", 503) : null);
  const waits: string[] = [];
  const progress = (_: number, waiting: string | null) => {
    if (waiting) setImmediate(() => context.mock.timers.tick(60_000));
    if (waiting) waits.push(waiting);
  };
  const scan = await sendScan(
    new Api("http://host/", tus.fetch as typeof fetch),
    file(),
    {},
    progress,
    memory(),
    new AbortController().signal,
  );
  assert.equal(scan, "scan-1");
  assert.deepEqual(waits, ["unavailable", "unavailable"]);
});

test("a refusal is final, and told word by word", async () => {
  const tus = new Tus();
  tus.refuse = (method) => (method === "POST" ? problem("scan_unreadable", 422) : null);
  const sent = sendScan(
    new Api("http://host/", tus.fetch as typeof fetch),
    file(),
    {},
    () => {},
    memory(),
    new AbortController().signal,
  );
  await assert.rejects(sent, (error: ApiError) => error.code === "scan_unreadable");
});

test("sidecars go with their scans, and what is no scan is refused with a reason", async () => {
  const { scans, refused } = await batchOf([
    new File(["x"], "hall.ply"),
    new File(['{"pose": [1, 2, 0, 0, 0, 0, 1], "captured_at": "2026-03-01T12:00:00Z"}'], "hall.pose.json"),
    new File(["x"], "stairs.pcd"),
    new File(["1 2 0, 0 0 0 1 # by hand\n"], "stairs.pose.txt"),
    new File(["x"], "notes.docx"),
    new File([], "empty.ply"),
    new File(["{}"], "lost.pose.json"),
  ]);
  assert.deepEqual(
    scans.map(({ file: { name }, told }) => [name, told]),
    [
      ["hall.ply", { pose: "[1,2,0,0,0,0,1]", captured_at: "2026-03-01T12:00:00Z" }],
      ["stairs.pcd", { pose: "1 2 0 0 0 0 1" }],
    ],
  );
  assert.deepEqual(
    refused.map(({ name }) => name),
    ["notes.docx", "empty.ply", "lost.pose.json"],
  );
});
