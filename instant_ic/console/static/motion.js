// @ts-check
// Pose of the shown robot at render time, interpolated and extrapolated from the state messages.

/** @import { Vec3 } from "./math.js" */
import { clamp, wrapAngle } from "./math.js";

const EXTRAPOLATION_MS = 200;
export const SMOOTHING_MS = 50;
const SNAP_RAD = 0.6, SNAP_M = 0.5; // larger jumps are not smoothed
const EASED_RAD = 0.2, EASED_M = 0.3; // larger offsets between the two robots are not eased out

export class Motion {
  constructor() {
    /** @type {Vec3 | null} x, y, yaw in the map frame; null: unknown. */
    this.pose = null;
    this.easeMs = 0;
    /** @type {Vec3 | null} Pose of the shown robot, without the offset that is still eased out. */
    this.own = null;
    /** @type {Vec3} Offset of the robot shown before, at the switch; it is eased out. */
    this._residual = [0, 0, 0];
    this._easedMs = 0;
    this._robot = "";
  }

  get yaw() {
    return this.pose?.[2] ?? null;
  }

  /**
   * Advances by `elapsedMs`. When the shown robot changes, the difference between the two poses is eased out.
   * @param {string} robot name of the shown robot @param {Vec3 | null | undefined} pose @param {[number, number]} twist m/s, rad/s
   * @param {number} ageMs of pose and twist @param {number} elapsedMs
   */
  follow(robot, pose, twist, ageMs, elapsedMs) {
    if (!pose) return;
    const target = advanced(pose, twist, clamp(ageMs, 0, EXTRAPOLATION_MS) / 1000);
    if (robot !== this._robot && this._robot && this.pose !== null) {
      const apart = difference(this.pose, target);
      this._residual = size(apart) < EASED_M && Math.abs(apart[2]) < EASED_RAD ? apart : [0, 0, 0];
      this._easedMs = 0;
      this.own = target;
    }
    this._robot = robot;
    // The pose moves on at the velocity, and only the error is smoothed, so that steady motion is shown without lag.
    const went = this.own && advanced(this.own, twist, ageMs < EXTRAPOLATION_MS ? elapsedMs / 1000 : 0);
    const left = went ? difference(target, went) : null;
    if (!went || !left || size(left) > SNAP_M || Math.abs(left[2]) > SNAP_RAD) this.own = target;
    else this.own = sum(went, left, 1 - Math.exp(-elapsedMs / SMOOTHING_MS));
    this._easedMs += elapsedMs; // summed over frames, so that after a short hang the easing continues where it was
    const t = this.easeMs > 0 ? clamp(this._easedMs / this.easeMs, 0, 1) : 1;
    this.pose = sum(this.own, this._residual, 1 - t * t * (3 - 2 * t));
  }
}

/** @param {Vec3} pose */
const size = ([x, y]) => Math.hypot(x, y);
/** @param {Vec3} a @param {Vec3} b @returns {Vec3} */
const difference = (a, b) => [a[0] - b[0], a[1] - b[1], wrapAngle(a[2] - b[2])];
/** @param {Vec3} a @param {Vec3} b @param {number} share @returns {Vec3} */
const sum = (a, b, share) => [a[0] + share * b[0], a[1] + share * b[1], wrapAngle(a[2] + share * b[2])];

/** @param {Vec3} pose @param {[number, number]} twist @param {number} seconds @returns {Vec3} */
export function advanced([x, y, yaw], [v, w], seconds) {
  const middle = yaw + (w * seconds) / 2;
  return [x + v * seconds * Math.cos(middle), y + v * seconds * Math.sin(middle), wrapAngle(yaw + w * seconds)];
}
