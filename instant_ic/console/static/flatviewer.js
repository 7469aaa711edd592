// @ts-check
// The view without WebGL: the panorama, pixel by pixel in the same projection as with it, and the rendered view, whose
// direction is exact at the centre.

/** @import { Colour } from "./colour.js" */
/** @import { Scene } from "./images.js" */
/** @import { Samples } from "./viewer.js" */
/** @typedef {CanvasRenderingContext2D | OffscreenCanvasRenderingContext2D} Context */
/** @typedef {{bitmap: ImageBitmap, finished: ImageBitmap | OffscreenCanvas, colour: Colour}} View An image, also in a colour. */

const TURN = 2 * Math.PI;
import { plain } from "./colour.js";
import { context2d, offscreen } from "./dom.js";
import { cells, SAMPLE, SAMPLE_FINE } from "./viewer.js";

export class FlatViewer {
  /** @param {HTMLCanvasElement} canvas */
  constructor(canvas) {
    this.canvas = canvas;
    this.context = context2d(canvas, { alpha: false });
    this.name = "canvas";
    this.slow = true;
    this.busy = false; // renders synchronously
    this.restUntil = 0;
    this.lost = false;
    /** @type {ImageData | null} */
    this._panorama = null;
    /** @type {View | null} */
    this._view = null;
    /** @type {OffscreenCanvasRenderingContext2D | null} */
    this._samples = null;
  }

  /** @param {ImageBitmap} bitmap */
  setPanorama(bitmap) {
    const { width, height } = bitmap, context = offscreen(width, height);
    context.drawImage(bitmap, 0, 0);
    bitmap.close();
    this._panorama = context.getImageData(0, 0, width, height);
  }

  /** @param {ImageBitmap} bitmap */
  setView(bitmap) {
    this._view?.bitmap.close();
    this._view = { bitmap, finished: bitmap, colour: plain };
  }

  /** @param {Scene} scene */
  render(scene) {
    const { width, height } = this.canvas;
    this._render(this.context, width, height, scene, scene.blend);
  }

  /** See GlViewer.sample; the weights are 0 outside the view, else 1. @param {Scene} scene @returns {Samples} */
  sample(scene) {
    const context = this._samples ??= offscreen(SAMPLE[0] * SAMPLE_FINE, SAMPLE[1] * SAMPLE_FINE);
    const { width, height } = context.canvas;
    const raw = { ...scene, panoramaColour: plain, viewColour: plain };
    /** @param {() => void} render */
    const read = (render) => {
      context.clearRect(0, 0, width, height);
      render();
      return cells(context.getImageData(0, 0, width, height).data);
    };
    const panorama = read(() => this._render(context, width, height, raw, 0));
    const view = read(() => this._renderView(context, width, height, raw));
    return { 1: panorama.colours, 2: view.colours, weights: view.alpha.map((alpha) => (alpha > 0.99 ? 1 : 0)) };
  }

  /** @param {Context} context @param {number} width @param {number} height @param {Scene} scene @param {number} blend */
  _render(context, width, height, scene, blend) {
    context.globalAlpha = 1;
    context.fillStyle = "#090b0e";
    context.fillRect(0, 0, width, height);
    if (this._panorama) this._renderPanorama(context, width, height, scene, this._panorama);
    if (this._view && blend > 0) {
      context.globalAlpha = blend;
      this._renderView(context, width, height, scene);
      context.globalAlpha = 1;
    }
  }

  /** @param {Context} context @param {number} width @param {number} height @param {Scene} scene @param {ImageData} panorama */
  _renderPanorama(context, width, height, { panoramaFromLook: m, tanHalf, panoramaColour }, panorama) {
    const [red, green, blue] = levels(panoramaColour), { data, width: columns, height: rows } = panorama;
    const image = context.createImageData(width, height), out = image.data;
    for (let y = 0, to = 0; y < height; y++) {
      const up = (1 - (2 * y + 1) / height) * tanHalf[1];
      for (let x = 0; x < width; x++, to += 4) {
        const left = (1 - (2 * x + 1) / width) * tanHalf[0];
        const ahead = m[0] + m[1] * left + m[2] * up, aside = m[3] + m[4] * left + m[5] * up, high = m[6] + m[7] * left + m[8] * up;
        const column = Math.floor((0.5 - Math.atan2(aside, ahead) / TURN) * columns) % columns;
        const row = Math.floor((0.5 - Math.atan2(high, Math.sqrt(ahead * ahead + aside * aside)) / Math.PI) * rows);
        const from = 4 * (Math.min(row, rows - 1) * columns + column);
        out[to] = red[data[from]];
        out[to + 1] = green[data[from + 1]];
        out[to + 2] = blue[data[from + 2]];
        out[to + 3] = 255;
      }
    }
    context.putImageData(image, 0, 0);
  }

  /** @param {Context} context @param {number} width @param {number} height @param {Scene} scene */
  _renderView(context, width, height, scene) {
    if (!this._view) return;
    // Axis of the rendered view in the look frame (first row of viewFromLook).
    const axis = scene.viewFromLook.slice(0, 3);
    if (axis[0] <= 0.1) return;
    const viewWidth = (width * scene.viewTanHalf[0]) / scene.tanHalf[0];
    const viewHeight = (height * scene.viewTanHalf[1]) / scene.tanHalf[1];
    const x = width / 2 - (axis[1] / axis[0] * width) / 2 / scene.tanHalf[0];
    const y = height / 2 - (axis[2] / axis[0] * height) / 2 / scene.tanHalf[1];
    context.drawImage(finished(this._view, scene.viewColour), x - viewWidth / 2, y - viewHeight / 2, viewWidth, viewHeight);
  }
}

/** Levels 0 to 255 of each channel in a colour. @param {Colour} colour */
const levels = ({ gain, offset }) =>
  gain.map((value, channel) => Uint8ClampedArray.from({ length: 256 }, (_, level) => value * level + 255 * offset[channel]));

/** Returns the image in its colour; cached. @param {View} view @param {Colour} colour */
function finished(view, colour) {
  if (colour === plain) return view.bitmap;
  if (sameColour(view.colour, colour)) return view.finished;
  const { width, height } = view.bitmap;
  const context = offscreen(width, height);
  context.drawImage(view.bitmap, 0, 0);
  const image = context.getImageData(0, 0, width, height), data = image.data;
  for (let i = 0; i < data.length; i += 4)
    for (let channel = 0; channel < 3; channel++)
      data[i + channel] = data[i + channel] * colour.gain[channel] + 255 * colour.offset[channel]; // Uint8ClampedArray clamps
  context.putImageData(image, 0, 0);
  view.colour = colour;
  return view.finished = context.canvas;
}

/** @param {Colour} a @param {Colour} b */
const sameColour = (a, b) =>
  a.gain.every((gain, i) => Math.abs(gain - b.gain[i]) < 0.004) &&
  a.offset.every((offset, i) => Math.abs(offset - b.offset[i]) < 0.002);
