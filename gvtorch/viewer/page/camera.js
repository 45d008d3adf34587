// A camera as in the state, {eye, target, up, fov, model}, and how it moves; no DOM here.
import { add, clamp, cross, dot, length, sub, times, turned, unit } from "./vectors.js";

/** The camera models by name, as the server describes them: {parallel, planar}. */
export const MODELS = {};

export const distance = (c) => length(sub(c.target, c.eye));

/** Unit vectors to the right, up and forward of the picture. */
export function axes(c) {
  const forward = unit(sub(c.target, c.eye));
  let right = cross(forward, c.up);
  if (length(right) < 1e-9 * length(c.up)) right = cross(forward, Math.abs(c.up[2]) > 0.9 ? [0, 1, 0] : [0, 0, -1]);
  right = unit(right);
  return { right, up: cross(right, forward), forward };
}

/** Half the picture's height in world units, at the target's distance. */
export const halfHeight = (c) => distance(c) * Math.tan(((Math.min(c.fov, 170) / 2) * Math.PI) / 180);

/** The same at a depth along the axis. */
export const halfHeightAt = (c, depth) => (MODELS[c.model].parallel ? halfHeight(c) : (depth * halfHeight(c)) / distance(c));

/** Turns a vector around the camera's up by -yaw, and around the axis `right` towards the pole by pitch (radians). */
function swung(c, vector, right, yaw, pitch) {
  const pole = unit(c.up), angle = Math.acos(clamp(dot(unit(vector), pole), -1, 1));  // from the pole
  const tilt = clamp(angle - pitch, 0.02, Math.PI - 0.02) - angle;
  return turned(turned(vector, right, tilt), pole, -yaw);
}

/** Orbits the target by angles (radians) to the right and up. */
export function orbited(c, yaw, pitch) {
  return { ...c, eye: add(c.target, swung(c, sub(c.eye, c.target), axes(c).right, yaw, pitch)) };
}

/** Turns the view direction by angles (radians), from the same position. */
export function lookedAround(c, yaw, pitch) {
  return { ...c, target: add(c.eye, swung(c, sub(c.target, c.eye), times(axes(c).right, -1), yaw, pitch)) };
}

export function shifted(c, move) {
  return { ...c, eye: add(c.eye, move), target: add(c.target, move) };
}

/** Shifts by x, y in half heights of the picture, so that a point at the target's distance stays under the pointer. */
export function panned(c, x, y) {
  const { right, up } = axes(c), half = halfHeight(c);
  return shifted(c, add(times(right, -x * half), times(up, y * half)));
}

/** The world position, at the target's distance, of a point of the picture: x, y in half heights from its middle. */
export function worldPoint(c, x, y) {
  const { right, up } = axes(c), half = halfHeight(c);
  return add(c.target, add(times(right, x * half), times(up, -y * half)));
}

/** Scales the distance to a world position: nearer if factor < 1. */
export function zoomed(c, factor, centre) {
  const scaled = (p) => add(centre, times(sub(p, centre), factor));
  return { ...c, eye: scaled(c.eye), target: scaled(c.target) };
}

/** Looks along an axis (0, 1, 2) from its positive or negative side (+1, -1). */
export function facing(c, axis, side, up) {
  const away = [0, 0, 0];
  away[axis] = side;
  const isParallel = Math.abs(dot(unit(up), away)) > 0.9;
  const alternative = axis === 1 ? [0, 0, -side] : [0, 1, 0];
  return { ...c, eye: add(c.target, times(away, distance(c))), up: isParallel ? alternative : up };
}

/** Projects a world position: half heights from the picture's middle (x right, y down), depth; null: behind the eye. */
export function projected(c, position) {
  const { right, up, forward } = axes(c), offset = sub(position, c.eye);
  const depth = dot(offset, forward);
  const half = halfHeightAt(c, depth);
  if (!MODELS[c.model].parallel && depth <= 1e-9 * distance(c)) return null;
  return { x: dot(offset, right) / half, y: -dot(offset, up) / half, depth };
}

/** Interpolates two cameras; t from 0 to 1. */
export function between(a, b, t) {
  const mix = (p, q) => add(times(p, 1 - t), times(q, t));
  const targetDistance = Math.exp((1 - t) * Math.log(distance(a)) + t * Math.log(distance(b)));
  const target = mix(a.target, b.target);
  let away = mix(unit(sub(a.eye, a.target)), unit(sub(b.eye, b.target)));
  if (length(away) < 1e-3) away = add(away, times(axes(a).right, 0.1));
  let up = mix(unit(a.up), unit(b.up));
  if (length(up) < 1e-3) up = b.up;
  return { ...b, target, eye: add(target, times(unit(away), targetDistance)), up, fov: (1 - t) * a.fov + t * b.fov };
}
