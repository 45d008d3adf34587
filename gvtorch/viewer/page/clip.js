// The clip: its boxes and planes in the world, and their handles in the picture.
import { axes, halfHeightAt, projected } from "./camera.js";
import { centreOf, COLORS, corner, EDGES, largestSide } from "./picture.js";
import { add, clamp, cross, dot, sub, times, unit } from "./vectors.js";

const WARM = "242,181,107";
const NO_CLIP = { kind: "Clip", planes: [], boxes: [], without: [], frame: "box" };
const ARROW = 0.16;  // length, in largest sides of the box

export class ClipEditor {
  constructor(app) {
    this.app = app;
  }

  get clip() {
    return this.app.state?.options.clip ?? null;
  }

  get inWorld() {
    return (this.clip ?? NO_CLIP).frame === "world";
  }

  get side() {
    return largestSide(this.app.box);
  }

  get middle() {
    return centreOf(this.app.box);
  }

  /** A world position in the frame of the clip. */
  toClip(position) {
    return this.inWorld ? position : times(sub(position, this.middle), 1 / this.side);
  }

  /** The box of the clip in the world, or null. */
  cropBox() {
    const box = this.clip?.boxes?.[0];
    if (!box || box.length !== 2) return null;
    return this.inWorld ? box : box.map((point) => add(times(point, this.side), this.middle));
  }

  /** Plane n in the world: unit normal, to the kept side, offset, and the point nearest to the scene's middle. */
  plane(n) {
    const [a, b, c, d] = this.clip.planes[n], length = Math.hypot(a, b, c);
    const normal = [a / length, b / length, c / length], { middle } = this;
    const offset = this.inWorld ? d / length : (d / length) * this.side - dot(normal, middle);
    return { normal, offset, anchor: add(middle, times(normal, -(dot(normal, middle) + offset))) };
  }

  setClip(clip, rest) {
    const empty = clip && !clip.planes?.length && !clip.boxes?.length && !clip.without?.length;
    this.app.change({ options: { clip: empty ? null : clip } }, rest);
  }

  setCrop(on) {
    const corners = this.app.box.map((point) => this.toClip(point));
    this.setClip({ ...(this.clip ?? NO_CLIP), boxes: on ? [corners] : [] }, true);
  }

  addPlane() {
    const { app } = this, { forward } = axes(app.camera), { target } = app.camera;
    const clip = this.clip ?? NO_CLIP;
    this.setClip({ ...clip, planes: [...clip.planes, [...forward, -dot(forward, this.toClip(target))]] }, true);
  }

  setPlane(n, numbers, rest) {
    this.setClip({ ...this.clip, planes: this.clip.planes.map((old, index) => (index === n ? numbers : old)) }, rest);
  }

  /** Sets a plane that is given in the world. */
  putPlane(n, normal, offset) {
    const d = this.inWorld ? offset : (offset + dot(normal, this.middle)) / this.side;
    this.setPlane(n, [...normal, d], false);
  }

  moveFace(axis, side, amount) {
    const { clip, app } = this, box = clip.boxes[0].map((point) => [...point]);
    const scale = this.inWorld ? 1 : 1 / this.side;
    const minThickness = this.side * 0.01 * scale;
    const moved = box[side][axis] + amount * scale;
    const limit = app.box.map((point) => this.toClip(point)[axis]);
    box[side][axis] = side ? clamp(moved, box[0][axis] + minThickness, limit[1]) : clamp(moved, limit[0], box[1][axis] - minThickness);
    this.setClip({ ...clip, boxes: [box, ...clip.boxes.slice(1)] }, false);
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
  step(position, displacement) {
    const ends = [position, add(position, displacement)].map((point) => projected(this.camera, point));
    if (!ends.every(Boolean)) return null;
    const [pixel, nextPixel] = ends.map((point) => this.view.pixel(point));
    return { at: pixel, step: [nextPixel[0] - pixel[0], nextPixel[1] - pixel[1]] };
  }

  faces(context, crop, handles) {
    const centre = centreOf(crop), stepSize = this.side * 0.01;
    for (const axis of [0, 1, 2]) {
      for (const side of [0, 1]) {
        const anchor = [...centre], displacement = [0, 0, 0];
        anchor[axis] = crop[side][axis];
        displacement[axis] = stepSize;
        const projection = this.step(anchor, displacement);
        if (!projection) continue;
        const drag = (dx, dy) => this.dragAlong(projection.step, dx, dy, stepSize, (amount) => this.moveFace(axis, side, amount));
        handles.push({ kind: "face", axis, side, ...projection, drag });
        this.view.dot(context, projection.at, COLORS[axis]);
      }
    }
  }

  /** Converts a move of the pointer to a world distance along a direction: `step` pixels there are `size` long. */
  dragAlong(step, dx, dy, size, apply) {
    const lengthSquared = step[0] ** 2 + step[1] ** 2;
    if (lengthSquared > 1e-6) apply(((dx * step[0] + dy * step[1]) * size) / lengthSquared);
  }

  drawPlane(context, n, handles) {
    const { view, camera } = this, { normal, offset, anchor } = this.plane(n);
    const rim = this.rim(normal, offset, anchor).map((point) => projected(camera, point));
    if (rim.length > 2 && rim.every(Boolean)) {
      context.beginPath();
      rim.forEach((point, index) => (index ? context.lineTo(...view.pixel(point)) : context.moveTo(...view.pixel(point))));
      context.closePath();
      context.fillStyle = `rgba(${WARM},.07)`;
      context.fill();
      context.strokeStyle = `rgba(${WARM},.75)`;
      context.lineWidth = 1.5 * view.ratio;
      context.stroke();
    }
    const tip = add(anchor, times(normal, -ARROW * this.side));  // towards what is cut away
    const size = this.side * 0.01, projection = this.step(anchor, times(normal, -size)), end = projected(camera, tip);
    if (!projection || !end) return;
    view.line(context, `rgb(${WARM})`, 2, projection.at, view.pixel(end));
    const move = (amount) => {
      const current = this.plane(n);
      this.putPlane(n, current.normal, current.offset + amount);
    };
    handles.push({ kind: "plane", n, ...projection, drag: (dx, dy) => this.dragAlong(projection.step, dx, dy, size, move) });
    handles.push({ kind: "tilt", n, at: view.pixel(end), drag: (dx, dy) => this.tilt(n, dx, dy) });
    view.dot(context, projection.at, `rgb(${WARM})`);
    view.dot(context, view.pixel(end), "#fff", 4.5);
  }

  /** Turns a plane around its handle: the end of its arrow follows the pointer. */
  tilt(n, dx, dy) {
    const { camera } = this, { normal, anchor } = this.plane(n);
    const tip = add(anchor, times(normal, -ARROW * this.side));
    const { right, up } = axes(camera), depth = projected(camera, tip)?.depth;
    if (!depth) return;
    const pixelSize = halfHeightAt(camera, depth) / (this.view.pictureRect[3] / 2);
    const moved = add(tip, add(times(right, dx * pixelSize), times(up, -dy * pixelSize)));
    const turned = unit(sub(anchor, moved));
    this.putPlane(n, turned, -dot(turned, anchor));
  }

  /** The polygon in which a plane cuts the box of the scene: its corners in order. */
  rim(normal, offset, anchor) {
    const { box } = this.app, points = [];
    for (const [a, b] of EDGES) {
      const [p, q] = [corner(box, a), corner(box, b)], [s, t] = [p, q].map((point) => dot(normal, point) + offset);
      if (s * t < 0) points.push(add(p, times(sub(q, p), s / (s - t))));
    }
    if (!points.length) return points;
    const x = unit(sub(points[0], anchor)), y = cross(normal, x);
    const angle = (point) => Math.atan2(dot(sub(point, anchor), y), dot(sub(point, anchor), x));
    return points.sort((point, otherPoint) => angle(point) - angle(otherPoint));
  }
}
