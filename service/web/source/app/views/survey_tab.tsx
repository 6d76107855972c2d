/** One survey: what it found, how sure its placement is, what became of each scan, what can be done with it. */

import { Fragment, h } from "preact";

import type { SurveySummaryDocument } from "../documents.ts";
import { count, instant, percent, whole } from "../format.ts";
import { focusOf, isOpen, jobOf } from "../state.ts";
import { sayingOf, sum, TILE_STATES } from "../words.ts";
import { Retry } from "./jobs.tsx";
import type { Props } from "./page.tsx";
import { Download, Empty, Fact, Problem, Share, Waiting, Warnings } from "./parts.tsx";
import { Scans } from "./scans.tsx";

const STATES = ["unchanged", "changed", "inconsistent", "unobserved"] as const;

export function SurveyTab(props: Props) {
  const { app, state } = props;
  const focus = focusOf(state);
  if (!focus) {
    if (!state.surveys.value) return <Waiting>Asking for the surveys…</Waiting>;
    return (
      <Empty title={state.surveys.value.length ? "No survey has a result yet." : "No survey yet."}>
        <p>
          {state.surveys.value.length
            ? "Choose one on the timeline."
            : "Drop the scans of a visit on the page to add one."}
        </p>
      </Empty>
    );
  }
  const { tone, long, more } = sayingOf(focus, jobOf(state, focus.job_id));
  const job = jobOf(state, focus.job_id);
  const { value, problem } = state.survey;
  const failedAlone = focus.status === "failed" && focus.placement?.state !== "refused"; // else each scan says why
  return (
    <div class="about">
      <h2>
        {!state.place.survey && "Latest with a result: "}
        {instant(focus.captured_at)}
      </h2>
      <p class={`saying tone-${tone}`}>{long}</p>
      {failedAlone && focus.problem ? (
        <Problem problem={focus.problem} />
      ) : (
        more && focus.status === "ready" && <p>{more}</p>
      )}
      <Warnings warnings={focus.warnings} />
      <Tally survey={focus} />
      <dl class="facts">
        <Fact name="Placement" hint="how sure it is that the scans stand where they were taken">
          {focus.placement ? (
            <>
              {focus.placement.state.replace("_", " ")}{" "}
              {focus.placement.confidence !== null && (
                <Share value={focus.placement.confidence} label="Confidence of the placement" />
              )}
            </>
          ) : (
            "not told"
          )}
        </Fact>
        <Fact name="Device">{focus.device_id}</Fact>
        <Fact name="Compared">
          with version {focus.map_version}, by {focus.model}
          {focus.threshold !== null && `, threshold ${percent(focus.threshold)}`}
        </Fact>
        <Fact name="Moving">
          {focus.moving ? `${count(focus.moving, "thing")} during the visit, not counted` : null}
        </Fact>
        <Fact name="Id">
          <code>{focus.survey_id}</code>
        </Fact>
      </dl>
      <div class="row">
        {focus.status === "failed" && <Retry app={app} jobId={focus.job_id} />}
        {canBeTakenOver(focus) && (
          <button onClick={() => takeOver(props, focus)}>Take over into the map</button>
        )}
        {!(job && isOpen(job)) && <button onClick={() => remove(props, focus)}>Delete</button>}
      </div>
      {focus.status === "ready" && <Files app={app} survey={focus} />}
      {problem && <Problem problem={problem} />}
      {value ? (
        <Scans scans={value.scans} names={state.names} placing={focus.status === "running"} />
      ) : (
        !problem && <Waiting>Asking for its scans…</Waiting>
      )}
    </div>
  );
}

function Files({ app, survey }: { app: Props["app"]; survey: SurveySummaryDocument }) {
  const here = `surveys/${survey.survey_id}`;
  const files: [string, string][] = [
    ["cloud.ply", "PLY"],
    ["cloud.laz", "LAZ"],
    ["picture.png", "picture"],
    ["tiles", "tiles (GeoJSON)"],
  ];
  if (survey.objects) files.push(["objects", "objects"]);
  return (
    <p class="row">
      <span class="faint">Download</span>
      {files.map(([file, word]) => (
        <Download
          app={app}
          path={`${here}/${file}`}
          name={`${survey.survey_id}-${file}${file.includes(".") ? "" : ".geojson"}`}
        >
          {word}
        </Download>
      ))}
    </p>
  );
}

/** Show the tiles of a survey by state as one bar with its numbers. */
function Tally({ survey }: { survey: SurveySummaryDocument }) {
  const { counts } = survey;
  if (!counts["tiles"]) return null;
  const told = STATES.filter((state) => counts[state]);
  return (
    <figure class="tally">
      <div class="tally-bar" aria-hidden="true">
        {told.map((state) => (
          <span class={`state-${state}`} style={{ flexGrow: counts[state] ?? 0 }} />
        ))}
      </div>
      <figcaption>
        {told.map((state) => (
          <span>
            <i class={`swatch state-${state}`} aria-hidden="true" /> {whole(counts[state] ?? 0)}{" "}
            {TILE_STATES[state]?.toLowerCase()}
          </span>
        ))}
        <span class="faint">of {count(counts["tiles"] ?? 0, "tile")}</span>
      </figcaption>
    </figure>
  );
}

function canBeTakenOver(survey: SurveySummaryDocument): boolean {
  const found = survey.objects ? sum(survey.objects) : 0;
  return (
    survey.status === "ready" &&
    survey.placement?.state !== "in_doubt" &&
    (found > 0 || (survey.counts["changed"] ?? 0) > 0)
  );
}

function takeOver({ app }: Props, survey: SurveySummaryDocument): void {
  app.ask({
    title: "Take this survey over into the map?",
    text:
      "A new version of the map is built in which what this survey found is as it should be. " +
      `Its changed tiles (${survey.counts["changed"] ?? 0}) become the map's, its objects are accepted, and later ` +
      "surveys do not tell them again. The version in use stays in use until the new one is ready.",
    yes: "Take it over",
    act: async () => {
      await app.api.send("POST", `maps/${survey.map_id}/versions`, { survey_id: survey.survey_id });
      app.tell("The new version of the map is being built.");
      app.jobsChanged();
    },
  });
}

function remove({ app }: Props, survey: SurveySummaryDocument): void {
  app.ask({
    title: "Delete this survey?",
    text:
      `The survey of ${instant(survey.captured_at)} goes with its results; ` +
      "objects that it alone saw are told no more. Its scans stay.",
    yes: "Delete it",
    act: async () => {
      await app.api.send("DELETE", `surveys/${survey.survey_id}`);
      app.go({ survey: null, item: null });
      app.jobsChanged();
    },
  });
}
