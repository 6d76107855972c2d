/** What is said of problems: plain words first; the service's own, with their figures, are folded beneath. */

import type { ProblemDocument } from "./documents.ts";
import { capital, REASONS } from "./words.ts";

/** What a problem means where the service's own sentence is one for experts. */
const PLAIN: Record<string, string> = {
  scan_unreadable: "The file cannot be read as a scan.",
  scan_too_large: "A scan has too many points.",
  scan_units: "A scan is not in metres.",
  scan_far_away: "A scan lies kilometres from where its coordinates begin.",
  registration_failed: "None of the scans could be placed.",
  map_failed: "The scans do not make a map.",
  training_failed: "The model could not be trained.",
  detector_unavailable: "What compares the scans cannot be used.",
  out_of_memory: "There was not enough memory.",
  timed_out: "It took too long, and was ended.",
  pipeline_error: "The service failed at it.",
  worker_died: "The service broke off.",
  process_lost: "The service broke off.",
  function_refused: "The service broke off.",
  internal: "The service failed.",
};

const AGAIN = "Run it again; if it fails again, tell whoever runs the service what stands under Details.";

const ADVICE: Record<string, string> = {
  no_answer:
    "See that the service runs and the network reaches it. What was sent is kept; it goes on by itself.",
  unauthorized: "Enter an API key; whoever runs the service makes one with `spicd keys add`.",
  forbidden: "Ask whoever runs the service for a key that may do this, or for this map.",
  scan_unreadable: "Write the file again as PLY, PCD, E57, LAS or LAZ and send that.",
  scan_too_large: "Send it with fewer points, or in parts.",
  scan_units: "Write the file in metres.",
  scan_far_away: "Subtract one offset from all scans of the place.",
  too_large: "Send fewer or smaller files, or have SPICD_MAX_UPLOAD_BYTES raised.",
  disk_full: "Delete surveys or maps that nobody needs, or have the disk enlarged; then send it again.",
  queue_full: "Wait until some jobs are done, then send it again.",
  not_found: "It may have been deleted. Go back to the list of maps.",
  not_ready: "Wait for its job; a failed one says why.",
  registration_failed: "Check that it is the right map, give pose priors, or scan more of the mapped place.",
  map_failed: "Send scans that overlap; each says why it was left out.",
  out_of_memory: "Send fewer or smaller scans, or have the machine's memory enlarged.",
  detector_unavailable: "Tell whoever runs the service what stands under Details.",
  pipeline_error: AGAIN,
  worker_died: AGAIN,
  process_lost: AGAIN,
  timed_out: AGAIN,
  internal: "Tell whoever runs the service the id of the job, or the instance that is named here.",
};

/** Return the stable code of a problem: what stands behind the last colon of its type. */
export function codeOf(problem: ProblemDocument): string {
  return problem.type.split(":").at(-1) ?? "";
}

/** Say what to do about a problem; empty where its detail is all that is known. */
export function adviceOn(problem: ProblemDocument): string {
  return ADVICE[codeOf(problem)] ?? (problem.status && problem.status >= 500 ? "Try again in a moment." : "");
}

/** Return a problem in plain sentences, that of each reason among them; null where its detail is plain by itself. */
export function plainOf(problem: ProblemDocument): string[] | null {
  const plain = PLAIN[codeOf(problem)];
  return plain ? [plain, ...reasonsIn(problem.detail)] : null;
}

/** Say a problem in a line or two. */
export function sentenceOf(problem: ProblemDocument): string {
  return plainOf(problem)?.join(" ") ?? problem.detail;
}

/** Return `Lies nowhere on the map: hall.ply, hall-2.ply.` for each reason that a detail has for scans. */
function reasonsIn(detail: string): string[] {
  const files = new Map<string, string[]>();
  for (const [, file, reason] of detail.matchAll(/(?:^|: |; )scan (\S.*?): .*?\[(\w+)\](?=;|$)/g))
    files.set(reason!, [...(files.get(reason!) ?? []), file!]);
  return [...files]
    .filter(([reason]) => reason in REASONS)
    .map(([reason, named]) => `${capital(REASONS[reason]![0])}: ${named.join(", ")}.`);
}

const SCAN_ID = /scan-[0-9a-f]{32}/g;

/** Return the ids of scans that a text names. */
export function scansIn(text: string): string[] {
  return [...new Set(text.match(SCAN_ID))];
}

/** Write the names of files in place of the ids of their scans, where they are known. */
export function withNames(text: string, names: Readonly<Record<string, string>>): string {
  return text.replace(SCAN_ID, (id) => names[id] || id);
}
