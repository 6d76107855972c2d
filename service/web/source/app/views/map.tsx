/** One map: the scene, what lies over it, the panel beside it. */

import { h } from "preact";

import type { Tab } from "../link.ts";
import { chosenItem, jobOf, listedSurvey, shownItems } from "../state.ts";
import { isCompared } from "../words.ts";
import { Changes } from "./changes.tsx";
import { Details } from "./details.tsx";
import { OpenJobs, Retry } from "./jobs.tsx";
import { MapTab } from "./map_tab.tsx";
import type { Props } from "./page.tsx";
import { Empty, Problem, Waiting } from "./parts.tsx";
import { SurveyTab } from "./survey_tab.tsx";
import { Timeline } from "./timeline.tsx";
import { Over } from "./toolbar.tsx";

const TABS: readonly (readonly [Tab, string])[] = [
  ["changes", "Changes"],
  ["survey", "Survey"],
  ["map", "Map"],
];

export function MapPage(props: Props) {
  const { app, state, stage } = props;
  const { map } = state;
  if (!map.value) {
    return (
      <main id="main" class="maps" tabIndex={-1}>
        {map.problem ? (
          <Problem problem={map.problem} again={() => app.jobsChanged()} />
        ) : (
          <Waiting>Asking for the map…</Waiting>
        )}
        {map.problem && <a href="#">Back to the list of maps</a>}
      </main>
    );
  }
  if (map.value.status !== "ready") return <Unready {...props} />;
  const details = chosenItem(state) !== null || state.place.item !== null;
  return (
    <main id="main" class={`map panel-${state.panel} ${details ? "with-details" : ""}`} tabIndex={-1}>
      <Panel {...props} />
      <section class="stage" aria-label="3D view of the map">
        <div class="canvas" ref={stage.attach} />
        <Over {...props} />
      </section>
      <Timeline {...props} />
      {details && <Details {...props} />}
    </main>
  );
}

function Panel(props: Props) {
  const { app, state } = props;
  const { tab } = state.place;
  const listed = listedSurvey(state);
  const told = !listed || isCompared(listed) || shownItems(state).length > 0; // else nothing was counted
  return (
    <section class="panel" aria-label="Changes, survey and map">
      <button
        class="handle narrow-only"
        aria-expanded={state.panel !== "low"}
        onClick={() => app.update({ panel: nextPanel[state.panel] })}
      >
        <span aria-hidden="true" />
        {state.panel === "full" ? "Less" : state.panel === "low" ? "Show the list" : "More"}
      </button>
      <div class="tabs" role="tablist" aria-label="What the panel shows">
        {TABS.map(([name, word]) => (
          <button
            role="tab"
            id={`tab-${name}`}
            aria-selected={tab === name}
            aria-controls="panel-body"
            tabIndex={tab === name ? 0 : -1}
            onClick={() => app.go({ tab: name })}
            onKeyDown={(event) => stepTab(event, name, (to) => app.go({ tab: to }))}
          >
            {word}
            {name === "changes" && <span class="number">{told ? shownItems(state).length : "–"}</span>}
          </button>
        ))}
      </div>
      <div id="panel-body" class="panel-body" role="tabpanel" aria-labelledby={`tab-${tab}`}>
        {tab === "changes" && <Changes {...props} />}
        {tab === "survey" && <SurveyTab {...props} />}
        {tab === "map" && <MapTab {...props} />}
      </div>
      <OpenJobs app={app} state={state} />
    </section>
  );
}

const nextPanel = { low: "half", half: "full", full: "low" } as const;

/** Arrow keys lead from tab to tab, as the ARIA pattern for tabs has it. */
function stepTab(event: KeyboardEvent, tab: Tab, go: (tab: Tab) => void): void {
  const step = { ArrowRight: 1, ArrowLeft: -1 }[event.key];
  if (!step) return;
  event.preventDefault();
  event.stopPropagation();
  const at = TABS.findIndex(([name]) => name === tab);
  const [next] = TABS[(at + step + TABS.length) % TABS.length]!;
  go(next);
  document.getElementById(`tab-${next}`)?.focus();
}

/** A map that is being built, or could not be. */
function Unready({ app, state }: Props) {
  const map = state.map.value!;
  const job = jobOf(state, map.job_id);
  return (
    <main id="main" class="maps" tabIndex={-1}>
      {map.status === "building" ? (
        <Empty title="This map is being built.">
          {!job && <p>Its job waits.</p>}
          <p class="faint">The page goes on by itself when it is ready. It may be left meanwhile.</p>
        </Empty>
      ) : (
        <Empty title="This map could not be built.">
          {map.problem && <Problem problem={map.problem} />}
          <Retry app={app} jobId={map.job_id} />
        </Empty>
      )}
      {map.status === "building" ? <OpenJobs app={app} state={state} /> : <MapTab app={app} state={state} />}
    </main>
  );
}
