// A sheet in 2D, on a canvas without WebGL: a texture or charts, and what is laid over them.

import { chartColour } from "./colours.js";
import { BORDER, FLIPPED } from "./preview.js";
import { gutters, painted, rasterise } from "./raster.js";

/** Faces up to which charts are drawn as outlines instead of pixels, once pixels are large. */
const MOST_DRAWN = 60000;
const OVERLAP = [214, 32, 39, 200], GUTTER = [230, 150, 20, 165], FREE = [110, 116, 126, 110];

export class SheetView {
  /** `camera` is shared with the other side: `{x, y, zoom}`, the texel at the middle and CSS pixels of a texel. */
  constructor(canvas, camera, handlers) {
    this.canvas = canvas;
    // Thousands of short lines: without a graphics card they take a hundred times as long as on the processor itself.
    this.context = canvas.getContext("2d", { willReadFrequently: true });
    this.camera = camera;
    this.handlers = handlers;
    this.cache = new Map();
    this.shown = { base: "texture", seams: true, gutters: false, overlaps: false, flips: false };
    this.faces = { faint: new Set() };
    this.pointers = new Map();
    this.listen();
  }

  /** Sets what is shown: a side of an atlas, its page, the pictures of a slot. */
  async set(side, page, slot, which) {
    this.side = side;
    this.page = page;
    const key = this.key = Symbol();
    const picture = slot?.[which]?.[page] ?? null;
    const bitmap = picture ? await picture.bitmap().catch(() => null) : null;
    if (this.key !== key) return;
    this.bitmap = bitmap;
    this.wrap = which === "before" ? slot?.wrap ?? ["clamp_to_edge", "clamp_to_edge"] : ["clamp_to_edge", "clamp_to_edge"];
    this.draw();
  }

  get sheet() { return this.side?.sheets[this.page] ?? [1, 1]; }

  /** What is derived from a page once. */
  derived(name, make) {
    if (!this.side?.layout) return null;
    let page = this.cache.get(this.side);
    if (!page) this.cache.set(this.side, (page = new Map()));
    const key = `${this.page} ${name}`;
    if (!page.has(key)) page.set(key, make());
    return page.get(key);
  }

  get raster() { return this.derived("raster", () => rasterise(this.side, this.page)); }

  chartPixels() {
    return this.derived("charts", () => {
      const colours = [];
      const { charts } = this.side.layout;
      return painted(this.raster, (id) => id && (colours[charts[id - 1]] ??= [...chartColour(charts[id - 1]), 255]));
    });
  }

  overlapPixels() {
    return this.derived("overlaps", () => painted(this.raster, (id, layers) => (layers > 1 ? OVERLAP : null)));
  }

  gutterPixels() {
    return this.derived("gutters", () => {
      const near = gutters(this.raster, this.handlers.gutter(this.side));
      return painted(this.raster, (id, layers, i) => (id ? null : near[i] ? GUTTER : FREE));
    });
  }

  lines(bits) {
    return this.derived(`lines ${bits}`, () => {
      const { layout: l, shown } = this.side, path = new Path2D();
      for (let f = 0; f < shown; f++) {
        if (l.pages[f] !== this.page || !(l.flags[f] & (7 * bits))) continue;
        for (let k = 0; k < 3; k++) {
          if (!(l.flags[f] & (bits << k))) continue;
          const a = 2 * l.corners[3 * f + k], b = 2 * l.corners[3 * f + ((k + 1) % 3)];
          path.moveTo(l.uvs[a], l.uvs[a + 1]);
          path.lineTo(l.uvs[b], l.uvs[b + 1]);
        }
      }
      return path;
    });
  }

  /** Faces as one shape. */
  shape(faces) {
    const { layout: l } = this.side, path = new Path2D();
    for (const f of faces) {
      if (l.pages[f] !== this.page) continue;
      const [a, b, c] = [0, 1, 2].map((k) => 2 * l.corners[3 * f + k]);
      path.moveTo(l.uvs[a], l.uvs[a + 1]);
      path.lineTo(l.uvs[b], l.uvs[b + 1]);
      path.lineTo(l.uvs[c], l.uvs[c + 1]);
      path.closePath();
    }
    return path;
  }

  /** The border of faces, where they border on none of themselves. */
  outline(faces) {
    const { layout: l } = this.side, edges = new Map(), path = new Path2D();
    for (const f of faces) {
      if (l.pages[f] !== this.page) continue;
      for (let k = 0; k < 3; k++) {
        const a = l.corners[3 * f + k], b = l.corners[3 * f + ((k + 1) % 3)];
        const twin = `${b} ${a}`;
        if (edges.has(twin)) edges.delete(twin);
        else edges.set(`${a} ${b}`, [2 * a, 2 * b]);
      }
    }
    for (const [a, b] of edges.values()) {
      path.moveTo(l.uvs[a], l.uvs[a + 1]);
      path.lineTo(l.uvs[b], l.uvs[b + 1]);
    }
    return path;
  }

  /** Lights faces; `null` for none. */
  light(faces) {
    const any = faces && faces.length;
    this.lit = any ? { shape: this.shape(faces), outline: this.outline(faces), faces } : null;
    this.draw();
  }

  draw() {
    if (this.pending) return;
    this.pending = requestAnimationFrame(() => { this.pending = 0; this.render(); });
  }

  resize() {
    const ratio = Math.min(devicePixelRatio || 1, 3);
    const width = Math.round(this.canvas.clientWidth * ratio), height = Math.round(this.canvas.clientHeight * ratio);
    if (!width || !height) return 0;
    if (this.canvas.width !== width || this.canvas.height !== height) Object.assign(this.canvas, { width, height });
    return ratio;
  }

  render() {
    const ratio = this.resize();
    if (!ratio || !this.side) return;
    const { context: c, camera, canvas } = this, zoom = camera.zoom * ratio;
    const style = getComputedStyle(document.documentElement), colour = (name) => style.getPropertyValue(name).trim();
    c.setTransform(1, 0, 0, 1, 0, 0);
    c.fillStyle = colour("--stage");
    c.fillRect(0, 0, canvas.width, canvas.height);
    if (!this.side.layout) return;
    c.setTransform(zoom, 0, 0, zoom, canvas.width / 2 - camera.x * zoom, canvas.height / 2 - camera.y * zoom);
    const [w, h] = this.sheet;
    c.fillStyle = colour("--paper");
    c.fillRect(0, 0, w, h);
    c.imageSmoothingQuality = "high";
    const raster = this.raster;
    const layer = (image) => {
      c.imageSmoothingEnabled = zoom < raster.scale * 1.5;
      c.drawImage(image, raster.x, raster.y, raster.width / raster.scale, raster.height / raster.scale);
    };
    if (this.shown.base === "texture" && this.bitmap) this.drawTexture(c, w, h, zoom, raster);
    else this.drawCharts(c, zoom, raster, layer);
    if (this.shown.gutters) layer(this.gutterPixels());
    if (this.shown.overlaps) layer(this.overlapPixels());
    if (this.shown.flips) {
      c.fillStyle = "rgb(190 0 190 / .8)";
      c.fill(this.derived("flips", () => this.shape([...this.side.layout.flags.keys()].filter((f) => this.side.layout.flags[f] & FLIPPED))));
    }
    if (this.lit) {
      c.fillStyle = "rgb(255 214 10 / .38)";
      c.fill(this.lit.shape);
    }
    if (this.shown.seams) {
      const path = this.lines(BORDER);
      // Dark on light, light on dark: seen over any texture.
      c.lineWidth = 2.4 * ratio / zoom;
      c.strokeStyle = "rgb(255 255 255 / .55)";
      if (zoom > 0.35 * ratio) c.stroke(path);
      c.lineWidth = 1.1 * ratio / zoom;
      c.strokeStyle = "rgb(20 24 34 / .9)";
      c.stroke(path);
    }
    c.lineWidth = 1.2 * ratio / zoom;
    c.strokeStyle = colour("--soft");
    c.strokeRect(0, 0, w, h);
    if (this.lit) {
      c.lineJoin = "round";
      for (const [width, ink] of [[5, "rgb(20 20 20 / .9)"], [2.6, "#ffd60a"]]) {
        c.lineWidth = width * ratio / zoom;
        c.strokeStyle = ink;
        c.stroke(this.lit.outline);
      }
    }
  }

  drawTexture(c, w, h, zoom, raster) {
    c.imageSmoothingEnabled = zoom * w < 1.5 * this.bitmap.width;
    const tile = (i, j) => {
      const flip = (n, mode) => mode === "mirrored_repeat" && Math.abs(n) % 2 === 1;
      c.save();
      c.translate(i * w, j * h);
      if (flip(i, this.wrap[0])) { c.translate(w, 0); c.scale(-1, 1); }
      if (flip(j, this.wrap[1])) { c.translate(0, h); c.scale(1, -1); }
      c.globalAlpha = i || j ? 0.45 : 1;
      c.drawImage(this.bitmap, 0, 0, w, h);
      c.restore();
    };
    const along = (mode, from, to) => (mode === "clamp_to_edge" ? [0] : [-2, -1, 0, 1, 2].filter((n) => n >= from && n < to));
    for (const i of along(this.wrap[0], Math.floor(raster.x / w), Math.ceil((raster.x + raster.width / raster.scale) / w)))
      for (const j of along(this.wrap[1], Math.floor(raster.y / h), Math.ceil((raster.y + raster.height / raster.scale) / h))) tile(i, j);
  }

  drawCharts(c, zoom, raster, layer) {
    const pixel = zoom / raster.scale;
    if (pixel > 2) {
      const [x0, y0] = this.texel(0, 0), [x1, y1] = this.texel(this.canvas.clientWidth, this.canvas.clientHeight);
      const { box, page, triangles } = this.side.tables, seen = [];
      let faces = 0;
      for (let n = 0; n < this.side.charts; n++) {
        if (page[n] === this.page && box[4 * n] <= x1 && box[4 * n + 2] >= x0 && box[4 * n + 1] <= y1 && box[4 * n + 3] >= y0) {
          seen.push(n);
          faces += triangles[n];
        }
      }
      if (faces < MOST_DRAWN) {
        for (const n of seen) {
          const shape = this.derived(`chart ${n}`, () => this.shape(this.facesOf(n)));
          c.fillStyle = c.strokeStyle = `rgb(${chartColour(n).join(" ")})`;
          c.lineWidth = 0.6 / zoom;
          c.fill(shape);
          c.stroke(shape);
        }
        return;
      }
    }
    layer(this.chartPixels());
  }

  facesOf(chart) {
    const { first, faces } = this.side.tables;
    return faces.subarray(first[chart], first[chart + 1]);
  }

  /** The texel under a point of the canvas, in CSS pixels. */
  texel(x, y) {
    const { camera, canvas } = this;
    return [camera.x + (x - canvas.clientWidth / 2) / camera.zoom, camera.y + (y - canvas.clientHeight / 2) / camera.zoom];
  }

  /** The chart there; -1 for none. */
  chartAt(x, y) {
    if (!this.side?.layout) return -1;
    const [u, v] = this.texel(x, y), { raster } = this;
    const i = Math.floor((u - raster.x) * raster.scale), j = Math.floor((v - raster.y) * raster.scale);
    if (i < 0 || j < 0 || i >= raster.width || j >= raster.height) return -1;
    const id = raster.ids[j * raster.width + i];
    return id ? this.side.layout.charts[id - 1] : -1;
  }

  zoomAt(x, y, factor) {
    const [u, v] = this.texel(x, y), { camera, canvas } = this;
    camera.zoom = Math.min(Math.max(camera.zoom * factor, 0.005), 64);
    camera.x = u - (x - canvas.clientWidth / 2) / camera.zoom;
    camera.y = v - (y - canvas.clientHeight / 2) / camera.zoom;
    this.handlers.moved();
  }

  listen() {
    const { canvas, pointers } = this;
    const at = (event) => { const box = canvas.getBoundingClientRect(); return [event.clientX - box.left, event.clientY - box.top]; };
    let moved = 0;
    canvas.addEventListener("pointerdown", (event) => {
      canvas.setPointerCapture(event.pointerId);
      pointers.set(event.pointerId, at(event));
      if (pointers.size === 1) moved = 0;
    });
    canvas.addEventListener("pointermove", (event) => {
      const now = at(event), before = pointers.get(event.pointerId);
      if (!before) return this.handlers.hover(this, this.chartAt(...now));
      moved += Math.hypot(now[0] - before[0], now[1] - before[1]);
      if (pointers.size === 2) {
        const other = [...pointers].find(([id]) => id !== event.pointerId)[1];
        const factor = Math.hypot(now[0] - other[0], now[1] - other[1]) / Math.max(1, Math.hypot(before[0] - other[0], before[1] - other[1]));
        this.zoomAt((now[0] + other[0]) / 2, (now[1] + other[1]) / 2, factor);
      } else {
        this.camera.x -= (now[0] - before[0]) / this.camera.zoom;
        this.camera.y -= (now[1] - before[1]) / this.camera.zoom;
        this.handlers.moved();
      }
      pointers.set(event.pointerId, now);
    });
    const up = (event) => {
      if (pointers.delete(event.pointerId) && event.type === "pointerup" && moved < 4) this.handlers.pick(this, this.chartAt(...at(event)));
    };
    canvas.addEventListener("pointerup", up);
    canvas.addEventListener("pointercancel", up);
    canvas.addEventListener("pointerleave", () => this.handlers.hover(this, -1));
    canvas.addEventListener("wheel", (event) => {
      event.preventDefault();
      this.zoomAt(...at(event), 2 ** (-event.deltaY * (event.deltaMode ? 20 : 1) / 300));
    }, { passive: false });
    canvas.addEventListener("keydown", (event) => {
      const step = 60 / this.camera.zoom, middle = [canvas.clientWidth / 2, canvas.clientHeight / 2];
      const by = { ArrowLeft: [-step, 0], ArrowRight: [step, 0], ArrowUp: [0, -step], ArrowDown: [0, step] }[event.key];
      if (by) { this.camera.x += by[0]; this.camera.y += by[1]; this.handlers.moved(); }
      else if (event.key === "+" || event.key === "=") this.zoomAt(...middle, 1.25);
      else if (event.key === "-") this.zoomAt(...middle, 0.8);
      else if (event.key === "0" || event.key === "Home") this.handlers.fit();
      else if (event.key === "1") this.handlers.hundred();
      else if (event.key === "Enter" || event.key === " ") this.handlers.pick(this, this.chartAt(...middle));
      else if (event.key === "n" || event.key === "p") this.handlers.step(this, event.key === "n" ? 1 : -1);
      else if (event.key === "Escape") this.handlers.pick(this, -1);
      else return;
      event.preventDefault();
    });
  }
}
