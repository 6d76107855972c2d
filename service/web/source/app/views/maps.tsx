/** The list of maps. */

import { h } from "preact";

import type { MapSummaryDocument, SurveySummaryDocument } from "../documents.ts";
import { ago, count, extent, instant, whole } from "../format.ts";
import { writePlace } from "../link.ts";
import { isOpen, jobOf, placeOf, type Latest, type State } from "../state.ts";
import { objectsOf, progressOf, sayingOf } from "../words.ts";
import { JobRow } from "./jobs.tsx";
import { follow, newUpload, type Props } from "./page.tsx";
import { Empty, Problem, Waiting } from "./parts.tsx";

export function MapsPage(props: Props) {
  const { app, state } = props;
  const { maps, jobs } = state;
  const others = jobs.filter(
    (job) => isOpen(job) && !job.survey_id && !maps.value?.some(({ job_id }) => job_id === job.jobID),
  );
  return (
    <main id="main" class="maps" tabIndex={-1}>
      <h1>Maps</h1>
      {maps.problem && <Problem problem={maps.problem} again={() => app.jobsChanged()} />}
      {!maps.value && maps.busy && <Waiting>Asking for the maps…</Waiting>}
      {maps.value?.length === 0 && (
        <Empty title="There is no map yet.">
          <p>A map is made of scans of a building as it is now. Later visits are compared with it.</p>
          <button class="primary" onClick={() => app.update({ upload: newUpload(null) })}>
            Make one from scans
          </button>
          <p class="faint">Or drop scans (PLY, PCD, E57, LAS, LAZ) anywhere on this page.</p>
        </Empty>
      )}
      <ul class="map-list">
        {maps.value?.map((map) => (
          <MapRow key={map.map_id} {...props} map={map} />
        ))}
      </ul>
      {others.map((job) => (
        <JobRow key={job.jobID} app={app} job={job} />
      ))}
    </main>
  );
}

function MapRow({ app, state, map }: Props & { map: MapSummaryDocument }) {
  const latest = state.latest[map.map_id];
  const { points = 0, scans = map.scan_count, accepted } = map.counts;
  return (
    <li>
      <a
        class="map-row"
        href={`#${writePlace(placeOf(map.map_id))}`}
        onClick={(event) => follow(event, () => app.open(map.map_id))}
      >
        <span class="map-name">
          <strong>{map.name ?? map.map_id}</strong>
          <span class={`badge badge-${map.status}`}>{statusOf(state, map)}</span>
          {map.name && <span class="faint">{map.map_id}</span>}
        </span>
        <span class="map-sizes">
          {[
            extent(map.bounds),
            points ? `${whole(points)} points` : "",
            accepted === undefined ? count(scans, "scan") : `${accepted} of ${count(scans, "scan")}`,
            `version ${map.version}`,
          ]
            .filter(Boolean)
            .join(" · ")}
        </span>
        <span class="map-latest">{latestOf(state, map, latest)}</span>
        <span class="map-objects">{objectsOf(map) && `Changed against the map: ${objectsOf(map)}`}</span>
      </a>
      {map.problem && <Problem problem={map.problem} />}
    </li>
  );
}

function statusOf(state: State, map: MapSummaryDocument): string {
  if (map.status !== "building") return map.status === "ready" ? "ready" : "failed";
  const job = jobOf(state, map.job_id);
  return job ? `building: ${progressOf(job).toLowerCase()}` : "building";
}

function latestOf(state: State, map: MapSummaryDocument, latest: Latest | undefined): string {
  if (map.status !== "ready") return "";
  if (latest === undefined) return "…";
  const { survey, result } = latest;
  if (survey === null) return "No survey yet: nothing has been compared with it.";
  const told = (one: SurveySummaryDocument) =>
    `${instant(one.captured_at)} (${ago(one.captured_at)}): ${sayingOf(one, jobOf(state, one.job_id)).short}`;
  const before = result && result !== survey ? `; last result ${told(result)}` : "";
  return `Last survey ${told(survey)}${before}`;
}
