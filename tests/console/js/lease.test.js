// The right to drive: asked for, kept, given back.

import assert from "node:assert/strict";
import { test } from "node:test";

const { ELSEWHERE, Lease, OTHER_DRIVES, WATCH_ONLY } = await import("../../../instant_ic/console/static/lease.js");

function made() {
  const sent = [], link = Object.assign(new EventTarget(), { sent, send: (message) => sent.push(message) });
  return [new Lease(link), link];
}

const session = (driver, estop = false) => ({ type: "session", driver, clients: 2, estop });

test("a page asks for the lease when it connects, a watcher does not", () => {
  const [lease, link] = made();
  link.dispatchEvent(new Event("open"));
  assert.deepEqual(link.sent, [{ type: "lease", take: false }]);
  lease.mayDrive = false;
  link.dispatchEvent(new Event("open"));
  assert.equal(link.sent.length, 1);
  assert.equal(lease.request(), WATCH_ONLY);
});

test("a lease that timed out is asked for again, one that was handed over is not", () => {
  const [lease, link] = made();
  lease.take(session("you"));
  lease.take(session("none"));
  assert.deepEqual(link.sent.at(-1), { type: "lease", take: false });
  lease.take(session("you"));
  lease.handOver();
  lease.take(session("none"));
  assert.deepEqual(link.sent.at(-1), { type: "yield" });
  lease.takeOver();
  assert.deepEqual(link.sent.at(-1), { type: "lease", take: true });
});

test("another driver is never displaced by a drive key", () => {
  const [lease, link] = made();
  lease.take(session("other"));
  assert.equal(lease.request(), OTHER_DRIVES);
  assert.deepEqual(link.sent, []);
});

test("a driver at another connection to the robot cannot be displaced from here, and the operator learns why", () => {
  const [lease, link] = made();
  lease.take({ ...session("other"), door: "host_bridge/tablet/console" });
  assert.equal(lease.request(), ELSEWHERE);
  assert.equal(lease.door, "host_bridge/tablet/console");
  assert.ok(!lease.drives);
  assert.deepEqual(link.sent, []);
});

test("an emergency stop or a lost link ends driving", () => {
  const [lease, link] = made();
  lease.take(session("you"));
  assert.ok(lease.drives);
  lease.take(session("you", true));
  assert.ok(!lease.drives);
  lease.take(session("you"));
  link.dispatchEvent(new Event("lost"));
  assert.ok(!lease.drives);
});
