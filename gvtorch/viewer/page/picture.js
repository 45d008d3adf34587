// The canvas: pictures as they come, and over them axes, scale bar, boxes and handles.
import { axes, halfHeight, MODELS, projected } from "./camera.js";
import { el } from "./dom.js";
import { short } from "./vectors.js";

export const COLORS = ["#ff7a6b", "#8fd460", "#6fb1ff"];  // x, y, z
export const EDGES = [[0, 1], [2, 3], [4, 5], [6, 7], [0, 2], [1, 3], [4, 6], [5, 7], [0, 4], [1, 5], [2, 6], [3, 7]];
const HIT_RADIUS = 12;  // pixels within which a handle is hit

/** Corner n of a box: bit 0 is x, bit 1 y, bit 2 z. */
export const corner = (box, n) => [0, 1, 2].map((axis) => box[(n >> axis) & 1][axis]);

export class PictureView {
  constructor(app) {
    this.app = app;
    this.canvas = el("canvas.gv-picture");
    this.overlayCanvas = el("canvas.gv-over");
    this.element = el("div.gv-stage", { tabIndex: 0 }, this.canvas, this.overlayCanvas);
    this.handles = [];
    this.axisLetters = [];
    this.drawing = Promise.resolve();
    this.latencies = [];
    new ResizeObserver(() => this.resized()).observe(this.element);
  }

  resized() {
    const ratio = Math.min(window.devicePixelRatio || 1, 2);
    const { width, height } = this.element.getBoundingClientRect();
    if (width < 16 || height < 16) return;
    this.width = width;
    this.height = height;
    const size = [Math.round(width * ratio), Math.round(height * ratio)];
    [this.overlayCanvas.width, this.overlayCanvas.height] = size;
    this.ratio = ratio;
    clearTimeout(this.timer);
    this.timer = setTimeout(() => this.sendSize(), 60);
    this.drawOverlay();
  }

  sendSize() {
    if (!this.width) return;
    const scale = 4096 / Math.max(this.overlayCanvas.width, this.overlayCanvas.height, 4096);
    const [width, height] = [this.overlayCanvas.width, this.overlayCanvas.height].map((n) => Math.max(16, Math.round(n * scale)));
    this.app.link.send("hello", { width, height });
  }

  /** Shows pictures one after another; one that can't be shown is reported. */
  receive({ head, bytes }) {
    this.drawing = this.drawing.then(() => this.show(head, bytes)).catch((error) => this.app.notify(String(error), true));
  }

  /** Draws a picture, then acknowledges it. */
  async show(head, bytes) {
    try {
      const image = await createImageBitmap(new Blob([bytes], { type: "image/jpeg" }));
      const { canvas } = this;
      if (canvas.width !== this.overlayCanvas.width || canvas.height !== this.overlayCanvas.height) {
        [canvas.width, canvas.height] = [this.overlayCanvas.width, this.overlayCanvas.height];
      }
      const context = canvas.getContext("2d", { alpha: false });
      context.imageSmoothingQuality = "high";
      context.drawImage(image, 0, 0, canvas.width, canvas.height);
      image.close();
    } finally {
      this.app.link.send("ack", { number: head.number });
    }
    if (head.sent) {
      this.latencies.push(performance.now() - head.sent);
      if (this.latencies.length > 500) this.latencies.shift();
    }
    this.head = head;
    this.drawOverlay();
    this.element.dispatchEvent(new CustomEvent("drawn", { detail: head }));
  }

  /** The part of the canvas that the picture covers, [left, top, width, height] in pixels: all of it without planes. */
  get pictureRect() {
    return this.app.slices.layout?.view ?? [0, 0, this.overlayCanvas.width, this.overlayCanvas.height];
  }

  /** This part in CSS pixels. */
  get pictureArea() {
    const [left, top, width, height] = this.pictureRect.map((number) => number / this.ratio);
    return { left, top, width, height };
  }

  /** Canvas pixels of a point that is given in half heights from the picture's middle. */
  pixel({ x, y }) {
    const [left, top, width, height] = this.pictureRect;
    return [left + width / 2 + (x * height) / 2, top + height / 2 + (y * height) / 2];
  }

  drawOverlay() {
    const { app } = this, { camera } = app;
    const context = this.overlayCanvas.getContext("2d");
    context.clearRect(0, 0, this.overlayCanvas.width, this.overlayCanvas.height);
    this.handles = [];
    this.axisLetters = [];
    if (!camera || !app.box) return;
    context.lineCap = "round";
    app.slices.draw(context);
    if (!MODELS[camera.model].planar) return;
    context.save();
    context.beginPath();
    context.rect(...this.pictureRect);
    context.clip();
    app.nodes.draw(context, camera);
    if (app.overlays.box) this.edges(context, camera, app.box, "rgba(255,255,255,.28)", 1);
    this.handles = app.clip.draw(this, context, camera);
    if (app.overlays.axes) this.gizmo(context, camera);
    if (app.overlays.scale) this.scaleBar(context, camera);
    context.restore();
  }

  edges(context, camera, box, color, width) {
    context.strokeStyle = color;
    context.lineWidth = width * this.ratio;
    context.beginPath();
    for (const [a, b] of EDGES) {
      const [from, to] = [a, b].map((n) => projected(camera, corner(box, n)));
      if (!from || !to) continue;
      context.moveTo(...this.pixel(from));
      context.lineTo(...this.pixel(to));
    }
    context.stroke();
  }

  /** Draws a line through canvas pixels. */
  line(context, color, width, first, ...others) {
    context.strokeStyle = color;
    context.lineWidth = width * this.ratio;
    context.beginPath();
    context.moveTo(...first);
    for (const position of others) context.lineTo(...position);
    context.stroke();
  }

  /** Draws a handle. */
  dot(context, position, color, size = 6) {
    context.beginPath();
    context.arc(...position, size * this.ratio, 0, 2 * Math.PI);
    context.fillStyle = color;
    context.fill();
    context.lineWidth = 2 * this.ratio;
    context.strokeStyle = "rgba(10,12,16,.9)";
    context.stroke();
  }

  /** Draws text over the picture, with a dark rim, so that it is legible on any background. */
  label(context, text, x, y, align, color = "rgba(255,255,255,.92)") {
    context.font = `500 ${12 * this.ratio}px system-ui, sans-serif`;
    context.textAlign = align;
    context.textBaseline = "bottom";
    context.strokeStyle = "rgba(0,0,0,.55)";
    context.lineWidth = 3 * this.ratio;
    context.lineJoin = "round";
    context.strokeText(text, x, y);
    context.fillStyle = color;
    context.fillText(text, x, y);
  }

  /** The handle at a position in CSS pixels, or undefined. */
  handleAt(x, y) {
    const distanceTo = ({ at }) => Math.hypot(at[0] / this.ratio - x, at[1] / this.ratio - y);
    const hits = this.handles.filter((handle) => distanceTo(handle) < HIT_RADIUS);
    return hits.reduce((best, handle) => (best && distanceTo(best) < distanceTo(handle) ? best : handle), undefined);  // of equals the topmost
  }

  gizmo(context, camera) {
    const { right, up, forward } = axes(camera), size = 30 * this.ratio;
    const [left, top, , height] = this.pictureRect;
    const middle = [left + 52 * this.ratio, top + height - 56 * this.ratio];
    const order = [0, 1, 2].map((axis) => ({ axis, x: right[axis], y: -up[axis], z: forward[axis] })).sort((a, b) => b.z - a.z);
    for (const { axis, x, y, z } of order) {
      const end = [middle[0] + x * size, middle[1] + y * size];
      context.globalAlpha = z > 0.3 ? 0.55 : 1;
      this.line(context, COLORS[axis], 2.2, middle, end);
      context.fillStyle = COLORS[axis];
      context.font = `600 ${12 * this.ratio}px system-ui, sans-serif`;
      context.textAlign = "center";
      context.textBaseline = "middle";
      const letter = [middle[0] + x * size * 1.38, middle[1] + y * size * 1.38];
      context.fillText("xyz"[axis], ...letter);
      this.axisLetters.push({ axis, at: letter, side: 1 });
    }
    context.globalAlpha = 1;
  }

  /** The axis whose letter is at a position in CSS pixels, or undefined. */
  axisAt(x, y) {
    const isNear = ({ at }) => Math.hypot(at[0] - x * this.ratio, at[1] - y * this.ratio) < HIT_RADIUS * this.ratio;
    return this.axisLetters.find(isNear);
  }

  scaleBar(context, camera) {
    const [left, top, width, height] = this.pictureRect;
    const pixelSize = (2 * halfHeight(camera)) / height;
    const maxSize = 130 * this.ratio * pixelSize;
    const power = 10 ** Math.floor(Math.log10(maxSize));
    const size = [5, 2, 1].map((n) => n * power).find((n) => n <= maxSize) ?? power;
    const span = size / pixelSize, y = top + height - (this.app.time ? 62 : 26) * this.ratio;
    const middle = left + width / 2, [a, b] = [middle - span / 2, middle + span / 2];
    const text = `${short(size)} ${this.app.unit}`.trim();
    const tip = y - 4 * this.ratio, ends = [[a, tip], [a, y], [b, y], [b, tip]];
    this.line(context, "rgba(0,0,0,.55)", 4, ...ends);
    this.line(context, "rgba(255,255,255,.88)", 1.5, ...ends);
    this.label(context, text, middle, y - 5 * this.ratio, "center");
  }
}

/** The centre of a box. */
export const centreOf = ([low, high]) => low.map((start, axis) => (start + high[axis]) / 2);

/** The largest side of a box. */
export const largestSide = (box) => Math.max(...[0, 1, 2].map((axis) => box[1][axis] - box[0][axis]));
