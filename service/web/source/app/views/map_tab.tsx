/** The map itself: its size, versions, and how well its scans were registered. */

import { h } from "preact";

import type { MapDocument } from "../documents.ts";
import { count, extent, instant, whole } from "../format.ts";
import type { Props } from "./page.tsx";
import { Download, Fact, Problem } from "./parts.tsx";
import { Scans } from "./scans.tsx";

export function MapTab({ app, state }: Pick<Props, "app" | "state">) {
  const map = state.map.value!;
  const { points = 0, tiles = 0 } = map.counts;
  return (
    <div class="about">
      <h2>{map.name ?? map.map_id}</h2>
      <dl class="facts">
        <Fact name="Size">{extent(map.bounds)}</Fact>
        <Fact name="Points">{points ? `${whole(points)} in ${count(tiles, "tile")}` : null}</Fact>
        <Fact name="Version">
          {map.version}, built {instant(map.updated)}
        </Fact>
        <Fact name="Model">{map.model}</Fact>
        <Fact name="Id">
          <code>{map.map_id}</code>
        </Fact>
      </dl>
      <div class="row">
        {map.status === "ready" && (
          <Download app={app} path={`maps/${map.map_id}/cloud.ply`} name={`${map.map_id}.ply`}>
            Cloud (PLY)
          </Download>
        )}
        <button onClick={() => remove({ app }, map)}>Delete the map</button>
      </div>
      <Versions state={state} />
      <Scans scans={map.scans} names={state.names} placing={map.status === "building"} />
    </div>
  );
}

function Versions({ state }: Pick<Props, "state">) {
  const versions = state.versions.value ?? [];
  if (state.versions.problem) return <Problem problem={state.versions.problem} />;
  if (versions.length < 2 && versions.every(({ status }) => status === "ready")) return null;
  return (
    <section>
      <h3>Versions</h3>
      <ul class="versions">
        {versions.map(({ version, status, survey_id, created, problem }) => (
          <li>
            <strong>{version}</strong> {status}, {instant(created)},{" "}
            {survey_id ? "takes a survey over" : "made of scans"}
            {problem && <Problem problem={problem} />}
          </li>
        ))}
      </ul>
    </section>
  );
}

function remove({ app }: Pick<Props, "app">, map: MapDocument): void {
  app.ask({
    title: "Delete this map?",
    text:
      `${map.name ?? map.map_id} goes with its versions, its surveys and what they found. ` +
      "Its scans stay. This cannot be undone.",
    yes: "Delete it",
    act: async () => {
      await app.api.send("DELETE", `maps/${map.map_id}`);
      app.open(null);
    },
  });
}
