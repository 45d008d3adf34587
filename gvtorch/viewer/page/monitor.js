// Figures of the frames, as they come: time by stage, rates, pools, misses.
import { el } from "./dom.js";
import { short } from "./vectors.js";

const MAX_FRAMES = 120;
const STAGE_COLORS = ["#6fb1ff", "#f2b56b", "#8fd460", "#d68cff", "#ff7a6b", "#5fd4c4", "#e6d35c", "#9aa7bd"];

export class MonitorView {
  constructor(app) {
    this.app = app;
    this.frames = [];
    this.times = [];
    this.chart = el("canvas.gv-chart");
    this.misses = el("canvas.gv-chart");
    this.stages = el("div.gv-stages");
    this.table = el("div.gv-figures");
    this.element = el("div.gv-monitor", {},
      el("div.gv-caption", {}, "milliseconds a frame"), this.chart, this.stages,
      el("div.gv-caption", {}, "bricks missed, of those wanted"), this.misses, this.table);
  }

  /** Notes when a picture was drawn. */
  drawn() {
    const now = performance.now();
    this.times = [...this.times.filter((time) => now - time < 2000), now];
  }

  receive(figures) {
    this.frames.push(figures);
    if (this.frames.length > MAX_FRAMES) this.frames.shift();
    this.draw();
  }

  draw() {
    const last = this.frames.at(-1);
    if (!last || !this.element.isConnected) return;
    const names = [...new Set(this.frames.flatMap((frame) => Object.keys(frame.stages)))];
    this.bars(names);
    this.line();
    const topStages = names.filter((name) => last.stages[name] >= 0.05).sort((a, b) => last.stages[b] - last.stages[a]).slice(0, 8);
    this.stages.replaceChildren(...topStages.map((name) => el("span.gv-stage-name", {},
      el("i", { style: { background: STAGE_COLORS[names.indexOf(name) % STAGE_COLORS.length] } }), `${name} ${last.stages[name].toFixed(1)}`)));
    const report = last.report, rows = [
      ["pictures / s", short(this.rate())],
      ["from hand to picture", this.latency()],
      ["samples", short(last.samples)],
      ["rays", short(last.rays)],
      ["bricks used", short(last.bricks_used)],
      ["requests", short(Object.values(last.requests ?? {}).reduce((a, b) => a + b, 0))],
    ];
    if (report) {
      rows.push(["bricks / s", short(report.bricks_per_second)]);
      rows.push(["hit rate", `${(100 * report.hit_rate).toFixed(1)} %`]);
      for (const [name, fraction] of Object.entries(report.occupancy)) rows.push([`${name} in use`, `${(100 * fraction).toFixed(1)} %`]);
    }
    if (last.failed) rows.push(["failed", short(last.failed)]);
    this.table.replaceChildren(...rows.flatMap(([name, value]) => [el("span", {}, name), el("b", {}, String(value))]));
  }

  rate() {
    const now = performance.now();
    return this.times.filter((time) => now - time < 2000).length / 2;
  }

  latency() {
    const sorted = [...this.app.view.latencies].sort((a, b) => a - b);
    if (!sorted.length) return "–";
    const percentile = (fraction) => sorted[Math.min(sorted.length - 1, Math.floor(fraction * sorted.length))].toFixed(0);
    return `${percentile(0.5)} ms, 95 %: ${percentile(0.95)} ms`;
  }

  prepareCanvas(canvas) {
    const ratio = window.devicePixelRatio || 1, [width, height] = [canvas.clientWidth, canvas.clientHeight];
    [canvas.width, canvas.height] = [width * ratio, height * ratio];
    const c = canvas.getContext("2d");
    c.scale(ratio, ratio);
    return { c, width, height };
  }

  bars(names) {
    const { c, width, height } = this.prepareCanvas(this.chart);
    const sums = this.frames.map((frame) => frame.milliseconds);
    const typical = [...sums].sort((a, b) => a - b)[Math.floor(0.9 * (sums.length - 1))];
    const limit = Math.max(20, 1.3 * typical), step = width / MAX_FRAMES;
    this.frames.forEach((frame, n) => {
      let y = height;
      const x = width - (this.frames.length - n) * step;
      names.forEach((name, index) => {
        const barHeight = ((frame.stages[name] ?? 0) / limit) * height;
        c.fillStyle = STAGE_COLORS[index % STAGE_COLORS.length];
        c.fillRect(x, y - barHeight, Math.max(1, step - 0.5), barHeight);
        y -= barHeight;
      });
    });
    c.fillStyle = "rgba(235,240,250,.6)";
    c.font = "10px system-ui, sans-serif";
    c.fillText(`${limit.toFixed(0)} ms`, 3, 10);
  }

  line() {
    const { c, width, height } = this.prepareCanvas(this.misses), step = width / MAX_FRAMES;
    c.beginPath();
    this.frames.forEach((frame, n) => {
      const x = width - (this.frames.length - n - 0.5) * step, y = height - 2 - (frame.miss_rate ?? 0) * (height - 4);
      if (n) c.lineTo(x, y);
      else c.moveTo(x, y);
    });
    c.strokeStyle = "#f2b56b";
    c.lineWidth = 1.5;
    c.stroke();
  }
}
