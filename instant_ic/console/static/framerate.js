// @ts-check
// Frames a second while the shown place moves.

const KEPT = 60;

export class FrameRate {
  constructor() {
    /** @type {number[]} Intervals between frames, ms. */
    this._intervals = [];
    /** @type {number | null} Time of the last frame if it showed a motion. */
    this._movedAt = null;
  }

  /** Mean over the newest frames that showed a motion; 0 before there are any. */
  get perSecond() {
    const total = this._intervals.reduce((sum, interval) => sum + interval, 0);
    return total > 0 ? (1000 * this._intervals.length) / total : 0;
  }

  /** Notes a frame; `moved`: it shows another place than the frame before. @param {number} now ms @param {boolean} moved */
  frame(now, moved) {
    if (moved && this._movedAt !== null) this._intervals.push(now - this._movedAt);
    if (this._intervals.length > KEPT) this._intervals.shift();
    this._movedAt = moved ? now : null;
  }
}
