// A stand-in for the browser, enough for modules that touch no element: events, timers, WebSocket and fetch.

class Target extends EventTarget {
  hidden = false;
}

globalThis.window = new Target();
globalThis.document = new Target();
globalThis.HTMLInputElement = class {
  type = "text";
};

/** WebSockets that the page has opened, oldest first. */
export const sockets = [];

globalThis.WebSocket = class {
  static OPEN = 1;
  readyState = 0;
  sent = [];

  constructor(url) {
    this.url = url;
    sockets.push(this);
  }

  send(text) {
    this.sent.push(JSON.parse(text));
  }

  close() {
    this.readyState = 3;
    this.onclose?.();
  }

  /** The server accepts the connection. */
  accept() {
    this.readyState = 1;
    this.onopen();
  }

  /** The server sends a message: an object, or the bytes of a frame. */
  deliver(message) {
    this.onmessage({ data: message instanceof ArrayBuffer ? message : JSON.stringify(message) });
  }
};

/** Answer of every fetch. */
export const server = { status: 200, requests: [] };
globalThis.fetch = async (path) => {
  server.requests.push(path);
  return { status: server.status, ok: server.status < 400 };
};

/** Dispatches an event with these properties. */
export function fire(target, name, properties = {}) {
  target.dispatchEvent(Object.assign(new Event(name), { preventDefault() {} }, properties));
}

/** Time of performance.now(), ms; advance() also runs the timers (node:test's mock timers). */
export class Time {
  constructor(mock) {
    this.now = 1000;
    this.mock = mock;
    mock.timers.enable({ apis: ["setTimeout", "setInterval"] });
    mock.method(performance, "now", () => this.now);
  }

  advance(ms) {
    for (let passed = 0; passed < ms; passed += 10) {
      this.now += 10;
      this.mock.timers.tick(10);
    }
  }
}
