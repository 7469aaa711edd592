// @ts-check
// Texts of the overlay, chosen by codes: modes, node names and states. No logic depends on the robot's texts.

/** @import { RecordingStatus, Session, State, Vspace } from "./messages.js" */

/** @typedef {State["mode"]} Mode */

/** @type {Record<Mode, [string, string]>} Name of a mode, and its usual reason. */
const MODES = {
  real: ["REAL", "The robot obeys the operator"],
  virtual: ["VIRTUAL", "The robot follows you around the obstacle"],
  entering: ["ENTERING", "Switching to the virtual space"],
  returning: ["RETURNING", "Switching back to the camera"],
  stopped: ["STOPPED", "The robot stands still"],
  none: ["WAITING", "No controller is running"],
};

/** @type {Partial<Record<Mode, string>>} Announcements of modes by screen readers; transitional modes are not announced. */
export const ANNOUNCED = {
  real: "Real view: you see through the robot's camera",
  virtual: "Virtual view: you drive the virtual robot, and the robot follows",
  stopped: "Stopped: the robot stands still",
};

/** @type {Record<string, string>} Node names for the operator's list of faults. */
const NODES = {
  theta_camera: "Camera", vlp16_driver: "LiDAR", crawler_base: "Base", grid_slam: "Map and pose", arbiter: "Control",
  virtual_robot: "Virtual robot", navigator: "Path planner", depth_estimator: "Depth", depth_scaler: "Depth",
  nerf: "Virtual space", console: "Console", operator_recorder: "Recorder", host_bridge: "Link to the robot",
  network: "Network", simulator: "Simulator",
};

/** @param {string} node */
export const nodeText = (node) => (Object.hasOwn(NODES, node) ? NODES[node] : node);

/** @param {string | null | undefined} text */
const sentence = (text) => (text ? text[0].toUpperCase() + text.slice(1) : "");

/** @param {State | null} state @param {Session["driver"]} driver @returns {{name: string, reason: string}} */
export function modeText(state, driver) {
  const mode = state?.mode ?? "none", [name, usual] = MODES[mode];
  return { name, reason: sentence(state?.reason) || (mode === "real" && driver === "you" ? "You drive the robot" : usual) };
}

/** @param {Session["driver"]} driver @param {number} watchers @param {string} door connection of another operator who drives */
export function leaseText(driver, watchers, door = "") {
  return {
    you: watchers > 0 ? `You are driving · ${watchers} watching` : "You are driving",
    other: door ? `Another operator is driving through ${door}` : "Another operator is driving",
    none: "Nobody is driving",
  }[driver];
}

/** @param {Vspace | null} vspace */
export function vspaceText(vspace) {
  switch (vspace?.state) {
    case "ready": return "Virtual space ready";
    case "training": return `Virtual space training, ${vspace.train_seconds.toFixed(0)} s`;
    case "failed": return `Virtual space failed: ${vspace.message}`;
    default: return sentence(vspace?.message) || "No virtual space yet";
  }
}

/**
 * Returns the quality of the virtual space: PSNR of the training or of the requested view, share seen, valid range.
 * @param {Vspace | null} vspace
 */
export function vspaceQuality(vspace) {
  if (!vspace) return "";
  const { psnr_db, expected_psnr_db, unseen_share, radius_m } = vspace, parts = [];
  if (expected_psnr_db > 0) parts.push(`${expected_psnr_db.toFixed(0)} dB here`, `${Math.round(100 * (1 - unseen_share))} % seen`);
  else if (psnr_db > 0) parts.push(`${psnr_db.toFixed(1)} dB`);
  if (radius_m > 0) parts.push(`within ${radius_m.toFixed(1)}\u00a0m`);
  return parts.map((part) => ` · ${part}`).join("");
}

/**
 * Returns the banner, in order of priority for a lost link, an emergency stop, and a control held while the robot is stopped
 * (`held`); null for none of them.
 * @param {{lost: boolean, estop: boolean, held: boolean, driver: Session["driver"], reason: string}} situation
 */
export function bannerText({ lost, estop, held, driver, reason }) {
  if (lost) return { title: "LINK LOST", text: "The server stops the robot. Reconnecting…", release: false };
  if (estop) {
    const release = driver === "you";
    const usual = release ? "Release the emergency stop to continue." : "Only the driver can release the emergency stop.";
    return { title: "EMERGENCY STOP", text: sentence(reason) || usual, release }; // the reason says what keeps the robot stopped
  }
  return held ? { title: "STOPPED", text: "Release the controls to continue.", release: false } : null;
}

/** @type {Record<string, string>} Button text in states of the recorder other than recording. */
const RECORDER = { ending: "Saving…", "disk full": "Disk full", failed: "Failed" };

/** Returns the text of the record button. @param {RecordingStatus} status */
export const recordText = (status) =>
  status.state === "recording" ? `${clockText(status.seconds)} · ${bytesText(status.bytes ?? 0)}` : recorderText(status.state) || "Record";

/** @param {string} state */
export const recorderText = (state) => (Object.hasOwn(RECORDER, state) ? RECORDER[state] : "");

/** Returns minutes and seconds as text. @param {number | null} seconds */
export function clockText(seconds) {
  const whole = Math.floor(seconds ?? 0);
  return `${Math.floor(whole / 60)}:${String(whole % 60).padStart(2, "0")}`;
}

/** @param {number} bytes */
export function bytesText(bytes) {
  return bytes < 1e9 ? `${Math.round(bytes / 1e6)} MB` : `${(bytes / 1e9).toFixed(1)} GB`;
}

/** @param {number} value */
export const millisecondsText = (value) => (value < 9950 ? `${Math.round(value)} ms` : `${(value / 1000).toFixed(0)} s`);
