// Transfer functions by name: those that come with gvtorch, the user's own, stored by the browser, and those of
// files of gvtorch, ParaView and 3D Slicer, which the server reads.
import { el, iconButton, keep, openText } from "./dom.js";
import { domain } from "./transfer.js";

const STORE = "gvtorch transfer functions";
const MOST = 900000;  // characters of a file that may be sent
const ENDINGS = ".json,.vp,.xml";

/** The user's own functions by name; none if the browser stores nothing. */
function ownFunctions() {
  try {
    return JSON.parse(localStorage.getItem(STORE)) ?? {};
  } catch {
    return {};
  }
}

export class Presets {
  constructor(app) {
    this.app = app;
    this.builtIn = [];
    this.file = null;  // the last file with several functions: {name, names, text(name)}
    this.name = el("input", { type: "text", placeholder: "name", maxLength: 60, onkeydown: (e) => { if (e.key === "Enter") this.save(); } });
    this.target = el("select", { title: "Where these colours are saved" }, ...["save mine", "save file", "ParaView"].map((one) => el("option", {}, one)));
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
    const own = Object.keys(ownFunctions()), groups = [["gvtorch", this.builtIn]];
    if (own.length) groups.push(["mine", own]);
    if (this.file) groups.push([this.file.name, this.file.names]);
    const takers = { gvtorch: (name) => this.take(name), mine: (name) => this.app.changeTransfer(ownFunctions()[name], true) };
    const pick = el("select", { title: "Colours by name; colour maps keep the opacity", onchange: () => {
      const chosen = pick.selectedOptions[0], { group } = chosen.dataset;
      if (!group) return;
      this.chosen = group === "mine" ? chosen.value : null;
      (takers[group] ?? ((name) => this.read(this.file.name, this.file.text(name), name)))(chosen.value);
    } }, el("option", {}, "presets"), ...groups.map(([label, names]) => {
      const made = names.map((name) => el("option", { value: name }, name));
      for (const one of made) one.dataset.group = label;
      return el("optgroup", { label }, ...made);
    }));
    return {
      pick,
      buttons: [
        iconButton("open", "Load a transfer function: of gvtorch or ParaView (JSON), or 3D Slicer (.vp, .vp.json, presets.xml)", () => openText(ENDINGS, (name, text) => this.open(name, text), (why) => this.app.say(why, true))),
      ],
      mine: el("div.gv-bar", {}, this.target, this.name,
        el("button.gv-small", { type: "button", title: "Save these colours", onclick: () => this.save() }, "save"),
        own.includes(this.chosen) ? el("button.gv-small", { type: "button", title: `Forget ${this.chosen}`, onclick: () => this.forget() }, "forget") : null),
    };
  }

  take(name) {
    this.app.link.send("preset", name.startsWith("ct-") ? { name } : { name, ...this.span() });
  }

  came({ name, function: made, lost }) {
    const { app } = this, own = app.transfer();
    const isMap = this.builtIn.includes(name) && made.color.length > 100 && own;  // a colour map has no opacity of its own
    app.changeTransfer(isMap ? { ...own, color: made.color } : made, true);
    app.panel.editor.setHistogram(app.panel.editor.histogram);
    app.say([name, ...(lost ?? [])].join("; "));
  }

  /** Reads a file with one function at once; offers the names if it has several. */
  open(name, text) {
    const found = several(name, text);
    if (!found) return this.read(name, text, null);
    this.file = { name, ...found };
    this.app.say(`${found.names.length} presets of ${name}: choose one`);
    this.app.refresh();
  }

  read(file, text, name) {
    if (text.length > MOST) return this.app.say(`${file}: ${text.length} letters, more than ${MOST}`, true);
    this.app.link.send("read", { file, text, name, ...this.span() });
  }

  /** Saves the colours in this browser, or as a file of gvtorch or ParaView. */
  save() {
    const name = this.name.value.trim(), { app } = this, target = this.target.selectedIndex;
    if (target === 2) return app.link.send("export", name ? { name } : {});
    if (target === 1) {
      const { kind, ...content } = app.transfer();
      return keep(`${name || "transfer"}.json`, JSON.stringify(content), "application/json");
    }
    if (!name) return app.say("a name is needed", true);
    this.store({ ...ownFunctions(), [name]: app.transfer() }, `${name} is saved in this browser`);
    this.name.value = "";
  }

  forget() {
    const { [this.chosen]: gone, ...rest } = ownFunctions();
    this.store(rest, `${this.chosen} is gone`);
  }

  store(functions, text) {
    try {
      localStorage.setItem(STORE, JSON.stringify(functions));
      this.app.say(text);
    } catch (error) {
      this.app.say(`this browser keeps nothing: ${error.message}`, true);
    }
    this.app.refresh();
  }
}

/** The names of a file's functions, and a function that returns the text of one; null if it has only one. */
function several(file, text) {
  if (file.endsWith(".xml")) {
    const parsed = new DOMParser().parseFromString(text, "text/xml");
    const names = [...parsed.querySelectorAll("VolumeProperty")].map((one) => one.getAttribute("name") || one.getAttribute("id") || "");
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
  const named = new Map(items.filter((one) => one?.RGBPoints).map((one, n) => [String(one.Name ?? n), one]));
  return named.size ? { names: [...named.keys()], text: (name) => JSON.stringify([named.get(name)]) } : null;
}
