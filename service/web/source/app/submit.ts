/** From files to a job: send them one after the other, then ask for the map or the survey of them. */

import { problemOf, unique } from "./api.ts";
import type { Controller } from "./controller.ts";
import type { Sending, UploadState } from "./state.ts";
import { batchOf, sendScan, type Told } from "./uploads.ts";

/** The files themselves; the state has what is shown of them. */
let chosen: { file: File; told: Told }[] = [];
let sending: AbortController | null = null;
let idempotencyKey = "";

/** Add files to those that are to be sent; opens the dialog where it is not. */
export async function addFiles(app: Controller, files: File[]): Promise<void> {
  const before = app.state.upload;
  if (before?.phase === "sending" || before?.phase === "asking") return;
  if (!before) chosen = [];
  const { scans, refused } = await batchOf(files);
  const known = new Set(chosen.map(({ file }) => `${file.name} ${file.size}`));
  chosen.push(...scans.filter(({ file }) => !known.has(`${file.name} ${file.size}`)));
  app.update({
    upload: {
      map: before ? before.map : app.state.place.map,
      files: chosen.map(({ file }, n) => before?.files[n] ?? rowOf(file)), // what was sent stays sent
      refused,
      phase: "choosing",
      problem: null,
    },
  });
}

/** Leave a file out again. */
export function leaveOut(app: Controller, n: number): void {
  keep(app, (_, at) => at !== n);
}

/** Leave out the files that the service refused, so that the others go without them. */
export function leaveOutRefused(app: Controller): void {
  keep(app, ({ problem }) => problem === null);
}

/** Keep some of the files; what was refused with the others is forgotten. */
function keep(app: Controller, wanted: (row: Sending, n: number) => boolean): void {
  const { upload } = app.state;
  if (!upload) return;
  chosen = chosen.filter((_, n) => wanted(upload.files[n]!, n));
  change(app, { files: upload.files.filter(wanted), phase: "choosing", problem: null });
}

function rowOf({ name, size }: File): Sending {
  return { name, size, sent: 0, waiting: null, problem: null, scan: null };
}

/** Stop sending, and close the dialog. What was sent is kept by the service for a day. */
export function cancel(app: Controller): void {
  sending?.abort();
  sending = null;
  chosen = [];
  app.update({ upload: null });
}

/** Send all files that are not scans yet, then ask for the job; what is refused is shown in the service's words. */
export async function submit(app: Controller, form: FormData): Promise<void> {
  const said = Object.fromEntries([...form].filter(([, value]) => value)) as Record<string, string>;
  if (said["captured_at"]) said["captured_at"] = new Date(said["captured_at"]).toISOString();
  const { signal } = (sending = new AbortController());
  change(app, { phase: "sending", problem: null });
  for (const [n, { file, told }] of chosen.entries()) {
    if (app.state.upload?.files[n]?.scan) continue;
    await sendOne(app, n, file, { ...shared(said), ...told }, signal);
    if (signal.aborted) return;
  }
  const scans = app.state.upload?.files.map(({ scan }) => scan) ?? [];
  if (scans.some((scan) => scan === null)) return change(app, { phase: "failed" });
  await askFor(app, said, [...new Set(scans)] as string[]);
}

/** Return what is said of all files alike. */
function shared({ device_id, captured_at }: Record<string, string>): Told {
  return { ...(device_id ? { device_id } : {}), ...(captured_at ? { captured_at } : {}) };
}

async function sendOne(
  app: Controller,
  n: number,
  file: File,
  told: Told,
  signal: AbortSignal,
): Promise<void> {
  const row = (part: Partial<Sending>) =>
    change(app, {
      files: app.state.upload?.files.map((one, at) => (at === n ? { ...one, ...part } : one)) ?? [],
    });
  row({ problem: null });
  const progress = (sent: number, waiting: string | null) =>
    row(waiting ? { waiting } : { sent, waiting: null });
  try {
    const scan = await sendScan(app.api, file, told, progress, localStorage, signal);
    row({ scan, sent: file.size, waiting: null });
  } catch (error) {
    if (!signal.aborted) row({ problem: problemOf(error), waiting: null });
  }
}

async function askFor(app: Controller, said: Record<string, string>, scans: string[]): Promise<void> {
  const { map } = app.state.upload as UploadState;
  change(app, { phase: "asking" });
  idempotencyKey ||= unique(); // the same when it is tried again, so that no second job comes of it
  try {
    const path = map ? `maps/${map}/surveys` : "maps";
    const body = map
      ? { ...shared(said), scan_ids: scans }
      : { name: said["name"] ?? null, id: said["id"] ?? null, scan_ids: scans };
    const made = await app.api.send<{ map_id: string; survey_id?: string }>(
      "POST",
      path,
      body,
      idempotencyKey,
    );
    idempotencyKey = "";
    cancel(app);
    if (made.survey_id) app.tell("The survey is being compared with the map.");
    else app.open(made.map_id);
    app.jobsChanged();
  } catch (error) {
    idempotencyKey = "";
    change(app, { phase: "failed", problem: problemOf(error) });
  }
}

function change(app: Controller, part: Partial<UploadState>): void {
  if (app.state.upload) app.update({ upload: { ...app.state.upload, ...part } });
}
