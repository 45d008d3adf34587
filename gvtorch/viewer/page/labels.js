// The table of labels: the colour of each, and whether it is shown.
import { el } from "./dom.js";
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
    return visible === null ? name !== 0 : visible === "all" || visible.includes(name);
  }

  rows() {
    const { labels } = this.app;
    if (this.shader.kind !== "Labels" || !labels) return [];
    const button = (text, title, visible) => el("button.gv-small", { type: "button", title, onclick: () => this.change({ visible }) }, text);
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
    const remaining = matches.length - rows.length + (count - names.length);
    this.body.replaceChildren(...rows, ...(remaining ? [el("div.gv-dim", {}, `${remaining} more: find them by number`)] : []));
  }

  row(name, color) {
    const paint = (rest) => (event) => this.change({ colors: { ...this.chosen, [name]: linear(event.target.value) } }, rest);
    const visibleWith = (on) => {
      const shown = this.app.labels.names.filter((label) => this.shows(label) && label !== name);
      return on ? [...shown, name].sort((a, b) => a - b) : shown;
    };
    const value = Array.isArray(color) ? hex(color) : color;
    return el("div.gv-row.gv-label", {},
      el("input.gv-flag", { type: "checkbox", title: "Show it", checked: this.shows(name), onchange: (event) => this.change({ visible: visibleWith(event.target.checked) }) }),
      el("input.gv-color", { type: "color", title: "Its colour", value, oninput: paint(false), onchange: paint(true) }),
      el("span", {}, String(name)), el("span.gv-gap"),
      el("button.gv-small", { type: "button", title: "Show this one alone", onclick: () => this.change({ visible: [name] }) }, "only"));
  }
}
