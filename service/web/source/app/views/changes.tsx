/** The list of what changed, with its filters. */

import { Fragment, h } from "preact";

import { active, daysOf, filtered, filterWords, NO_FILTERS, PERIODS, periodWords, tally, toggled, wholeDay, withHigh, withLow, type Filters } from "../filters.ts";
import type { ProblemDocument, SurveySummaryDocument } from "../documents.ts";
import { ago, count, deviceWords, instant, percent } from "../format.ts";
import { whereOf, type Item } from "../items.ts";
import { plainOf } from "../problems.ts";
import { allItems, focusOf, jobOf, listedSurvey, sectionOf, shownItems, type State } from "../state.ts";
import { isCompared, KINDS, sayingOf, STATUSES, statusOf } from "../words.ts";
import { newUpload, type Props } from "./page.tsx";
import { closedByEscape, openFilters } from "./panels.ts";
import { Empty, Folded, Kind, Problem, Waiting } from "./parts.tsx";

const MOST_DAYS = 12; // of visits that are offered to filter by

export function Changes(props: Props) {
  const { app, state } = props;
  const { place } = state;
  const items = shownItems(state);
  const set = active(place.filters);
  return (
    <>
      <div class="list-head">
        <div class="segments" role="group" aria-label="What is listed">
          <button aria-pressed={place.list === "objects"} onClick={() => app.go({ list: "objects" })}>
            Objects
          </button>
          <button aria-pressed={place.list === "tiles"} onClick={() => app.go({ list: "tiles" })}>
            Tiles
          </button>
        </div>
        <button
          aria-expanded={state.filtersOpen}
          aria-controls="filters"
          id="filters-button"
          title="Filter by kind, time, place and more (/)"
          onClick={() => app.update({ filtersOpen: !state.filtersOpen })}
        >
          {set ? `Filters (${set})` : "Filters"}
        </button>
      </div>
      {state.filtersOpen && <FilterForm {...props} />}
      <p class="list-count" role="status" aria-live="polite">
        {words(state, items)}
      </p>
      <List {...props} items={items} />
    </>
  );
}

/** Say how many are listed, of which survey. */
function words(state: State, items: readonly Item[]): string {
  const { place } = state;
  const chosen = listedSurvey(state);
  if (chosen && !isCompared(chosen) && !items.length)
    return `${notCompared(chosen)}: the survey of ${instant(chosen.captured_at)}`;
  const all = allItems(state).length;
  const noun = place.list === "tiles" ? "changed tile" : "object";
  const number = items.length === all ? count(all, noun) : `${items.length} of ${count(all, noun)}`;
  const of = chosen ? `in the survey of ${instant(chosen.captured_at)}` : "over all surveys";
  return [`${number} ${of}`, filterWords(place.filters)].filter(Boolean).join(": ");
}

function notCompared({ status }: SurveySummaryDocument): string {
  if (status === "running") return "Not compared yet";
  return status === "failed" ? "Nothing was compared" : "Nothing is said about change";
}

function List({ app, state, items }: Props & { items: readonly Item[] }) {
  const source = sourceOf(state);
  if (source.problem) return <Problem problem={source.problem} again={() => app.jobsChanged()} />;
  if (!items.length)
    return source.value ? <NoItems app={app} state={state} /> : <NothingYet app={app} state={state} />;
  return (
    <ul
      class="items"
      id="items"
      role="listbox"
      aria-label="What changed"
      tabIndex={0}
      aria-activedescendant={state.place.item ? rowId(state.place.item) : undefined}
    >
      {items.map((item) => (
        <Row
          key={item.id}
          item={item}
          chosen={item.id === state.place.item}
          choose={() => app.go({ item: item.id, view: null })}
        />
      ))}
    </ul>
  );
}

function sourceOf({ place, changes, sightings, objects }: State) {
  if (place.list === "tiles") return changes;
  return place.survey ? sightings : objects;
}

export function rowId(item: string): string {
  return `item-${item.replace(/\W/g, "_")}`;
}

function Row({ item, chosen, choose }: { item: Item; chosen: boolean; choose: () => void }) {
  const faint = item.status === "gone_again" || item.status === "accepted";
  return (
    <li
      id={rowId(item.id)}
      role="option"
      aria-selected={chosen}
      class={`item ${faint ? "item-faint" : ""}`}
      onClick={choose}
    >
      <Kind kind={item.kind} />
      <span class="item-title">
        <strong>{KINDS[item.kind] ?? item.kind}</strong> {item.title}
      </span>
      <span class="item-score" title="probability of change">
        {percent(item.probability)}
      </span>
      <span class="item-more">
        {item.status && (
          <span class={`status status-${item.status}`}>{statusOf(item.status, item.kind)}</span>
        )}
        {item.history?.transient && <span class="status">comes and goes</span>}
        <span title={`change first seen ${ago(item.firstSeen)}`}>since {instant(item.firstSeen)}</span>
        {item.device && <span>{deviceWords(item.device)}</span>}
        <span>{whereOf(item)}</span>
      </span>
    </li>
  );
}

/** Nothing is listed: because of filters, because nothing changed, or because nothing could be said. */
function NoItems({ app, state }: Pick<Props, "app" | "state">) {
  if (allItems(state).length) {
    return (
      <Empty title="The filters hide everything.">
        <button onClick={() => app.go({ filters: NO_FILTERS })}>Clear the filters</button>
      </Empty>
    );
  }
  return <NothingYet app={app} state={state} />;
}

function NothingYet({ app, state }: Pick<Props, "app" | "state">) {
  const { place, surveys } = state;
  if (!surveys.value) return <Waiting>Asking for the surveys…</Waiting>;
  if (!surveys.value.length) {
    return (
      <Empty title="No survey yet.">
        <p>
          Nothing has been compared with this map. Drop the scans of a later visit anywhere on the page, or
          choose them:
        </p>
        <button class="primary" onClick={() => app.update({ upload: newUpload(place.map) })}>
          Add a survey
        </button>
      </Empty>
    );
  }
  if (sourceOf(state).busy) return <Waiting>Asking for what changed…</Waiting>;
  const survey = place.survey
    ? surveys.value.find(({ survey_id }) => survey_id === place.survey)
    : focusOf(state);
  if (!survey)
    return (
      <Empty title={place.survey ? "There is no such survey of this map." : "No survey has a result yet."} />
    );
  const { long, more } = sayingOf(survey, jobOf(state, survey.job_id));
  if (
    survey.status === "ready" &&
    !survey.objects &&
    place.list === "objects" &&
    survey.placement?.state !== "in_doubt"
  ) {
    return (
      <Empty title={`${survey.model} tells tiles, and no objects.`}>
        <button onClick={() => app.go({ list: "tiles" })}>List the changed tiles</button>
      </Empty>
    );
  }
  return (
    <Empty
      title={place.survey ? long : `The latest survey with a result, ${instant(survey.captured_at)}: ${long}`}
    >
      {more && <p>{more}</p>}
      {survey.problem && <Why problem={survey.problem} />}
      {survey.status === "failed" && (
        <button onClick={() => app.go({ survey: survey.survey_id, tab: "survey" })}>Why, scan by scan</button>
      )}
    </Empty>
  );
}

/** Say why a survey failed: plainly where that is known, with the service's own words folded beneath. */
function Why({ problem }: { problem: ProblemDocument }) {
  const [, ...reasons] = plainOf(problem) ?? ["", problem.detail];
  return (
    <>
      {reasons.map((line) => (
        <p>{line}</p>
      ))}
      {plainOf(problem) && <Folded>{problem.detail}</Folded>}
    </>
  );
}

function FilterForm({ app, state }: Props) {
  const { filters } = state.place;
  const all = allItems(state);
  const set = (change: Partial<Filters>) => app.go({ filters: { ...filters, ...change } });
  /** Count the values of all items among those that the other filters let through. */
  const counted = (name: "kind" | "status", open: Partial<Filters>) => {
    const rest = tally(filtered(all, { ...filters, ...open }, sectionOf(state)).map((item) => item[name]));
    return tally(all.map((item) => item[name])).map(([value]): [string, number] => [
      value,
      rest.find(([one]) => one === value)?.[1] ?? 0,
    ]);
  };
  const visits = daysOf((state.surveys.value ?? []).map(({ captured_at }) => captured_at)).slice(0, MOST_DAYS);
  const devices = tally((state.surveys.value ?? []).map(({ device_id }) => device_id)).map(([name]) => name);
  return (
    <form
      id="filters"
      class="filters"
      onSubmit={(event) => event.preventDefault()}
      onKeyDown={(event) => closedByEscape(event, () => openFilters(app, false))}
    >
      <Choices
        legend="Kind"
        chosen={filters.kinds}
        known={counted("kind", { kinds: [] })}
        word={(kind) => KINDS[kind] ?? kind}
        pick={(kinds) => set({ kinds })}
      />
      {state.place.list === "objects" && !state.place.survey && (
        <Choices
          legend="Status"
          chosen={filters.statuses}
          known={counted("status", { statuses: [] })}
          word={(status) => STATUSES[status] ?? status}
          pick={(statuses) => set({ statuses })}
        />
      )}
      <label>
        Change first seen
        <select
          value={isDay(filters.since) && !visits.includes(filters.since) ? "day" : filters.since}
          onChange={({ currentTarget }) =>
            set({ since: currentTarget.value === "day" ? otherDay(visits) : currentTarget.value })
          }
        >
          {PERIODS.map(([value]) => (
            <option value={value}>{periodWords(value)}</option>
          ))}
          {visits.map((day) => (
            <option value={day}>{periodWords(day)}, a visit</option>
          ))}
          <option value="day">since a day…</option>
        </select>
        {isDay(filters.since) && (
          <DayField name="Change first seen since" value={filters.since} set={(since) => set({ since })} />
        )}
      </label>
      {devices.length > 0 && (
        <label>
          Device
          <select
            value={filters.device}
            onChange={({ currentTarget }) => set({ device: currentTarget.value })}
          >
            <option value="">any</option>
            {devices.map((device) => (
              <option value={device}>{device}</option>
            ))}
          </select>
        </label>
      )}
      <label>
        Probability at least {percent(filters.minScore)}
        <input
          type="range"
          min={0}
          max={0.95}
          step={0.05}
          value={filters.minScore}
          onInput={({ currentTarget }) => set({ minScore: Number(currentTarget.value) })}
        />
      </label>
      <label class="check">
        <input
          type="checkbox"
          checked={filters.inSection}
          onChange={({ currentTarget }) => set({ inSection: currentTarget.checked })}
        />
        only at the heights that are shown, such as one floor
      </label>
      {filters.inSection && <Heights app={app} state={state} />}
      {active(filters) > 0 && (
        <button type="button" onClick={() => set(NO_FILTERS)}>
          Clear
        </button>
      )}
    </form>
  );
}

/** Fields for the heights that are shown; they are those of the section. */
function Heights({ app, state }: Pick<Props, "app" | "state">) {
  const section = sectionOf(state);
  if (!section) return <p class="faint">The heights are known once the cloud is loaded.</p>;
  const [low, high] = section;
  return (
    <span class="row">
      from
      <Height name="Heights from, metres" value={low} set={(to) => app.go({ section: withLow(section, to) })} />
      to
      <Height name="Heights to, metres" value={high} set={(to) => app.go({ section: withHigh(section, to) })} />m
    </span>
  );
}

/** A field for a height in metres, which counts once it is left or Enter is pressed. */
function Height({ name, value, set }: { name: string; value: number; set: (height: number) => void }) {
  const shown = (field: HTMLInputElement | null) => {
    if (field && field !== document.activeElement) field.value = value.toFixed(2);
  };
  const take = ({ currentTarget }: { currentTarget: HTMLInputElement }) => {
    if (Number.isFinite(currentTarget.valueAsNumber)) set(currentTarget.valueAsNumber);
  };
  return <input type="number" step="any" aria-label={name} ref={shown} onChange={take} />;
}

/** A field for a day, which nobody writes into while it has the focus: a day that is half typed is an empty value. */
function DayField({ name, value, set }: { name: string; value: string; set: (day: string) => void }) {
  const shown = (field: HTMLInputElement | null) => {
    if (field && field !== document.activeElement) field.value = value;
  };
  const take = ({ currentTarget }: { currentTarget: HTMLInputElement }) => {
    const day = wholeDay(currentTarget.value);
    if (day && day !== value) set(day);
  };
  const leave = ({ currentTarget }: { currentTarget: HTMLInputElement }) => {
    currentTarget.value = wholeDay(currentTarget.value) ?? value;
  };
  return <input type="date" min="1900-01-01" aria-label={name} ref={shown} onChange={take} onBlur={leave} />;
}

interface ChoicesProps {
  legend: string;
  chosen: string[];
  known: [string, number][];
  word: (value: string) => string;
  pick: (values: string[]) => void;
}

function Choices({ legend, chosen, known, word, pick }: ChoicesProps) {
  const missing = chosen
    .filter((value) => !known.some(([name]) => name === value))
    .map((value): [string, number] => [value, 0]);
  return (
    <fieldset class="choices">
      <legend>{legend}</legend>
      {[...known, ...missing].map(([value, number]) => (
        <label class="choice">
          <input
            type="checkbox"
            checked={chosen.includes(value)}
            onChange={() => pick(toggled(chosen, value))}
          />
          {word(value)} <span class="number">{number}</span>
        </label>
      ))}
    </fieldset>
  );
}

function isDay(since: string): boolean {
  return /^\d{4}-/.test(since);
}

/** Return the day that a day field begins with: today, or the day before where today is a visit's. */
function otherDay(visits: readonly string[]): string {
  const days = [0, 1].map((back) => new Date(Date.now() - back * 86_400_000).toISOString());
  return daysOf(days).find((day) => !visits.includes(day)) ?? daysOf(days)[0]!;
}
