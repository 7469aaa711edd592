// @ts-check
// An exported virtual space: look round and walk. Runs from one file, without a server (ic console export-scene).

/** @import { Layer } from "./layers.js" */
/** @import { Vec3 } from "./math.js" */
import { plain } from "./colour.js";
import { elementOf, byId } from "./dom.js";
import { LayerRenderer } from "./layers.js";
import { Look } from "./look.js";
import { clamp, fromQuaternion, lookRotation, multiply, rotate } from "./math.js";

const SPEED_M_S = 0.8;
/** @type {Record<string, [number, number]>} Forward, left. */
const KEYS = {
  KeyW: [1, 0], KeyS: [-1, 0], KeyA: [0, 1], KeyD: [0, -1],
  ArrowUp: [1, 0], ArrowDown: [-1, 0], ArrowLeft: [0, 1], ArrowRight: [0, -1],
};

/** @param {string} text base64 */
const bytes = (text) => Uint8Array.from(atob(text), (letter) => letter.charCodeAt(0));

/** @param {string} text base64 image */
const decoded = (text) => createImageBitmap(new Blob([bytes(text)]), { colorSpaceConversion: "none" });

async function run() {
  const canvas = elementOf("scene", HTMLCanvasElement);
  const gl = canvas.getContext("webgl2", { alpha: false, antialias: true, stencil: true });
  if (!gl) throw new Error("this browser has no WebGL 2");
  const scene = JSON.parse(byId("data").textContent ?? "");
  byId("title").textContent = scene.title;
  /** @type {Layer[]} */
  const layers = await Promise.all(scene.layers.map(async (/** @type {Record<string, any>} */ layer) => ({
    surface: {
      image: await decoded(layer.image),
      confidence: layer.confidence ? await decoded(layer.confidence) : null,
      size: layer.size,
      corners: new Uint16Array(bytes(layer.corners).buffer),
      inverse: new Float32Array(bytes(layer.inverse).buffer),
      triangles: new Uint32Array(bytes(layer.triangles).buffer),
    },
    gain: layer.gain,
    mapFromCamera: fromQuaternion(layer.q),
    position: layer.p,
  })));
  const [{ mapFromCamera, position: start }] = layers;
  const renderer = new LayerRenderer(gl, false);
  renderer.load(layers);
  const look = new Look(canvas);
  /** @type {Set<string>} */
  const held = new Set();
  /** @type {Vec3} In the map frame. */
  let place = start;
  let before = performance.now();
  /** @param {number} now */
  const frame = (now) => {
    requestAnimationFrame(frame);
    const seconds = clamp((now - before) / 1000, 0, 0.1);
    before = now;
    look.step(seconds);
    const [forward, left] = [...held].map((key) => KEYS[key]).reduce((a, b) => [a[0] + b[0], a[1] + b[1]], [0, 0]);
    const way = SPEED_M_S * seconds;
    const ahead = multiply(mapFromCamera, lookRotation(look.yaw, 0));
    const [x, y] = rotate(ahead, [way * clamp(forward, -1, 1), way * clamp(left, -1, 1), 0]);
    place = [place[0] + x, place[1] + y, place[2]];
    const width = Math.round(canvas.clientWidth * devicePixelRatio);
    const height = Math.round(canvas.clientHeight * devicePixelRatio);
    const key = [...place, look.yaw, look.pitch, look.vfov, width, height].join();
    if (canvas.dataset.drawn === key) return;
    canvas.dataset.drawn = key;
    canvas.width = width;
    canvas.height = height;
    const tan = Math.tan(look.vfov / 2), mapFromLook = multiply(mapFromCamera, lookRotation(look.yaw, look.pitch));
    renderer.render({ mapFromLook, position: place, tanHalf: [tan * width / Math.max(height, 1), tan] }, width, height, plain);
  };
  addEventListener("keydown", (event) => {
    if (event.ctrlKey || event.metaKey || event.altKey) return;
    if (event.code === "Home") {
      place = start;
      look.centre();
    } else if (Object.hasOwn(KEYS, event.code)) held.add(event.code);
    else return;
    event.preventDefault();
  });
  addEventListener("keyup", (event) => held.delete(event.code));
  addEventListener("blur", () => held.clear());
  requestAnimationFrame(frame);
}

run().catch((error) => { byId("title").textContent = `The virtual space cannot be shown: ${error.message}`; });
