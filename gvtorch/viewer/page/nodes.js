// Boxes of the tree's nodes over the picture: those whose bricks the last frame read, coloured by their depth.
import { projected } from "./camera.js";
import { corner, EDGES } from "./picture.js";

const DEPTHS = ["#9aa7bd", "#d68cff", "#6fb1ff", "#5fd4c4", "#8fd460", "#e6d35c", "#f2b56b", "#ff7a6b"];

export class NodeBoxes {
  constructor(app) {
    this.app = app;
    this.message = null;
  }

  show(on) {
    this.message = null;
    this.app.link.send("nodes", { on });
    this.app.view.drawOverlay();
  }

  receive(message) {
    this.message = message;
    this.app.view.drawOverlay();
  }

  /** Low and high corner of box n in the world. */
  box(n) {
    const { boxes, low, size, branching } = this.message, [x, y, z, depth] = boxes[n];
    const fraction = branching ** -depth;
    const cornerAt = (step) => [x + step, y + step, z + step].map((coordinate, axis) => low[axis] + Math.min(coordinate * fraction, 1) * size[axis]);
    const high = cornerAt(1).map((coordinate, axis) => Math.min(coordinate, this.app.box[1][axis]));
    return [cornerAt(0), high];
  }

  draw(context, camera) {
    if (!this.message) return;
    const { view } = this.app, { boxes, count } = this.message, paths = new Map();
    boxes.forEach((loc, n) => {
      const box = this.box(n), ends = [...Array(8).keys()].map((index) => projected(camera, corner(box, index)));
      if (!ends.every(Boolean)) return;
      const path = paths.get(loc[3]) ?? new Path2D(), pixels = ends.map((end) => view.pixel(end));
      for (const [a, b] of EDGES) {
        path.moveTo(...pixels[a]);
        path.lineTo(...pixels[b]);
      }
      paths.set(loc[3], path);
    });
    context.lineWidth = view.ratio;
    context.globalAlpha = boxes.length > 300 ? 0.35 : 0.6;
    for (const [depth, path] of paths) {
      context.strokeStyle = DEPTHS[depth % DEPTHS.length];
      context.stroke(path);
    }
    context.globalAlpha = 1;
    const text = count > boxes.length ? `the nearest ${boxes.length} of ${count} nodes` : `${count} nodes`;
    const depths = [...paths.keys()].sort((a, b) => a - b), { pictureArea, ratio } = view;
    const x = (pictureArea.left + pictureArea.width - 12) * ratio;
    view.label(context, text, x, (pictureArea.top + 66 + 15 * depths.length) * ratio, "right");
    depths.forEach((depth, n) => view.label(context, `depth ${depth}`, x, (pictureArea.top + 64 + 15 * n) * ratio, "right", DEPTHS[depth % DEPTHS.length]));
  }
}
