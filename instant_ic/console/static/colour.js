// @ts-check
// Colour matching of two images of one place by a gain per channel. Exposure and white balance differ only by such gains.

/** @import { Vec3 } from "./math.js" */
import { clamp } from "./math.js";

/** @type {Vec3} Gains that change nothing. */
export const plain = [1, 1, 1];

const LEAST_OVERLAP = 0.05; // smallest share of samples in both images with which colours are matched
const DARKEST = 0.05, BRIGHTEST = 0.95; // darker values are too noisy for a ratio, brighter ones are clipped
const MOST_GAIN = 1.8;

/**
 * Returns the gains that match the colours of `from` to those of `to`. As medians of ratios, they ignore the few samples
 * where something has moved or an edge is displaced.
 * @param {number[]} from 3 values per sample, 0..1 @param {number[]} to @param {number[]} weights one per sample, 0..1
 * @returns {Vec3}
 */
export function fitGains(from, to, weights) {
  const seen = weights.flatMap((weight, i) => (weight > 0.5 ? [3 * i] : []));
  if (seen.length < LEAST_OVERLAP * weights.length) return plain;
  /** @param {number} channel */
  const gain = (channel) => {
    const usable = seen.map((i) => i + channel).filter((i) => from[i] > DARKEST && Math.max(from[i], to[i]) < BRIGHTEST);
    const ratios = usable.map((i) => to[i] / from[i]).sort((a, b) => a - b);
    return clamp(ratios[ratios.length >> 1] ?? 1, 1 / MOST_GAIN, MOST_GAIN);
  };
  return [gain(0), gain(1), gain(2)];
}

/** Gains that fade out within `releaseMs`. */
export class Releasing {
  constructor() {
    this._gains = plain;
    this._since = 0;
    this.releaseMs = 0;
  }

  /** @param {Vec3} gains @param {number} now ms */
  set(gains, now) {
    this._gains = gains;
    this._since = now;
  }

  get active() {
    return this._gains !== plain;
  }

  /** @param {number} now ms @returns {Vec3} */
  at(now) {
    const t = this.releaseMs > 0 ? (now - this._since) / this.releaseMs : 1;
    if (t >= 1) this._gains = plain;
    if (!this.active) return plain;
    const share = 1 - t * t * (3 - 2 * t), [r, g, b] = this._gains;
    return [1 + (r - 1) * share, 1 + (g - 1) * share, 1 + (b - 1) * share];
  }
}
