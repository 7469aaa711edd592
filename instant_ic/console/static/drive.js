// @ts-check
// Hold to drive: keyboard, touch stick and gamepad. Any event that may hide a release counts as a release.

/** @import { Link } from "./link.js" */
import { clamp } from "./math.js";

const SEND_MS = 50;
/** @type {Record<string, [number, number]>} Forward and left. */
const KEYS = {
  KeyW: [1, 0], ArrowUp: [1, 0],
  KeyS: [-1, 0], ArrowDown: [-1, 0],
  KeyA: [0, 1], ArrowLeft: [0, 1],
  KeyD: [0, -1], ArrowRight: [0, -1],
};

/** Returns whether a key event drives. Arrow keys belong to a focused slider. @param {KeyboardEvent} event */
export function isDriveKey(event) {
  const slider = event.target instanceof HTMLInputElement && event.code.startsWith("Arrow");
  return event.code in KEYS && !slider;
}

/**
 * The operator's drive command. Events: "change" when keys, stick or command may have changed; "stop" (detail: reason or "")
 * when a drive ends for another reason than a released key or stick.
 */
export class Drive extends EventTarget {
  /** @param {Link} link */
  constructor(link) {
    super();
    this.link = link;
    this.scale = 0.7;
    this.limits = { linear: 0, angular: 0 };
    this.enabled = false;
    /** @type {[number, number]} m/s, rad/s */
    this.command = [0, 0];
    /** @type {Set<string>} */
    this._held = new Set();
    this._stick = [0, 0];
    this._timer = 0;
    window.addEventListener("keydown", (event) => this._keyDown(event));
    window.addEventListener("keyup", (event) => this._keyUp(event));
    window.addEventListener("blur", () => this.stop("the window lost focus"));
    window.addEventListener("pagehide", () => this.stop("the page was closed"));
    window.addEventListener("contextmenu", () => this.stop("a menu was opened"));
    document.addEventListener("visibilitychange", () => {
      if (document.hidden) this.stop("the page was hidden");
    });
    link.addEventListener("lost", () => this.stop("the link was lost"));
  }

  /** Releases all keys and the stick, and sends zero at once. @param {string} why text for the operator; empty: none */
  stop(why = "") {
    const moving = this.command[0] !== 0 || this.command[1] !== 0;
    this._held.clear();
    this._stick = [0, 0];
    this._update();
    if (moving) this.dispatchEvent(new CustomEvent("stop", { detail: why }));
  }

  /** Returns whether a key of this direction is held. @param {string} code KeyW, KeyA, KeyS or KeyD */
  holds(code) {
    const [forward, left] = KEYS[code];
    return [...this._held].some((held) => KEYS[held][0] === forward && KEYS[held][1] === left);
  }

  /** @param {boolean} enabled */
  setEnabled(enabled) {
    if (this.enabled && !enabled) this.stop();
    this.enabled = enabled;
  }

  /** @param {number} scale share of the limits, 0.1 to 1 */
  setScale(scale) {
    this.scale = clamp(scale, 0.1, 1);
    this._update();
  }

  /** Sets the stick, each axis in [-1, 1]. @param {number} forward @param {number} left */
  setStick(forward, left) {
    this._stick = this.enabled ? [forward, left] : [0, 0];
    this._update();
  }

  /** @param {KeyboardEvent} event */
  _keyDown(event) {
    if (!isDriveKey(event)) return;
    // While a system key is held, the browser may suppress the key-up event.
    if (event.ctrlKey || event.metaKey || event.altKey) return this.stop("a system key was pressed");
    event.preventDefault();
    if (event.repeat || !this.enabled) return;
    this._held.add(event.code);
    this._update();
  }

  /** @param {KeyboardEvent} event */
  _keyUp(event) {
    if (event.key === "Meta") return this.stop("a system key was pressed");
    if (this._held.delete(event.code)) this._update();
  }

  _update() {
    let [forward, left] = this._stick;
    for (const code of this._held) {
      forward += KEYS[code][0];
      left += KEYS[code][1];
    }
    const linear = clamp(forward, -1, 1) * this.scale * this.limits.linear;
    const angular = clamp(left, -1, 1) * this.scale * this.limits.angular;
    const changed = linear !== this.command[0] || angular !== this.command[1];
    this.command = [linear, angular];
    this.dispatchEvent(new Event("change"));
    if (!changed) return;
    this._send();
    const active = linear !== 0 || angular !== 0;
    if (active && !this._timer) this._timer = setInterval(() => this._send(), SEND_MS);
    if (!active && this._timer) {
      clearInterval(this._timer);
      this._timer = 0;
    }
  }

  _send() {
    this.link.drive(this.command[0], this.command[1]);
  }
}

/** Makes `element`, which has a child with class "knob", an on-screen stick. @param {HTMLElement} element @param {Drive} drive */
export function attachStick(element, drive) {
  const knob = /** @type {HTMLElement} */ (element.querySelector(".knob"));
  /** @type {number | null} */
  let pointer = null;

  /** @param {PointerEvent} event */
  const release = (event) => {
    if (event.pointerId !== pointer) return;
    pointer = null;
    knob.style.transform = "";
    drive.setStick(0, 0);
  };
  /** @param {PointerEvent} event */
  const move = (event) => {
    if (event.pointerId !== pointer) return;
    const box = element.getBoundingClientRect();
    const radius = box.width / 2 - 22;
    let x = event.clientX - box.left - box.width / 2;
    let y = event.clientY - box.top - box.height / 2;
    const length = Math.hypot(x, y);
    if (length > radius) {
      x *= radius / length;
      y *= radius / length;
    }
    knob.style.transform = `translate(${x}px, ${y}px)`;
    drive.setStick(deadZone(-y / radius), deadZone(-x / radius));
  };
  element.addEventListener("pointerdown", (event) => {
    if (pointer !== null || !drive.enabled) return; // a touch that begins without the lease never drives
    pointer = event.pointerId;
    element.setPointerCapture(event.pointerId);
    event.preventDefault();
    move(event);
  });
  element.addEventListener("pointermove", move);
  for (const end of /** @type {const} */ (["pointerup", "pointercancel", "lostpointercapture"])) element.addEventListener(end, release);
  drive.addEventListener("stop", () => {
    pointer = null;
    knob.style.transform = "";
  });
}

/** Returns the value of a stick's axis, [-1, 1], with a dead zone around its centre. @param {number} value */
export function deadZone(value) {
  const size = Math.abs(value);
  return size < 0.12 ? 0 : (Math.sign(value) * (size - 0.12)) / 0.88;
}
