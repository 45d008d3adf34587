// The panel: sections of controls for every part of the state.
import { Controls, spaced } from "./controls.js";
import { axes } from "./camera.js";
import { el, menu, textButton } from "./dom.js";
import { LabelTable } from "./labels.js";
import { TransferEditor, domain } from "./transfer.js";

export class Panel {
  constructor(app) {
    this.app = app;
    this.controls = new Controls(app.schema, (kind, name) => this.newObject(kind, name), () => ({ ...app.unfit, ...this.unfit }));
    this.unfit = unfitColours(app.widths);
    this.editor = new TransferEditor((f, rest) => app.changeTransfer(f, rest));
    this.labels = new LabelTable(app);
    this.body = el("div.gv-sections");
    this.element = el("aside.gv-panel", {}, this.body);
    this.outdated = false;  // whether the rows wait to be rebuilt
    this.edited = null;  // the field with the focus, until its number or text is entered; or the slider that is dragged
    const on = (name, handler, capture = false) => this.element.addEventListener(name, handler, capture);
    const begin = ({ type, target }) => { this.edited = (type === "input" || ["number", "text"].includes(target.type)) ? target : null; };
    const end = () => { this.edited = null; };
    const catchUp = () => { if (this.outdated) this.show(); };
    on("focusin", begin);
    on("input", begin);
    on("change", end, true);  // before the field's own handler, which may rebuild the rows
    on("change", catchUp);
    on("focusout", () => { end(); catchUp(); });
  }

  /** A new object of a class: fields of the present shader where they fit, else the page's defaults. */
  newObject(kind, name) {
    const { app } = this, shader = app.state.shader;
    const fields = this.controls.schema[kind].fields, object = { kind };
    const oldFields = (name === "shader" && this.controls.schema[shader.kind]?.fields) || {};
    for (const [key, field] of Object.entries(fields)) {
      if (oldFields[key] && alike(field, oldFields[key]) && (field.optional || (shader[key] ?? null) !== null)) object[key] = shader[key];
    }
    const transfer = app.transfer() ?? app.lastTransfer;
    const [low, high] = domain(transfer);
    const middle = low + 0.5 * (high - low);
    const { forward } = axes(app.camera);
    const inBox = ["world", "box"].includes(fields.frame?.default);
    const defaults = {
      transfer, value: middle, which: "maximum", channel: Object.keys(app.widths)[0],
      direction: forward.map((field) => Number(field.toFixed(3))), position: app.camera.eye,
      aperture: 0.05, focus: 2, frame: "box", top: [0.1, 0.13, 0.18], bottom: [0.01, 0.012, 0.016],
      looks: [{ kind: "ChannelLook", window: [low, high] }],
    };
    for (const [key, field] of Object.entries(fields)) {
      const isNeeded = !("default" in field) && !field.optional;
      if (key in defaults && (isNeeded || (key === "frame" && inBox)) && object[key] === undefined) object[key] = defaults[key];
    }
    return kind === "TransferFunction" ? transfer : object;
  }

  section(name, ...rows) {
    const shown = rows.flat().filter(Boolean);
    if (!shown.length) return null;
    const element = el("details.gv-section", { open: this.app.open.has(name) }, el("summary", {}, name), ...shown);
    element.addEventListener("toggle", () => {
      this.app.open[element.open ? "add" : "delete"](name);
      if (name === "Monitor") this.app.link.send("monitor", { on: element.open });
    });
    return element;
  }

  /** Rebuilds all rows from the state; while one is edited, only after that, since the text would be lost. */
  show() {
    this.outdated = !!this.edited?.isConnected;
    if (this.outdated) return;
    const { app } = this, { state } = app, top = this.body.scrollTop;
    const change = (name) => (value, rest) => app.change({ [name]: value }, rest);
    const transfer = app.transfer();
    if (transfer) this.editor.set(transfer);
    const sections = [
      this.section("Colours", transfer ? this.colours() : [], this.looks(), this.labels.rows()),
      this.section("Shader", this.shader()),
      this.section("Picture", this.controls.fields({ kind: "Development", ...state.develop }, change("develop")),
        this.controls.fields(state.options, change("options"), { only: ["background"] }), this.showing()),
      this.section("Slices", this.slices()),
      this.section("Clip", this.clip()),
      this.section("Light and lens", this.controls.fields(state.options, change("options"), { only: ["lighting", "lens"] })),
      this.section("Sampling", this.controls.fields(state.options, change("options"), { only: ["step", "lod", "stop_alpha", "depth_alpha", "cone_scale"] })),
      this.section("Scene", this.parameters()),
      this.section("Camera", this.camera()),
      this.section("Film", app.film.rows()),
      this.section("Memory", this.memory()),
      this.section("Monitor", app.monitor.element),
    ];
    this.body.replaceChildren(...sections.filter(Boolean));
    this.body.scrollTop = top;
    app.monitor.draw();
  }

  colours() {
    const { app, editor } = this;
    const { pick, buttons, saveBar } = app.presets.rows();
    return [
      editor.element,
      el("div.gv-bar", {}, pick,
        tick("log", editor.log, (on) => { editor.log = on; editor.draw(); }),
        tick("in view", app.inView, (on) => app.askHistogram(on)),
        el("span.gv-gap"), ...buttons),
      saveBar,
    ];
  }

  /** Channels of an image: each with its colour, window and whether it is shown. */
  looks() {
    const { app } = this, { shader } = app.state;
    if (!shader.looks) return [];
    return shader.looks.map((look, index) => {
      const set = (value, rest) => app.change({ shader: { ...shader, looks: shader.looks.map((old, n) => (n === index ? value : old)) } }, rest);
      if (look.kind !== "ChannelLook") return null;
      const name = look.name || app.channels[look.component ?? index] || `channel ${look.component ?? index}`;
      return el("div.gv-group", {}, el("div.gv-row.gv-strong", {}, name),
        el("div.gv-inner", {}, ...this.controls.fields(look, set, { only: ["visible", "window", "opacity"] }),
          el("label.gv-row", {}, el("span.gv-name", {}, "color"), this.controls.color(Array.isArray(look.color) ? look.color : null, (color, rest) => set({ ...look, color }, rest)))));
    });
  }

  shader() {
    const { app } = this, { shader } = app.state;
    const change = (value, rest, name) => app.change({ shader: name === "color" ? { ...value, color_channel: colorChannel(value, app.widths) } : value }, rest);
    const kinds = app.schema.ViewState.fields.shader.choices.map((choice) => choice.kind);
    if (shader.kept) return [el("div.gv-row", {}, el("span.gv-name", {}, "shader"), el("span.gv-dim", {}, shader.kept.split("(")[0]))];
    const offered = kinds.filter((kind) => app.offers(kind) || kind === shader.kind);
    const select = menu(offered, spaced, shader.kind, (kind) => change(this.newObject(kind, "shader"), true));
    const rows = this.controls.fields(shader, change, { without: ["transfer", "looks", ...(shader.kind === "TransferFunction" ? ["opacity", "color"] : ["channel", "normals", "visible", "color_channel", "color_component"])] });
    return [el("label.gv-row", {}, el("span.gv-name", {}, "shader"), select), ...rows, this.surface()];
  }

  /** The row that saves the shown surface as a file. */
  surface() {
    const { app } = this, { value, kind } = app.state.shader;
    if (kind !== "Isosurface") return null;
    const level = el("input.gv-number", { type: "number", min: 0, step: 1, value: app.surfaceLevel, title: "Level of detail; 0 is the finest, each further one has a quarter of the triangles", onchange: () => { app.surfaceLevel = Math.max(0, Math.round(level.valueAsNumber) || 0); } });
    const button = (text, format) => textButton(text, "The whole surface at this value as a file, not cut: gvtorch surface", () => app.saveSurface({ value, format, level: app.surfaceLevel }));
    return el("div.gv-row", {}, el("span.gv-name", {}, "save surface, level"), el("span.gv-both", {}, level, button("PLY", "ply"), button("glTF", "glb")));
  }

  showing() {
    const { app } = this;
    const overlay = (name, text) => tick(text, app.overlays[name], (on) => { app.overlays[name] = on; app.view.drawOverlay(); });
    const only = app.state.show === "picture" ? ["show"] : ["show", "blend"];
    const rows = this.controls.fields({ kind: "ViewState", ...app.state }, ({ show, blend }, rest) => app.change({ show, blend }, rest), { only });
    const nodes = tick("nodes", app.overlays.nodes, (on) => { app.overlays.nodes = on; app.nodes.show(on); }, "Boxes of the tree's nodes whose bricks the picture shows");
    return [...rows, el("div.gv-bar", {}, overlay("axes", "axes"), overlay("scale", "scale bar"), overlay("box", "box"), nodes)];
  }

  slices() {
    const { app } = this, { slices } = app.state;
    const on = this.controls.row("three slices", { type: "flag" }, slices, (show) => app.slices.show(show));
    if (!slices) return [on];
    return [on, ...this.controls.fields(slices, (value, rest) => app.change({ slices: value }, rest))];
  }

  clip() {
    const { app } = this, { clip } = app, current = clip.clip;
    const crop = this.controls.row("crop box", { type: "flag" }, clip.cropBox(), (on) => clip.setCrop(on));
    const planes = (current?.planes ?? []).flatMap((plane, index) => [
      el("div.gv-row", {}, el("span.gv-name", {}, `plane ${index + 1}`),
        this.controls.number({ type: "number", range: [-0.9, 0.9] }, plane[3], (d, rest) => clip.setPlane(index, [...plane.slice(0, 3), d], rest))),
      el("div.gv-row", {}, el("span.gv-name"), el("span.gv-both", {},
        textButton("turn", "Keep the other side", () => clip.setPlane(index, plane.map((n) => -n), true)),
        textButton("remove", "", () => clip.setClip({ ...current, planes: current.planes.filter((_, n) => n !== index) }, true)))),
    ]);
    const facing = textButton("add one facing me", "A plane through the target that faces you", () => clip.addPlane());
    const capRows = current ? this.controls.fields(current, (value, rest) => clip.setClip(value, rest), { only: ["caps", "cap_opacity", "cap_light"] }) : [];
    return [crop, ...planes, el("div.gv-row", {}, el("span.gv-name", {}, "planes"), facing), ...capRows];
  }

  parameters() {
    const { app } = this;
    return Object.entries(app.parameters ?? {}).map(([name, parameter]) =>
      this.controls.row(name, parameter, parameter.value, (value, rest) => {
        if (rest) app.setValue("set", parameter.value, value, (newValue) => ({ name, value: newValue }));
      }));
  }

  camera() {
    const { app } = this;
    const others = Object.keys(app.clients).map(Number).filter((number) => number !== app.number);
    const rows = this.controls.fields({ kind: "Eye", ...app.camera }, ({ kind, ...camera }, rest) => app.changeCamera(camera, rest));
    if (!others.length) return rows;
    const name = (number) => (number === null ? "nobody" : `page ${number}`);
    const select = menu([null, ...others], name, app.clients[app.number] ?? null, (client) => app.link.send("follow", { client }));
    return [...rows, el("label.gv-row", {}, el("span.gv-name", {}, `follow (this is page ${app.number})`), select)];
  }

  memory() {
    const { app } = this;
    if (!app.engine) return [];
    const fields = app.schema.EngineOptions.fields;
    return Object.entries(app.engine).map(([name, value]) => {
      const field = name.endsWith("pool") ? { type: "text", text: fields[name].text } : fields[name];
      return this.controls.row(name, field, value, (newValue, rest) => {
        if (rest) app.setValue("resize", value, newValue, (sentValue) => ({ engine: { [name]: sentValue } }));
      });
    });
  }
}

/** A box to tick, with a text beside it; `onchange(on)`. */
const tick = (text, checked, onchange, title = "") => el("label.gv-tick", { title }, el("input", { type: "checkbox", checked, onchange: (event) => onchange(event.target.checked) }), text);

/** The channel that colours a surface: the present one if it fits, else the last that does; null: one fixed colour. */
function colorChannel({ color, color_channel }, widths) {
  const names = Object.keys(widths).filter((name) => color !== null || widths[name] === 4);
  return Array.isArray(color) ? null : names.find((name) => name === color_channel) ?? names.at(-1) ?? null;
}

/** Why some choices of a surface's colour can't be used: they need channels that the scene lacks. */
function unfitColours(widths) {
  const counts = Object.values(widths), reasons = {};
  for (const kind of ["Isosurface", "DistanceField"]) {
    if (counts.length < 2) reasons[`${kind}.color=TransferFunction`] = "a function needs a second channel";
    if (!counts.includes(4)) reasons[`${kind}.color=none`] = "stored colours need a channel of 4 numbers";
  }
  return reasons;
}

/** Whether two fields have the same type: a function's `color` is a list of points, a surface's is one colour. */
function alike(a, b) {
  return ["type", "items", "choices"].every((part) => JSON.stringify(a[part]) === JSON.stringify(b[part]));
}
