// Where the shown robot is at the moment of drawing, between and beyond the state messages.

import { clamp, wrapAngle } from "./math.js";

const EXTRAPOLATION_MS = 200;
export const SMOOTHING_MS = 50;
const SNAP_RAD = 0.6, SNAP_M = 0.5; // a larger jump is a new pose, not a motion
const EASED_RAD = 0.2, EASED_M = 0.3; // likewise from one robot to the other

export class Motion {
  constructor() {
    this.pose = null; // [x, y, yaw] in the map; null: not known
    this.easeMs = 400;
    this._followed = null;
    this._residual = [0, 0, 0]; // what the other robot's pose had more, and is still left of it
    this._easedMs = 0;
    this._robot = null;
  }

  get yaw() {
    return this.pose?.[2] ?? null;
  }

  /** The shown robot's own pose, without what is left of the other's. */
  get own() {
    return this._followed;
  }

  /**
   * Goes on by `elapsedMs`. `robot`: name of the robot that is shown; at another name the difference of the two poses
   * is eased out. `pose` was true `ageMs` ago, `twist` [m/s, rad/s] its velocity then.
   */
  follow(robot, pose, twist, ageMs, elapsedMs) {
    if (!pose) return;
    const target = moved(pose, twist, clamp(ageMs, 0, EXTRAPOLATION_MS) / 1000);
    if (robot !== this._robot && this._robot !== null && this.pose !== null) {
      const apart = difference(this.pose, target);
      this._residual = size(apart) < EASED_M && Math.abs(apart[2]) < EASED_RAD ? apart : [0, 0, 0];
      this._easedMs = 0;
      this._followed = target;
    }
    this._robot = robot;
    // It goes on at its velocity, and only what that misses is smoothed: so a steady motion is shown without a lag.
    const went = this._followed && moved(this._followed, twist, ageMs < EXTRAPOLATION_MS ? elapsedMs / 1000 : 0);
    const left = went ? difference(target, went) : null;
    if (left === null || size(left) > SNAP_M || Math.abs(left[2]) > SNAP_RAD) this._followed = target;
    else this._followed = sum(went, left, 1 - Math.exp(-elapsedMs / SMOOTHING_MS));
    this._easedMs += elapsedMs; // not the time itself: a page that hangs for a moment goes on from where it was
    const t = this.easeMs > 0 ? clamp(this._easedMs / this.easeMs, 0, 1) : 1;
    this.pose = sum(this._followed, this._residual, 1 - t * t * (3 - 2 * t));
  }
}

const size = ([x, y]) => Math.hypot(x, y);
const difference = (a, b) => [a[0] - b[0], a[1] - b[1], wrapAngle(a[2] - b[2])];
const sum = (a, b, share) => [a[0] + share * b[0], a[1] + share * b[1], wrapAngle(a[2] + share * b[2])];

function moved([x, y, yaw], [v, w], seconds) {
  const middle = yaw + (w * seconds) / 2;
  return [x + v * seconds * Math.cos(middle), y + v * seconds * Math.sin(middle), wrapAngle(yaw + w * seconds)];
}
