// @ts-check
// The predicted trajectory as a ribbon on the floor, and the compass tape.

/** @import { Mat3, Vec3 } from "./math.js" */
import { context2d } from "./dom.js";
import { degrees, rotate, wrapAngle } from "./math.js";

/** @type {Record<number, string>} Degrees to the right. */
const NAMES = { 0: "AHEAD", 90: "RIGHT", "-90": "LEFT", "-180": "BEHIND" };
const NEAREST_M = 0.25;
const REACH_M = 4; // the nearby floor is out of view, so the arc is extended to here
const STEP_M = 0.1;
const TILE = 64; // pixels of the window; the canvas covers whole tiles, so that its size seldom changes
const RAIL = 2.5; // width, pixels of the window

/**
 * Returns `points`, extended along the arc of their last bend to REACH_M from the start.
 * @param {[number, number][]} points @returns {[number, number][]}
 */
export function extended(points) {
  let length = 0;
  for (let i = 1; i < points.length; i++)
    length += Math.hypot(points[i][0] - points[i - 1][0], points[i][1] - points[i - 1][1]);
  if (length < 0.15) return points;
  const n = points.length, from = points[Math.max(0, n - 9)], middle = points[Math.max(0, n - 5)], end = points[n - 1];
  const first = Math.atan2(middle[1] - from[1], middle[0] - from[0]);
  const last = Math.atan2(end[1] - middle[1], end[0] - middle[0]);
  const apart = (Math.hypot(middle[0] - from[0], middle[1] - from[1]) + Math.hypot(end[0] - middle[0], end[1] - middle[1])) / 2;
  const bend = n < 3 || apart < 1e-3 ? 0 : wrapAngle(last - first) / apart;
  const result = [...points];
  let [x, y] = end, heading = last + (bend * apart) / 2;
  for (; length < REACH_M; length += STEP_M) {
    heading += bend * STEP_M;
    x += Math.cos(heading) * STEP_M;
    y += Math.sin(heading) * STEP_M;
    result.push([x, y]);
  }
  return result;
}

/**
 * Renders `trajectory` (map frame, [[x, y], ...]) on the floor as seen by the shown camera, and fits the canvas around it:
 * on a CPU, a canvas over the whole window would cost as much as the view.
 * @param {HTMLCanvasElement} canvas @param {[number, number][]} trajectory
 * @param {{lookFromMap: Mat3, position: Vec3}} camera @param {[number, number]} tanHalf of the shown field of view
 * @param {number} halfWidth m @param {string} colour
 */
export function drawGuide(canvas, trajectory, camera, tanHalf, halfWidth, colour) {
  const ribbon = trajectory.length < 2 ? null : projected(trajectory, camera, tanHalf, halfWidth);
  canvas.hidden = ribbon === null;
  if (!ribbon) return;
  const { left, right } = ribbon, ratio = Math.min(devicePixelRatio, 2), box = tiles([...left, ...right], innerWidth, innerHeight);
  const context = context2d(canvas);
  Object.assign(canvas.style, { left: `${box.x}px`, top: `${box.y}px`, width: `${box.width}px`, height: `${box.height}px` });
  canvas.width = box.width * ratio; // also clears it
  canvas.height = box.height * ratio;
  context.setTransform(ratio, 0, 0, ratio, -box.x * ratio, -box.y * ratio);
  const near = Math.max(left[0][1], right[0][1]), far = Math.min(left[left.length - 1][1], right[right.length - 1][1]);
  const fade = context.createLinearGradient(0, Math.min(near, innerHeight), 0, far);
  fade.addColorStop(0, `${colour}66`);
  fade.addColorStop(1, `${colour}08`);
  context.fillStyle = fade;
  context.beginPath();
  left.forEach(([x, y], i) => (i ? context.lineTo(x, y) : context.moveTo(x, y)));
  right.toReversed().forEach(([x, y]) => context.lineTo(x, y));
  context.fill();
  context.lineWidth = RAIL;
  context.strokeStyle = `${colour}cc`;
  for (const rail of [left, right]) {
    context.beginPath();
    rail.forEach(([x, y], i) => (i ? context.lineTo(x, y) : context.moveTo(x, y)));
    context.stroke();
  }
}

/**
 * Returns the smallest box of whole tiles around the points within the window, pixels.
 * @param {[number, number][]} points @param {number} width of the window @param {number} height
 */
export function tiles(points, width, height) {
  /** @param {0 | 1} axis @param {number} size */
  const span = (axis, size) => {
    const values = points.map((point) => point[axis]);
    const from = TILE * Math.floor(Math.min(Math.max(Math.min(...values) - RAIL, 0), size) / TILE);
    return [from, Math.min(TILE * Math.ceil(Math.max(...values) / TILE + RAIL / TILE), size)];
  };
  const [x, right] = span(0, width), [y, bottom] = span(1, height);
  return { x, y, width: Math.max(right - x, 0), height: Math.max(bottom - y, 0) };
}

/**
 * Returns both rails of the ribbon in the window, pixels; null if it is out of view.
 * @param {[number, number][]} trajectory @param {{lookFromMap: Mat3, position: Vec3}} camera
 * @param {[number, number]} tanHalf @param {number} halfWidth
 */
function projected(trajectory, camera, tanHalf, halfWidth) {
  /** @param {number} x @param {number} y @returns {[number, number] | null} */
  const project = (x, y) => {
    const p = rotate(camera.lookFromMap, [x - camera.position[0], y - camera.position[1], -camera.position[2]]);
    if (p[0] < NEAREST_M) return null;
    return [
      innerWidth * (0.5 - p[1] / p[0] / tanHalf[0] / 2),
      innerHeight * (0.5 - p[2] / p[0] / tanHalf[1] / 2),
    ];
  };
  trajectory = extended(trajectory);
  /** @type {[number, number][]} */
  const left = [], /** @type {[number, number][]} */ right = [];
  for (let i = 0; i < trajectory.length; i++) {
    const before = trajectory[Math.max(i - 1, 0)], after = trajectory[Math.min(i + 1, trajectory.length - 1)];
    const length = Math.hypot(after[0] - before[0], after[1] - before[1]);
    if (length < 1e-4) continue;
    const nx = (-(after[1] - before[1]) / length) * halfWidth, ny = ((after[0] - before[0]) / length) * halfWidth;
    const [x, y] = trajectory[i];
    const l = project(x + nx, y + ny), r = project(x - nx, y - ny);
    if (l && r) {
      left.push(l);
      right.push(r);
    }
  }
  return left.length < 2 ? null : { left, right };
}

/**
 * Renders a tape of directions relative to the robot: 0 is straight ahead.
 * @param {HTMLCanvasElement} canvas @param {number} lookYaw @param {string} colour
 */
export function drawCompass(canvas, lookYaw, colour) {
  const context = context2d(canvas);
  const { width, height } = canvas, ratio = devicePixelRatio;
  context.clearRect(0, 0, width, height);
  const perDegree = width / 150, look = -degrees(lookYaw); // right is positive on the tape
  context.textAlign = "center";
  context.font = `600 ${11 * ratio}px system-ui, sans-serif`;
  for (let mark = -180; mark < 180; mark += 15) {
    const x = width / 2 + degrees(wrapAngle(((mark - look) * Math.PI) / 180)) * perDegree;
    if (x < 0 || x > width) continue;
    const side = Math.abs(x - width / 2) / (width / 2);
    context.globalAlpha = 1 - side ** 2;
    context.fillStyle = mark === 0 ? colour : "#a3adb8";
    const name = NAMES[mark];
    context.fillRect(x - ratio / 2, height - (mark % 45 ? 7 : 12) * ratio, ratio, (mark % 45 ? 7 : 12) * ratio);
    if (name) context.fillText(name, x, 18 * ratio);
    else if (mark % 45 === 0) context.fillText(`${Math.abs(mark)}°`, x, 18 * ratio);
  }
  context.globalAlpha = 1;
  context.fillStyle = "#fff";
  context.beginPath();
  context.moveTo(width / 2, height - 9 * ratio);
  context.lineTo(width / 2 - 5 * ratio, height);
  context.lineTo(width / 2 + 5 * ratio, height);
  context.fill();
}
