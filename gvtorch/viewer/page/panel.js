// The panel: sections of controls for every part of the state.
import { Controls } from "./controls.js";
import { axes } from "./camera.js";
import { el } from "./dom.js";
import { LabelTable } from "./labels.js";
import { TransferEditor, domain } from "./transfer.js";

const HIDDEN = ["transfer", "kind", "camera", "looks"];

export class Panel {
  constructor(app) {
    this.app = app;
    this.open = new Set(["Colours", "Shader", "Picture"]);
    this.controls = new Controls(app.schema, (kind, name) => this.first(kind, name), () => ({ ...app.unfit, ...this.unfit }));
    this.unfit = unfitColours(app.widths);
    this.editor = new TransferEditor((f, rest) => app.changeTransfer(f, rest));
    this.labels = new LabelTable(app, this.controls);
    this.body = el("div.gv-sections");
    this.element = el("aside.gv-panel", {}, this.body);
  }

  /** A new object of a class: fields of the present shader where they fit, else the page's defaults. */
  first(kind, name) {
    const { app } = this, now = app.state.shader;
    const told = this.controls.schema[kind].fields, made = { kind };
    const old = (name === "shader" && this.controls.schema[now.kind]?.fields) || {};
    for (const [field, one] of Object.entries(told)) {
      if (old[field] && alike(one, old[field]) && (one.optional || (now[field] ?? null) !== null)) made[field] = now[field];
    }
    const transfer = app.transfer() ?? app.lastTransfer;
    const [low, high] = domain(transfer);
    const middle = low + 0.5 * (high - low);
    const { forward } = axes(app.camera);
    const inBox = ["world", "box"].includes(told.frame?.default);
    const known = {
      transfer, value: middle, which: "maximum", channel: Object.keys(app.widths)[0],
      direction: forward.map((one) => Number(one.toFixed(3))), position: app.camera.eye,
      aperture: 0.05, focus: 2, frame: "box", top: [0.1, 0.13, 0.18], bottom: [0.01, 0.012, 0.016],
      looks: [{ kind: "ChannelLook", window: [low, high] }],
    };
    for (const [field, one] of Object.entries(told)) {
      const needed = !("default" in one) && !one.optional;
      if (field in known && (needed || (field === "frame" && inBox)) && made[field] === undefined) made[field] = known[field];
    }
    return kind === "TransferFunction" ? transfer : made;
  }

  section(name, ...rows) {
    const shown = rows.flat().filter(Boolean);
    if (!shown.length) return null;
    const made = el("details.gv-section", { open: this.open.has(name) }, el("summary", {}, name), ...shown);
    made.addEventListener("toggle", () => (made.open ? this.open.add(name) : this.open.delete(name)));
    return made;
  }

  /** Rebuilds all rows from the state. */
  show() {
    const { app } = this, { state } = app, top = this.body.scrollTop;
    const put = (name) => (value, rest) => app.change({ [name]: value }, rest);
    const transfer = app.transfer();
    if (transfer) this.editor.set(transfer);
    const sections = [
      this.section("Colours", transfer ? this.colours() : [], this.looks(), this.labels.rows()),
      this.section("Shader", this.shader()),
      this.section("Picture", this.controls.fields({ kind: "Development", ...state.develop }, put("develop")),
        this.controls.fields(state.options, put("options"), { only: ["background"] }), this.showing()),
      this.section("Slices", this.slices()),
      this.section("Clip", this.clip()),
      this.section("Light and lens", this.controls.fields(state.options, put("options"), { only: ["lighting", "lens"] })),
      this.section("Sampling", this.controls.fields(state.options, put("options"), { only: ["step", "lod", "stop_alpha", "depth_alpha", "cone_scale"] })),
      this.section("Scene", this.parameters()),
      this.section("Camera", this.camera()),
      this.section("Film", app.film.rows()),
      this.section("Memory", this.memory()),
      this.section("Monitor", app.monitor.element),
    ];
    this.body.replaceChildren(...sections.filter(Boolean));
    for (const made of this.body.children) {
      if (made.firstChild.textContent === "Monitor") made.addEventListener("toggle", () => app.watch(made.open));
    }
    this.body.scrollTop = top;
    app.monitor.draw();
  }

  colours() {
    const { app, editor } = this;
    const tick = (text, checked, onchange) => el("label.gv-tick", {}, el("input", { type: "checkbox", checked, onchange: (e) => onchange(e.target.checked) }), text);
    const { pick, buttons, mine } = app.presets.rows();
    return [
      editor.element,
      el("div.gv-bar", {}, pick,
        tick("log", editor.log, (on) => { editor.log = on; editor.draw(); }),
        tick("in view", app.inView, (on) => app.askHistogram(on)),
        el("span.gv-gap"), ...buttons),
      mine,
    ];
  }

  /** Channels of an image: each with its colour, window and whether it is shown. */
  looks() {
    const { app } = this, { shader } = app.state;
    if (!shader.looks) return [];
    return shader.looks.map((look, at) => {
      const set = (value, rest) => app.change({ shader: { ...shader, looks: shader.looks.map((old, n) => (n === at ? value : old)) } }, rest);
      if (look.kind !== "ChannelLook") return null;
      const name = look.name || app.channels[look.component ?? at] || `channel ${look.component ?? at}`;
      return el("div.gv-group", {}, el("div.gv-row.gv-strong", {}, name),
        el("div.gv-inner", {}, ...this.controls.fields(look, set, { only: ["visible", "window", "opacity"] }),
          el("label.gv-row", {}, el("span.gv-name", {}, "color"), this.controls.color(Array.isArray(look.color) ? look.color : null, (color, rest) => set({ ...look, color }, rest)))));
    });
  }

  shader() {
    const { app } = this, { shader } = app.state;
    const put = (value, rest, name) => app.change({ shader: name === "color" ? { ...value, color_channel: colorChannel(value, app.widths) } : value }, rest);
    const known = app.schema.ViewState.fields.shader.choices.map((one) => one.kind);
    if (shader.kept) return [el("div.gv-row", {}, el("span.gv-name", {}, "shader"), el("span.gv-dim", {}, shader.kept.split("(")[0]))];
    const wanted = known.filter((kind) => app.offers(kind) || kind === shader.kind);
    const pick = el("select", { onchange: () => put(this.first(wanted[pick.selectedIndex], "shader"), true) }, ...wanted.map((kind) => el("option", {}, words(kind))));
    pick.selectedIndex = wanted.indexOf(shader.kind);
    const rows = this.controls.fields(shader, put, { without: [...HIDDEN, ...(shader.kind === "TransferFunction" ? ["opacity", "color"] : ["channel", "normals", "visible", "color_channel", "color_component"])] });
    return [el("label.gv-row", {}, el("span.gv-name", {}, "shader"), pick), ...rows, this.surface()];
  }

  /** The row that saves the shown surface as a file. */
  surface() {
    const { app } = this, { value, kind } = app.state.shader;
    if (kind !== "Isosurface") return null;
    const level = el("input.gv-number", { type: "number", min: 0, step: 1, value: app.surfaceLevel, title: "Level of detail; 0 is the finest, each further one has a quarter of the triangles", onchange: () => { app.surfaceLevel = Math.max(0, Math.round(level.valueAsNumber) || 0); } });
    const button = (text, format) => el("button.gv-small", { type: "button", title: `The whole surface at this value as a file, not cut: gvtorch surface`, onclick: () => app.surface({ value, format, level: app.surfaceLevel }) }, text);
    return el("div.gv-row", {}, el("span.gv-name", {}, "save surface, level"), el("span.gv-both", {}, level, button("PLY", "ply"), button("glTF", "glb")));
  }

  showing() {
    const { app } = this;
    const tick = (name, text) => el("label.gv-tick", {}, el("input", { type: "checkbox", checked: app.shown[name], onchange: (e) => { app.shown[name] = e.target.checked; app.view.overlay(); } }), text);
    const only = app.state.show === "picture" ? ["show"] : ["show", "blend"];
    const rows = this.controls.fields({ kind: "ViewState", ...app.state }, ({ show, blend }, rest) => app.change({ show, blend }, rest), { only });
    const nodes = el("label.gv-tick", { title: "Boxes of the tree's nodes whose bricks the picture shows" }, el("input", { type: "checkbox", checked: app.shown.nodes, onchange: (e) => { app.shown.nodes = e.target.checked; app.nodes.show(e.target.checked); } }), "nodes");
    return [...rows, el("div.gv-bar", {}, tick("axes", "axes"), tick("scale", "scale bar"), tick("box", "box"), nodes)];
  }

  slices() {
    const { app } = this, { slices } = app.state;
    const on = el("label.gv-row", {}, el("span.gv-name", {}, "three slices"),
      el("input.gv-flag", { type: "checkbox", checked: !!slices, onchange: (e) => app.slices.show(e.target.checked) }));
    if (!slices) return [on];
    return [on, ...this.controls.fields(slices, (value, rest) => app.change({ slices: value }, rest))];
  }

  clip() {
    const { app } = this, { clip } = app, now = clip.clip;
    const crop = el("label.gv-row", {}, el("span.gv-name", {}, "crop box"),
      el("input.gv-flag", { type: "checkbox", checked: !!clip.cropBox(), onchange: (e) => clip.setCrop(e.target.checked) }));
    const planes = (now?.planes ?? []).flatMap((plane, at) => [
      el("div.gv-row", {}, el("span.gv-name", {}, `plane ${at + 1}`),
        this.controls.number({ type: "number", range: [-0.9, 0.9] }, plane[3], (d, rest) => clip.setPlane(at, [...plane.slice(0, 3), d], rest))),
      el("div.gv-row", {}, el("span.gv-name"), el("span.gv-both", {},
        el("button.gv-small", { type: "button", title: "Keep the other side", onclick: () => clip.setPlane(at, plane.map((n) => -n), true) }, "turn"),
        el("button.gv-small", { type: "button", onclick: () => clip.put({ ...now, planes: now.planes.filter((_, n) => n !== at) }, true) }, "remove"))),
    ]);
    const facing = el("button.gv-small", { type: "button", title: "A plane through the target that faces you", onclick: () => clip.addPlane() }, "add one facing me");
    const rest = now ? this.controls.fields(now, (value, still) => clip.put(value, still), { only: ["caps", "cap_opacity", "cap_light"] }) : [];
    return [crop, ...planes, el("div.gv-row", {}, el("span.gv-name", {}, "planes"), facing), ...rest];
  }

  parameters() {
    const { app } = this;
    return Object.entries(app.parameters ?? {}).map(([name, told]) =>
      this.controls.row(name, told, told.value, (value, rest) => {
        if (rest) app.set("set", app.parameters, name, value, (one) => ({ name, value: one }));
      }));
  }

  camera() {
    const { app } = this;
    const others = Object.keys(app.clients).map(Number).filter((one) => one !== app.number);
    const rows = this.controls.fields({ kind: "Eye", ...app.camera }, ({ kind, ...camera }, rest) => app.changeCamera(camera, rest));
    if (!others.length) return rows;
    const all = [null, ...others];
    const pick = el("select", { onchange: () => app.link.send("follow", { client: all[pick.selectedIndex] }) },
      ...all.map((one) => el("option", {}, one === null ? "nobody" : `page ${one}`)));
    pick.selectedIndex = Math.max(0, all.indexOf(app.clients[app.number]));
    return [...rows, el("label.gv-row", {}, el("span.gv-name", {}, `follow (this is page ${app.number})`), pick)];
  }

  memory() {
    const { app } = this;
    if (!app.engine) return [];
    const told = app.schema.EngineOptions.fields;
    return Object.entries(app.engine).map(([name, value]) => {
      const known = name.endsWith("pool") ? { type: "text" } : told[name];
      return this.controls.row(name, { ...known, text: told[name].text }, value, (one, rest) => {
        if (rest) app.set("resize", app.engine, name, one, (now) => ({ engine: { [name]: now } }));
      });
    });
  }
}

const words = (kind) => kind.replace(/([a-z])([A-Z])/g, (_, a, b) => `${a} ${b.toLowerCase()}`);

/** The channel that colours a surface: the present one if it fits, else the last that does; null: one fixed colour. */
function colorChannel({ color, color_channel }, widths) {
  const names = Object.keys(widths).filter((name) => color !== null || widths[name] === 4);
  return Array.isArray(color) ? null : names.find((name) => name === color_channel) ?? names.at(-1) ?? null;
}

/** Why some choices of a surface's colour can't be used: they need channels that the scene lacks. */
function unfitColours(widths) {
  const numbers = Object.values(widths), told = {};
  for (const kind of ["Isosurface", "DistanceField"]) {
    if (numbers.length < 2) told[`${kind}.color=TransferFunction`] = "a function needs a second channel";
    if (!numbers.includes(4)) told[`${kind}.color=none`] = "stored colours need a channel of 4 numbers";
  }
  return told;
}

/** Whether two fields have the same type: a function's `color` is a list of points, a surface's is one colour. */
function alike(one, other) {
  return ["type", "items", "choices"].every((part) => JSON.stringify(one[part]) === JSON.stringify(other[part]));
}
