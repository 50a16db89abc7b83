// What a job came to: one sentence, a handful of figures, warnings, requirements that were missed.

import { bytes, count, h, megapixels, percent, significant } from "./dom.js";

/** Figures of the model: path in the report, name, how it reads, and whether more (1) or less (-1) of it is better. */
const FIGURES = [
  ["packing_efficiency", "Packing efficiency", percent, 1, "Area of the charts over that of the box about them"],
  ["charts", "Charts", count, -1, "Pieces that the surface is cut into"],
  ["seam_length", "Seam length", significant, -1, "3D length of all seams, over the square root of surface area / π"],
  ["texture_pixels", "Texture pixels", megapixels, -1, "Over all textures"],
  ["texture_bytes", "Texture files", bytes, -1, "Bytes of the textures on disk"],
  ["gpu_bytes", "GPU memory", bytes, -1, "Uncompressed RGBA with mip levels"],
];

/** Relative changes smaller than this are none. */
const SAME = 0.0005;

/** `{relative, better}`: better is 1, -1 or 0. */
export function change(before, after, direction) {
  if (before === null || after === null || before === undefined || after === undefined) return null;
  const relative = before === 0 ? (after === 0 ? 0 : Infinity) : after / before - 1;
  return { relative, better: Math.abs(relative) < SAME ? 0 : Math.sign(relative) * direction };
}

const signed = (relative) => (!Number.isFinite(relative) ? "new" : Math.abs(relative) < SAME ? "unchanged" : `${relative > 0 ? "+" : "−"}${percent(Math.abs(relative))}`);

/** The worst fidelity of all textures. */
export function fidelity(report) {
  const all = report.textures ?? [], known = all.map((t) => t.psnr_db).filter((v) => v !== null && v !== undefined);
  const angles = all.map((t) => t.angle_p95_deg).filter((v) => v !== null && v !== undefined);
  return { exact: all.length > 0 && all.every((t) => t.exact), psnr: known.length ? Math.min(...known) : null, angle: angles.length ? Math.max(...angles) : null, any: all.length > 0 };
}

/** One sentence. */
export function sentence(report, job) {
  const { before: b, after: a } = report.model;
  if (job?.error?.code === "requirement_not_met") {
    const n = job.error.failures?.length ?? 0;
    return n ? `The model was refined, but misses ${n === 1 ? "a requirement" : `${n} requirements`}.` : "The model was refined, but a warning fails the job.";
  }
  if (report.outcome === "nothing_to_refine") return "There was nothing to refine: the model is as it came.";
  if (report.outcome === "kept_input") return "The model is as it came: no layout was found that is better.";
  const said = [];
  const pixels = change(b.texture_pixels, a.texture_pixels, -1), charts = change(b.charts, a.charts, -1), packing = change(b.packing_efficiency, a.packing_efficiency, 1);
  if (pixels?.better > 0) said.push(`its textures need ${percent(-pixels.relative, 0)} fewer pixels`);
  if (pixels?.better < 0) said.push(`its textures need ${percent(pixels.relative, 0)} more pixels`);
  if (charts?.better) said.push(`${count(b.charts)} charts became ${count(a.charts)}`);
  if (packing?.better && said.length < 2) said.push(`charts cover ${percent(a.packing_efficiency, 0)} of their box instead of ${percent(b.packing_efficiency, 0)}`);
  const f = fidelity(report);
  if (f.exact) said.push("and no colour changed");
  else if (f.psnr !== null && f.psnr >= 40) said.push("and colours look the same");
  else if (f.psnr !== null) said.push("and colours changed a little");
  const start = report.outcome === "partly_refined" ? "Partly refined: " : "Refined: ";
  return said.length ? `${start}${said.join(", ").replace(/, and/, " and")}.` : `${start}the layout is another, its figures are the same.`;
}

function figure(name, title, path, before, after, told) {
  return h("div", { className: "figure", title }, h("dt", {}, name),
    h("dd", {}, h("div", { className: "after", "data-path": `after.${path}`, "data-value": String(after) }, told.after), h("div", { className: "before", "data-path": `before.${path}`, "data-value": String(before) }, told.before), told.change));
}

/** The verdict as a section; `job` is null in a file of its own. */
export function buildVerdict(report, job, downloads) {
  const { before, after } = report.model;
  const figures = FIGURES.map(([path, name, told, direction, title]) => {
    const [b, a] = [before[path], after[path]];
    if ((b ?? null) === null && (a ?? null) === null) return null;
    const c = change(b, a, direction), read = (v) => (v === null || v === undefined ? "–" : told(v));
    const mark = c && h("span", { className: `change ${c.better > 0 ? "good" : c.better < 0 ? "bad" : ""}` }, signed(c.relative), c.better < 0 ? " · worse" : "");
    return figure(name, title, path, b, a, { after: read(a), before: `before: ${read(b)}`, change: mark });
  });
  const f = fidelity(report);
  if (f.any) {
    const told = f.exact ? "Exact" : f.psnr === null ? `${significant(f.angle ?? 0, 2)}°` : `${significant(f.psnr)} dB`;
    const what = f.exact ? "every colour as uploaded" : f.psnr === null ? "95 % of directions are closer" : "PSNR of the worst texture";
    figures.push(figure("Fidelity", "Colours on the surface, uploaded against delivered", "psnr_db", null, f.psnr, { after: told, before: what, change: null }));
  }
  const failures = job?.error?.failures ?? [];
  const missed = job?.error && h("div", { className: "note bad", role: "group", "aria-label": "Requirements that were missed" }, h("strong", { className: "lead" }, failures.length ? "Requirements that were missed" : "The job failed"),
    h("p", {}, job.error.message), failures.length ? h("div", { className: "scroll", tabIndex: 0, role: "region", "aria-label": "Requirements" }, h("table", { className: "failures" }, h("thead", {}, h("tr", {}, h("th", {}, "Figure"), h("th", {}, "Wanted"), h("th", { className: "n" }, "Got"))),
      h("tbody", {}, failures.map((x) => h("tr", {}, h("td", {}, h("code", {}, x.path)), h("td", {}, x.wanted), h("td", { className: "n" }, x.got === null ? "undefined" : significant(x.got, 5), x.detail ? ` (${x.detail})` : "")))))) : null);
  return h("section", { className: "card verdict", "aria-label": "Verdict" }, h("h1", { tabIndex: -1, id: "verdict" }, sentence(report, job)),
    h("p", { className: "soft" }, `${report.input.name} · ${count(report.input.triangles)} triangles · ${count(report.input.images)} ${report.input.images === 1 ? "image" : "images"} · ${bytes(report.input.bytes)} uploaded`),
    missed, h("dl", { className: "figures" }, figures), warnings(report.warnings), downloads, allFigures(report));
}

export function warnings(list) {
  if (!list?.length) return null;
  return h("div", { className: "note warn" }, h("strong", { className: "lead" }, list.length === 1 ? "One thing to know" : `${list.length} things to know`),
    h("ul", {}, list.map((w) => h("li", {}, w.message.replace(/^./, (c) => c.toUpperCase()), w.pointer ? [" ", h("code", {}, w.pointer)] : null))));
}

/** Every figure of every atlas, for whoever wants them. */
function allFigures(report) {
  const rows = (a) => Object.keys(a.before).filter((k) => typeof (a.before[k] ?? a.after[k]) === "number").map((k) => h("tr", {}, h("td", {}, k.replaceAll("_", " ")), ...["before", "after"].map((w) => h("td", { className: "n" }, a[w][k] === null ? "–" : significant(a[w][k], 5)))));
  const table = (a) => [h("h3", {}, `Atlas ${a.id}: ${a.name}`), h("div", { className: "scroll", tabIndex: 0, role: "region", "aria-label": `Figures of atlas ${a.id}` }, h("table", {}, h("thead", {}, h("tr", {}, h("th", {}, "Figure"), h("th", { className: "n" }, "Before"), h("th", { className: "n" }, "After"))), h("tbody", {}, rows(a))))];
  return h("details", {}, h("summary", {}, "All figures"), (report.atlases ?? []).slice(0, 50).map(table));
}
