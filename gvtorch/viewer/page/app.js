// The page: its copy of the view's state, its parts, and the messages that it handles and sends.
import { between, distance, facing } from "./camera.js";
import { el, iconButton, keep, openJson } from "./dom.js";
import { ClipEditor } from "./clip.js";
import { Film } from "./film.js";
import { History } from "./history.js";
import { Link } from "./link.js";
import { MonitorView } from "./monitor.js";
import { Panel } from "./panel.js";
import { NodeBoxes } from "./nodes.js";
import { PictureView } from "./picture.js";
import { Pointer } from "./pointer.js";
import { Presets } from "./presets.js";
import { SlicesView } from "./slices.js";
import { TimeBar } from "./times.js";
import { domain, stretched } from "./transfer.js";
import { clamp } from "./vectors.js";

const TOOLS = {
  orbit: "Orbit: drag; Shift or right: pan; wheel: zoom; W A S D: fly; double click: look at it",
  pan: "Pan",
  fly: "Fly: drag to look around, W A S D Q E to move, wheel: speed",
  window: "Window: drag right for a wider window, down for brighter (or hold Alt)",
};
const TYPES = { png: "image/png", json: "application/json", glb: "model/gltf-binary" };
const REST = 160;  // milliseconds after which a wheel or a key is at rest

/** Merges a change into a value: objects of one kind field by field; anything else is replaced. */
function merged(now, change) {
  const plain = (one) => one !== null && typeof one === "object" && !Array.isArray(one);
  if (!plain(change) || !plain(now) || (change.kind && now.kind && change.kind !== now.kind)) return change;
  const made = { ...now };
  for (const [name, value] of Object.entries(change)) made[name] = merged(now[name], value);
  return made;
}

export class App {
  constructor(root, connect) {
    this.root = root;
    this.tool = "orbit";
    this.surfaceLevel = 0;
    this.shown = { axes: true, scale: true, box: false, nodes: false };
    this.history = new History();
    this.clients = {};
    this.inView = false;
    this.link = new Link(connect);
    this.view = new PictureView(this);
    this.clip = new ClipEditor(this);
    this.slices = new SlicesView(this, this.view);
    this.nodes = new NodeBoxes(this);
    this.times = new TimeBar(this);
    this.film = new Film(this);
    this.presets = new Presets(this);
    this.monitor = new MonitorView(this);
    this.pointer = new Pointer(this, this.view);
    this.progress = el("div.gv-progress");
    this.note = el("div.gv-note", { role: "status" });
    this.title = el("span.gv-title");
    root.append(this.view.element, this.toolbar(), this.times.element, this.progress, this.note);
    const on = (type, take) => this.link.on(type, take);
    on("welcome", (told) => this.welcome(told));
    on("picture", (picture) => this.view.take(picture));
    on("file", ({ head, bytes }) => { keep(head.file, bytes, TYPES[head.file.split(".").at(-1)] ?? "application/octet-stream"); this.say(`${head.file} is saved`); });
    on("state", (told) => this.take(told));
    on("camera", ({ camera }) => this.seat(camera));
    on("clients", ({ clients }) => { this.clients = clients; this.refresh(); });
    on("histogram", (told) => this.panel?.editor.setHistogram(told));
    on("preset", (told) => this.presets.came(told));
    on("nodes", (told) => this.nodes.take(told));
    on("note", ({ text }) => this.say(text));
    on("picked", (told) => this.picked(told));
    on("parameters", ({ parameters }) => { this.parameters = parameters; this.refresh(); this.askHistogram(this.inView); });
    on("busy", (busy) => this.busy(busy));
    on("figures", (figures) => this.monitor.take(figures));
    on("exporting", ({ done, total }) => this.say(`making the surface … ${Math.round((100 * done) / total)} %`, false, null, true));
    on("refused", ({ text }) => this.say(text, true));
    on("error", ({ text }) => this.say(text, true));
    on("failed", ({ text, count }) => this.say(`${count} parts could not be loaded: ${text}`, true, () => this.link.send("do", { what: "retry" })));
    on("gone", ({ why }) => { this.say(why || "The view is gone; trying to reach it again …", true); this.root.classList.add("gv-lost"); });
    this.view.element.addEventListener("drawn", ({ detail }) => {
      this.monitor.drawn();
      this.times.drawn(detail);
    });
  }

  toolbar() {
    this.buttons = {};
    for (const [name, title] of Object.entries(TOOLS)) this.buttons[name] = iconButton(name, title, () => this.use(name));
    this.buttons.orbit.classList.add("gv-on");
    const bar = (...items) => el("div.gv-tools", {}, ...items);
    return el("nav.gv-top", {}, bar(...Object.values(this.buttons)),
      bar(iconButton("home", "The whole box (F)", () => this.link.send("do", { what: "fit" })),
        iconButton("ortho", "Orthographic or perspective (O); views along axes: 1 to 6, or a click on x, y, z", () => this.switchOrtho())),
      bar(this.slicesButton = iconButton("slices", "Three slices beside the picture", () => this.slices.show(!this.state.slices))),
      bar(iconButton("undo", "Undo (Ctrl Z)", () => this.undo()),
        iconButton("redo", "Redo (Ctrl Shift Z)", () => this.redo()),
        iconButton("camera", "Save the picture (PNG)", () => this.still()),
        iconButton("save", "Save all that is shown (JSON): gvtorch view --state, gvtorch render --state", () => keep("view.json", JSON.stringify({ ...this.state, camera: this.camera }, null, 1), "application/json")),
        iconButton("open", "Load what was saved (JSON)", () => openJson((state) => this.load(state), (why) => this.say(why, true)))),
      this.title, el("span.gv-gap"),
      bar(iconButton("panel", "Panel", () => { this.root.classList.toggle("gv-closed"); })));
  }

  use(name) {
    this.tool = name;
    for (const [other, button] of Object.entries(this.buttons)) button.classList.toggle("gv-on", other === name);
    this.view.element.focus({ preventScroll: true });
  }

  welcome(told) {
    Object.assign(this, {
      number: told.client, box: told.box, unit: told.unit, schema: told.schema, time: told.time, labels: told.labels,
      channels: told.channels, widths: told.widths, engine: told.engine, parameters: told.parameters,
    });
    this.presets.builtIn = told.presets;
    this.root.classList.remove("gv-lost");
    this.note.classList.remove("gv-shown");
    const { camera, ...state } = told.state;
    this.state = state;
    this.unfit = told.unfit;
    this.camera ??= camera;
    this.home = camera;
    this.title.textContent = told.name;
    document.title = this.root.classList.contains("gv-page") ? `${told.name} · gvtorch` : document.title;
    this.panel?.element.remove();
    this.panel = new Panel(this);
    this.root.append(this.panel.element);
    this.view.hello();
    this.view.overlay();
    this.lastTransfer = this.transfer() ?? { kind: "TransferFunction", opacity: [[0, 0], [1, 0.5]], color: [[0, 0, 0, 0], [1, 1, 1, 1]] };
    this.refresh();
    this.askHistogram(false);
    if (this.shown.nodes) this.nodes.show(true);
    if (this.panel.open.has("Monitor")) this.watch(true);
  }

  refresh() {
    if (!this.panel || this.panel.editor.dragged) return;
    this.panel.show();
    this.times.show();
    this.root.classList.toggle("gv-sliced", !!this.state.slices);
    this.slicesButton.classList.toggle("gv-on", !!this.state.slices);
  }

  // The state.

  take({ state, unfit }) {
    const { camera, ...rest } = state;
    if (JSON.stringify([rest, unfit]) === JSON.stringify([this.state, this.unfit])) return;
    this.state = rest;
    this.unfit = unfit;
    this.refresh();
    this.view.overlay();
  }

  change(part, rest = true) {
    if (!this.before) this.before = this.state;
    const shape = (one) => [one.shader.kind, one.options.clip?.planes.length, one.options.lens, one.options.lighting, !one.slices, one.show].map((x) => JSON.stringify(x)?.length);
    const old = shape(this.state);
    this.state = merged(this.state, part);
    this.link.send("change", { state: part, rest });
    if (rest) {
      this.remember(this.before, this.state);
      this.before = null;
    }
    if (rest || shape(this.state).some((one, n) => one !== old[n])) this.refresh();
    this.view.overlay();
  }

  /** Adds an edit of the state to the history. */
  remember(before, after) {
    this.history.push(() => this.put(before), () => this.put(after));
  }

  /** Replaces the whole state. */
  put(state) {
    this.state = state;
    this.link.send("change", { state, rest: true });
    this.refresh();
    this.view.overlay();
  }

  undo() {
    if (!this.history.undo()) this.say("there is nothing to undo");
  }

  redo() {
    if (!this.history.redo()) this.say("there is nothing to do again");
  }

  /** Sets a parameter of the scene, or the engine's memory. */
  set(type, values, name, value, message) {
    const before = type === "set" ? values[name].value : values[name];
    const put = (one) => {
      if (type === "resize") values[name] = one;
      this.link.send(type, message(one));
      this.refresh();
    };
    this.history.push(() => put(before), () => put(value));
    put(value);
  }

  load(state) {
    const { camera, ...rest } = state, before = this.state;
    this.link.send("change", { state, rest: true });
    if (camera) this.seat(camera);
    this.state = merged(this.state, rest);
    this.remember(before, this.state);
    this.refresh();
  }

  // Colours.

  transfer() {
    const { shader } = this.state;
    const found = shader.kind === "TransferFunction" ? shader : shader.transfer;
    return Array.isArray(found?.opacity) && Array.isArray(found.color) ? found : null;
  }

  changeTransfer(f, rest) {
    this.lastTransfer = f;
    const { shader } = this.state;
    this.change({ shader: shader.kind === "TransferFunction" ? f : { ...shader, transfer: f } }, rest);
  }

  /** Whether a kind of shader is offered: Features needs a second channel; StoredColor and Labels only if shown now. */
  offers(kind) {
    const many = Object.keys(this.widths).length > 1;
    return { Features: many, StoredColor: this.state.shader.kind === "StoredColor", Labels: this.state.shader.kind === "Labels" }[kind] ?? this.state.shader.kind !== "Labels";
  }

  askHistogram(inView) {
    this.inView = inView;
    this.link.send("histogram", { in_view: inView });
  }

  beginWindow() {
    const { shader } = this.state;
    this.windowed = this.transfer() ?? shader;
  }

  dragWindow(dx, dy) {
    const move = ([low, high]) => {
      const wide = (high - low) * Math.exp(dx * 3), middle = (low + high) / 2 - dy * (high - low) * 1.5;
      return [middle - wide / 2, middle + wide / 2];
    };
    const f = this.transfer(), { shader } = this.state;
    if (f) this.changeTransfer(stretched(f, domain(f), move(domain(f))), false);
    else if (shader.looks) this.change({ shader: { ...shader, looks: shader.looks.map((one) => (one.window ? { ...one, window: move(one.window) } : one)) } }, false);
    else if ("value" in shader) this.change({ shader: { ...shader, value: shader.value - dy * (Math.abs(shader.value) + 1) } }, false);
  }

  settle() {
    if (this.before) this.change({}, true);
    this.refresh();
  }

  // The camera.

  seat(camera) {
    this.camera = camera;
    this.view.overlay();
    this.refresh();
  }

  look(camera, moving) {
    this.camera = camera;
    this.view.overlay();
    if (moving && this.asked) return;
    if (!moving) return this.sendCamera(false);
    this.asked = requestAnimationFrame(() => { this.asked = 0; this.sendCamera(true); });
  }

  sendCamera(moving) {
    if (this.asked) cancelAnimationFrame(this.asked);
    this.asked = 0;
    const { eye, target, up, fov, model } = this.camera;
    this.link.send("move", { camera: { eye, target, up, fov, model }, moving, sent: moving ? performance.now() : 0 });
  }

  rest() {
    this.sendCamera(false);
    if (this.panel?.open.has("Camera")) this.refresh();
  }

  restSoon() {
    clearTimeout(this.resting);
    this.resting = setTimeout(() => this.rest(), REST);
  }

  /** Moves smoothly to a camera in a quarter of a second. */
  glide(camera) {
    const from = this.camera, start = performance.now();
    const step = (now) => {
      const t = clamp((now - start) / 260, 0, 1);
      this.look(t < 1 ? between(from, camera, t * t * (3 - 2 * t)) : camera, t < 1);
      if (t < 1) requestAnimationFrame(step);
    };
    step(start);
  }

  face(axis, side) {
    this.glide(facing(this.camera, axis, side, this.home.up));
  }

  /** Sets a field of the camera, which can be undone. */
  changeCamera(camera, rest) {
    this.cameraBefore ??= this.camera;
    this.look(camera, !rest);
    if (!rest) return;
    const before = this.cameraBefore, put = (one) => { this.look(one, false); this.refresh(); };
    this.cameraBefore = null;
    this.history.push(() => put(before), () => put(camera));
  }

  switchOrtho() {
    this.look({ ...this.camera, model: this.camera.model === "ortho" ? "pinhole" : "ortho" }, false);
    this.refresh();
  }

  picked({ place, purpose }) {
    if (purpose !== "focus") return;
    if (!place) return this.say("there is nothing");
    const { camera } = this, move = place.map((one, axis) => one - camera.target[axis]);
    this.glide({ ...camera, target: place, eye: camera.eye.map((one, axis) => one + move[axis]) });
    this.say(`at ${place.map((one) => Number(one.toPrecision(5))).join(", ")}; ${Number(distance(camera).toPrecision(3))} away`);
  }

  surface(wanted) {
    this.say("making the surface …", false, null, true);
    this.link.send("surface", wanted);
  }

  still() {
    this.say("rendering …");
    this.link.send("still", { width: this.view.over.width, height: this.view.over.height });
  }

  // Figures, progress and notes.

  watch(on) {
    this.link.send("monitor", { on });
  }

  busy({ pending, misses, crowded }) {
    const left = Math.max(pending, misses);
    this.progress.classList.toggle("gv-shown", left > 0);
    this.most = left ? Math.max(this.most ?? 0, left) : 0;
    this.progress.style.setProperty("--done", `${left ? Math.max(4, 100 * (1 - left / this.most)) : 100}%`);
    if (crowded && !this.toldCrowded) this.say("The brick pool is too small for this picture: parts of it are coarser (Memory).");
    this.toldCrowded = crowded;
  }

  say(text, bad = false, again = null, stays = false) {
    clearTimeout(this.saying);
    this.note.replaceChildren(text, ...(again ? [el("button.gv-small", { type: "button", onclick: () => { again(); this.note.classList.remove("gv-shown"); } }, "try again")] : []));
    this.note.classList.toggle("gv-bad", bad);
    this.note.classList.add("gv-shown");
    if (!again && !stays) this.saying = setTimeout(() => this.note.classList.remove("gv-shown"), bad ? 7000 : 2200);
  }
}

/** Shows a view in an element; `connect(take, gone)` opens its transport. */
export function mount(root, connect) {
  root.app = new App(root, connect);
  return root.app;
}
