// The clip: its boxes and planes in the world, and their handles in the picture.
import { axes, halfHeight, distance, projected } from "./camera.js";
import { COLORS, corner, EDGES, largestSide } from "./picture.js";
import { add, clamp, cross, dot, sub, times, unit } from "./vectors.js";

const WARM = "242,181,107";
const ARROW = 0.16;  // length, in largest sides of the box

export class ClipEditor {
  constructor(app) {
    this.app = app;
  }

  get clip() {
    return this.app.state?.options.clip ?? null;
  }

  get inWorld() {
    return this.clip.frame === "world";
  }

  get side() {
    return largestSide(this.app.box);
  }

  get middle() {
    const { box } = this.app;
    return [0, 1, 2].map((axis) => (box[0][axis] + box[1][axis]) / 2);
  }

  toBox(place) {
    return times(sub(place, this.middle), 1 / this.side);
  }

  /** The box of the clip in the world, or null. */
  cropBox() {
    const found = this.clip?.boxes?.[0];
    if (!found || found.length !== 2) return null;
    return this.inWorld ? found : found.map((one) => add(times(one, this.side), this.middle));
  }

  /** Plane n in the world: unit normal, to the kept side, and offset. */
  plane(n) {
    const [a, b, c, d] = this.clip.planes[n], length = Math.hypot(a, b, c);
    const normal = [a / length, b / length, c / length];
    if (this.inWorld) return { normal, offset: d / length };
    return { normal, offset: (d / length) * this.side - dot(normal, this.middle) };
  }

  put(clip, rest) {
    const empty = clip && !clip.planes?.length && !clip.boxes?.length && !clip.without?.length;
    this.app.change({ options: { clip: empty ? null : clip } }, rest);
  }

  setCrop(on) {
    const now = this.clip ?? { kind: "Clip", planes: [], boxes: [], without: [], frame: "box" };
    const whole = this.app.box.map((one) => (now.frame === "world" ? one : this.toBox(one)));
    this.put({ ...now, boxes: on ? [whole] : [] }, true);
  }

  addPlane() {
    const { app } = this, { forward } = axes(app.camera), { target } = app.camera;
    const now = this.clip ?? { kind: "Clip", frame: "box", planes: [], boxes: [], without: [] };
    const at = now.frame === "world" ? target : this.toBox(target);
    this.put({ ...now, planes: [...now.planes, [...forward, -dot(forward, at)]] }, true);
  }

  setPlane(n, numbers, rest) {
    this.put({ ...this.clip, planes: this.clip.planes.map((old, at) => (at === n ? numbers : old)) }, rest);
  }

  /** Sets a plane that is given in the world. */
  putPlane(n, normal, offset) {
    const d = this.inWorld ? offset : (offset + dot(normal, this.middle)) / this.side;
    this.setPlane(n, [...normal, d], false);
  }

  moveFace(axis, side, by) {
    const { clip, app } = this, box = clip.boxes[0].map((one) => [...one]);
    const scale = this.inWorld ? 1 : 1 / this.side;
    const thin = this.side * 0.01 * scale;
    const moved = box[side][axis] + by * scale;
    const limit = app.box.map((one) => (this.inWorld ? one : this.toBox(one))[axis]);
    box[side][axis] = side ? clamp(moved, box[0][axis] + thin, limit[1]) : clamp(moved, limit[0], box[1][axis] - thin);
    this.put({ ...clip, boxes: [box] }, false);
  }

  /** Draws boxes and planes; returns their handles. */
  draw(view, context, camera) {
    this.view = view;
    this.camera = camera;
    const handles = [];
    const crop = this.cropBox();
    if (crop) {
      view.edges(context, camera, crop, `rgba(${WARM},.75)`, 1.5);
      this.faces(context, crop, handles);
    }
    (this.clip?.planes ?? []).forEach((_, n) => this.drawPlane(context, n, handles));
    return handles;
  }

  /** Pixel of a world position, and the step in pixels of a displacement from it; null: behind the eye. */
  step(place, way) {
    const ends = [place, add(place, way)].map((one) => projected(this.camera, one));
    if (!ends.every(Boolean)) return null;
    const [at, next] = ends.map((one) => this.view.pixel(one));
    return { at, step: [next[0] - at[0], next[1] - at[1]] };
  }

  faces(context, crop, handles) {
    const centre = [0, 1, 2].map((axis) => (crop[0][axis] + crop[1][axis]) / 2), unit_ = this.side * 0.01;
    for (const axis of [0, 1, 2]) {
      for (const side of [0, 1]) {
        const place = [...centre], way = [0, 0, 0];
        place[axis] = crop[side][axis];
        way[axis] = unit_;
        const found = this.step(place, way);
        if (!found) continue;
        const drag = (dx, dy) => this.along(found.step, dx, dy, unit_, (by) => this.moveFace(axis, side, by));
        handles.push({ kind: "face", axis, side, ...found, drag });
        this.view.dot(context, found.at, COLORS[axis]);
      }
    }
  }

  /** Converts a move of the pointer to a world distance along a direction: `step` pixels there are `size` long. */
  along(step, dx, dy, size, take) {
    const long = step[0] ** 2 + step[1] ** 2;
    if (long > 1e-6) take(((dx * step[0] + dy * step[1]) * size) / long);
  }

  drawPlane(context, n, handles) {
    const { view, camera } = this, { normal, offset } = this.plane(n);
    const anchor = add(this.middle, times(normal, -(dot(normal, this.middle) + offset)));
    const rim = this.rim(normal, offset, anchor).map((one) => projected(camera, one));
    if (rim.length > 2 && rim.every(Boolean)) {
      context.beginPath();
      rim.forEach((one, at) => (at ? context.lineTo(...view.pixel(one)) : context.moveTo(...view.pixel(one))));
      context.closePath();
      context.fillStyle = `rgba(${WARM},.07)`;
      context.fill();
      context.strokeStyle = `rgba(${WARM},.75)`;
      context.lineWidth = 1.5 * view.ratio;
      context.stroke();
    }
    const tip = add(anchor, times(normal, -ARROW * this.side));  // towards what is cut away
    const size = this.side * 0.01, found = this.step(anchor, times(normal, -size)), end = projected(camera, tip);
    if (!found || !end) return;
    context.strokeStyle = `rgb(${WARM})`;
    context.lineWidth = 2 * view.ratio;
    context.beginPath();
    context.moveTo(...found.at);
    context.lineTo(...view.pixel(end));
    context.stroke();
    const move = (by) => this.putPlane(n, normalOf(this.plane(n)), this.plane(n).offset + by);
    handles.push({ kind: "plane", n, ...found, drag: (dx, dy) => this.along(found.step, dx, dy, size, move) });
    handles.push({ kind: "tilt", n, at: view.pixel(end), drag: (dx, dy) => this.tilt(n, dx, dy) });
    view.dot(context, found.at, `rgb(${WARM})`);
    view.dot(context, view.pixel(end), "#fff", 4.5);
  }

  /** Turns a plane around its handle: the end of its arrow follows the pointer. */
  tilt(n, dx, dy) {
    const { camera } = this, { normal, offset } = this.plane(n);
    const anchor = add(this.middle, times(normal, -(dot(normal, this.middle) + offset)));
    const tip = add(anchor, times(normal, -ARROW * this.side));
    const { right, up } = axes(camera), depth = projected(camera, tip)?.depth;
    if (!depth) return;
    const half = camera.model === "ortho" ? halfHeight(camera) : (depth * halfHeight(camera)) / distance(camera);
    const pixel = half / (this.view.part[3] / 2);
    const moved = add(tip, add(times(right, dx * pixel), times(up, -dy * pixel)));
    const turned = unit(sub(anchor, moved));
    this.putPlane(n, turned, -dot(turned, anchor));
  }

  /** The polygon in which a plane cuts the box of the scene: its corners in order. */
  rim(normal, offset, anchor) {
    const { box } = this.app, found = [];
    for (const [a, b] of EDGES) {
      const [p, q] = [corner(box, a), corner(box, b)], [s, t] = [p, q].map((one) => dot(normal, one) + offset);
      if (s * t < 0) found.push(add(p, times(sub(q, p), s / (s - t))));
    }
    if (!found.length) return found;
    const x = unit(sub(found[0], anchor)), y = cross(normal, x);
    const angle = (one) => Math.atan2(dot(sub(one, anchor), y), dot(sub(one, anchor), x));
    return found.sort((one, other) => angle(one) - angle(other));
  }
}

const normalOf = ({ normal }) => normal;
