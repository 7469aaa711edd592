// @ts-check
// Messages of the server, checked on arrival.

/** @template T @typedef {(value: unknown, name: string) => T} Reader */

/** A message that violates the protocol; the text names the field. */
export class MessageError extends Error {}

/** @param {string} name @param {string} wanted @param {unknown} value @returns {never} */
function refuse(name, wanted, value) {
  throw new MessageError(`${name} must be ${wanted} (got ${String(JSON.stringify(value)).slice(0, 40)})`);
}

/** @type {Reader<number>} */
const number = (value, name) =>
  typeof value === "number" && Number.isFinite(value) ? value : refuse(name, "a finite number", value);

/** @type {Reader<string>} */
const text = (value, name) => (typeof value === "string" ? value : refuse(name, "a text", value));

/** @type {Reader<boolean>} */
const flag = (value, name) => (typeof value === "boolean" ? value : refuse(name, "true or false", value));

/** @template {string} T @param {...T} values @returns {Reader<T>} */
const oneOf = (...values) => (value, name) =>
  values.find((known) => known === value) ?? refuse(name, `one of ${values.join(", ")}`, value);

/** Reads a field that may be missing or null. @template T @param {Reader<T>} read @param {NoInfer<T>} instead @returns {Reader<T>} */
const defaulted = (read, instead) => (value, name) => (value === null || value === undefined ? instead : read(value, name));

/** @template T @param {Reader<T>} read @returns {Reader<T | null>} */
const optional = (read) => defaulted(/** @type {Reader<T | null>} */ (read), null);

/** @template T @param {Reader<T>} read @returns {Reader<T[]>} */
const list = (read) => (value, name) =>
  Array.isArray(value) ? value.map((one, i) => read(one, `${name}[${i}]`)) : refuse(name, "a list", value);

/** @param {unknown} value @param {string} name @param {number} length */
function numbers(value, name, length) {
  const found = list(number)(value, name);
  return found.length === length ? found : refuse(name, `${length} numbers`, value);
}

/** @type {Reader<[number, number]>} */
const pair = (value, name) => /** @type {[number, number]} */ (numbers(value, name, 2));
/** @type {Reader<[number, number, number]>} */
const triple = (value, name) => /** @type {[number, number, number]} */ (numbers(value, name, 3));
/** @type {Reader<[number, number, number, number]>} */
const quaternion = (value, name) => /** @type {[number, number, number, number]} */ (numbers(value, name, 4));

/**
 * Reads an object. Fields that are not listed are dropped.
 * @template {Record<string, Reader<unknown>>} F
 * @param {F} fields
 * @returns {Reader<{[K in keyof F]: ReturnType<F[K]>}>}
 */
const object = (fields) => (value, name) => {
  if (typeof value !== "object" || value === null || Array.isArray(value)) return refuse(name, "an object", value);
  const given = /** @type {Record<string, unknown>} */ (value);
  const read = Object.entries(fields).map(([key, reader]) => [key, reader(given[key], `${name}.${key}`)]);
  return Object.fromEntries(read);
};

const page = object({
  dissolve_ms: defaulted(number, 250),
  ease_ms: defaulted(number, 400),
  colour_release_s: defaulted(number, 6),
  max_accel: defaulted(pair, [0.8, 2]), // m/s², rad/s²
  footprint: defaulted(pair, [0.6, 0.5]), // length, width, m
  camera: defaulted(triple, [0, 0, 1.2]), // position on the robot, m
});
export const DEFAULT_PAGE = page({}, "page");
const hello = object({
  type: oneOf("hello"), max_linear: number, max_angular: number, may_drive: flag, page,
});
const pong = object({
  type: oneOf("pong"), client_ms: number, server_ms: number, command_age_ms: optional(number), command_hz: number,
});
const session = object({
  type: oneOf("session"), driver: oneOf("you", "other", "none"), clients: number, estop: flag, door: optional(text),
});
const state = object({
  type: oneOf("state"),
  at_ms: number,
  mode: oneOf("real", "entering", "virtual", "returning", "stopped", "none"),
  shown: oneOf("real", "virtual", "none"),
  robot: optional(triple),
  vbot: optional(triple),
  twist: pair,
  reason: optional(text),
  estop: optional(flag),
  command: optional(list(optional(number))),
});
const plan = object({
  type: oneOf("plan"), trajectory: list(pair), path: list(pair), subgoal: optional(triple),
});
const vspace = object({
  state: oneOf("empty", "training", "ready", "failed"),
  psnr_db: number,
  expected_psnr_db: number,
  unseen_share: number,
  radius_m: number,
  train_seconds: number,
  message: text,
});
const health = object({
  type: oneOf("health"),
  vspace: optional(vspace),
  battery: optional(object({ voltage: number, percent: optional(number) })),
  nodes: list(object({ name: text, cpu_percent: number })),
  faults: list(object({ level: oneOf("warn", "error"), name: text, text })),
  pace: optional(text),
});
const recording = object({
  type: oneOf("recording"),
  recorder: oneOf("ok", "missing"),
  text,
  state: text,
  path: optional(text),
  seconds: optional(number),
  bytes: optional(number),
  free_bytes: optional(number),
  cached_s: optional(number),
  notice: object({ number, text, level: text }),
});
const refused = object({
  type: oneOf("refused"), reason: oneOf("not_driver", "watch_only", "old", "future", "out_of_order", "stopped", "held"), text,
});
const error = object({ type: oneOf("error"), text });

/** @typedef {typeof DEFAULT_PAGE} PageSettings */
/** @typedef {ReturnType<typeof hello>} Hello */
/** @typedef {ReturnType<typeof pong>} Pong */
/** @typedef {ReturnType<typeof session>} Session */
/** @typedef {ReturnType<typeof state>} State */
/** @typedef {ReturnType<typeof plan>} Plan */
/** @typedef {ReturnType<typeof health>} Health */
/** @typedef {ReturnType<typeof vspace>} Vspace */
/** @typedef {ReturnType<typeof recording>} RecordingStatus */
/** @typedef {ReturnType<typeof refused>} Refused */
/** @typedef {Hello | Pong | Session | State | Plan | Health | RecordingStatus | Refused | ReturnType<typeof error>} Message */

/** @type {Record<string, Reader<Message>>} */
const MESSAGES = { hello, pong, session, state, plan, health, recording, refused, error };

/**
 * Parses a text message; throws MessageError, which names the wrong field.
 * @param {string} json
 * @returns {Message}
 */
export function parseMessage(json) {
  const value = parsed(json);
  const type = typeof value === "object" && value !== null && "type" in value ? String(value.type) : "";
  const read = Object.hasOwn(MESSAGES, type) ? MESSAGES[type] : undefined;
  return read ? read(value, type) : refuse("type", `one of ${Object.keys(MESSAGES).join(", ")}`, type);
}

/** @param {string} json @returns {unknown} */
function parsed(json) {
  try {
    return JSON.parse(json);
  } catch (fault) {
    throw new MessageError(`not valid JSON: ${fault}`);
  }
}

// ---- binary frames -------------------------------------------------------------------------------

export const PANORAMA = 1, VIEW = 2, MAP = 3, COSTMAP = 4, LAYERS = 5, PART = 6;
const PREFIX_BYTES = 12;
const VERSION = 1;

const gridHeader = object({ resolution: number, width: number, height: number, x: number, y: number });
const HEADERS = {
  [PANORAMA]: object({ captured_ms: number, q: optional(quaternion), p: optional(triple) }),
  [VIEW]: object({ captured_ms: number, q: quaternion, p: triple, fov: number }),
  [MAP]: gridHeader,
  [COSTMAP]: gridHeader,
  [PART]: object({ start: number, size: number }),
};
const MOST_LAYERS = 8; // bits of the stencil buffer
const parts = object({ inverse: pair, triangles: pair, corners: pair, image: pair, confidence: pair });
const layersHeader = object({
  version: number, mount: triple,
  layers: list(object({ id: text, size: pair, gain: triple, q: quaternion, p: triple, parts: optional(parts) })),
});

/**
 * A layer: triangles around a keyframe, whose vertices are corners of the panorama's pixels.
 * @typedef {object} LayerData
 * @property {string} id of the mesh; equal ids have equal content
 * @property {[number, number, number]} gain factors of the colours
 * @property {[number, number, number, number]} q rotation map_from_camera of the keyframe
 * @property {[number, number, number]} p position of the keyframe in the map frame, m
 * @property {Mesh | null} mesh null: the mesh of this id in earlier layers
 */
/**
 * @typedef {object} Mesh
 * @property {[number, number]} size height and width of the lattice of corners
 * @property {Uint16Array} corners column and row of each vertex
 * @property {Float32Array} inverse inverse depth of each vertex, 1/m
 * @property {Uint32Array} triangles indices of vertices
 * @property {Blob} image JPEG or PNG, equirectangular
 * @property {Blob | null} confidence PNG; null: a keyframe has seen all of the mesh
 */
/** @typedef {Omit<ReturnType<typeof layersHeader>, "layers">} LayersHeader */
/** @typedef {{kind: 5, sequence: number, header: LayersHeader, layers: LayerData[]}} LayersFrame */
/** @template {keyof typeof HEADERS} K @typedef {ReturnType<(typeof HEADERS)[K]>} Header */
/** @template {keyof typeof HEADERS} K @typedef {{kind: K, sequence: number, header: Header<K>, payload: Blob}} FrameOf */
/** @typedef {Header<1>} PanoramaHeader */
/** @typedef {Header<2>} ViewHeader */
/** @typedef {Header<3>} GridHeader */
/** @typedef {FrameOf<3> | FrameOf<4>} GridFrame */
/** @typedef {FrameOf<1> | FrameOf<2> | GridFrame | LayersFrame} Frame */
/** @typedef {FrameOf<6>} PartFrame */

/** Decodes a binary frame; throws MessageError. @param {ArrayBuffer} buffer @returns {Frame | PartFrame} */
export function decodeFrame(buffer) {
  const view = new DataView(buffer), size = buffer.byteLength;
  if (size < PREFIX_BYTES) return refuse("frame", `at least ${PREFIX_BYTES} bytes long`, size);
  if (view.getUint8(0) !== VERSION) return refuse("frame.version", String(VERSION), view.getUint8(0));
  const kind = view.getUint8(1), sequence = view.getUint32(4, true), headerEnd = PREFIX_BYTES + view.getUint32(8, true);
  if (headerEnd > size) return refuse("frame", `at least ${headerEnd} bytes long`, size);
  const header = parsed(new TextDecoder().decode(new Uint8Array(buffer, PREFIX_BYTES, headerEnd - PREFIX_BYTES)));
  if (kind === LAYERS) return { kind, sequence, ...decodeLayers(header, buffer.slice(headerEnd)) };
  const payload = new Blob([new Uint8Array(buffer, headerEnd)]);
  const read = Object.hasOwn(HEADERS, kind) ? HEADERS[/** @type {keyof typeof HEADERS} */ (kind)] : refuse("frame.kind", "1 to 6", kind);
  return /** @type {Frame | PartFrame} */ ({ kind, sequence, header: read(header, `frame ${kind}`), payload });
}

/**
 * Returns kind and sequence of a frame, even if the rest of it cannot be decoded; null if it has none.
 * @param {ArrayBuffer} buffer @returns {Pick<Frame | PartFrame, "kind" | "sequence"> | null}
 */
export function frameNumber(buffer) {
  if (buffer.byteLength < PREFIX_BYTES) return null;
  const view = new DataView(buffer), kind = /** @type {Frame["kind"]} */ (view.getUint8(1));
  return kind === LAYERS || Object.hasOwn(HEADERS, kind) ? { kind, sequence: view.getUint32(4, true) } : null;
}

/** @param {unknown} value @param {ArrayBuffer} payload @returns {Pick<LayersFrame, "header" | "layers">} */
function decodeLayers(value, payload) {
  const { layers, ...header } = layersHeader(value, "layers");
  if (layers.length < 1 || layers.length > MOST_LAYERS) return refuse("layers", `1 to ${MOST_LAYERS} layers`, layers.length);
  return { header, layers: layers.map(({ id, gain, q, p, size, parts: ranges }, i) => ({
    id, gain, q, p, mesh: ranges && decodeMesh(ranges, size, payload, `layers[${i}]`) })) };
}

/**
 * @param {ReturnType<typeof parts>} ranges start and length in bytes @param {[number, number]} size
 * @param {ArrayBuffer} payload @param {string} name @returns {Mesh}
 */
function decodeMesh(ranges, [height, width], payload, name) {
  /** @param {keyof typeof ranges} part @param {number} unit bytes of one entry */
  const bytes = (part, unit) => {
    const [start, length] = ranges[part], end = start + length;
    const whole = Number.isInteger(start) && Number.isInteger(length) && length % unit === 0;
    if (whole && start >= 0 && length >= 0 && end <= payload.byteLength) return payload.slice(start, end);
    return refuse(`${name}.${part}`, `entries of ${unit} bytes within ${payload.byteLength} bytes`, [start, length]);
  };
  const corners = new Uint16Array(bytes("corners", 4)), inverse = new Float32Array(bytes("inverse", 4));
  const triangles = new Uint32Array(bytes("triangles", 12)), count = inverse.length;
  if (corners.length !== 2 * count) return refuse(`${name}.corners`, `${count} pairs`, corners.length / 2);
  if (![height, width].every((side) => Number.isInteger(side) && side >= 1 && side <= 0xffff))
    return refuse(`${name}.size`, "two sizes from 1 to 65535", [height, width]);
  for (let i = 0; i < count; i++) {
    if (corners[2 * i] > width || corners[2 * i + 1] > height)
      return refuse(`${name}.corners[${i}]`, `within ${width} x ${height}`, [corners[2 * i], corners[2 * i + 1]]);
    if (!(inverse[i] >= 0 && inverse[i] < Infinity)) return refuse(`${name}.inverse[${i}]`, "finite and >= 0", inverse[i]);
  }
  const wrong = triangles.findIndex((index) => index >= count);
  if (wrong >= 0) return refuse(`${name}.triangles[${wrong}]`, `below ${count}`, triangles[wrong]);
  const confidence = bytes("confidence", 1);
  return {
    size: [height, width], corners, inverse, triangles, image: new Blob([bytes("image", 1)]),
    confidence: confidence.byteLength ? new Blob([confidence]) : null,
  };
}
