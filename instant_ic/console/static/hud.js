// @ts-check
// The overlay: mode, link, faults, gauges, banner. Texts of the robot are never used as HTML.

/** @import { Drive } from "./drive.js" */
/** @import { Images } from "./images.js" */
/** @import { Lease } from "./lease.js" */
/** @import { Link } from "./link.js" */
/** @import { Health, State } from "./messages.js" */
import { byId, mark, write } from "./dom.js";
import { degrees } from "./math.js";
import { PANORAMA, VIEW } from "./messages.js";
import * as texts from "./texts.js";

const ANNOUNCE_MS = 400;
const HOLD_MS = 800;
const TOAST_MS = 2600;

/** @param {State | null} state @param {Lease["driver"]} driver */
export function showMode(state, driver) {
  const mode = state?.mode ?? "none", { name, reason } = texts.modeText(state, driver), said = texts.ANNOUNCED[mode];
  if (mode !== document.body.dataset.mode && said) announce(said);
  mark("mode", mode);
  write(byId("mode-name"), name);
  write(byId("mode-reason"), reason);
}

/** @param {Link} link @param {Images} images */
export function showLatency(link, images) {
  /** @param {string} id @param {number | null} value @param {(value: number) => string} text @param {number} warn @param {number} bad */
  const put = (id, value, text, warn, bad) => {
    const element = byId(id), shown = link.connected ? value : null;
    write(element, shown === null ? "–" : text(shown));
    element.className = shown === null ? "" : shown > bad ? "bad" : shown > warn ? "warn" : "";
  };
  const ms = texts.millisecondsText, { clock } = link;
  put("link-ms", clock.roundTripMs, (value) => ms(value) + (clock.quality ? ` · ${clock.quality}` : ""), 80, 200);
  put("image-ms", images.ageMs(), ms, 400, 1000);
  put("camera-ms", images.blend < 1 ? images.cameraMs : null, ms, 400, 1000);
  const rate = link.commandHz ? ` · ${Math.round(link.commandHz)} /s` : "";
  put("command-ms", link.commandAgeMs, (value) => ms(value) + rate, 80, 200);
  const camera = images.rate(PANORAMA), view = images.rate(VIEW);
  write(byId("rates"), link.connected && (camera || view) ? `${camera.toFixed(0)} · ${view.toFixed(0)} /s` : "–");
}

/** @param {Health} health */
export function showHealth({ vspace, battery, faults, nodes, pace }) {
  byId("vspace-dot").dataset.state = vspace?.state ?? "empty";
  write(byId("vspace-text"), texts.vspaceText(vspace));
  write(byId("vspace-more"), texts.vspaceQuality(vspace));
  byId("pace").hidden = !pace;
  write(byId("pace"), pace ?? "");
  byId("battery-row").hidden = !battery;
  if (battery) {
    const share = battery.percent === null ? "" : ` · ${Math.round(battery.percent)} %`;
    write(byId("battery"), `${battery.voltage.toFixed(1)} V${share}`);
  }
  const total = nodes.reduce((sum, node) => sum + node.cpu_percent, 0);
  write(byId("cpu"), nodes.length ? `${Math.round(total)} %` : "–");
  replaceItems(byId("cpu-list"), nodes, ({ name, cpu_percent }) =>
    Object.assign(document.createElement("li"), { textContent: `${name}: ${Math.round(cpu_percent)} %` }));
  replaceItems(byId("faults"), faults, ({ level, name, text }) => {
    const item = document.createElement("li"), bold = document.createElement("b");
    item.className = level;
    item.title = `${name}: ${text}`; // full text, with the node's name for `ic log`
    bold.textContent = texts.nodeText(name);
    item.append(bold, ` ${text}`);
    return item;
  });
}

/**
 * Fills a list if its entries have changed.
 * @template T
 * @param {HTMLElement} element @param {T[]} entries @param {(entry: T) => HTMLElement} item
 */
function replaceItems(element, entries, item) {
  const key = JSON.stringify(entries);
  if (element.dataset.key === key) return;
  element.dataset.key = key;
  element.replaceChildren(...entries.map(item));
}

/** @param {Drive} drive */
export function showCommand(drive) {
  const [linear, angular] = drive.command;
  bar(byId("speed-bar"), linear / (drive.limits.linear || 1));
  bar(byId("turn-bar"), -angular / (drive.limits.angular || 1));
  write(byId("speed"), `${linear.toFixed(2)} m/s`);
  write(byId("turn"), `${Math.round(degrees(Math.abs(angular)))} °/s${angular ? (angular > 0 ? " L" : " R") : ""}`);
}

/** @param {HTMLElement} element @param {number} share */
function bar(element, share) {
  const left = `${50 + Math.min(share, 0) * 50}%`, width = `${Math.abs(share) * 50}%`;
  if (element.style.left === left && element.style.width === width) return;
  element.style.left = left;
  element.style.width = width;
}

/** @param {Lease} lease */
export function showLease({ driver, clients, door }) {
  mark("driver", driver);
  write(byId("lease-text"), texts.leaseText(driver, clients - 1, door));
  write(byId("take"), driver === "none" ? "Drive" : "Take over");
  byId("take").hidden = driver === "you" || door !== "";
  byId("yield").hidden = driver !== "you" || clients < 2;
}

/** @param {Link} link @param {Lease} lease @param {State | null} state */
export function showBanner(link, lease, state) {
  const lost = !link.connected && link.everConnected, estop = lease.estop || (state?.estop ?? false);
  // A stopped robot starts only after the controls have been released, so remind an operator who still holds a key.
  const held = state?.mode === "stopped" && (state.command ?? []).some((value) => value !== 0);
  mark("link", link.connected ? "up" : lost ? "lost" : "connecting");
  mark("estop", estop ? "set" : "free");
  const shown = texts.bannerText({ lost, estop, held, driver: lease.driver, reason: state?.reason ?? "" });
  byId("banner").hidden = shown === null;
  if (!shown) return;
  write(byId("banner-title"), shown.title);
  write(byId("banner-text"), shown.text);
  byId("release").hidden = !shown.release;
}

/** @type {Map<string, number>} */
const announceTimers = new Map();
/**
 * Announces a text to screen readers after ANNOUNCE_MS unless another one replaces it, so that short changes stay silent.
 * @param {string} text @param {string} id element of the subject, because a text replaces only one of the same subject
 */
export function announce(text, id = "announce") {
  clearTimeout(announceTimers.get(id));
  announceTimers.set(id, setTimeout(() => write(byId(id), text), ANNOUNCE_MS));
}

let toastTimer = 0;
/** @param {string} text */
export function toast(text) {
  const element = byId("toast");
  write(element, text);
  element.classList.add("shown");
  clearTimeout(toastTimer);
  toastTimer = setTimeout(() => element.classList.remove("shown"), TOAST_MS);
}

/** Calls `done` after `button` was held by pointer or Enter for 0.8 s. @param {HTMLElement} button @param {() => void} done */
export function holdToConfirm(button, done) {
  let timer = 0;
  const start = () => {
    if (timer) return;
    button.classList.add("holding");
    timer = setTimeout(() => {
      cancel();
      done();
    }, HOLD_MS);
  };
  const cancel = () => {
    clearTimeout(timer);
    timer = 0;
    button.classList.remove("holding");
  };
  button.addEventListener("pointerdown", start);
  for (const end of ["pointerup", "pointerleave", "pointercancel", "blur", "keyup"]) button.addEventListener(end, cancel);
  button.addEventListener("keydown", (event) => {
    if (event.code === "Enter") start();
  });
}
