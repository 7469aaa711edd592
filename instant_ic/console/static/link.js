// @ts-check
// The WebSocket to the server: it reconnects, keeps the server's clock, and passes on checked messages and frames.

/** @import { Frame, PartFrame, Pong } from "./messages.js" */
import { ServerClock } from "./clock.js";
import { decodeFrame, frameNumber, MessageError, PART, parseMessage } from "./messages.js";

const PING_MS = 50; // the server counts a driver as lost after beat_timeout_s (0.25 s)
const SILENCE_MS = 1000; // silence after which the link counts as lost
const FIRST_RETRY_MS = 250, LAST_RETRY_MS = 2000;

/**
 * Events: "open", "lost" (once for each loss), "signed-out" (the server requires a token), "message" (detail: Message),
 * "frame" (detail: Frame). The consumer of a frame must call acknowledge(frame).
 */
export class Link extends EventTarget {
  /** @param {string} url */
  constructor(url) {
    super();
    this.url = url;
    this.clock = new ServerClock();
    /** @type {number | null} Delay of the last drive command. */
    this.commandAgeMs = null;
    this.commandHz = 0; // drive commands accepted in the last second
    this.connected = false;
    this.everConnected = false;
    /** @type {WebSocket | null} */
    this._socket = null;
    this._retryMs = FIRST_RETRY_MS;
    this._heard = 0;
    this._pieces = new Blob(); // pieces of a frame that have arrived so far
    this._sequence = 0;
    this._connect();
    setInterval(() => this._beat(), PING_MS);
    // The ping is sent at once, because timers of hidden pages run once a second or not at all.
    document.addEventListener("visibilitychange", () => this._ping());
    window.addEventListener("pagehide", () => this._ping(true));
  }

  /** Returns the present time of the server's clock, ms; null before the first answer. */
  serverNow() {
    return this.clock.at(performance.now());
  }

  /** @param {{type: string, [field: string]: unknown}} message */
  send(message) {
    if (this._socket?.readyState === WebSocket.OPEN) this._socket.send(JSON.stringify(message));
  }

  /** Sends a drive command; returns false without a link. @param {number} linear m/s @param {number} angular rad/s */
  drive(linear, angular) {
    const time_ms = this.serverNow();
    if (!this.connected || time_ms === null) return false;
    this.send({ type: "drive", seq: ++this._sequence, time_ms, linear, angular });
    return true;
  }

  /** @param {Pick<Frame | PartFrame, "kind" | "sequence">} frame @param {boolean} loaded false: the page could not use it */
  acknowledge(frame, loaded = true) {
    this.send({ type: "ack", kind: frame.kind, seq: frame.sequence, ...(loaded ? {} : { loaded }) });
  }

  _connect() {
    const socket = new WebSocket(this.url);
    let opened = false;
    this._socket = socket;
    socket.binaryType = "arraybuffer";
    socket.onopen = () => {
      opened = true;
      this._retryMs = FIRST_RETRY_MS;
      this._heard = performance.now();
      this.clock.reset();
      this._ping();
    };
    socket.onmessage = (event) => {
      if (socket === this._socket) this._receive(event.data);
    };
    socket.onclose = () => {
      if (!opened) this._askWhy();
      if (socket === this._socket) this._reconnect();
    };
  }

  _reconnect() {
    this._lose();
    this._socket = null;
    setTimeout(() => this._connect(), this._retryMs);
    this._retryMs = Math.min(this._retryMs * 2, LAST_RETRY_MS);
  }

  /** Finds out by an ordinary request why the WebSocket was refused, because a WebSocket gives no reason. */
  async _askWhy() {
    try {
      const answer = await fetch("/health", { cache: "no-store" });
      if (answer.status === 401) this.dispatchEvent(new Event("signed-out"));
    } catch {
      // The server cannot be reached. The next attempt asks again.
    }
  }

  _lose() {
    if (!this.connected) return;
    this.connected = false;
    this.dispatchEvent(new Event("lost"));
  }

  _beat() {
    if (this._socket?.readyState !== WebSocket.OPEN) return;
    if (performance.now() - this._heard > SILENCE_MS && !document.hidden) {
      // On a dead network path the socket would stay open for minutes, so close it here.
      const dead = this._socket;
      this._socket = null;
      dead.close();
      this._reconnect();
      return;
    }
    this._ping();
  }

  _ping(leaving = false) {
    this.send({ type: "ping", client_ms: performance.now(), away: leaving || document.hidden });
  }

  /** @param {string | ArrayBuffer} data */
  _receive(data) {
    this._heard = performance.now();
    try {
      if (typeof data !== "string") {
        const frame = decodeFrame(data);
        if (frame.kind === PART) this._collect(frame);
        else this.dispatchEvent(new CustomEvent("frame", { detail: frame }));
        return;
      }
      const message = parseMessage(data);
      if (message.type === "pong") this._pong(message);
      else this.dispatchEvent(new CustomEvent("message", { detail: message }));
    } catch (error) {
      if (!(error instanceof MessageError)) throw error;
      console.error(`message of the server dropped: ${error.message}`);
      const frame = typeof data === "string" ? null : frameNumber(data);
      if (frame) this.acknowledge(frame, false); // the server waits for this before it sends the next one
    }
  }

  /** Adds a piece of a frame. The frame is complete once the pieces have its size. @param {PartFrame} part */
  _collect(part) {
    const { header: { start, size }, payload } = part, socket = this._socket;
    this.acknowledge(part);
    if (start === 0) this._pieces = new Blob();
    if (start !== this._pieces.size) throw new MessageError(`part.start must be ${this._pieces.size} (got ${start})`);
    const whole = this._pieces = new Blob([this._pieces, payload]);
    if (whole.size !== size) return;
    this._pieces = new Blob();
    whole.arrayBuffer().then((bytes) => {
      if (socket === this._socket) this._receive(bytes);
    });
  }

  /** @param {Pong} message */
  _pong(message) {
    this.clock.take(message.client_ms, message.server_ms, performance.now());
    this.commandAgeMs = message.command_age_ms;
    this.commandHz = message.command_hz;
    if (this.connected) return;
    this.connected = this.everConnected = true;
    this.dispatchEvent(new Event("open"));
  }
}

/**
 * Calls `handle` with the detail of each event of this name.
 * @template T
 * @param {EventTarget} target @param {string} name @param {(detail: T) => void} handle
 */
export function onDetail(target, name, handle) {
  target.addEventListener(name, (event) => handle(/** @type {CustomEvent<T>} */ (event).detail));
}

