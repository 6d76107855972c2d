/** Scans that are dropped or chosen: what they become, how far they are, what the service says of them. */

import { Fragment, h } from "preact";

import type { Controller } from "../controller.ts";
import { bytes, count } from "../format.ts";
import type { Sending, UploadState } from "../state.ts";
import { addFiles, cancel, leaveOut, leaveOutRefused, submit } from "../submit.ts";
import type { Props } from "./page.tsx";
import { keepFocus } from "./panels.ts";
import { Problem } from "./parts.tsx";

export function UploadDialog({ app, state }: Props) {
  const { upload } = state;
  return (
    <dialog
      ref={(element) => shown(element, upload !== null)}
      onCancel={(event) => cancelled(event, app)}
      aria-labelledby="upload-title"
    >
      {upload && <Form app={app} upload={upload} name={state.map.value?.name ?? upload.map} />}
    </dialog>
  );
}

/** Open or close a dialog as the state has it; the browser keeps the focus inside, and gives it back. */
export function shown(element: HTMLDialogElement | null, open: boolean): void {
  if (!element || element.open === open) return;
  if (!open) return element.close();
  keepFocus(); // for the browser to give it back to something
  element.showModal();
}

/** Close the dialog; a file chooser inside that is left without files tells `cancel` as well, and closes nothing. */
function cancelled(event: Event, app: Controller): void {
  if (event.target !== event.currentTarget) return;
  event.preventDefault();
  cancel(app);
}

function Form({ app, upload, name }: { app: Controller; upload: UploadState; name: string | null }) {
  const { phase, files, refused, problem } = upload;
  const busy = phase === "sending" || phase === "asking";
  return (
    <form method="dialog" class="upload" onSubmit={(event) => begin(event, app)}>
      <h2 id="upload-title">{upload.map ? `Add a survey to ${name}` : "New map"}</h2>
      <p class="faint">
        {upload.map
          ? "The scans of one visit, compared together with the map."
          : "Scans of a building as it is now; they have to overlap. Later visits are compared with it."}
      </p>
      <label class="drop">
        <input
          type="file"
          multiple
          disabled={busy}
          accept=".ply,.pcd,.e57,.las,.laz,.json,.txt"
          onChange={({ currentTarget }) => void addFiles(app, [...(currentTarget.files ?? [])])}
        />
        <span>{files.length ? "Add more files" : "Choose files, or drop them anywhere on the page"}</span>
        <small>
          PLY, PCD, E57, LAS or LAZ in metres, z up. A pose prior as hall.pose.json or hall.pose.txt beside hall.ply.
        </small>
      </label>
      {refused.map(({ name, why }) => (
        <p class="warning">
          {name}: {why}
        </p>
      ))}
      {files.length > 0 && (
        <ul class="files">
          {files.map((file, n) => (
            <FileRow key={file.name} file={file} {...(busy ? {} : { leaveOut: () => leaveOut(app, n) })} />
          ))}
        </ul>
      )}
      <Fields upload={upload} disabled={busy} />
      {problem && <Problem problem={problem} />}
      <div class="row end">
        <button type="button" onClick={() => cancel(app)}>
          {busy ? "Stop" : "Cancel"}
        </button>
        {phase === "failed" && someSent(files) && (
          <button type="button" onClick={({ currentTarget }) => goWithout(app, currentTarget.form!)}>
            {`${upload.map ? "Compare" : "Build"} without ${nameOf(files.filter(({ problem }) => problem))}`}
          </button>
        )}
        <button class="primary" disabled={busy || !files.length}>
          {label(upload)}
        </button>
      </div>
      <p role="status" aria-live="polite" class="faint">
        {busy &&
          "What was sent is kept: if the page is closed, choose the same files again and they go on where they were."}
      </p>
    </form>
  );
}

/** Whether some files were refused and others became scans. */
function someSent(files: Sending[]): boolean {
  return files.some(({ problem }) => problem) && files.some(({ scan }) => scan);
}

function nameOf(files: Sending[]): string {
  return files.length === 1 ? files[0]!.name : count(files.length, "file");
}

function label({ phase, files, map }: UploadState): string {
  if (phase === "sending") return "Sending…";
  if (phase === "asking") return "Asking for the job…";
  if (phase === "failed") return "Try again";
  return `${map ? "Compare" : "Build from"} ${count(files.length, "scan")}`;
}

function Fields({ upload, disabled }: { upload: UploadState; disabled: boolean }) {
  return (
    <fieldset class="fields" disabled={disabled}>
      {!upload.map && (
        <>
          <label>
            Name
            <input name="name" maxLength={200} placeholder="Lobby, ground floor" autocomplete="off" />
          </label>
          <label>
            Id in addresses
            <input
              name="id"
              pattern="[A-Za-z0-9_\-]{1,64}"
              title="letters, digits, - and _"
              placeholder="left out: chosen"
              autocomplete="off"
            />
          </label>
        </>
      )}
      <label>
        Device
        <input
          name="device_id"
          maxLength={64}
          placeholder="such as robot-7; may be left out"
          autocomplete="off"
        />
      </label>
      <label>
        Captured at
        <input name="captured_at" type="datetime-local" />
        <small class="faint">Empty: now</small>
      </label>
    </fieldset>
  );
}

function FileRow({ file, leaveOut }: { file: Sending; leaveOut?: () => void }) {
  const { name, size, sent, waiting, problem, scan } = file;
  const state = scan
    ? "sent"
    : waiting
      ? `waits: ${waiting}`
      : sent
        ? `${bytes(sent)} of ${bytes(size)}`
        : bytes(size);
  return (
    <li>
      <span class="name">{name}</span>
      <span class="faint">{state}</span>
      <button
        type="button"
        class="small"
        aria-label={`Leave ${name} out`}
        title="Leave it out"
        disabled={!leaveOut}
        onClick={leaveOut}
      >
        ✕
      </button>
      <progress max={size} value={sent} aria-label={`${name}: ${state}`} />
      {problem && <Problem problem={problem} />}
    </li>
  );
}

function goWithout(app: Controller, form: HTMLFormElement): void {
  leaveOutRefused(app);
  void submit(app, new FormData(form));
}

function begin(event: SubmitEvent, app: Controller): void {
  event.preventDefault();
  void submit(app, new FormData(event.currentTarget as HTMLFormElement));
}
