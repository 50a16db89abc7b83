// The views of a result, before and after, in 2D and 3D: one camera for both sides, one chart lit in all four.

import { announce, check, choice, count, h, percent, segments, significant } from "./dom.js";
import { RAMPS, ramp } from "./colours.js";
import { counterparts } from "./preview.js";
import { SheetView } from "./view2d.js";
import { MODES, ModelView, Orbit, bounds } from "./view3d.js";

const SIDES = ["before", "after"];
const NAMES = { before: "Before", after: "After" };

/** The section with all views. `preview` is what `readPreview` gives. */
export function buildViewer(preview, report) {
  const { atlases } = preview;
  const camera = { x: 0, y: 0, zoom: 1 }, orbit = new Orbit();
  const state = { atlas: Math.max(0, atlases.findIndex((a) => a.after.layout)), pages: { before: 0, after: 0 }, selected: null, compare: "both", split: 50 };
  const sheets = {}, models = {}, pairs = [];
  const atlas = () => atlases[state.atlas];
  const measures = (which) => report?.atlases?.find((a) => a.id === atlas().id)?.[which];

  const pair = (kind, help) => {
    const id = `help-${kind}`;
    const panes = SIDES.map((which) => {
      const canvas = h("canvas", { id: `${kind}-${which}`, tabIndex: 0, role: "application", "aria-label": `${NAMES[which]}: ${kind === "sheet" ? "the atlas in 2D" : "the model in 3D"}`, "aria-describedby": id });
      return h("div", { className: `pane ${which}` }, canvas, h("span", { className: "chip", "aria-hidden": "true" }, NAMES[which]));
    });
    const line = h("i"), divider = h("div", { className: "divider", "aria-hidden": "true" }, line);
    const range = h("input", { type: "range", min: 0, max: 100, value: 50, step: 0.5, "aria-label": "How much of the view shows before", oninput: () => slide(Number(range.value)) });
    const element = h("div", { className: "pair" }, panes, divider), below = h("div", { className: "slide" }, range);
    line.addEventListener("pointerdown", (event) => { line.setPointerCapture(event.pointerId); event.preventDefault(); });
    line.addEventListener("pointermove", (event) => {
      if (!line.hasPointerCapture(event.pointerId)) return;
      const box = element.getBoundingClientRect();
      slide(Math.min(Math.max((100 * (event.clientX - box.left)) / box.width, 0), 100));
    });
    const own = { element, below, range, line, panes, canvases: panes.map((p) => p.querySelector("canvas")), help: h("p", { id, className: "doc" }, help) };
    pairs.push(own);
    return own;
  };

  const slide = (value) => {
    state.split = value;
    for (const p of pairs) {
      p.range.value = value;
      p.line.style.left = `${value}%`;
      p.panes[0].style.clipPath = state.compare === "slider" ? `inset(0 ${100 - value}% 0 0)` : "none";
    }
  };
  const compare = (mode) => {
    state.compare = mode;
    for (const p of pairs) { p.element.dataset.mode = mode; p.below.classList.toggle("on", mode === "slider"); }
    slide(state.split);
    redraw();
  };
  const redraw = () => { for (const view of [...Object.values(sheets), ...Object.values(models)]) view.draw(); };

  // 2D.
  const flat = pair("sheet", "Drag or arrow keys move, the wheel or + and − zoom, 0 fits, 1 shows a texel as a pixel. Click a chart, or press N and P, to light it everywhere; Escape lets go.");
  const fit = () => {
    const canvas = flat.canvases.find((c) => c.clientWidth) ?? flat.canvases[0];
    const boxes = SIDES.map((which) => sheets[which].raster).filter(Boolean).map((r) => [r.x, r.y, r.x + r.width / r.scale, r.y + r.height / r.scale]);
    if (!boxes.length || !canvas.clientWidth) return;
    const [x0, y0, x1, y1] = [Math.min, Math.min, Math.max, Math.max].map((pick, k) => pick(...boxes.map((b) => b[k])));
    Object.assign(camera, { x: (x0 + x1) / 2, y: (y0 + y1) / 2, zoom: 0.94 * Math.min(canvas.clientWidth / (x1 - x0), canvas.clientHeight / (y1 - y0)) });
    moved();
  };
  const zoomTo = (zoom) => {
    const box = state.selected && lightedBox();
    if (box) Object.assign(camera, { x: (box[0] + box[2]) / 2, y: (box[1] + box[3]) / 2 });
    camera.zoom = zoom;
    moved();
  };
  const lightedBox = () => {
    const { atlas: n, side, chart } = state.selected;
    return n === state.atlas ? atlases[n][side].tables.box.subarray(4 * chart, 4 * chart + 4) : null;
  };
  const moved = () => {
    const told = [camera.x, camera.y, camera.zoom].map((v) => v.toPrecision(8)).join(" ");
    for (const which of SIDES) { sheets[which].canvas.dataset.camera = told; sheets[which].draw(); }
    zoomed.textContent = percent(camera.zoom * (devicePixelRatio || 1), 0);
  };
  const zoomed = h("output", { "aria-label": "Zoom" }, "");
  const of = (view) => (view === sheets.before || view === models.before ? "before" : "after");
  const flatHandlers = {
    moved, fit: () => fit(), hundred: () => zoomTo(1 / (devicePixelRatio || 1)),
    hover: (view, chart) => { if (!state.selected) tell(chart < 0 ? null : { atlas: state.atlas, side: of(view), chart }, true); },
    pick: (view, chart) => select(chart < 0 ? null : { atlas: state.atlas, side: of(view), chart }),
    step: (view, by) => step(of(view), by),
    gutter: () => Math.min(Math.max(measures("after")?.gutter_texels ?? 4, 1), 16),
  };
  SIDES.forEach((which, k) => { sheets[which] = new SheetView(flat.canvases[k], camera, flatHandlers); });

  // 3D.
  const solid = pair("model", "Drag or arrow keys turn, with Shift they move, the wheel or + and − zoom, 0 resets. Click a chart, or press Enter for the one in the middle, to light it everywhere.");
  const handlers = {
    moved: () => SIDES.forEach((which) => models[which]?.draw(true)),
    reset: () => { orbit.reset(...bounds(atlases, "before")); handlers.moved(); },
    pick: (view, found) => {
      const side = of(view), layout = found && atlases[found.atlas][side].layout;
      select(layout ? { atlas: found.atlas, side, chart: layout.charts[found.face] } : null);
    },
  };
  let noWebGl = null;
  try {
    SIDES.forEach((which, k) => { models[which] = new ModelView(solid.canvases[k], orbit, handlers); });
  } catch (error) {
    noWebGl = error;
    for (const which of SIDES) delete models[which];
    solid.panes.forEach((pane) => { pane.querySelector("canvas").hidden = true; pane.append(h("p", { className: "message" }, "3D needs WebGL 2, which this browser does not offer here. The figures and the 2D views are complete without it.")); });
  }

  // What is lit.
  const select = (chosen) => {
    const same = chosen && state.selected && ["atlas", "side", "chart"].every((k) => chosen[k] === state.selected[k]);
    state.selected = same ? null : chosen;
    if (state.selected && state.selected.atlas !== state.atlas) setAtlas(state.selected.atlas);
    light();
    tell(state.selected, false);
  };
  const light = () => {
    const s = state.selected;
    for (const which of SIDES) {
      const here = s && s.atlas === state.atlas, side = atlas()[which];
      const straight = s && (s.side === which || atlas().kept);
      let faces = null;
      if (here && side.layout) {
        if (straight) faces = sheets[which].facesOf(s.chart);
        else faces = [...side.layout.counterparts.keys()].filter((f) => side.layout.counterparts[f] === s.chart);
      }
      sheets[which].light(faces);
      models[which]?.light(s?.atlas ?? -1, s ? s.chart : -1, s ? s.side !== which && !atlases[s.atlas].kept : false);
      for (const canvas of [sheets[which].canvas, models[which]?.canvas]) if (canvas) canvas.dataset.lit = s ? `${s.atlas} ${s.side} ${s.chart}` : "";
      sheets[which].canvas.dataset.faces = faces?.length ?? 0;
    }
  };
  const step = (side, by) => {
    const n = atlas()[side].charts;
    if (!atlas()[side].layout || !n) return;
    const s = state.selected, now = s && s.atlas === state.atlas && s.side === side ? s.chart : by > 0 ? -1 : n;
    select({ atlas: state.atlas, side, chart: (now + by + n) % n });
  };

  const info = h("div", { className: "info" });
  const tell = (s, hovered) => {
    if (!s) {
      info.replaceChildren(h("p", { className: "none" }, "Point at a chart for its figures; click it to light it in all views."));
      return;
    }
    const own = atlases[s.atlas], other = s.side === "before" ? "after" : "before";
    const there = own.kept ? [s.chart] : counterparts(own[s.side], s.chart);
    const columns = SIDES.map((which) => h("div", {}, which === s.side ? chartFigures(own[which], [s.chart], NAMES[which]) : own[which].layout ? chartFigures(own[which], there, NAMES[which]) : h("p", { className: "none" }, `${NAMES[which]}: no layout`)));
    info.replaceChildren(...columns);
    if (!hovered) announce(`Chart ${s.chart} ${s.side} is lit; ${other} its surface lies in ${there.length} ${there.length === 1 ? "chart" : "charts"}.`);
  };
  const chartFigures = (side, charts, name) => {
    const t = side.tables;
    const sum = (list) => charts.reduce((a, c) => a + list[c], 0);
    const [area, texels] = [sum(t.area), sum(t.texels)], whole = t.area.reduce((a, v) => a + v, 0);
    const shown = charts.slice(0, 5).join(", ") + (charts.length > 5 ? ", …" : "");
    const facts = [side.shown === side.triangles ? `${count(sum(t.triangles))} triangles` : null, `${percent(area / whole, 2)} of the surface`, `${count(Math.round(texels))} texels`,
      area > 0 ? `${significant(Math.sqrt(texels / area))} texels per unit` : null, area > 0 ? `stretch ${significant(sum(t.distortion) / area)} (4 is none)` : null,
      sum(t.flipped) ? `${count(sum(t.flipped))} flipped` : null, sum(t.resampled) ? `${count(sum(t.resampled))} triangles resampled` : null,
      side.sheets.length > 1 ? `page ${[...new Set(charts.map((c) => t.page[c] + 1))].join(", ")}` : null];
    return [h("p", {}, h("strong", {}, `${name}: ${charts.length === 1 ? "chart" : `${charts.length} charts,`} ${shown}`)), h("p", {}, facts.filter(Boolean).join(" · "))];
  };

  // Tools.
  const slotNames = () => atlas().slots.map((s) => s.name);
  const allSlots = [...new Set(atlases.flatMap((a) => a.slots.map((s) => s.name)))];
  state.slot = allSlots.includes("base_color") ? "base_color" : allSlots[0] ?? null;
  const readable = (name) => name.replaceAll("_", " ").replace(/^./, (c) => c.toUpperCase());
  const setAtlas = (n) => {
    state.atlas = n;
    state.pages = { before: 0, after: 0 };
    state.fitted = false;
    atlasChoice.select.value = String(n);
    showSheets();
  };
  const showSheets = async () => {
    const a = atlas(), slot = a.slots.find((s) => s.name === state.slot) ?? a.slots[0];
    pageChoice.hidden = a.after.sheets.length < 2;
    pageChoice.fill(a.after.sheets.map((_, n) => [String(n), `Page ${n + 1} of ${a.after.sheets.length}`]), String(state.pages.after));
    for (const which of SIDES) {
      const pane = sheets[which].canvas.parentElement;
      pane.querySelector(".message")?.remove();
      if (!a[which].layout) pane.append(h("p", { className: "message" }, which === "before" ? "The upload has no texture coordinates here." : "No layout was made."));
      const [w, hgt] = a[which].sheets[state.pages[which]] ?? [0, 0];
      pane.querySelector(".chip").textContent = a[which].layout ? `${NAMES[which]} · ${count(w)} × ${count(hgt)}` : NAMES[which];
    }
    await Promise.all(SIDES.map((which) => sheets[which].set(a[which], state.pages[which], slot, which)));
    if (!state.fitted) { state.fitted = true; fit(); }
    light();
  };
  const atlasChoice = choice("Atlas", atlases.map((a, n) => [String(n), `${a.id}: ${a.name}`.slice(0, 48)]), String(state.atlas), (value) => { select(null); setAtlas(Number(value)); });
  atlasChoice.hidden = atlases.length < 2;
  const pageChoice = choice("Page", [], "0", (value) => { state.pages.after = Number(value); showSheets(); });
  const slotChoice = choice("Texture", allSlots.map((name) => [name, readable(name)]), state.slot, (value) => {
    state.slot = value;
    showSheets();
    SIDES.forEach((which) => models[which]?.setSlot(value));
  });
  slotChoice.hidden = !allSlots.length;
  const base = (value) => SIDES.forEach((which) => { sheets[which].shown.base = value; sheets[which].draw(); });
  const over = (name, key, checked = false, title) => check(name, checked, (on) => SIDES.forEach((which) => { sheets[which].shown[key] = on; sheets[which].draw(); }), title);
  const set3d = (key, value) => SIDES.forEach((which) => { if (models[which]) { models[which].shown[key] = value; models[which].draw(); } });
  const legend = h("div", { className: "legend" });
  const mode3d = (value) => {
    set3d("mode", value);
    const bar = (stops, low, high) => {
      const canvas = h("canvas", { width: 176, height: 1, "aria-hidden": "true" }), context = canvas.getContext("2d");
      for (let x = 0; x < 176; x++) { context.fillStyle = `rgb(${ramp(stops, x / 175).map(Math.round).join(" ")})`; context.fillRect(x, 0, 1, 1); }
      return [h("span", {}, low), canvas, h("span", {}, high)];
    };
    legend.replaceChildren(...({ density: bar(RAMPS.density, "¼ of the median", "4 times"), distortion: bar(RAMPS.distortion, "4: none", "16: much"),
      resampled: [h("span", {}, "Orange was resampled; green was copied texel by texel")], checker: [h("span", {}, "Squares of 16 texels, larger ones of 128")] }[value] ?? []));
  };
  if (!allSlots.length) SIDES.forEach((which) => { sheets[which].shown.base = "charts"; if (models[which]) models[which].shown.mode = "charts"; });
  const shared = h("div", { className: "tools" },
    h("div", { className: "group" }, h("span", {}, "Compare"), segments("Compare", [["both", "Side by side"], ["slider", "Slider"], ["before", "Before"], ["after", "After"]], "both", compare)),
    atlasChoice, slotChoice);
  const tools2d = h("div", { className: "tools" },
    h("div", { className: "group" }, h("span", {}, "Show"), segments("Show in 2D", [["texture", "Texture"], ["charts", "Charts"]], sheets.before.shown.base, base)), pageChoice,
    h("div", { className: "group" }, h("span", {}, "Over it"), h("div", { className: "checks" }, over("Seams", "seams", true), over("Gutters and gaps", "gutters", false, "Orange: within the gutter of a chart; grey: free"), over("Overlaps", "overlaps"), over("Flips", "flips"))),
    h("div", { className: "group" }, h("span", {}, "Zoom"), h("div", { className: "row" }, h("div", { className: "seg", role: "group", "aria-label": "Zoom of the 2D views" },
      h("button", { type: "button", onclick: () => fit() }, "Fit"), h("button", { type: "button", onclick: () => zoomTo(1 / (devicePixelRatio || 1)) }, "100 %"), h("button", { type: "button", onclick: () => zoomTo(8) }, "Texels")), zoomed)));
  const tools3d = h("div", { className: "tools" },
    choice("Surface", allSlots.length ? MODES : MODES.slice(1), allSlots.length ? "texture" : "charts", mode3d),
    h("div", { className: "group" }, h("span", {}, "Over it"), h("div", { className: "checks" }, check("Seam lines", false, (on) => set3d("seams", on)), check("Wireframe", false, (on) => set3d("wire", on)))),
    h("div", { className: "group" }, h("span", {}, "View"), h("button", { type: "button", onclick: handlers.reset }, "Reset")), legend);
  const chartTools = h("div", { className: "row" }, h("button", { type: "button", onclick: () => step(state.selected?.side ?? "after", -1) }, "Previous chart"),
    h("button", { type: "button", onclick: () => step(state.selected?.side ?? "after", 1) }, "Next chart"), h("button", { type: "button", onclick: () => select(null) }, "Let go"));
  const reduced = preview.shown < preview.triangles ? h("div", { className: "note warn" }, h("strong", { className: "lead" }, "The views are reduced"), h("p", {}, `They show ${count(preview.shown)} triangles for ${count(preview.triangles)} (before and after together): charts have their borders, and fewer triangles inside. The figures of the verdict are those of the whole model.`)) : null;
  const element = h("section", { className: "card viewer", "aria-label": "Before and after" }, h("h2", {}, "Before and after"), reduced, shared,
    h("h3", {}, "The atlas"), tools2d, flat.element, flat.below, info, h("div", { className: "row spread" }, flat.help, chartTools),
    h("h3", {}, "The model"), noWebGl ? null : tools3d, solid.element, solid.below, noWebGl ? null : solid.help);

  tell(null, true);
  compare("both");
  handlers.reset();
  SIDES.forEach((which) => { models[which]?.load(atlases, which); models[which]?.setSlot(state.slot); });
  const observer = new ResizeObserver(() => { if (!state.fitted || !state.sized) { state.sized = true; fit(); } redraw(); });
  [...flat.panes, ...solid.panes].forEach((pane) => observer.observe(pane));
  matchMedia("(prefers-color-scheme: dark)").addEventListener("change", redraw);
  element.ready = showSheets();
  return element;
}
