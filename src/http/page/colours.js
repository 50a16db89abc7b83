// Colours of charts, as in the pictures of a job, and of maps.

const srgb = (x) => { const v = Math.min(Math.max(x, 0), 1); return Math.round(255 * (v <= 0.0031308 ? 12.92 * v : 1.055 * v ** (1 / 2.4) - 0.055)); };

/** Hues a golden ratio apart, three lightnesses in turn, in OKLCh. */
export function chartColour(chart) {
  const hue = ((chart * 0.6180339887498949 + 0.07) % 1) * 2 * Math.PI;
  const [lightness, chroma] = [[0.79, 0.115], [0.7, 0.125], [0.86, 0.085]][chart % 3];
  const a = chroma * Math.cos(hue), b = chroma * Math.sin(hue);
  const l = (lightness + 0.3963377774 * a + 0.2158037573 * b) ** 3, m = (lightness - 0.1055613458 * a - 0.0638541728 * b) ** 3;
  const s = (lightness - 0.0894841775 * a - 1.291485548 * b) ** 3;
  return [4.0767416621 * l - 3.3077115913 * m + 0.2309699292 * s, -1.2684380046 * l + 2.6097574011 * m - 0.3413193965 * s, -0.0041960863 * l - 0.7034186147 * m + 1.707614701 * s].map(srgb);
}

/** Stops of the maps: from low to high. */
export const RAMPS = {
  density: [[33, 73, 147], [117, 169, 209], [240, 240, 236], [226, 147, 86], [148, 48, 20]],
  distortion: [[68, 1, 84], [59, 82, 139], [33, 145, 140], [94, 201, 98], [253, 231, 37]],
};

export function ramp(stops, t) {
  const x = Math.min(Math.max(t, 0), 1) * (stops.length - 1), i = Math.min(Math.floor(x), stops.length - 2);
  return stops[i].map((v, k) => v + (stops[i + 1][k] - v) * (x - i));
}
