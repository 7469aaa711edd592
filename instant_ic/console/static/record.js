// @ts-check
// Record button, snapshot of the last minute and bookmarks: commands to the server, and their results.

/** @import { Drive } from "./drive.js" */
/** @import { Link } from "./link.js" */
/** @import { RecordingStatus } from "./messages.js" */
import { byId, elementOf, mark, write } from "./dom.js";
import { announce, replaceLines, toast } from "./hud.js";
import { bytesText, clockText, recorderText, recordText } from "./texts.js";

const RUNNING = ["recording", "disk full", "paused"];

/** @type {RecordingStatus} */
const NO_ANSWER = {
  type: "recording", recorder: "missing", state: "none", text: "The recorder has not answered yet.", bookmarks: [], snapshots: [],
  notice: { number: 0, text: "", level: "ok" }, path: null, seconds: null, bytes: null, free_bytes: null, cached_s: null,
};

export class Recording {
  /**
   * While a bookmark's name is typed, `drive` is stopped and the link reports "away", which keeps the robot stopped.
   * @param {Link} link @param {Drive} drive
   */
  constructor(link, drive) {
    this.link = link;
    this.drive = drive;
    this.mayRecord = true;
    this._status = NO_ANSWER;
    /** @type {number | null} */
    this._notice = null;
    const name = elementOf("mark-name", HTMLInputElement);
    byId("record").addEventListener("click", () => this.toggle());
    byId("snapshot").addEventListener("click", () => this._send({ type: "snapshot" }));
    byId("mark").addEventListener("click", () => this.mark());
    byId("marks-open").addEventListener("click", () => this._openMarks());
    // Asked each time: the dialog's "close" event can come after the next key, which would then be lost.
    const marks = elementOf("marks", HTMLDialogElement);
    link.away = () => marks.open;
    byId("mark-form").addEventListener("submit", (event) => {
      event.preventDefault();
      this.mark(name.value.trim());
      name.value = "";
    });
  }

  get running() {
    return RUNNING.includes(this._status.state);
  }

  toggle() {
    if (this._status.recorder !== "ok" && this.mayRecord) toast(this._status.text);
    else this._send({ type: "record", on: !this.running });
  }

  /** Sets a bookmark; without a name it gets a number. */
  mark(name = "") {
    this._send({ type: "bookmark", name: name || `Mark ${this._status.bookmarks.length + 1}` });
  }

  /** Shows the recorder's status. @param {RecordingStatus} status */
  take(status) {
    this._status = status;
    const { number, text } = status.notice;
    if (this._notice !== null && number !== this._notice) toast(text);
    this._notice = number;
    this._showButton();
    this._showLists();
  }

  /** @param {{type: string, [field: string]: unknown}} message */
  _send(message) {
    if (!this.mayRecord) toast("This sign-in can watch and save images, but not record.");
    else if (!this.link.connected) toast("No connection to the server. Nothing was recorded or bookmarked.");
    else this.link.send(message);
  }

  _openMarks() {
    this.drive.stop("the bookmark dialog is open");
    elementOf("marks", HTMLDialogElement).showModal();
  }

  _showButton() {
    const { recorder, state, path, text } = this._status, button = byId("record"), shown = recordText(this._status);
    if (document.body.dataset.recording !== state) announce(state === "recording" ? "Recording" : recorderText(state));
    mark("recording", state);
    write(byId("record-text"), shown);
    button.setAttribute("aria-pressed", String(this.running));
    button.setAttribute("aria-disabled", String(recorder !== "ok" || !this.mayRecord));
    button.setAttribute("aria-label", this.running ? `Stop recording (${shown})` : shown);
    button.title = text || (this.running && path ? path : "Record the drive (R)");
  }

  _showLists() {
    const { bookmarks, snapshots, free_bytes, cached_s, text } = this._status;
    list(byId("marks-list"), bookmarks.map((one) =>
      `${one.at}  ${one.name}` + (one.recording ? `  (${clockText(one.seconds)} in ${one.recording})` : "")));
    list(byId("snapshots-list"), (snapshots ?? []).map((one) => `${one.name}: ${one.text || one.state}`));
    const room = free_bytes === null ? "" : ` · ${bytesText(free_bytes)} free on disk`;
    write(byId("record-more"), cached_s === null ? text : `The last ${Math.round(cached_s)} s are in memory${room}`);
  }
}

/** Lists lines, newest first. @param {HTMLElement} element @param {string[]} lines */
function list(element, lines) {
  replaceLines(element, lines.length ? lines.reverse() : ["None yet."]);
}
