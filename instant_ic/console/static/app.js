// The operator's page: connects link, drive, look, images, map and overlay.

import { attachStick, Drive, isDriveKey, isTyping } from "./drive.js";
import { Gamepads } from "./gamepad.js";
import { FlatViewer } from "./flatviewer.js";
import { drawCompass, drawGuide } from "./guide.js";
import * as hud from "./hud.js";
import { COSTMAP, Link, MAP } from "./link.js";
import { Look } from "./look.js";
import { radians, transpose } from "./math.js";
import { MiniMap } from "./minimap.js";
import { Pictures, shows } from "./pictures.js";
import { Recording } from "./record.js";
import { saveFile, savePicture } from "./save.js";
import { GlViewer } from "./viewer.js";

const LOOK_MS = 100; // shortest interval between two look messages
const SLOW_FRAME_MS = 45; // shortest frame time when the CPU renders, with fewer pixels
const SLOW_PIXELS = 0.5;
const SLOW_MAP_MS = 200;
const byId = (id) => document.getElementById(id);
const options = new URLSearchParams(location.search);
const reducedMotion = matchMedia("(prefers-reduced-motion: reduce)");

const picture = byId("picture"), guide = byId("guide"), compass = byId("compass-tape");
const link = new Link(`${location.protocol === "https:" ? "wss" : "ws"}://${location.host}/ws`);
const drive = new Drive(link);
const look = new Look(picture);
const viewer = makeViewer();
if (options.get("quality") === "full") viewer.slow = false;
hud.mark("viewer", viewer.name);
hud.mark("quality", viewer.slow ? "plain" : "full");
const pictures = new Pictures(viewer, link);
const minimap = new MiniMap(byId("map-canvas"));
const recording = new Recording(link, drive);

let page = { footprint: [0.6, 0.5], camera: [0, 0, 1.2], dissolve_ms: 250, ease_ms: 400, colour_release_s: 6, lead_max_m: 0 };
let state = null, session = { driver: "none", clients: 0, estop: false };
let plan = { trajectory: [], path: [], subgoal: null };
let everConnected = false;
let sentLook = "", sentLookAt = 0;
let yielded = false; // the operator gave the lease back
let mayDrive = true; // false: signed in to watch
let mapChanged = true, lastFrame = performance.now(), lastHud = 0, lastMap = 0;
let lastPicture = "", lastGuide = "", lastMapKey = "";

function makeViewer() {
  if (options.get("viewer") !== "canvas") {
    try {
      return new GlViewer(picture);
    } catch (error) {
      console.info(`${error.message}: falling back to the 2D canvas`);
    }
  }
  return new FlatViewer(picture);
}

// ---- incoming messages -------------------------------------------------------------------------

link.addEventListener("open", () => {
  everConnected = true;
  sentLook = "";
  if (mayDrive) link.send({ type: "lease", take: false });
  showBanner();
});
link.addEventListener("lost", () => {
  session = { ...session, driver: "none" };
  drive.setEnabled(false);
  showBanner();
});
link.addEventListener("signed-out", () => location.reload()); // shows the sign-in form
link.addEventListener("message", ({ detail: message }) => {
  switch (message.type) {
    case "hello":
      page = { ...page, ...message.page };
      mayDrive = recording.mayRecord = message.may_drive;
      document.body.dataset.mayDrive = mayDrive;
      pictures.dissolveMs = reducedMotion.matches ? 0 : page.dissolve_ms;
      pictures.motion.easeMs = reducedMotion.matches ? 0 : page.ease_ms;
      pictures.leadMaxM = page.lead_max_m;
      pictures.colourReleaseMs = 1000 * page.colour_release_s;
      drive.limits = { linear: message.max_linear, angular: message.max_angular };
      break;
    case "state":
      state = message;
      hud.showMode(state, session.driver);
      showBanner();
      break;
    case "plan":
      plan = message;
      break;
    case "recording":
      recording.take(message);
      break;
    case "health":
      hud.showHealth(message);
      break;
    case "session":
      // The lease timed out and was not given back: request it again. Keys must be pressed again.
      if (session.driver === "you" && message.driver === "none" && !yielded) link.send({ type: "lease", take: false });
      session = message;
      drive.setEnabled(session.driver === "you" && !session.estop);
      hud.showSession(session);
      showBanner();
      break;
    case "refused":
      if (message.reason === "not_driver") hud.toast("Another operator is driving. Press Take over to drive.");
      break;
    case "error":
      console.error(`server: ${message.text}`);
  }
});
link.addEventListener("frame", async ({ detail: frame }) => {
  if (frame.kind !== MAP && frame.kind !== COSTMAP) return pictures.take(frame);
  try {
    const bitmap = await createImageBitmap(frame.payload, { colorSpaceConversion: "none" });
    minimap.setLayer(frame.kind === MAP ? "map" : "costmap", bitmap, frame.header);
    bitmap.close();
    mapChanged = true;
  } catch (error) {
    console.warn(`map ${frame.sequence}: ${error}`);
  } finally {
    link.acknowledge(frame);
  }
});

// ---- operator actions ----------------------------------------------------------------------------

function stopNow() {
  drive.stop();
  link.send({ type: "estop" });
  // Also by a separate connection: the WebSocket may be stuck, and a second stop changes nothing.
  fetch("/estop", { method: "POST", keepalive: true }).then(({ ok }) => ok).catch(() => false).then((sent) => {
    if (!sent && !link.connected) hud.toast("Emergency stop not sent: no connection to the server.");
  });
}

/** Requests the lease if nobody drives; otherwise says why not. */
function askForTheLease() {
  if (!mayDrive) hud.toast("This sign-in can watch and stop the robot, but not drive it.");
  else if (session.driver === "none") link.send({ type: "lease", take: false });
  else if (session.driver === "other") hud.toast("Another operator is driving. Press Take over to drive.");
}

function setScale(percent) {
  const value = Math.min(Math.max(percent, 10), 100);
  byId("scale").value = value;
  byId("scale-text").textContent = `${value} %`;
  drive.setScale(value / 100);
}

function enlargeMap() {
  minimap.large = byId("map").classList.toggle("large");
  byId("map-size").setAttribute("aria-label", minimap.large ? "Shrink the map" : "Enlarge the map");
  mapChanged = true;
}

function fullScreen() {
  if (document.fullscreenElement) document.exitFullscreen();
  else document.documentElement.requestFullscreen().catch((error) => hud.toast(`Full screen failed: ${error.message}`));
}

function saveShownPicture() {
  savePicture(picture, () => viewer.draw(pictures.scene(state, look, shownFov(), 0)));
  lastPicture = "";
}

function help() {
  if (byId("help").open) byId("help").close();
  else byId("help").showModal();
}

const SHORTCUTS = {
  KeyM: enlargeMap,
  KeyR: () => recording.toggle(),
  KeyB: () => recording.mark(),
  KeyP: saveShownPicture,
  KeyF: fullScreen,
  KeyH: help,
  Minus: () => setScale(+byId("scale").value - 10),
  Equal: () => setScale(+byId("scale").value + 10),
};
SHORTCUTS.NumpadSubtract = SHORTCUTS.Minus;
SHORTCUTS.NumpadAdd = SHORTCUTS.Equal;

window.addEventListener("keydown", (event) => {
  if (isTyping(event)) return; // typing a name in a dialog; the robot is stopped while it is open
  if (event.code === "Space") {
    // The space bar always stops, so no focused button may receive it.
    event.preventDefault();
    event.stopPropagation();
    if (!event.repeat) stopNow();
    return;
  }
  if (event.ctrlKey || event.metaKey || event.altKey || event.repeat) return;
  SHORTCUTS[event.code]?.();
  if (isDriveKey(event)) askForTheLease();
}, { capture: true });
window.addEventListener("keyup", (event) => {
  if (event.code === "Space" && !isTyping(event)) event.preventDefault();
}, { capture: true });

byId("estop").addEventListener("pointerdown", stopNow);
byId("estop").addEventListener("click", stopNow);
byId("take").addEventListener("click", () => {
  yielded = false;
  link.send({ type: "lease", take: true });
});
byId("yield").addEventListener("click", () => {
  yielded = true;
  link.send({ type: "yield" });
});
byId("compass").addEventListener("click", () => look.centre());
byId("map-size").addEventListener("click", enlargeMap);
byId("map-canvas").addEventListener("click", enlargeMap);
for (const id of ["fullscreen", "fullscreen-more"]) byId(id).addEventListener("click", fullScreen);
byId("help-open").addEventListener("click", help);
byId("help-more").addEventListener("click", help);
byId("save-picture").addEventListener("click", saveShownPicture);
byId("save-panorama").addEventListener("click", () => saveFile("panorama.jpg"));
byId("save-map").addEventListener("click", () => saveFile("map.zip"));
for (const button of document.querySelectorAll("#more button")) {
  button.addEventListener("click", () => byId("more").hidePopover());
}
byId("scale").addEventListener("input", (event) => setScale(+event.target.value));
byId("scale").addEventListener("change", (event) => event.target.blur());
hud.holdToConfirm(byId("release"), () => link.send({ type: "estop_release" }));
attachStick(byId("stick"), drive);
const pads = new Gamepads(drive, look);
pads.addEventListener("drive", askForTheLease);
pads.addEventListener("stop", stopNow);
pads.addEventListener("centre", () => look.centre());
pads.addEventListener("scale", ({ detail: change }) => setScale(+byId("scale").value + change));
pads.addEventListener("tell", ({ detail: words }) => hud.toast(words));
drive.addEventListener("stop", ({ detail: why }) => hud.toast(`Stopped: ${why}`));
document.addEventListener("visibilitychange", () => { lastFrame = performance.now(); });

// ---- display -------------------------------------------------------------------------------------

function showBanner() {
  // A stopped robot starts only once the controls are released, so remind an operator who still holds a key.
  const held = state?.mode === "stopped" && (state.command ?? []).some((value) => value !== 0);
  hud.showBanner(link.connected, everConnected, session.estop || (state?.estop ?? false), held, session.driver, state?.reason ?? "");
}

function fit(canvas, pixels = 1) {
  const ratio = Math.min(devicePixelRatio, 2) * pixels;
  const width = Math.round(canvas.clientWidth * ratio), height = Math.round(canvas.clientHeight * ratio);
  if (canvas.width === width && canvas.height === height) return false;
  canvas.width = width;
  canvas.height = height;
  return true;
}

function shownFov() {
  const tanV = Math.tan(look.vfov / 2);
  const tanH = (tanV * picture.clientWidth) / Math.max(picture.clientHeight, 1);
  return [tanH, tanV];
}

function sendLook(tanHalf, now) {
  if (!link.connected || now - sentLookAt < LOOK_MS) return;
  const message = {
    type: "look",
    yaw: look.yaw,
    pitch: look.pitch,
    hfov: Math.min(2 * Math.atan(tanHalf[0]), radians(149)),
    vfov: Math.min(2 * Math.atan(tanHalf[1]), radians(149)),
  };
  const key = [message.yaw, message.pitch, message.hfov, message.vfov].map((value) => value.toFixed(3)).join() + session.driver;
  if (key === sentLook) return;
  sentLook = key;
  sentLookAt = now;
  link.send(message);
}

function cameraPosition() {
  if (!pictures.motion.pose) return null;
  if (pictures.blend > 0.5 && pictures.place) return [...pictures.place, page.camera[2]];
  const [x, y, yaw] = pictures.motion.pose, [cx, cy, cz] = page.camera;
  return [x + Math.cos(yaw) * cx - Math.sin(yaw) * cy, y + Math.sin(yaw) * cx + Math.cos(yaw) * cy, cz];
}

const COLOURS = { real: "#45c4b0", entering: "#45c4b0", virtual: "#f0ac45", returning: "#f0ac45", stopped: "#ff6b57", none: "#a3adb8" };

const rounded = (values, digits) => (values ? values.map((value) => value.toFixed(digits)).join() : "");

function frame(now) {
  requestAnimationFrame(frame);
  if (viewer.slow && (viewer.busy || now - lastFrame < (pictures.changed ? SLOW_FRAME_MS / 2 : SLOW_FRAME_MS))) return;
  const elapsed = Math.min(now - lastFrame, 200);
  lastFrame = now;
  look.step(elapsed / 1000);
  const tanHalf = shownFov();
  sendLook(tanHalf, now);
  const scene = pictures.scene(state, look, tanHalf, elapsed);
  drawPicture(scene);
  drawOverlay(scene, tanHalf);
  drawMap(scene, tanHalf, now);
  hud.showCommand(drive);
  for (const cap of document.querySelectorAll("#keys kbd")) cap.classList.toggle("held", drive.holds(cap.dataset.code));
  if (now - lastHud > 250) {
    lastHud = now;
    hud.showLatency(link, pictures);
    hud.mark("picture", pictures.shown ? (pictures.stale ? "stale" : "live") : "none");
  }
  // For tests and debugging.
  hud.mark("blend", scene.blend.toFixed(2));
  hud.mark("map", minimap.hasMap ? "drawn" : "none");
}

/** Renders if a new image arrived, the direction changed by half a pixel, or the window size changed. */
function drawPicture(scene) {
  const moved = scene.blend > 0 ? rounded(scene.moved, 3) : "";
  const key = rounded([...scene.mapFromLook, look.yaw, look.vfov], 4) + moved;
  const resized = fit(picture, viewer.slow ? SLOW_PIXELS : 1);
  if (viewer.lost || !(resized || pictures.changed || key !== lastPicture)) return;
  lastPicture = key;
  pictures.changed = false;
  viewer.draw(scene);
  // For measurements: the rendered image and its position.
  const { motion, view, panorama, place } = pictures, shown = shows(state);
  const detail = { shown, pose: motion.pose, blend: scene.blend, view, panorama, place };
  dispatchEvent(new CustomEvent("drawn", { detail }));
}

function drawOverlay(scene, tanHalf) {
  const position = cameraPosition(), colour = COLOURS[state?.mode] ?? COLOURS.none;
  const trajectory = position && link.connected ? plan.trajectory : [];
  // Without a trajectory nothing in the overlay can move.
  const place = trajectory.length ? rounded([...scene.mapFromLook, ...position], 3) + trajectory.join() : "";
  const key = [place, colour, rounded([look.yaw, look.vfov], 3)].join();
  const resized = fit(guide, viewer.slow ? SLOW_PIXELS : 1) | fit(compass);
  if (!resized && key === lastGuide) return;
  lastGuide = key;
  const camera = { lookFromMap: transpose(scene.mapFromLook), position };
  drawGuide(guide, trajectory, camera, tanHalf, page.footprint[1] / 2, colour);
  drawCompass(compass, look.yaw, colour);
}

function drawMap(scene, tanHalf, now) {
  const resized = fit(minimap.canvas);
  if (viewer.slow && !resized && !mapChanged && now - lastMap < SLOW_MAP_MS) return;
  const key = [
    state?.mode, rounded(state?.robot, 2), rounded(state?.vbot, 2), JSON.stringify(plan), rounded([look.yaw, look.vfov], 2),
  ].join(";");
  if (!resized && !mapChanged && key === lastMapKey) return;
  lastMapKey = key;
  lastMap = now;
  mapChanged = false;
  minimap.draw({
    mode: state?.shown ?? state?.mode ?? "none",
    robot: state?.robot ?? null,
    vbot: state?.vbot ?? null,
    plan,
    footprint: page.footprint,
    lookYaw: look.yaw,
    hfov: 2 * Math.atan(tanHalf[0]),
  });
}

setScale(70);
hud.showMode(null, session.driver);
requestAnimationFrame(frame);
