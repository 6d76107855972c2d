/** Jobs that wait, run or failed: how far each is, and what can be done about it. */

import { Fragment, h } from "preact";

import type { Controller } from "../controller.ts";
import type { JobDocument } from "../documents.ts";
import { isOpen, type State } from "../state.ts";
import { progressOf } from "../words.ts";
import { Problem } from "./parts.tsx";

const WORK: Record<string, string> = {
  map: "Building the map",
  survey: "Comparing a survey",
  model: "Training a model",
};

/** Show the jobs of the map that wait or run. */
export function OpenJobs({ app, state }: { app: Controller; state: State }) {
  const open = state.jobs.filter(isOpen);
  if (!open.length) return null;
  return (
    <section class="jobs" aria-label="Jobs that wait or run">
      {open.map((job) => (
        <JobRow key={job.jobID} app={app} job={job} />
      ))}
    </section>
  );
}

export function JobRow({ app, job }: { app: Controller; job: JobDocument }) {
  return (
    <div class="job">
      <div class="job-words">
        <strong>{WORK[job.processID] ?? job.processID}</strong>
        <span>{progressOf(job)}</span>
      </div>
      {isOpen(job) && (
        <div class="job-bar">
          <progress
            max={100}
            value={job.progress}
            aria-label={`${WORK[job.processID] ?? job.processID}: ${progressOf(job)}`}
          />
          <button class="small" onClick={() => stop(app, job)}>
            Stop
          </button>
        </div>
      )}
      {job.status === "failed" && job.problem && (
        <>
          <Problem problem={job.problem} />
          <Retry app={app} jobId={job.jobID} />
        </>
      )}
    </div>
  );
}

/** A button that runs a failed job again. */
export function Retry({ app, jobId }: { app: Controller; jobId: string }) {
  const act = () =>
    app.attempt(async () => {
      await app.api.send("POST", `jobs/${jobId}/retry`);
      app.tell("The job runs again.");
      app.jobsChanged();
    });
  return (
    <button
      onClick={() => void act()}
      title="Goes on with the step that failed, once what was wrong is mended"
    >
      Run it again
    </button>
  );
}

function stop(app: Controller, job: JobDocument): void {
  app.ask({
    title: "Stop this job?",
    text:
      `${WORK[job.processID] ?? job.processID} is at ${job.progress} %. ` +
      "Stopped, it cannot go on; its scans stay, so it can be asked for again.",
    yes: "Stop it",
    act: async () => {
      await app.api.send("DELETE", `jobs/${job.jobID}`);
      app.jobsChanged();
    },
  });
}
