// Key frames: states of this page, each at a time, in the format of `gvtorch fly --keys`.
import { el, iconButton, textButton, saveFile, openJson } from "./dom.js";

const KEY_SPACING = 2;  // seconds from a key to the next

export class Film {
  constructor(app) {
    this.app = app;
    this.keys = [];  // {time, state}, by time
  }

  /** Rows of the panel. */
  rows() {
    const keys = this.keys.map((key, index) => {
      const time = el("input", { type: "number", min: 0, step: 0.5, value: key.time, title: "Seconds", onchange: () => this.move(index, time.valueAsNumber) });
      return el("div.gv-row", {}, el("span.gv-name", {}, `key ${index + 1}`), el("span.gv-both", {}, time,
        textButton("show", "Show this key", () => this.app.load(key.state)),
        textButton("remove", "Remove this key", () => this.setKeys(this.keys.filter((otherKey) => otherKey !== key)))));
    });
    return [...keys, el("div.gv-bar", {},
      textButton("add this view", "What is shown now, after the last key", () => this.add()),
      el("span.gv-gap"),
      this.keys.length ? iconButton("save", "Save the keys (JSON): gvtorch fly --keys", () => saveFile("keys.json", JSON.stringify(this.keys, null, 1), "application/json")) : null,
      iconButton("open", "Load keys that were saved (JSON)", () => openJson((keys) => this.load(keys), (reason) => this.app.notify(reason, true))))];
  }

  add() {
    const time = this.keys.length ? this.keys.at(-1).time + KEY_SPACING : 0;
    this.setKeys([...this.keys, { time, state: { ...this.app.state, camera: this.app.camera } }]);
  }

  /** Moves a key to another time. */
  move(index, time) {
    if (Number.isFinite(time) && !this.keys.some((key, n) => n !== index && key.time === time)) {
      return this.setKeys(this.keys.map((key, n) => (n === index ? { ...key, time } : key)));
    }
    this.app.notify("each key has a time of its own", true);
    this.app.refresh();
  }

  load(keys) {
    const isKey = (key) => Number.isFinite(key?.time) && key.state?.camera && key.state.shader;
    if (Array.isArray(keys) && keys.length && keys.every(isKey) && new Set(keys.map((key) => key.time)).size === keys.length) return this.setKeys(keys);
    this.app.notify("these are no keys: each must have a time of its own, in seconds, and a whole state", true);
  }

  setKeys(keys) {
    const before = this.keys, after = [...keys].sort((a, b) => a.time - b.time);
    const set = (keys) => { this.keys = keys; this.app.refresh(); };
    this.app.history.push(() => set(before), () => set(after));
    set(after);
  }
}
