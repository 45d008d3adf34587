// The table of labels: the colour of each, and whether it is shown.
import { el, textButton } from "./dom.js";
import { hex, linear } from "./vectors.js";

const MAX_ROWS = 60;  // shown at a time

export class LabelTable {
  constructor(app) {
    this.app = app;
    this.search = "";
    this.filter = el("input", { type: "text", placeholder: "find a label", oninput: () => { this.search = this.filter.value.trim(); this.fill(); } });
    this.body = el("div.gv-labels");
  }

  get shader() {
    return this.app.state.shader;
  }

  change(part, rest = true) {
    this.app.change({ shader: { ...this.shader, ...part } }, rest);
    if (rest) this.fill();  // else a row is still being edited
  }

  /** Colours that were chosen, by label. */
  get chosen() {
    const { colors } = this.shader;
    if (Array.isArray(colors)) return Object.fromEntries(colors.map((color, n) => [n, color]));
    return colors && !colors.kept ? colors : {};
  }

  shows(name) {
    const { visible } = this.shader;
    return visible === null ? name !== 0 : (Array.isArray(visible) ? visible.includes(name) : true);
  }

  rows() {
    const { labels } = this.app;
    if (this.shader.kind !== "Labels" || !labels) return [];
    const button = (text, title, visible) => textButton(text, title, () => this.change({ visible }));
    this.fill();
    return [
      el("div.gv-row", {}, el("span.gv-name", {}, `${labels.count} labels`), el("span.gv-both", {}, this.filter,
        button("all", "Show all but 0, the background", null), button("none", "Hide all", []))),
      this.body,
    ];
  }

  fill() {
    const { names, colors, count } = this.app.labels, { chosen } = this;
    const matches = names.map((_, n) => n).filter((n) => String(names[n]).includes(this.search));
    const rows = matches.slice(0, MAX_ROWS).map((n) => this.row(names[n], chosen[names[n]] ?? colors[n]));
    const note = (n, text) => (n ? [el("div.gv-dim", {}, `${n} ${text}`)] : []);
    this.body.replaceChildren(...rows, ...note(matches.length - rows.length, "more: find them by number"),
      ...note(count - names.length, `labels above ${names.at(-1)} have no row`));
  }

  row(name, color) {
    const paint = (rest) => (event) => this.change({ colors: { ...this.chosen, [name]: linear(event.target.value) } }, rest);
    const visibleWith = (on) => {
      const shown = this.app.labels.names.filter((label) => this.shows(label) && label !== name);
      return on ? [...shown, name].sort((a, b) => a - b) : shown;
    };
    const { visible } = this.shader, { names, count } = this.app.labels;
    const disabled = count > names.length && !Array.isArray(visible);  // a list would hide those without a row
    return el("div.gv-row.gv-label", {},
      el("input.gv-flag", { type: "checkbox", title: disabled ? "There are too many labels to hide one of them" : "Show it", disabled, checked: this.shows(name), onchange: (event) => this.change({ visible: visibleWith(event.target.checked) }) }),
      el("input.gv-color", { type: "color", title: "Its colour", value: hex(color), oninput: paint(false), onchange: paint(true) }),
      el("span", {}, String(name)), el("span.gv-gap"),
      textButton("only", "Show this one alone", () => this.change({ visible: [name] })));
  }
}
