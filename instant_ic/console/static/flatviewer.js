// The view without WebGL: a crop of the panorama (a cylinder instead of a plane, so lines bend slightly), and the
// rendered view, shifted and scaled as a whole when the camera has moved. The direction is exact at the centre.

import { plain } from "./colour.js";
import { rotate } from "./math.js";
import { cells, MOST_PARALLAX, SAMPLE, SAMPLE_FINE } from "./viewer.js";

const SOFT_PIXELS = 16; // of the view per pixel of its blurred copy

export class FlatViewer {
  constructor(canvas) {
    this.canvas = canvas;
    this.context = canvas.getContext("2d", { alpha: false });
    this.name = "canvas";
    this.slow = true;
    this.busy = false; // renders synchronously
    this.lost = false;
    this._panorama = null; // {bitmap, mask, finished, colour}
    this._view = null;
    this._inverse = 0; // mean inverse depth of the view, 1/m; 0: unknown
  }

  setPanorama(bitmap) {
    this._panorama = renewed(this._panorama, bitmap, null);
  }

  /** See GlViewer.setView; only the mean of the depth image is used. */
  setView(bitmap, mask = null, depth = null) {
    this._view = renewed(this._view, bitmap, mask);
    this._inverse = depth ? meanLevel(depth.picture) / depth.near_m : 0;
  }

  draw(scene) {
    const { width, height } = this.canvas;
    this._draw(this.context, width, height, scene, scene.blend);
  }

  /** See GlViewer.sample; the weights are 0 outside the view, else 1. */
  sample(scene) {
    this._sampled ??= new OffscreenCanvas(SAMPLE[0] * SAMPLE_FINE, SAMPLE[1] * SAMPLE_FINE);
    const { width, height } = this._sampled;
    const context = this._sampled.getContext("2d", { willReadFrequently: true });
    const raw = { ...scene, panoramaColour: plain, viewColour: plain };
    const read = (draw) => {
      context.clearRect(0, 0, width, height);
      draw();
      return cells(context.getImageData(0, 0, width, height).data);
    };
    const panorama = read(() => this._draw(context, width, height, raw, 0));
    const view = read(() => this._drawView(context, width, height, raw));
    return { 1: panorama.colours, 2: view.colours, weights: view.alpha.map((alpha) => (alpha > 0.99 ? 1 : 0)) };
  }

  _draw(context, width, height, scene, blend) {
    context.globalAlpha = 1;
    context.fillStyle = "#090b0e";
    context.fillRect(0, 0, width, height);
    if (this._panorama) this._drawPanorama(context, width, height, scene);
    if (this._view && blend > 0) {
      context.globalAlpha = blend;
      this._drawView(context, width, height, scene);
      context.globalAlpha = 1;
    }
  }

  _drawPanorama(context, width, height, scene) {
    const image = finished(this._panorama, scene.panoramaColour);
    const [x, y, z] = rotate(scene.panoramaFromLook, [1, 0, 0]);
    const centreU = 0.5 - Math.atan2(y, x) / (2 * Math.PI);
    const centreV = 0.5 - Math.asin(z) / Math.PI;
    const spanU = Math.atan(scene.tanHalf[0]) / Math.PI;
    const spanV = (2 * Math.atan(scene.tanHalf[1])) / Math.PI;
    // The full panorama, repeated on both sides, so that the seam needs no special case.
    const turn = width / spanU, sheet = height / spanV;
    const top = height / 2 - centreV * sheet;
    for (const shift of [-1, 0, 1])
      context.drawImage(image, width / 2 - (centreU + shift) * turn, top, turn, sheet);
  }

  _drawView(context, width, height, scene) {
    // Axis of the rendered view in the look frame (first row of viewFromLook).
    const axis = scene.viewFromLook.slice(0, 3);
    if (axis[0] <= 0.1) return;
    const [forward, left, up] = scene.moved ?? [0, 0, 0];
    const inverse = Math.min(this._inverse, MOST_PARALLAX / Math.max(Math.hypot(forward, left, up), 1e-9));
    const nearer = 1 / (1 - forward * inverse);
    const viewWidth = (nearer * width * scene.viewTanHalf[0]) / scene.tanHalf[0];
    const viewHeight = (nearer * height * scene.viewTanHalf[1]) / scene.tanHalf[1];
    const aside = (value, moved) => value / axis[0] - moved * inverse * nearer;
    const x = width / 2 - (aside(axis[1], left) * width) / 2 / scene.tanHalf[0];
    const y = height / 2 - (aside(axis[2], up) * height) / 2 / scene.tanHalf[1];
    context.drawImage(finished(this._view, scene.viewColour), x - viewWidth / 2, y - viewHeight / 2, viewWidth, viewHeight);
  }
}

/** Mean level of a grey image, 0..1. */
function meanLevel(picture) {
  const context = new OffscreenCanvas(picture.width, picture.height).getContext("2d", { willReadFrequently: true });
  context.drawImage(picture, 0, 0);
  const { data } = context.getImageData(0, 0, picture.width, picture.height);
  let total = 0;
  for (let i = 0; i < data.length; i += 4) total += data[i];
  return total / (255 * data.length / 4);
}

function renewed(old, bitmap, mask) {
  old?.bitmap.close();
  return { bitmap, mask, finished: null, colour: plain };
}

/** Returns the image in its colour, blurred where the mask marks unseen places; cached for each image and colour. */
function finished(picture, colour) {
  if (!picture.mask && colour === plain) return picture.bitmap;
  if (picture.finished && sameColour(picture.colour, colour)) return picture.finished;
  const { width, height } = picture.bitmap;
  const canvas = new OffscreenCanvas(width, height);
  const context = canvas.getContext("2d", { willReadFrequently: true });
  context.imageSmoothingQuality = "high";
  const pixels = (image) => {
    context.drawImage(image, 0, 0, width, height);
    return context.getImageData(0, 0, width, height);
  };
  const image = pixels(picture.bitmap), data = image.data;
  if (picture.mask) soften(data, pixels(blurred(picture.bitmap)).data, pixels(picture.mask).data);
  for (let i = 0; i < data.length; i += 4)
    for (let channel = 0; channel < 3; channel++)
      data[i + channel] = data[i + channel] * colour.gain[channel] + 255 * colour.offset[channel]; // Uint8ClampedArray clamps
  context.putImageData(image, 0, 0);
  picture.finished = canvas;
  picture.colour = colour;
  return canvas;
}

const sameColour = (a, b) =>
  a.gain.every((gain, i) => Math.abs(gain - b.gain[i]) < 0.004) &&
  a.offset.every((offset, i) => Math.abs(offset - b.offset[i]) < 0.002);

function blurred(bitmap) {
  const small = new OffscreenCanvas(Math.ceil(bitmap.width / SOFT_PIXELS), Math.ceil(bitmap.height / SOFT_PIXELS));
  const context = small.getContext("2d");
  context.imageSmoothingQuality = "high";
  context.drawImage(bitmap, 0, 0, small.width, small.height);
  return small;
}

/** Blends in the blurred, paler image where the mask is dark. */
function soften(data, soft, mask) {
  for (let i = 0; i < data.length; i += 4) {
    const seen = mask[i] / 255;
    if (seen > 0.996) continue;
    const grey = 0.3 * soft[i] + 0.59 * soft[i + 1] + 0.11 * soft[i + 2];
    for (let channel = 0; channel < 3; channel++)
      data[i + channel] = seen * data[i + channel] + (1 - seen) * (soft[i + channel] + grey) / 2;
  }
}
