// @ts-check
// Rotations as 3x3 row-major arrays, x forward, y left, z up; angles counter-clockwise, radians.

/** @typedef {[number, number, number]} Vec3 */
/** @typedef {number[]} Mat3 Nine numbers. */

export const identity = [1, 0, 0, 0, 1, 0, 0, 0, 1];

/** @param {number} angle @returns {Mat3} */
export function rotationZ(angle) {
  const c = Math.cos(angle), s = Math.sin(angle);
  return [c, -s, 0, s, c, 0, 0, 0, 1];
}

/** Returns the rotation of the line of sight to the left by `yaw` and up by `pitch`. @param {number} yaw @param {number} pitch */
export function lookRotation(yaw, pitch) {
  const c = Math.cos(pitch), s = Math.sin(pitch);
  return multiply(rotationZ(yaw), [c, 0, -s, 0, 1, 0, s, 0, c]);
}

/** @param {Mat3} a @param {Mat3} b @returns {Mat3} */
export function multiply(a, b) {
  const m = new Array(9);
  for (let i = 0; i < 3; i++)
    for (let j = 0; j < 3; j++)
      m[3 * i + j] = a[3 * i] * b[j] + a[3 * i + 1] * b[3 + j] + a[3 * i + 2] * b[6 + j];
  return m;
}

/** @param {Mat3} m @returns {Mat3} */
export function transpose(m) {
  return [m[0], m[3], m[6], m[1], m[4], m[7], m[2], m[5], m[8]];
}

/** @param {Mat3} m @param {Vec3} v @returns {Vec3} */
export function rotate(m, v) {
  return [
    m[0] * v[0] + m[1] * v[1] + m[2] * v[2],
    m[3] * v[0] + m[4] * v[1] + m[5] * v[2],
    m[6] * v[0] + m[7] * v[1] + m[8] * v[2],
  ];
}

/**
 * Returns the position in the map of a place on a robot.
 * @param {Vec3} pose x, y, yaw @param {readonly number[]} place x and y on the robot @returns {[number, number]}
 */
export function mounted([x, y, yaw], [ahead, left]) {
  const c = Math.cos(yaw), s = Math.sin(yaw);
  return [x + c * ahead - s * left, y + s * ahead + c * left];
}

/** @param {Vec3} a @param {Vec3} b @returns {Vec3} */
export const times = (a, b) => [a[0] * b[0], a[1] * b[1], a[2] * b[2]];

/** Returns the rotation matrix of a quaternion. @param {[number, number, number, number]} q x, y, z, w @returns {Mat3} */
export function fromQuaternion([x, y, z, w]) {
  return [
    1 - 2 * (y * y + z * z), 2 * (x * y - z * w), 2 * (x * z + y * w),
    2 * (x * y + z * w), 1 - 2 * (x * x + z * z), 2 * (y * z - x * w),
    2 * (x * z - y * w), 2 * (y * z + x * w), 1 - 2 * (x * x + y * y),
  ];
}

/** Returns the angle wrapped to [-π, π]. @param {number} angle */
export function wrapAngle(angle) {
  return angle - 2 * Math.PI * Math.round(angle / (2 * Math.PI));
}

/** @param {number} value @param {number} low @param {number} high */
export function clamp(value, low, high) {
  return Math.min(Math.max(value, low), high);
}

/** @param {number} radians */
export const degrees = (radians) => (radians * 180) / Math.PI;
/** @param {number} angle degrees */
export const radians = (angle) => (angle * Math.PI) / 180;
