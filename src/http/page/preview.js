// Reads preview.bin: surfaces, layouts, figures by face and pictures, before and after. Its layout: api/preview.md.

const NONE = 0x7fffffff;
const UV_STEPS = 256;
const LOG_STEPS = 1024;

/** Bits of `flags`. */
export const BORDER = 1;
export const SEAM = 8;
export const FLIPPED = 64;
export const RESAMPLED = 128;

export async function readPreview(buffer) {
  const view = new DataView(buffer);
  if (buffer.byteLength < 12 || view.getUint32(0) !== 0x494e5450) throw new Error("the preview is no preview");
  if (view.getUint32(4, true) !== 1) throw new Error("the preview was made by another version of Intarsia");
  const length = view.getUint32(8, true);
  const header = JSON.parse(new TextDecoder().decode(new Uint8Array(buffer, 12, length)));
  const part = (section) => new Uint8Array(buffer, 12 + length + section.offset, section.bytes);
  const atlases = await Promise.all(header.atlases.map(async (atlas) => {
    const before = await readSide(atlas.before, part);
    const after = atlas.after ? await readSide(atlas.after, part) : before;
    const slots = atlas.slots.map((slot) => ({
      name: slot.name, wrap: slot.wrap,
      before: slot.before.map((page) => page && picture(page, part)),
      after: slot.after ? slot.after.map((page) => picture(page, part)) : null,
    }));
    slots.forEach((slot) => { slot.after ??= slot.before; });
    return { id: atlas.id, name: atlas.name, kept: atlas.kept, slots, before, after };
  }));
  return { triangles: header.triangles, shown: header.shown, atlases };
}

function picture(page, part) {
  let bitmap = null;
  return {
    size: page.size, pixels: page.pixels,
    /** Decoded when it is first wanted. */
    bitmap: () => (bitmap ??= createImageBitmap(new Blob([part(page)], { type: page.media_type }), { premultiplyAlpha: "none", colorSpaceConversion: "none" })),
  };
}

async function inflate(bytes) {
  const stream = new Blob([bytes]).stream().pipeThrough(new DecompressionStream("deflate"));
  return new Uint8Array(await new Response(stream).arrayBuffer());
}

/** Differences, zigzag, the four bytes of all apart. */
async function numbers(section, part) {
  const planes = await inflate(part(section));
  const { count: n, width } = section;
  const values = new Uint32Array(n);
  for (let i = 0; i < n; i++) {
    const zigzag = planes[i] | (planes[n + i] << 8) | (planes[2 * n + i] << 16) | (planes[3 * n + i] << 24);
    values[i] = (i < width ? 0 : values[i - width]) + ((zigzag >>> 1) ^ -(zigzag & 1));
  }
  return values;
}

async function readSide(told, part) {
  const [positions, corners] = await Promise.all([numbers(told.positions, part), numbers(told.corners, part)]);
  const side = {
    triangles: told.triangles, shown: told.shown, charts: told.charts, sheets: told.sheets, parts: told.parts,
    positions: new Float32Array(positions.buffer), corners, layout: null,
  };
  if (told.layout) {
    const l = told.layout;
    const names = ["uvs", "corners", "pages", "charts", "counterparts", "density", "distortion"];
    const read = await Promise.all([...names.map((name) => numbers(l[name], part)), inflate(part(l.flags))]);
    const [uvs, uvCorners, pages, charts, counterparts, density, distortion, flags] = read;
    const log = (values) => Float32Array.from(new Int32Array(values.buffer), (v) => (v === NONE ? NaN : v / LOG_STEPS));
    side.layout = {
      uvs: Float32Array.from(new Int32Array(uvs.buffer), (v) => v / UV_STEPS),
      corners: uvCorners, pages, charts, counterparts, flags,
      logDensity: log(density), logDistortion: log(distortion),
    };
    side.tables = chartTables(side);
  }
  return side;
}

/** Figures of each chart, and its faces. */
function chartTables(side) {
  const { layout: l, positions: p, corners } = side;
  const n = side.charts, faces = side.shown;
  const table = {
    triangles: new Uint32Array(n), area: new Float64Array(n), texels: new Float64Array(n), distortion: new Float64Array(n), flipped: new Uint32Array(n),
    resampled: new Uint32Array(n), page: new Uint16Array(n), box: new Float32Array(4 * n).fill(Infinity), first: new Uint32Array(n + 1), faces: new Uint32Array(faces),
  };
  for (let c = 0; c < n; c++) table.box[4 * c + 2] = table.box[4 * c + 3] = -Infinity;
  for (let f = 0; f < faces; f++) {
    const c = l.charts[f];
    table.triangles[c]++;
    table.page[c] = l.pages[f];
    if (l.flags[f] & FLIPPED) table.flipped[c]++;
    if (l.flags[f] & RESAMPLED) table.resampled[c]++;
    const [i, j, k] = [0, 1, 2].map((q) => 3 * corners[3 * f + q]);
    const e = [p[j] - p[i], p[j + 1] - p[i + 1], p[j + 2] - p[i + 2]], g = [p[k] - p[i], p[k + 1] - p[i + 1], p[k + 2] - p[i + 2]];
    const area = 0.5 * Math.hypot(e[1] * g[2] - e[2] * g[1], e[2] * g[0] - e[0] * g[2], e[0] * g[1] - e[1] * g[0]);
    const [a, b, d] = [0, 1, 2].map((q) => 2 * l.corners[3 * f + q]);
    const u = l.uvs;
    table.area[c] += area;
    table.texels[c] += 0.5 * Math.abs((u[b] - u[a]) * (u[d + 1] - u[a + 1]) - (u[d] - u[a]) * (u[b + 1] - u[a + 1]));
    if (!Number.isNaN(l.logDistortion[f])) table.distortion[c] += area * 2 ** l.logDistortion[f];
    for (const q of [a, b, d]) {
      table.box[4 * c] = Math.min(table.box[4 * c], u[q]);
      table.box[4 * c + 1] = Math.min(table.box[4 * c + 1], u[q + 1]);
      table.box[4 * c + 2] = Math.max(table.box[4 * c + 2], u[q]);
      table.box[4 * c + 3] = Math.max(table.box[4 * c + 3], u[q + 1]);
    }
  }
  for (let c = 0; c < n; c++) table.first[c + 1] = table.first[c] + table.triangles[c];
  const next = table.first.slice();
  for (let f = 0; f < faces; f++) table.faces[next[l.charts[f]]++] = f;
  return table;
}

/** The charts on the other side that a chart's faces lie in, the most faces first. */
export function counterparts(side, chart) {
  const counts = new Map();
  for (let i = side.tables.first[chart]; i < side.tables.first[chart + 1]; i++) {
    const other = side.layout.counterparts[side.tables.faces[i]];
    if (other !== NONE) counts.set(other, (counts.get(other) ?? 0) + 1);
  }
  return [...counts].sort((a, b) => b[1] - a[1] || a[0] - b[0]).map(([other]) => other);
}
