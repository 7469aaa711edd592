// Hold to drive: keys, stick and speed limit. Commands that a held key or stick gives, and when they end.

import assert from "node:assert/strict";
import { beforeEach, mock, test } from "node:test";
import { fire, Time } from "./page.js";

const { attachStick, deadZone, Drive, isDriveKey } = await import("../../../instant_ic/console/static/drive.js");

let time, link, drive;

beforeEach(() => {
  mock.reset();
  time = new Time(mock);
});

function driver() {
  const sent = [];
  link = Object.assign(new EventTarget(), { sent, drive: (...command) => sent.push(command) });
  drive = new Drive(link);
  drive.limits = { linear: 0.4, angular: 0.8 };
  drive.setScale(1);
  drive.setEnabled(true);
  return drive;
}

const press = (code, more = {}) => fire(window, "keydown", { code, ...more });
const release = (code) => fire(window, "keyup", { code });

test("keys of both directions add up to a command and cancel each other", () => {
  driver();
  press("KeyW");
  press("KeyA");
  assert.deepEqual(drive.command, [0.4, 0.8]);
  press("ArrowDown");
  assert.deepEqual(drive.command, [0, 0.8]);
  assert.ok(drive.holds("KeyS") && !drive.holds("KeyD"));
  for (const code of ["KeyW", "KeyA", "ArrowDown"]) release(code);
  assert.deepEqual(drive.command, [0, 0]);
});

test("two keys of one direction drive no faster than one", () => {
  driver();
  press("KeyW");
  press("ArrowUp");
  assert.equal(drive.command[0], 0.4);
  release("KeyW");
  assert.equal(drive.command[0], 0.4);
  release("ArrowUp");
  assert.equal(drive.command[0], 0);
});

test("a held key is sent at 20 Hz and its release at once, then nothing", () => {
  driver();
  press("KeyW");
  time.advance(200);
  assert.equal(link.sent.length, 5);
  release("KeyW");
  assert.deepEqual(link.sent.at(-1), [0, 0]);
  time.advance(200);
  assert.equal(link.sent.length, 6);
});

test("the speed limit scales a command that is being held", () => {
  driver();
  press("KeyW");
  drive.setScale(0.5);
  assert.deepEqual(drive.command, [0.2, 0]);
  drive.setScale(0.01); // at least 10 %
  assert.ok(Math.abs(drive.command[0] - 0.04) < 1e-12);
});

for (const [name, event] of [
  ["blur", () => fire(window, "blur")],
  ["pagehide", () => fire(window, "pagehide")],
  ["contextmenu", () => fire(window, "contextmenu")],
  ["a hidden page", () => { document.hidden = true; fire(document, "visibilitychange"); document.hidden = false; }],
  ["a lost link", () => link.dispatchEvent(new Event("lost"))],
  ["a system key", () => press("KeyD", { ctrlKey: true })],
  ["Meta released", () => fire(window, "keyup", { code: "MetaLeft", key: "Meta" })],
]) {
  test(`${name} stops, and the key must be pressed again`, () => {
    driver();
    const reasons = [];
    drive.addEventListener("stop", ({ detail }) => reasons.push(detail));
    press("KeyW");
    event();
    assert.deepEqual(drive.command, [0, 0]);
    assert.equal(reasons.length, 1);
    press("KeyW", { repeat: true }); // the key is still held
    assert.deepEqual(drive.command, [0, 0]);
    press("KeyW");
    assert.equal(drive.command[0], 0.4);
  });
}

test("without the lease neither keys nor stick drive", () => {
  driver();
  drive.setEnabled(false);
  press("KeyW");
  drive.setStick(1, 0);
  assert.deepEqual(drive.command, [0, 0]);
});

test("losing the lease releases a held key", () => {
  driver();
  press("KeyW");
  drive.setEnabled(false);
  drive.setEnabled(true);
  assert.deepEqual(drive.command, [0, 0]);
});

/** A stick of 144 px; `touch` puts a finger on it, `pull` moves the finger by these pixels to the top. */
function stick() {
  const element = Object.assign(new EventTarget(), {
    knob: { style: {} },
    querySelector: () => element.knob,
    setPointerCapture() {},
    getBoundingClientRect: () => ({ left: 0, top: 0, width: 144, height: 144 }),
  });
  attachStick(element, drive);
  const finger = (name, up = 0) => fire(element, name, { pointerId: 1, clientX: 72, clientY: 72 - up });
  return { touch: () => finger("pointerdown"), pull: (up) => finger("pointermove", up), let_go: () => finger("pointerup") };
}

for (const [name, stop] of [["an emergency stop", () => drive.stop()], ["the loss of the lease", () => {}]]) {
  test(`fault: a stick held through ${name} drives once the page may drive again`, () => {
    driver();
    const { touch, pull, let_go } = stick();
    touch();
    pull(50);
    assert.deepEqual(drive.command, [0.4, 0]);
    stop();
    drive.setEnabled(false);
    drive.setEnabled(true);
    pull(49); // a finger never stands still
    assert.deepEqual(drive.command, [0, 0]);
    let_go();
    touch();
    pull(50);
    assert.deepEqual(drive.command, [0.4, 0]);
  });
}

test("fault: a stick that was touched in vain drives once the page may drive", () => {
  driver().setEnabled(false);
  const { touch, pull } = stick();
  touch();
  drive.setEnabled(true);
  pull(50);
  assert.deepEqual(drive.command, [0, 0]);
});

test("arrows of a slider do not drive", () => {
  const slider = Object.assign(new HTMLInputElement(), { type: "range" });
  assert.ok(!isDriveKey({ target: slider, code: "ArrowUp" }));
  assert.ok(isDriveKey({ target: slider, code: "KeyW" }));
  assert.ok(!isDriveKey({ target: null, code: "KeyX" }));
});

test("the stick's dead zone ends without a step and reaches full deflection", () => {
  assert.equal(deadZone(0.119), 0);
  assert.ok(deadZone(0.1201) > 0 && deadZone(0.1201) < 0.001);
  assert.equal(deadZone(1), 1);
  assert.equal(deadZone(-1), -1);
  assert.ok(Math.abs(deadZone(0.56) - 0.5) < 1e-12); // (0.56 - 0.12) / 0.88
});
