import assert from "node:assert/strict";
import { test } from "node:test";

import { Api, ApiError } from "../../../../service/web/source/app/api.ts";

type Answer = (url: string, init: RequestInit) => Response | Promise<Response>;

function api(answer: Answer): { api: Api; asked: [string, Headers][] } {
  const asked: [string, Headers][] = [];
  const fetcher = async (input: RequestInfo | URL, init: RequestInit = {}) => {
    asked.push([String(input), init.headers as Headers]);
    return answer(String(input), init);
  };
  return { api: new Api("http://host/spicd/", fetcher as typeof fetch), asked };
}

const problem = (code: string, status: number) =>
  Response.json(
    { type: `urn:spicd:problem:${code}`, title: "No", status, detail: `because of ${code}` },
    { status },
  );

test("paths are under where the page lies, links are taken as they are, and the key goes with both", async () => {
  const { api: one, asked } = api(() => Response.json({}));
  one.key = "spicd_secret";
  await one.get("maps/lobby");
  await one.get("/spicd/maps?cursor=x");
  assert.deepEqual(
    asked.map(([url]) => url),
    ["http://host/spicd/maps/lobby", "http://host/spicd/maps?cursor=x"],
  );
  assert.deepEqual(
    asked.map(([, headers]) => headers.get("Authorization")),
    ["Bearer spicd_secret", "Bearer spicd_secret"],
  );
});

test("a refusal is raised in the service's own words, and 401 asks for a key", async () => {
  const { api: one } = api(() => problem("unauthorized", 401));
  let told = "";
  one.onUnauthorized = ({ detail }) => (told = detail);
  await assert.rejects(
    one.get("maps"),
    (error: ApiError) => error.code === "unauthorized" && error.message === "because of unauthorized",
  );
  assert.equal(told, "because of unauthorized");
});

test("no answer, and one of something in front, are problems as well", async () => {
  const { api: none } = api(() => Promise.reject(new TypeError("failed")));
  await assert.rejects(none.get("maps"), (error: ApiError) => error.code === "no_answer");
  const { api: proxy } = api(
    () => new Response("<h1>Bad gateway</h1>", { status: 502, statusText: "Bad Gateway" }),
  );
  await assert.rejects(proxy.get("maps"), (error: ApiError) => error.problem.title === "502 Bad Gateway");
});

test("an aborted request stays an abort", async () => {
  const { api: one } = api(() => Promise.reject(new DOMException("gone", "AbortError")));
  await assert.rejects(one.get("maps"), { name: "AbortError" });
});

test("a list is read over its pages, up to as many as are wanted", async () => {
  const { api: one, asked } = api((url) => {
    const page = Number(new URL(url).searchParams.get("cursor") ?? 0);
    return Response.json({
      maps: [page],
      links: page < 9 ? [{ rel: "next", href: `/spicd/maps?cursor=${page + 1}` }] : [],
    });
  });
  const read = (list: { maps: number[]; links: { rel: string; href: string }[] }) => list.maps;
  assert.deepEqual(await one.pages("maps", read), [0, 1, 2, 3, 4, 5, 6, 7, 8, 9]);
  assert.deepEqual(await one.pages("maps", read, 3), [0, 1, 2]);
  assert.equal(asked.length, 13);
});

test("what makes something is safe to repeat", async () => {
  const { api: one, asked } = api(() => Response.json({}, { status: 202 }));
  await one.send("POST", "maps", { scan_ids: [] });
  await one.send("POST", "maps", { scan_ids: [] });
  const keys = asked.map(([, headers]) => headers.get("Idempotency-Key"));
  assert.match(keys[0] ?? "", /^[0-9a-f]{32}$/);
  assert.notEqual(keys[0], keys[1]);
});
