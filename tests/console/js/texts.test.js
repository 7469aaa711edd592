// The operator's texts, chosen by codes, never by wording.

import assert from "node:assert/strict";
import { test } from "node:test";

const texts = await import("../../../instant_ic/console/static/texts.js");

const QUIET = { lost: false, estop: false, held: false, driver: "you", reason: "" };

test("the mode's reason comes from the controller, else from the mode", () => {
  assert.deepEqual(texts.modeText(null, "none"), { name: "WAITING", reason: "No controller is running" });
  assert.equal(texts.modeText({ mode: "real", reason: "" }, "you").reason, "You drive the robot");
  assert.equal(texts.modeText({ mode: "real", reason: null }, "other").reason, "The robot obeys the operator");
  assert.deepEqual(texts.modeText({ mode: "stopped", reason: "no scan" }, "you"), { name: "STOPPED", reason: "No scan" });
});

test("one banner at a time: link, emergency stop, held key", () => {
  assert.equal(texts.bannerText(QUIET), null);
  const all = { ...QUIET, lost: true, estop: true, held: true };
  assert.equal(texts.bannerText(all).title, "LINK LOST");
  assert.equal(texts.bannerText({ ...all, lost: false }).title, "EMERGENCY STOP");
  assert.equal(texts.bannerText({ ...QUIET, held: true }).text, "Release the controls to continue.");
});

test("only the driver can release an emergency stop; the reason says what holds the robot", () => {
  const stop = { ...QUIET, estop: true };
  assert.deepEqual(texts.bannerText(stop),
    { title: "EMERGENCY STOP", text: "Release the emergency stop to continue.", release: true });
  assert.equal(texts.bannerText({ ...stop, driver: "other" }).release, false);
  // A reason that mentions other things decides nothing.
  assert.deepEqual(texts.bannerText({ ...stop, reason: "button: link lost" }),
    { title: "EMERGENCY STOP", text: "Button: link lost", release: true });
});
