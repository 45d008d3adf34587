// Boxes of the tree's nodes over the picture: those whose bricks the last frame read, coloured by their depth.
import { projected } from "./camera.js";
import { corner, EDGES } from "./picture.js";

const DEPTHS = ["#9aa7bd", "#d68cff", "#6fb1ff", "#5fd4c4", "#8fd460", "#e6d35c", "#f2b56b", "#ff7a6b"];

export class NodeBoxes {
  constructor(app) {
    this.app = app;
    this.told = null;
  }

  show(on) {
    this.told = null;
    this.app.link.send("nodes", { on });
    this.app.view.overlay();
  }

  take(told) {
    this.told = told;
    this.app.view.overlay();
  }

  /** Low and high corner of box n in the world. */
  box(n) {
    const { boxes, low, size, branching } = this.told, [x, y, z, depth] = boxes[n];
    const share = branching ** -depth;
    const end = (at) => [x + at, y + at, z + at].map((one, axis) => low[axis] + Math.min(one * share, 1) * size[axis]);
    const high = end(1).map((one, axis) => Math.min(one, this.app.box[1][axis]));
    return [end(0), high];
  }

  draw(context, camera) {
    if (!this.told) return;
    const { view } = this.app, { boxes, count } = this.told, paths = new Map();
    boxes.forEach((one, n) => {
      const box = this.box(n), ends = [...Array(8).keys()].map((at) => projected(camera, corner(box, at)));
      if (!ends.every(Boolean)) return;
      const path = paths.get(one[3]) ?? new Path2D(), pixels = ends.map((end) => view.pixel(end));
      for (const [a, b] of EDGES) {
        path.moveTo(...pixels[a]);
        path.lineTo(...pixels[b]);
      }
      paths.set(one[3], path);
    });
    context.lineWidth = view.ratio;
    context.globalAlpha = boxes.length > 300 ? 0.35 : 0.6;
    for (const [depth, path] of paths) {
      context.strokeStyle = DEPTHS[depth % DEPTHS.length];
      context.stroke(path);
    }
    context.globalAlpha = 1;
    const left = count > boxes.length ? `the nearest ${boxes.length} of ${count} nodes` : `${count} nodes`;
    const depths = [...paths.keys()].sort((a, b) => a - b), { area, ratio } = view;
    const right = (area.left + area.width - 12) * ratio;
    view.label(context, left, right, (area.top + 66 + 15 * depths.length) * ratio, "right");
    depths.forEach((depth, n) => view.label(context, `depth ${depth}`, right, (area.top + 64 + 15 * n) * ratio, "right", DEPTHS[depth % DEPTHS.length]));
  }
}
