// The newest panorama and rendered view, and what to show of them now.

import { PANORAMA, VIEW } from "./link.js";
import { clamp, fromQuaternion, identity, lookRotation, multiply, rotationZ, transpose, wrapAngle } from "./math.js";

const STALE_MS = 2000;
const WAIT_FOR_VIEW_MS = 500; // for a view made after the change of mode
const HEADING_EXTRAPOLATION_MS = 200;
const HEADING_SMOOTHING_MS = 50;
const SNAP_RAD = 0.6; // a larger jump of the heading is a new pose, not a motion

export class Pictures {
  constructor(viewer, link) {
    this.viewer = viewer;
    this.link = link;
    this.panorama = null; // header of the shown one
    this.view = null;
    this.blend = 0;
    this.dissolveMs = 250;
    this.decodeErrors = 0;
    this.changed = true;
    this._heading = null;
    this._virtualSince = null;
    this._arrivals = { [PANORAMA]: [], [VIEW]: [] };
  }

  /** Decodes a picture frame, puts it into the viewer, then acknowledges it. */
  async take(frame) {
    try {
      const bitmap = await createImageBitmap(frame.payload, { colorSpaceConversion: "none" });
      if (frame.kind === PANORAMA) {
        this.viewer.setPanorama(bitmap);
        this.panorama = frame.header;
      } else {
        this.viewer.setView(bitmap);
        this.view = { ...frame.header, aspect: bitmap.width / bitmap.height };
      }
      if (this.viewer.name === "webgl") bitmap.close();
      this.changed = true;
      const arrivals = this._arrivals[frame.kind];
      arrivals.push(performance.now());
      if (arrivals.length > 30) arrivals.shift();
    } catch (error) {
      this.decodeErrors++;
      console.warn(`picture ${frame.sequence} of kind ${frame.kind}: ${error}`);
    } finally {
      this.link.acknowledge(frame);
    }
  }

  /** Pictures of a kind that came in the last 3 s, a second. */
  rate(kind) {
    const now = performance.now();
    const recent = this._arrivals[kind].filter((t) => now - t < 3000);
    if (recent.length < 2) return 0;
    return (1000 * (recent.length - 1)) / (now - recent[0]);
  }

  /** Header of the picture that the operator sees. */
  get shown() {
    return this.blend > 0.5 ? this.view : this.panorama;
  }

  /** Age of the shown picture, ms; null when there is none. */
  ageMs() {
    const now = this.link.serverNow();
    return this.shown && now !== null ? now - this.shown.captured_ms : null;
  }

  get stale() {
    const age = this.ageMs();
    return age !== null && age > STALE_MS;
  }

  /** Scene for the viewer after `elapsedMs` more. `state` is the newest state message. */
  scene(state, look, tanHalf, elapsedMs) {
    this._step(state, elapsedMs);
    const lookTurn = lookRotation(look.yaw, look.pitch);
    const mapFromLook = multiply(rotationZ(this._heading ?? 0), lookTurn);
    const relative = (header) => multiply(transpose(fromQuaternion(header.q)), mapFromLook);
    const panoramaKnown = this.panorama?.q && this._heading !== null;
    const viewTan = this.view ? Math.tan(this.view.fov / 2) : 1;
    return {
      tanHalf,
      mapFromLook,
      panoramaFromLook: panoramaKnown ? relative(this.panorama) : lookTurn,
      viewFromLook: this.view ? relative(this.view) : identity,
      viewTanHalf: [viewTan, viewTan / (this.view?.aspect ?? 1)],
      blend: this.blend * this.blend * (3 - 2 * this.blend),
    };
  }

  _step(state, elapsedMs) {
    const virtual = state?.mode === "virtual";
    if (!virtual) this._virtualSince = null;
    else this._virtualSince ??= state.at_ms;
    const toward = virtual && this._viewFits() ? 1 : 0;
    if (toward !== this.blend) {
      const step = this.dissolveMs > 0 ? elapsedMs / this.dissolveMs : 1;
      this.blend = toward ? Math.min(1, this.blend + step) : Math.max(0, this.blend - step);
      this.changed = true;
    }
    this._turn(state, virtual, elapsedMs);
  }

  /** Whether the newest view may be shown: made in this mode, or the best there is after a wait. */
  _viewFits() {
    if (!this.view) return false;
    if (this.blend > 0 || this.view.captured_ms >= this._virtualSince) return true;
    return this.link.serverNow() - this._virtualSince > WAIT_FOR_VIEW_MS;
  }

  /** Follows the shown robot's heading between the state messages. */
  _turn(state, virtual, elapsedMs) {
    const pose = virtual ? (state.vbot ?? state.robot) : state?.robot;
    if (!pose) return;
    const turned = virtual ? state.command?.[1] : state.applied?.[1];
    const since = clamp((this.link.serverNow() ?? state.at_ms) - state.at_ms, 0, HEADING_EXTRAPOLATION_MS);
    const target = pose[2] + ((turned ?? 0) * since) / 1000;
    if (this._heading === null || Math.abs(wrapAngle(target - this._heading)) > SNAP_RAD) {
      this._heading = target;
      return;
    }
    const move = wrapAngle(target - this._heading) * (1 - Math.exp(-elapsedMs / HEADING_SMOOTHING_MS));
    this._heading = wrapAngle(this._heading + move);
  }
}
