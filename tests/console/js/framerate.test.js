// The page's frame rate counts only while the shown place moves.

import assert from "node:assert/strict";
import { test } from "node:test";

const { FrameRate } = await import("../../../instant_ic/console/static/framerate.js");

test("frames of a motion count, the pause between two motions does not", () => {
  const rate = new FrameRate();
  assert.equal(rate.perSecond, 0);
  for (const now of [0, 50, 100, 150]) rate.frame(now, true);
  rate.frame(200, false); // stands
  for (const now of [5000, 5050]) rate.frame(now, true);
  assert.equal(rate.perSecond, 20);
});

test("a frame that comes late during a motion lowers the rate", () => {
  const rate = new FrameRate();
  for (const now of [0, 50, 1950]) rate.frame(now, true);
  assert.ok(Math.abs(rate.perSecond - 2000 / 1950) < 1e-9);
});

test("only the newest frames count", () => {
  const rate = new FrameRate();
  for (let i = 0; i < 10; i++) rate.frame(500 * i, true);
  for (let i = 0; i < 60; i++) rate.frame(4500 + 40 * (i + 1), true);
  assert.equal(rate.perSecond, 25);
});
