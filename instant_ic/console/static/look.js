// @ts-check
// Look direction relative to the robot's heading: mouse or finger drag, wheel, keys.

import { clamp, radians, wrapAngle } from "./math.js";

const MAX_PITCH = radians(80);
const MIN_VFOV = radians(25), MAX_VFOV = radians(85);
const KEY_RATE = radians(70); // per second
/** @type {Record<string, [number, number]>} Left and up. */
const KEYS = { KeyJ: [1, 0], KeyL: [-1, 0], KeyI: [0, 1], KeyK: [0, -1] };
const REST_PITCH = radians(-10); // a little floor in front of the robot
const CENTRE_MS = 350;

export class Look {
  /** @param {HTMLElement} element receives the drags */
  constructor(element) {
    this.yaw = 0;
    this.pitch = REST_PITCH;
    this.vfov = radians(60);
    /** @type {Set<string>} */
    this._held = new Set();
    /** @type {{yaw: number, pitch: number, start: number} | null} */
    this._centring = null;
    /** @type {Map<number, [number, number]>} Pixels. */
    this._pointers = new Map();
    element.addEventListener("pointerdown", (event) => {
      element.setPointerCapture(event.pointerId);
      this._pointers.set(event.pointerId, [event.clientX, event.clientY]);
      this._centring = null;
      element.classList.add("dragging");
    });
    element.addEventListener("pointermove", (event) => this._drag(event, element));
    for (const end of /** @type {const} */ (["pointerup", "pointercancel", "lostpointercapture"]))
      element.addEventListener(end, (event) => {
        this._pointers.delete(event.pointerId);
        if (this._pointers.size === 0) element.classList.remove("dragging");
      });
    element.addEventListener("wheel", (event) => {
      event.preventDefault();
      this.zoom(Math.exp(event.deltaY * 0.001));
    }, { passive: false });
    element.addEventListener("dblclick", () => this.centre());
    window.addEventListener("keydown", (event) => {
      if (event.code in KEYS && !event.ctrlKey && !event.metaKey && !event.altKey) this._held.add(event.code);
    });
    window.addEventListener("keyup", (event) => this._held.delete(event.code));
    window.addEventListener("blur", () => this._held.clear());
  }

  /** True while keys or centring turn the line of sight. */
  get moves() {
    return this._held.size > 0 || this._centring !== null;
  }

  /** Starts to turn the line of sight straight ahead. */
  centre() {
    this._centring = { yaw: this.yaw, pitch: this.pitch, start: performance.now() };
  }

  /** Turns the line of sight by angles in radians, left and up. @param {number} yaw @param {number} pitch */
  turn(yaw, pitch) {
    this._centring = null;
    this.yaw = wrapAngle(this.yaw + yaw);
    this.pitch = clamp(this.pitch + pitch, -MAX_PITCH, MAX_PITCH);
  }

  /** @param {number} factor of the field of view */
  zoom(factor) {
    this.vfov = clamp(this.vfov * factor, MIN_VFOV, MAX_VFOV);
  }

  /** Advances the motion by keys and centring. @param {number} seconds */
  step(seconds) {
    for (const code of this._held) {
      this.turn(KEYS[code][0] * KEY_RATE * seconds, KEYS[code][1] * KEY_RATE * seconds);
    }
    if (this._centring) {
      const t = clamp((performance.now() - this._centring.start) / CENTRE_MS, 0, 1);
      const left = (1 - t) ** 3;
      this.yaw = this._centring.yaw * left;
      this.pitch = REST_PITCH + (this._centring.pitch - REST_PITCH) * left;
      if (t === 1) this._centring = null;
    }
  }

  /** @param {PointerEvent} event @param {HTMLElement} element */
  _drag(event, element) {
    const last = this._pointers.get(event.pointerId);
    if (!last) return;
    const points = [...this._pointers.values()];
    if (points.length === 2) {
      const before = Math.hypot(points[0][0] - points[1][0], points[0][1] - points[1][1]);
      this._pointers.set(event.pointerId, [event.clientX, event.clientY]);
      const [a, b] = [...this._pointers.values()];
      const after = Math.hypot(a[0] - b[0], a[1] - b[1]);
      if (before > 10 && after > 10) this.zoom(before / after);
      return;
    }
    // The image follows the pointer: a drag to the right turns the line of sight to the left.
    const perPixel = this.vfov / element.clientHeight;
    this.turn((event.clientX - last[0]) * perPixel, (event.clientY - last[1]) * perPixel);
    this._pointers.set(event.pointerId, [event.clientX, event.clientY]);
  }
}
