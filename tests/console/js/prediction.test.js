// The v-bot at render time, from a state message and what was commanded since.

import assert from "node:assert/strict";
import { beforeEach, test } from "node:test";

const { Prediction } = await import("../../../instant_ic/console/static/prediction.js");

/** @type {InstanceType<typeof Prediction>} */
let prediction;
const REST = [0, 0];

beforeEach(() => {
  prediction = new Prediction();
  prediction.maxAccel = [0.8, 2];
});

const close = (found, expected) => assert.ok(Math.abs(found - expected) < 1e-3, `${found} instead of ${expected}`);

test("without a command of this page the robot goes on as the state says", () => {
  const { pose, twist } = prediction.from([1, 2, Math.PI / 2], [0.3, 0], 1000, 1100, 20);
  close(pose[0], 1);
  close(pose[1], 2 + 0.3 * 0.12); // also for the time that a command takes
  assert.deepEqual(twist, [0.3, 0]);
});

test("a key acts at once, with the robot's acceleration and no more than the command", () => {
  prediction.command([0.2, 0], 1000);
  let { pose, twist } = prediction.from([0, 0, 0], REST, 1000, 1100, 0);
  close(pose[0], 0.4 * 0.1 ** 2); // a t² / 2
  close(twist[0], 0.08);
  ({ pose, twist } = prediction.from([0, 0, 0], [0.19, 0], 1000, 1200, 0));
  assert.equal(twist[0], 0.2);
  close(pose[0], 0.04);
  prediction.command(REST, 1200); // released: it brakes
  close(prediction.from([0, 0, 0], [0.2, 0], 1200, 1300, 0).twist[0], 0.12);
  prediction.command([0, 0.8], 1300);
  close(prediction.from([0, 0, 0], REST, 1300, 1400, 0).pose[2], 0.01); // 2 rad/s² for 0.1 s
});

test("what was sent before the state by less than the delay of a command is not in it yet", () => {
  prediction.command([0.4, 0], 980);
  close(prediction.from([0, 0, 0], REST, 1000, 1000, 30).twist[0], 0.8 * 0.02);
  close(prediction.from([0, 0, 0], REST, 1000, 1000, 0).twist[0], 0);
});

test("a robot that is slower than its command, at a wall or because it leads too far, stays as slow", () => {
  prediction.command([0.4, 0], 1000);
  const { pose, twist } = prediction.from([0, 0, 0], REST, 1800, 1900, 20);
  assert.deepEqual([pose, twist], [[0, 0, 0], REST]);
});

test("nothing is predicted for longer than a quarter of a second after a state", () => {
  prediction.command([0.4, 0], 1000);
  const late = prediction.from([0, 0, 0], REST, 1000, 9000, 0);
  close(late.pose[0], 0.4 * 0.25 ** 2);
  assert.deepEqual(late.twist, REST);
  // Nor is a longer delay than 100 ms believed.
  close(prediction.from([0, 0, 0], [0.4, 0], 2000, 2000, 5000).pose[0], 0.04);
});

test("a lost link forgets the commands", () => {
  prediction.command([0.4, 0], 1000);
  prediction.command(REST, null);
  assert.deepEqual(prediction.from([0, 0, 0], REST, 1000, 1100, 0).pose, [0, 0, 0]);
});
