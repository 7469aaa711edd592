// @ts-check
// The server's clock and the quality of the link, estimated from the round trips of pings.

const KEPT = 100;
const QUALITY_SAMPLES = 60, LEAST_SAMPLES = 10;

export class ServerClock {
  constructor() {
    /** @type {{roundTrip: number, offset: number}[]} */
    this._samples = [];
    /** @type {number | null} */
    this._offsetMs = null;
  }

  /** Forgets all round trips, because a new connection may lead to a restarted server. */
  reset() {
    this._samples = [];
    this._offsetMs = null;
  }

  /**
   * Records an answer that arrived at `nowMs` of this page's clock.
   * @param {number} sentMs @param {number} serverMs @param {number} nowMs
   */
  take(sentMs, serverMs, nowMs) {
    const roundTrip = nowMs - sentMs;
    this._samples.push({ roundTrip, offset: serverMs + roundTrip / 2 - nowMs });
    if (this._samples.length > KEPT) this._samples.shift();
    // The fastest answer was delayed least, so that its offset is the most accurate.
    this._offsetMs = this._samples.reduce((a, b) => (b.roundTrip < a.roundTrip ? b : a)).offset;
  }

  /** Returns the time of the server's clock at `nowMs`, ms; null before the first answer. @param {number} nowMs */
  at(nowMs) {
    return this._offsetMs === null ? null : nowMs + this._offsetMs;
  }

  /** Median round trip, ms; null before the first answer. */
  get roundTripMs() {
    const sorted = this._sorted();
    return sorted[sorted.length >> 1] ?? null;
  }

  /** Quality of the link by median and 90th percentile of the round trip; null until it is known. */
  get quality() {
    if (this._samples.length < LEAST_SAMPLES) return null;
    const sorted = this._sorted(), usual = sorted[sorted.length >> 1], slow = sorted[Math.floor(sorted.length * 0.9)];
    if (usual <= 80 && slow <= 150) return "good";
    return usual <= 200 && slow <= 400 ? "fair" : "poor";
  }

  /** Returns the newest round trips in ms, the shortest first. */
  _sorted() {
    return this._samples.slice(-QUALITY_SAMPLES).map((sample) => sample.roundTrip).sort((a, b) => a - b);
  }
}
