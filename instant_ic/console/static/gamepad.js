// Gamepad of the browser's standard layout: hold a shoulder button and drive by the left stick, look by the right one.

import { deadZone } from "./drive.js";
import { radians } from "./math.js";

const POLL_MS = 20;
const STOP = 1, CENTRE = 3, SHOULDERS = [4, 5], FASTER = 12, SLOWER = 13; // B, Y, LB and RB, cross up and down
const LOOK_RATE = radians(110); // a second, at the stick's end
const STEP = 10; // percent of the speed limit

/**
 * Events: "drive" (the shoulder button was pressed), "stop", "centre", "scale" (detail: percent to add),
 * "tell" (detail: words). Nothing is driven unless the window has the focus and the button was pressed since.
 */
export class Gamepads extends EventTarget {
  constructor(drive, look) {
    super();
    this.drive = drive;
    this.look = look;
    this._index = null; // of the pad that is used
    this._held = new Set();
    this._driving = false;
    this._last = performance.now();
    window.addEventListener("gamepadconnected", ({ gamepad }) => this._connect(gamepad));
    window.addEventListener("gamepaddisconnected", ({ gamepad }) => {
      if (gamepad.index === this._index) this._lose();
    });
    // What stopped the drive stops the pad too: the button must be let go and pressed anew.
    drive.addEventListener("stop", () => { this._driving = false; });
    setInterval(() => this._poll(), POLL_MS);
  }

  _connect(pad) {
    if (pad.mapping !== "standard") {
      this._tell(`${pad.id}: the browser does not know this gamepad's layout, so it does not drive`);
      return;
    }
    if (this._index !== null) return;
    this._index = pad.index;
    this._held = pressed(pad); // what is held already was not pressed for us
    this._state("ready");
    this._tell("Gamepad: hold a shoulder button and drive by the left stick");
  }

  _lose() {
    this._index = null;
    this._driving = false;
    this._state("none");
    this.drive.stop("the gamepad was disconnected");
  }

  _poll() {
    const now = performance.now(), seconds = Math.min((now - this._last) / 1000, 0.1);
    this._last = now;
    if (this._index === null) return;
    const pad = navigator.getGamepads()[this._index];
    if (!pad?.connected) return this._lose();
    const held = pressed(pad), fresh = [...held].filter((button) => !this._held.has(button));
    this._held = held;
    const focused = document.hasFocus() && !document.hidden;
    if (fresh.includes(STOP)) this._say("stop"); // also without the focus
    if (!focused) return this._letGo();
    if (!this.drive.enabled) this._letGo(); // not the driver, or an emergency stop
    if (fresh.includes(CENTRE)) this._say("centre");
    if (fresh.includes(FASTER)) this._say("scale", STEP);
    if (fresh.includes(SLOWER)) this._say("scale", -STEP);
    const [yaw, pitch] = [deadZone(-pad.axes[2]), deadZone(-pad.axes[3])];
    if (yaw || pitch) this.look.turn(yaw * LOOK_RATE * seconds, pitch * LOOK_RATE * seconds);
    if (fresh.some((button) => SHOULDERS.includes(button))) {
      this._driving = true;
      this._say("drive");
    }
    if (!SHOULDERS.some((button) => held.has(button))) this._letGo();
    if (this._driving) this.drive.setStick(deadZone(-pad.axes[1]), deadZone(-pad.axes[0]));
    this._state(this._driving ? "driving" : "ready");
  }

  _letGo() {
    if (!this._driving) return;
    this._driving = false;
    this.drive.setStick(0, 0);
    this._state("ready");
  }

  _state(state) {
    document.body.dataset.pad = state;
  }

  _say(kind, detail) {
    this.dispatchEvent(new CustomEvent(kind, { detail }));
  }

  _tell(words) {
    this._say("tell", words);
  }
}

function pressed(pad) {
  return new Set(pad.buttons.flatMap((button, index) => (button.pressed ? [index] : [])));
}
