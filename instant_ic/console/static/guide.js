// @ts-check
// The predicted trajectory as a ribbon on the floor, and the compass tape.

/** @import { Mat3, Vec3 } from "./math.js" */
import { attribute, byId } from "./dom.js";
import { degrees, rotate, wrapAngle } from "./math.js";

const NEAREST_M = 0.25;
const REACH_M = 4; // the trajectory is extended to this length, because the nearby floor is out of view
const STEP_M = 0.1;
const COMPASS_PIXELS = 1.6; // per degree, as in style.css

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
 * Shows the predicted trajectory as a ribbon on the floor, as the shown camera would see it.
 * @param {[number, number][]} trajectory points in the map frame, m @param {{lookFromMap: Mat3, position: Vec3}} camera
 * @param {[number, number]} tanHalf of the shown field of view @param {number} halfWidth m
 */
export function showGuide(trajectory, camera, tanHalf, halfWidth) {
  const { left, right } = projected(trajectory, camera, tanHalf, halfWidth), ends = [...left.slice(-1), ...right.slice(-1)];
  attribute("guide-rails", "d", left.length < 2 ? "" : `M${left.join(" ")}M${right.join(" ")}`);
  attribute("guide-floor", "points", [...left, ...right.toReversed()].join(" "));
  attribute("guide-fade", "y1", String(innerHeight));
  attribute("guide-fade", "y2", String(Math.min(innerHeight, ...ends.map(([, y]) => y))));
}

/** Turns the tape of directions to `lookYaw`; 0 is straight ahead of the robot. @param {number} lookYaw */
export function showCompass(lookYaw) {
  byId("compass-tape").style.translate = `${(degrees(lookYaw) * COMPASS_PIXELS).toFixed(1)}px`;
}

/**
 * Returns both rails of the ribbon in pixels of the window; empty if out of view.
 * @param {[number, number][]} trajectory @param {{lookFromMap: Mat3, position: Vec3}} camera
 * @param {[number, number]} tanHalf @param {number} halfWidth
 */
function projected(trajectory, camera, tanHalf, halfWidth) {
  /** @param {number} x @param {number} y */
  const project = (x, y) => {
    const p = rotate(camera.lookFromMap, [x - camera.position[0], y - camera.position[1], -camera.position[2]]);
    if (p[0] < NEAREST_M) return null;
    return [
      Math.round(innerWidth * (5 - 5 * p[1] / p[0] / tanHalf[0])) / 10,
      Math.round(innerHeight * (5 - 5 * p[2] / p[0] / tanHalf[1])) / 10,
    ];
  };
  /** @type {number[][]} */
  const left = [], /** @type {number[][]} */ right = [], points = extended(trajectory);
  points.forEach(([x, y], i) => {
    const before = points[Math.max(i - 1, 0)], after = points[Math.min(i + 1, points.length - 1)];
    const length = Math.hypot(after[0] - before[0], after[1] - before[1]);
    if (length < 1e-4) return;
    const nx = (-(after[1] - before[1]) / length) * halfWidth, ny = ((after[0] - before[0]) / length) * halfWidth;
    const l = project(x + nx, y + ny), r = project(x - nx, y - ny);
    if (!l || !r) return;
    left.push(l);
    right.push(r);
  });
  return { left, right };
}
