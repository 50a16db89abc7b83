// The generated TypeScript client at work: node built/client.js SERVER SAMPLE. Posts, waits, fetches, and holds a figure against a bound.
import assert from "node:assert/strict";
import { readFile } from "node:fs/promises";
import createClient from "openapi-fetch";
import type { components, paths } from "./intarsia.js";

type Job = components["schemas"]["Job"];
type Submission = components["schemas"]["Submission"];

const [baseUrl, sample] = process.argv.slice(2) as [string, string];
const service = createClient<paths>({ baseUrl });
const model = new File([await readFile(sample)], "sample.glb", { type: "model/gltf-binary" });

// What is posted is a form or a model, and its serialiser is given either.
function form(body: unknown): FormData {
  const { model, files, options } = body as Submission;
  const form = new FormData();
  model.forEach(file => form.append("model", file));
  files?.forEach(file => form.append("files", file));
  if (options) form.append("options", new Blob([JSON.stringify(options)], { type: "application/json" }));
  return form;
}

async function finished(job: Job): Promise<Job> {
  while (job.state === "queued" || job.state === "running") {
    const { data } = await service.GET("/v1/jobs/{id}", { params: { path: { id: job.id }, header: { Prefer: "wait=30" } } });
    assert(data);
    job = data;
  }
  return job;
}

async function submitted(body: Submission): Promise<Job> {
  const { data, error } = await service.POST("/v1/jobs", { body, bodySerializer: form });
  if (error) throw new Error(`${error.code}: ${error.detail}`);
  // With `validate_only` there would be no job.
  if (!("id" in data)) throw new Error("nothing was submitted");
  return data;
}

// Post, wait, fetch.
const job = await finished(
  await submitted({
    model: [model],
    options: { recipe: [{ stage: "box_cutter", cuts: "edges" }, { stage: "pack" }], pack: { gutter: 8, rotation: "any" }, texture: { size: "keep_density" }, work_budget: 1000 },
  }),
);
assert.equal(job.state, "succeeded", job.error?.message);
const path = { id: job.id, name: "model.glb" };
const { data: glb } = await service.GET("/v1/jobs/{id}/artifacts/{name}", { params: { path }, parseAs: "arrayBuffer" });
assert(glb);
assert.equal(Buffer.from(glb).toString("latin1", 0, 4), "glTF");
assert.equal(glb.byteLength, job.artifacts.find(a => a.name === "model.glb")?.bytes);

// Gate on a figure of the report.
const { data: report } = await service.GET("/v1/jobs/{id}/artifacts/report.json", { params: { path: { id: job.id } } });
const efficiency = report?.model.after.packing_efficiency ?? 0;
assert(efficiency > 0.5, `packing efficiency ${efficiency}`);

// Gate by the service: the job fails, its artifacts are there.
const missed = await finished(await submitted({ model: [model], options: { require: { "atlas.packing_efficiency": { min: 1 } } } }));
assert.equal(missed.state, "failed");
assert.equal(missed.error?.code, "requirement_not_met");
assert.equal(missed.error?.failures[0]?.path, "atlas.packing_efficiency");
assert(missed.artifacts.length > 0);

// A raw model, with its recipe in the query.
const raw = await service.POST("/v1/jobs", {
  body: model,
  bodySerializer: (body: unknown) => body as Blob,
  headers: { "Content-Type": "model/gltf-binary" },
  params: { query: { recipe: "pack" } },
});
assert.equal(raw.response.status, 202);

// What is wrong is told.
const wrong = await service.POST("/v1/jobs", { body: { model: [model], options: { pack: { grid: 65 } } }, bodySerializer: form });
assert.equal(wrong.response.status, 422);
assert.equal(wrong.error?.errors[0]?.pointer, "/pack/grid");

// Events, read as they come.
const { data: events } = await service.GET("/v1/jobs/{id}/events", { params: { path: { id: job.id } }, parseAs: "text" });
assert(events?.includes("event: state"));

console.log(`TypeScript: packing efficiency ${efficiency.toFixed(3)}, ${glb.byteLength} bytes`);
