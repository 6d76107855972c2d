/** What is said of surveys, objects, scans and errors. Nothing found is never said where nothing was judged. */

import { count, instant, ordinal, percent, whole } from "./format.ts";
import type {
  Counts,
  JobDocument,
  MapSummaryDocument,
  SurveySummaryDocument,
} from "./documents.ts";

export type Tone = "changed" | "quiet" | "doubt" | "failed" | "running";

export interface Saying {
  tone: Tone;
  short: string; // of two or three words
  long: string; // a sentence
  more?: string; // what has to be known beside it
}

export const KINDS: Record<string, string> = {
  appeared: "Appeared",
  disappeared: "Disappeared",
  moved: "Moved",
  both: "Appeared and disappeared",
  changed: "Changed",
};

/** What a status means of objects of any kind. */
export const STATUSES: Record<string, string> = {
  new: "New",
  still_there: "Still changed",
  gone_again: "As in the map again",
  unknown: "Not looked at since",
  accepted: "Accepted",
};

/** What a status means of an object of that kind, and what the survey which looked last found. */
const STATUSES_BY_KIND: Record<string, Record<string, [string, string]>> = {
  appeared: {
    new: ["New", "was the first that saw it"],
    still_there: ["Still there", "looked and saw it again"],
    gone_again: ["Gone again", "looked and it was not there, as in the map"],
  },
  disappeared: {
    new: ["New", "was the first that found it gone"],
    still_there: ["Still missing", "looked and it was gone"],
    gone_again: ["Back again", "looked and it was there, as in the map"],
  },
  moved: {
    new: ["New", "was the first that found it elsewhere"],
    still_there: ["Still in its new place", "looked and saw it there again"],
    gone_again: ["Back in its old place", "looked and it was as in the map"],
  },
};

/** Say in short how it stands with an object, in the words of its kind. */
export function statusOf(status: string, kind: string): string {
  return STATUSES_BY_KIND[kind]?.[status]?.[0] ?? STATUSES[status] ?? status;
}

/** Say who found it so; `looked` is when a survey looked there last. */
export function whyStatus(status: string, kind: string, looked: string): string {
  if (status === "accepted") return "a version of the map has taken it over";
  if (status === "unknown")
    return `${instant(looked)} looked last; the latest survey that could be compared did not`;
  const found = STATUSES_BY_KIND[kind]?.[status]?.[1];
  return found ? `${instant(looked)} ${found}` : `${instant(looked)} looked there last`;
}

export const TILE_STATES: Record<string, string> = {
  changed: "Changed",
  inconsistent: "In doubt",
  unobserved: "Not seen",
  unchanged: "Unchanged",
};

/** Say what a survey found, or why it says nothing; `job` is that which compares it. */
export function sayingOf(survey: SurveySummaryDocument, job?: JobDocument): Saying {
  if (survey.status === "running")
    return { tone: "running", short: runningWords(job), long: progressOf(job) };
  if (survey.status === "failed") return failedSaying(survey);
  if (survey.placement?.state === "in_doubt") {
    return {
      tone: "doubt",
      short: "in doubt",
      long:
        `It is in doubt where the scans stand (confidence ${percent(survey.placement.confidence)}), ` +
        "so nothing is said about change.",
      more: "Visit the place again, with pose priors or with scans that show more of what the map holds.",
    };
  }
  return readySaying(survey);
}

function failedSaying({ placement, problem }: SurveySummaryDocument): Saying {
  const long =
    placement?.state === "refused"
      ? "No scan could be placed on the map. This is not the same as no change: nothing was compared."
      : `The survey failed: ${problem?.title ?? "nobody said why"}. Nothing was compared.`;
  return {
    tone: "failed",
    short: placement?.state === "refused" ? "not registered" : "failed",
    long,
  };
}

function readySaying(survey: SurveySummaryDocument): Saying {
  const { changed = 0 } = survey.counts;
  const found = survey.objects ? sum(survey.objects) : changed;
  const moving = survey.moving
    ? ` ${count(survey.moving, "thing")} moved during the visit and ${survey.moving === 1 ? "is" : "are"} not counted.`
    : "";
  const more = `${coverage(survey.counts)}${moving}`.trim();
  if (!found && !changed) {
    const few = lowCoverage(survey.counts);
    const short = !judged(survey.counts)
      ? "nothing judged"
      : few
        ? "nothing changed in part"
        : "nothing changed";
    return {
      tone: judged(survey.counts) ? "quiet" : "doubt",
      short,
      long: nothingChanged(survey.counts),
      more: few ? more : moving.trim(),
    };
  }
  if (!found) {
    return {
      tone: "quiet",
      short: "no object",
      long: `No object changed, but ${count(changed, "tile")} did.`,
      more,
    };
  }
  const what = survey.objects
    ? `${count(found, "object")} changed: ${kinds(survey.objects)}.`
    : `${count(changed, "tile")} of ${whole(judged(survey.counts))} changed; this model tells tiles and no objects.`;
  return { tone: "changed", short: `${whole(found)} changed`, long: what, more };
}

/** Say that nothing changed, in how many tiles, and how many say nothing. */
export function nothingChanged(counts: Counts): string {
  const { unobserved = 0 } = counts;
  if (!judged(counts)) return "No tile was seen well enough to judge. Nothing is said about change.";
  const { inconsistent = 0 } = counts;
  const unseen = unobserved ? `; ${whole(unobserved)} ${unobserved === 1 ? "was" : "were"} not seen` : "";
  const doubted = inconsistent
    ? `; ${whole(inconsistent)} ${inconsistent === 1 ? "is" : "are"} in doubt`
    : "";
  return `Nothing changed in ${count(judged(counts), "judged tile")}${unseen}${doubted}.`;
}

/** Say how much of a map a survey saw; empty where it was all. */
export function coverage(counts: Counts): string {
  const { tiles = 0, unobserved = 0, inconsistent = 0 } = counts;
  const words: string[] = [];
  if (lowCoverage(counts)) {
    words.push(
      `${percent(unobserved / tiles)} of the map was not seen (${whole(unobserved)} of ${count(tiles, "tile")}): ` +
        "nothing is said about it.",
    );
  } else if (unobserved) {
    words.push(`${whole(unobserved)} of ${count(tiles, "tile")} not seen.`);
  }
  if (inconsistent)
    words.push(`${count(inconsistent, "tile")} in doubt: the registration there is not sure.`);
  return words.join(" ");
}

function lowCoverage({ tiles = 0, unobserved = 0 }: Counts): boolean {
  return unobserved >= tiles * 0.25 && unobserved > 0;
}

function judged(counts: Counts): number {
  return (counts["unchanged"] ?? 0) + (counts["changed"] ?? 0);
}

/** Tell whether a survey was compared with the map, so that a count of what changed says something. */
export function isCompared({ status, placement }: Pick<SurveySummaryDocument, "status" | "placement">): boolean {
  return status === "ready" && placement?.state !== "in_doubt";
}

/** List counts by kind: `2 appeared, 1 moved`. */
export function kinds(counts: Counts): string {
  const told = Object.entries(counts).filter(([, number]) => number);
  return told.map(([kind, number]) => `${whole(number)} ${kind.replaceAll("_", " ")}`).join(", ");
}

export function sum(counts: Counts): number {
  return Object.values(counts).reduce((total, number) => total + number, 0);
}

/** Say what the objects of a map are in short, those that count now first. */
export function objectsOf({ objects }: Pick<MapSummaryDocument, "objects">): string {
  const order = ["new", "still_there", "unknown", "gone_again", "accepted"];
  const told = order.filter((name) => objects[name]);
  return told.map((name) => `${whole(objects[name]!)} ${STATUSES[name]!.toLowerCase()}`).join(", ");
}

function runningWords(job?: JobDocument): string {
  if (!job) return "running";
  return job.queue_position ? `waits, ${ordinal(job.queue_position)}` : `${job.progress} %`;
}

/** Say how far a job is. */
export function progressOf(job?: JobDocument): string {
  if (!job) return "It is being compared with the map.";
  if (job.status === "failed") return `Failed: ${job.problem?.title ?? "nobody said why"}`;
  if (job.status === "dismissed") return "Stopped";
  if (job.status === "successful") return "Done";
  const stage = job.message || "waiting";
  if (job.queue_position === 1) return `${capital(stage)}, next in the queue`;
  if (job.queue_position) return `${capital(stage)}, number ${job.queue_position} in the queue`;
  return `${capital(stage)}, ${job.progress} %`;
}

export function capital(text: string): string {
  return text.charAt(0).toUpperCase() + text.slice(1);
}

/** Why a scan was left out or what is odd about it, and what to do; docs/reasons.md has the same list. */
export const REASONS: Record<string, [string, string]> = {
  unreadable: ["cannot be read", "write the file again"],
  damaged: ["looks like a damaged file", "send the scan as the sensor gave it"],
  too_few_points: ["too few points", "scan for longer"],
  degenerate: ["too few surfaces to tell where it stands", "scan where there are more surfaces, in more directions"],
  too_little_overlap: [
    "the map covers too little of it",
    "scan more of the mapped place, or extend the map first",
  ],
  no_fit: ["lies nowhere on the map", "check that it is the right map; give a pose prior"],
  other_place: ["another place", "check that it is the right map"],
  ambiguous: ["fits in two places or more", "give a pose prior, or scan more of the mapped place"],
  mirrored: [
    "its mirror image fits",
    "look for an axis that is turned round on the way from the sensor to the file",
  ],
  wrong_scale: ["too large or too small", "write metres; calibrate the sensor"],
  other_up_axis: ["another axis is up", "write the file with z up"],
  wrong_prior: ["the given pose is far off", "send the scan without a pose, or with a better one"],
  moved_while_scanning: ["the sensor moved", "stand still while a scan is taken"],
  disagrees: ["other scans contradict it", "scan there again"],
  wrong_units: ["not in metres", "write metres"],
  far_from_origin: ["kilometres from its origin", "subtract one offset from all scans of the place"],
  far_points: ["a few points far away were left out", "filter reflections"],
  missing_returns: ["most points are missing returns", "see that nothing covers the sensor"],
  odd_density: ["points on each other, or on a grid", "send each point once"],
  odd_size: ["an odd size for rooms", "write metres, with z up"],
  little_coverage: ["shows few surfaces or directions", "scan for longer, in more directions"],
  offset_taken_off: ["coordinates of a country's grid", "nothing: a round offset was taken off"],
  no_sensor_place: ["nothing tells where the sensor stood", "write the sensor's place into the file, or send PLY or PCD"],
  clock: ["its time cannot be right", "set the device's clock"],
};
