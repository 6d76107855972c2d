/** Follows `/events`: a stream while one comes through, long polls where a proxy holds it back. */

import { ApiError, type Api } from "./api.ts";
import type { CloudEvent, EventList } from "./documents.ts";
import { SseParser } from "./sse.ts";

export type Line = "live" | "polling" | "offline";

export interface Follower {
  onEvents: (events: CloudEvent[]) => void;
  onLine: (line: Line) => void; // how events come, when that changes
  onGap: () => void; // events were missed: all that is shown has to be asked for again
}

const FIRST_CHUNK_MS = 5000; // the service sends one at once; later than this something holds the stream back
const WAIT_S = 20;
const PAUSES_MS = [500, 1000, 2000, 5000, 10_000];

/** Follow until `signal` aborts. A failure is told as `offline`, and tried again for ever. */
export async function follow(
  api: Api,
  follower: Follower,
  signal: AbortSignal,
  after: string | null = null,
): Promise<void> {
  const state = { cursor: after, streams: true, failures: 0 };
  while (!signal.aborted) {
    try {
      if (state.streams) await stream(api, follower, state, signal);
      else await poll(api, follower, state, signal);
      state.failures = 0;
    } catch (error) {
      if (signal.aborted) return;
      if (error instanceof ApiError && error.code === "gone") {
        state.cursor = null;
        follower.onGap();
        continue;
      }
      if (error instanceof ApiError && error.code === "unauthorized") return; // begun again with a key
      if (error instanceof HeldBack) {
        state.streams = false;
        continue;
      }
      follower.onLine("offline");
      await pause(PAUSES_MS[Math.min(state.failures++, PAUSES_MS.length - 1)]!, signal);
    }
  }
}

interface State {
  cursor: string | null;
  streams: boolean;
  failures: number;
}

class HeldBack extends Error {}

/** Read one stream to its end. Raises HeldBack where nothing of it comes through. */
async function stream(api: Api, follower: Follower, state: State, signal: AbortSignal): Promise<void> {
  const headers: Record<string, string> = { Accept: "text/event-stream" };
  if (state.cursor !== null) headers["Last-Event-ID"] = state.cursor;
  const own = new AbortController();
  const abort = () => own.abort();
  signal.addEventListener("abort", abort, { once: true });
  let held = false;
  const timer = setTimeout(() => {
    held = true;
    own.abort();
  }, FIRST_CHUNK_MS);
  try {
    const answer = await api.fetch("events", { headers, signal: own.signal });
    const reader = answer.body!.pipeThrough(new TextDecoderStream()).getReader();
    const parser = new SseParser();
    for (;;) {
      const { value, done } = await reader.read();
      if (done) return;
      clearTimeout(timer);
      state.failures = 0;
      follower.onLine("live");
      take(parser.feed(value), follower, state);
    }
  } catch (error) {
    if (held) throw new HeldBack();
    if (error instanceof ApiError || signal.aborted) throw error;
    throw error instanceof Error && error.name === "AbortError" ? error : new Error("the stream broke");
  } finally {
    clearTimeout(timer);
    signal.removeEventListener("abort", abort);
  }
}

function take(messages: { id: string; data: string }[], follower: Follower, state: State): void {
  const events: CloudEvent[] = [];
  for (const { id, data } of messages) {
    if (id) state.cursor = id;
    if (data) events.push(JSON.parse(data) as CloudEvent);
  }
  if (events.length) follower.onEvents(events);
}

async function poll(api: Api, follower: Follower, state: State, signal: AbortSignal): Promise<void> {
  const path = state.cursor === null ? "events?limit=1" : `events?after=${state.cursor}&wait=${WAIT_S}`;
  const list = await api.get<EventList>(path, signal);
  follower.onLine("polling");
  state.cursor = list.cursor;
  if (list.events.length) follower.onEvents(list.events);
}

function pause(milliseconds: number, signal: AbortSignal): Promise<void> {
  return new Promise((resolve) => {
    const timer = setTimeout(done, milliseconds);
    function done(): void {
      clearTimeout(timer);
      signal.removeEventListener("abort", done);
      resolve();
    }
    signal.addEventListener("abort", done);
  });
}
