// @ts-check
// The newest panorama and rendered view, and the scene composed of them.

/** @import { Link } from "./link.js" */
/** @import { Look } from "./look.js" */
/** @import { Mat3, Vec3 } from "./math.js" */
/** @import { Layer, Photo, Surface } from "./layers.js" */
/** @import { FrameOf, LayerData, LayersFrame, LayersHeader, Mesh, PageSettings, PanoramaHeader, State, ViewHeader } from "./messages.js" */
/** @import { GlViewer } from "./viewer.js" */
import { fitGains, plain, Releasing } from "./colour.js";
import { clamp, fromQuaternion, identity, lookRotation, mounted, multiply, rotationZ, times, transpose } from "./math.js";
import { DEFAULT_PAGE, PANORAMA, VIEW } from "./messages.js";
import { Motion } from "./motion.js";
import { Prediction } from "./prediction.js";

/** @typedef {1 | 2} Kind PANORAMA or VIEW. */
/** @typedef {ViewHeader & {aspect: number}} View */
/** @typedef {{from: Omit<Photo, "image">, to: Vec3}} Glide Pose of the camera when the image was taken, and the place from which it is shown, m. */
/**
 * @typedef {object} Scene
 * @property {[number, number]} tanHalf of the shown field of view: horizontal, vertical
 * @property {Mat3} mapFromLook
 * @property {Mat3} panoramaFromLook
 * @property {Mat3} viewFromLook
 * @property {[number, number]} viewTanHalf of the rendered view
 * @property {Glide | null} glide shows the camera's image from another place; null: it is shown as it was taken
 * @property {Vec3 | null} place from which the layers are shown instead of the rendered view, m; null: no layers
 * @property {number} blend 0 panorama, 1 view
 * @property {Vec3} panoramaGain of the colours
 * @property {Vec3} viewGain
 */

const STALE_MS = 2000;
const KEPT_TIMES = 100; // number of arrival times kept per kind of image, for its rate
// Longest wait for an image made after a change of mode. After it, the best available image is shown.
const WAIT_MS = { [PANORAMA]: 300, [VIEW]: 500 };
const LAYERS_MS = 5000; // longest wait for the layers of a new link
// A camera image that was taken farther away or longer ago is shown as it was taken.
const ELSEWHERE_M = 0.5, FROZEN_MS = 1000;
const LEAD_MS = 800; // time after a switch until the prediction includes the full delay of a command

export class Images {
  /** @param {GlViewer} viewer @param {Link} link */
  constructor(viewer, link) {
    this.viewer = viewer;
    this.link = link;
    /** @type {PanoramaHeader | null} */
    this.panorama = null;
    /** @type {View | null} */
    this.view = null;
    this.blend = 0;
    this.dissolveMs = 0;
    this.changed = true;
    this.motion = new Motion();
    this.prediction = new Prediction();
    /** @type {LayersHeader | null} The layers that this page renders itself; null: it shows views rendered by the server. */
    this.layers = null;
    /** @type {Map<string, Surface>} Loaded surfaces, by id. */
    this._held = new Map();
    this._loads = 0; // number of links so far; layers of an earlier link are dropped
    /** @type {number | null} Time from the capture of the newest camera image to its first rendering. */
    this.cameraMs = null;
    /** @type {PanoramaHeader | null} The camera image of the last rendered frame. */
    this._rendered = null;
    this.shownMs = 0; // time of the newest shown state, server's clock
    this.moves = false; // by this page's prediction, the v-bot moves
    this.glides = !viewer.slow; // the camera's image is shown from the robot's present place
    /** @type {[number, number] | null} Position in the map frame from which the view is shown. */
    this.place = null;
    /** @type {[number, number] | null} Position of the v-bot's camera. */
    this._now = null;
    /** @type {[number, number] | null} Position of the real robot's camera in the last scene, if it was shown. */
    this._followed = null;
    this._lead = 0; // share of a command's delay that is predicted
    this._virtual = false;
    // Server time since which images of each kind are taken at the shown robot; Infinity: they are taken elsewhere.
    this._since = { [PANORAMA]: Infinity, [VIEW]: Infinity };
    this._changedAt = 0;
    this._toward = 0;
    this._gains = { [PANORAMA]: new Releasing(), [VIEW]: new Releasing() };
    /** @type {Record<Kind, number[]>} */
    this._times = { [PANORAMA]: [], [VIEW]: [] };
    this.configure(DEFAULT_PAGE);
  }

  /** @param {PageSettings} settings @param {boolean} still the operator's system asks for reduced motion */
  configure({ dissolve_ms, ease_ms, max_accel, colour_release_s }, still = false) {
    this.dissolveMs = still ? 0 : dissolve_ms;
    this.motion.easeMs = still ? 0 : ease_ms;
    this.prediction.maxAccel = max_accel;
    for (const gains of Object.values(this._gains)) gains.releaseMs = 1000 * colour_release_s; // 0: colours are not matched
  }

  /** Decodes an image, passes it to the viewer, then acknowledges it. @param {FrameOf<1> | FrameOf<2>} frame */
  async take(frame) {
    try {
      const bitmap = await decoded(frame.payload);
      if (frame.kind === VIEW) {
        this.viewer.setView(bitmap);
        this.view = { ...frame.header, aspect: bitmap.width / bitmap.height };
      } else {
        this.viewer.setPanorama(bitmap);
        this.panorama = frame.header;
      }
      bitmap.close();
      this.changed = true;
      this.countFrame(frame.kind);
    } catch (error) {
      console.warn(`image ${frame.sequence} of kind ${frame.kind}: ${error}`);
    } finally {
      this.link.acknowledge(frame);
    }
  }

  /** Decodes and loads layers, then acknowledges them. @param {LayersFrame} frame */
  async takeLayers(frame) {
    const { viewer, _loads: load } = this;
    let loaded = false;
    try {
      const layers = await Promise.all(frame.layers.map((data) => this._decodedLayer(data)));
      if (load === this._loads && !viewer.lost) {
        viewer.loadLayers(layers);
        this._held = new Map(frame.layers.map(({ id }, i) => [id, layers[i].surface]));
        this.layers = frame.header;
        this.changed = loaded = true;
      }
    } catch (error) {
      console.warn(`layers of version ${frame.header.version}: ${error}; the previous layers stay`);
    }
    if (load === this._loads) this.link.acknowledge(frame, loaded);
  }

  /** Waits for the layers of a new link. If none arrive, the page returns to views rendered by the server. */
  expectLayers() {
    const load = ++this._loads, { layers } = this;
    setTimeout(() => {
      if (load !== this._loads || layers !== this.layers) return;
      this._held.clear();
      this.layers = null;
      this.changed = true;
    }, LAYERS_MS);
  }

  /** @param {LayerData} data @returns {Promise<Layer>} */
  async _decodedLayer({ id, gain, q, p, mesh }) {
    const surface = mesh ? await decodedSurface(mesh) : this._held.get(id);
    if (!surface) throw new Error(`the mesh of layer ${id} has not been loaded`);
    return { surface, gain, mapFromCamera: fromQuaternion(q), position: p };
  }

  /** True if this page renders layers in place of the server's views. */
  get rendersLayers() {
    return this.layers !== null && !this.viewer.lost;
  }

  /** Counts a received image, or a view rendered by this page. @param {Kind} kind */
  countFrame(kind) {
    this._times[kind] = [...this._times[kind].slice(1 - KEPT_TIMES), performance.now()];
  }

  /** Returns the images of a kind per second, over the last 3 s. @param {Kind} kind */
  rate(kind) {
    const now = performance.now(), recent = this._times[kind].filter((t) => now - t < 3000);
    return recent.length < 2 ? 0 : (1000 * (recent.length - 1)) / (now - recent[0]);
  }

  /** Records that a frame with the newest images was rendered. */
  noteRendered() {
    const { panorama } = this, now = this.link.serverNow();
    if (!panorama || panorama === this._rendered || this.blend === 1 || now === null) return;
    this._rendered = panorama;
    this.cameraMs = now - panorama.captured_ms;
  }

  /** Header of the shown image. */
  get shown() {
    if (this.blend > 0.5 && this.rendersLayers) return { captured_ms: this.shownMs };
    return this.blend > 0.5 ? this.view : this.panorama;
  }

  /** Returns the age of the shown image in ms; null if there is none. */
  ageMs() {
    const now = this.link.serverNow();
    return this.shown && now !== null ? now - this.shown.captured_ms : null;
  }

  get stale() {
    const age = this.ageMs();
    return age !== null && age > STALE_MS;
  }

  /**
   * Advances by `elapsedMs` and returns the scene for the viewer.
   * @param {State | null} state newest state message
   * @param {Pick<Look, "yaw" | "pitch">} look @param {[number, number]} tanHalf @param {number} elapsedMs
   * @returns {Scene}
   */
  scene(state, look, tanHalf, elapsedMs) {
    const now = performance.now();
    const starts = this._step(state, elapsedMs);
    this._lead = ramp(this._lead, state?.mode === "virtual", elapsedMs / LEAD_MS);
    this._follow(state, elapsedMs);
    this.place = this.view && [this.view.p[0], this.view.p[1]];
    const lookTurn = lookRotation(look.yaw, look.pitch);
    const mapFromLook = multiply(rotationZ(this.motion.yaw ?? 0), lookTurn);
    /** @param {[number, number, number, number]} q */
    const relative = (q) => multiply(transpose(fromQuaternion(q)), mapFromLook);
    const q = this.motion.yaw === null ? null : this.panorama?.q;
    const glide = this._glided(state);
    const viewTan = this.view ? Math.tan(this.view.fov / 2) : 1;
    /** @type {Scene} */
    const scene = {
      tanHalf,
      mapFromLook,
      panoramaFromLook: q ? relative(q) : lookTurn,
      viewFromLook: this.view ? relative(this.view.q) : identity,
      viewTanHalf: [viewTan, viewTan / (this.view?.aspect ?? 1)],
      glide,
      place: this.layers && this.rendersLayers ? this._layersPlace(this.layers, glide) : null,
      blend: this.blend * this.blend * (3 - 2 * this.blend),
      panoramaGain: plain,
      viewGain: plain,
    };
    if (starts && this.panorama && (this.view || scene.place)) this._match(scene, now);
    scene.panoramaGain = this._gains[PANORAMA].at(now);
    scene.viewGain = this._gains[VIEW].at(now);
    if (Object.values(this._gains).some((gains) => gains.active)) this.changed = true;
    return scene;
  }

  /**
   * Returns the robot's present place. The camera's image is shown from there with the depth of the layers, so that motion
   * looks smooth at a low frame rate. Null if the image must be shown as it was taken, so that an old one does not look new.
   * @param {State | null} state @returns {Glide | null}
   */
  _glided(state) {
    const { panorama, layers } = this, { pose } = this.motion;
    if (!this.glides || !panorama?.q || !panorama.p || !pose || !layers || !this.rendersLayers) return null;
    if (state && state.at_ms - panorama.captured_ms > FROZEN_MS) return null;
    const [x, y] = mounted(pose, layers.mount), [px, py, pz] = panorama.p;
    if (Math.hypot(x - px, y - py) > ELSEWHERE_M) return null;
    return { from: { mapFromCamera: fromQuaternion(panorama.q), position: panorama.p }, to: [x, y, pz] };
  }

  /**
   * Returns the place from which the layers, and a gliding camera image, are shown; null if unknown. When the real robot is
   * shown again, the place moves on with the robot, so that both images of the dissolve move alike.
   * @param {LayersHeader} layers @param {Glide | null} glide @returns {Vec3 | null}
   */
  _layersPlace({ mount }, glide) {
    const { own } = this.motion, before = this._followed;
    if (own) {
      const [x, y] = mounted(own, mount);
      if (this._virtual || !this._now) this._now = [x, y];
      else if (before) this._now = [this._now[0] + x - before[0], this._now[1] + y - before[1]];
      this._followed = this._virtual ? null : [x, y];
    }
    if (glide) this._now = [glide.to[0], glide.to[1]];
    if (!this._now) return null;
    this.place = this._now;
    return [...this._now, mount[2]];
  }

  /**
   * Advances the dissolve. Returns true when a dissolve starts while one image is shown alone.
   * @param {State | null} state @param {number} elapsedMs
   */
  _step(state, elapsedMs) {
    const virtual = shows(state) === "virtual", at = state?.at_ms ?? 0;
    if (virtual !== this._virtual) this._changedAt = at;
    this._virtual = virtual;
    // In ENTERING, views are already rendered at the v-bot's pose. In RETURNING, the camera has already reached the v-bot,
    // and the page switches when the newest image shows the same place as the view.
    const nearVbot = virtual || state?.mode === "entering", nearRobot = !virtual || state?.mode === "returning";
    this._since[VIEW] = nearVbot ? Math.min(this._since[VIEW], at) : Infinity;
    this._since[PANORAMA] = nearRobot ? Math.min(this._since[PANORAMA], at) : Infinity;
    // After a stop or the loss of the controller, the camera's image is shown even if it is old.
    const waits = virtual || state?.mode === "real";
    const kind = virtual ? VIEW : PANORAMA, wanted = virtual ? 1 : 0;
    const toward = this.blend === wanted || this._toward === wanted || !waits || this._fits(kind) ? wanted : 1 - wanted;
    const starts = toward !== this._toward && (this.blend === 0 || this.blend === 1);
    this._toward = toward;
    if (toward !== this.blend) {
      const step = this.dissolveMs > 0 ? elapsedMs / this.dissolveMs : 1;
      this.blend = toward ? Math.min(1, this.blend + step) : Math.max(0, this.blend - step);
      this.changed = true;
    }
    return starts;
  }

  /** Returns whether a kind's newest image was made since the switch, or the wait for one is over. @param {Kind} kind */
  _fits(kind) {
    if (kind === VIEW && this.rendersLayers) return true;
    const header = kind === VIEW ? this.view : this.panorama;
    if (!header) return kind === PANORAMA;
    return header.captured_ms >= this._since[kind] || (this.link.serverNow() ?? 0) - this._changedAt > WAIT_MS[kind];
  }

  /** Matches the colours of the new image to those of the old one. @param {Scene} scene @param {number} now */
  _match(scene, now) {
    if (this._gains[VIEW].releaseMs <= 0) return;
    const seen = this.viewer.sample(scene);
    /** @type {[Kind, Kind]} */
    const [comes, goes] = this._toward ? [VIEW, PANORAMA] : [PANORAMA, VIEW];
    this._gains[comes].set(times(fitGains(seen[comes], seen[goes], seen.weights), this._gains[goes].at(now)), now);
  }

  /** Updates the pose of the shown robot between state messages. @param {State | null} state @param {number} elapsedMs */
  _follow(state, elapsedMs) {
    const robot = shows(state), pose = robot === "virtual" ? (state?.vbot ?? state?.robot) : state?.robot;
    const now = this.link.serverNow() ?? state?.at_ms ?? 0, age = state ? now - state.at_ms : 0;
    const twist = state?.twist ?? [0, 0];
    if (state && pose && state.mode === "virtual" && robot === "virtual" && this.rendersLayers) {
      const delay = (this._lead * (this.link.clock.roundTripMs ?? 0)) / 2;
      const present = this.prediction.from(pose, twist, state.at_ms, now, delay);
      this.motion.follow(robot, present.pose, present.twist, 0, elapsedMs);
      this.moves = present.twist[0] !== 0 || present.twist[1] !== 0;
    } else {
      this.motion.follow(robot, pose, twist, age, elapsedMs);
      this.moves = false;
    }
  }
}

/** Returns the robot that the operator sees and drives. @param {State | null} state @returns {"real" | "virtual"} */
export const shows = (state) => (state?.shown === "virtual" ? "virtual" : "real");

/** @param {number} share @param {boolean} up @param {number} step @returns {number} */
const ramp = (share, up, step) => clamp(share + (up ? step : -step), 0, 1);

/** @param {Blob} blob */
const decoded = (blob) => createImageBitmap(blob, { colorSpaceConversion: "none" });

/** @param {Mesh} mesh @returns {Promise<Surface>} */
async function decodedSurface({ image, confidence, ...numbers }) {
  const [colours, seen] = await Promise.all([decoded(image), confidence && decoded(confidence)]);
  return { ...numbers, image: colours, confidence: seen };
}
