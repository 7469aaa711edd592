// @ts-check
// Renders the main image if it has changed, and shows trajectory, compass and map. While something moves, frames follow each
// other. Otherwise a message, an image or an input requests the next frame.

/** @import { PageSettings, Plan, State } from "./messages.js" */
/** @import { Images, Scene } from "./images.js" */
/** @import { Lease } from "./lease.js" */
/** @import { Link } from "./link.js" */
/** @import { Look } from "./look.js" */
/** @import { Vec3 } from "./math.js" */
/** @import { GlViewer } from "./viewer.js" */
import { byId, mark } from "./dom.js";
import { showCompass, showGuide } from "./guide.js";
import { showLatency } from "./hud.js";
import { shows } from "./images.js";
import { mounted, radians, transpose } from "./math.js";
import { DEFAULT_PAGE, VIEW } from "./messages.js";
import { MiniMap } from "./minimap.js";
import { saveView } from "./save.js";

const LOOK_MS = 100; // shortest interval between two look messages
const MAX_FOV = radians(149);
const LATENCY_MS = 250;
const SLOW_FRAME_MS = 45; // shortest frame time when the CPU renders, with fewer pixels
const SLOW_PIXELS = 0.45; // share of the window's pixels per axis
const STILL_PIXELS = 0.5, LEAST_PIXELS = 0.3; // smallest turn that is rendered while the robot stands and while the v-bot moves

export class Screen {
  /** @param {GlViewer} viewer @param {Images} images @param {Look} look @param {Link} link @param {Lease} lease */
  constructor(viewer, images, look, link, lease) {
    this.viewer = viewer;
    this.images = images;
    this.look = look;
    this.link = link;
    this.lease = lease;
    this.minimap = new MiniMap();
    /** @type {State | null} The newest state message. */
    this.state = null;
    /** @type {Pick<Plan, "trajectory" | "path" | "subgoal">} The newest plan message. */
    this.plan = { trajectory: [], path: [], subgoal: null };
    /** @type {PageSettings} */
    this.settings = DEFAULT_PAGE;
    this._viewAt = this._steppedAt = performance.now();
    this._requested = this._wanted = false;
    this._timer = 0;
    this._latencyAt = this._lookAt = 0;
    /** Rotation and field of view of the last rendered image. @type {number[]} */
    this._direction = [];
    this._sentLook = this._viewKey = this._reported = "";
    for (const name of ["open", "lost"]) link.addEventListener(name, () => {
      this._sentLook = this._reported = "";
      this._latencyAt = 0;
    });
    document.addEventListener("visibilitychange", () => { this._steppedAt = performance.now(); });
  }

  /** Shows a state message. @param {State} state */
  take(state) {
    this.state = state;
    this.wake();
  }

  /** Reports to the server that the newest state is on the screen, or that this page needs rendered views. */
  _reportShown() {
    const { state, images, link } = this;
    if (!state) return;
    images.shownMs = state.at_ms;
    const version = images.rendersLayers && images.layers ? images.layers.version : 0;
    const key = version === 0 ? "0" : `${version} ${state.at_ms}`;
    if (!link.connected || key === this._reported) return;
    this._reported = key;
    link.send({ type: "drawn", version, state_ms: state.at_ms });
  }

  /** Requests a frame. */
  wake() {
    if (!this._wanted) this._steppedAt = performance.now(); // nothing has moved until now
    this._wanted = true;
    this._request();
  }

  _request() {
    if (this._requested) return;
    this._requested = true;
    clearTimeout(this._timer);
    requestAnimationFrame((now) => {
      this._requested = false;
      this._frame(now);
    });
  }

  /** @param {number} now ms of this page's clock */
  _frame(now) {
    if (this.viewer.busy) return this._request();
    if (!this._wanted) return;
    const pause = this.viewer.slow ? SLOW_FRAME_MS / (this.images.changed ? 2 : 1) : 0;
    const left = Math.max(this._viewAt + pause, this.viewer.restUntil) - now;
    if (left > 0) {
      this._timer = setTimeout(() => this._request(), left);
      return;
    }
    this._wanted = this._renderFrame(now);
    if (this._wanted || this.viewer.busy) this._request();
  }

  /** Sends the look direction and renders the changes; returns whether something moves. @param {number} now */
  _renderFrame(now) {
    const elapsed = Math.min(Math.max(now - this._steppedAt, 0), 200);
    this._steppedAt = Math.max(now, this._steppedAt);
    this.look.step(elapsed / 1000);
    const tanHalf = this._tanHalf(), waits = this._sendLook(tanHalf, now);
    const scene = this.images.scene(this.state, this.look, tanHalf, elapsed);
    const moved = this._renderView(scene);
    this._reportShown();
    this._showOverlay(scene, tanHalf);
    if (now - this._latencyAt > LATENCY_MS) {
      this._latencyAt = now;
      showLatency(this.link, this.images);
      mark("image", this.images.shown ? (this.images.stale ? "stale" : "live") : "none");
    }
    // For tests and debugging.
    mark("blend", scene.blend.toFixed(2));
    mark("map", this.minimap.hasMap ? "drawn" : "none");
    return moved || waits || this.look.moves || this.images.moves;
  }

  enlargeMap() {
    const large = this.minimap.large = byId("map").classList.toggle("large");
    byId("map-size").setAttribute("aria-label", large ? "Shrink the map" : "Enlarge the map");
    this.wake();
  }

  /** Saves the shown view as a file. */
  save() {
    const render = () => this.viewer.render(this.images.scene(this.state, this.look, this._tanHalf(), 0));
    saveView(this.viewer.canvas, render);
    this._viewKey = "";
    this.wake();
  }

  /** Returns the tangents of half the shown field of view: horizontal, vertical. @returns {[number, number]} */
  _tanHalf() {
    const { clientWidth, clientHeight } = this.viewer.canvas, tanV = Math.tan(this.look.vfov / 2);
    return [(tanV * clientWidth) / Math.max(clientHeight, 1), tanV];
  }

  /** Sends the look direction if due; returns whether it still waits. @param {[number, number]} tanHalf @param {number} now */
  _sendLook(tanHalf, now) {
    const { yaw, pitch } = this.look;
    const [hfov, vfov] = tanHalf.map((tan) => Math.min(2 * Math.atan(tan), MAX_FOV));
    const key = rounded([yaw, pitch, hfov, vfov], 3) + this.lease.driver;
    if (!this.link.connected || key === this._sentLook) return false;
    if (now - this._lookAt < LOOK_MS) return true;
    this._sentLook = key;
    this._lookAt = now;
    this.link.send({ type: "look", yaw, pitch, hfov, vfov });
    return false;
  }

  /**
   * Renders if a new image has arrived, or if the direction or the window's size has changed visibly. Returns whether the
   * shown place or the blend has changed, since the next frame is then likely to differ too.
   * @param {Scene} scene
   */
  _renderView(scene) {
    const { viewer, images, look } = this;
    const resized = fit(viewer.canvas, viewer.slow ? SLOW_PIXELS : 1);
    const key = rounded([scene.blend], 4) + rounded(scene.blend > 0 ? scene.place : scene.glide?.to, 3);
    const direction = [...scene.mapFromLook, look.vfov];
    // SLAM turns a standing robot by a fraction of a milliradian with every scan; the v-bot's pose has no such noise.
    const least = (images.moves ? LEAST_PIXELS : STILL_PIXELS) * 2 * this._tanHalf()[0] / viewer.canvas.width;
    const turned = this._direction.some((value, index) => Math.abs(value - direction[index]) > least);
    const moves = turned || key !== this._viewKey;
    if (viewer.lost || !(resized || images.changed || moves)) return false;
    this._viewKey = key;
    this._direction = direction;
    images.changed = false;
    this._viewAt = this._steppedAt; // a frame that renders nothing needs no pause
    viewer.render(scene);
    images.noteRendered();
    if (scene.place && scene.blend > 0) images.countFrame(VIEW);
    // For measurements: the rendered image and its position.
    const { motion, view, panorama, place } = images;
    const detail = { shown: shows(this.state), pose: motion.pose, blend: scene.blend, view, panorama, place };
    dispatchEvent(new CustomEvent("rendered", { detail }));
    return moves;
  }

  /** @param {Scene} scene @param {[number, number]} tanHalf */
  _showOverlay(scene, tanHalf) {
    const position = this._cameraPosition(), camera = { lookFromMap: transpose(scene.mapFromLook), position: position ?? [0, 0, 0] };
    showGuide(position && this.link.connected ? this.plan.trajectory : [], camera, tanHalf, this.settings.footprint[1] / 2);
    showCompass(this.look.yaw);
    this.minimap.show({
      virtual: shows(this.state) === "virtual",
      robot: this.state?.robot ?? null,
      vbot: this.state?.vbot ?? null,
      plan: this.plan,
      footprint: this.settings.footprint,
      lookYaw: this.look.yaw,
      hfov: 2 * Math.atan(tanHalf[0]),
    });
  }

  /** Returns the position of the shown camera in the map frame; null if unknown. @returns {Vec3 | null} */
  _cameraPosition() {
    const { motion, blend, place } = this.images, [x, y, z] = this.settings.camera;
    if (!motion.pose) return null;
    const [px, py] = blend > 0.5 && place ? place : mounted(motion.pose, [x, y]);
    return [px, py, z];
  }
}

/** @param {readonly number[] | null | undefined} values @param {number} digits */
const rounded = (values, digits) => (values ? values.map((value) => value.toFixed(digits)).join() : "");

/** Gives a canvas the size of its element; returns whether it changed. @param {HTMLCanvasElement} canvas @param {number} pixels share per axis */
function fit(canvas, pixels) {
  const ratio = Math.min(devicePixelRatio, 2) * pixels;
  const width = Math.round(canvas.clientWidth * ratio), height = Math.round(canvas.clientHeight * ratio);
  if (canvas.width === width && canvas.height === height) return false;
  canvas.width = width;
  canvas.height = height;
  return true;
}
