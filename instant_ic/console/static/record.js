// Record button, snapshot of the last minute and bookmarks: commands to the server, and their results.

import { announce, toast } from "./hud.js";

const byId = (id) => document.getElementById(id);
const BUSY = { ending: "Saving…", "disk full": "Disk full", failed: "Failed", paused: "Paused" };

export class Recording {
  /** While a bookmark's name is typed, `drive` is stopped and the link reports "away", which keeps the robot stopped. */
  constructor(link, drive) {
    this.link = link;
    this.drive = drive;
    this.mayRecord = true;
    this._told = { recorder: "missing", state: "none", text: "The recorder has not answered yet.", bookmarks: [], snapshots: [] };
    this._notice = null;
    byId("record").addEventListener("click", () => this.toggle());
    byId("snapshot").addEventListener("click", () => this._wish({ type: "snapshot" }));
    byId("mark").addEventListener("click", () => this.mark());
    byId("marks-open").addEventListener("click", () => this._openMarks());
    byId("marks").addEventListener("close", () => { link.away = false; });
    byId("mark-form").addEventListener("submit", (event) => {
      event.preventDefault();
      this.mark(byId("mark-name").value.trim());
      byId("mark-name").value = "";
    });
  }

  get running() {
    return ["recording", "disk full", "paused"].includes(this._told.state);
  }

  toggle() {
    if (this._told.recorder !== "ok" && this.mayRecord) toast(this._told.text);
    else this._wish({ type: "record", on: !this.running });
  }

  /** Sets a bookmark; without a name it gets a number. */
  mark(name) {
    this._wish({ type: "bookmark", name: name || `Mark ${this._told.bookmarks.length + 1}` });
  }

  /** Shows a "recording" message. */
  take(message) {
    this._told = { bookmarks: [], snapshots: [], ...message };
    const { number, text } = message.notice;
    if (this._notice !== null && number !== this._notice) toast(text);
    this._notice = number;
    this._showButton();
    this._showLists();
  }

  _wish(message) {
    if (!this.mayRecord) toast("This sign-in can watch and save images, but not record.");
    else if (!this.link.connected) toast("No connection to the server. Nothing was recorded or bookmarked.");
    else this.link.send(message);
  }

  _openMarks() {
    this.drive.stop("the bookmark dialog is open");
    this.link.away = true;
    byId("marks").showModal();
  }

  _showButton() {
    const { recorder, state, seconds, bytes, text } = this._told, button = byId("record");
    const amount = `${clock(seconds ?? 0)} · ${megabytes(bytes ?? 0)}`;
    const shown = state === "recording" ? amount : BUSY[state] ?? "Record";
    const usable = recorder === "ok" && this.mayRecord;
    if (document.body.dataset.recording !== state) announce(state === "recording" ? "Recording" : BUSY[state] ?? "");
    document.body.dataset.recording = state;
    write(byId("record-text"), shown);
    button.setAttribute("aria-pressed", this.running);
    button.setAttribute("aria-disabled", !usable);
    button.setAttribute("aria-label", this.running ? `Stop recording (${shown})` : shown);
    button.title = text || (this.running ? this._told.path : "Record the drive (R)");
  }

  _showLists() {
    const { bookmarks, snapshots, free_bytes, cached_s } = this._told;
    const marks = bookmarks.map(({ at, name, seconds, recording }) =>
      `${at}  ${name}` + (recording ? `  (${clock(seconds)} in ${recording})` : ""));
    list(byId("marks-list"), marks.reverse(), "None yet.");
    list(byId("snapshots-list"), snapshots.map(({ name, state, words }) => `${name}: ${words || state}`).reverse(), "None yet.");
    const room = free_bytes == null ? "" : ` · ${megabytes(free_bytes)} free on disk`;
    write(byId("record-more"), cached_s === undefined ? this._told.text : `The last ${Math.round(cached_s)} s are in memory${room}`);
  }
}

function clock(seconds) {
  const whole = Math.floor(seconds ?? 0), minutes = Math.floor(whole / 60);
  return `${minutes}:${String(whole % 60).padStart(2, "0")}`;
}

function megabytes(bytes) {
  return bytes < 1e9 ? `${Math.round(bytes / 1e6)} MB` : `${(bytes / 1e9).toFixed(1)} GB`;
}

function write(element, text) {
  if (element.textContent !== text) element.textContent = text;
}

function list(element, lines, none) {
  const key = lines.join("\n");
  if (element.dataset.key === key) return;
  element.dataset.key = key;
  element.replaceChildren(...(lines.length ? lines : [none]).map((line) => {
    const item = document.createElement("li");
    item.textContent = line;
    return item;
  }));
}
