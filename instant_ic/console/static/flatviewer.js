// The feedback picture without WebGL: a crop of the panorama (cylinder in place of a plane, so lines bend
// a little), and the rendered view moved and scaled. Aims right in the middle of the picture.

import { rotate } from "./math.js";

export class FlatViewer {
  constructor(canvas) {
    this.canvas = canvas;
    this.context = canvas.getContext("2d", { alpha: false });
    this.name = "canvas";
    this.slow = true;
    this.lost = false;
    this._panorama = null;
    this._view = null;
  }

  setPanorama(bitmap) {
    this._panorama?.close();
    this._panorama = bitmap;
  }

  setView(bitmap) {
    this._view?.close();
    this._view = bitmap;
  }

  draw(scene) {
    const context = this.context;
    context.globalAlpha = 1;
    context.fillStyle = "#090b0e";
    context.fillRect(0, 0, this.canvas.width, this.canvas.height);
    if (this._panorama) this._drawPanorama(scene);
    if (this._view && scene.blend > 0) {
      context.globalAlpha = scene.blend;
      this._drawView(scene);
      context.globalAlpha = 1;
    }
  }

  _drawPanorama(scene) {
    const { width, height } = this.canvas, image = this._panorama;
    const [x, y, z] = rotate(scene.panoramaFromLook, [1, 0, 0]);
    const centreU = 0.5 - Math.atan2(y, x) / (2 * Math.PI);
    const centreV = 0.5 - Math.asin(z) / Math.PI;
    const spanU = Math.atan(scene.tanHalf[0]) / Math.PI;
    const spanV = (2 * Math.atan(scene.tanHalf[1])) / Math.PI;
    // The whole turn, repeated on both sides, so that the seam needs no special case.
    const turn = width / spanU, sheet = height / spanV;
    const top = height / 2 - centreV * sheet;
    for (const shift of [-1, 0, 1])
      this.context.drawImage(image, width / 2 - (centreU + shift) * turn, top, turn, sheet);
  }

  _drawView(scene) {
    const { width, height } = this.canvas;
    // Where the rendered view's axis stands in the look frame (viewFromLook's first row).
    const axis = scene.viewFromLook.slice(0, 3);
    if (axis[0] <= 0.1) return;
    const viewWidth = (width * scene.viewTanHalf[0]) / scene.tanHalf[0];
    const viewHeight = (height * scene.viewTanHalf[1]) / scene.tanHalf[1];
    const x = width / 2 - ((axis[1] / axis[0]) * width) / 2 / scene.tanHalf[0];
    const y = height / 2 - ((axis[2] / axis[0]) * height) / 2 / scene.tanHalf[1];
    this.context.drawImage(this._view, x - viewWidth / 2, y - viewHeight / 2, viewWidth, viewHeight);
  }
}
