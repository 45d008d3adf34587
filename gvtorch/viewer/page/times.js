// The time slider below the picture, for scenes that change with time.
import { el, icon, ICONS } from "./dom.js";
import { short } from "./vectors.js";

const CLOCK_SPAN = 10;  // a clock's slider ends at a multiple of it, since clocks have no end
const CLOCK_STEP = 0.1;  // by which a clock advances while it plays

export class TimeBar {
  constructor(app) {
    this.app = app;
    this.playing = false;
    this.slider = el("input.gv-slider", { type: "range", title: "Time" });
    this.readout = el("span.gv-time-told");
    this.button = el("button.gv-icon", { type: "button", onclick: () => this.play(!this.playing) });
    this.element = el("div.gv-time", {}, this.button, this.slider, this.readout);
    this.slider.oninput = () => this.setTime(Number(this.slider.value), false);
    this.slider.onchange = () => this.setTime(Number(this.slider.value), true);
    this.play(false);
  }

  get times() {
    return this.app.time?.times ?? null;
  }

  show() {
    const { app } = this, { time } = app.state;
    this.element.classList.toggle("gv-shown", !!app.time);
    if (!app.time) return;
    const maxTime = this.times === null ? Math.max(CLOCK_SPAN, Math.ceil(time / CLOCK_SPAN) * CLOCK_SPAN) : this.times - 1;
    Object.assign(this.slider, { min: 0, max: maxTime, step: this.times === null ? maxTime / 200 : 1, value: time });
    const { step, origin, unit } = app.time;
    const worldTime = step ? ` · ${short(origin + time * step)} ${unit ?? ""}`.trimEnd() : "";
    this.readout.textContent = this.times === null ? short(time) : `${time + 1} of ${this.times}${worldTime}`;
  }

  setTime(time, rest) {
    this.app.change({ time }, rest);
    this.show();
  }

  play(on) {
    this.playing = on;
    const text = on ? "Stop" : "Play";
    this.button.replaceChildren(icon(on ? ICONS.stop : ICONS.play));
    Object.assign(this.button, { title: text, ariaLabel: text });
    if (on) this.advance();
    else if (this.app.stateBefore) this.app.finishEdit();
  }

  /** Goes to the next time. */
  advance() {
    const { time } = this.app.state;
    const nextTime = this.times === null ? Number((time + CLOCK_STEP).toFixed(6)) : (time + 1) % this.times;
    this.setTime(nextTime, false);
  }

  /** Handles a picture that was drawn: goes on playing if it shows the present time. */
  drawn(head) {
    if (this.playing && head.time === this.app.state.time) {
      clearTimeout(this.timer);
      this.timer = setTimeout(() => { if (this.playing) this.advance(); }, 40);
    }
  }
}
