// Which text the operator gets; chosen by codes, never by wording.

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

test("the lease says who drives and who watches", () => {
  assert.equal(texts.leaseText("you", 0), "You are driving");
  assert.equal(texts.leaseText("you", 2), "You are driving · 2 watching");
  assert.equal(texts.leaseText("none", 2), "Nobody is driving");
  assert.equal(texts.leaseText("other", 1, "foxglove_bridge"), "Another operator is driving through foxglove_bridge");
});

test("virtual space: state and quality", () => {
  const vspace = {
    state: "training", psnr_db: 21.26, expected_psnr_db: 0, unseen_share: 0, radius_m: 0, train_seconds: 3.2, message: "",
  };
  assert.equal(texts.vspaceText(vspace), "Virtual space training, 3 s");
  assert.equal(texts.vspaceQuality(vspace), " · 21.3 dB");
  const expected = { ...vspace, expected_psnr_db: 25.6, unseen_share: 0.03, radius_m: 2 };
  assert.equal(texts.vspaceQuality(expected), " · 26 dB here · 97 % seen · within 2.0 m");
  assert.equal(texts.vspaceText({ ...vspace, state: "failed", message: "no depth" }), "Virtual space failed: no depth");
  assert.equal(texts.vspaceText(null), "No virtual space yet");
  assert.equal(texts.vspaceQuality(null), "");
});

test("numbers for the operator", () => {
  assert.equal(texts.clockText(61.9), "1:01");
  assert.equal(texts.clockText(null), "0:00");
  assert.equal(texts.bytesText(12_400_000), "12 MB");
  assert.equal(texts.bytesText(2.25e9), "2.3 GB");
  assert.equal(texts.millisecondsText(41.6), "42 ms");
  assert.equal(texts.millisecondsText(12_300), "12 s");
  assert.equal(texts.recordText({ state: "recording", seconds: 5, bytes: 1e6 }), "0:05 · 1 MB");
  assert.equal(texts.recordText({ state: "idle" }), "Record");
  assert.equal(texts.recorderText("disk full"), "Disk full");
  assert.equal(texts.nodeText("vlp16_driver"), "LiDAR");
  assert.equal(texts.nodeText("constructor"), "constructor");
});

test("a node's CPU in percent of one core", () => {
  assert.equal(texts.cpuText({ name: "nerf", cpu_percent: 17.4 }), "nerf: 17 %");
});
