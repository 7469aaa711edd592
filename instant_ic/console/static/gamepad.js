// @ts-check
// Gamepad with the browser's standard layout: hold a shoulder button and drive with the left stick, look with the right.

/** @import { Drive } from "./drive.js" */
/** @import { Look } from "./look.js" */
import { deadZone } from "./drive.js";
import { mark } from "./dom.js";
import { radians } from "./math.js";

const POLL_MS = 20;
const STOP = 1, CENTRE = 3, SHOULDERS = [4, 5], FASTER = 12, SLOWER = 13; // B, Y, LB and RB, D-pad up and down
const LOOK_RATE = radians(110); // per second, at full deflection
const STEP = 10; // percent of the speed limit

/**
 * @typedef {object} PadActions
 * @property {() => void} drive the shoulder button was pressed
 * @property {() => void} stop
 * @property {(percent: number) => void} changeScale adds to the speed limit
 * @property {(text: string) => void} notice
 * @property {() => void} wake the direction changed
 */

/** The gamepads. One drives only while the window has focus, and with a shoulder button pressed after it gained focus. */
export class Gamepads {
  /** @param {Drive} drive @param {Look} look @param {PadActions} actions */
  constructor(drive, look, actions) {
    this.drive = drive;
    this.look = look;
    this.actions = actions;
    /** @type {number | null} Index of the active pad. */
    this._index = null;
    /** @type {Set<number>} */
    this._held = new Set();
    this._driving = false;
    this._last = this._timer = 0;
    window.addEventListener("gamepadconnected", ({ gamepad }) => this._connect(gamepad));
    window.addEventListener("gamepaddisconnected", ({ gamepad }) => {
      if (gamepad.index === this._index) this._lose();
    });
    // After any stop, the shoulder button must be released and pressed again.
    drive.addEventListener("stop", () => { this._driving = false; });
  }

  /** @param {Gamepad} pad */
  _connect(pad) {
    if (pad.mapping !== "standard") {
      this.actions.notice(`Gamepad ${pad.id} cannot drive: the browser does not know its layout.`);
      return;
    }
    if (this._index !== null) return;
    this._index = pad.index;
    this._last = performance.now();
    this._timer = setInterval(() => this._poll(), POLL_MS);
    this._held = pressed(pad); // a button that is already held was not pressed to drive
    mark("pad", "ready");
    this.actions.notice("Gamepad connected: hold a shoulder button and drive with the left stick.");
  }

  _lose() {
    clearInterval(this._timer);
    this._index = null;
    this._driving = false;
    mark("pad", "none");
    this.drive.stop("the gamepad was disconnected");
  }

  _poll() {
    const now = performance.now(), seconds = Math.min((now - this._last) / 1000, 0.1);
    this._last = now;
    const pad = this._index === null ? null : navigator.getGamepads()[this._index];
    if (!pad?.connected) return this._lose();
    const held = pressed(pad), fresh = [...held].filter((button) => !this._held.has(button));
    this._held = held;
    const focused = document.hasFocus() && !document.hidden;
    if (fresh.includes(STOP)) this.actions.stop(); // even without focus
    if (!focused) return this._release();
    if (!this.drive.enabled) this._release(); // not the driver, or an emergency stop
    if (fresh.includes(FASTER)) this.actions.changeScale(STEP);
    if (fresh.includes(SLOWER)) this.actions.changeScale(-STEP);
    const [yaw, pitch] = [deadZone(-pad.axes[2]), deadZone(-pad.axes[3])];
    if (yaw || pitch) this.look.turn(yaw * LOOK_RATE * seconds, pitch * LOOK_RATE * seconds);
    if (fresh.includes(CENTRE)) this.look.centre();
    if (yaw || pitch || fresh.includes(CENTRE)) this.actions.wake();
    if (fresh.some((button) => SHOULDERS.includes(button))) {
      this._driving = true;
      this.actions.drive();
    }
    if (!SHOULDERS.some((button) => held.has(button))) this._release();
    if (this._driving) this.drive.setStick(deadZone(-pad.axes[1]), deadZone(-pad.axes[0]));
    mark("pad", this._driving ? "driving" : "ready");
  }

  _release() {
    if (!this._driving) return;
    this._driving = false;
    this.drive.setStick(0, 0);
    mark("pad", "ready");
  }
}

/** @param {Gamepad} pad @returns {Set<number>} */
function pressed(pad) {
  return new Set(pad.buttons.flatMap((button, index) => (button.pressed ? [index] : [])));
}
