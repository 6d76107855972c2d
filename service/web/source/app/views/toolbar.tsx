/** What lies over the scene: which clouds are shown, the section, tiles and the legend, how far loading is. */

import { Fragment, h } from "preact";

import { setFilters, toggled } from "../filters.ts";
import { height, heights, percent, whole } from "../format.ts";
import type { Place, Show } from "../link.ts";
import { focusOf, sectionOf, showOf, type LayerState } from "../state.ts";
import { TILE_STATES } from "../words.ts";
import { referenceVersion } from "../stage.ts";
import type { Props } from "./page.tsx";
import { closedByEscape, openSection, seesFilters } from "./panels.ts";
import { Kind } from "./parts.tsx";

const SHOWS: readonly (readonly [Show, string, string])[] = [
  ["reference", "Reference", "1"],
  ["survey", "Survey", "2"],
  ["both", "Both", "3"],
  ["split", "Split", "4"],
];
const KINDS = ["appeared", "disappeared", "moved"];
const STATES = ["changed", "inconsistent", "unobserved"];

export function Over(props: Props) {
  const { state } = props;
  const version = referenceVersion(state);
  return (
    <>
      <div class="over over-top">
        <Tools {...props} />
        <Chips {...props} />
        {showOf(state) === "split" && state.stage.survey.loaded && (
          <div class="split-words" aria-hidden="true">
            <span>Before</span>
            <span>After</span>
          </div>
        )}
        {state.sectionOpen && <Section {...props} />}
      </div>
      {version !== state.map.value?.version && (
        <p class="over reference-version">
          The reference is version {version}, which this survey was compared with; in use is{" "}
          {state.map.value?.version}.
        </p>
      )}
      <Loading {...props} />
      <Legend {...props} />
    </>
  );
}

/** Buttons for what the scene shows. */
function Tools({ app, stage, state }: Props) {
  const none = !focusOf(state) || focusOf(state)?.status !== "ready";
  return (
    <div class="tools">
      <div class="segments" role="group" aria-label="Clouds that are shown">
        {SHOWS.map(([show, word, key]) => (
          <button
            aria-pressed={showOf(state) === show}
            disabled={none && show !== "reference"}
            title={
              none && show !== "reference" ? "There is no survey with a result to show" : `${word} (${key})`
            }
            onClick={() => app.go({ show })}
          >
            {word}
          </button>
        ))}
      </div>
      <button title="Look from above (t)" onClick={() => stage.topDown()}>
        Top
      </button>
      <button
        id="section-button"
        aria-expanded={state.sectionOpen}
        title="Cut by height (x); c cuts the ceiling"
        onClick={() => app.update({ sectionOpen: !state.sectionOpen })}
      >
        Section
      </button>
    </div>
  );
}

/** What is cut and filtered while the panels that say so are closed; each goes by a press. */
function Chips({ app, state }: Props) {
  const { filters, section } = state.place;
  const chips: [string, Partial<Place>][] = [];
  if (section && !state.sectionOpen) chips.push([heights(section), { section: null }]);
  if (!seesFilters(state)) {
    for (const { words, without } of setFilters(filters))
      chips.push([words, { filters: { ...filters, ...without } }]);
  }
  if (!chips.length) return null;
  return (
    <div class="chips" role="group" aria-label="What is cut and filtered">
      {chips.map(([words, without]) => (
        <button
          key={words}
          aria-label={`${words}: take it away`}
          title={"section" in without ? "Show all heights but the ceiling" : "Do not filter by this"}
          onClick={() => app.go(without)}
        >
          {words} <span aria-hidden="true">✕</span>
        </button>
      ))}
    </div>
  );
}

/** Say what is loaded, and what could not be. */
function Loading({ state }: Props) {
  const { problem, reference, survey } = state.stage;
  const words = [
    problem,
    layerWords("the map's cloud", reference),
    layerWords("the survey's cloud", survey),
  ].filter(Boolean);
  if (!words.length) return null;
  return (
    <div class="over over-middle" role="status">
      {words.map((word) => (
        <p>{word}</p>
      ))}
    </div>
  );
}

function layerWords(name: string, { url, share, loaded, problem }: LayerState): string | null {
  if (problem) return `${name} cannot be shown: ${problem}`;
  return url && !loaded ? `Loading ${name}${share ? `, ${percent(share)}` : "…"}` : null;
}

function Section({ app, state }: Props) {
  const { extent, ceiling } = state.stage;
  const section = sectionOf(state);
  if (!extent || !section)
    return <div class="section">The heights are known once the cloud is loaded.</div>;
  const [low, high] = [extent.min[2], extent.max[2]];
  const set = (section: [number, number]) =>
    app.go({ section: section[1] - section[0] < 0.05 ? null : section });
  const slider = (name: string, value: number, change: (value: number) => void) => (
    <label>
      <span>
        {name} <output>{height(value)}</output>
      </span>
      <input
        type="range"
        aria-label={`${name}, metres`}
        aria-valuetext={height(value)}
        min={low}
        max={high}
        step={0.05}
        value={value}
        onInput={({ currentTarget }) => change(Number(currentTarget.value))}
      />
    </label>
  );
  return (
    <div
      class="section"
      role="group"
      aria-label="Section: heights that are shown"
      onKeyDown={(event) => closedByEscape(event, () => openSection(app, false))}
    >
      {slider("Up to", section[1], (value) => set([Math.min(section[0], value - 0.1), value]))}
      {slider("From", section[0], (value) => set([value, Math.max(section[1], value + 0.1)]))}
      <label class="check">
        <input
          type="checkbox"
          checked={state.place.section === null}
          disabled={ceiling === null}
          onChange={() => app.go({ section: state.place.section === null ? [low, high] : null })}
        />
        {ceiling === null ? "no ceiling was found" : `cut the ceiling, at ${height(ceiling)}`}
      </label>
    </div>
  );
}

function Legend({ app, state }: Props) {
  const { tiles } = state.place;
  const counts = focusOf(state)?.counts ?? {};
  return (
    <div class="over legend" role="group" aria-label="Legend, and tiles that are shown">
      {state.place.list === "objects" &&
        KINDS.map((kind) => (
          <span>
            <Kind kind={kind} /> {kind}
            {kind === "moved" && <Moved />}
          </span>
        ))}
      {STATES.map((name) => (
        <label
          class={counts[name] ? "" : "faint"}
          title={`tiles that are ${TILE_STATES[name]?.toLowerCase()}, as boxes`}
        >
          <input
            type="checkbox"
            checked={tiles.includes(name)}
            onChange={() => app.go({ tiles: STATES.filter((one) => toggled(tiles, name).includes(one)) })}
          />
          <i class={`swatch state-${name}`} aria-hidden="true" /> {TILE_STATES[name]?.toLowerCase()}{" "}
          {counts[name] !== undefined && whole(counts[name])}
        </label>
      ))}
    </div>
  );
}

/** The outlines of what moved, in words: dashed where it was, solid where it is. */
function Moved() {
  return (
    <>
      {" "}
      <i class="outline outline-from" aria-hidden="true" /> from <i class="outline" aria-hidden="true" /> to
    </>
  );
}
