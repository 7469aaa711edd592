// @ts-check
// The lease: the right to drive, and how this page gets it and gives it back.

/** @import { Link } from "./link.js" */
/** @import { Session } from "./messages.js" */

export const WATCH_ONLY = "This sign-in can watch and stop the robot, but not drive it.";
export const OTHER_DRIVES = "Another operator is driving. Press Take over to drive.";
export const ELSEWHERE = "Another operator is driving through another connection, and must hand over first.";

/** Event "change" when the server has reported the session. */
export class Lease extends EventTarget {
  /** @param {Link} link */
  constructor(link) {
    super();
    this.link = link;
    this.mayDrive = true; // false: signed in to watch
    /** @type {Session["driver"]} */
    this.driver = "none";
    this.door = ""; // connection of an operator who drives without a page of this server
    this.clients = 0;
    this.estop = false;
    this._handedOver = false; // the operator gave the lease back
    link.addEventListener("open", () => {
      if (this.mayDrive) this._request(false);
    });
    link.addEventListener("lost", () => { this.driver = "none"; });
  }

  /** True if this page's drive commands are obeyed. */
  get drives() {
    return this.driver === "you" && !this.estop;
  }

  /** @param {Session} session */
  take(session) {
    // The lease has timed out and was not given back, so request it again. Keys must then be pressed again.
    if (this.driver === "you" && session.driver === "none" && !this._handedOver) this._request(false);
    this.driver = session.driver;
    this.door = session.door ?? "";
    this.clients = session.clients;
    this.estop = session.estop;
    this.dispatchEvent(new Event("change"));
  }

  /** Requests the lease if nobody drives; otherwise returns the reason for the operator. */
  request() {
    if (!this.mayDrive) return WATCH_ONLY;
    if (this.driver === "none") this._request(false);
    return this.driver === "other" ? this.refusal : "";
  }

  /** Text for an operator who cannot drive because another one does, and what to do. */
  get refusal() {
    return this.door ? ELSEWHERE : OTHER_DRIVES;
  }

  takeOver() {
    this._handedOver = false;
    this._request(true);
  }

  handOver() {
    this._handedOver = true;
    this.link.send({ type: "yield" });
  }

  /** @param {boolean} take */
  _request(take) {
    this.link.send({ type: "lease", take });
  }
}
