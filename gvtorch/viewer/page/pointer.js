// Mouse, keys and touch: they move the camera, the window of values, the handles of the clip, and the slices.
import { distance, halfHeight, looked, orbited, panned, shifted, under, zoomed, axes } from "./camera.js";
import { add, clamp, times } from "./vectors.js";

const TURN = 0.0075;  // radians a pixel
const KEYS = { w: [0, 0, 1], s: [0, 0, -1], a: [-1, 0, 0], d: [1, 0, 0], q: [0, -1, 0], e: [0, 1, 0] };

export class Pointer {
  constructor(app, view) {
    this.app = app;
    this.view = view;
    this.stage = view.element;
    this.fingers = new Map();
    this.keys = new Set();
    this.speed = 1;
    const on = (name, take) => this.stage.addEventListener(name, take, { passive: false });
    on("pointerdown", (event) => this.down(event));
    on("pointermove", (event) => this.moved(event));
    for (const name of ["pointerup", "pointercancel"]) on(name, (event) => this.up(event));
    on("wheel", (event) => this.wheel(event));
    on("dblclick", (event) => this.focus(event));
    on("contextmenu", (event) => event.preventDefault());
    on("keydown", (event) => this.key(event));
    on("keyup", (event) => this.keys.delete(event.key.toLowerCase()));
    on("blur", () => this.keys.clear());
  }

  /** CSS pixels from the stage's corner. */
  place(event) {
    const box = this.stage.getBoundingClientRect();
    return [event.clientX - box.left, event.clientY - box.top];
  }

  /** Converts CSS pixels from the stage's corner to half heights from the picture's middle. */
  middle([x, y]) {
    const { left, top, width, height } = this.view.area;
    return [(x - left - width / 2) / (height / 2), (y - top - height / 2) / (height / 2)];
  }

  down(event) {
    this.stage.focus({ preventScroll: true });
    this.stage.setPointerCapture(event.pointerId);
    const at = this.place(event);
    this.fingers.set(event.pointerId, at);
    this.plane = event.button ? undefined : this.app.slices.axisAt(...at);
    this.handle = this.plane ? undefined : this.view.handleAt(...at);
    this.travel = 0;
    if (this.fingers.size === 1) {
      const pan = event.button === 2 || event.button === 1 || event.shiftKey;
      this.tool = pan ? "pan" : event.altKey ? "window" : event.ctrlKey ? "fly" : this.app.tool;
    }
    if (this.plane) this.app.slices.pick(this.plane, ...at);
    else if (this.tool === "window") this.app.beginWindow();
  }

  moved(event) {
    const before = this.fingers.get(event.pointerId);
    const at = this.place(event);
    if (!before) {
      const over = this.view.handleAt(...at) || this.view.axisAt(...at);
      this.stage.style.cursor = over ? "pointer" : this.app.slices.axisAt(...at) ? "crosshair" : "";
      return;
    }
    const [dx, dy] = [at[0] - before[0], at[1] - before[1]];
    this.travel += Math.abs(dx) + Math.abs(dy);
    if (this.fingers.size === 2) this.pinch(event.pointerId, at);
    this.fingers.set(event.pointerId, at);
    if (this.fingers.size !== 1 || !this.app.camera) return;
    if (this.plane) return this.app.slices.pick(this.plane, ...at);
    if (this.handle) return this.drag(dx, dy);
    const { app } = this, half = this.view.area.height / 2;
    if (this.tool === "window") app.dragWindow(dx / this.view.width, dy / this.view.height);
    else if (this.tool === "pan") app.look(panned(app.camera, dx / half, dy / half), true);
    else if (this.tool === "fly") app.look(looked(app.camera, dx * TURN * 0.4, dy * TURN * 0.4), true);
    else app.look(orbited(app.camera, dx * TURN, -dy * TURN), true);
  }

  pinch(id, at) {
    const [other] = [...this.fingers].filter(([one]) => one !== id).map(([, place]) => place);
    const before = this.fingers.get(id), { app } = this;
    const span = (a) => Math.max(10, Math.hypot(a[0] - other[0], a[1] - other[1]));
    const centre = this.middle([(at[0] + other[0]) / 2, (at[1] + other[1]) / 2]);
    const half = this.view.area.height / 2;
    const moved = panned(app.camera, (at[0] - before[0]) / 2 / half, (at[1] - before[1]) / 2 / half);
    app.look(zoomed(moved, span(before) / span(at), under(moved, ...centre)), true);
  }

  up(event) {
    const at = this.fingers.get(event.pointerId);
    this.fingers.delete(event.pointerId);
    if (this.fingers.size) return;
    if (at && this.travel < 4) {
      const axis = this.view.axisAt(...at);
      if (axis) this.app.face(axis.axis, event.shiftKey ? -1 : 1);
    }
    if (this.handle || this.plane) this.app.settle();
    else if (this.tool === "window") this.app.settle();
    else if (this.travel) this.app.rest();
    this.handle = this.plane = null;
  }

  /** Moves a handle with the pointer, and finds it again: the drawing makes new handles. */
  drag(dx, dy) {
    const { ratio } = this.view, { kind, axis, side, n } = this.handle;
    this.handle.drag(dx * ratio, dy * ratio);
    const same = (one) => one.kind === kind && one.axis === axis && one.side === side && one.n === n;
    this.handle = this.view.handles.find(same) ?? this.handle;
  }

  wheel(event) {
    event.preventDefault();
    const { app } = this;
    if (!app.camera) return;
    const lines = event.deltaMode ? event.deltaY * 30 : event.deltaY;
    const plane = app.slices.axisAt(...this.place(event));
    if (plane) return app.slices.wheel(plane, lines);
    if (app.tool === "fly" && !event.ctrlKey) {
      this.speed = clamp(this.speed * Math.exp(-lines * 0.002), 0.02, 50);
      app.say(`speed × ${this.speed.toPrecision(2)}`);
      return;
    }
    const factor = Math.exp(clamp(lines, -300, 300) * 0.0013);
    app.look(zoomed(app.camera, factor, under(app.camera, ...this.middle(this.place(event)))), true);
    app.restSoon();
  }

  focus(event) {
    const [x, y] = this.place(event), { left, top, width, height } = this.view.area;
    if (this.app.slices.axisAt(x, y)) return;
    this.app.link.send("pick", { x: clamp((x - left) / width, 0, 1), y: clamp((y - top) / height, 0, 1), purpose: "focus" });
  }

  key(event) {
    const key = event.key.toLowerCase(), { app } = this;
    if (event.ctrlKey || event.metaKey) {
      if (key === "z" && event.shiftKey) app.redo();
      else if (key === "z") app.undo();
      return;
    }
    if (event.altKey || !app.camera) return;
    if (key in KEYS) {
      event.preventDefault();
      if (!this.keys.size) requestAnimationFrame((now) => this.fly(now, now));
      this.keys.add(key);
    } else if ("123456".includes(key)) app.face(Math.floor((key - 1) / 2), key % 2 ? 1 : -1);
    else if (key === "f" || key === "home") app.link.send("do", { what: "fit" });
    else if (key === "o") app.switchOrtho();
    else if (key.startsWith("arrow")) {
      event.preventDefault();
      const turn = { arrowleft: [-1, 0], arrowright: [1, 0], arrowup: [0, 1], arrowdown: [0, -1] }[key];
      app.look(orbited(app.camera, -turn[0] * 0.08, -turn[1] * 0.08), true);
      app.restSoon();
    }
  }

  /** Flies while keys are held. */
  fly(now, before) {
    const { app } = this;
    if (!this.keys.size) return app.rest();
    const { right, up, forward } = axes(app.camera);
    let way = [0, 0, 0];
    for (const key of this.keys) {
      const [x, y, z] = KEYS[key] ?? [0, 0, 0];
      way = add(way, add(times(right, x), add(times(up, y), times(forward, z))));
    }
    const seconds = Math.min(0.1, (now - before) / 1000);
    const reach = Math.max(halfHeight(app.camera), 0.02 * distance(app.camera));
    app.look(shifted(app.camera, times(way, seconds * reach * 1.2 * this.speed)), true);
    requestAnimationFrame((next) => this.fly(next, now));
  }
}
