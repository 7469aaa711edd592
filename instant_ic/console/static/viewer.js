// @ts-check
// The view in WebGL 2: the camera's image and the virtual space, rendered alike.

/** @import { Scene } from "./images.js" */
/** @import { Layer } from "./layers.js" */
/** @import { Vec3 } from "./math.js" */
import { plain } from "./colour.js";
import { LayerRenderer } from "./layers.js";
import { identity } from "./math.js";
import { createTexture, Program, setImage } from "./program.js";

const DARK = [9, 11, 14]; // before the first image

// A view rendered by the server, which fades out towards its edge.
const FRAGMENT = `
precision highp float;
in vec2 screen;
out vec4 colour;
uniform sampler2D view;
uniform mat3 viewFromLook;
uniform vec2 tanHalf, viewTanHalf; // of the shown field of view and of the rendered view's
uniform vec3 gain;
void main() {
  vec3 d = viewFromLook * vec3(1.0, -screen.x * tanHalf.x, screen.y * tanHalf.y);
  vec2 at = vec2(-d.y, d.z) / (d.x * viewTanHalf), edge = smoothstep(1.0, 0.94, abs(at));
  vec3 rgb = textureLod(view, vec2(0.5 + 0.5 * at.x, 0.5 - 0.5 * at.y), 0.0).rgb;
  colour = vec4(rgb * gain, d.x > 0.0 ? edge.x * edge.y : 0.0);
}`;

/** Width and height of the sampled images in pixels. */
const SAMPLE = /** @type {const} */ ([64, 40]);
// Pause after a frame that the CPU rendered, as a share of its duration, and the longest pause.
const REST = 0.3, MOST_REST_MS = 100;

/** @typedef {{1: number[], 2: number[], weights: number[]}} Samples Colours by kind of image: 3 values per pixel, 0..1. */

export class GlViewer {
  /**
   * Throws when WebGL 2 is missing.
   * @param {HTMLCanvasElement} canvas @param {boolean} full render all pixels, even on the CPU
   */
  constructor(canvas, full = false) {
    const gl = canvas.getContext("webgl2", {
      alpha: false, antialias: false, depth: true, stencil: true, powerPreference: "high-performance" });
    if (!gl) throw new Error("WebGL 2 is missing");
    this.gl = gl;
    this.canvas = canvas;
    const info = gl.getExtension("WEBGL_debug_renderer_info");
    const renderer = String(gl.getParameter(info ? info.UNMASKED_RENDERER_WEBGL : gl.RENDERER));
    // With software rendering, the page uses fewer pixels and plain look-ups.
    this.slow = !full && /swiftshader|llvmpipe|software|basic render/i.test(renderer);
    this.lost = false;
    canvas.addEventListener("webglcontextlost", () => { this.lost = true; });
    this._renderer = new LayerRenderer(gl, this.slow);
    this._overlay = new Program(gl, FRAGMENT);
    this._panorama = createTexture(gl, DARK);
    this._view = createTexture(gl, DARK);
    this._samples = this._target(...SAMPLE);
    /** @type {WebGLSync | null} Fence that is signalled when the CPU has rendered the last frame. */
    this._fence = null;
    this._renderedAt = 0;
    /** Earliest time of the next frame, which leaves time for messages and new views. */
    this.restUntil = 0;
    // Drivers translate a program at its first use. Using each now keeps this from delaying the first frame after a switch.
    gl.viewport(0, 0, 1, 1);
    this._renderer.renderFar(this._panorama, identity, [1, 1]);
    this._renderView({ viewFromLook: identity, tanHalf: [1, 1], viewTanHalf: [1, 1] }, plain);
  }

  /** @param {ImageBitmap} bitmap */
  setPanorama(bitmap) {
    setImage(this.gl, this._panorama, bitmap);
  }

  /** @param {ImageBitmap} bitmap */
  setView(bitmap) {
    setImage(this.gl, this._view, bitmap);
  }

  /** Replaces the layers, which are rendered for scenes with a place. @param {Layer[]} layers */
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
    if (scene.blend > 0) this._renderVirtual(scene, width, height, scene.viewGain);
    if (scene.blend < 1) {
      if (scene.blend > 0) gl.enable(gl.BLEND);
      gl.blendColor(0, 0, 0, 1 - scene.blend);
      gl.blendFunc(gl.CONSTANT_ALPHA, gl.ONE_MINUS_CONSTANT_ALPHA);
      this._renderReal(scene, width, height, scene.panoramaGain);
      gl.disable(gl.BLEND);
    }
    if (!this.slow) return;
    if (this._fence) gl.deleteSync(this._fence);
    this._fence = gl.fenceSync(gl.SYNC_GPU_COMMANDS_COMPLETE, 0);
    this._renderedAt = performance.now();
    gl.flush();
  }

  /** True while the CPU renders the last frame. It must be read until it is false. */
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
   * Returns small images of panorama and view in the same projection, without colour matching. `weights` are 0 where the
   * view shows estimated surfaces.
   * @param {Scene} scene @returns {Samples}
   */
  sample(scene) {
    const gl = this.gl, [width, height] = SAMPLE, pixels = new Uint8Array(4 * width * height);
    const read = () => {
      gl.readPixels(0, 0, width, height, gl.RGBA, gl.UNSIGNED_BYTE, pixels);
      const values = Array.from(pixels, (value) => value / 255);
      return { colours: values.filter((_, i) => i % 4 < 3), alpha: values.filter((_, i) => i % 4 === 3) };
    };
    gl.bindFramebuffer(gl.FRAMEBUFFER, this._samples);
    this._renderReal(scene, width, height, plain);
    const panorama = read();
    this._renderVirtual(scene, width, height, plain);
    const view = read();
    gl.bindFramebuffer(gl.FRAMEBUFFER, null);
    return { 1: panorama.colours, 2: view.colours, weights: view.alpha };
  }

  /** @param {Scene} scene @param {number} width @param {number} height @param {Vec3} gain */
  _renderReal(scene, width, height, gain) {
    const { glide, panoramaFromLook, tanHalf } = scene, image = this._panorama;
    this.gl.viewport(0, 0, width, height);
    if (!glide || !this._renderer.ready) return this._renderer.renderFar(image, panoramaFromLook, tanHalf, gain);
    const camera = { ...scene, position: glide.to }, photo = { image, ...glide.from };
    this._renderer.render(camera, width, height, gain, photo, this.gl.isEnabled(this.gl.BLEND));
  }

  /** @param {Scene} scene @param {number} width @param {number} height @param {Vec3} gain */
  _renderVirtual(scene, width, height, gain) {
    if (scene.place && this._renderer.ready) return this._renderer.render({ ...scene, position: scene.place }, width, height, gain);
    const gl = this.gl;
    gl.viewport(0, 0, width, height);
    // Beyond the rendered view's edge, the camera's image is shown dim and grey.
    this._renderer.renderFar(this._panorama, scene.panoramaFromLook, scene.tanHalf, plain, 0, 1);
    gl.enable(gl.BLEND);
    gl.blendFuncSeparate(gl.SRC_ALPHA, gl.ONE_MINUS_SRC_ALPHA, gl.ONE, gl.ZERO);
    this._renderView(scene, gain);
    gl.disable(gl.BLEND);
  }

  /** @param {Pick<Scene, "viewFromLook" | "tanHalf" | "viewTanHalf">} scene @param {Vec3} gain */
  _renderView({ viewFromLook, tanHalf, viewTanHalf }, gain) {
    this._overlay.fill({ view: this._view, viewFromLook, tanHalf, viewTanHalf, gain });
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
}
