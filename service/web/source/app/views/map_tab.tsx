/** The map itself: its size, versions, and how well its scans were registered. */

import { h } from "preact";

import { count, extent, instant, whole } from "../format.ts";
import type { Props } from "./page.tsx";
import { Fact, Problem } from "./parts.tsx";
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
      {map.status === "ready" && (
        <div class="row">
          <a href={`maps/${map.map_id}/cloud.ply`} onClick={(event) => state.hasKey && download(event, app, map.map_id)}>
            Download the cloud (PLY)
          </a>
        </div>
      )}
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
            <strong>{version}</strong> {status}, {instant(created)}, {survey_id ? "takes a survey over" : "made of scans"}
            {problem && <Problem problem={problem} />}
          </li>
        ))}
      </ul>
    </section>
  );
}

/** Fetch a file with the key, which a plain link cannot bring, and hand it to the browser. */
function download(event: Event, app: Props["app"], map: string): void {
  event.preventDefault();
  void app.attempt(async () => {
    const answer = await app.api.fetch(`maps/${map}/cloud.ply`);
    const link = document.createElement("a");
    link.href = URL.createObjectURL(await answer.blob());
    link.download = `${map}.ply`;
    link.click();
    URL.revokeObjectURL(link.href);
  });
}
