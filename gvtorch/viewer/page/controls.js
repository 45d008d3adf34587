// Controls made from the schema: each by the type and range of a field, whatever its class.
import { el } from "./dom.js";
import { hex, linear } from "./vectors.js";

const words = (name) => name.replaceAll("_", " ");
const LETTERS = ["x", "y", "z"];

export class Controls {
  /** `schema`: fields by class name; `first(kind)` returns a new object of a class; `unfit()` returns why
   * controls (`Class.field`), or choices of them (`Class.field=choice`), can't be used at present. */
  constructor(schema, first, unfit) {
    this.schema = schema;
    this.first = first;
    this.unfit = unfit;
  }

  /** Rows for the fields of an object; `change(value, rest, name)` gets the whole changed object. */
  fields(value, change, { only, without = [] } = {}) {
    const told = this.schema[value.kind]?.fields ?? {};
    const names = (only ?? Object.keys(told)).filter((name) => name in told && !without.includes(name));
    const now = { ...value };
    return names.map((name) => {
      const set = (one, rest) => {
        now[name] = one;
        change({ ...now }, rest, name);
      };
      const own = `${value.kind}.${name}`, why = this.unfit()[own];
      const row = this.row(name, told[name], value[name], set, own);
      if (row && why) {
        row.title = why;
        row.classList.add("gv-unfit");
        for (const part of row.querySelectorAll("input, select, button")) part.disabled = true;
      }
      return row;
    }).filter(Boolean);
  }

  row(name, told, value, set, own = name) {
    if (told.type === "kept" || (value && value.kept)) return null;
    if (told.type === "object" || told.type === "one of" || told.type === "list") {
      return this.group(name, told, value, set, own);
    }
    return el("label.gv-row", { title: told.text ?? "" }, el("span.gv-name", {}, words(name)), this.simple(told, value, set));
  }

  simple(told, value, set) {
    if (told.type === "flag") return el("input.gv-flag", { type: "checkbox", checked: !!value, onchange: (e) => set(e.target.checked, true) });
    if (told.type === "choice") return this.choice(told.choices, value, set, told.optional);
    if (told.type === "color") return this.color(value, set);
    if (told.type === "triple") return this.numbers(value ?? (told.optional ? Array(3).fill(null) : [0, 0, 0]), set);
    if (told.type === "pair") return this.numbers(value ?? (told.optional ? [null, null] : [0, 1]), set);
    if (told.type === "numbers") return this.numbers(value, set);
    if (told.type === "text") return el("input", { type: "text", value: value ?? "", onchange: (e) => set(e.target.value || (told.optional ? null : ""), true) });
    return this.number(told, value, set);
  }

  choice(choices, value, set, optional) {
    const all = optional ? [null, ...choices] : choices;
    const made = el("select", { onchange: () => set(all[made.selectedIndex], true) },
      ...all.map((one) => el("option", {}, one === null ? "–" : words(String(one)))));
    made.selectedIndex = Math.max(0, all.indexOf(value ?? null));
    return made;
  }

  color(value, set) {
    const now = Array.isArray(value) ? value : [1, 1, 1];
    const take = (rest) => (event) => set(linear(event.target.value), rest);
    return el("input.gv-color", { type: "color", value: hex(now), oninput: take(false), onchange: take(true) });
  }

  number(told, value, set) {
    const whole = told.type === "whole";
    const read = (text) => (text === "" && told.optional ? null : whole ? Math.round(Number(text)) : Number(text));
    const box = el("input.gv-number", { type: "number", step: "any", value: typeof value === "number" ? Number(value.toPrecision(6)) : "", placeholder: told.optional ? "auto" : "" });
    let slider = null;
    box.onchange = () => {
      const found = read(box.value);
      if (found !== null && !Number.isFinite(found)) return;
      if (slider && found !== null) slider.value = found;
      set(found, true);
    };
    if (!told.range) return box;
    const [low, high] = told.range;
    slider = el("input.gv-slider", { type: "range", min: low, max: high, step: whole ? 1 : (high - low) / 400, value: value ?? low });
    slider.oninput = () => {
      box.value = whole ? slider.value : Number(Number(slider.value).toPrecision(4));
      set(read(slider.value), false);
    };
    slider.onchange = () => set(read(slider.value), true);
    return el("span.gv-both", {}, slider, box);
  }

  numbers(value, set) {
    const now = [...value];
    return el("span.gv-triple", {}, ...now.map((one, at) => el("input.gv-number", {
      type: "number", step: "any", value: one === null ? "" : Number(one.toPrecision(6)), placeholder: one === null ? "auto" : "", title: LETTERS[at] ?? "",
      onchange: (event) => {
        now[at] = event.target.value === "" ? null : Number(event.target.value);
        if (now.every(Number.isFinite)) set([...now], true);
        else if (now.every((each) => each === null)) set(null, true);
      },
    })));
  }

  /** An object, one of several kinds, or a list of objects, as a block of rows. */
  group(name, told, value, set, own = name) {
    if (told.type === "list") return this.list(name, told, value, set);
    const kinds = (told.type === "one of" ? told.choices : [told]).filter((one) => one.type !== "list");
    const label = (one) => (one.type === "object" ? one.kind : one.type);
    const fits = (one) => one === current || !this.unfit()[`${own}=${one ? label(one) : "none"}`];
    const kindOf = (one) => kinds.find((k) => (k.type === "object" ? k.kind === one?.kind : k.type === "color" ? Array.isArray(one) : typeof one === "string"));
    const current = value === null || value === undefined ? null : kindOf(value) ?? null;
    const options = (told.optional ? [null, ...kinds] : kinds).filter(fits);
    const pick = el("select", { title: told.text ?? "" }, ...options.map((one) => el("option", {}, one ? words(label(one)) : "none")));
    pick.selectedIndex = Math.max(0, options.indexOf(current));
    pick.onchange = () => {
      const chosen = options[pick.selectedIndex];
      set(chosen ? (chosen.type === "object" ? this.first(chosen.kind, name) : chosen.type === "color" ? [0, 0, 0] : "") : null, true);
    };
    const head = el("label.gv-row", { title: told.text ?? "" }, el("span.gv-name", {}, words(name)));
    if (current && current.type === "color") {
      head.append(options.length > 1 ? el("span.gv-both", {}, pick, this.color(value, set)) : this.color(value, set));
      return head;
    }
    head.append(pick);
    if (!current || current.type !== "object" || value.kind === "TransferFunction") return options.length > 1 ? head : null;
    return el("div.gv-group", {}, options.length > 1 ? head : el("div.gv-row", {}, el("span.gv-name", {}, words(name))),
      el("div.gv-inner", {}, ...this.fields(value, set)));
  }

  /** A list of objects; lists of plain numbers have editors of their own. */
  list(name, told, value, set) {
    const kinds = told.items?.type === "one of" ? told.items.choices : [told.items];
    if (!kinds.every((one) => one?.type === "object")) return null;
    const items = value ?? [];
    const put = (at, one, rest) => set(items.map((old, n) => (n === at ? one : old)), rest);
    const rows = items.map((one, at) => el("div.gv-inner", {},
      this.group(`${at + 1}`, told.items, one, (next, rest) => put(at, next, rest)) ?? "",
      el("button.gv-small", { type: "button", onclick: () => set(items.filter((_, n) => n !== at), true) }, "remove")));
    const more = el("button.gv-small", { type: "button", onclick: () => set([...items, this.first(kinds[kinds.length > 1 ? 1 : 0].kind, name)], true) }, "add");
    return el("div.gv-group", { title: told.text ?? "" }, el("div.gv-row", {}, el("span.gv-name", {}, words(name)), more), ...rows);
  }
}
