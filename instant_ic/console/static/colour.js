// @ts-check
// Colour matching of two images: gain and offset for each channel, fitted where both show the same place.

import { clamp } from "./math.js";

/** @typedef {{gain: number[], offset: number[]}} Colour For each channel. */

/** @type {Colour} */
export const plain = { gain: [1, 1, 1], offset: [0, 0, 0] };

const ROUNDS = 6; // of the reweighted fit
const OUTLIER = 1.5; // in median deviations
const LEAST_WEIGHT = 0.05; // share of the cells; with less overlap colours are not matched
const STIFFNESS = 0.02; // a flat image cannot separate gain from offset; this favours gain
const MOST_GAIN = 1.8, MOST_OFFSET = 0.2;

/**
 * Returns the colour {gain, offset} that makes `from` look most like `to`.
 * `from`, `to`: 3 values per cell, 0..1; `weights`: one per cell, 0..1. Cells that differ by more than colour
 * (something moved, an edge is slightly off) get little weight.
 * @param {number[]} from @param {number[]} to @param {number[]} weights @returns {Colour}
 */
export function fitColour(from, to, weights) {
  const total = weights.reduce((sum, weight) => sum + weight, 0);
  if (total < LEAST_WEIGHT * weights.length) return plain;
  /** @type {Colour} */
  const result = { gain: [], offset: [] };
  for (let channel = 0; channel < 3; channel++) {
    const x = pick(from, channel), y = pick(to, channel);
    let [gain, offset] = line(x, y, weights);
    for (let round = 0; round < ROUNDS; round++) {
      const misfit = x.map((value, i) => Math.abs(y[i] - gain * value - offset));
      const scale = Math.max(OUTLIER * median(misfit.filter((_, i) => weights[i] > 0)), 1 / 255);
      const heard = weights.map((weight, i) => (weight * scale) / Math.max(scale, misfit[i]) / Math.max(1, (misfit[i] / scale) ** 2));
      [gain, offset] = line(x, y, heard);
    }
    result.gain.push(gain);
    result.offset.push(offset);
  }
  return result;
}

/** @param {number[]} values @param {number} channel @returns {number[]} */
function pick(values, channel) {
  const one = new Array(values.length / 3);
  for (let i = 0; i < one.length; i++) one[i] = values[3 * i + channel];
  return one;
}

/**
 * Weighted least squares of y = gain x + offset; returns [gain, offset]. The offset is regularised towards 0.
 * @param {number[]} x @param {number[]} y @param {number[]} weights @returns {[number, number]}
 */
function line(x, y, weights) {
  let n = 0, sx = 0, sy = 0, sxx = 0, sxy = 0;
  for (let i = 0; i < x.length; i++) {
    n += weights[i];
    sx += weights[i] * x[i];
    sy += weights[i] * y[i];
    sxx += weights[i] * x[i] * x[i];
    sxy += weights[i] * x[i] * y[i];
  }
  if (sxx < 1e-9) return [1, 0];
  const m = n * (1 + STIFFNESS);
  const determinant = sxx * m - sx * sx;
  const offset = clamp((sxx * sy - sx * sxy) / determinant, -MOST_OFFSET, MOST_OFFSET);
  return [clamp((sxy - offset * sx) / sxx, 1 / MOST_GAIN, MOST_GAIN), offset];
}

/** @param {number[]} values */
function median(values) {
  const sorted = values.toSorted((a, b) => a - b);
  return sorted[sorted.length >> 1] ?? 0;
}

/** Scales a colour. @param {Colour} colour @param {number} share 0 none, 1 all of it @returns {Colour} */
function part(colour, share) {
  return {
    gain: colour.gain.map((gain) => 1 + (gain - 1) * share),
    offset: colour.offset.map((offset) => offset * share),
  };
}

/** Applies a colour. @param {number[]} values 3 per cell @param {Colour} colour */
export function coloured(values, { gain, offset }) {
  return values.map((value, i) => clamp(value * gain[i % 3] + offset[i % 3], 0, 1));
}

/** A colour that fades out within `releaseMs`. */
export class Releasing {
  constructor() {
    this._colour = plain;
    this._since = 0;
    this.releaseMs = 0;
  }

  /** @param {Colour} colour @param {number} now ms */
  set(colour, now) {
    this._colour = colour;
    this._since = now;
  }

  get active() {
    return this._colour !== plain;
  }

  /** @param {number} now ms @returns {Colour} */
  at(now) {
    const t = this.releaseMs > 0 ? (now - this._since) / this.releaseMs : 1;
    if (t >= 1) this._colour = plain;
    return this._colour === plain ? plain : part(this._colour, 1 - t * t * (3 - 2 * t));
  }
}
