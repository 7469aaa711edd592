// @ts-check
// Access to the page's elements.

/** Returns the element of index.html with this id; throws if it is missing. @param {string} id */
export function byId(id) {
  const element = document.getElementById(id);
  if (!element) throw new Error(`index.html has no element #${id}`);
  return element;
}

/** @template {Element} T @param {string} id @param {new () => T} type @returns {T} */
export function elementOf(id, type) {
  const element = byId(id);
  if (!(element instanceof type)) throw new Error(`#${id} of index.html is not a ${type.name}`);
  return element;
}

/** HTML elements of a CSS selector. @param {string} selector @returns {HTMLElement[]} */
export const all = (selector) => [...document.querySelectorAll(selector)].filter((element) => element instanceof HTMLElement);

/** 2D context of a canvas. @param {HTMLCanvasElement} canvas @param {CanvasRenderingContext2DSettings} [options] */
export function context2d(canvas, options) {
  const context = canvas.getContext("2d", options);
  if (!context) throw new Error("2D canvas is missing");
  return context;
}

/** Sets an element's text if it differs, so that screen readers do not repeat it. @param {Element} element @param {string} text */
export function write(element, text) {
  if (element.textContent !== text) element.textContent = text;
}

/** Sets an attribute if it differs, so that the browser does not render again. @param {string} id @param {string} name @param {string} value */
export function attribute(id, name, value) {
  const element = byId(id);
  if (element.getAttribute(name) !== value) element.setAttribute(name, value);
}

/** Sets a data attribute of the page, for styles and tests, if it differs. @param {string} name @param {string} value */
export function mark(name, value) {
  if (document.body.dataset[name] !== value) document.body.dataset[name] = value;
}
