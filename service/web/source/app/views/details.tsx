/** What is known of the chosen object or tile, and what speaks for it. */

import { Fragment, h } from "preact";

import type { SightingProperties, TileProperties } from "../documents.ts";
import { ago, count, deviceWords, instant, metres, percent } from "../format.ts";
import { whereOf, type Item } from "../items.ts";
import type { Show } from "../link.ts";
import { lookedAt } from "../stage.ts";
import { focusOf, showOf, type Look } from "../state.ts";
import { KINDS, statusOf, TILE_STATES, whyStatus } from "../words.ts";
import { follow, type Props } from "./page.tsx";
import { Empty, Fact, Kind, Meanings, Problem, Share, Waiting } from "./parts.tsx";

/** Share of a place that a survey has to see to say that something is gone (service/catalog/tracking.py). */
const ENOUGH = 0.5;

export function Details(props: Props) {
  const { app, state } = props;
  const item = lookedAt(state);
  const known = state.objects.value ?? state.changes.value;
  const close = () => app.go({ item: null });
  return (
    <aside class="details" aria-label="Details of what is chosen">
      <div class="details-head">
        {item && (item.kind in TILE_STATES ? <i class={`swatch state-${item.kind}`} /> : <Kind kind={item.kind} />)}
        <h2>{item ? (KINDS[item.kind] ?? TILE_STATES[item.kind] ?? item.kind) : "Details"}</h2>
        <button aria-label="Close the details" title="Close (Esc)" onClick={close}>
          ✕
        </button>
      </div>
      {item ? <About {...props} item={item} /> : known ? <Missing /> : <Waiting>Asking for it…</Waiting>}
    </aside>
  );
}

function Missing() {
  return (
    <Empty title="It is not told any more.">
      <p>No survey that is kept sees it, or it turned out to be part of something else.</p>
    </Empty>
  );
}

const SHOWS: readonly (readonly [Show, string])[] = [
  ["split", "Before | after"],
  ["reference", "Before"],
  ["survey", "After"],
];

function About(props: Props & { item: Item }) {
  const { app, stage, state, item } = props;
  return (
    <>
      <p class="lead">
        {item.title}
        <br />
        <span class="faint">{whereOf(item)}</span>
      </p>
      <div class="segments" role="group" aria-label="Points before and after">
        {SHOWS.map(([show, word]) => (
          <button aria-pressed={showOf(state) === show} onClick={() => app.go({ show })}>
            {word}
          </button>
        ))}
        <button title="Fly to it again (f)" onClick={() => stage.lookAtItem()}>
          Look
        </button>
      </div>
      {(!item.tile || item.tile.state === "changed") && <Doubts item={item} />}
      {item.tile ? <AboutTile app={app} tile={item.tile} /> : <AboutObject {...props} />}
      {item.sighting && <Tiles {...props} item={item} />}
      {item.what === "object" && <History {...props} item={item} />}
    </>
  );
}

/** Say what is not sure about it. */
function Doubts({ item }: { item: Item }) {
  const { history, sighting } = item;
  const words: string[] = [];
  if (item.probability < 0.7)
    words.push(`Not sure: the probability that something changed is ${percent(item.probability)}.`);
  const share = sighting?.observed_share ?? item.tile?.observed_share;
  if (share != null && share < ENOUGH)
    words.push(`Only ${percent(share)} of it could be judged, so its size and shape may be others.`);
  if (sighting?.scans_seen_through === 0)
    words.push("No scan of the other visit saw through where it is; it may have been hidden there.");
  if (history?.status === "unknown")
    words.push(
      "The latest survey that could be compared did not look there. " +
        `It was ${statusOf(history.last_known, item.kind).toLowerCase()} ` +
        `when one looked last, ${instant(history.last_looked)}.`,
    );
  if (history?.transient) words.push("It comes and goes: it was seen, gone, and seen again.");
  if (!words.length) return null;
  return (
    <ul class="doubts">
      {words.map((word) => (
        <li>{word}</li>
      ))}
    </ul>
  );
}

function AboutObject({ app, item }: Props & { item: Item }) {
  const { history, sighting, place } = item;
  const seen = sighting as SightingProperties;
  const { motion } = seen;
  return (
    <dl class="facts">
      {item.status && (
        <Fact name="Status">
          <strong>{statusOf(item.status, item.kind)}</strong>:{" "}
          {whyStatus(item.status, item.kind, history?.last_looked ?? item.lastSeen)}
        </Fact>
      )}
      <Fact name="Probability" hint="of change, mean over its voxels">
        <Share value={seen.probability} label="Probability of change" />
      </Fact>
      <Fact name="Judged" hint="share of it that both visits could judge">
        <Share value={seen.observed_share} label="Share that both visits could judge" />
      </Fact>
      <Fact name="Seen past" hint="scans of the other visit whose rays went through where it is">
        by {count(seen.scans_seen_through, "scan")} of the {item.kind === "disappeared" ? "survey" : "map"}
      </Fact>
      {motion && (
        <Fact name="Moved">
          by {metres(Math.hypot(...motion.translation))}
          {motion.yaw_degrees !== null && Math.abs(motion.yaw_degrees) >= 5
            ? `, turned by ${Math.abs(motion.yaw_degrees).toFixed(0)}°`
            : ""}
        </Fact>
      )}
      <Fact name="Change first seen">
        {instant(item.firstSeen)} ({ago(item.firstSeen)})
      </Fact>
      {history && (
        <Fact name="Change last seen">
          {instant(history.last_seen)}, in {count(history.sightings, "survey")}
        </Fact>
      )}
      {history && <Fact name="Looked at last">{instant(history.last_looked)}</Fact>}
      {history?.accepted_in_version && (
        <Fact name="Taken over">by version {history.accepted_in_version} of the map</Fact>
      )}
      <Fact name="Volume">
        {place && `${(place.volume * 1000).toFixed(0)} litres, ${place.points} points`}
      </Fact>
      <Fact name="Survey">
        <SurveyLink app={app} id={item.surveyId}>
          {instant(seen.captured_at)}
        </SurveyLink>
        {seen.device_id && `, ${deviceWords(seen.device_id)}`}
      </Fact>
      <Fact name="Compared">
        with version {seen.map_version}, by {seen.model}
      </Fact>
    </dl>
  );
}

function SurveyLink({ app, id, children }: { app: Props["app"]; id: string; children: string }) {
  const { place } = app.state;
  const go = () => app.go({ survey: id, tab: "survey" });
  return (
    <a href={`#map=${place.map}&survey=${id}`} onClick={(event) => follow(event, go)}>
      {children}
    </a>
  );
}

/** What the latest survey that judged a tile says of it; of a changed tile also since when. */
function AboutTile({ app, tile }: { app: Props["app"]; tile: TileProperties }) {
  return (
    <dl class="facts">
      <Fact name="State">{TILE_STATES[tile.state] ?? tile.state}</Fact>
      <Fact name="Survey">
        <SurveyLink app={app} id={tile.survey_id}>
          {instant(tile.captured_at)}
        </SurveyLink>
      </Fact>
      {tile.score !== null && (
        <Fact name="Score" hint="probability of change, as this survey has it">
          <Share value={tile.score} label="Probability of change" />
        </Fact>
      )}
      {tile.max_score !== null && tile.max_score !== tile.score && (
        <Fact name="Highest" hint="score over all surveys, which the list shows">
          <Share value={tile.max_score} label="Highest probability of change over all surveys" /> over all surveys
        </Fact>
      )}
      <Fact name="Threshold">
        {tile.threshold === null ? null : `${percent(tile.threshold)}: changed above it`}
      </Fact>
      <Fact name="Seen" hint="share of the tile that the survey could judge">
        <Share value={tile.observed_share} label="Share that the survey could judge" />
      </Fact>
      <Fact name="Voxels">
        {tile.appeared === null ? null : `${tile.appeared} appeared, ${tile.disappeared ?? 0} disappeared`}
      </Fact>
      <Fact name="Points">
        {tile.n_reference} of the map, {tile.n_current} of the survey
      </Fact>
      <Fact name="Change first seen">
        {tile.first_seen && `${instant(tile.first_seen)} (${ago(tile.first_seen)})`}
      </Fact>
      <Fact name="Change last seen">{tile.last_seen && instant(tile.last_seen)}</Fact>
      <Fact name="Device">{tile.device_id}</Fact>
      <Fact name="Tile">{tile.tile_id}</Fact>
    </dl>
  );
}

const TILE_COLUMNS: readonly (readonly [string, string])[] = [
  ["Score", "probability that something in the tile changed"],
  ["Seen", "share of the tile that the survey could judge"],
  ["+", "voxels that appeared"],
  ["−", "voxels that disappeared"],
];

/** The tiles that an object lies in, as the latest survey which saw it tells them. */
function Tiles({ app, state, item }: Props & { item: Item }) {
  const { value } = state.looks;
  if (value?.id !== item.id) return null;
  return (
    <section>
      <h3>In {count(value.tiles.length, "tile")}</h3>
      <table>
        <thead>
          <tr>
            <th>Tile</th>
            {TILE_COLUMNS.map(([word, meaning]) => (
              <th title={meaning}>{word}</th>
            ))}
          </tr>
        </thead>
        <tbody>
          {value.tiles.map((tile) => (
            <TileRow
              key={tile.tile_id}
              tile={tile}
              show={() => app.go({ list: "tiles", item: `tile:${tile.tile_id}` })}
            />
          ))}
        </tbody>
      </table>
      <Meanings of={TILE_COLUMNS} />
    </section>
  );
}

function TileRow({ tile, show }: { tile: TileProperties; show: () => void }) {
  const name = tile.tile_id.replace("tile_", "").replaceAll("_", " ");
  return (
    <tr title={TILE_STATES[tile.state]}>
      <td>
        <i class={`swatch state-${tile.state}`} />{" "}
        {tile.state === "changed" ? (
          <button class="as-link" onClick={show}>
            {name}
          </button>
        ) : (
          name
        )}
      </td>
      <td>{tile.score === null ? "none" : percent(tile.score)}</td>
      <td>{tile.observed_share === null ? "not told" : percent(tile.observed_share)}</td>
      <td>{tile.appeared ?? ""}</td>
      <td>{tile.disappeared ?? ""}</td>
    </tr>
  );
}

/** From visit to visit: who saw it, who looked and did not, who did not look. */
function History({ app, state, item }: Props & { item: Item }) {
  const { value, problem } = state.looks;
  if (problem) return <Problem problem={problem} />;
  if (!value || value.id !== item.id) return <Waiting>Asking for its history…</Waiting>;
  const rows = [
    ...value.history.sightings.map(({ properties: seen }) => ({
      at: seen.captured_at,
      survey: seen.survey_id,
      seen: true,
      text: sawIt(seen),
    })),
    ...value.looks.map((look) => ({
      at: look.survey.captured_at,
      survey: look.survey.survey_id,
      seen: false,
      text: lookedThere(look, item.kind),
    })),
  ].sort((one, other) => Date.parse(one.at) - Date.parse(other.at));
  return (
    <section>
      <h3>From visit to visit</h3>
      <ol class="history">
        {rows.map((row) => (
          <li class={row.seen ? "saw" : "saw-not"} aria-current={row.survey === focusOf(state)?.survey_id}>
            <SurveyLink app={app} id={row.survey}>
              {instant(row.at)}
            </SurveyLink>
            <span>{row.text}</span>
          </li>
        ))}
      </ol>
    </section>
  );
}

function sawIt(seen: SightingProperties): string {
  const device = seen.device_id && deviceWords(seen.device_id);
  const words = [(KINDS[seen.kind] ?? seen.kind).toLowerCase(), percent(seen.probability), device];
  return words.filter(Boolean).join(", ");
}

function lookedThere({ share }: Look, kind: string): string {
  if (share === null) return "did not tell it";
  const found = kind === "appeared" ? "it was not there" : "it was as in the map";
  return share >= ENOUGH
    ? `saw ${percent(share)} of its place: ${found}`
    : `did not look there: saw ${percent(share)} of its place`;
}
