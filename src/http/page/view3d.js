import { chartColour, RAMPS, ramp } from "./colours.js";
import { RESAMPLED, SEAM } from "./preview.js";

export const MODES = [["texture", "Texture"], ["checker", "Checkerboard"], ["charts", "Charts"], ["density", "Texel density"], ["distortion", "Stretch"], ["resampled", "Resampled"]];
/** Modes in which a face has a figure of its own, and its vertices are not shared. */
const BY_FACE = ["density", "distortion", "resampled"];

// A program for each way to colour, so that nothing is interpolated in vain: COLOUR is 0 for the texture, 1 for the checkerboard, 2 for colours of vertices, 3 for grey.
const VERTEX = `
layout(location = 0) in vec3 position;
layout(location = 1) in vec2 uv;
layout(location = 2) in vec4 colour;
layout(location = 3) in uvec2 charts;
uniform mat4 world, camera;
uniform uint lit;
uniform bool otherSide;
out vec3 place;
out vec2 at;
flat out vec3 own;
flat out float on;
void main() {
  vec4 p = world * vec4(position, 1.0);
  place = p.xyz;
#if COLOUR < 2
  at = uv;
#elif COLOUR == 2
  own = colour.rgb;
#endif
#if LIT
  on = (otherSide ? charts.y : charts.x) == lit ? 1.0 : 0.0;
#endif
  gl_Position = camera * p;
}`;

const FRAGMENT = `
precision highp float;
in vec3 place;
in vec2 at;
flat in vec3 own;
flat in float on;
uniform sampler2D picture;
uniform vec3 eye;
uniform vec2 sheet;
uniform float cutoff;
out vec4 pixel;
void main() {
  float alpha = 1.0;
  vec3 normal = normalize(cross(dFdx(place), dFdy(place)));
  float light = 0.42 + 0.58 * abs(dot(normal, normalize(eye - place)));
#if COLOUR == 0
  vec4 texel = texture(picture, at / sheet);
  if (texel.a < cutoff) discard;
  if (cutoff < 0.0) alpha = texel.a;
  vec3 c = texel.rgb * mix(1.0, light, 0.28);
#elif COLOUR == 1
  vec2 cell = floor(at / 16.0), coarse = floor(at / 128.0);
  float fine = mod(cell.x + cell.y, 2.0), large = mod(coarse.x + coarse.y, 2.0);
  float blur = clamp(fwidth(at.x + at.y) / 16.0 - 0.4, 0.0, 1.0);
  vec3 c = mix(mix(vec3(0.93, 0.92, 0.89), vec3(0.30, 0.34, 0.40), fine), vec3(0.61), blur);
  c *= mix(vec3(1.0), vec3(0.86, 0.95, 1.0), large) * light;
#elif COLOUR == 2
  vec3 c = own * light;
#else
  vec3 c = vec3(0.62) * light;
#endif
#if LIT
  c = on > 0.5 ? mix(c, vec3(1.0, 0.84, 0.04), 0.62) : c * 0.62;
#endif
  pixel = vec4(c, alpha);
}`;

// Edges are rectangles as wide as \`width\` pixels, a little nearer than the surface that they lie on.
const EDGE_VERTEX = `
layout(location = 0) in vec3 from;
layout(location = 1) in vec3 to;
uniform mat4 world, camera;
uniform vec3 eye;
uniform vec2 size;
uniform float width;
vec4 seen(vec3 p) { return camera * vec4(mix((world * vec4(p, 1.0)).xyz, eye, 0.003), 1.0); }
void main() {
  vec4 p = seen(from), q = seen(to);
  const float near = 1e-5;
  if (p.w < near && q.w < near) { gl_Position = vec4(2.0, 2.0, 2.0, 1.0); return; }
  if (p.w < near) p = mix(p, q, (near - p.w) / (q.w - p.w));
  if (q.w < near) q = mix(q, p, (near - q.w) / (p.w - q.w));
  vec2 along = (q.xy / q.w - p.xy / p.w) * size;
  vec2 across = vec2(-along.y, along.x) / max(length(along), 1e-6);
  vec4 end = gl_VertexID < 2 ? p : q;
  end.xy += across * (gl_VertexID % 2 == 0 ? width : -width) / size * end.w;
  gl_Position = end;
}`;

const EDGE_FRAGMENT = `
precision mediump float;
uniform vec4 tint;
out vec4 pixel;
void main() { pixel = tint; }`;

const NOT_LIT = 0xffffffff;
/** Bytes of a vertex. */
const STRIDE = 32;
/** Milliseconds that a view may take, of two in a frame. */
const FLUENT = 13;
/** Pixels of a view at rest, at most. */
const MOST_PIXELS = 12e6;

/** A camera that looks at a point: shared by both sides. */
export class Orbit {
  constructor() { this.reset([-1, -1, -1], [1, 1, 1]); }

  reset(low, high) {
    this.target = low.map((v, k) => (v + high[k]) / 2);
    this.radius = Math.max(1e-6, Math.hypot(...low.map((v, k) => high[k] - v)) / 2);
    Object.assign(this, { yaw: 0.65, pitch: 0.42, distance: 2.9 * this.radius });
  }

  get axes() {
    const [cy, sy, cp, sp] = [Math.cos(this.yaw), Math.sin(this.yaw), Math.cos(this.pitch), Math.sin(this.pitch)];
    return { back: [sy * cp, sp, cy * cp], right: [cy, 0, -sy], up: [-sy * sp, cp, -cy * sp] };
  }

  get eye() { return this.target.map((v, k) => v + this.axes.back[k] * this.distance); }

  turn(x, y) {
    this.yaw -= x;
    this.pitch = Math.min(Math.max(this.pitch + y, -1.55), 1.55);
  }

  shift(x, y) {
    const { right, up } = this.axes;
    this.target = this.target.map((v, k) => v - (right[k] * x - up[k] * y) * this.distance * 0.6);
  }

  zoom(factor) { this.distance = Math.min(Math.max(this.distance / factor, this.radius * 0.02), this.radius * 40); }

  matrix(aspect) {
    const { right, up, back } = this.axes, { eye } = this;
    const f = 1 / Math.tan(0.3), near = Math.max(this.distance - 2 * this.radius, this.distance * 0.01), far = this.distance + 4 * this.radius;
    const fx = aspect < 1 ? f : f / aspect, fy = aspect < 1 ? f * aspect : f;
    const a = (far + near) / (near - far), b = (2 * far * near) / (near - far);
    return new Float32Array([right[0] * fx, up[0] * fy, back[0] * a, -back[0], right[1] * fx, up[1] * fy, back[1] * a, -back[1],
      right[2] * fx, up[2] * fy, back[2] * a, -back[2], -dot(right, eye) * fx, -dot(up, eye) * fy, b - dot(back, eye) * a, dot(back, eye)]);
  }

  /** Where the ray through a point of the view (-1 to 1) begins, and its direction. */
  ray(x, y, aspect) {
    const { right, up, back } = this.axes, t = Math.tan(0.3), tx = aspect < 1 ? t : t * aspect, ty = aspect < 1 ? t / aspect : t;
    return [this.eye, back.map((v, k) => -v + right[k] * x * tx + up[k] * y * ty)];
  }

  toString() { return [this.yaw, this.pitch, this.distance, ...this.target].map((v) => v.toPrecision(9)).join(" "); }
}

const apply = (m, [x, y, z]) => [0, 1, 2].map((k) => m[k] * x + m[4 + k] * y + m[8 + k] * z + m[12 + k]);

const minus = (a, b) => [a[0] - b[0], a[1] - b[1], a[2] - b[2]];
const dot = (a, b) => a[0] * b[0] + a[1] * b[1] + a[2] * b[2];
const cross = (a, b) => [a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0]];

/** The box of a side's instances, over all atlases. */
export function bounds(atlases, which) {
  const low = [Infinity, Infinity, Infinity], high = [-Infinity, -Infinity, -Infinity];
  for (const atlas of atlases) {
    const side = atlas[which];
    for (const part of side.parts) {
      const own = [[Infinity, Infinity, Infinity], [-Infinity, -Infinity, -Infinity]];
      for (let i = 3 * part.first; i < 3 * (part.first + part.count); i++) {
        for (let k = 0; k < 3; k++) {
          const v = side.positions[3 * side.corners[i] + k];
          own[0][k] = Math.min(own[0][k], v);
          own[1][k] = Math.max(own[1][k], v);
        }
      }
      for (const m of part.matrices) {
        for (let corner = 0; corner < 8; corner++) {
          const p = apply(m, [0, 1, 2].map((k) => own[(corner >> k) & 1][k]));
          p.forEach((v, k) => { low[k] = Math.min(low[k], v); high[k] = Math.max(high[k], v); });
        }
      }
    }
  }
  return low.every(Number.isFinite) && high.every(Number.isFinite) ? [low, high] : [[-1, -1, -1], [1, 1, 1]];
}

export class ModelView {
  /** Throws where there is no WebGL 2. */
  constructor(canvas, orbit, handlers) {
    Object.assign(this, { canvas, orbit, handlers, pointers: new Map(), textures: new Map(), buffers: [], lit: null, share: 1 });
    this.shown = { mode: "texture", wire: false, seams: false };
    // At rest there are four pixels for one of the screen instead.
    const gl = (this.gl = canvas.getContext("webgl2", { antialias: false, alpha: false, powerPreference: "high-performance" }));
    if (!gl) throw new Error("no WebGL 2");
    this.prepare();
    canvas.addEventListener("webglcontextlost", (event) => event.preventDefault());
    canvas.addEventListener("webglcontextrestored", () => { this.textures.clear(); this.buffers = []; this.prepare(); if (this.atlases) this.load(this.atlases, this.which); });
    this.listen();
  }

  prepare() {
    this.programs = new Map();
    this.use("surface", 3, false);
    this.gl.enable(this.gl.DEPTH_TEST);
    this.gl.blendFunc(this.gl.SRC_ALPHA, this.gl.ONE_MINUS_SRC_ALPHA);
  }

  /** Takes a program, made when it is first wanted; gives the places of its uniforms. */
  use(kind, colour, lit) {
    const { gl } = this, key = `${kind} ${colour} ${lit}`;
    let made = this.programs.get(key);
    if (!made) {
      const program = gl.createProgram(), sources = kind === "surface" ? [VERTEX, FRAGMENT] : [EDGE_VERTEX, EDGE_FRAGMENT];
      for (const [k, type] of [gl.VERTEX_SHADER, gl.FRAGMENT_SHADER].entries()) {
        const shader = gl.createShader(type);
        gl.shaderSource(shader, `#version 300 es\n#define COLOUR ${colour}\n#define LIT ${lit ? 1 : 0}\n${sources[k]}`);
        gl.compileShader(shader);
        gl.attachShader(program, shader);
      }
      gl.linkProgram(program);
      if (!gl.getProgramParameter(program, gl.LINK_STATUS)) throw new Error(gl.getProgramInfoLog(program) || "no shaders");
      const at = new Map();
      made = { program, uniform: (name) => { if (!at.has(name)) at.set(name, gl.getUniformLocation(program, name)); return at.get(name); } };
      this.programs.set(key, made);
    }
    gl.useProgram(made.program);
    return made.uniform;
  }

  /** Takes a side of all atlases. */
  load(atlases, which) {
    Object.assign(this, { atlases, which });
    for (const own of this.buffers) for (const name of ["shared", "byFace", "seams", "wire"]) this.drop(own[name]);
    this.buffers = atlases.map((atlas, n) => this.buffer(atlas[which], n));
    const known = Float32Array.from(atlases.flatMap((a) => [...(a.before.layout?.logDensity ?? a.after.layout?.logDensity ?? [])]).filter((v) => !Number.isNaN(v))).sort();
    this.median = known[known.length >> 1] ?? 0;
    this.draw(true);
  }

  drop(held) {
    if (!held) return;
    this.gl.deleteVertexArray(held.array);
    held.buffers.forEach((b) => this.gl.deleteBuffer(b));
  }

  /** Vertices that faces share, with the triangles by part and page. */
  buffer(side, atlas) {
    const { layout: l, corners } = side, runs = [], order = new Uint32Array(side.shown);
    let at = 0;
    for (const part of side.parts) {
      const pages = new Map();
      for (let f = part.first; f < part.first + part.count; f++) {
        const page = l ? l.pages[f] : 0;
        if (!pages.has(page)) pages.set(page, []);
        pages.get(page).push(f);
      }
      for (const [page, faces] of pages) {
        runs.push({ page, first: 3 * at, count: 3 * faces.length, matrices: part.matrices, alpha: part.alpha });
        for (const f of faces) order[at++] = f;
      }
    }
    // A vertex is shared by faces that have its position, its UV, its chart and its chart on the other side: those of one UV are in a list.
    const indices = new Uint32Array(3 * at), firsts = new Int32Array(l ? l.uvs.length / 2 : side.positions.length / 3).fill(-1), nexts = [], faceOf = [], cornerOf = [];
    for (let i = 0; i < 3 * at; i++) {
      const f = order[Math.floor(i / 3)], corner = 3 * f + (i % 3), head = l ? l.corners[corner] : corners[corner];
      let v = firsts[head];
      while (v >= 0 && (corners[cornerOf[v]] !== corners[corner] || (l && (l.charts[faceOf[v]] !== l.charts[f] || l.counterparts[faceOf[v]] !== l.counterparts[f])))) v = nexts[v];
      if (v < 0) {
        v = faceOf.length;
        nexts.push(firsts[head]);
        firsts[head] = v;
        faceOf.push(f);
        cornerOf.push(corner);
      }
      indices[i] = v;
    }
    const colours = Array.from({ length: l ? side.charts : 0 }, (_, chart) => chartColour(chart));
    const shared = this.vertices(side, cornerOf, (f) => colours[l.charts[f]], indices);
    return { side, atlas, runs, order, shared, byFace: null, seams: null, wire: null };
  }

  /** Uploads vertices, each a corner of a face. */
  vertices(side, list, colourOf, indices) {
    const { gl } = this, { layout: l } = side, data = new ArrayBuffer(STRIDE * list.length);
    const floats = new Float32Array(data), words = new Uint32Array(data), octets = new Uint8Array(data);
    for (let v = 0; v < list.length; v++) {
      const corner = list[v], f = Math.floor(corner / 3), at = (STRIDE / 4) * v, p = 3 * side.corners[corner];
      for (let k = 0; k < 3; k++) floats[at + k] = side.positions[p + k];
      if (!l) { words[at + 6] = words[at + 7] = NOT_LIT - 1; continue; }
      const c = 2 * l.corners[corner];
      floats[at + 3] = l.uvs[c];
      floats[at + 4] = l.uvs[c + 1];
      octets.set(colourOf(f), STRIDE * v + 20);
      words[at + 6] = l.charts[f];
      words[at + 7] = l.counterparts[f];
    }
    const array = gl.createVertexArray(), buffers = [gl.createBuffer()];
    gl.bindVertexArray(array);
    gl.bindBuffer(gl.ARRAY_BUFFER, buffers[0]);
    gl.bufferData(gl.ARRAY_BUFFER, data, gl.STATIC_DRAW);
    [0, 1, 2, 3].forEach((i) => gl.enableVertexAttribArray(i));
    gl.vertexAttribPointer(0, 3, gl.FLOAT, false, STRIDE, 0);
    gl.vertexAttribPointer(1, 2, gl.FLOAT, false, STRIDE, 12);
    gl.vertexAttribPointer(2, 4, gl.UNSIGNED_BYTE, true, STRIDE, 20);
    gl.vertexAttribIPointer(3, 2, gl.UNSIGNED_INT, STRIDE, 24);
    if (indices) {
      buffers.push(gl.createBuffer());
      gl.bindBuffer(gl.ELEMENT_ARRAY_BUFFER, buffers[1]);
      gl.bufferData(gl.ELEMENT_ARRAY_BUFFER, indices, gl.STATIC_DRAW);
    }
    gl.bindVertexArray(null);
    return { array, buffers };
  }

  /** What of a buffer a way of drawing needs, made when it is first wanted. */
  part(own, name) {
    if (name === "shared") return own.shared;
    const key = BY_FACE.includes(name) ? "byFace" : name;
    if (own[key] && (key !== "byFace" || own[key].mode === name)) return own[key];
    this.drop(own[key]);
    if (key !== "byFace") return (own[key] = this.edges(own, name === "seams" ? SEAM : 0));
    const { layout: l } = own.side, grey = [140, 140, 140];
    const map = (stops, v, low, range) => (Number.isNaN(v) ? grey : ramp(stops, (v - low) / range));
    const colourOf = {
      density: (f) => map(RAMPS.density, l.logDensity[f], this.median - 2, 4),
      distortion: (f) => map(RAMPS.distortion, l.logDistortion[f], 2, 2),
      resampled: (f) => (l.flags[f] & RESAMPLED ? [230, 122, 31] : [140, 168, 158]),
    }[name];
    const list = new Uint32Array(3 * own.order.length);
    own.order.forEach((f, i) => { for (let k = 0; k < 3; k++) list[3 * i + k] = 3 * f + k; });
    own.byFace = this.vertices(own.side, list, colourOf, null);
    own.byFace.mode = name;
    return own.byFace;
  }

  /** Edges of faces with a bit, each once, by part. */
  edges(own, bit) {
    const { gl } = this, { corners, positions, parts, layout: l } = own.side, ends = [], runs = [];
    const n = positions.length / 3;
    for (const part of parts) {
      const first = ends.length / 2, known = new Set();
      for (let f = part.first; f < part.first + part.count; f++) {
        for (let k = 0; k < 3; k++) {
          if (bit && !(l && l.flags[f] & (bit << k))) continue;
          const a = corners[3 * f + k], b = corners[3 * f + ((k + 1) % 3)], key = a < b ? a * n + b : b * n + a;
          if (known.has(key)) continue;
          known.add(key);
          ends.push(a, b);
        }
      }
      runs.push({ first, count: ends.length / 2 - first, matrices: part.matrices });
    }
    const data = new Float32Array(3 * ends.length);
    ends.forEach((v, i) => { for (let k = 0; k < 3; k++) data[3 * i + k] = positions[3 * v + k]; });
    const array = gl.createVertexArray(), buffer = gl.createBuffer();
    gl.bindVertexArray(array);
    gl.bindBuffer(gl.ARRAY_BUFFER, buffer);
    gl.bufferData(gl.ARRAY_BUFFER, data, gl.STATIC_DRAW);
    [0, 1].forEach((i) => { gl.enableVertexAttribArray(i); gl.vertexAttribDivisor(i, 1); });
    gl.bindVertexArray(null);
    return { array, buffers: [buffer], runs };
  }

  /** Shows the pictures of a slot, by name. */
  async setSlot(name) {
    this.slot = name;
    const wanted = [];
    for (const [n, atlas] of this.atlases.entries()) {
      const slot = atlas.slots.find((s) => s.name === name);
      slot?.[this.which].forEach((picture, page) => { if (picture && !this.textures.has(`${n} ${name} ${page}`)) wanted.push([n, slot, page, picture]); });
    }
    await Promise.all(wanted.map(async ([n, slot, page, picture]) => {
      const bitmap = await picture.bitmap().catch(() => null);
      if (bitmap && !this.textures.has(`${n} ${name} ${page}`)) this.textures.set(`${n} ${name} ${page}`, this.texture(bitmap, slot.wrap));
    }));
    this.draw(true);
  }

  texture(bitmap, wrap) {
    const { gl } = this, texture = gl.createTexture();
    const modes = { repeat: gl.REPEAT, mirrored_repeat: gl.MIRRORED_REPEAT, clamp_to_edge: gl.CLAMP_TO_EDGE };
    gl.bindTexture(gl.TEXTURE_2D, texture);
    gl.pixelStorei(gl.UNPACK_PREMULTIPLY_ALPHA_WEBGL, false);
    gl.texImage2D(gl.TEXTURE_2D, 0, gl.RGBA, gl.RGBA, gl.UNSIGNED_BYTE, bitmap);
    gl.generateMipmap(gl.TEXTURE_2D);
    gl.texParameteri(gl.TEXTURE_2D, gl.TEXTURE_MIN_FILTER, gl.LINEAR_MIPMAP_LINEAR);
    gl.texParameteri(gl.TEXTURE_2D, gl.TEXTURE_WRAP_S, this.which === "before" ? modes[wrap[0]] : gl.CLAMP_TO_EDGE);
    gl.texParameteri(gl.TEXTURE_2D, gl.TEXTURE_WRAP_T, this.which === "before" ? modes[wrap[1]] : gl.CLAMP_TO_EDGE);
    return texture;
  }

  /** Lights a chart of an atlas: of this side, or of the other. */
  light(atlas, chart, otherSide) {
    this.lit = chart < 0 ? null : { atlas, chart, otherSide };
    this.draw();
  }

  /** Draws soon; while the camera is `moving`, with as few pixels as keep it fluent, and all of them when it rests. */
  draw(moving = false) {
    this.moving = moving;
    clearTimeout(this.rest);
    if (moving) this.rest = setTimeout(() => this.draw(), 250);
    if (this.pending) return;
    this.pending = requestAnimationFrame(() => { this.pending = 0; this.render(); });
  }

  render() {
    const started = performance.now();
    const { gl, canvas, orbit, shown } = this, ratio = Math.min(devicePixelRatio || 1, 2), area = canvas.clientWidth * canvas.clientHeight;
    const scale = this.moving ? ratio * this.share : Math.max(ratio, Math.min(2 * ratio, 2, Math.sqrt(MOST_PIXELS / Math.max(1, area))));
    const width = Math.round(canvas.clientWidth * scale), height = Math.round(canvas.clientHeight * scale);
    if (!width || !height || gl.isContextLost()) return;
    if (canvas.width !== width || canvas.height !== height) Object.assign(canvas, { width, height });
    canvas.dataset.camera = orbit.toString();
    const clear = getComputedStyle(document.documentElement).getPropertyValue("--stage").trim().match(/[\da-f]{2}/gi) ?? ["e9", "e7", "e1"];
    gl.viewport(0, 0, width, height);
    gl.clearColor(...clear.map((v) => parseInt(v, 16) / 255), 1);
    gl.clear(gl.COLOR_BUFFER_BIT | gl.DEPTH_BUFFER_BIT);
    const camera = orbit.matrix(width / height);
    // What lets other things through is drawn behind them.
    const isClear = (run) => shown.mode === "texture" && this.slot === "base_color" && run.alpha === "blend";
    for (const through of [false, true]) {
      gl[through ? "enable" : "disable"](gl.BLEND);
      gl.depthMask(!through);
      for (const own of this.buffers) this.drawSurface(own, own.runs.filter((run) => isClear(run) === through), camera);
    }
    gl.disable(gl.BLEND);
    gl.depthMask(true);
    const textured = shown.mode === "texture" || shown.mode === "checker", wide = scale / ratio;
    if (shown.wire) this.drawEdges("wire", camera, [width, height], wide, [0.05, 0.05, 0.06, 0.45]);
    if (shown.seams) this.drawEdges("seams", camera, [width, height], 1.5 * Math.max(wide, 0.5), textured ? [0.95, 0.12, 0.25, 1] : [0.04, 0.05, 0.09, 1]);
    gl.bindVertexArray(null);
    if (!this.moving) return;
    // What is read has been drawn.
    gl.readPixels(0, 0, 1, 1, gl.RGBA, gl.UNSIGNED_BYTE, new Uint8Array(4));
    this.share = Math.min(1, Math.max(0.25, this.share * Math.min(Math.max(Math.sqrt(FLUENT / (performance.now() - started)), 0.5), 1.15)));
  }

  drawSurface(own, runs, camera) {
    const { gl, shown, lit } = this, { side, atlas } = own, byFace = side.layout && BY_FACE.includes(shown.mode);
    gl.bindVertexArray(this.part(own, byFace ? shown.mode : "shared").array);
    for (const run of runs) {
      const texture = this.textures.get(`${atlas} ${this.slot} ${run.page}`);
      const colour = shown.mode === "texture" ? (texture ? 0 : 3) : !side.layout ? 3 : shown.mode === "checker" ? 1 : 2;
      const u = this.use("surface", colour, lit !== null);
      gl.uniformMatrix4fv(u("camera"), false, camera);
      gl.uniform3fv(u("eye"), this.orbit.eye);
      gl.uniform1ui(u("lit"), lit?.atlas === atlas ? lit.chart : NOT_LIT);
      gl.uniform1i(u("otherSide"), lit?.otherSide ?? false);
      // Nothing is below 0; -1 is a blend.
      gl.uniform1f(u("cutoff"), this.slot !== "base_color" ? 0 : run.alpha === "blend" ? -1 : (run.alpha ?? 0));
      gl.bindTexture(gl.TEXTURE_2D, texture ?? null);
      gl.uniform2fv(u("sheet"), side.sheets[run.page] ?? [1, 1]);
      for (const m of run.matrices) {
        gl.uniformMatrix4fv(u("world"), false, m);
        if (byFace) gl.drawArrays(gl.TRIANGLES, run.first, run.count);
        else gl.drawElements(gl.TRIANGLES, run.count, gl.UNSIGNED_INT, 4 * run.first);
      }
    }
  }

  drawEdges(name, camera, size, width, tint) {
    const { gl } = this, u = this.use("edges", 3, false);
    gl.uniformMatrix4fv(u("camera"), false, camera);
    gl.uniform3fv(u("eye"), this.orbit.eye);
    gl.uniform2fv(u("size"), size);
    gl.uniform1f(u("width"), width);
    gl.uniform4fv(u("tint"), tint);
    gl.enable(gl.BLEND);
    for (const own of this.buffers) {
      const { array, buffers, runs } = this.part(own, name);
      gl.bindVertexArray(array);
      gl.bindBuffer(gl.ARRAY_BUFFER, buffers[0]);
      for (const run of runs) {
        if (!run.count) continue;
        [0, 1].forEach((i) => gl.vertexAttribPointer(i, 3, gl.FLOAT, false, 24, 24 * run.first + 12 * i));
        for (const m of run.matrices) {
          gl.uniformMatrix4fv(u("world"), false, m);
          gl.drawArraysInstanced(gl.TRIANGLE_STRIP, 0, 4, run.count);
        }
      }
    }
    gl.disable(gl.BLEND);
  }

  /** Atlas and face under a point of the canvas, in CSS pixels. */
  faceAt(x, y) {
    const { canvas } = this, [from, along] = this.orbit.ray((2 * x) / canvas.clientWidth - 1, 1 - (2 * y) / canvas.clientHeight, canvas.clientWidth / canvas.clientHeight);
    let best = Infinity, found = null;
    this.atlases.forEach((atlas, n) => {
      const { parts, positions, corners } = atlas[this.which];
      for (const { first, count, matrices } of parts) {
        for (const m of matrices) {
          for (let face = first; face < first + count; face++) {
            const [a, b, c] = [0, 1, 2].map((k) => apply(m, positions.subarray(3 * corners[3 * face + k], 3 * corners[3 * face + k] + 3)));
            const e = minus(b, a), g = minus(c, a), h = cross(along, g), s = minus(from, a), q = cross(s, e), d = dot(e, h);
            const u = dot(s, h) / d, v = dot(along, q) / d, t = dot(g, q) / d;
            if (u >= 0 && v >= 0 && u + v <= 1 && t > 0 && t < best) { best = t; found = { atlas: n, face }; }
          }
        }
      }
    });
    return found;
  }

  listen() {
    const { canvas, pointers, orbit, handlers } = this;
    const at = (event) => { const box = canvas.getBoundingClientRect(); return [event.clientX - box.left, event.clientY - box.top]; };
    let moved = 0;
    canvas.addEventListener("contextmenu", (event) => event.preventDefault());
    canvas.addEventListener("pointerdown", (event) => {
      canvas.setPointerCapture(event.pointerId);
      pointers.set(event.pointerId, at(event));
      if (pointers.size === 1) moved = 0;
    });
    canvas.addEventListener("pointermove", (event) => {
      const now = at(event), before = pointers.get(event.pointerId);
      if (!before) return;
      const [dx, dy] = [now[0] - before[0], now[1] - before[1]];
      moved += Math.hypot(dx, dy);
      if (pointers.size === 2) {
        const other = [...pointers].find(([id]) => id !== event.pointerId)[1];
        orbit.zoom(Math.hypot(now[0] - other[0], now[1] - other[1]) / Math.max(1, Math.hypot(before[0] - other[0], before[1] - other[1])));
        orbit.shift(dx / canvas.clientHeight / 2, dy / canvas.clientHeight / 2);
      } else if (event.shiftKey || event.buttons & 6) orbit.shift(dx / canvas.clientHeight, dy / canvas.clientHeight);
      else orbit.turn(dx / 160, dy / 160);
      pointers.set(event.pointerId, now);
      handlers.moved();
    });
    const up = (event) => {
      if (!pointers.delete(event.pointerId) || event.type !== "pointerup" || moved >= 4 || event.button > 0) return;
      handlers.pick(this, this.faceAt(...at(event)));
    };
    canvas.addEventListener("pointerup", up);
    canvas.addEventListener("pointercancel", up);
    canvas.addEventListener("wheel", (event) => {
      event.preventDefault();
      orbit.zoom(2 ** (-event.deltaY * (event.deltaMode ? 20 : 1) / 400));
      handlers.moved();
    }, { passive: false });
    canvas.addEventListener("keydown", (event) => {
      const by = { ArrowLeft: [1, 0], ArrowRight: [-1, 0], ArrowUp: [0, 1], ArrowDown: [0, -1] }[event.key];
      if (by && event.shiftKey) orbit.shift(-0.05 * by[0], 0.05 * by[1]);
      else if (by) orbit.turn(0.12 * by[0], -0.12 * by[1]);
      else if (event.key === "+" || event.key === "=") orbit.zoom(1.2);
      else if (event.key === "-") orbit.zoom(1 / 1.2);
      else if (event.key === "0" || event.key === "Home") handlers.reset();
      else if (event.key === "Enter" || event.key === " ") handlers.pick(this, this.faceAt(canvas.clientWidth / 2, canvas.clientHeight / 2));
      else if (event.key === "Escape") handlers.pick(this, null);
      else return;
      event.preventDefault();
      handlers.moved();
    });
  }
}
