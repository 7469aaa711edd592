// The WebSocket: reconnects, measures round trip and clock offset, decodes binary frames.

const PING_MS = 50; // the server counts a driver as lost after beat_timeout_s (0.25 s)
const SILENCE_MS = 1000; // the link counts as lost after this silence
const PREFIX_BYTES = 12;
const VERSION = 1;

export const PANORAMA = 1, VIEW = 2, MAP = 3, COSTMAP = 4;

/**
 * Events: "open", "lost" (once for each loss), "signed-out" (the server requires a token), "message" (detail: object), "frame"
 * (detail: frame). A frame is {kind, sequence, header, payload: Blob}; its consumer must call acknowledge(frame).
 */
export class Link extends EventTarget {
  constructor(url) {
    super();
    this.url = url;
    this.roundTripMs = null;
    this.commandAgeMs = null;
    this.commandHz = 0; // drive commands accepted in the last second
    this.away = false; // the operator does something else, such as typing
    this.connected = false;
    this._offsetMs = null;
    this._samples = [];
    this._retryMs = 250;
    this._heard = 0;
    this._sequence = 0;
    this._connect();
    setInterval(() => this._beat(), PING_MS);
    // At once, because timers of hidden pages run once a second or not at all.
    document.addEventListener("visibilitychange", () => this._ping());
    window.addEventListener("pagehide", () => this._ping(true));
  }

  /** Present time of the server's clock, ms; null before the first answer. */
  serverNow() {
    return this._offsetMs === null ? null : performance.now() + this._offsetMs;
  }

  /** Quality of the link by median and 90th percentile of the round trip: "good", "fair", "poor"; null if unknown. */
  get quality() {
    if (!this.connected || this._samples.length < 10) return null;
    const sorted = this._samples.slice(-60).map((sample) => sample.roundTrip).sort((a, b) => a - b);
    const usual = sorted[sorted.length >> 1], slow = sorted[Math.floor(sorted.length * 0.9)];
    if (usual <= 80 && slow <= 150) return "good";
    return usual <= 200 && slow <= 400 ? "fair" : "poor";
  }

  send(message) {
    if (this._socket?.readyState === WebSocket.OPEN) this._socket.send(JSON.stringify(message));
  }

  /** Sends a drive command (m/s, rad/s); returns false without a link. */
  drive(linear, angular) {
    const time_ms = this.serverNow();
    if (!this.connected || time_ms === null) return false;
    this.send({ type: "drive", seq: ++this._sequence, time_ms, linear, angular });
    return true;
  }

  acknowledge(frame) {
    this.send({ type: "ack", kind: frame.kind, seq: frame.sequence });
  }

  _connect() {
    const socket = new WebSocket(this.url);
    this._socket = socket;
    socket.binaryType = "arraybuffer";
    socket.onopen = () => {
      this._retryMs = 250;
      this._heard = performance.now();
      this._samples = [];
      this._offsetMs = null;
      this._ping();
    };
    socket.onmessage = (event) => {
      if (socket === this._socket) this._receive(event.data);
    };
    let opened = false;
    socket.addEventListener("open", () => { opened = true; });
    socket.onclose = () => {
      if (!opened) this._askWhy();
      if (socket === this._socket) this._reconnect();
    };
  }

  _reconnect() {
    this._lose();
    this._socket = null;
    setTimeout(() => this._connect(), this._retryMs);
    this._retryMs = Math.min(this._retryMs * 2, 2000);
  }

  /** Asks by an ordinary request why the WebSocket was refused; a WebSocket gives a page no reason. */
  async _askWhy() {
    try {
      const answer = await fetch("/health", { cache: "no-store" });
      if (answer.status === 401) this.dispatchEvent(new Event("signed-out"));
    } catch {
      // No server; the next attempt will show.
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
      // A dead path leaves the socket open for minutes, so close it here.
      const dead = this._socket;
      this._socket = null;
      dead.close();
      this._reconnect();
      return;
    }
    this._ping();
  }

  _ping(leaving = false) {
    this.send({ type: "ping", client_ms: performance.now(), away: leaving || document.hidden || this.away });
  }

  _receive(data) {
    this._heard = performance.now();
    if (typeof data === "string") {
      const message = JSON.parse(data);
      if (message.type === "pong") this._pong(message);
      else this.dispatchEvent(new CustomEvent("message", { detail: message }));
    } else {
      const frame = decodeFrame(data);
      if (frame) this.dispatchEvent(new CustomEvent("frame", { detail: frame }));
    }
  }

  _pong(message) {
    const now = performance.now();
    const roundTrip = now - message.client_ms;
    this._samples.push({ roundTrip, offset: message.server_ms + roundTrip / 2 - now });
    if (this._samples.length > 100) this._samples.shift();
    // The fastest answer was delayed least, so its offset is the most accurate.
    this._offsetMs = this._samples.reduce((a, b) => (b.roundTrip < a.roundTrip ? b : a)).offset;
    const recent = this._samples.slice(-40).map((s) => s.roundTrip).sort((a, b) => a - b);
    this.roundTripMs = recent[recent.length >> 1];
    this.commandAgeMs = message.command_age_ms;
    this.commandHz = message.command_hz;
    if (!this.connected) {
      this.connected = true;
      this.dispatchEvent(new Event("open"));
    }
  }
}

function decodeFrame(buffer) {
  const view = new DataView(buffer);
  if (buffer.byteLength < PREFIX_BYTES || view.getUint8(0) !== VERSION) {
    console.error(`frame of ${buffer.byteLength} bytes, version ${view.getUint8(0)}: not understood`);
    return null;
  }
  const headerEnd = PREFIX_BYTES + view.getUint32(8, true);
  const header = JSON.parse(new TextDecoder().decode(new Uint8Array(buffer, PREFIX_BYTES, headerEnd - PREFIX_BYTES)));
  const payload = new Blob([new Uint8Array(buffer, headerEnd)]);
  return { kind: view.getUint8(1), sequence: view.getUint32(4, true), header, payload };
}
