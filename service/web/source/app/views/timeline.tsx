/** The surveys of a map in the order in which they were captured, and what each found. */

import { h } from "preact";

import type { SurveySummaryDocument } from "../documents.ts";
import { count, deviceWords, instant } from "../format.ts";
import { focusOf, jobOf, type State } from "../state.ts";
import { sayingOf } from "../words.ts";
import type { Props } from "./page.tsx";
import { Problem } from "./parts.tsx";

const DAY_MS = 86_400_000;

export function Timeline({ app, state }: Props) {
  const { surveys, place } = state;
  const list = surveys.value ?? [];
  if (surveys.problem)
    return (
      <nav class="timeline">
        <Problem problem={surveys.problem} />
      </nav>
    );
  return (
    <nav class="timeline" aria-label="Surveys by the time they were captured">
      <button
        class="visit visit-all"
        aria-pressed={place.survey === null}
        onClick={() => app.go({ survey: null, item: null })}
      >
        <strong>All surveys</strong>
        <span>{surveys.value ? count(list.length, "survey") : "asking…"}</span>
      </button>
      <ol ref={(list) => watchEdges(list)} onScroll={({ currentTarget }) => tellEdges(currentTarget)}>
        {list.map((survey, n) => (
          <Visit
            key={survey.survey_id}
            state={state}
            survey={survey}
            before={list[n - 1]}
            choose={() => choose(survey)}
          />
        ))}
      </ol>
    </nav>
  );

  function choose(survey: SurveySummaryDocument): void {
    const again = survey.survey_id === place.survey;
    const tab = survey.status === "ready" ? place.tab : "survey";
    app.go({ survey: again ? null : survey.survey_id, item: null, tab: again ? place.tab : tab });
  }
}

interface VisitProps {
  state: State;
  survey: SurveySummaryDocument;
  before: SurveySummaryDocument | undefined;
  choose: () => void;
}

function Visit({ state, survey, before, choose }: VisitProps) {
  const { tone, short, long } = sayingOf(survey, jobOf(state, survey.job_id));
  const gap = before ? Date.parse(survey.captured_at) - Date.parse(before.captured_at) : 0;
  const chosen = survey.survey_id === state.place.survey;
  const title = survey.device_id ? `${long} By ${deviceWords(survey.device_id)}.` : long;
  const inFocus = survey.survey_id === focusOf(state)?.survey_id;
  return (
    <li>
      {gap > 1.5 * DAY_MS && <span class="gap">{Math.round(gap / DAY_MS)} days</span>}
      <button
        class={`visit tone-${tone} ${inFocus ? "in-focus" : ""}`}
        id={`visit-${survey.survey_id}`}
        aria-pressed={chosen}
        title={title}
        ref={(element) => intoSight(element, chosen || inFocus)}
        onClick={choose}
      >
        <strong>{instant(survey.captured_at)}</strong>
        <span>{short}</span>
      </button>
    </li>
  );
}

const watched = new WeakSet<Element>();

/** Fade the ends of a list beyond which there is more, now and whenever its size is another. */
function watchEdges(list: HTMLElement | null): void {
  if (!list) return;
  tellEdges(list);
  if (watched.has(list)) return;
  watched.add(list);
  new ResizeObserver(() => tellEdges(list)).observe(list);
}

function tellEdges(list: HTMLElement): void {
  const { scrollLeft, scrollWidth, clientWidth } = list;
  list.classList.toggle("more-before", scrollLeft > 2);
  list.classList.toggle("more-after", scrollLeft + clientWidth < scrollWidth - 2);
}

const inSight = new WeakSet<Element>();

/** Scroll to a survey when it becomes the one that is compared, and not again. */
function intoSight(element: HTMLElement | null, chosen: boolean): void {
  if (!element) return;
  if (chosen && !inSight.has(element)) element.scrollIntoView({ block: "nearest", inline: "nearest" });
  if (chosen) inSight.add(element);
  else inSight.delete(element);
}

/** Return the survey before or after the chosen one. */
export function neighbour(state: State, step: 1 | -1): string | null {
  const list = state.surveys.value ?? [];
  const at = list.findIndex(
    ({ survey_id }) => survey_id === (state.place.survey ?? focusOf(state)?.survey_id),
  );
  if (state.place.survey === null) return list[at]?.survey_id ?? null;
  return list[at + step]?.survey_id ?? state.place.survey;
}
