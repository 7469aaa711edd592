// @ts-check
// Saving the view as a file on the operator's machine.

import { toast } from "./hud.js";

/**
 * Saves the shown view without the overlay, at the window's full resolution. `render` renders the view into the canvas.
 * @param {HTMLCanvasElement} canvas @param {() => void} render
 */
export function saveView(canvas, render) {
  const { width, height } = canvas;
  canvas.width = Math.round(canvas.clientWidth * devicePixelRatio);
  canvas.height = Math.round(canvas.clientHeight * devicePixelRatio);
  const stamp = new Date().toLocaleString("sv").replaceAll(/[-:]/g, "").replace(" ", "_"); // Swedish time is ISO 8601
  render(); // needed here, because WebGL discards an image after the task that rendered it
  canvas.toBlob((blob) => {
    if (blob) download(blob, `view_${stamp}.png`);
    else toast("The view was not saved: the browser could not encode the image.");
  }, "image/png");
  canvas.width = width;
  canvas.height = height;
  render();
}

/** @param {Blob} blob @param {string} name */
function download(blob, name) {
  const link = document.createElement("a");
  link.href = URL.createObjectURL(blob);
  link.download = name;
  link.click();
  setTimeout(() => URL.revokeObjectURL(link.href), 10_000);
  toast(`Saved: ${name}`);
}
