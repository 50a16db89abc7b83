// The model in 3D, drawn with WebGL 2 alone.

import { chartColour, RAMPS } from "./colours.js";

export const MODES = [["texture", "Texture"], ["checker", "Checkerboard"], ["charts", "Charts"], ["density", "Texel density"], ["distortion", "Stretch"], ["resampled", "Resampled"]];

const VERTEX = `#version 300 es
layout(location = 0) in vec3 position;
layout(location = 1) in vec2 uv;
layout(location = 2) in vec4 colour;
layout(location = 3) in vec2 figures;
layout(location = 4) in uvec2 charts;
layout(location = 5) in uint bits;
uniform mat4 world, camera;
out vec3 place;
out vec2 at;
out vec3 inside;
flat out vec4 own;
flat out vec2 figure;
flat out uvec2 chart;
flat out uint flags;
void main() {
  vec4 p = world * vec4(position, 1.0);
  int k = gl_VertexID % 3;
  place = p.xyz;
  at = uv;
  inside = vec3(k == 0, k == 1, k == 2);
  own = colour;
  figure = figures;
  chart = charts;
  flags = bits;
  gl_Position = camera * p;
}`;

const FRAGMENT = `#version 300 es
precision highp float;
precision highp int;
in vec3 place;
in vec2 at;
in vec3 inside;
flat in vec4 own;
flat in vec2 figure;
flat in uvec2 chart;
flat in uint flags;
uniform sampler2D picture;
uniform vec3 eye;
uniform vec2 sheet;
uniform float median;
uniform int mode;
uniform bool textured, wire, seams, otherSide;
uniform uint lit;
uniform vec3 low[5];
uniform vec3 high[5];
out vec4 pixel;
vec3 map(vec3 stops[5], float t) {
  float x = clamp(t, 0.0, 1.0) * 4.0;
  vec3 c = stops[0];
  for (int i = 0; i < 4; i++) c = mix(c, stops[i + 1], clamp(x - float(i), 0.0, 1.0));
  return c;
}
void main() {
  vec3 normal = normalize(cross(dFdx(place), dFdy(place)));
  float light = 0.42 + 0.58 * abs(dot(normal, normalize(eye - place)));
  vec3 c = vec3(0.62);
  if (mode == 0) {
    if (textured) { c = texture(picture, at / sheet).rgb; light = mix(1.0, light, 0.28); }
  } else if (mode == 1) {
    vec2 cell = floor(at / 16.0), coarse = floor(at / 128.0);
    float fine = mod(cell.x + cell.y, 2.0), large = mod(coarse.x + coarse.y, 2.0);
    float blur = clamp(fwidth(at.x + at.y) / 16.0 - 0.4, 0.0, 1.0);
    c = mix(mix(vec3(0.93, 0.92, 0.89), vec3(0.30, 0.34, 0.40), fine), vec3(0.61), blur);
    c *= mix(vec3(1.0), vec3(0.86, 0.95, 1.0), large);
  } else if (mode == 2) {
    c = own.rgb;
  } else if (mode == 3) {
    c = figure.x < -500.0 ? vec3(0.55) : map(low, (figure.x - median) / 4.0 + 0.5);
  } else if (mode == 4) {
    c = figure.y < -500.0 ? vec3(0.55) : map(high, (figure.y - 2.0) / 2.0);
  } else {
    c = (flags & 128u) != 0u ? vec3(0.90, 0.48, 0.12) : vec3(0.55, 0.66, 0.62);
  }
  c *= light;
  vec3 width = fwidth(inside);
  if (wire) {
    vec3 d = smoothstep(vec3(0.0), width * 1.1, inside);
    c = mix(vec3(0.05), c, 0.45 + 0.55 * min(min(d.x, d.y), d.z));
  }
  bool on = lit != 0xffffffffu && (otherSide ? chart.y : chart.x) == lit;
  if (lit != 0xffffffffu) c = on ? mix(c, vec3(1.0, 0.84, 0.04), 0.62) : c * 0.62;
  if (seams) {
    vec3 d = inside / max(width, vec3(1e-6));
    bool near = ((flags & 8u) != 0u && d.z < 1.4) || ((flags & 16u) != 0u && d.x < 1.4) || ((flags & 32u) != 0u && d.y < 1.4);
    if (near) c = mode == 0 || mode == 1 ? vec3(0.95, 0.12, 0.25) : vec3(0.04, 0.05, 0.09);
  }
  pixel = vec4(c, 1.0);
}`;

const NOT_LIT = 0xffffffff;
const STRIDE = 44;
/** Milliseconds that a view may take, of two in a frame. */
const FLUENT = 14;
/** A figure that a face does not have. */
const UNKNOWN = -1000;

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
    const dot = (a) => -(a[0] * eye[0] + a[1] * eye[1] + a[2] * eye[2]);
    const a = (far + near) / (near - far), b = (2 * far * near) / (near - far);
    return new Float32Array([right[0] * fx, up[0] * fy, back[0] * a, -back[0], right[1] * fx, up[1] * fy, back[1] * a, -back[1],
      right[2] * fx, up[2] * fy, back[2] * a, -back[2], dot(right) * fx, dot(up) * fy, dot(back) * a + b, -dot(back)]);
  }

  /** Where the ray through a point of the view (-1 to 1) begins, and its direction. */
  ray(x, y, aspect) {
    const { right, up, back } = this.axes, t = Math.tan(0.3), tx = aspect < 1 ? t : t * aspect, ty = aspect < 1 ? t / aspect : t;
    return [this.eye, back.map((v, k) => -v + right[k] * x * tx + up[k] * y * ty)];
  }

  toString() { return [this.yaw, this.pitch, this.distance, ...this.target].map((v) => v.toPrecision(9)).join(" "); }
}

const apply = (m, [x, y, z]) => [0, 1, 2].map((k) => m[k] * x + m[4 + k] * y + m[8 + k] * z + m[12 + k]);

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
    const gl = (this.gl = canvas.getContext("webgl2", { antialias: true, alpha: false, powerPreference: "high-performance" }));
    if (!gl) throw new Error("no WebGL 2");
    this.prepare();
    canvas.addEventListener("webglcontextlost", (event) => event.preventDefault());
    canvas.addEventListener("webglcontextrestored", () => { this.textures.clear(); this.prepare(); if (this.atlases) this.load(this.atlases, this.which); });
    this.listen();
  }

  prepare() {
    const { gl } = this, program = (this.program = gl.createProgram());
    for (const [kind, source] of [[gl.VERTEX_SHADER, VERTEX], [gl.FRAGMENT_SHADER, FRAGMENT]]) {
      const shader = gl.createShader(kind);
      gl.shaderSource(shader, source);
      gl.compileShader(shader);
      gl.attachShader(program, shader);
    }
    gl.linkProgram(program);
    if (!gl.getProgramParameter(program, gl.LINK_STATUS)) throw new Error(gl.getProgramInfoLog(program) || "no shaders");
    this.at = new Map();
    this.uniform = (name) => { if (!this.at.has(name)) this.at.set(name, gl.getUniformLocation(program, name)); return this.at.get(name); };
    gl.enable(gl.DEPTH_TEST);
  }

  /** Takes a side of all atlases. */
  load(atlases, which) {
    Object.assign(this, { atlases, which });
    const { gl } = this;
    this.buffers.forEach((b) => { gl.deleteVertexArray(b.array); gl.deleteBuffer(b.buffer); });
    this.buffers = atlases.map((atlas, n) => this.buffer(atlas[which], n));
    const known = atlases.flatMap((a) => [...(a.before.layout?.logDensity ?? a.after.layout?.logDensity ?? [])]).filter((v) => !Number.isNaN(v)).sort((a, b) => a - b);
    this.median = known[known.length >> 1] ?? 0;
    this.draw();
  }

  buffer(side, atlas) {
    const { gl } = this, { layout: l } = side, data = new ArrayBuffer(STRIDE * 3 * side.shown);
    const floats = new Float32Array(data), words = new Uint32Array(data), octets = new Uint8Array(data);
    const runs = [];
    let vertex = 0;
    for (const part of side.parts) {
      const pages = new Map();
      for (let f = part.first; f < part.first + part.count; f++) {
        const page = l ? l.pages[f] : 0;
        if (!pages.has(page)) pages.set(page, []);
        pages.get(page).push(f);
      }
      for (const [page, faces] of pages) {
        runs.push({ page, first: vertex, count: 3 * faces.length, matrices: part.matrices.map((m) => new Float32Array(m)) });
        for (const f of faces) {
          const colour = l ? chartColour(l.charts[f]) : [150, 155, 160];
          for (let k = 0; k < 3; k++, vertex++) {
            const at = (STRIDE / 4) * vertex, p = 3 * side.corners[3 * f + k];
            floats.set(side.positions.subarray(p, p + 3), at);
            if (l) {
              const c = 2 * l.corners[3 * f + k];
              floats[at + 3] = l.uvs[c];
              floats[at + 4] = l.uvs[c + 1];
            }
            octets.set(colour, STRIDE * vertex + 20);
            floats[at + 6] = l && !Number.isNaN(l.logDensity[f]) ? l.logDensity[f] : UNKNOWN;
            floats[at + 7] = l && !Number.isNaN(l.logDistortion[f]) ? l.logDistortion[f] : UNKNOWN;
            words[at + 8] = l ? l.charts[f] : NOT_LIT - 1;
            words[at + 9] = l ? l.counterparts[f] : NOT_LIT - 1;
            words[at + 10] = l ? l.flags[f] : 0;
          }
        }
      }
    }
    const array = gl.createVertexArray(), buffer = gl.createBuffer();
    gl.bindVertexArray(array);
    gl.bindBuffer(gl.ARRAY_BUFFER, buffer);
    gl.bufferData(gl.ARRAY_BUFFER, data, gl.STATIC_DRAW);
    [[0, 3, gl.FLOAT, 0], [1, 2, gl.FLOAT, 12], [3, 2, gl.FLOAT, 24]].forEach(([i, n, kind, offset]) => { gl.enableVertexAttribArray(i); gl.vertexAttribPointer(i, n, kind, false, STRIDE, offset); });
    gl.enableVertexAttribArray(2);
    gl.vertexAttribPointer(2, 4, gl.UNSIGNED_BYTE, true, STRIDE, 20);
    [[4, 2, 32], [5, 1, 40]].forEach(([i, n, offset]) => { gl.enableVertexAttribArray(i); gl.vertexAttribIPointer(i, n, gl.UNSIGNED_INT, STRIDE, offset); });
    gl.bindVertexArray(null);
    return { array, buffer, runs, side, atlas };
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
    this.draw();
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
    const { gl, canvas, orbit } = this, ratio = Math.min(devicePixelRatio || 1, 2) * (this.moving ? this.share : 1);
    const width = Math.round(canvas.clientWidth * ratio), height = Math.round(canvas.clientHeight * ratio);
    if (!width || !height || gl.isContextLost()) return;
    if (canvas.width !== width || canvas.height !== height) Object.assign(canvas, { width, height });
    canvas.dataset.camera = orbit.toString();
    const clear = getComputedStyle(document.documentElement).getPropertyValue("--stage").trim().match(/[\da-f]{2}/gi) ?? ["e9", "e7", "e1"];
    gl.viewport(0, 0, width, height);
    gl.clearColor(...clear.map((v) => parseInt(v, 16) / 255), 1);
    gl.clear(gl.COLOR_BUFFER_BIT | gl.DEPTH_BUFFER_BIT);
    gl.useProgram(this.program);
    const u = this.uniform, shown = this.shown;
    gl.uniformMatrix4fv(u("camera"), false, orbit.matrix(width / height));
    gl.uniform3fv(u("eye"), orbit.eye);
    gl.uniform1i(u("mode"), MODES.findIndex(([name]) => name === shown.mode));
    gl.uniform1i(u("wire"), shown.wire);
    gl.uniform1i(u("seams"), shown.seams);
    gl.uniform1f(u("median"), this.median);
    gl.uniform3fv(u("low"), RAMPS.density.flat().map((v) => v / 255));
    gl.uniform3fv(u("high"), RAMPS.distortion.flat().map((v) => v / 255));
    for (const { array, runs, side, atlas } of this.buffers) {
      const lit = this.lit;
      gl.uniform1ui(u("lit"), !lit ? NOT_LIT : lit.atlas === atlas ? lit.chart : NOT_LIT - 2);
      gl.uniform1i(u("otherSide"), lit?.otherSide ?? false);
      gl.bindVertexArray(array);
      for (const run of runs) {
        const texture = this.textures.get(`${atlas} ${this.slot} ${run.page}`);
        gl.uniform1i(u("textured"), !!texture);
        gl.bindTexture(gl.TEXTURE_2D, texture ?? null);
        gl.uniform2fv(u("sheet"), side.sheets[run.page] ?? [1, 1]);
        for (const m of run.matrices) {
          gl.uniformMatrix4fv(u("world"), false, m);
          gl.drawArrays(gl.TRIANGLES, run.first, run.count);
        }
      }
    }
    gl.bindVertexArray(null);
    if (!this.moving) return;
    // What is read has been drawn.
    gl.readPixels(0, 0, 1, 1, gl.RGBA, gl.UNSIGNED_BYTE, new Uint8Array(4));
    const took = performance.now() - started;
    if (took > FLUENT) this.share = Math.max(0.25, this.share * 0.7);
    else if (took < FLUENT / 3) this.share = Math.min(1, this.share * 1.15);
  }

  /** Atlas and face under a point of the canvas, in CSS pixels. */
  faceAt(x, y) {
    const { canvas } = this, aspect = canvas.clientWidth / canvas.clientHeight;
    const [from, along] = this.orbit.ray((2 * x) / canvas.clientWidth - 1, 1 - (2 * y) / canvas.clientHeight, aspect);
    let best = Infinity, found = null;
    this.atlases.forEach((atlas, n) => {
      const side = atlas[this.which], p = side.positions;
      for (const part of side.parts) {
        for (const m of part.matrices) {
          for (let f = part.first; f < part.first + part.count; f++) {
            const [i, j, k] = [3 * side.corners[3 * f], 3 * side.corners[3 * f + 1], 3 * side.corners[3 * f + 2]];
            const world = (q, r) => m[r] * p[q] + m[4 + r] * p[q + 1] + m[8 + r] * p[q + 2] + m[12 + r];
            const a0 = world(i, 0), a1 = world(i, 1), a2 = world(i, 2);
            const e0 = world(j, 0) - a0, e1 = world(j, 1) - a1, e2 = world(j, 2) - a2, g0 = world(k, 0) - a0, g1 = world(k, 1) - a1, g2 = world(k, 2) - a2;
            const h0 = along[1] * g2 - along[2] * g1, h1 = along[2] * g0 - along[0] * g2, h2 = along[0] * g1 - along[1] * g0;
            const d = e0 * h0 + e1 * h1 + e2 * h2;
            if (d === 0) continue;
            const s0 = from[0] - a0, s1 = from[1] - a1, s2 = from[2] - a2, u = (s0 * h0 + s1 * h1 + s2 * h2) / d;
            if (u < 0 || u > 1) continue;
            const q0 = s1 * e2 - s2 * e1, q1 = s2 * e0 - s0 * e2, q2 = s0 * e1 - s1 * e0, v = (along[0] * q0 + along[1] * q1 + along[2] * q2) / d;
            if (v < 0 || u + v > 1) continue;
            const t = (g0 * q0 + g1 * q1 + g2 * q2) / d;
            if (t > 0 && t < best) { best = t; found = { atlas: n, face: f }; }
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
