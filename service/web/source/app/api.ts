/** The service's API: requests with the key, relative to where the page lies; problems are raised as ApiError. */

import type { Link, ProblemDocument } from "./documents.ts";

const NO_ANSWER: ProblemDocument = {
  type: "urn:spicd:problem:no_answer",
  title: "The service does not answer",
  status: null,
  detail: "the service does not answer",
};

/** A problem document that a request was answered with; `no_answer` where none came. */
export class ApiError extends Error {
  readonly problem: ProblemDocument;

  constructor(problem: ProblemDocument) {
    super(problem.detail);
    this.problem = problem;
  }

  get code(): string {
    return this.problem.type.split(":").at(-1) ?? "";
  }
}

/** Return what was thrown as a problem document. */
export function problemOf(error: unknown): ProblemDocument {
  if (error instanceof ApiError) return error.problem;
  return { type: "urn:spicd:problem:page", title: "The page failed", detail: String(error) };
}

/** Return a name that nobody else takes; `crypto.randomUUID` is only there on HTTPS and localhost. */
export function unique(): string {
  return Array.from(crypto.getRandomValues(new Uint8Array(16)), (byte) =>
    byte.toString(16).padStart(2, "0"),
  ).join("");
}

export class Api {
  key: string | null = null;
  onUnauthorized: (problem: ProblemDocument) => void = () => {};
  readonly #base: string;
  readonly #fetch: typeof fetch;

  constructor(base: string, fetcher: typeof fetch = fetch) {
    this.#base = base;
    this.#fetch = fetcher;
  }

  /** Return the address of a path such as `maps/lobby`, or of an absolute one as links have it. */
  url(path: string): string {
    return new URL(path, this.#base).href;
  }

  /** Fetch as `fetch` does, with the key; paths are relative to the page. Raises ApiError for any status over 399. */
  readonly fetch = async (input: RequestInfo | URL, init: RequestInit = {}): Promise<Response> => {
    const headers = new Headers(input instanceof Request ? input.headers : undefined);
    new Headers(init.headers).forEach((value, name) => headers.set(name, value));
    if (this.key) headers.set("Authorization", `Bearer ${this.key}`);
    const target = typeof input === "string" ? this.url(input) : input;
    let answer: Response;
    try {
      answer = await this.#fetch.call(globalThis, target, { ...init, headers });
    } catch (error) {
      if ((error as Error).name === "AbortError") throw error;
      throw new ApiError(NO_ANSWER);
    }
    if (answer.ok || answer.status === 304) return answer;
    const error = new ApiError(await problemIn(answer));
    if (answer.status === 401) this.onUnauthorized(error.problem);
    throw error;
  };

  async get<T>(path: string, signal?: AbortSignal): Promise<T> {
    const answer = await this.fetch(path, {
      headers: { Accept: "application/json, application/geo+json" },
      ...(signal ? { signal } : {}),
    });
    return (await answer.json()) as T;
  }

  /** Send JSON, under a key of its own that makes a request safe to repeat. */
  async send<T>(method: "POST" | "DELETE", path: string, body?: unknown, key = unique()): Promise<T> {
    const headers: Record<string, string> = { Accept: "application/json" };
    if (method === "POST") headers["Idempotency-Key"] = key;
    if (body !== undefined) headers["Content-Type"] = "application/json";
    const answer = await this.fetch(path, {
      method,
      headers,
      ...(body === undefined ? {} : { body: JSON.stringify(body) }),
    });
    return (answer.status === 204 ? undefined : await answer.json()) as T;
  }

  /** Return the items of a list over its pages, `most` of them at most. */
  async pages<T, D extends { links: Link[] }>(
    path: string,
    items: (document: D) => T[],
    most = 10_000,
    signal?: AbortSignal,
  ): Promise<T[]> {
    const all: T[] = [];
    for (let next: string | undefined = path; next && all.length < most;) {
      const document: D = await this.get<D>(next, signal);
      all.push(...items(document));
      next = document.links.find((link) => link.rel === "next")?.href;
    }
    return all;
  }
}

async function problemIn(answer: Response): Promise<ProblemDocument> {
  try {
    const said = (await answer.json()) as ProblemDocument;
    if (said.type && said.detail) return { ...said, status: answer.status };
  } catch {
    // something in front of the service answered
  }
  return {
    type: "urn:spicd:problem:unavailable",
    title: `${answer.status} ${answer.statusText}`.trim(),
    status: answer.status,
    detail: `something answered ${answer.status} that is not the service; look at what stands in front of it`,
  };
}
