// The time slider below the picture, for scenes that change with time.
import { el, icon, ICONS } from "./dom.js";
import { short } from "./vectors.js";

const SPAN = 10;  // a clock's slider ends at a multiple of it, since clocks have no end
const STEP = 0.1;  // by which a clock advances while it plays

export class TimeBar {
  constructor(app) {
    this.app = app;
    this.playing = false;
    this.slider = el("input.gv-slider", { type: "range", title: "Time" });
    this.told = el("span.gv-time-told");
    this.button = el("button.gv-icon", { type: "button", onclick: () => this.play(!this.playing) });
    this.element = el("div.gv-time", {}, this.button, this.slider, this.told);
    this.slider.oninput = () => this.go(Number(this.slider.value), false);
    this.slider.onchange = () => this.go(Number(this.slider.value), true);
    this.play(false);
  }

  get times() {
    return this.app.time?.times ?? null;
  }

  show() {
    const { app } = this, { time } = app.state;
    this.element.classList.toggle("gv-shown", !!app.time);
    if (!app.time) return;
    const most = this.times === null ? Math.max(SPAN, Math.ceil(time / SPAN) * SPAN) : this.times - 1;
    Object.assign(this.slider, { min: 0, max: most, step: this.times === null ? most / 200 : 1, value: time });
    const { step, origin, unit } = app.time;
    const world = step ? ` · ${short(origin + time * step)} ${unit ?? ""}`.trimEnd() : "";
    this.told.textContent = this.times === null ? short(time) : `${time + 1} of ${this.times}${world}`;
  }

  go(time, rest) {
    this.app.change({ time }, rest);
    this.show();
  }

  play(on) {
    this.playing = on;
    const text = on ? "Stop" : "Play";
    this.button.replaceChildren(icon(on ? ICONS.stop : ICONS.play));
    Object.assign(this.button, { title: text, ariaLabel: text });
    if (on) this.next();
    else if (this.app.before) this.app.settle();
  }

  /** Goes to the next time. */
  next() {
    const { time } = this.app.state;
    const after = this.times === null ? Number((time + STEP).toFixed(6)) : (time + 1) % this.times;
    this.go(after, false);
  }

  /** Handles a picture that was drawn: goes on playing if it shows the present time. */
  drawn(head) {
    if (this.playing && head.time === this.app.state.time) {
      clearTimeout(this.timer);
      this.timer = setTimeout(() => { if (this.playing) this.next(); }, 40);
    }
  }
}
