// The table of labels: the colour of each, and whether it is shown.
import { el, textButton } from "./dom.js";
import { hex, linear } from "./vectors.js";

const MAX_ROWS = 60;  // shown at a time

export class LabelTable {
  constructor(app) {
    this.app = app;
    this.search = "";
    this.found = null;  // the labels of a search that the server made; null: `app.labels`
    this.filter = el("input", { type: "text", placeholder: "find a label", oninput: () => { this.search = this.filter.value.trim(); this.find(); } });
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

  /** Finds the labels whose number contains the text: here, or by the server if not all are here. */
  find() {
    const { names, count } = this.app.labels;
    if (names.length < count && this.search) {
      if (!this.asked) this.app.link.send("find", { text: this.asked = this.search });
      return;
    }
    this.found = null;
    this.fill();
  }

  receive(found) {
    this.asked = "";
    this.found = found;
    if (found.text === this.search) this.fill();
    else this.find();
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
    const { names, colors, count } = this.found ?? this.app.labels, { chosen } = this;
    const matches = names.map((_, n) => n).filter((n) => String(names[n]).includes(this.search));
    const rows = matches.slice(0, MAX_ROWS).map((n) => this.row(names[n], chosen[names[n]] ?? colors[n]));
    const more = matches.length + count - names.length - rows.length;
    this.body.replaceChildren(...rows, ...(more ? [el("div.gv-dim", {}, `${more} more: find them by number`)] : []));
  }

  row(name, color) {
    const paint = (rest) => (event) => this.change({ colors: { ...this.chosen, [name]: linear(event.target.value) } }, rest);
    const { visible } = this.shader, { names, count } = this.app.labels, isListed = Array.isArray(visible);
    const visibleWith = (on) => {
      const shown = (isListed ? visible : names.filter((label) => this.shows(label))).filter((label) => label !== name);
      return on ? [...shown, name].sort((a, b) => a - b) : shown;
    };
    const disabled = count > names.length && !isListed;  // a list would hide those that are not here
    return el("div.gv-row.gv-label", {},
      el("input.gv-flag", { type: "checkbox", title: disabled ? "There are too many labels to hide one of them" : "Show it", disabled, checked: this.shows(name), onchange: (event) => this.change({ visible: visibleWith(event.target.checked) }) }),
      el("input.gv-color", { type: "color", title: "Its colour", value: hex(color), oninput: paint(false), onchange: paint(true) }),
      el("span", {}, String(name)), el("span.gv-gap"),
      textButton("only", "Show this one alone", () => this.change({ visible: [name] })));
  }
}
