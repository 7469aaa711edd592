// @ts-check
// The operator's page: connects link, lease, drive, images and overlay.

/** @import { Frame, GridFrame, Message, State } from "./messages.js" */
import { all, byId, elementOf, mark } from "./dom.js";
import { attachStick, Drive, isDriveKey } from "./drive.js";
import { Gamepads } from "./gamepad.js";
import * as hud from "./hud.js";
import { Images } from "./images.js";
import { Lease } from "./lease.js";
import { Link, onDetail } from "./link.js";
import { Look } from "./look.js";
import { LAYERS, MAP, PANORAMA, VIEW } from "./messages.js";
import { Recording } from "./record.js";
import { Screen } from "./screen.js";
import { GlViewer } from "./viewer.js";

const canvas = elementOf("view", HTMLCanvasElement), scale = elementOf("scale", HTMLInputElement);
const helpDialog = elementOf("help", HTMLDialogElement);
const link = new Link(`${location.protocol === "https:" ? "wss" : "ws"}://${location.host}/ws`);
const lease = new Lease(link);
const drive = new Drive(link);
/** @type {State | null} The newest state message. */
let state = null;
// Emergency stop and banner come first, because they work without an image too.
attachStop();
for (const name of ["open", "lost"]) link.addEventListener(name, showBanner);
lease.addEventListener("change", showBanner);
link.addEventListener("signed-out", () => location.reload()); // shows the sign-in form
onDetail(link, "message", (/** @type {Message} */ message) => {
  if (message.type === "session") lease.take(message);
});
const viewer = makeViewer();
const look = new Look(canvas);
const images = new Images(viewer, link);
const screen = new Screen(viewer, images, look, link, lease);
const recording = new Recording(link);
const wake = () => screen.wake();
// A page whose view is lost (crash or update of the graphics driver) must not drive. Reloaded, it has a view or only stops.
canvas.addEventListener("webglcontextlost", () => {
  lease.mayDrive = false;
  lease.handOver();
  location.reload();
});

/** Returns the viewer. Without WebGL 2 it throws, and the page can only stop the robot. */
function makeViewer() {
  try {
    return new GlViewer(canvas, new URLSearchParams(location.search).get("quality") === "full");
  } catch (error) {
    onlyStop();
    throw error;
  }
}

/** Leaves only advice and the emergency stop on the page, because a page without a view must not drive. */
function onlyStop() {
  const text = byId("no-view");
  byId("stick").remove();
  document.body.replaceChildren(text, byId("right-bottom"), byId("banner"), byId("toast"));
  text.hidden = false;
  lease.mayDrive = false;
}

function showBanner() {
  hud.showBanner(link, lease, state);
}

// ---- from the server -----------------------------------------------------------------------------

link.addEventListener("lost", () => drive.setEnabled(false)); // the banner says what happened
lease.addEventListener("change", () => {
  drive.setEnabled(lease.drives);
  hud.showLease(lease);
});
onDetail(link, "message", (/** @type {Message} */ message) => {
  switch (message.type) {
    case "hello":
      lease.mayDrive = recording.mayRecord = message.may_drive;
      mark("mayDrive", String(message.may_drive));
      drive.limits = { linear: message.max_linear, angular: message.max_angular };
      screen.settings = message.page;
      images.configure(message.page, matchMedia("(prefers-reduced-motion: reduce)").matches);
      images.expectLayers();
      break;
    case "state":
      state = message;
      screen.take(message);
      hud.showMode(message, lease.driver);
      showBanner();
      break;
    case "plan":
      screen.plan = message;
      break;
    case "recording":
      recording.take(message);
      break;
    case "health":
      hud.showHealth(message);
      break;
    case "refused":
      if (message.reason === "not_driver") hud.toast(lease.refusal);
      break;
    case "error":
      console.error(`server: ${message.text}`);
  }
});
onDetail(link, "frame", (/** @type {Frame} */ received) => {
  if (received.kind === PANORAMA || received.kind === VIEW) images.take(received).then(wake);
  else if (received.kind === LAYERS) images.takeLayers(received).then(wake);
  else takeGrid(received);
});

/** @param {GridFrame} grid */
async function takeGrid(grid) {
  try {
    const bitmap = await createImageBitmap(grid.payload, { colorSpaceConversion: "none" });
    screen.minimap.setGrid(grid.kind === MAP ? "map-grid" : "cost-grid", bitmap, grid.header);
    bitmap.close();
  } catch (error) {
    console.warn(`map ${grid.sequence}: ${error}`);
  } finally {
    wake();
    link.acknowledge(grid);
  }
}

// ---- from the operator -----------------------------------------------------------------------------

/** Makes the button and the space bar stop the robot. */
function attachStop() {
  for (const name of ["pointerdown", "click"]) byId("estop").addEventListener(name, stopNow);
  for (const name of /** @type {const} */ (["keydown", "keyup"])) {
    window.addEventListener(name, (event) => {
      if (event.code !== "Space") return;
      // The space bar must not press a focused button.
      event.preventDefault();
      event.stopPropagation();
      if (name === "keydown" && !event.repeat) stopNow();
    }, { capture: true });
  }
}

function stopNow() {
  drive.stop();
  link.send({ type: "estop" });
  // The stop is also sent over a connection of its own, because the WebSocket may be stuck. A second stop does no harm.
  fetch("/estop", { method: "POST", keepalive: true }).then(({ ok }) => ok).catch(() => false).then((sent) => {
    if (!sent && !link.connected) hud.toast("Emergency stop not sent: no connection to the server.");
  });
}

function askForTheLease() {
  const refusal = lease.request();
  if (refusal) hud.toast(refusal);
}

/** Sets the speed limit. @param {number} percent of the largest speed, 10 to 100 */
function setScale(percent) {
  const value = Math.min(Math.max(percent, 10), 100);
  scale.value = String(value);
  byId("scale-text").textContent = `${value} %`;
  drive.setScale(value / 100);
}

function fullScreen() {
  if (document.fullscreenElement) document.exitFullscreen();
  else document.documentElement.requestFullscreen().catch((error) => hud.toast(`Full screen failed: ${error.message}`));
}

function help() {
  if (helpDialog.open) helpDialog.close();
  else helpDialog.showModal();
}

function glide() {
  images.glides = !images.glides;
  hud.toast(`Smooth motion of the camera's image: ${images.glides ? "on" : "off"}`);
}

/** Changes the speed limit. @param {number} percent to add */
const changeScale = (percent) => setScale(+scale.value + percent);
const slower = () => changeScale(-10), faster = () => changeScale(10);
/** @type {Record<string, () => void>} Actions by key code. A button names its key in data-key. */
const SHORTCUTS = {
  KeyC: () => look.centre(),
  KeyM: () => screen.enlargeMap(),
  KeyR: () => recording.toggle(),
  KeyB: () => recording.mark(),
  KeyP: () => screen.save(),
  KeyF: fullScreen,
  KeyH: help,
  KeyV: glide,
  Minus: slower, NumpadSubtract: slower,
  Equal: faster, NumpadAdd: faster,
};

window.addEventListener("keydown", (event) => {
  if (event.ctrlKey || event.metaKey || event.altKey || event.repeat) return;
  SHORTCUTS[event.code]?.();
  if (isDriveKey(event)) askForTheLease();
}, { capture: true });
for (const element of all("[data-key]")) element.addEventListener("click", SHORTCUTS[element.dataset.key ?? ""]);
byId("take").addEventListener("click", () => lease.takeOver());
byId("yield").addEventListener("click", () => lease.handOver());
for (const button of all("#more button")) {
  button.addEventListener("click", () => byId("more").hidePopover());
}
scale.addEventListener("input", () => setScale(+scale.value));
scale.addEventListener("change", () => scale.blur());
hud.holdToConfirm(byId("release"), () => link.send({ type: "estop_release" }));
attachStick(byId("stick"), drive);
new Gamepads(drive, look, { drive: askForTheLease, stop: stopNow, changeScale, notice: hud.toast, wake });
drive.addEventListener("change", () => {
  images.prediction.command(drive.command, link.serverNow());
  showCommand();
  wake();
});
onDetail(drive, "stop", (/** @type {string} */ why) => {
  if (why) hud.toast(`Stopped: ${why}`);
});

const keyCaps = all("#keys kbd");

function showCommand() {
  hud.showCommand(drive);
  for (const cap of keyCaps) cap.classList.toggle("held", drive.holds(cap.dataset.code ?? ""));
}

for (const name of ["pointerdown", "pointermove", "wheel", "dblclick", "click", "keydown", "keyup", "resize"]) {
  window.addEventListener(name, wake, { passive: true });
}
for (const name of ["open", "lost"]) link.addEventListener(name, wake);

mark("quality", viewer.slow ? "plain" : "full");
setScale(70);
hud.showMode(null, lease.driver);
showCommand();
wake();
