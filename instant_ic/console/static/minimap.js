// @ts-check
// Map in the corner: walls, costs, both robots, path, subgoal and predicted trajectory.

/** @import { GridHeader, Plan } from "./messages.js" */
/** @import { Vec3 } from "./math.js" */
import { byId, context2d } from "./dom.js";

/** @typedef {{image: HTMLCanvasElement, header: GridHeader}} Layer */
/**
 * @typedef {object} MapScene
 * @property {boolean} virtual whether the v-bot is shown
 * @property {Vec3 | null} robot x, y, yaw
 * @property {Vec3 | null} vbot
 * @property {Pick<Plan, "trajectory" | "path" | "subgoal">} plan
 * @property {[number, number]} footprint length, width
 * @property {number} lookYaw
 * @property {number} hfov
 */

const COLOURS = { real: "#45c4b0", virtual: "#f0ac45", path: "#8fb8ff", goal: "#ffffff" };
const RADIUS_M = 3.5; // half the width shown in the small map
const CONE_M = 1.7; // length of the shown cone of sight

export class MiniMap {
  /** @param {HTMLCanvasElement} canvas */
  constructor(canvas) {
    this.canvas = canvas;
    this.context = context2d(canvas);
    this.large = false;
    this.changed = true; // render although no pose has changed
    /** @type {{costmap: Layer | null, map: Layer | null}} In the order of rendering. */
    this._layers = { costmap: null, map: null };
  }

  /** Sets a layer of grey cells (gridimage.py). @param {"map" | "costmap"} name @param {ImageBitmap} bitmap @param {GridHeader} header */
  setLayer(name, bitmap, header) {
    this.changed = true;
    this._layers[name] = { image: coloured(bitmap, name === "map" ? mapColour : costColour), header };
  }

  get hasMap() {
    return this._layers.map !== null;
  }

  /** @param {MapScene} scene */
  draw({ virtual, robot, vbot, plan, footprint, lookYaw, hfov }) {
    this.changed = false;
    const { context, canvas } = this, shown = virtual ? vbot ?? robot : robot ?? vbot;
    context.reset();
    byId("map-empty").hidden = shown !== null;
    if (!shown) return;
    const scale = this._place(shown, canvas.width, canvas.height), pixel = 1 / scale;
    for (const layer of Object.values(this._layers)) if (layer) this._drawLayer(layer);
    this._cone(shown, shown[2] + lookYaw, hfov / 2);
    this._line(plan.path, COLOURS.path, 2 * pixel, [6 * pixel, 5 * pixel]);
    this._line(plan.trajectory, virtual ? COLOURS.virtual : COLOURS.real, 3 * pixel, []);
    if (plan.subgoal) this._goal(plan.subgoal, pixel);
    if (robot) this._robot(robot, footprint, COLOURS.real, pixel, true);
    if (vbot && virtual) this._robot(vbot, footprint, COLOURS.virtual, pixel, false);
  }

  /**
   * Scales the canvas to metres and returns pixels per metre. Small: heading up; large: north up with the whole map.
   * @param {Vec3} shown @param {number} width @param {number} height
   */
  _place([x, y, yaw], width, height) {
    const context = this.context;
    if (this.large && this._layers.map) {
      const { header } = this._layers.map;
      const w = header.width * header.resolution, h = header.height * header.resolution;
      const scale = Math.min(width / (w + 1), height / (h + 1));
      context.translate(width / 2, height / 2);
      context.scale(scale, -scale);
      context.translate(-(header.x + w / 2), -(header.y + h / 2));
      return scale;
    }
    const scale = Math.min(width, height) / (2 * RADIUS_M);
    context.translate(width / 2, height * 0.6);
    context.scale(scale, -scale);
    context.rotate(Math.PI / 2 - yaw);
    context.translate(-x, -y);
    return scale;
  }

  /** @param {Layer} layer */
  _drawLayer({ image, header }) {
    const context = this.context;
    const h = header.height * header.resolution;
    context.save();
    context.imageSmoothingEnabled = false;
    context.translate(header.x, header.y + h);
    context.scale(header.resolution, -header.resolution);
    context.drawImage(image, 0, 0);
    context.restore();
  }

  /** @param {[number, number][]} points @param {string} colour @param {number} width m @param {number[]} dash */
  _line(points, colour, width, dash) {
    const context = this.context;
    context.strokeStyle = colour;
    context.lineWidth = width;
    context.lineJoin = context.lineCap = "round";
    context.setLineDash(dash);
    context.beginPath();
    for (const [x, y] of points) context.lineTo(x, y);
    context.stroke();
  }

  /** @param {Vec3} goal @param {number} pixel m */
  _goal([x, y], pixel) {
    const context = this.context;
    context.strokeStyle = COLOURS.goal;
    context.lineWidth = 2 * pixel;
    for (const radius of [6, 1.5]) {
      context.beginPath();
      context.arc(x, y, radius * pixel, 0, 2 * Math.PI);
      context.stroke();
    }
  }

  /** The shown part of the surroundings. @param {Vec3} pose @param {number} middle direction @param {number} half angle */
  _cone([x, y], middle, half) {
    const context = this.context, gradient = context.createRadialGradient(x, y, 0, x, y, CONE_M);
    gradient.addColorStop(0, "rgba(255,255,255,0.28)");
    gradient.addColorStop(1, "rgba(255,255,255,0)");
    context.fillStyle = gradient;
    context.beginPath();
    context.moveTo(x, y);
    context.arc(x, y, CONE_M, middle - half, middle + half);
    context.fill();
  }

  /** @param {Vec3} pose @param {[number, number]} footprint @param {string} colour @param {number} pixel @param {boolean} solid */
  _robot([x, y, yaw], [length, width], colour, pixel, solid) {
    const context = this.context;
    context.save();
    context.translate(x, y);
    context.rotate(yaw);
    context.lineWidth = 2 * pixel;
    context.strokeStyle = colour;
    context.fillStyle = solid ? colour : "rgba(240,172,69,0.22)";
    if (!solid) context.setLineDash([4 * pixel, 3 * pixel]);
    context.beginPath();
    context.roundRect(-length / 2, -width / 2, length, width, 0.08);
    context.fill();
    context.stroke();
    context.setLineDash([]);
    // The triangle shows the heading.
    context.fillStyle = solid ? "#0b0e12" : colour;
    context.beginPath();
    context.moveTo(length * 0.36, 0);
    context.lineTo(-length * 0.05, width * 0.27);
    context.lineTo(-length * 0.05, -width * 0.27);
    context.fill();
    context.restore();
  }
}

/** @param {ImageBitmap} bitmap @param {(cell: number) => number[]} colour of a cell */
function coloured(bitmap, colour) {
  const image = document.createElement("canvas");
  image.width = bitmap.width;
  image.height = bitmap.height;
  const context = context2d(image, { willReadFrequently: true });
  context.drawImage(bitmap, 0, 0);
  const cells = context.getImageData(0, 0, image.width, image.height);
  for (let i = 0; i < cells.data.length; i += 4) cells.data.set(colour(cells.data[i]), i);
  context.putImageData(cells, 0, 0);
  return image;
}

// Colours [r, g, b, alpha] of a cell: 0..100, 255 unknown.
/** Floor and walls. @param {number} cell */
const mapColour = (cell) => (cell < 50 ? [150, 165, 180, 70 - cell] : cell <= 100 ? [226, 232, 238, 120 + 1.3 * cell] : [0, 0, 0, 0]);
/** @param {number} cell */
const costColour = (cell) => (cell <= 100 ? [255, 110, 80, 0.6 * cell] : [0, 0, 0, 0]);
