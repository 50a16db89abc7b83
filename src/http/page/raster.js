// Faces drawn into numbers: which face covers a pixel of a sheet, and how many do.

/** Longest side, in pixels. */
const LONGEST = 1536;

/** A page of a side as `{ids, layers, width, height, scale, x, y}`: pixel (i, j) is the texel (x + i / scale, y + j / scale). */
export function rasterise(side, page) {
  const { layout: l } = side;
  const sheet = side.sheets[page] ?? side.sheets[0];
  const area = region(side, page, sheet);
  const scale = Math.min(4, LONGEST / Math.max(area.width, area.height));
  const width = Math.max(1, Math.round(area.width * scale)), height = Math.max(1, Math.round(area.height * scale));
  const ids = new Uint32Array(width * height), layers = new Uint8Array(width * height);
  const x = [0, 0, 0], y = [0, 0, 0];
  for (let f = 0; f < side.shown; f++) {
    if (l.pages[f] !== page) continue;
    for (let k = 0; k < 3; k++) {
      const c = 2 * l.corners[3 * f + k];
      x[k] = (l.uvs[c] - area.x) * scale;
      y[k] = (l.uvs[c + 1] - area.y) * scale;
    }
    const low = Math.max(0, Math.ceil(Math.min(...y) - 0.5)), high = Math.min(height, Math.ceil(Math.max(...y) - 0.5));
    for (let row = low; row < high; row++) {
      const middle = row + 0.5;
      let from = Infinity, to = -Infinity;
      for (let k = 0; k < 3; k++) {
        // Ends in a fixed order, so that both faces of an edge find the same crossing.
        let i = k, j = (k + 1) % 3;
        if (y[i] > y[j] || (y[i] === y[j] && x[i] > x[j])) [i, j] = [j, i];
        if (y[i] === y[j] || middle < y[i] || middle > y[j]) continue;
        const at = x[i] + ((x[j] - x[i]) * (middle - y[i])) / (y[j] - y[i]);
        from = Math.min(from, at);
        to = Math.max(to, at);
      }
      const first = Math.max(0, Math.ceil(from - 0.5)), last = Math.min(width, Math.ceil(to - 0.5));
      for (let i = row * width + first; i < row * width + last; i++) {
        ids[i] = f + 1;
        if (layers[i] < 255) layers[i]++;
      }
    }
  }
  return { ids, layers, width, height, scale, x: area.x, y: area.y, sheet };
}

/** The sheet, and as much about it as charts need that leave it. */
function region(side, page, [w, h]) {
  let [x0, y0, x1, y1] = [0, 0, w, h];
  const { box, page: pages } = side.tables;
  for (let c = 0; c < side.charts; c++) {
    if (pages[c] !== page || !Number.isFinite(box[4 * c])) continue;
    x0 = Math.min(x0, Math.max(box[4 * c], -2 * w));
    y0 = Math.min(y0, Math.max(box[4 * c + 1], -2 * h));
    x1 = Math.max(x1, Math.min(box[4 * c + 2], 3 * w));
    y1 = Math.max(y1, Math.min(box[4 * c + 3], 3 * h));
  }
  return { x: Math.floor(x0), y: Math.floor(y0), width: Math.ceil(x1) - Math.floor(x0), height: Math.ceil(y1) - Math.floor(y0) };
}

/** A canvas of the raster's size, each pixel as `paint(face + 1, layers, index)` says: [r, g, b, a] or null. */
export function painted(raster, paint) {
  const canvas = new OffscreenCanvas(raster.width, raster.height);
  const context = canvas.getContext("2d", { willReadFrequently: true });
  const image = context.createImageData(raster.width, raster.height);
  for (let i = 0; i < raster.ids.length; i++) {
    const colour = paint(raster.ids[i], raster.layers[i], i);
    if (colour) image.data.set(colour, 4 * i);
  }
  context.putImageData(image, 0, 0);
  return canvas;
}

/** By pixel, whether it is free and within `reach` texels of a chart. */
export function gutters(raster, reach) {
  const { ids, width, height } = raster, steps = Math.max(1, Math.round(reach * raster.scale));
  const far = steps + 1;
  // Distances along rows, then columns: squares about covered pixels, as gutters are counted.
  const distance = new Uint16Array(ids.length);
  for (let row = 0; row < height; row++) {
    let d = far;
    for (let i = 0; i < width; i++) { d = ids[row * width + i] ? 0 : Math.min(d + 1, far); distance[row * width + i] = d; }
    d = far;
    for (let i = width - 1; i >= 0; i--) { d = ids[row * width + i] ? 0 : Math.min(d + 1, far); distance[row * width + i] = Math.min(distance[row * width + i], d); }
  }
  const near = new Uint8Array(ids.length);
  for (let i = 0; i < width; i++) {
    for (const [from, to, by] of [[0, height, 1], [height - 1, -1, -1]]) {
      let since = far;
      for (let row = from; row !== to; row += by) {
        const at = row * width + i;
        since = distance[at] <= steps ? 0 : Math.min(since + 1, far);
        if (!ids[at] && since <= steps) near[at] = 1;
      }
    }
  }
  return near;
}
