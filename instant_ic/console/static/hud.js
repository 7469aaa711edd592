// The overlay: mode, link, faults, gauges, banner. Text only, never HTML from the robot.

import { degrees } from "./math.js";
import { PANORAMA, VIEW } from "./link.js";

const MODES = {
  real: ["REAL", "The robot obeys the operator"],
  virtual: ["VIRTUAL", "The robot follows you round the obstacle"],
  entering: ["ENTERING", "Switching to the virtual space"],
  returning: ["RETURNING", "Switching back to the camera"],
  stopped: ["STOPPED", "The robot stands still"],
  none: ["WAITING", "No controller is running"],
};
// Announced by screen readers; transitional modes are not.
const SAID = {
  real: "Real view: you see through the robot's camera",
  virtual: "Virtual view: you drive the virtual robot, and the robot follows",
  stopped: "Stopped: the robot stands still",
};
const ANNOUNCE_MS = 400;
// Node names for the operator's list of faults.
const NODES = {
  theta_camera: "Camera", vlp16_driver: "LiDAR", crawler_base: "Base", grid_slam: "Map and pose", arbiter: "Control",
  virtual_robot: "Virtual robot", navigator: "Path planner", depth_estimator: "Depth", depth_scaler: "Depth",
  nerf: "Virtual space", console: "Console", operator_recorder: "Recorder", host_bridge: "Link to the robot",
  network: "Network",
};
const HOLD_MS = 800;
const TOAST_MS = 2600;
const byId = (id) => document.getElementById(id);

function write(element, text) {
  // Setting the same text again would make screen readers repeat it.
  if (element.textContent !== text) element.textContent = text;
}

export function showMode(state, driver) {
  const mode = state?.mode ?? "none";
  let [name, usual] = MODES[mode] ?? MODES.none;
  if (mode === "real" && driver === "you") usual = "You drive the robot";
  if (mode !== document.body.dataset.mode && mode in SAID) announce(SAID[mode]);
  document.body.dataset.mode = mode;
  write(byId("mode-name"), name);
  write(byId("mode-reason"), sentence(state?.reason) || usual);
}

export function showLatency(link, pictures) {
  const put = (id, value, text, warn, bad) => {
    const element = byId(id);
    write(element, value === null ? "–" : text(value));
    element.className = value === null ? "" : value > bad ? "bad" : value > warn ? "warn" : "";
  };
  const ms = (value) => (value < 9950 ? `${Math.round(value)} ms` : `${(value / 1000).toFixed(0)} s`);
  put("link-ms", link.connected ? link.roundTripMs : null, (value) => ms(value) + (link.quality ? ` · ${link.quality}` : ""), 80, 200);
  mark("linkQuality", link.quality ?? "none");
  put("picture-ms", link.connected ? pictures.ageMs() : null, ms, 400, 1000);
  const withRate = (value) => ms(value) + (link.commandHz ? ` · ${Math.round(link.commandHz)} /s` : "");
  put("command-ms", link.connected ? link.commandAgeMs : null, withRate, 80, 200);
  const camera = pictures.rate(PANORAMA), view = pictures.rate(VIEW);
  write(byId("rates"), camera || view ? `${camera.toFixed(0)} · ${view.toFixed(0)} /s` : "–");
}

export function showHealth(health) {
  const { vspace, battery, faults = [] } = health;
  byId("vspace-dot").dataset.state = vspace?.state ?? "empty";
  write(byId("vspace-text"), vspaceText(vspace));
  write(byId("vspace-more"), vspace ? readiness(vspace) : "");
  byId("battery-row").hidden = !battery;
  if (battery) {
    const share = battery.percent === null ? "" : ` · ${Math.round(battery.percent)} %`;
    write(byId("battery"), `${battery.voltage.toFixed(1)} V${share}`);
  }
  const list = byId("faults");
  const key = JSON.stringify(faults);
  if (list.dataset.key === key) return;
  list.dataset.key = key;
  list.replaceChildren(...faults.map(({ level, name, text }) => {
    const item = document.createElement("li");
    item.className = level;
    item.title = `${name}: ${text}`; // full text, with the node's name for `ic log`
    const bold = document.createElement("b");
    bold.textContent = NODES[name] ?? name;
    item.append(bold, ` ${text}`);
    return item;
  }));
}

/** Quality of the virtual space: PSNR of the training or of the requested view, share of it that was seen, valid range. */
function readiness({ psnr_db, expected_psnr_db, unseen_share, radius_m }) {
  const words = [];
  if (expected_psnr_db > 0) words.push(`${expected_psnr_db.toFixed(0)} dB here`, `${Math.round(100 * (1 - unseen_share))} % seen`);
  else if (psnr_db > 0) words.push(`${psnr_db.toFixed(1)} dB`);
  if (radius_m > 0) words.push(`within ${radius_m.toFixed(1)} m`);
  return words.map((word) => ` · ${word}`).join("");
}

function vspaceText(vspace) {
  if (!vspace) return "No virtual space yet";
  switch (vspace.state) {
    case "ready": return "Virtual space ready";
    case "training": return `Virtual space training, ${vspace.train_seconds.toFixed(0)} s`;
    case "failed": return `Virtual space failed: ${vspace.message}`;
    default: return vspace.message || "No virtual space yet";
  }
}

export function showCommand(drive) {
  const [linear, angular] = drive.command;
  bar(byId("speed-bar"), linear / (drive.limits.linear || 1));
  bar(byId("turn-bar"), -angular / (drive.limits.angular || 1));
  write(byId("speed"), `${linear.toFixed(2)} m/s`);
  write(byId("turn"), `${Math.round(degrees(Math.abs(angular)))} °/s${angular ? (angular > 0 ? " L" : " R") : ""}`);
}

function bar(element, share) {
  const left = `${50 + Math.min(share, 0) * 50}%`, width = `${Math.abs(share) * 50}%`;
  if (element.style.left === left && element.style.width === width) return;
  element.style.left = left;
  element.style.width = width;
}

export function showSession(session) {
  document.body.dataset.driver = session.driver;
  const watchers = session.clients - 1;
  const text = {
    you: watchers > 0 ? `You are driving · ${watchers} watching` : "You are driving",
    other: "Another operator is driving",
    none: "Nobody is driving",
  }[session.driver];
  write(byId("lease-text"), text);
  write(byId("take"), session.driver === "none" ? "Drive" : "Take over");
  byId("take").hidden = session.driver === "you";
  byId("yield").hidden = session.driver !== "you" || watchers === 0;
}

const sentence = (words) => (words ? words[0].toUpperCase() + words.slice(1) : "");

/** One banner at a time, by priority: lost link, emergency stop, key held through a stop. */
export function showBanner(connected, everConnected, estop, held, driver, reason) {
  document.body.dataset.link = connected ? "up" : everConnected ? "lost" : "connecting";
  document.body.dataset.estop = estop ? "set" : "free";
  const banner = byId("banner");
  const lost = !connected && everConnected;
  banner.hidden = !lost && !estop && !held;
  if (banner.hidden) return;
  write(byId("banner-title"), lost ? "LINK LOST" : estop ? "EMERGENCY STOP" : "STOPPED");
  write(byId("banner-text"), lost
    ? "The server stops the robot. Reconnecting…"
    : !estop ? "Release the controls to continue."
    : reason ? sentence(reason) // says what holds the robot and what to do
    : driver === "you" ? "Release the emergency stop to continue." : "Only the driver can release the emergency stop.");
  byId("release").hidden = lost || !estop || driver !== "you";
}

/** Sets a data attribute of the page, for styles and tests, if it has changed. */
export function mark(name, value) {
  if (document.body.dataset[name] !== value) document.body.dataset[name] = value;
}

let announceTimer = null;
/** Announces a text to screen readers after ANNOUNCE_MS, unless another one replaces it: short changes stay silent. */
export function announce(text) {
  clearTimeout(announceTimer);
  announceTimer = setTimeout(() => write(byId("announce"), text), ANNOUNCE_MS);
}

let toastTimer = null;
export function toast(text) {
  const element = byId("toast");
  write(element, text);
  element.classList.add("shown");
  clearTimeout(toastTimer);
  toastTimer = setTimeout(() => element.classList.remove("shown"), TOAST_MS);
}

/** Calls `done` when `button` was held by pointer or Enter for 0.8 s. */
export function holdToConfirm(button, done) {
  let timer = null;
  const start = () => {
    if (timer !== null) return;
    button.classList.add("holding");
    timer = setTimeout(() => {
      cancel();
      done();
    }, HOLD_MS);
  };
  const cancel = () => {
    clearTimeout(timer);
    timer = null;
    button.classList.remove("holding");
  };
  button.addEventListener("pointerdown", start);
  for (const end of ["pointerup", "pointerleave", "pointercancel", "blur", "keyup"]) button.addEventListener(end, cancel);
  button.addEventListener("keydown", (event) => {
    if (event.code === "Enter") start();
  });
}
