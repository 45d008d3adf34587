// The page: its copy of the view's state, its parts, and the messages that it handles and sends.
import { between, distance, facing, MODELS } from "./camera.js";
import { el, iconButton, textButton, saveFile, openJson } from "./dom.js";
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
const REST_MS = 160;  // milliseconds after which a wheel or a key is at rest

/** Merges a change into a value: objects of one kind field by field; anything else is replaced. */
function merged(current, change) {
  const isObject = (value) => value !== null && typeof value === "object" && !Array.isArray(value);
  if (!isObject(change) || !isObject(current) || (change.kind && current.kind && change.kind !== current.kind)) return change;
  const result = { ...current };
  for (const [name, value] of Object.entries(change)) result[name] = merged(current[name], value);
  return result;
}

export class App {
  constructor(root, connect) {
    this.root = root;
    this.tool = "orbit";
    this.surfaceLevel = 0;
    this.open = new Set(["Colours", "Shader", "Picture"]);  // sections of the panel
    this.overlays = { axes: true, scale: true, box: false, nodes: false };
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
    const on = (type, handler) => this.link.on(type, handler);
    on("welcome", (message) => this.welcome(message));
    on("picture", (picture) => this.view.receive(picture));
    on("file", ({ head, bytes }) => { saveFile(head.file, bytes, TYPES[head.file.split(".").at(-1)] ?? "application/octet-stream"); this.notify(`${head.file} is saved`); });
    on("state", (message) => this.receiveState(message));
    on("camera", ({ camera }) => this.setCamera(camera));
    on("clients", ({ clients }) => { this.clients = clients; this.refresh(); });
    on("histogram", (message) => this.panel?.editor.setHistogram(message));
    on("preset", (message) => this.presets.receive(message));
    on("found", (message) => this.panel?.labels.receive(message));
    on("nodes", (message) => this.nodes.receive(message));
    on("note", ({ text }) => this.notify(text));
    on("picked", (message) => this.picked(message));
    on("parameters", ({ parameters, box }) => { Object.assign(this, { parameters, box }); this.refresh(); this.view.drawOverlay(); this.askHistogram(this.inView); });
    on("engine", ({ engine }) => { this.engine = engine; this.refresh(); });
    on("busy", (busy) => this.busy(busy));
    on("figures", (figures) => this.monitor.receive(figures));
    on("exporting", ({ done, total }) => this.notify(`making the surface … ${Math.round((100 * done) / total)} %`, false, null, true));
    for (const type of ["refused", "error"]) on(type, ({ text }) => { this.notify(text, true); this.refresh(); });
    on("failed", ({ text, count }) => this.notify(`${count} parts could not be loaded: ${text}`, true, () => this.link.send("do", { what: "retry" })));
    on("gone", ({ reason }) => { this.notify(reason || "The view is gone; trying to reach it again …", true); this.root.classList.add("gv-lost"); });
    this.view.element.addEventListener("drawn", ({ detail }) => {
      this.monitor.drawn();
      this.times.drawn(detail);
      if (detail.final && this.panel?.editor.histogram?.in_view) this.askHistogram(this.inView);
    });
  }

  toolbar() {
    this.buttons = {};
    for (const [name, title] of Object.entries(TOOLS)) this.buttons[name] = iconButton(name, title, () => this.useTool(name));
    this.buttons.orbit.classList.add("gv-on");
    const group = (...items) => el("div.gv-tools", {}, ...items);
    return el("nav.gv-top", {}, group(...Object.values(this.buttons)),
      group(iconButton("home", "The whole box (F)", () => this.link.send("do", { what: "fit" })),
        iconButton("ortho", "Orthographic or perspective (O); views along axes: 1 to 6, or a click on x, y, z", () => this.switchOrtho())),
      group(this.slicesButton = iconButton("slices", "Three slices beside the picture", () => this.slices.show(!this.state.slices))),
      group(iconButton("undo", "Undo (Ctrl Z)", () => this.travel("undo")),
        iconButton("redo", "Redo (Ctrl Shift Z)", () => this.travel("redo")),
        iconButton("camera", "Save the picture (PNG)", () => this.saveStill()),
        iconButton("save", "Save all that is shown (JSON): gvtorch view --state, gvtorch render --state", () => saveFile("view.json", JSON.stringify({ ...this.state, camera: this.camera }, null, 1), "application/json")),
        iconButton("open", "Load what was saved (JSON)", () => openJson((state) => this.load(state), (reason) => this.notify(reason, true)))),
      this.title, el("span.gv-gap"),
      group(iconButton("panel", "Panel", () => { this.root.classList.toggle("gv-closed"); })));
  }

  useTool(name) {
    this.tool = name;
    for (const [other, button] of Object.entries(this.buttons)) button.classList.toggle("gv-on", other === name);
    this.view.element.focus({ preventScroll: true });
  }

  welcome(message) {
    Object.assign(this, {
      number: message.client, box: message.box, unit: message.unit, schema: message.schema, time: message.time, labels: message.labels,
      channels: message.channels, widths: message.widths, engine: message.engine, parameters: message.parameters,
    });
    Object.assign(MODELS, message.models);
    this.presets.builtIn = message.presets;
    this.root.classList.remove("gv-lost");
    this.note.classList.remove("gv-shown");
    const { camera, ...state } = message.state;
    this.state = state;
    this.unfit = message.unfit;
    if (this.camera) this.sendCamera(false);  // a new connection
    else this.camera = camera;
    this.home = camera;
    this.title.textContent = message.name;
    document.title = this.root.classList.contains("gv-page") ? `${message.name} · gvtorch` : document.title;
    this.panel?.element.remove();
    this.panel = new Panel(this);
    this.root.append(this.panel.element);
    this.view.sendSize();
    this.view.drawOverlay();
    this.lastTransfer = this.transfer() ?? { kind: "TransferFunction", opacity: [[0, 0], [1, 0.5]], color: [[0, 0, 0, 0], [1, 1, 1, 1]] };
    this.refresh();
    this.askHistogram(false);
    if (this.overlays.nodes) this.nodes.show(true);
  }

  refresh() {
    if (!this.panel || this.panel.editor.dragged) return;
    this.panel.show();
    this.times.show();
    this.root.classList.toggle("gv-sliced", !!this.state.slices);
    this.slicesButton.classList.toggle("gv-on", !!this.state.slices);
  }

  // The state.

  receiveState({ state, unfit }) {
    const { camera, ...rest } = state;
    if (JSON.stringify([rest, unfit]) === JSON.stringify([this.state, this.unfit])) return;
    this.state = rest;
    this.unfit = unfit;
    this.refresh();
    this.view.drawOverlay();
  }

  change(part, rest = true) {
    if (!this.stateBefore) this.stateBefore = this.state;
    this.state = merged(this.state, part);
    this.link.send("change", { state: part, rest });
    if (rest) {
      this.remember(this.stateBefore, this.state);
      this.stateBefore = null;
      this.refresh();  // not before: a slider that is dragged would be replaced
    }
    this.view.drawOverlay();
  }

  /** Adds an edit of the state to the history, unless it changed nothing. */
  remember(before, after) {
    if (JSON.stringify(before) === JSON.stringify(after)) return;
    this.history.push(() => this.replaceState(before), () => this.replaceState(after));
  }

  /** Replaces the whole state. */
  replaceState(state) {
    this.state = state;
    this.link.send("change", { state, rest: true });
    this.refresh();
    this.view.drawOverlay();
  }

  /** Undoes or redoes an edit. */
  travel(direction) {
    if (!this.history[direction]()) this.notify(`there is nothing to ${direction}`);
  }

  /** Sets a parameter of the scene, or the engine's memory; the answer shows it. */
  setValue(type, before, value, message) {
    const apply = (newValue) => this.link.send(type, message(newValue));
    this.history.push(() => apply(before), () => apply(value));
    apply(value);
  }

  /** Loads a saved state; the answer shows it, and sets the camera. */
  load(state) {
    const before = this.state, send = (content) => this.link.send("change", { state: content, rest: true });
    this.history.push(() => this.replaceState(before), () => send({ ...state, camera: undefined }));
    send(state);
  }

  // Colours.

  transfer() {
    const { shader } = this.state;
    const transfer = shader.kind === "TransferFunction" ? shader : shader.transfer;
    return Array.isArray(transfer?.opacity) && Array.isArray(transfer.color) ? transfer : null;
  }

  changeTransfer(f, rest) {
    this.lastTransfer = f;
    const { shader } = this.state;
    this.change({ shader: shader.kind === "TransferFunction" ? f : { ...shader, transfer: f } }, rest);
  }

  /** Whether a kind of shader is offered: Features needs a second channel; StoredColor and Labels only if shown now. */
  offers(kind) {
    const severalChannels = Object.keys(this.widths).length > 1;
    return { Features: severalChannels, StoredColor: this.state.shader.kind === "StoredColor", Labels: this.state.shader.kind === "Labels" }[kind] ?? this.state.shader.kind !== "Labels";
  }

  askHistogram(inView) {
    this.inView = inView;
    this.link.send("histogram", { in_view: inView });
  }

  dragWindow(dx, dy) {
    const move = ([low, high]) => {
      const width = (high - low) * Math.exp(dx * 3), middle = (low + high) / 2 - dy * (high - low) * 1.5;
      return [middle - width / 2, middle + width / 2];
    };
    const f = this.transfer(), { shader } = this.state;
    if (f) this.changeTransfer(stretched(f, domain(f), move(domain(f))), false);
    else if (shader.looks) this.change({ shader: { ...shader, looks: shader.looks.map((look) => (look.window ? { ...look, window: move(look.window) } : look)) } }, false);
    else if ("value" in shader) this.change({ shader: { ...shader, value: shader.value - dy * (Math.abs(shader.value) + 1) } }, false);
  }

  finishEdit() {
    if (this.stateBefore) this.change({}, true);
    this.refresh();
  }

  // The camera.

  setCamera(camera) {
    this.camera = camera;
    this.view.drawOverlay();
    this.refresh();
  }

  moveCamera(camera, moving) {
    this.camera = camera;
    this.view.drawOverlay();
    if (moving && this.frameRequest) return;
    if (!moving) return this.sendCamera(false);
    this.frameRequest = requestAnimationFrame(() => { this.frameRequest = 0; this.sendCamera(true); });
  }

  sendCamera(moving) {
    if (this.frameRequest) cancelAnimationFrame(this.frameRequest);
    this.frameRequest = 0;
    const { eye, target, up, fov, model } = this.camera;
    this.link.send("move", { camera: { eye, target, up, fov, model }, moving, sent: moving ? performance.now() : 0 });
  }

  finishMove() {
    this.sendCamera(false);
    if (this.open.has("Camera")) this.refresh();
  }

  finishMoveSoon() {
    clearTimeout(this.restTimer);
    this.restTimer = setTimeout(() => this.finishMove(), REST_MS);
  }

  /** Moves smoothly to a camera in a quarter of a second, unless something else moves it. */
  glide(camera) {
    const from = this.camera, start = performance.now();
    let last = from;
    const step = (now) => {
      if (this.camera !== last) return;
      const t = clamp((now - start) / 260, 0, 1);
      last = t < 1 ? between(from, camera, t * t * (3 - 2 * t)) : camera;
      this.moveCamera(last, t < 1);
      if (t < 1) requestAnimationFrame(step);
    };
    step(start);
  }

  faceAxis(axis, side) {
    this.glide(facing(this.camera, axis, side, this.home.up));
  }

  /** Sets a field of the camera, which can be undone. */
  changeCamera(camera, rest) {
    this.cameraBefore ??= this.camera;
    this.moveCamera(camera, !rest);
    if (!rest) return;
    const before = this.cameraBefore, apply = (newCamera) => { this.moveCamera(newCamera, false); this.refresh(); };
    this.cameraBefore = null;
    this.history.push(() => apply(before), () => apply(camera));
  }

  switchOrtho() {
    this.changeCamera({ ...this.camera, model: this.camera.model === "ortho" ? "pinhole" : "ortho" }, true);
    this.refresh();
  }

  picked({ place: position, purpose }) {
    if (purpose !== "focus") return;
    if (!position) return this.notify("there is nothing");
    const { camera } = this, shift = position.map((value, axis) => value - camera.target[axis]);
    this.glide({ ...camera, target: position, eye: camera.eye.map((value, axis) => value + shift[axis]) });
    this.notify(`at ${position.map((value) => Number(value.toPrecision(5))).join(", ")}; ${Number(distance(camera).toPrecision(3))} away`);
  }

  saveSurface(request) {
    this.notify("making the surface …", false, null, true);
    this.link.send("surface", request);
  }

  saveStill() {
    this.notify("rendering …");
    this.link.send("still", { width: this.view.overlayCanvas.width, height: this.view.overlayCanvas.height });
  }

  // Progress and notes.

  busy({ pending, misses, crowded }) {
    const remaining = Math.max(pending, misses);
    this.progress.classList.toggle("gv-shown", remaining > 0);
    this.busyMax = remaining ? Math.max(this.busyMax ?? 0, remaining) : 0;
    this.progress.style.setProperty("--done", `${remaining ? Math.max(4, 100 * (1 - remaining / this.busyMax)) : 100}%`);
    if (crowded && !this.wasCrowded) this.notify("The brick pool is too small for this picture: parts of it are coarser (Memory).");
    this.wasCrowded = crowded;
  }

  notify(text, isError = false, retry = null, isSticky = false) {
    clearTimeout(this.noteTimer);
    this.note.replaceChildren(text, ...(retry ? [textButton("try again", "", () => { retry(); this.note.classList.remove("gv-shown"); })] : []));
    this.note.classList.toggle("gv-bad", isError);
    this.note.classList.add("gv-shown");
    if (!retry && !isSticky) this.noteTimer = setTimeout(() => this.note.classList.remove("gv-shown"), isError ? 7000 : 2200);
  }
}

/** Shows a view in an element; `connect(receive, onLost)` opens its transport. */
export function mount(root, connect) {
  root.app = new App(root, connect);
  return root.app;
}
