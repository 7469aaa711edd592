// Checks of the server's messages.

import assert from "node:assert/strict";
import { test } from "node:test";

const { DEFAULT_PAGE, decodeFrame, frameNumber, MessageError, parseMessage } = await import("../../../instant_ic/console/static/messages.js");

const STATE = {
  type: "state", at_ms: 5, mode: "virtual", shown: "virtual", robot: [1, 2, 0.1], vbot: null, twist: [0.2, 0],
};
const HELLO = { type: "hello", max_linear: 0.4, max_angular: 0.8, may_drive: true, page: {} };

test("fields without a value are null, and unknown fields are dropped", () => {
  const state = parseMessage(JSON.stringify({ ...STATE, later: 1 }));
  assert.deepEqual([state.vbot, state.reason, state.estop, state.command], [null, null, null, null]);
  assert.ok(!("later" in state));
});

for (const [what, change, text] of [
  ["a mode that does not exist", { mode: "flying" }, /state\.mode must be one of real, .* \(got "flying"\)/],
  ["a pose with two numbers", { robot: [1, 2] }, /state\.robot must be 3 numbers/],
  ["a text for a number", { at_ms: "0" }, /state\.at_ms must be a finite number \(got "0"\)/],
  ["a list with a hole", { twist: [0.1, null] }, /state\.twist\[1\] must be a finite number/],
  ["a missing field", { at_ms: undefined }, /state\.at_ms must be/],
]) {
  test(`${what} is refused by its name`, () => {
    assert.throws(() => parseMessage(JSON.stringify({ ...STATE, ...change })), (error) =>
      error instanceof MessageError && text.test(error.message));
  });
}

test("what is no message at all is refused", () => {
  for (const json of ["", "{", "null", "[]", "5", '{"type": 5}', '{"type": "toString"}', '{"type": "hello", "page": []}']) {
    assert.throws(() => parseMessage(json), MessageError, json);
  }
});

function frame(kind, header, { version = 1, length } = {}) {
  const json = new TextEncoder().encode(JSON.stringify(header)), buffer = new ArrayBuffer(12 + json.length + 2);
  const view = new DataView(buffer), bytes = new Uint8Array(buffer);
  view.setUint8(0, version);
  view.setUint8(1, kind);
  view.setUint32(4, 7, true);
  view.setUint32(8, length ?? json.length, true);
  bytes.set(json, 12);
  bytes.set([0xff, 0xd8], 12 + json.length);
  return buffer;
}

test("a frame's parts are those of the layout in protocol.py", async () => {
  const decoded = decodeFrame(frame(1, { captured_ms: 3, q: [0, 0, 0, 1], p: [1, 2, 3] }));
  assert.deepEqual([decoded.kind, decoded.sequence, decoded.header], [1, 7, { captured_ms: 3, q: [0, 0, 0, 1], p: [1, 2, 3] }]);
  assert.deepEqual([...new Uint8Array(await decoded.payload.arrayBuffer())], [0xff, 0xd8]);
});

test("frames that cannot be decoded are refused", () => {
  const header = { captured_ms: 3, q: null };
  for (const [buffer, text] of [
    [frame(1, header, { version: 2 }), /version must be 1/],
    [frame(9, header), /kind must be 1 to 6/],
    [frame(1, header, { length: 999 }), /at least 1011 bytes/],
    [frame(2, header), /frame 2\.q must be a list/],
    [frame(3, header), /frame 3\.resolution must be a finite number/],
    [frame(1, header, { length: 4 }), /not valid JSON/],
  ]) assert.throws(() => decodeFrame(buffer), text);
});

// One triangle on a lattice of 2 x 4 pixels, as in test_console_layers.py.
const LAYER = { id: "a", size: [2, 4], gain: [1, 0.9, 1.1], q: [0, 0, 0, 1], p: [1, 0, 1.2],
  parts: { inverse: [0, 12], triangles: [12, 12], corners: [24, 12], image: [36, 4], confidence: [40, 3] } };
const LAYERS = { version: 3, mount: [0.1, 0, 1.2], layers: [LAYER] };

function layersFrame(header = LAYERS, { inverse = [0.5, 0.25, 0], triangles = [0, 1, 2], corners = [0, 0, 4, 0, 2, 2] } = {}) {
  const parts = [new Float32Array(inverse), new Uint32Array(triangles), new Uint16Array(corners)].map((a) => new Uint8Array(a.buffer));
  const payload = [...parts.flatMap((part) => [...part]), ...new TextEncoder().encode("JPEGPNG")];
  const json = new TextEncoder().encode(JSON.stringify(header)), bytes = new Uint8Array(12 + json.length + payload.length);
  bytes.set([1, 5, 0, 0, 9, 0, 0, 0]);
  new DataView(bytes.buffer).setUint32(8, json.length, true);
  bytes.set(json, 12);
  bytes.set(payload, 12 + json.length);
  return bytes.buffer;
}

test("layers: numbers and images by their ranges; a layer without parts is one that the page holds", async () => {
  const held = { ...LAYER, id: "b", parts: null };
  const { sequence, header, layers } = decodeFrame(layersFrame({ ...LAYERS, layers: [LAYER, held] }));
  assert.deepEqual([sequence, header], [9, { version: 3, mount: [0.1, 0, 1.2] }]);
  const [{ gain, q, p, mesh }, second] = layers;
  assert.deepEqual([gain, q, p], [[1, 0.9, 1.1], [0, 0, 0, 1], [1, 0, 1.2]]);
  assert.deepEqual([mesh.size, [...mesh.inverse], [...mesh.triangles]], [[2, 4], [0.5, 0.25, 0], [0, 1, 2]]);
  assert.deepEqual([...mesh.corners], [0, 0, 4, 0, 2, 2]);
  assert.deepEqual([await mesh.image.text(), await mesh.confidence.text()], ["JPEG", "PNG"]);
  assert.deepEqual(second, { id: "b", gain, q, p, mesh: null });
});

test("layers that cannot be rendered are refused by the name of what is wrong", () => {
  /** Layers with other ranges. */
  const ranges = (parts) => ({ ...LAYERS, layers: [{ ...LAYER, parts: { ...LAYER.parts, ...parts } }] });
  const sized = (size) => ({ ...LAYERS, layers: [{ ...LAYER, size }] });
  for (const [buffer, text] of [
    [layersFrame({ ...LAYERS, layers: [] }), /layers must be 1 to 8 layers \(got 0\)/],
    [layersFrame({ ...LAYERS, layers: Array(9).fill(LAYER) }), /layers must be 1 to 8 layers \(got 9\)/],
    [layersFrame({ ...LAYERS, mount: [1, 2] }), /layers\.mount must be 3 numbers/],
    [layersFrame(ranges({ image: [36, 99] })), /layers\[0\]\.image must be entries of 1 bytes within 43 bytes/],
    [layersFrame(ranges({ inverse: [0, 11] })), /layers\[0\]\.inverse must be entries of 4 bytes/],
    [layersFrame(ranges({ inverse: [-4, 12] })), /layers\[0\]\.inverse must be/],
    [layersFrame(ranges({ inverse: [0, 1e300] })), /layers\[0\]\.inverse must be/],
    [layersFrame(ranges({ inverse: [0.5, 12] })), /layers\[0\]\.inverse must be/],
    [layersFrame(ranges({ inverse: [0, 8] })), /layers\[0\]\.corners must be 2 pairs/],
    [layersFrame(sized([1, 4])), /layers\[0\]\.corners\[2\] must be within 4 x 1/],
    [layersFrame(sized([0, 4])), /layers\[0\]\.size must be two sizes/],
    [layersFrame(LAYERS, { inverse: [0.5, NaN, 0] }), /layers\[0\]\.inverse\[1\] must be finite and >= 0/],
    [layersFrame(LAYERS, { inverse: [0.5, -1, 0] }), /layers\[0\]\.inverse\[1\] must be finite and >= 0/],
    [layersFrame(LAYERS, { triangles: [0, 1, 3] }), /layers\[0\]\.triangles\[2\] must be below 3 \(got 3\)/],
  ]) {
    assert.throws(() => decodeFrame(buffer), (error) => error instanceof MessageError && text.test(error.message), `${text}`);
    assert.deepEqual(frameNumber(buffer), { kind: 5, sequence: 9 });
  }
  assert.equal(frameNumber(frame(9, {})), null);
  assert.equal(frameNumber(new ArrayBuffer(5)), null);
});

test("settings of the page: the server's values, else the defaults", () => {
  const settings = (page) => parseMessage(JSON.stringify({ ...HELLO, page })).page;
  assert.deepEqual(settings({}), DEFAULT_PAGE);
  assert.deepEqual(settings({ dissolve_ms: 100, ease_ms: 0, footprint: [1, 2], camera: null }),
    { ...DEFAULT_PAGE, dissolve_ms: 100, ease_ms: 0, footprint: [1, 2] });
});
