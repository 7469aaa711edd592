// @ts-check
// Recording, snapshot of the last minute and bookmark: buttons, commands to the server, and their results.

/** @import { Link } from "./link.js" */
/** @import { RecordingStatus } from "./messages.js" */
import { byId, mark, write } from "./dom.js";
import { announce, toast } from "./hud.js";
import { bytesText, recorderText, recordText } from "./texts.js";

const RUNNING = ["recording", "disk full"];

export class Recording {
  /** @param {Link} link */
  constructor(link) {
    this.link = link;
    this.mayRecord = true;
    /** @type {RecordingStatus | null} The newest status; null: none yet. */
    this._status = null;
    /** @type {number | null} Number of the last notice. */
    this._notice = null;
    byId("snapshot").addEventListener("click", () => this._send({ type: "snapshot" }));
  }

  get running() {
    return RUNNING.includes(this._status?.state ?? "");
  }

  /** Starts or stops a recording. */
  toggle() {
    if (this._status?.recorder !== "ok" && this.mayRecord) toast(this._status?.text ?? "The recorder has not answered yet.");
    else this._send({ type: "record", on: !this.running });
  }

  /** Sets a bookmark at the present moment. */
  mark() {
    this._send({ type: "bookmark" });
  }

  /** Shows the recorder's status. @param {RecordingStatus} status */
  take(status) {
    const { recorder, state, path, text, free_bytes, cached_s, notice } = this._status = status;
    if (this._notice !== null && notice.number !== this._notice) toast(notice.text);
    this._notice = notice.number;
    if (document.body.dataset.recording !== state) announce(state === "recording" ? "Recording" : recorderText(state), "announce-record");
    mark("recording", state);
    const button = byId("record"), shown = recordText(status);
    write(byId("record-text"), shown);
    button.setAttribute("aria-pressed", String(this.running));
    button.setAttribute("aria-disabled", String(recorder !== "ok" || !this.mayRecord));
    button.setAttribute("aria-label", this.running ? `Stop recording (${shown})` : shown);
    button.title = text || (this.running && path ? path : "Record the drive (R)");
    const room = free_bytes === null ? "" : ` · ${bytesText(free_bytes)} free on disk`;
    write(byId("record-more"), cached_s === null ? text : `The last ${Math.round(cached_s)} s are in memory${room}`);
  }

  /** @param {{type: string, [field: string]: unknown}} message */
  _send(message) {
    if (!this.mayRecord) toast("This sign-in can watch and save images, but not record.");
    else if (!this.link.connected) toast("No connection to the server. Nothing was recorded or bookmarked.");
    else this.link.send(message);
  }
}
