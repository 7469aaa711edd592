// @ts-check
// The map in the corner: two grids, and over them an SVG in metres with both robots, path, subgoal and predicted trajectory.

/** @import { GridHeader, Plan } from "./messages.js" */
/** @import { Vec3 } from "./math.js" */
import { attribute, byId, context2d, elementOf } from "./dom.js";
import { degrees } from "./math.js";

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
/** @typedef {"cost-grid" | "map-grid"} GridName Ids of their canvases. */

const RADIUS_M = 3.5; // half the width shown in the small map
const CONE_M = 1.7; // length of the cone of sight

export class MiniMap {
  constructor() {
    this.large = false;
    /** @type {Map<GridName, GridHeader>} */
    this._grids = new Map();
  }

  /** Sets a grid of grey cells (gridimage.py). @param {GridName} name @param {ImageBitmap} bitmap @param {GridHeader} header */
  setGrid(name, bitmap, header) {
    this._grids.set(name, header);
    colour(elementOf(name, HTMLCanvasElement), bitmap, name === "map-grid" ? mapColour : costColour);
  }

  get hasMap() {
    return this._grids.has("map-grid");
  }

  /** @param {MapScene} scene */
  show({ virtual, robot, vbot, plan, footprint, lookYaw, hfov }) {
    const shown = virtual ? vbot ?? robot : robot ?? vbot;
    byId("map-empty").hidden = shown !== null;
    if (!shown) return;
    const world = this._pixelsFromMap(shown);
    for (const [name, { x, y, height, resolution }] of this._grids) {
      const top = y + height * resolution;
      byId(name).style.transform = `${world} translate(${x}px, ${top}px) scale(${resolution}, ${-resolution})`;
    }
    attribute("map-world", "transform", world);
    attribute("map-path", "points", plan.path.join(" "));
    attribute("map-trajectory", "points", plan.trajectory.join(" "));
    const side = CONE_M * Math.sin(hfov / 2), ahead = CONE_M * Math.cos(hfov / 2);
    attribute("map-cone", "d", `M0 0L${ahead} ${-side}A${CONE_M} ${CONE_M} 0 0 1 ${ahead} ${side}`);
    place("map-cone", [shown[0], shown[1], shown[2] + lookYaw]);
    place("map-robot", robot, footprint);
    place("map-vbot", virtual ? vbot : null, footprint);
    place("map-goal", plan.subgoal);
  }

  /**
   * Returns the transform from the map frame to pixels of the element. The small map has the heading up; the large one shows
   * the whole map with north up.
   * @param {Vec3} shown
   */
  _pixelsFromMap([x, y, yaw]) {
    const { clientWidth: width, clientHeight: height } = byId("map"), grid = this._grids.get("map-grid");
    if (this.large && grid) {
      const w = grid.width * grid.resolution, h = grid.height * grid.resolution, scale = Math.min(width / (w + 1), height / (h + 1));
      return matrix(scale, 0, [grid.x + w / 2, grid.y + h / 2], [width / 2, height / 2]);
    }
    return matrix(Math.min(width, height) / (2 * RADIUS_M), Math.PI / 2 - yaw, [x, y], [width / 2, height * 0.6]);
  }
}

/**
 * Returns a transform from the map, whose y axis points up, to pixels. It turns by `angle` and shows `place` at `pixel`.
 * @param {number} scale @param {number} angle @param {[number, number]} place @param {[number, number]} pixel
 */
function matrix(scale, angle, [x, y], [column, row]) {
  const c = scale * Math.cos(angle), s = scale * Math.sin(angle);
  return `matrix(${c}, ${-s}, ${-s}, ${-c}, ${column - c * x + s * y}, ${row + s * x + c * y})`;
}

/** Moves a mark of the map, or hides it if it has no pose. @param {string} id @param {Vec3 | null} pose @param {[number, number]} size m */
function place(id, pose, size = [1, 1]) {
  byId(id).toggleAttribute("hidden", pose === null);
  if (pose) attribute(id, "transform", `translate(${pose[0]} ${pose[1]}) rotate(${degrees(pose[2])}) scale(${size})`);
}

/** @param {HTMLCanvasElement} canvas @param {ImageBitmap} bitmap @param {(cell: number) => number[]} colourOf [r, g, b, alpha] of a cell */
function colour(canvas, bitmap, colourOf) {
  const { width, height } = Object.assign(canvas, { width: bitmap.width, height: bitmap.height });
  const context = context2d(canvas, { willReadFrequently: true });
  context.drawImage(bitmap, 0, 0);
  const cells = context.getImageData(0, 0, width, height);
  for (let i = 0; i < cells.data.length; i += 4) cells.data.set(colourOf(cells.data[i]), i);
  context.putImageData(cells, 0, 0);
}

/** Returns the colour of floor and walls. @param {number} cell 0 to 100; 255: unknown */
const mapColour = (cell) => (cell < 50 ? [150, 165, 180, 70 - cell] : cell <= 100 ? [226, 232, 238, 120 + 1.3 * cell] : [0, 0, 0, 0]);
/** @param {number} cell the same */
const costColour = (cell) => (cell <= 100 ? [255, 110, 80, 0.6 * cell] : [0, 0, 0, 0]);
