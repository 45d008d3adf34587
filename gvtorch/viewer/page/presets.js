// Transfer functions by name: those that come with gvtorch, the user's own, stored by the browser, and those of
// files of gvtorch, ParaView and 3D Slicer, which the server reads.
import { el, iconButton, textButton, saveFile, openText } from "./dom.js";
import { domain } from "./transfer.js";

const STORAGE_KEY = "gvtorch transfer functions";
const SUFFIXES = ".json,.vp,.xml";

/** The user's own functions by name; none if the browser stores nothing. */
function ownFunctions() {
  try {
    return JSON.parse(localStorage.getItem(STORAGE_KEY)) ?? {};
  } catch {
    return {};
  }
}

export class Presets {
  constructor(app) {
    this.app = app;
    this.builtIn = [];
    this.file = null;  // the last file with several functions: {name, names, text(name)}
    this.name = el("input", { type: "text", placeholder: "name", maxLength: 60, onkeydown: (event) => { if (event.key === "Enter") this.enter(); } });
    this.target = el("select", { title: "Where these colours are saved" }, ...["save mine", "save file", "ParaView"].map((label) => el("option", {}, label)));
  }

  /** The values over which presets with relative values are stretched. */
  span() {
    const { app } = this, f = app.transfer(), h = app.panel.editor.histogram;
    let [low, high] = f ? domain(f) : [h.low, h.high];
    if (high <= low) [low, high] = [h.low, h.high];
    return { low, high };
  }

  /** Rows of the panel. */
  rows() {
    const ownNames = Object.keys(ownFunctions()), groups = [["gvtorch", this.builtIn]];
    if (ownNames.length) groups.push(["mine", ownNames]);
    if (this.file) groups.push([this.file.name, this.file.names]);
    const handlers = { gvtorch: (name) => this.app.link.send("preset", { name, ...this.span() }), mine: (name) => this.app.changeTransfer(ownFunctions()[name], true) };
    const select = el("select", { title: "Colours by name; colour maps keep the opacity", onchange: () => {
      const chosen = select.selectedOptions[0], { group } = chosen.dataset;
      if (!group) return;
      this.chosen = group === "mine" ? chosen.value : null;
      (handlers[group] ?? ((name) => this.read(this.file.name, this.file.text(name), name)))(chosen.value);
    } }, el("option", {}, "presets"), ...groups.map(([label, names]) => {
      const options = names.map((name) => el("option", { value: name }, name));
      for (const option of options) option.dataset.group = label;
      return el("optgroup", { label }, ...options);
    }));
    return {
      pick: select,
      buttons: [
        iconButton("open", "Load a transfer function: of gvtorch or ParaView (JSON), or 3D Slicer (.vp, .vp.json, presets.xml)", () => openText(SUFFIXES, (name, text) => this.open(name, text), (reason) => this.app.notify(reason, true))),
      ],
      saveBar: el("div.gv-bar", {}, this.target, this.name,
        textButton("save", "Save these colours", () => this.save()),
        ownNames.includes(this.chosen) ? textButton("forget", `Forget ${this.chosen}`, () => this.forget()) : null),
    };
  }

  receive({ name, function: preset, colors_only: isMap, lost: notes }) {
    const { app } = this, current = app.transfer();
    app.changeTransfer(isMap && current ? { ...current, color: preset.color } : preset, true);
    app.panel.editor.setHistogram(app.panel.editor.histogram);
    app.notify([name, ...(notes ?? [])].join("; "));
  }

  /** Reads a file with one function at once; offers the names if it has several. */
  open(name, text) {
    const functions = namedFunctions(name, text);
    if (!functions) return this.read(name, text, null);
    this.file = { name, ...functions };
    this.app.notify(`${functions.names.length} presets of ${name}: choose one`);
    this.app.refresh();
  }

  read(file, text, name) {
    this.app.link.send("read", { file, text, name, ...this.span() });
  }

  /** Saves the colours in this browser, or as a file of gvtorch or ParaView. */
  save() {
    const name = this.name.value.trim(), { app } = this, target = this.target.selectedIndex;
    if (target === 2) return app.link.send("export", name ? { name } : {});
    if (target === 1) {
      const { kind, ...content } = app.transfer();
      return saveFile(`${name || "transfer"}.json`, JSON.stringify(content), "application/json");
    }
    if (!name) return app.notify("a name is needed", true);
    this.storeFunctions({ ...ownFunctions(), [name]: app.transfer() }, `${name} is saved in this browser`);
    this.name.value = "";
  }

  /** Saves them, and ends the edit of the name, so that the panel lists them. */
  enter() {
    this.save();
    this.name.blur();
  }

  forget() {
    const { [this.chosen]: removed, ...rest } = ownFunctions();
    this.storeFunctions(rest, `${this.chosen} is gone`);
  }

  storeFunctions(functions, text) {
    try {
      localStorage.setItem(STORAGE_KEY, JSON.stringify(functions));
      this.app.notify(text);
    } catch (error) {
      this.app.notify(`this browser keeps nothing: ${error.message}`, true);
    }
    this.app.refresh();
  }
}

/** The names of a file's functions, and a function that returns the text of one; null if it has only one. */
function namedFunctions(file, text) {
  if (file.endsWith(".xml")) {
    const parsed = new DOMParser().parseFromString(text, "text/xml");
    const names = [...parsed.querySelectorAll("VolumeProperty")].map((item) => item.getAttribute("name") || item.getAttribute("id") || "");
    return names.length > 1 ? { names, text: () => text } : null;
  }
  if (!file.endsWith(".json")) return null;
  let items = null;
  try {
    items = JSON.parse(text);
  } catch {
    return null;  // the server reports what is wrong
  }
  if (!Array.isArray(items) || items.length < 2) return null;
  const named = new Map(items.filter((item) => item?.RGBPoints).map((item, n) => [String(item.Name ?? n), item]));
  return named.size ? { names: [...named.keys()], text: (name) => JSON.stringify([named.get(name)]) } : null;
}
