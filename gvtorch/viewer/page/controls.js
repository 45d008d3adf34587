// Controls made from the schema: each by the type and range of a field, whatever its class.
import { el, menu, textButton } from "./dom.js";
import { hex, linear } from "./vectors.js";

/** The name of a field or a class in words: "cap_light" is "cap light", "PointLight" is "Point light". */
export const spaced = (name) => name.replaceAll("_", " ").replace(/([a-z])([A-Z])/g, (_, a, b) => `${a} ${b.toLowerCase()}`);

const AXIS_NAMES = ["x", "y", "z"];

export class Controls {
  /** `schema`: fields by class name; `newObject(kind)` returns a new object of a class; `unfit()` returns why
   * controls (`Class.field`), or choices of them (`Class.field=choice`), can't be used at present. */
  constructor(schema, newObject, unfit) {
    this.schema = schema;
    this.newObject = newObject;
    this.unfit = unfit;
  }

  /** Rows for the fields of an object; `change(value, rest, name)` gets the whole changed object. */
  fields(value, change, { only, without = [] } = {}) {
    const descriptions = this.schema[value.kind]?.fields ?? {};
    const names = (only ?? Object.keys(descriptions)).filter((name) => name in descriptions && !without.includes(name));
    const changed = { ...value };
    return names.map((name) => {
      const set = (newValue, rest) => {
        changed[name] = newValue;
        change({ ...changed }, rest, name);
      };
      const control = `${value.kind}.${name}`, reason = this.unfit()[control];
      const row = this.row(name, descriptions[name], value[name], set, control);
      if (row && reason) {
        row.title = reason;
        row.classList.add("gv-unfit");
        for (const input of row.querySelectorAll("input, select, button")) input.disabled = true;
      }
      return row;
    }).filter(Boolean);
  }

  row(name, field, value, set, control = name) {
    if (field.type === "kept" || (value && value.kept)) return null;
    if (field.type === "object" || field.type === "one of" || field.type === "list") {
      return this.group(name, field, value, set, control);
    }
    return el("label.gv-row", { title: field.text ?? "" }, el("span.gv-name", {}, spaced(name)), this.simple(field, value, set));
  }

  simple(field, value, set) {
    if (field.type === "flag") return el("input.gv-flag", { type: "checkbox", checked: !!value, onchange: (event) => set(event.target.checked, true) });
    if (field.type === "choice") return this.choice(field.choices, value, set, field.optional);
    if (field.type === "color") return this.color(value, set);
    if (field.type === "triple") return this.numbers(value ?? (field.optional ? Array(3).fill(null) : [0, 0, 0]), set);
    if (field.type === "pair") return this.numbers(value ?? (field.optional ? [null, null] : [0, 1]), set);
    if (field.type === "numbers") return this.numbers(value, set);
    if (field.type === "text") return el("input", { type: "text", value: value ?? "", onchange: (event) => set(event.target.value || (field.optional ? null : ""), true) });
    return this.number(field, value, set);
  }

  choice(choices, value, set, optional) {
    const name = (option) => (option === null ? "–" : spaced(String(option)));
    return menu(optional ? [null, ...choices] : choices, name, value ?? null, (option) => set(option, true));
  }

  color(value, set) {
    const color = Array.isArray(value) ? value : [1, 1, 1];
    const handler = (rest) => (event) => set(linear(event.target.value), rest);
    return el("input.gv-color", { type: "color", value: hex(color), oninput: handler(false), onchange: handler(true) });
  }

  number(field, value, set) {
    const isInteger = field.type === "whole";
    const parse = (text) => (text === "" ? (field.optional ? null : NaN) : isInteger ? Math.round(Number(text)) : Number(text));
    const shown = typeof value === "number" ? Number(value.toPrecision(6)) : "";
    const input = el("input.gv-number", { type: "number", step: "any", value: shown, placeholder: field.optional ? "auto" : "" });
    let slider = null;
    input.onchange = () => {
      const number = parse(input.value);
      if (number !== null && !Number.isFinite(number)) { input.value = shown; return; }
      if (slider && number !== null) slider.value = number;
      set(number, true);
    };
    if (!field.range) return input;
    const [low, high] = field.range;
    slider = el("input.gv-slider", { type: "range", min: low, max: high, step: isInteger ? 1 : (high - low) / 400, value: value ?? low });
    slider.oninput = () => {
      input.value = isInteger ? slider.value : Number(Number(slider.value).toPrecision(4));
      set(parse(slider.value), false);
    };
    slider.onchange = () => set(parse(slider.value), true);
    return el("span.gv-both", {}, slider, input);
  }

  numbers(value, set) {
    const current = [...value];
    return el("span.gv-triple", {}, ...current.map((number, index) => el("input.gv-number", {
      type: "number", step: "any", value: number === null ? "" : Number(number.toPrecision(6)), placeholder: number === null ? "auto" : "", title: AXIS_NAMES[index] ?? "",
      onchange: (event) => {
        current[index] = event.target.value === "" ? null : Number(event.target.value);
        if (current.every(Number.isFinite)) set([...current], true);
        else if (current.every((number) => number === null)) set(null, true);
      },
    })));
  }

  /** An object, one of several kinds, or a list of objects, as a block of rows. */
  group(name, field, value, set, control = name) {
    if (field.type === "list") return this.list(name, field, value, set);
    const kinds = (field.type === "one of" ? field.choices : [field]).filter((kind) => kind.type !== "list");
    const label = (kind) => (kind.type === "object" ? kind.kind : kind.type);
    const fits = (kind) => kind === current || !this.unfit()[`${control}=${kind ? label(kind) : "none"}`];
    const kindOf = (item) => kinds.find((kind) => (kind.type === "object" ? kind.kind === item?.kind : kind.type === "color" ? Array.isArray(item) : typeof item === "string"));
    const current = value === null || value === undefined ? null : kindOf(value) ?? null;
    const options = (field.optional ? [null, ...kinds] : kinds).filter(fits);
    const newValue = (kind) => (kind.type === "object" ? this.newObject(kind.kind, name) : kind.type === "color" ? [0, 0, 0] : "");
    const select = menu(options, (kind) => (kind ? spaced(label(kind)) : "none"), current, (kind) => set(kind ? newValue(kind) : null, true), field.text ?? "");
    const header = el("label.gv-row", { title: field.text ?? "" }, el("span.gv-name", {}, spaced(name)));
    if (current && current.type === "color") {
      header.append(options.length > 1 ? el("span.gv-both", {}, select, this.color(value, set)) : this.color(value, set));
      return header;
    }
    header.append(select);
    if (!current || current.type !== "object" || value.kind === "TransferFunction") return options.length > 1 ? header : null;
    return el("div.gv-group", {}, options.length > 1 ? header : el("div.gv-row", {}, el("span.gv-name", {}, spaced(name))),
      el("div.gv-inner", {}, ...this.fields(value, set)));
  }

  /** A list of objects; lists of plain numbers have editors of their own. */
  list(name, field, value, set) {
    const kinds = field.items?.type === "one of" ? field.items.choices : [field.items];
    if (!kinds.every((item) => item?.type === "object")) return null;
    const items = value ?? [];
    const replaceItem = (index, item, rest) => set(items.map((old, n) => (n === index ? item : old)), rest);
    const rows = items.map((item, index) => el("div.gv-inner", {},
      this.group(`${index + 1}`, field.items, item, (next, rest) => replaceItem(index, next, rest)) ?? "",
      textButton("remove", "", () => set(items.filter((_, n) => n !== index), true))));
    const addButton = textButton("add", "", () => set([...items, this.newObject(kinds[kinds.length > 1 ? 1 : 0].kind, name)], true));
    return el("div.gv-group", { title: field.text ?? "" }, el("div.gv-row", {}, el("span.gv-name", {}, spaced(name)), addButton), ...rows);
  }
}
