// What a dashboard asks, with types that openapi-typescript made of the OpenAPI document and openapi-fetch:
// the maps, a job until it has ended, and what changed. docs/clients.md says how `spicd.ts` is made.

import createClient from "openapi-fetch";
import type { components, paths } from "./spicd.js";

declare const process: { argv: string[]; env: Record<string, string | undefined> };

type Job = components["schemas"]["JobDocument"];

const [url, jobId] = process.argv.slice(2);
if (url === undefined || jobId === undefined) {
  throw new Error("node dashboard.js URL JOB");
}
const options = {
  baseUrl: url,
  headers: { Authorization: `Bearer ${process.env.SPICD_KEY ?? "none"}` },
};
// A client for JSON and one for features: some answers come in more than one media type.
const api = createClient<paths, "application/json" | "application/problem+json">(options);
const features = createClient<paths, "application/geo+json" | "application/problem+json">(options);

async function ended(id: string): Promise<Job> {
  for (;;) {
    const { data: job, error } = await api.GET("/jobs/{job_id}", {
      params: { path: { job_id: id }, query: { wait: 20 } },
    });
    if (error !== undefined) {
      throw new Error(error.detail);
    }
    if (job.status !== "accepted" && job.status !== "running") {
      return job;
    }
  }
}

async function changed(mapId: string): Promise<string[]> {
  const { data, error } = await features.GET("/maps/{map_id}/changes", {
    params: { path: { map_id: mapId }, query: { limit: 1000 } },
  });
  if (error !== undefined) {
    throw new Error(error.detail);
  }
  return data.features.map((change) => `${change.properties.tile_id} ${change.properties.state}`);
}

const job = await ended(jobId);
const { data: listed, error } = await api.GET("/maps");
if (error !== undefined) {
  throw new Error(error.detail);
}
const maps: Record<string, string[]> = {};
for (const map of listed.maps) {
  maps[map.map_id] = map.status === "ready" ? await changed(map.map_id) : [];
}
console.log(JSON.stringify({ job: job.status, maps }));
