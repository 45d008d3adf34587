// Mouse, keys and touch: they move the camera, the window of values, the handles of the clip, and the slices.
import { distance, halfHeight, lookedAround, orbited, panned, shifted, worldPoint, zoomed, axes } from "./camera.js";
import { add, clamp, times } from "./vectors.js";

const RADIANS_PER_PIXEL = 0.0075;  // radians a pixel
const KEYS = { w: [0, 0, 1], s: [0, 0, -1], a: [-1, 0, 0], d: [1, 0, 0], q: [0, -1, 0], e: [0, 1, 0] };

export class Pointer {
  constructor(app, view) {
    this.app = app;
    this.view = view;
    this.stage = view.element;
    this.fingers = new Map();
    this.keys = new Set();
    this.speed = 1;
    const on = (name, handler) => this.stage.addEventListener(name, handler, { passive: false });
    on("pointerdown", (event) => this.down(event));
    on("pointermove", (event) => this.moved(event));
    for (const name of ["pointerup", "pointercancel"]) on(name, (event) => this.up(event));
    on("wheel", (event) => this.wheel(event));
    on("dblclick", (event) => this.focus(event));
    on("contextmenu", (event) => event.preventDefault());
    on("blur", () => this.keys.clear());
    window.addEventListener("blur", () => this.keys.clear());
    const keyboard = app.root.classList.contains("gv-page") ? document : app.root;
    keyboard.addEventListener("keydown", (event) => this.key(event));
    keyboard.addEventListener("keyup", (event) => this.keys.delete(event.key.toLowerCase()));
  }

  /** CSS pixels from the stage's corner. */
  positionOf(event) {
    const box = this.stage.getBoundingClientRect();
    return [event.clientX - box.left, event.clientY - box.top];
  }

  /** Converts CSS pixels from the stage's corner to half heights from the picture's middle. */
  toHalfHeights([x, y]) {
    const { left, top, width, height } = this.view.pictureArea;
    return [(x - left - width / 2) / (height / 2), (y - top - height / 2) / (height / 2)];
  }

  down(event) {
    this.stage.focus({ preventScroll: true });
    this.stage.setPointerCapture(event.pointerId);
    const position = this.positionOf(event);
    this.fingers.set(event.pointerId, position);
    this.plane = event.button ? undefined : this.app.slices.axisAt(...position);
    this.handle = this.plane ? undefined : this.view.handleAt(...position);
    this.travel = 0;
    if (this.fingers.size === 1) {
      const pan = event.button === 2 || event.button === 1 || event.shiftKey;
      this.tool = pan ? "pan" : event.altKey ? "window" : event.ctrlKey ? "fly" : this.app.tool;
    }
    if (this.plane) this.app.slices.pick(this.plane, ...position);
  }

  moved(event) {
    const previous = this.fingers.get(event.pointerId);
    const position = this.positionOf(event);
    if (!previous) {
      const target = this.view.handleAt(...position) || this.view.axisAt(...position);
      this.stage.style.cursor = target ? "pointer" : this.app.slices.axisAt(...position) ? "crosshair" : "";
      return;
    }
    const [dx, dy] = [position[0] - previous[0], position[1] - previous[1]];
    this.travel += Math.abs(dx) + Math.abs(dy);
    if (this.fingers.size === 2) this.pinch(event.pointerId, position);
    this.fingers.set(event.pointerId, position);
    if (this.fingers.size !== 1 || !this.app.camera) return;
    if (this.plane) return this.app.slices.pick(this.plane, ...position);
    if (this.handle) return this.drag(dx, dy);
    const { app } = this, half = this.view.pictureArea.height / 2;
    if (this.tool === "window") app.dragWindow(dx / this.view.width, dy / this.view.height);
    else if (this.tool === "pan") app.moveCamera(panned(app.camera, dx / half, dy / half), true);
    else if (this.tool === "fly") app.moveCamera(lookedAround(app.camera, dx * RADIANS_PER_PIXEL * 0.4, dy * RADIANS_PER_PIXEL * 0.4), true);
    else app.moveCamera(orbited(app.camera, dx * RADIANS_PER_PIXEL, -dy * RADIANS_PER_PIXEL), true);
  }

  pinch(id, position) {
    const [other] = [...this.fingers].filter(([otherId]) => otherId !== id).map(([, otherPosition]) => otherPosition);
    const previous = this.fingers.get(id), { app } = this;
    const span = (finger) => Math.max(10, Math.hypot(finger[0] - other[0], finger[1] - other[1]));
    const centre = this.toHalfHeights([(position[0] + other[0]) / 2, (position[1] + other[1]) / 2]);
    const half = this.view.pictureArea.height / 2;
    const moved = panned(app.camera, (position[0] - previous[0]) / 2 / half, (position[1] - previous[1]) / 2 / half);
    app.moveCamera(zoomed(moved, span(previous) / span(position), worldPoint(moved, ...centre)), true);
  }

  up(event) {
    const position = this.fingers.get(event.pointerId);
    this.fingers.delete(event.pointerId);
    if (this.fingers.size) return;
    if (position && this.travel < 4) {
      const axis = this.view.axisAt(...position);
      if (axis) this.app.faceAxis(axis.axis, event.shiftKey ? -1 : 1);
    }
    if (this.handle || this.plane) this.app.finishEdit();
    else if (this.tool === "window") this.app.finishEdit();
    else if (this.travel) this.app.finishMove();
    this.handle = this.plane = null;
  }

  /** Moves a handle with the pointer, and finds it again: the drawing makes new handles. */
  drag(dx, dy) {
    const { ratio } = this.view, { kind, axis, side, n } = this.handle;
    this.handle.drag(dx * ratio, dy * ratio);
    const isSame = (handle) => handle.kind === kind && handle.axis === axis && handle.side === side && handle.n === n;
    this.handle = this.view.handles.find(isSame) ?? this.handle;
  }

  wheel(event) {
    event.preventDefault();
    const { app } = this;
    if (!app.camera) return;
    const amount = event.deltaMode ? event.deltaY * 30 : event.deltaY;
    const plane = app.slices.axisAt(...this.positionOf(event));
    if (plane) return app.slices.wheel(plane, amount);
    if (app.tool === "fly" && !event.ctrlKey) {
      this.speed = clamp(this.speed * Math.exp(-amount * 0.002), 0.02, 50);
      app.notify(`speed × ${this.speed.toPrecision(2)}`);
      return;
    }
    const factor = Math.exp(clamp(amount, -300, 300) * 0.0013);
    app.moveCamera(zoomed(app.camera, factor, worldPoint(app.camera, ...this.toHalfHeights(this.positionOf(event)))), true);
    app.finishMoveSoon();
  }

  focus(event) {
    const [x, y] = this.positionOf(event), { left, top, width, height } = this.view.pictureArea;
    if (this.app.slices.axisAt(x, y)) return;
    this.app.link.send("pick", { x: clamp((x - left) / width, 0, 1), y: clamp((y - top) / height, 0, 1), purpose: "focus" });
  }

  /** Handles a key, unless a control has a use for it. */
  key(event) {
    const key = event.key.toLowerCase(), { app } = this, { target } = event;
    if (["number", "text"].includes(target.type)) return;
    if (event.ctrlKey || event.metaKey) {
      if (key === "z") app.travel(event.shiftKey ? "redo" : "undo");
      return;
    }
    if (event.altKey || !app.camera || app.panel.element.contains(target)) return;
    if (key in KEYS) {
      event.preventDefault();
      this.keys.add(key);
      this.flight ||= requestAnimationFrame((now) => this.fly(now, now));
    } else if ("123456".includes(key)) app.faceAxis(Math.floor((key - 1) / 2), key % 2 ? 1 : -1);
    else if (key === "f" || key === "home") app.link.send("do", { what: "fit" });
    else if (key === "o") app.switchOrtho();
    else if (key.startsWith("arrow")) {
      event.preventDefault();
      const turn = { arrowleft: [-1, 0], arrowright: [1, 0], arrowup: [0, 1], arrowdown: [0, -1] }[key];
      app.moveCamera(orbited(app.camera, -turn[0] * 0.08, -turn[1] * 0.08), true);
      app.finishMoveSoon();
    }
  }

  /** Flies while keys are held. */
  fly(now, lastTime) {
    const { app } = this;
    this.flight = 0;
    if (!this.keys.size) return app.finishMove();
    const { right, up, forward } = axes(app.camera);
    let direction = [0, 0, 0];
    for (const key of this.keys) {
      const [x, y, z] = KEYS[key] ?? [0, 0, 0];
      direction = add(direction, add(times(right, x), add(times(up, y), times(forward, z))));
    }
    const seconds = Math.min(0.1, (now - lastTime) / 1000);
    const pace = Math.max(halfHeight(app.camera), 0.02 * distance(app.camera));
    app.moveCamera(shifted(app.camera, times(direction, seconds * pace * 1.2 * this.speed)), true);
    this.flight = requestAnimationFrame((next) => this.fly(next, now));
  }
}
