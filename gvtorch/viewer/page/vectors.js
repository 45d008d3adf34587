// Vectors of three numbers, and colours: linear light to and from what displays show (sRGB).

export const add = (a, b) => [a[0] + b[0], a[1] + b[1], a[2] + b[2]];
export const sub = (a, b) => [a[0] - b[0], a[1] - b[1], a[2] - b[2]];
export const times = (a, s) => [a[0] * s, a[1] * s, a[2] * s];
export const dot = (a, b) => a[0] * b[0] + a[1] * b[1] + a[2] * b[2];
export const length = (a) => Math.hypot(a[0], a[1], a[2]);
export const unit = (a) => times(a, 1 / (length(a) || 1));
export const cross = (a, b) => [
  a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0],
];
export const clamp = (x, low, high) => Math.min(high, Math.max(low, x));

/** Turns v around a unit axis (Rodrigues' formula). */
export function turned(v, axis, angle) {
  const c = Math.cos(angle), s = Math.sin(angle);
  const parallel = times(axis, dot(axis, v) * (1 - c));
  return add(add(times(v, c), times(cross(axis, v), s)), parallel);
}

export const toSrgb = (x) => (x <= 0.0031308 ? 12.92 * x : 1.055 * x ** (1 / 2.4) - 0.055);
export const fromSrgb = (x) => (x <= 0.04045 ? x / 12.92 : ((x + 0.055) / 1.055) ** 2.4);

/** #rrggbb of linear red, green, blue. */
export function hex(color) {
  const channel = (x) => Math.round(255 * clamp(toSrgb(clamp(x, 0, 1)), 0, 1));
  return "#" + color.slice(0, 3).map((x) => channel(x).toString(16).padStart(2, "0")).join("");
}

/** Linear red, green, blue of #rrggbb. */
export function linear(text) {
  return [1, 3, 5].map((start) => fromSrgb(parseInt(text.slice(start, start + 2), 16) / 255));
}

/** A number in few digits. */
export function short(x) {
  if (!Number.isFinite(x)) return "–";
  const size = Math.abs(x);
  if (size >= 1e9) return (x / 1e9).toPrecision(3) + " G";
  if (size >= 1e6) return (x / 1e6).toPrecision(3) + " M";
  if (size >= 1e4) return (x / 1e3).toPrecision(3) + " k";
  return String(Number(x.toPrecision(size >= 100 ? 4 : 3)));
}
