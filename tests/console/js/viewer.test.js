// Geometry of the view: directions, motion and the trajectory's extension.

import assert from "node:assert/strict";
import { test } from "node:test";
import "./page.js";

const math = await import("../../../instant_ic/console/static/math.js");
const { extended } = await import("../../../instant_ic/console/static/guide.js");
const { Motion } = await import("../../../instant_ic/console/static/motion.js");
const { ServerClock } = await import("../../../instant_ic/console/static/clock.js");

function close(found, expected, tolerance = 1e-9) {
  assert.equal(found.length, expected.length);
  found.forEach((value, i) => assert.ok(Math.abs(value - expected[i]) <= tolerance, `${found} instead of ${expected}`));
}

test("the line of sight turns left by yaw and up by pitch", () => {
  close(math.rotate(math.lookRotation(Math.PI / 2, 0), [1, 0, 0]), [0, 1, 0]);
  close(math.rotate(math.lookRotation(0, Math.PI / 6), [1, 0, 0]), [Math.cos(Math.PI / 6), 0, 0.5]);
});

test("a quaternion about z is the rotation about z", () => {
  const half = 0.35;
  close(math.fromQuaternion([0, 0, Math.sin(half), Math.cos(half)]), math.rotationZ(0.7));
  close(math.multiply(math.rotationZ(0.7), math.transpose(math.rotationZ(0.7))), math.identity);
});

test("angles wrap into a half turn to either side", () => {
  close([3 * Math.PI / 2, -3 * Math.PI / 2, 0.1 + 4 * Math.PI].map(math.wrapAngle), [-Math.PI / 2, Math.PI / 2, 0.1]);
});

test("a straight trajectory is extended straight to four metres, a bent one along its arc", () => {
  const line = Array.from({ length: 11 }, (_, i) => [0.05 * i, 1]);
  const [x, y] = extended(line).at(-1);
  assert.ok(x > 3.9 && x < 4.2 && Math.abs(y - 1) < 1e-9);
  const arc = Array.from({ length: 11 }, (_, i) => [2 * Math.sin(0.05 * i), 2 - 2 * Math.cos(0.05 * i)]); // radius 2 m
  for (const [px, py] of extended(arc)) assert.ok(Math.abs(Math.hypot(px, py - 2) - 2) < 0.06);
  assert.equal(extended([[0, 0], [0.1, 0]]).length, 2); // too short to have a direction
});

test("the shown pose runs on with the velocity and eases the other robot's offset out", () => {
  const motion = new Motion();
  motion.easeMs = 400;
  motion.follow("real", [0, 0, 0], [0.4, 0], 0, 16);
  motion.follow("real", [0, 0, 0], [0.4, 0], 100, 16); // a state 0.1 s old
  assert.ok(motion.pose[0] > 0 && motion.pose[0] <= 0.04);
  motion.follow("virtual", [0.2, 0, 0], [0, 0], 0, 16);
  assert.ok(motion.pose[0] < 0.06, "no jump at the switch");
  for (let i = 0; i < 60; i++) motion.follow("virtual", [0.2, 0, 0], [0, 0], 0, 16);
  close(motion.pose, [0.2, 0, 0], 1e-3);
  motion.follow("real", [3, 0, 0], [0, 0], 0, 16);
  close(motion.pose, [3, 0, 0]); // another place: a cut
});

test("the server's clock follows the fastest answer, and the quality the slow ones", () => {
  const clock = new ServerClock();
  assert.equal(clock.at(0), null);
  clock.take(100, 1000, 300); // 200 ms: offset 1000 + 100 - 300
  assert.equal(clock.at(300), 1100);
  clock.take(300, 1110, 310); // 10 ms: offset 1110 + 5 - 310
  clock.take(400, 1400, 600); // slow again: changes nothing
  assert.equal(clock.at(600), 1405);
  assert.equal(clock.roundTripMs, 200);
  assert.equal(clock.quality, null);
  for (let i = 0; i < 60; i++) clock.take(0, 0, 20);
  assert.equal(clock.quality, "good");
  for (let i = 0; i < 10; i++) clock.take(0, 0, 300);
  assert.equal(clock.quality, "fair");
  for (let i = 0; i < 40; i++) clock.take(0, 0, 500);
  assert.equal(clock.quality, "poor");
  clock.reset();
  assert.equal(clock.at(0), null);
});
