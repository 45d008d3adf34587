// The editor of a transfer function: opacity over the histogram, colours below, both edited by their points.
import { el } from "./dom.js";
import { clamp, hex, linear, short, toSrgb } from "./vectors.js";

const [HEIGHT, STRIP, EDGE, TOP] = [136, 18, 10, 24];  // CSS pixels
const MAX_POINTS = 40;  // points of a function up to which they are drawn and can be edited
const HIT_RADIUS = 9;  // pixels within which a point is hit

/** The range of values of a function's points. */
export function domain(f) {
  const values = [...f.opacity, ...f.color].map((point) => point[0]);
  return [Math.min(...values), Math.max(...values)];
}

/** The function with its points stretched from [a, b] to [low, high]. */
export function stretched(f, [a, b], [low, high]) {
  const move = (points) => points.map(([v, ...rest]) => [low + ((v - a) / (b - a || 1)) * (high - low), ...rest]);
  return { ...f, opacity: move(f.opacity), color: move(f.color) };
}

/** Evaluates a piecewise linear function at v: points by increasing value; constant beyond its ends. */
export function valueAt(points, v) {
  const next = points.findIndex((point) => point[0] >= v);
  if (next === 0) return points[0].slice(1);
  if (next < 0) return points.at(-1).slice(1);
  const [a, b] = [points[next - 1], points[next]];
  const t = (v - a[0]) / (b[0] - a[0] || 1);
  return a.slice(1).map((value, index) => value + t * (b[index + 1] - value));
}

// The opacity axis is a square root, so that small opacities can be set finely.
const up = (alpha) => Math.sqrt(alpha);
const down = (height) => height * height;

export class TransferEditor {
  /** `change(function, rest)` takes an edited function. */
  constructor(change) {
    this.change = change;
    this.histogram = null;
    this.log = true;
    this.canvas = el("canvas.gv-tf", { tabIndex: 0 });
    this.readout = el("span.gv-told");
    this.picker = el("input.gv-hidden", { type: "color" });
    this.element = el("div.gv-transfer", {}, this.canvas, el("div.gv-ends", {}, this.readout), this.picker);
    const on = (name, handler) => this.canvas.addEventListener(name, handler);
    on("pointerdown", (event) => this.down(event));
    on("pointermove", (event) => this.moved(event));
    for (const name of ["pointerup", "pointercancel"]) on(name, () => this.up());
    on("dblclick", (event) => this.recolor(event));
    on("contextmenu", (event) => this.remove(event));
    on("keydown", (event) => { if (["Delete", "Backspace"].includes(event.key)) this.removeChosen(); });
    on("pointerleave", () => { this.readout.textContent = this.rangeText(); });
    this.picker.oninput = () => this.colored(false);
    this.picker.onchange = () => this.colored(true);
    new ResizeObserver(() => this.draw()).observe(this.canvas);
  }

  set(f) {
    this.f = f;
    if (!this.dragged) this.span = this.wholeSpan();
    this.readout.textContent = this.rangeText();
    this.draw();
  }

  setHistogram(histogram) {
    this.histogram = histogram;
    if (this.f) this.set(this.f);
  }

  /** The range of values that the editor shows. */
  wholeSpan() {
    let [low, high] = domain(this.f);
    const h = this.histogram;
    if (h) {
      const total = h.counts.reduce((a, b) => a + b, 0), width = (h.high - h.low) / h.counts.length;
      let sum = 0, last = h.counts.length - 1;
      while (last > 0 && sum + h.counts[last] < total * 2e-5) sum += h.counts[last--];
      low = Math.min(low, h.low);
      high = Math.max(high, h.low + (last + 1) * width);
    }
    return high > low ? [low, high] : [low, low + 1];
  }

  rangeText() {
    const [low, high] = this.f ? domain(this.f) : [0, 1];
    return `${short(low)} – ${short(high)}`;
  }

  get width() { return this.canvas.clientWidth - 2 * EDGE; }
  x(v) { return EDGE + ((v - this.span[0]) / (this.span[1] - this.span[0])) * this.width; }
  v(x) { return this.span[0] + ((x - EDGE) / this.width) * (this.span[1] - this.span[0]); }
  y(alpha) { return TOP + (1 - up(alpha)) * (HEIGHT - TOP); }
  alpha(y) { return clamp(down(clamp(1 - (y - TOP) / (HEIGHT - TOP), 0, 1)), 0, 1); }

  draw() {
    const { canvas } = this, width = canvas.clientWidth;
    if (!this.f || !width) return;
    const ratio = window.devicePixelRatio || 1, height = HEIGHT + STRIP + 12;
    canvas.style.height = `${height}px`;
    [canvas.width, canvas.height] = [Math.round(width * ratio), Math.round(height * ratio)];
    const c = canvas.getContext("2d");
    c.scale(ratio, ratio);
    this.drawHistogram(c);
    this.drawCurve(c);
    this.drawStrip(c);
  }

  drawHistogram(c) {
    const h = this.histogram;
    if (!h) return;
    const scale = this.log ? Math.log1p : (n) => n;
    const maxCount = Math.max(1e-9, ...h.counts.map(scale)), bin = (h.high - h.low) / h.counts.length;
    c.beginPath();
    c.moveTo(this.x(h.low), HEIGHT);
    h.counts.forEach((count, n) => {
      const y = HEIGHT - (scale(count) / maxCount) * (HEIGHT - TOP);
      c.lineTo(this.x(h.low + n * bin), y);
      c.lineTo(this.x(h.low + (n + 1) * bin), y);
    });
    c.lineTo(this.x(h.high), HEIGHT);
    c.save();
    c.clip(new Path2D(`M${EDGE} 0H${EDGE + this.width}V${HEIGHT}H${EDGE}Z`));
    c.fillStyle = "rgba(150,165,190,.22)";
    c.fill();
    c.restore();
  }

  drawCurve(c) {
    const points = this.f.opacity, right = EDGE + this.width;
    const line = new Path2D();
    line.moveTo(EDGE, this.y(points[0][1]));
    // The axis is a square root, so straight parts are drawn in steps.
    for (let n = 0; n <= 160; n += 1) {
      const x = EDGE + (n / 160) * this.width;
      line.lineTo(x, this.y(valueAt(points, this.v(x))[0]));
    }
    const area = new Path2D(line);
    area.lineTo(right, HEIGHT);
    area.lineTo(EDGE, HEIGHT);
    c.fillStyle = this.gradient(c, 0.34);
    c.fill(area);
    c.strokeStyle = "rgba(235,240,250,.9)";
    c.lineWidth = 1.6;
    c.stroke(line);
    c.strokeStyle = "rgba(255,255,255,.12)";
    c.lineWidth = 1;
    c.stroke(new Path2D(`M${EDGE} ${HEIGHT + 0.5}H${right}`));
    if (points.length > MAX_POINTS) return;
    points.forEach(([v, alpha], n) => this.dot(c, this.x(v), this.y(alpha), "#fff", this.chosen?.row === "opacity" && this.chosen.index === n));
  }

  dot(c, x, y, color, chosen) {
    c.beginPath();
    c.arc(x, y, chosen ? 5.5 : 4.2, 0, 2 * Math.PI);
    c.fillStyle = color;
    c.fill();
    c.lineWidth = chosen ? 2.2 : 1.4;
    c.strokeStyle = chosen ? "#7fb4ff" : "rgba(8,10,14,.9)";
    c.stroke();
  }

  gradient(c, opacity) {
    const gradient = c.createLinearGradient(EDGE, 0, EDGE + this.width, 0);
    for (let n = 0; n <= 64; n += 1) {
      const color = valueAt(this.f.color, this.v(EDGE + (n / 64) * this.width));
      const rgb = color.map((channel) => Math.round(255 * toSrgb(clamp(channel, 0, 1))));
      gradient.addColorStop(n / 64, `rgba(${rgb.join(",")},${opacity})`);
    }
    return gradient;
  }

  drawStrip(c) {
    const top = HEIGHT + 4;
    c.fillStyle = this.gradient(c, 1);
    c.beginPath();
    c.roundRect(EDGE, top, this.width, STRIP - 6, 4);
    c.fill();
    if (this.f.color.length > MAX_POINTS) return;
    this.f.color.forEach(([v, ...color], n) => this.dot(c, this.x(v), top + STRIP - 4, hex(color), this.chosen?.row === "color" && this.chosen.index === n));
  }

  /** What is under the pointer: point `index` of the opacity or of the colours, or no point of that row (-1). */
  pointAt(event) {
    const box = this.canvas.getBoundingClientRect();
    const [x, y] = [event.clientX - box.left, event.clientY - box.top];
    const row = y > HEIGHT + 2 ? "color" : "opacity";
    const points = this.f[row];
    const distanceTo = (point) => (row === "color" ? Math.abs(this.x(point[0]) - x) : Math.hypot(this.x(point[0]) - x, this.y(point[1]) - y));
    let index = -1;
    if (points.length <= MAX_POINTS) points.forEach((point, n) => { if (distanceTo(point) < HIT_RADIUS && (index < 0 || distanceTo(point) < distanceTo(points[index]))) index = n; });
    return { row, index, x, y };
  }

  down(event) {
    if (event.button || !this.f) return;
    this.canvas.setPointerCapture(event.pointerId);
    const { row, index, x, y } = this.pointAt(event);
    this.chosen = { row, index };
    if (index < 0) {
      const points = this.f[row], v = this.v(x);
      if (points.length > MAX_POINTS) return;
      const point = row === "color" ? [v, ...valueAt(points, v)] : [v, this.alpha(y)];
      if (points.some((other) => other[0] === v)) return;
      const next = [...points, point].sort((a, b) => a[0] - b[0]);
      this.chosen.index = next.indexOf(point);
      this.applyEdit({ ...this.f, [row]: next }, false);
    }
    this.dragged = this.chosen;
    this.draw();
  }

  moved(event) {
    if (!this.f) return;
    const box = this.canvas.getBoundingClientRect();
    const [x, y] = [event.clientX - box.left, event.clientY - box.top];
    if (!this.dragged) {
      const v = this.v(clamp(x, EDGE, EDGE + this.width));
      this.readout.textContent = `${short(v)}: ${short(100 * valueAt(this.f.opacity, v)[0])} %`;
      return;
    }
    const { row, index } = this.dragged, points = this.f[row].map((point) => [...point]);
    const minGap = (this.span[1] - this.span[0]) * 1e-4;
    const low = index ? points[index - 1][0] + minGap : -Infinity;
    const high = index + 1 < points.length ? points[index + 1][0] - minGap : Infinity;
    points[index][0] = clamp(this.v(clamp(x, EDGE, EDGE + this.width)), low, high);
    if (row === "opacity") points[index][1] = this.alpha(y);
    this.applyEdit({ ...this.f, [row]: points }, false);
    this.readout.textContent = `${short(points[index][0])}: ${row === "opacity" ? `${short(100 * points[index][1])} %` : hex(points[index].slice(1))}`;
  }

  up() {
    if (!this.dragged) return;
    this.dragged = null;
    this.applyEdit(this.f, true);
  }

  applyEdit(f, rest) {
    this.f = f;
    this.draw();
    this.change(f, rest);
  }

  recolor(event) {
    const { row, index } = this.pointAt(event);
    if (row !== "color" || index < 0) return;
    this.chosen = { row, index };
    this.picker.value = hex(this.f.color[index].slice(1));
    this.picker.click();
  }

  colored(rest) {
    if (this.chosen?.row !== "color") return;
    const color = this.f.color.map((point, n) => (n === this.chosen.index ? [point[0], ...linear(this.picker.value)] : point));
    this.applyEdit({ ...this.f, color }, rest);
  }

  remove(event) {
    event.preventDefault();
    const { row, index } = this.pointAt(event);
    this.chosen = { row, index };
    this.removeChosen();
  }

  removeChosen() {
    const { row, index } = this.chosen ?? {};
    if (!row || index < 0 || this.f[row].length < 2) return;
    this.applyEdit({ ...this.f, [row]: this.f[row].filter((_, n) => n !== index) }, true);
    this.chosen = null;
  }
}
