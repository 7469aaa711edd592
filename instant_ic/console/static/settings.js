// @ts-check
// Settings of the page: the server's values of the "hello" message over the defaults.

/** @import { Hello } from "./messages.js" */

export const DEFAULTS = {
  mayDrive: true, // false: signed in to watch
  limits: { linear: 0, angular: 0 }, // m/s, rad/s
  /** @type {[number, number]} */
  footprint: [0.6, 0.5], // length, width, m
  /** @type {[number, number, number]} */
  camera: [0, 0, 1.2], // position on the robot, m
  dissolveMs: 250,
  easeMs: 400,
  colourReleaseMs: 6000,
  /** @type {[number, number]} */
  maxAccel: [0.8, 2], // m/s², rad/s²
};

/** @typedef {typeof DEFAULTS} Settings */

/** @param {Hello} hello @param {boolean} reducedMotion the operator's system asks for little motion @returns {Settings} */
export function settingsOf(hello, reducedMotion) {
  const { page } = hello;
  return {
    mayDrive: hello.may_drive,
    limits: { linear: hello.max_linear, angular: hello.max_angular },
    footprint: page.footprint ?? DEFAULTS.footprint,
    camera: page.camera ?? DEFAULTS.camera,
    dissolveMs: reducedMotion ? 0 : page.dissolve_ms ?? DEFAULTS.dissolveMs,
    easeMs: reducedMotion ? 0 : page.ease_ms ?? DEFAULTS.easeMs,
    colourReleaseMs: page.colour_release_s === null ? DEFAULTS.colourReleaseMs : 1000 * page.colour_release_s,
    maxAccel: page.max_accel ?? DEFAULTS.maxAccel,
  };
}
