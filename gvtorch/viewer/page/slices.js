// Three planes beside the picture: their layout, what is drawn over them, and how the pointer moves them.
import { centreOf, COLORS } from "./picture.js";
import { clamp } from "./vectors.js";

const AXES = ["x", "y", "z"];
const REST_MS = 200;  // milliseconds after which a wheel is at rest

export class SlicesView {
  constructor(app, view) {
    this.app = app;
    this.view = view;
  }

  /** The layout of the newest picture's parts, or null if it has no planes. */
  get layout() {
    return this.app.state?.slices ? this.view.head?.layout ?? null : null;
  }

  /** The world position through which the planes go. */
  get position() {
    return this.app.state.slices.position ?? this.layout.x.position;
  }

  /** The axis of the plane at a position in CSS pixels, or undefined. */
  axisAt(x, y) {
    const { layout } = this, { ratio } = this.view;
    const inside = ([left, top, width, height]) => x * ratio >= left && x * ratio < left + width && y * ratio >= top && y * ratio < top + height;
    return layout ? AXES.find((axis) => inside(layout[axis].pane)) : undefined;
  }

  show(on) {
    this.app.change({ slices: on ? { kind: "Slices", position: centreOf(this.app.box) } : null });
  }

  moveTo(position, rest) {
    this.app.change({ slices: { ...this.app.state.slices, position } }, rest);
  }

  /** Moves the planes to the point that a plane shows at a position in CSS pixels. */
  pick(axis, x, y) {
    const { image: [left, top, width, height], columns, rows } = this.layout[axis];
    const fraction = (pixel, start, size) => clamp((pixel * this.view.ratio - start) / size, 0, 1);
    const position = [...this.position];
    const setCoordinate = ([name, first, last], t) => { position[AXES.indexOf(name)] = first + t * (last - first); };
    setCoordinate(columns, fraction(x, left, width));
    setCoordinate(rows, fraction(y, top, height));
    this.moveTo(position, false);
  }

  /** Moves a plane by one voxel. */
  wheel(axis, amount) {
    const position = [...this.position], { step } = this.layout[axis], index = AXES.indexOf(axis), { box } = this.app;
    const moved = position[index] - Math.sign(amount) * step;
    position[index] = clamp(moved, box[0][index] + step / 2, box[1][index] - step / 2);
    this.moveTo(position, false);
    clearTimeout(this.timer);
    this.timer = setTimeout(() => this.app.finishEdit(), REST_MS);
  }

  draw(context) {
    const { layout } = this, { ratio } = this.view;
    if (!layout) return;
    const position = this.position;
    for (const axis of AXES) {
      const { pane, image, columns, rows, name } = layout[axis];
      const toPixel = ([axisName, first, last], start, size) => start + ((position[AXES.indexOf(axisName)] - first) / (last - first)) * size;
      const [x, y] = [toPixel(columns, image[0], image[2]), toPixel(rows, image[1], image[3])];
      const colorOf = (axisName) => COLORS[AXES.indexOf(axisName)];
      context.globalAlpha = 0.75;  // where the planes across the other axes cut this one
      this.view.line(context, colorOf(columns[0]), 1, [x, image[1]], [x, image[1] + image[3]]);
      this.view.line(context, colorOf(rows[0]), 1, [image[0], y], [image[0] + image[2], y]);
      context.globalAlpha = 1;
      context.strokeStyle = colorOf(axis);
      context.lineWidth = ratio;
      context.strokeRect(pane[0] + 0.5, pane[1] + 0.5, pane[2] - 1, pane[3] - 1);
      const number = Number(position[AXES.indexOf(axis)].toPrecision(5));
      this.view.label(context, `${name}, ${axis} = ${number} ${this.app.unit}`.trim(), pane[0] + 10 * ratio, pane[1] + pane[3] - 10 * ratio, "left");
    }
  }
}
