// @ts-check
// The view in WebGL 2: the camera's image and the virtual space, by one renderer.

/** @import { Colour } from "./colour.js" */
/** @import { Scene } from "./images.js" */
/** @import { Layer } from "./layers.js" */
import { plain } from "./colour.js";
import { LayerRenderer } from "./layers.js";
import { identity } from "./math.js";
import { Program } from "./program.js";

const VIEW = 1; // texture unit of the rendered view

// A rendered view of the server, which fades out towards its edge.
const FRAGMENT = `
precision highp float;
in vec2 screen;
out vec4 colour;
uniform sampler2D view;
uniform mat3 viewFromLook;
uniform vec2 tanHalf, viewTanHalf; // of the shown field of view and of the rendered one
uniform vec3 gain, offset;
void main() {
  vec3 d = viewFromLook * vec3(1.0, -screen.x * tanHalf.x, screen.y * tanHalf.y);
  vec2 at = vec2(-d.y, d.z) / (d.x * viewTanHalf), edge = smoothstep(1.0, 0.94, abs(at));
  vec3 rgb = textureLod(view, vec2(0.5 + 0.5 * at.x, 0.5 - 0.5 * at.y), 0.0).rgb;
  colour = vec4(rgb * gain + offset, d.x > 0.0 ? edge.x * edge.y : 0.0);
}`;

/** Size of the samples, cells; each is the mean of SAMPLE_FINE × SAMPLE_FINE pixels. */
export const SAMPLE = /** @type {const} */ ([40, 24]), SAMPLE_FINE = 4;
// Pause between two frames that the CPU renders, as a share of the time that it takes for one, and the longest.
const REST = 0.3, MOST_REST_MS = 100;

/** @typedef {{1: number[], 2: number[], weights: number[]}} Samples Colours by kind of image. */

export class GlViewer {
  /**
   * Throws when WebGL 2 is missing.
   * @param {HTMLCanvasElement} canvas @param {boolean} full all pixels, also where the CPU renders
   */
  constructor(canvas, full = false) {
    const gl = canvas.getContext("webgl2", {
      alpha: false, antialias: false, depth: true, stencil: true, powerPreference: "high-performance" });
    if (!gl) throw new Error("WebGL 2 is missing");
    this.gl = gl;
    this.canvas = canvas;
    const info = gl.getExtension("WEBGL_debug_renderer_info");
    const renderer = String(gl.getParameter(info ? info.UNMASKED_RENDERER_WEBGL : gl.RENDERER));
    // Software rendering: the page then uses fewer pixels and plain look-ups.
    this.slow = !full && /swiftshader|llvmpipe|software|basic render/i.test(renderer);
    this.lost = false;
    canvas.addEventListener("webglcontextlost", () => { this.lost = true; });
    this._renderer = new LayerRenderer(gl, this.slow);
    this._overlay = new Program(gl, FRAGMENT);
    this._panorama = this._texture(gl.REPEAT);
    this._view = this._texture(gl.CLAMP_TO_EDGE);
    this._samples = this._target(SAMPLE[0] * SAMPLE_FINE, SAMPLE[1] * SAMPLE_FINE);
    /** @type {WebGLSync | null} Signalled when the CPU has rendered the last frame. */
    this._fence = null;
    this._renderedAt = 0;
    /** The next frame pauses, so that messages and new views are not delayed. */
    this.restUntil = 0;
    // A program is translated at its first use; that must not delay the first frame after a switch.
    gl.viewport(0, 0, 1, 1);
    this._renderer.renderFar(this._panorama, identity, [1, 1]);
    this._renderView({ viewFromLook: identity, tanHalf: [1, 1], viewTanHalf: [1, 1] }, plain);
  }

  /** @param {ImageBitmap} bitmap */
  setPanorama(bitmap) {
    this._upload(this._panorama, bitmap);
  }

  /** @param {ImageBitmap} bitmap */
  setView(bitmap) {
    this._upload(this._view, bitmap);
  }

  /** Replaces the layers that are rendered for a scene with their camera. @param {Layer[]} layers */
  loadLayers(layers) {
    const first = !this._renderer.ready;
    this._renderer.load(layers);
    if (!first) return;
    this.gl.bindFramebuffer(this.gl.FRAMEBUFFER, this._samples);
    this._renderer.render({ mapFromLook: identity, position: layers[0].position, tanHalf: [1, 1] }, 2, 2, plain);
    this.gl.bindFramebuffer(this.gl.FRAMEBUFFER, null);
  }

  /** @param {Scene} scene */
  render(scene) {
    const gl = this.gl, { width, height } = this.canvas;
    if (scene.blend > 0) this._renderVirtual(scene, width, height, scene.viewColour);
    if (scene.blend < 1) {
      // Over the virtual space.
      if (scene.blend > 0) gl.enable(gl.BLEND);
      gl.blendColor(0, 0, 0, 1 - scene.blend);
      gl.blendFunc(gl.CONSTANT_ALPHA, gl.ONE_MINUS_CONSTANT_ALPHA);
      this._renderReal(scene, width, height, scene.panoramaColour);
      gl.disable(gl.BLEND);
    }
    if (!this.slow) return;
    if (this._fence) gl.deleteSync(this._fence);
    this._fence = gl.fenceSync(gl.SYNC_GPU_COMMANDS_COMPLETE, 0);
    this._renderedAt = performance.now();
    gl.flush();
  }

  /** True while the CPU renders the last frame. Read it until it is false. */
  get busy() {
    const gl = this.gl;
    if (!this._fence || this.lost) return false;
    if (gl.getSyncParameter(this._fence, gl.SYNC_STATUS) !== gl.SIGNALED) return true;
    gl.deleteSync(this._fence);
    this._fence = null;
    const now = performance.now();
    this.restUntil = now + Math.min(REST * (now - this._renderedAt), MOST_REST_MS);
    return false;
  }

  /**
   * Returns panorama and view without colour matching, small and in the same projection: {1: panorama, 2: view} with
   * 3 values per cell, 0..1, and `weights`, which are 0 where the view shows no seen place.
   * @param {Scene} scene @returns {Samples}
   */
  sample(scene) {
    const gl = this.gl, width = SAMPLE[0] * SAMPLE_FINE, height = SAMPLE[1] * SAMPLE_FINE;
    const pixels = new Uint8Array(4 * width * height);
    const read = () => {
      gl.readPixels(0, 0, width, height, gl.RGBA, gl.UNSIGNED_BYTE, pixels);
      return cells(pixels);
    };
    gl.bindFramebuffer(gl.FRAMEBUFFER, this._samples);
    this._renderReal(scene, width, height, plain);
    const panorama = read();
    this._renderVirtual(scene, width, height, plain);
    const view = read();
    gl.bindFramebuffer(gl.FRAMEBUFFER, null);
    return { 1: panorama.colours, 2: view.colours, weights: view.alpha };
  }

  /** @param {Scene} scene @param {number} width @param {number} height @param {Colour} colour */
  _renderReal(scene, width, height, colour) {
    const { glide, mapFromLook, tanHalf } = scene, image = this._panorama;
    this.gl.viewport(0, 0, width, height);
    if (!glide || !this._renderer.ready) this._renderer.renderFar(image, scene.panoramaFromLook, tanHalf, colour);
    else {
      const camera = { mapFromLook, position: glide.to, tanHalf };
      this._renderer.render(camera, width, height, colour, { image, ...glide.from }, this.gl.isEnabled(this.gl.BLEND));
    }
  }

  /** @param {Scene} scene @param {number} width @param {number} height @param {Colour} colour */
  _renderVirtual(scene, width, height, colour) {
    if (scene.camera && this._renderer.ready) return this._renderer.render(scene.camera, width, height, colour);
    const gl = this.gl;
    gl.viewport(0, 0, width, height);
    // Beyond the rendered view's edge the camera's image continues, dim and grey.
    this._renderer.renderFar(this._panorama, scene.panoramaFromLook, scene.tanHalf, plain, 0, 1);
    gl.enable(gl.BLEND);
    gl.blendFuncSeparate(gl.SRC_ALPHA, gl.ONE_MINUS_SRC_ALPHA, gl.ONE, gl.ZERO);
    this._renderView(scene, colour);
    gl.disable(gl.BLEND);
  }

  /** @param {Pick<Scene, "viewFromLook" | "tanHalf" | "viewTanHalf">} scene @param {Colour} colour */
  _renderView({ viewFromLook, tanHalf, viewTanHalf }, colour) {
    const gl = this.gl, at = this._overlay.use();
    gl.activeTexture(gl.TEXTURE0 + VIEW);
    gl.bindTexture(gl.TEXTURE_2D, this._view);
    gl.uniform1i(at("view"), VIEW);
    gl.uniformMatrix3fv(at("viewFromLook"), true, viewFromLook); // our matrices are row-major
    gl.uniform2fv(at("tanHalf"), tanHalf);
    gl.uniform2fv(at("viewTanHalf"), viewTanHalf);
    gl.uniform3fv(at("gain"), colour.gain);
    gl.uniform3fv(at("offset"), colour.offset);
    gl.drawArrays(gl.TRIANGLES, 0, 3);
  }

  /** @param {number} width @param {number} height */
  _target(width, height) {
    const gl = this.gl, buffer = gl.createFramebuffer();
    gl.bindFramebuffer(gl.FRAMEBUFFER, buffer);
    for (const [attachment, format] of [[gl.COLOR_ATTACHMENT0, gl.RGBA8], [gl.DEPTH_STENCIL_ATTACHMENT, gl.DEPTH24_STENCIL8]]) {
      const pixels = gl.createRenderbuffer();
      gl.bindRenderbuffer(gl.RENDERBUFFER, pixels);
      gl.renderbufferStorage(gl.RENDERBUFFER, format, width, height);
      gl.framebufferRenderbuffer(gl.FRAMEBUFFER, attachment, gl.RENDERBUFFER, pixels);
    }
    gl.bindFramebuffer(gl.FRAMEBUFFER, null);
    return buffer;
  }

  /** @param {number} wrap */
  _texture(wrap) {
    const gl = this.gl, texture = gl.createTexture();
    gl.activeTexture(gl.TEXTURE0 + VIEW);
    gl.bindTexture(gl.TEXTURE_2D, texture);
    gl.texImage2D(gl.TEXTURE_2D, 0, gl.RGB8, 1, 1, 0, gl.RGB, gl.UNSIGNED_BYTE, new Uint8Array([9, 11, 14]));
    gl.texParameteri(gl.TEXTURE_2D, gl.TEXTURE_MIN_FILTER, gl.LINEAR);
    gl.texParameteri(gl.TEXTURE_2D, gl.TEXTURE_MAG_FILTER, gl.LINEAR);
    gl.texParameteri(gl.TEXTURE_2D, gl.TEXTURE_WRAP_S, wrap);
    gl.texParameteri(gl.TEXTURE_2D, gl.TEXTURE_WRAP_T, gl.CLAMP_TO_EDGE);
    return texture;
  }

  /** @param {WebGLTexture} texture @param {ImageBitmap} bitmap */
  _upload(texture, bitmap) {
    const gl = this.gl;
    gl.activeTexture(gl.TEXTURE0 + VIEW);
    gl.bindTexture(gl.TEXTURE_2D, texture);
    gl.texImage2D(gl.TEXTURE_2D, 0, gl.RGB8, gl.RGB, gl.UNSIGNED_BYTE, bitmap);
  }
}

/**
 * Averages RGBA pixels over the cells: 3 colours and 1 alpha per cell, 0..1.
 * @param {Uint8Array} pixels
 * @returns {{colours: number[], alpha: number[]}}
 */
export function cells(pixels) {
  const [columns, rows] = SAMPLE, fine = SAMPLE_FINE, share = 1 / (255 * fine * fine);
  const colours = new Array(3 * columns * rows).fill(0), alpha = new Array(columns * rows).fill(0);
  for (let i = 0; i < pixels.length / 4; i++) {
    const cell = Math.floor(i / (columns * fine) / fine) * columns + Math.floor((i % (columns * fine)) / fine);
    for (let channel = 0; channel < 3; channel++) colours[3 * cell + channel] += pixels[4 * i + channel] * share;
    alpha[cell] += pixels[4 * i + 3] * share;
  }
  return { colours, alpha };
}
