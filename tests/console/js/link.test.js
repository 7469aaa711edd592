// The WebSocket: connecting, losing and finding the server again; checks of what arrives.

import assert from "node:assert/strict";
import { beforeEach, mock, test } from "node:test";
import { fire, server, sockets, Time } from "./page.js";

const { Link } = await import("../../../instant_ic/console/static/link.js");

let time, link, events;

beforeEach(() => {
  mock.reset();
  time = new Time(mock);
  sockets.length = server.requests.length = 0;
  server.status = 200;
  events = [];
  link = new Link("ws://robot/ws");
  for (const name of ["open", "lost", "signed-out", "message", "frame"]) {
    link.addEventListener(name, ({ detail }) => events.push(detail ? [name, detail] : name));
  }
});

const socket = () => sockets.at(-1);

function answerPing(serverMs = 5000, delayMs = 20) {
  const sent = socket().sent.findLast((message) => message.type === "ping").client_ms;
  time.now = sent + delayMs;
  socket().deliver({ type: "pong", client_ms: sent, server_ms: serverMs, command_age_ms: 7, command_hz: 20 });
}

function connect() {
  socket().accept();
  answerPing();
}

test("a link is open after the first answer, not with the socket", () => {
  socket().accept();
  assert.ok(!link.connected);
  assert.equal(link.drive(0.1, 0), false);
  answerPing();
  assert.deepEqual(events, ["open"]);
  assert.equal(link.serverNow(), 5010); // half of 20 ms later
  assert.deepEqual([link.clock.roundTripMs, link.commandAgeMs, link.commandHz], [20, 7, 20]);
});

test("commands carry the server's time and increasing numbers", () => {
  connect();
  link.drive(0.3, -0.1);
  link.drive(0, 0);
  const [first, second] = socket().sent.slice(-2);
  assert.deepEqual(first, { type: "drive", seq: 1, time_ms: 5010, linear: 0.3, angular: -0.1 });
  assert.equal(second.seq, 2);
});

test("silence of one second counts as lost, and the page connects again at once", () => {
  connect();
  time.advance(990);
  assert.ok(link.connected);
  time.advance(100);
  assert.deepEqual(events, ["open", "lost"]);
  assert.equal(sockets[0].readyState, 3);
  time.advance(300);
  assert.equal(sockets.length, 2);
  connect();
  assert.deepEqual(events, ["open", "lost", "open"]);
});

test("attempts to connect become rarer, up to every two seconds", () => {
  const at = [];
  for (let i = 0; i < 6; i++) {
    const before = sockets.length, from = time.now;
    socket().close();
    while (sockets.length === before) time.advance(10);
    at.push(time.now - from);
  }
  assert.deepEqual(at, [250, 500, 1000, 2000, 2000, 2000]);
});

test("an old socket's late messages and closing change nothing", () => {
  connect();
  const old = socket();
  time.advance(1100); // silent: given up
  time.advance(300);
  connect();
  old.deliver({ type: "session", driver: "you", clients: 1, estop: false });
  old.onclose();
  assert.ok(link.connected);
  assert.ok(!events.some((event) => event[0] === "message"));
});

test("a refused WebSocket asks why; 401 shows the sign-in", async () => {
  server.status = 401;
  socket().close();
  await new Promise(setImmediate);
  assert.deepEqual(server.requests, ["/health"]);
  assert.deepEqual(events, ["signed-out"]);
});

test("pings say whether the operator is away: hidden or leaving", () => {
  connect();
  const last = () => socket().sent.at(-1);
  time.advance(50);
  assert.deepEqual([last().type, last().away], ["ping", false]);
  document.hidden = true;
  fire(document, "visibilitychange"); // at once
  assert.equal(last().away, true);
  document.hidden = false;
  fire(window, "pagehide");
  assert.equal(last().away, true);
});

test("a message that violates the protocol is dropped and reported with its field", () => {
  connect();
  const reported = mock.method(console, "error", () => {});
  socket().deliver({ type: "session", driver: "nobody", clients: 1, estop: false });
  socket().deliver({ type: "constructor" });
  socket().deliver(new ArrayBuffer(3));
  assert.equal(events.length, 1);
  const texts = reported.mock.calls.map(({ arguments: [text] }) => text);
  assert.match(texts[0], /session\.driver must be one of you, other, none \(got "nobody"\)/);
  assert.match(texts[1], /type must be one of/);
  assert.match(texts[2], /frame must be at least 12 bytes/);
  socket().deliver({ type: "session", driver: "you", clients: 1, estop: false });
  assert.equal(events.at(-1)[1].driver, "you");
});

test("a frame that is refused is acknowledged as not loaded, so that the next one comes", () => {
  connect();
  const said = mock.method(console, "error", () => {});
  const frame = new Uint8Array(14);
  frame.set([1, 5, 0, 0, 7, 0, 0, 0, 2, 0, 0, 0, 123, 125]); // "{}"
  socket().deliver(frame.buffer);
  assert.deepEqual(socket().sent.at(-1), { type: "ack", kind: 5, seq: 7, loaded: false });
  assert.match(said.mock.calls[0].arguments[0], /layers\.version must be a finite number/);
  assert.ok(!events.some(([name]) => name === "frame"));
});

test("a frame that comes in pieces is put together, and each piece is acknowledged at once", async () => {
  connect();
  const said = mock.method(console, "error", () => {});
  const json = new TextEncoder().encode(JSON.stringify({ resolution: 1, width: 2, height: 1, x: 0, y: 0 }));
  const whole = new Uint8Array([1, 3, 0, 0, 7, 0, 0, 0, json.length, 0, 0, 0, ...json, 65, 66]);
  const piece = (start, end, sequence) => {
    const header = new TextEncoder().encode(JSON.stringify({ start, size: whole.length }));
    return new Uint8Array([1, 6, 0, 0, sequence, 0, 0, 0, header.length, 0, 0, 0, ...header, ...whole.slice(start, end)]).buffer;
  };
  socket().deliver(piece(0, 20, 1));
  assert.deepEqual(socket().sent.at(-1), { type: "ack", kind: 6, seq: 1 });
  assert.deepEqual(events, ["open"]);
  socket().deliver(piece(20, whole.length, 2));
  await new Promise(setImmediate);
  const [[name, frame]] = events.slice(1);
  assert.deepEqual([name, frame.kind, frame.sequence, frame.header.width], ["frame", 3, 7, 2]);
  assert.equal(await frame.payload.text(), "AB");
  socket().deliver(piece(20, whole.length, 3));
  assert.match(said.mock.calls[0].arguments[0], /part\.start must be 0 \(got 20\)/);
});
