/** Scans sent in pieces by tus 1.0.0, so that a broken connection or a closed page costs one piece at most. */

import { ApiError, type Api } from "./api.ts";

const VERSION = "1.0.0";
const PIECE = 4 << 20;
const PAUSES_MS = [1000, 2000, 4000, 8000, 15_000, 30_000];
/** Codes after which the same piece may go through later. */
const PASSING = new Set([
  "no_answer",
  "upload_busy",
  "offset_mismatch",
  "unavailable",
  "database_unavailable",
  "blobs_unavailable",
  "incomplete_body",
  "too_slow",
]);

export interface Told {
  captured_at?: string; // RFC 3339
  device_id?: string;
  pose?: string; // as POST /scans takes it
  frame?: string;
}

/** Where unfinished uploads are remembered: `localStorage`, or anything like it. */
export type Memory = Pick<Storage, "getItem" | "setItem" | "removeItem">;

export interface Progress {
  (sent: number, waiting: string | null): void; // bytes so far; why it waits
}

/** Send a file and return the id of its scan. Raises ApiError with the service's refusal. */
export async function sendScan(
  api: Api,
  file: File,
  told: Told,
  progress: Progress,
  memory: Memory,
  signal: AbortSignal,
): Promise<string> {
  const name = `spicd-upload ${file.name} ${file.size} ${file.lastModified} ${JSON.stringify(told)}`;
  for (let failures = 0; ;) {
    try {
      const scan = await sendAll(
        api,
        file,
        told,
        memory,
        name,
        (sent) => {
          failures = 0;
          progress(sent, null);
        },
        signal,
      );
      memory.removeItem(name);
      return scan;
    } catch (error) {
      if (!(error instanceof ApiError) || !PASSING.has(error.code)) {
        memory.removeItem(name);
        throw error;
      }
      progress(-1, error.problem.detail);
      await new Promise((resolve) =>
        setTimeout(resolve, PAUSES_MS[Math.min(failures++, PAUSES_MS.length - 1)]),
      );
      signal.throwIfAborted();
    }
  }
}

async function sendAll(
  api: Api,
  file: File,
  told: Told,
  memory: Memory,
  name: string,
  sent: (bytes: number) => void,
  signal: AbortSignal,
): Promise<string> {
  let { path, offset, scan } = await begun(api, file, told, memory, name, signal);
  while (!scan) {
    sent(offset);
    const answer = await api.fetch(path, {
      method: "PATCH",
      headers: {
        "Tus-Resumable": VERSION,
        "Upload-Offset": String(offset),
        "Content-Type": "application/offset+octet-stream",
      },
      body: file.slice(offset, offset + PIECE),
      signal,
    });
    offset = Number(answer.headers.get("Upload-Offset"));
    scan = answer.headers.get("Scan-Id");
  }
  sent(file.size);
  return scan;
}

interface Begun {
  path: string;
  offset: number;
  scan: string | null;
}

/** Return an upload of this file that was begun before and is still there, or begin one. */
async function begun(
  api: Api,
  file: File,
  told: Told,
  memory: Memory,
  name: string,
  signal: AbortSignal,
): Promise<Begun> {
  const known = memory.getItem(name);
  if (known) {
    try {
      const answer = await api.fetch(known, {
        method: "HEAD",
        headers: { "Tus-Resumable": VERSION },
        signal,
      });
      return {
        path: known,
        offset: Number(answer.headers.get("Upload-Offset")),
        scan: answer.headers.get("Scan-Id"),
      };
    } catch (error) {
      if (!(error instanceof ApiError) || PASSING.has(error.code)) throw error;
      // it is gone, or was refused: begin anew
    }
  }
  const metadata = Object.entries({ filename: file.name, ...told }).filter(([, value]) => value);
  const answer = await api.fetch("uploads", {
    method: "POST",
    headers: {
      "Tus-Resumable": VERSION,
      "Upload-Length": String(file.size),
      "Upload-Metadata": metadata.map(([key, value]) => `${key} ${base64(value as string)}`).join(","),
    },
    signal,
  });
  const path = answer.headers.get("Location") as string;
  memory.setItem(name, path);
  return { path, offset: 0, scan: answer.headers.get("Scan-Id") };
}

/** Write text as base64 of its UTF-8 (tus 1.0.0, Upload-Metadata). */
export function base64(text: string): string {
  return btoa(String.fromCharCode(...new TextEncoder().encode(text)));
}

export interface Batch {
  scans: { file: File; told: Told }[];
  refused: { name: string; why: string }[];
}

const SIDECAR = /\.pose\.(json|txt)$/i;
const SCAN = /\.(ply|pcd|e57|las|laz)$/i;

/** Part dropped files into scans, each with what its sidecar (`hall.pose.json` of `hall.ply`) tells, and others. */
export async function batchOf(files: readonly File[]): Promise<Batch> {
  const batch: Batch = { scans: [], refused: [] };
  const sidecars = new Map(
    files.filter(({ name }) => SIDECAR.test(name)).map((file) => [file.name.replace(SIDECAR, ""), file]),
  );
  for (const file of files.filter(({ name }) => !SIDECAR.test(name))) {
    const stem = file.name.replace(/\.[^.]*$/, "");
    if (!SCAN.test(file.name))
      batch.refused.push({ name: file.name, why: "no scan by its name; send PLY, PCD, E57, LAS or LAZ" });
    else if (!file.size) batch.refused.push({ name: file.name, why: "the file is empty" });
    else batch.scans.push({ file, told: await toldBy(sidecars.get(stem), batch) });
    sidecars.delete(stem);
  }
  for (const { name } of sidecars.values())
    batch.refused.push({ name, why: "the scan that it tells of is not among the files" });
  return batch;
}

async function toldBy(sidecar: File | undefined, batch: Batch): Promise<Told> {
  if (!sidecar) return {};
  const text = await sidecar.text();
  if (/txt$/i.test(sidecar.name))
    return {
      pose: text
        .replace(/#.*$/gm, "")
        .trim()
        .replace(/[\s,]+/g, " "),
    };
  try {
    const { pose, frame, captured_at, device_id } = JSON.parse(text) as Record<string, unknown>;
    return Object.fromEntries(
      Object.entries({ pose: pose && JSON.stringify(pose), frame, captured_at, device_id }).filter(
        ([, value]) => value,
      ),
    ) as Told;
  } catch {
    batch.refused.push({ name: sidecar.name, why: "no JSON; its scan goes without a pose" });
    return {};
  }
}
