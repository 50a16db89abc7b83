// The page: drop a model, follow its job, see what was won. The job is in the URL.

import { Problem, call, follow, hasKey, json, upload, useKey } from "./api.js";
import { announce, bytes, count, h, percent } from "./dom.js";
import { fromDrop, fromInput, isModel, missing } from "./files.js";
import { buildOptions } from "./options.js";
import { readPreview } from "./preview.js";
import { buildVerdict, warnings } from "./verdict.js";
import { buildViewer } from "./viewer.js";

const RECENT = "intarsia.jobs";
const MOST_RECENT = 12;
const main = document.getElementById("main");
let leaving = new AbortController();

/** Shows one view; what the one before waits for is given up. */
function show(title, ...content) {
  main.replaceChildren(...content.filter(Boolean));
  document.title = title ? `${title} – Intarsia` : "Intarsia";
}

function focusHeading() {
  const heading = main.querySelector("h1");
  if (heading) { heading.tabIndex = -1; heading.focus({ preventScroll: true }); }
}

const note = (kind, lead, ...content) => h("div", { className: `note ${kind}`, role: kind === "bad" ? "alert" : null }, h("strong", { className: "lead" }, lead), ...content);

function explained(error) {
  const more = error instanceof Problem && error.errors.length > 0 ? h("ul", {}, error.errors.map((e) => h("li", {}, e.message, e.pointer ? [" ", h("code", {}, e.pointer)] : null))) : null;
  return [h("p", {}, error.message.replace(/^./, (c) => c.toUpperCase())), more, error.status === 401 ? keyForm() : null];
}

function keyForm() {
  const field = h("input", { type: "password", id: "key", autocomplete: "off", required: true });
  const use = (event) => {
    event.preventDefault();
    useKey(field.value.trim());
    if (location.search) location.reload();
    else event.target.replaceWith(h("p", {}, "The key is used until this tab is closed. Refine once more."));
  };
  return h("form", { className: "row", onsubmit: use }, h("label", { htmlFor: "key" }, "API key"), field, h("button", { type: "submit" }, "Use it"));
}

/** Links carry no key: the file is fetched, and then given. */
async function give(event, artifact) {
  if (!hasKey()) return;
  event.preventDefault();
  const url = URL.createObjectURL(await (await call(artifact.href)).blob());
  h("a", { href: url, download: artifact.name }).click();
  setTimeout(() => URL.revokeObjectURL(url), 60_000);
}

// Jobs of this browser.
const recent = () => { try { return JSON.parse(localStorage.getItem(RECENT)) ?? []; } catch { return []; } };
const remember = (job) => {
  try { localStorage.setItem(RECENT, JSON.stringify([job, ...recent().filter((j) => j.id !== job.id)].slice(0, MOST_RECENT))); } catch { /* Without storage there is no list. */ }
};
const forget = (id) => {
  try { localStorage.setItem(RECENT, JSON.stringify(recent().filter((j) => j.id !== id))); } catch { /* The same. */ }
};

function recentList() {
  const jobs = recent();
  if (!jobs.length) return null;
  return h("section", { className: "card", "aria-label": "Jobs of this browser" }, h("h2", {}, "Your last jobs"),
    h("ul", { className: "recent" }, jobs.map((j) => h("li", {}, h("a", { href: `?job=${j.id}` }, j.name), h("time", { dateTime: j.at }, new Date(j.at).toLocaleString())))));
}

// The start: files and options.
async function start() {
  leaving.abort();
  const { signal } = (leaving = new AbortController());
  let files = [], options = null;
  const status = h("div", { "aria-live": "polite" }), list = h("ul", { className: "files", "aria-label": "Files" });
  const go = h("button", { type: "button", className: "primary", disabled: true, onclick: () => submit(files, options, status) }, "Refine");
  const pick = h("input", { type: "file", multiple: true, className: "hidden", tabIndex: -1, "aria-hidden": "true", id: "pick-files", onchange: () => add(fromInput(pick)) });
  const pickFolder = h("input", { type: "file", webkitdirectory: true, className: "hidden", tabIndex: -1, "aria-hidden": "true", id: "pick-folder", onchange: () => add(fromInput(pickFolder)) });
  const drop = h("div", { className: "drop" }, h("strong", {}, "Drop a model here"), h("p", {}, "GLB, glTF with its files, OBJ with MTL and textures, a 3D tile, a zip or a folder of them"),
    h("div", { className: "row center" }, h("button", { type: "button", onclick: () => pick.click() }, "Pick files"), h("button", { type: "button", onclick: () => pickFolder.click() }, "Pick a folder")), pick, pickFolder);
  const add = async (more) => {
    files = [...files.filter((f) => !more.some((m) => m.path === f.path)), ...more];
    pick.value = pickFolder.value = "";
    await look();
  };
  const look = async () => {
    list.replaceChildren(...files.map((f) => h("li", {}, h("span", { className: "name" }, f.path), isModel(f.path) ? h("span", { className: "tag" }, "model") : null, h("span", { className: "size" }, bytes(f.file.size)),
      h("button", { type: "button", "aria-label": `Remove ${f.path}`, onclick: () => { files = files.filter((x) => x !== f); look(); } }, "×"))));
    const models = files.filter((f) => isModel(f.path)), absent = await missing(files);
    status.replaceChildren(...[
      files.length && !models.length ? note("warn", "There is no model among these files", h("p", {}, "A model ends in .glb, .gltf, .obj, .b3dm or .i3dm, or is a .zip of one.")) : null,
      absent.length ? note("warn", absent.length === 1 ? "A file is missing" : `${absent.length} files are missing`, h("p", {}, "The model names them; drop them too, or refine without them."), h("ul", {}, absent.map((a) => h("li", {}, h("code", {}, a.name), ` (named by ${a.model})`)))) : null,
      models.length > 1 ? note("good", `${models.length} models`, h("p", {}, "They will share one atlas. Remove what is not to be part of it.")) : null,
    ].filter(Boolean));
    go.disabled = !models.length || !options;
    go.textContent = models.length > 1 ? `Refine ${models.length} models together` : absent.length ? "Refine without them" : "Refine";
    if (files.length) announce(`${count(files.length)} files, ${models.length} of them models${absent.length ? `; missing: ${absent.map((a) => a.name).join(", ")}` : ""}.`);
  };
  const over = (on) => (event) => { event.preventDefault(); drop.classList.toggle("over", on); };
  for (const name of ["dragenter", "dragover"]) document.addEventListener(name, over(true), { signal });
  document.addEventListener("dragleave", over(false), { signal });
  document.addEventListener("drop", async (event) => { over(false)(event); await add(await fromDrop(event.dataTransfer)); }, { signal });
  const asked = h("div", {}, h("p", { className: "soft" }, "Asking the service what it offers…"));
  show("", h("h1", {}, "Refine a texture atlas"), h("p", { className: "soft" }, "Charts are packed better, merged or cut; every texture moves with them; and you see what was won and what it cost, before and after."),
    h("div", { className: "start" }, h("section", { className: "card", "aria-label": "Model" }, drop, list, status, h("div", { className: "row" }, go)), h("div", {}, h("section", { className: "card", "aria-label": "What is to be done" }, asked), recentList())));
  for (let wait = 500; !options && !signal.aborted; wait = Math.min(wait * 1.6, 5000)) {
    try {
      options = buildOptions(await json("v1/recipes", { signal }));
      asked.replaceChildren(options.element);
    } catch (error) {
      if (signal.aborted) return;
      asked.replaceChildren(note("bad", "The service does not answer", ...explained(error), h("p", {}, "Trying again…")));
      await new Promise((yes) => setTimeout(yes, wait));
    }
  }
  if (files.length) await look();
}

async function submit(files, options, status) {
  const form = new FormData();
  let wanted;
  try {
    wanted = options.read();
  } catch (error) {
    status.replaceChildren(note("bad", "The options cannot be read", ...explained(error)));
    return;
  }
  // What decides stands before what is large.
  form.append("options", JSON.stringify(wanted));
  for (const f of files) form.append(isModel(f.path) ? "model" : "files", f.file, f.path);
  const name = files.filter((f) => isModel(f.path)).map((f) => f.path.split("/").pop()).join(", ");
  const stop = new AbortController();
  const bar = h("progress", { max: 1, value: 0, "aria-label": "Upload" }), sent = h("p", { className: "soft" }, "Sending…");
  const section = h("section", { className: "card", "aria-label": "Upload" }, h("h1", {}, `Sending ${name}`), bar, sent, h("button", { type: "button", onclick: () => stop.abort() }, "Stop"));
  const before = [...main.children], title = document.title;
  show("Sending", section);
  focusHeading();
  try {
    const job = await upload(form, (fraction, total) => {
      bar.value = fraction;
      sent.textContent = fraction < 1 ? `${percent(fraction, 0)} of ${bytes(total)}` : "The service looks at it…";
    }, stop.signal);
    remember({ id: job.id, name, at: job.created_at });
    history.pushState(null, "", `?job=${job.id}`);
    followJob(job.id);
  } catch (error) {
    main.replaceChildren(...before);
    document.title = title;
    status.replaceChildren(error.name === "AbortError" ? note("warn", "The upload was stopped", h("p", {}, "Nothing was submitted.")) : note("bad", "The model was not taken", ...explained(error)));
    announce(error.message);
    status.scrollIntoView({ block: "nearest" });
  }
}

// A job, from its start to its end.
async function followJob(id) {
  leaving.abort();
  const { signal } = (leaving = new AbortController());
  const name = recent().find((j) => j.id === id)?.name ?? "the model";
  const heading = h("h1", {}, `Refining ${name}`), bar = h("progress", { max: 1, value: 0, "aria-label": "Progress of the job" }), what = h("p", { className: "soft" }, "Asking for the job…");
  const stages = h("ol", { className: "stages", "aria-label": "Stages" }), lost = h("div"), found = h("div"), cancel = h("button", { type: "button", onclick: () => stop() }, "Cancel the job");
  show("Refining", h("section", { className: "card", "aria-label": "Progress" }, heading, bar, what, stages, lost, found, h("div", { className: "row" }, cancel)));
  focusHeading();
  const stop = async () => {
    cancel.disabled = true;
    cancel.textContent = "Cancelling…";
    await call(`v1/jobs/${id}/cancel`, { method: "POST" }).catch((error) => { if (error.status !== 409) { cancel.disabled = false; cancel.textContent = "Cancel the job"; lost.replaceChildren(note("bad", "It was not cancelled", ...explained(error))); } });
  };
  let job = null;
  const known = [], warned = [];
  const progress = (p) => {
    bar.value = p.fraction;
    if (p.stage && known.at(-1) !== p.stage) {
      if (!known.includes(p.stage)) known.push(p.stage);
      announce(`Stage ${p.stage.replaceAll("_", " ")}`);
    }
    const more = Math.max(0, (p.stage_count ?? 0) - known.length);
    stages.replaceChildren(...known.map((s) => h("li", { className: s === p.stage ? "now" : "done", "aria-current": s === p.stage ? "step" : null }, s.replaceAll("_", " "))), ...(more ? [h("li", {}, `${more} more`)] : []));
    what.textContent = `${percent(p.fraction, 0)}${p.message ? ` · ${p.message}` : ""}`;
  };
  const take = (now) => {
    job = now;
    if (job.state === "queued") what.textContent = job.queue_position > 1 ? `Waiting: ${job.queue_position - 1} jobs are before it.` : "Waiting for a worker…";
    else if (job.progress) progress(job.progress);
    warned.splice(0, warned.length, ...(job.warnings ?? []));
    found.replaceChildren(...[warnings(warned)].filter(Boolean));
  };
  try {
    await follow(id, {
      event(kind, data) {
        if (kind === "progress") progress(data);
        else if (kind === "warning") { warned.push(data); found.replaceChildren(warnings(warned)); }
        else if (data.created_at) take(data);
        else job = { ...job, ...data, deleted: true };
      },
      lost: () => { lost.replaceChildren(note("warn", "The connection to the service is lost", h("p", {}, "The job goes on without this page. Trying to come back…"))); announce("The connection to the service is lost; trying again."); },
      back: () => { lost.replaceChildren(); announce("The service is back."); },
    }, signal);
  } catch (error) {
    if (error.status === 404) {
      forget(id);
      show("Unknown job", h("section", { className: "card" }, h("h1", {}, "There is no such job"), h("p", {}, "It may have been deleted, or be too old: the service keeps jobs for a while only."), h("a", { className: "button primary", href: "./" }, "Refine a model")));
      return focusHeading();
    }
    lost.replaceChildren(note("bad", "The job cannot be followed", ...explained(error)));
    return;
  }
  if (!signal.aborted) await ended(id, name, job, signal);
}

async function ended(id, name, job, signal) {
  const artifact = (n) => job.artifacts?.find((a) => a.name === n && !a.expired);
  const again = h("a", { className: "button", href: "./" }, "Refine another");
  const gone = job.artifacts?.length > 0 && job.artifacts.every((a) => a.expired);
  if (!artifact("report.json")) {
    const titles = { canceled: "The job was cancelled", expired: "The job was never run", failed: "The model could not be refined", succeeded: "The result is no longer kept" };
    show(titles[job.state], h("section", { className: "card", "aria-label": "End" }, h("h1", {}, titles[job.state]),
      job.error ? note("bad", job.error.code.replaceAll("_", " ").replace(/^./, (c) => c.toUpperCase()), h("p", {}, job.error.message.replace(/^./, (c) => c.toUpperCase())), job.error.pointer ? h("p", {}, "At ", h("code", {}, job.error.pointer)) : null) : null,
      job.state === "canceled" ? h("p", {}, job.deleted ? "It was deleted." : "Nothing is kept of it. The model that you uploaded is untouched.") : null,
      job.state === "expired" ? h("p", {}, "It waited longer than the service lets jobs wait. Submit it again.") : null,
      gone ? h("p", {}, "Its files were removed. Submit the model again to have them made again: equal input gives equal bytes.") : null,
      warnings(job.warnings), h("div", { className: "row" }, again)));
    announce(titles[job.state]);
    return focusHeading();
  }
  show("Loading the result", h("p", { className: "soft" }, "Loading the result…"));
  try {
    const binary = artifact("preview.bin");
    const [report, preview] = await Promise.all([json(artifact("report.json").href, { signal }), binary ? call(binary.href, { signal }).then((r) => r.arrayBuffer()).then(readPreview).catch((error) => error) : null]);
    if (signal.aborted) return;
    const link = (a, primary) => h("a", { className: primary ? "button primary" : "button", href: a.href, download: a.name, onclick: (event) => give(event, a) }, primary ? `Download everything (${bytes(a.bytes)})` : `${a.name} (${bytes(a.bytes)})`);
    const own = (job.artifacts ?? []).filter((a) => !a.expired), zip = artifact("result.zip");
    const downloads = h("div", { className: "downloads" }, zip ? link(zip, true) : null, own.filter((a) => a.role === "model").map((a) => link(a)), again,
      h("details", {}, h("summary", {}, `All files (${own.length})`), h("div", { className: "downloads" }, own.filter((a) => a !== zip && a.role !== "model").map((a) => link(a)))));
    result(report, job, preview, downloads, name);
  } catch (error) {
    if (signal.aborted) return;
    show("Result", h("section", { className: "card" }, h("h1", {}, "The result cannot be shown"), note("bad", "The service did not give it", ...explained(error)), h("a", { className: "button", href: location.href }, "Try again")));
    focusHeading();
  }
}

/** Verdict and views. */
function result(report, job, preview, downloads, name) {
  const verdict = buildVerdict(report, job, downloads);
  const viewer = preview instanceof Error ? note("warn", "There are no views", h("p", {}, `The figures are complete, but the preview cannot be shown: ${preview.message}.`)) : preview && preview.atlases.length ? buildViewer(preview, report) : null;
  show(name ?? report.input.name, verdict, viewer);
  announce(verdict.querySelector("h1").textContent);
  focusHeading();
  const ready = () => { main.dataset.ready = "true"; };
  if (viewer?.ready) viewer.ready.then(() => requestAnimationFrame(ready));
  else ready();
}

async function route() {
  delete main.dataset.ready;
  const inside = document.getElementById("report-data");
  if (inside) {
    document.querySelector("a.brand").removeAttribute("href");
    const octets = Uint8Array.from(atob(document.getElementById("preview-data").textContent), (c) => c.charCodeAt(0));
    return result(JSON.parse(inside.textContent), null, await readPreview(octets.buffer).catch((error) => error), null, null);
  }
  const id = new URLSearchParams(location.search).get("job");
  if (id && /^[0-9a-f]{32}$/.test(id)) return followJob(id);
  return start();
}

window.addEventListener("popstate", route);
route();
