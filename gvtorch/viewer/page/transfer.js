// The editor of a transfer function: opacity over the histogram, colours below, both edited by their points.
import { el } from "./dom.js";
import { clamp, hex, linear, short, toSrgb } from "./vectors.js";

const [HEIGHT, STRIP, EDGE, TOP] = [136, 18, 10, 24];  // CSS pixels
const MOST = 40;  // points of a function up to which they are drawn and can be edited
const TAKEN = 9;  // pixels within which a point is hit

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
  return a.slice(1).map((one, at) => one + t * (b[at + 1] - one));
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
    this.told = el("span.gv-told");
    this.picker = el("input.gv-hidden", { type: "color" });
    this.element = el("div.gv-transfer", {}, this.canvas, el("div.gv-ends", {}, this.told), this.picker);
    const on = (name, take) => this.canvas.addEventListener(name, take);
    on("pointerdown", (event) => this.down(event));
    on("pointermove", (event) => this.moved(event));
    on("pointerup", () => this.up());
    on("dblclick", (event) => this.recolor(event));
    on("contextmenu", (event) => this.remove(event));
    on("keydown", (event) => { if (["Delete", "Backspace"].includes(event.key)) this.removeChosen(); });
    on("pointerleave", () => { this.told.textContent = this.ends(); });
    this.picker.oninput = () => this.colored(false);
    this.picker.onchange = () => this.colored(true);
    new ResizeObserver(() => this.draw()).observe(this.canvas);
  }

  set(f) {
    this.f = f;
    if (!this.dragged) this.span = this.wholeSpan();
    this.told.textContent = this.ends();
    this.draw();
  }

  setHistogram(histogram) {
    this.histogram = histogram;
    this.span = this.f ? this.wholeSpan() : null;
    this.draw();
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

  ends() {
    const [low, high] = this.f ? domain(this.f) : [0, 1];
    return `${short(low)} – ${short(high)}`;
  }

  get width() { return this.canvas.clientWidth - 2 * EDGE; }
  x(v) { return EDGE + ((v - this.span[0]) / (this.span[1] - this.span[0])) * this.width; }
  v(x) { return this.span[0] + ((x - EDGE) / this.width) * (this.span[1] - this.span[0]); }
  y(alpha) { return TOP + (1 - up(alpha)) * (HEIGHT - TOP); }
  alpha(y) { return clamp(down(clamp(1 - (y - TOP) / (HEIGHT - TOP), 0, 1)), 0, 1); }

  draw() {
    const { canvas } = this, wide = canvas.clientWidth;
    if (!this.f || !wide) return;
    const ratio = window.devicePixelRatio || 1, tall = HEIGHT + STRIP + 12;
    canvas.style.height = `${tall}px`;
    [canvas.width, canvas.height] = [Math.round(wide * ratio), Math.round(tall * ratio)];
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
    const most = Math.max(1e-9, ...h.counts.map(scale)), bin = (h.high - h.low) / h.counts.length;
    c.beginPath();
    c.moveTo(this.x(h.low), HEIGHT);
    h.counts.forEach((count, n) => {
      const y = HEIGHT - (scale(count) / most) * (HEIGHT - TOP);
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
    if (points.length > MOST) return;
    points.forEach(([v, alpha], n) => this.dot(c, this.x(v), this.y(alpha), "#fff", this.chosen?.what === "opacity" && this.chosen.at === n));
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
    const made = c.createLinearGradient(EDGE, 0, EDGE + this.width, 0);
    for (let n = 0; n <= 64; n += 1) {
      const color = valueAt(this.f.color, this.v(EDGE + (n / 64) * this.width));
      const parts = color.map((one) => Math.round(255 * toSrgb(clamp(one, 0, 1))));
      made.addColorStop(n / 64, `rgba(${parts.join(",")},${opacity})`);
    }
    return made;
  }

  drawStrip(c) {
    const top = HEIGHT + 4;
    c.fillStyle = this.gradient(c, 1);
    c.beginPath();
    c.roundRect(EDGE, top, this.width, STRIP - 6, 4);
    c.fill();
    if (this.f.color.length > MOST) return;
    this.f.color.forEach(([v, ...color], n) => this.dot(c, this.x(v), top + STRIP - 4, hex(color), this.chosen?.what === "color" && this.chosen.at === n));
  }

  /** What is under the pointer: point `at` of the opacity or of the colours, or no point of that row (-1). */
  found(event) {
    const box = this.canvas.getBoundingClientRect();
    const [x, y] = [event.clientX - box.left, event.clientY - box.top];
    const what = y > HEIGHT + 2 ? "color" : "opacity";
    const points = this.f[what];
    const far = (point) => (what === "color" ? Math.abs(this.x(point[0]) - x) : Math.hypot(this.x(point[0]) - x, this.y(point[1]) - y));
    let at = -1;
    if (points.length <= MOST) points.forEach((point, n) => { if (far(point) < TAKEN && (at < 0 || far(point) < far(points[at]))) at = n; });
    return { what, at, x, y };
  }

  down(event) {
    if (event.button || !this.f) return;
    this.canvas.setPointerCapture(event.pointerId);
    const { what, at, x, y } = this.found(event);
    this.chosen = { what, at };
    if (at < 0) {
      const points = this.f[what], v = this.v(x);
      if (points.length > MOST) return;
      const point = what === "color" ? [v, ...valueAt(points, v)] : [v, this.alpha(y)];
      if (points.some((one) => one[0] === v)) return;
      const next = [...points, point].sort((a, b) => a[0] - b[0]);
      this.chosen.at = next.indexOf(point);
      this.edited({ ...this.f, [what]: next }, false);
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
      this.told.textContent = `${short(v)}: ${short(100 * valueAt(this.f.opacity, v)[0])} %`;
      return;
    }
    const { what, at } = this.dragged, points = this.f[what].map((point) => [...point]);
    const apart = (this.span[1] - this.span[0]) * 1e-4;
    const low = at ? points[at - 1][0] + apart : -Infinity;
    const high = at + 1 < points.length ? points[at + 1][0] - apart : Infinity;
    points[at][0] = clamp(this.v(clamp(x, EDGE, EDGE + this.width)), low, high);
    if (what === "opacity") points[at][1] = this.alpha(y);
    this.edited({ ...this.f, [what]: points }, false);
    this.told.textContent = `${short(points[at][0])}: ${what === "opacity" ? `${short(100 * points[at][1])} %` : hex(points[at].slice(1))}`;
  }

  up() {
    if (!this.dragged) return;
    this.dragged = null;
    this.edited(this.f, true);
  }

  edited(f, rest) {
    this.f = f;
    this.draw();
    this.change(f, rest);
  }

  recolor(event) {
    const { what, at } = this.found(event);
    if (what !== "color" || at < 0) return;
    this.chosen = { what, at };
    this.picker.value = hex(this.f.color[at].slice(1));
    this.picker.click();
  }

  colored(rest) {
    if (this.chosen?.what !== "color") return;
    const color = this.f.color.map((point, n) => (n === this.chosen.at ? [point[0], ...linear(this.picker.value)] : point));
    this.edited({ ...this.f, color }, rest);
  }

  remove(event) {
    event.preventDefault();
    const { what, at } = this.found(event);
    this.chosen = { what, at };
    this.removeChosen();
  }

  removeChosen() {
    const { what, at } = this.chosen ?? {};
    if (!what || at < 0 || this.f[what].length < 2) return;
    this.edited({ ...this.f, [what]: this.f[what].filter((_, n) => n !== at) }, true);
    this.chosen = null;
  }
}
