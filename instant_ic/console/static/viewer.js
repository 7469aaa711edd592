// @ts-check
// The view in WebGL 2: panorama and rendered view in one projection and one pass.

/** @import { Scene } from "./images.js" */
/** @import { Layer } from "./layers.js" */
import { plain } from "./colour.js";
import { LayerRenderer } from "./layers.js";
import { identity, rotate } from "./math.js";
import { Program } from "./program.js";

const EDGE = 0.94; // the rendered view fades out from here to 1, its edge
const WITHIN = 1.1; // layers are rendered wider than shown by this factor where they are mixed: their edge stays out of sight
const RENDERED = 5; // texture unit of rendered layers
const SOFT_LEVEL = 4; // mipmap level of the view for unseen places

const COMMON = `
precision highp float;
in vec2 screen;
out vec4 colour;
uniform sampler2D view;
const vec3 GREY = vec3(0.30, 0.59, 0.11);

// Cubic B-spline by four bilinear look-ups: an enlarged small image stays smooth, without visible pixels.
vec4 smoothView(vec2 uv, vec2 size, float level) {
  vec2 p = uv * size - 0.5;
  vec2 i = floor(p), f = p - i;
  vec2 f2 = f * f, f3 = f2 * f;
  vec2 w0 = (1.0 - 3.0 * f + 3.0 * f2 - f3) / 6.0;
  vec2 w1 = (4.0 - 6.0 * f2 + 3.0 * f3) / 6.0;
  vec2 w3 = f3 / 6.0;
  vec2 w2 = 1.0 - w0 - w1 - w3;
  vec2 low = w0 + w1, high = w2 + w3;
  vec2 a = (i - 0.5 + w1 / low) / size, b = (i + 1.5 + w3 / high) / size;
  return mix(
    mix(textureLod(view, vec2(a.x, a.y), level), textureLod(view, vec2(b.x, a.y), level), high.x),
    mix(textureLod(view, vec2(a.x, b.y), level), textureLod(view, vec2(b.x, b.y), level), high.x), high.y);
}`;

// Once per view: seen places are sharp; the rest is a guess from its surroundings, so it is blurred and paler.
const SOFTEN = `${COMMON}
uniform sampler2D mask;
uniform vec2 softSize; // pixels of that mipmap level
void main() {
  vec2 uv = 0.5 + 0.5 * screen;
  float level = textureLod(mask, uv, 0.0).r, seen = smoothstep(0.0, 1.0, level);
  vec3 soft = smoothView(uv, softSize, ${SOFT_LEVEL}.0).rgb;
  colour = vec4(mix(mix(soft, vec3(dot(soft, GREY)), 0.5), textureLod(view, uv, 0.0).rgb, seen), level);
}`;

// A CPU executes all branches of a shader. Each combination of the constants has a program without the unused ones:
// REAL: the camera's image is visible; VIEW: the rendered view is; MOVED: the camera has moved since that was rendered;
// PLAIN: the CPU renders; SAMPLE: the result is the view with its confidence as alpha.
const FRAGMENT = `${COMMON}
uniform sampler2D panorama, depth;
uniform mat3 panoramaFromLook, viewFromLook;
uniform vec2 tanHalf;      // of the shown field of view
uniform vec2 viewTanHalf;  // of the rendered view
uniform vec2 viewSize;     // pixels
uniform float blend;       // 0 camera, 1 virtual space
uniform vec2 aside;        // motion to the right and up, divided by viewTanHalf, m
uniform float along;       // motion forward, m
uniform float perInverse;  // inverse depth along the axis of value 1 in the depth image, 1/m
uniform float mostInverse; // upper limit: nearer surfaces would tear
uniform vec3 panoramaGain, panoramaOffset, viewGain, viewOffset;
const float PI = 3.14159265358979;
const float EDGE = ${EDGE};
const vec3 NIGHT = vec3(0.035, 0.043, 0.055);

vec3 fromPanorama(vec3 direction) {
  vec3 d = panoramaFromLook * direction;
  float u = 0.5 - atan(d.y, d.x) / (2.0 * PI);
  float v = 0.5 - asin(clamp(d.z, -1.0, 1.0)) / PI;
  return textureLod(panorama, vec2(u, v), 0.0).rgb;
}

// Position in the rendered view of what the moved camera sees. Fixed-point iteration on the depth, from the
// nearest depth on, so that near surfaces cover far ones. The number of steps is even: where the iteration alternates
// between near and far, a gap opens behind an edge, and the far surface fills it. (Python: geometry/depth_picture.py.)
vec2 before(vec2 at) {
  vec2 perInverseDepth = aside - along * at;
  float inverse = mostInverse;
  for (int i = 0; i < 2; i++) {
    vec2 there = at + inverse * perInverseDepth;
    inverse = min(textureLod(depth, vec2(0.5 + 0.5 * there.x, 0.5 - 0.5 * there.y), 0.0).r * perInverse, mostInverse);
  }
  return at + inverse * perInverseDepth;
}

void main() {
  vec3 direction = normalize(vec3(1.0, -screen.x * tanHalf.x, screen.y * tanHalf.y));
  vec3 real = vec3(0.0);
  vec4 rendered = vec4(0.0);
  float inside = 0.0; // inside the rendered view, with a soft edge
  if (REAL) real = fromPanorama(direction) * panoramaGain + panoramaOffset;
  if (VIEW) {
    vec3 d = viewFromLook * direction;
    vec2 at = vec2(-d.y, d.z) / (d.x * viewTanHalf);
    if (MOVED) at = before(at);
    vec2 edge = smoothstep(1.0, EDGE, abs(at)), uv = vec2(0.5 + 0.5 * at.x, 0.5 - 0.5 * at.y);
    if (REAL || SAMPLE) inside = d.x > 0.0 ? edge.x * edge.y : 0.0;
    else inside = 1.0;
    // Four look-ups would be a third of the CPU's work.
    rendered = PLAIN ? textureLod(view, uv, 0.0) : smoothView(uv, viewSize, 0.0);
  }
  if (SAMPLE) colour = vec4(rendered.rgb, inside * rendered.a);
  else if (!VIEW) colour = vec4(real, 1.0);
  else {
    // Beyond the rendered view's edge the camera's image continues, dim and grey.
    vec3 around = mix(NIGHT, vec3(dot(real, GREY)), 0.35);
    colour = vec4(mix(real, mix(around, rendered.rgb * viewGain + viewOffset, inside), blend), 1.0);
  }
}`;

/** Size of the samples, cells; each is the mean of SAMPLE_FINE × SAMPLE_FINE pixels. */
export const SAMPLE = /** @type {const} */ ([40, 24]), SAMPLE_FINE = 4;
/** Largest motion over depth; nearer surfaces are moved by no more than this. */
export const MOST_PARALLAX = 0.5;
// Pause between two frames that the CPU renders, as a share of the time that it takes for one, and the longest.
const REST = 0.3, MOST_REST_MS = 100;

/** @typedef {{image: ImageBitmap, near_m: number}} Depth Grey; value v is the depth near_m * 255 / v along the axis. */
/** @typedef {{1: number[], 2: number[], weights: number[]}} Samples Colours by kind of image. */

export class GlViewer {
  /** Throws when WebGL 2 is missing. @param {HTMLCanvasElement} canvas */
  constructor(canvas) {
    const gl = canvas.getContext("webgl2", {
      alpha: false, antialias: false, depth: true, stencil: true, powerPreference: "high-performance" });
    if (!gl) throw new Error("WebGL 2 is missing");
    this.gl = gl;
    this.canvas = canvas;
    this.name = "webgl";
    const info = gl.getExtension("WEBGL_debug_renderer_info");
    const renderer = String(gl.getParameter(info ? info.UNMASKED_RENDERER_WEBGL : gl.RENDERER));
    // Software rendering: the page then uses fewer pixels and no blur.
    this.slow = /swiftshader|llvmpipe|software|basic render/i.test(renderer);
    this.lost = false;
    canvas.addEventListener("webglcontextlost", () => { this.lost = true; });
    /** @type {Map<string, Program>} By the constants of FRAGMENT. */
    this._programs = new Map();
    this._softener = new Program(gl, SOFTEN);
    this._panorama = this._texture(0, gl.REPEAT);
    this._view = this._texture(1, gl.CLAMP_TO_EDGE);
    this._mask = this._texture(2, gl.CLAMP_TO_EDGE);
    this._depth = this._texture(3, gl.CLAMP_TO_EDGE);
    this._softened = this._texture(4, gl.CLAMP_TO_EDGE);
    this._softTarget = gl.createFramebuffer();
    gl.bindFramebuffer(gl.FRAMEBUFFER, this._softTarget);
    gl.framebufferTexture2D(gl.FRAMEBUFFER, gl.COLOR_ATTACHMENT0, gl.TEXTURE_2D, this._softened, 0);
    gl.bindFramebuffer(gl.FRAMEBUFFER, null);
    gl.activeTexture(gl.TEXTURE1);
    gl.texParameteri(gl.TEXTURE_2D, gl.TEXTURE_MIN_FILTER, gl.LINEAR_MIPMAP_NEAREST);
    gl.texParameteri(gl.TEXTURE_2D, gl.TEXTURE_MAX_LEVEL, 0);
    this._viewUnit = 1; // 4: softened where the view was not seen
    this._perInverse = 0; // 1/m; 0: depth unknown
    this._viewSize = [1, 1];
    /** @type {LayerRenderer | null} Made with the first layers. */
    this._layers = null;
    /** @type {{buffer: WebGLFramebuffer, texture: WebGLTexture, depth: WebGLRenderbuffer, size: string} | null} */
    this._layerTarget = null;
    /** @type {WebGLSync | null} Signalled when the CPU has rendered the last frame. */
    this._fence = null;
    /** @type {WebGLFramebuffer | null} */
    this._samples = null;
    this._renderedAt = 0;
    /** The next frame pauses, so that messages and new views are not delayed. */
    this.restUntil = 0;
    // A program is translated at its first use; that must not delay the first frame after a switch.
    gl.viewport(0, 0, 1, 1);
    for (const [real, view, sample] of [[true, false, false], [false, true, false], [true, true, false], [false, true, true]])
      for (const moved of view ? [false, true] : [false]) {
        this._use({ REAL: real, VIEW: view, MOVED: moved, PLAIN: this.slow, SAMPLE: sample });
        gl.drawArrays(gl.TRIANGLES, 0, 3);
      }
  }

  /** @param {ImageBitmap} bitmap */
  setPanorama(bitmap) {
    this._upload(0, this._panorama, bitmap);
  }

  /**
   * @param {ImageBitmap} bitmap
   * @param {OffscreenCanvas | null} mask small grey image, bright where the view was seen; null: everywhere
   * @param {Depth | null} depth null: unknown
   */
  setView(bitmap, mask, depth) {
    this._upload(1, this._view, bitmap);
    this._viewSize = [bitmap.width, bitmap.height];
    this._viewUnit = mask ? 4 : 1;
    if (mask) this._soften(mask);
    this._perInverse = depth ? 1 / depth.near_m : 0;
    if (depth) this._upload(3, this._depth, depth.image);
  }

  /** Replaces the layers that are rendered for a scene with their camera. @param {Layer[]} layers */
  loadLayers(layers) {
    const first = this._layers === null;
    this._layers ??= new LayerRenderer(this.gl, this.slow);
    this._layers.load(layers);
    if (!first) return;
    // As for the other programs: not at the first switch.
    const buffer = this._targetForLayers(2, 2);
    this.gl.bindFramebuffer(this.gl.FRAMEBUFFER, buffer);
    this._layers.render({ mapFromLook: identity, position: layers[0].position, tanHalf: [1, 1] }, 2, 2, plain);
    this.gl.bindFramebuffer(this.gl.FRAMEBUFFER, null);
  }

  /** @param {Scene} scene */
  render(scene) {
    const gl = this.gl, { width, height } = this.canvas;
    if (scene.camera && this._layers && scene.blend === 1)
      this._layers.render(scene.camera, width, height, scene.viewColour);
    else this._render(scene, width, height, false, null);
    if (!this.slow) return;
    if (this._fence) gl.deleteSync(this._fence);
    this._fence = gl.fenceSync(gl.SYNC_GPU_COMMANDS_COMPLETE, 0);
    this._renderedAt = performance.now();
    gl.flush();
  }

  /** Whether the CPU still renders the last frame; to be asked until it is done. */
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
    this._samples ??= this._target(width, height);
    gl.bindFramebuffer(gl.FRAMEBUFFER, this._samples);
    const pixels = new Uint8Array(4 * width * height);
    const raw = { ...scene, panoramaColour: plain, viewColour: plain };
    /** @param {number} blend */
    const read = (blend) => {
      this._render({ ...raw, blend }, width, height, blend === 1, this._samples);
      gl.readPixels(0, 0, width, height, gl.RGBA, gl.UNSIGNED_BYTE, pixels);
      return cells(pixels);
    };
    const panorama = read(0), view = read(1);
    gl.bindFramebuffer(gl.FRAMEBUFFER, null);
    return { 1: panorama.colours, 2: view.colours, weights: view.alpha };
  }

  /**
   * @param {Scene} scene @param {number} width @param {number} height @param {boolean} sample see the shader
   * @param {WebGLFramebuffer | null} target which is bound
   */
  _render(scene, width, height, sample, target) {
    const gl = this.gl, shown = scene.blend > 0, layers = shown && scene.camera !== null && this._layers !== null;
    if (layers) scene = this._withLayers(scene, width, height, target);
    const moved = shown && !layers && this._perInverse > 0 ? scene.moved : null;
    const mostInverse = moved ? Math.min(this._perInverse, MOST_PARALLAX / Math.hypot(...moved)) : 0;
    const real = !sample && (scene.blend < 1 || !covers(scene, mostInverse));
    const at = this._use({ REAL: real, VIEW: shown, MOVED: moved !== null, PLAIN: this.slow || layers, SAMPLE: sample });
    gl.viewport(0, 0, width, height);
    gl.uniform1i(at("view"), layers ? RENDERED : this._viewUnit);
    gl.uniform3fv(at("panoramaGain"), scene.panoramaColour.gain);
    gl.uniform3fv(at("panoramaOffset"), scene.panoramaColour.offset);
    gl.uniform3fv(at("viewGain"), scene.viewColour.gain);
    gl.uniform3fv(at("viewOffset"), scene.viewColour.offset);
    // transpose = true: our matrices are row-major.
    gl.uniformMatrix3fv(at("panoramaFromLook"), true, scene.panoramaFromLook);
    gl.uniformMatrix3fv(at("viewFromLook"), true, scene.viewFromLook);
    gl.uniform2fv(at("tanHalf"), scene.tanHalf);
    gl.uniform2fv(at("viewTanHalf"), scene.viewTanHalf);
    gl.uniform2fv(at("viewSize"), this._viewSize);
    if (moved) {
      const [forward, left, up] = moved;
      gl.uniform2f(at("aside"), -left / scene.viewTanHalf[0], up / scene.viewTanHalf[1]);
      gl.uniform1f(at("along"), forward);
      gl.uniform1f(at("perInverse"), this._perInverse);
      gl.uniform1f(at("mostInverse"), mostInverse);
    }
    gl.uniform1f(at("blend"), scene.blend);
    gl.drawArrays(gl.TRIANGLES, 0, 3);
  }

  /**
   * Renders the layers into a texture; returns the scene with it in place of the rendered view.
   * @param {Scene} scene @param {number} width @param {number} height @param {WebGLFramebuffer | null} target bound afterwards
   * @returns {Scene}
   */
  _withLayers(scene, width, height, target) {
    const gl = this.gl, { camera } = scene;
    if (!camera || !this._layers) return scene;
    const [x, y] = camera.tanHalf, wide = /** @type {[number, number]} */ ([x * WITHIN, y * WITHIN]);
    gl.bindFramebuffer(gl.FRAMEBUFFER, this._targetForLayers(width, height));
    this._layers.render({ ...camera, tanHalf: wide }, width, height, plain);
    gl.bindFramebuffer(gl.FRAMEBUFFER, target);
    // Row 0 of what is rendered is the lowest, of a view that arrives the highest.
    return { ...scene, viewFromLook: identity, viewTanHalf: [wide[0], -wide[1]], moved: null };
  }

  /** @param {number} width @param {number} height */
  _targetForLayers(width, height) {
    const gl = this.gl, size = `${width} ${height}`;
    if (!this._layerTarget) {
      const buffer = gl.createFramebuffer(), texture = this._texture(RENDERED, gl.CLAMP_TO_EDGE), depth = gl.createRenderbuffer();
      gl.bindFramebuffer(gl.FRAMEBUFFER, buffer);
      gl.framebufferTexture2D(gl.FRAMEBUFFER, gl.COLOR_ATTACHMENT0, gl.TEXTURE_2D, texture, 0);
      gl.framebufferRenderbuffer(gl.FRAMEBUFFER, gl.DEPTH_STENCIL_ATTACHMENT, gl.RENDERBUFFER, depth);
      gl.bindFramebuffer(gl.FRAMEBUFFER, null);
      this._layerTarget = { buffer, texture, depth, size: "" };
    }
    if (this._layerTarget.size !== size) {
      this._layerTarget.size = size;
      gl.activeTexture(gl.TEXTURE0 + RENDERED);
      gl.bindTexture(gl.TEXTURE_2D, this._layerTarget.texture);
      gl.texImage2D(gl.TEXTURE_2D, 0, gl.RGBA8, width, height, 0, gl.RGBA, gl.UNSIGNED_BYTE, null);
      gl.bindRenderbuffer(gl.RENDERBUFFER, this._layerTarget.depth);
      gl.renderbufferStorage(gl.RENDERBUFFER, gl.DEPTH24_STENCIL8, width, height);
    }
    return this._layerTarget.buffer;
  }

  /** Blurs the view where the mask is dark. @param {OffscreenCanvas} mask */
  _soften(mask) {
    const gl = this.gl, [width, height] = this._viewSize, at = this._softener.use();
    this._upload(2, this._mask, mask);
    gl.activeTexture(gl.TEXTURE1);
    gl.texParameteri(gl.TEXTURE_2D, gl.TEXTURE_MAX_LEVEL, SOFT_LEVEL);
    gl.generateMipmap(gl.TEXTURE_2D);
    gl.activeTexture(gl.TEXTURE4);
    gl.texImage2D(gl.TEXTURE_2D, 0, gl.RGBA8, width, height, 0, gl.RGBA, gl.UNSIGNED_BYTE, null);
    gl.bindFramebuffer(gl.FRAMEBUFFER, this._softTarget);
    gl.viewport(0, 0, width, height);
    gl.uniform1i(at("view"), 1);
    gl.uniform2fv(at("softSize"), [width, height].map((size) => Math.max(size >> SOFT_LEVEL, 1)));
    gl.drawArrays(gl.TRIANGLES, 0, 3);
    gl.bindFramebuffer(gl.FRAMEBUFFER, null);
    gl.activeTexture(gl.TEXTURE1);
    gl.texParameteri(gl.TEXTURE_2D, gl.TEXTURE_MAX_LEVEL, 0); // the next view may come without a mask
  }

  /** Uses the program with these constants; returns its uniforms by name. @param {Record<string, boolean>} constants */
  _use(constants) {
    const header = Object.entries(constants).map(([name, value]) => `const bool ${name} = ${value};\n`).join("");
    let program = this._programs.get(header);
    if (!program) this._programs.set(header, program = new Program(this.gl, header + FRAGMENT));
    return program.use();
  }

  /** @param {number} width @param {number} height */
  _target(width, height) {
    const gl = this.gl, buffer = gl.createFramebuffer(), pixels = gl.createRenderbuffer();
    gl.bindRenderbuffer(gl.RENDERBUFFER, pixels);
    gl.renderbufferStorage(gl.RENDERBUFFER, gl.RGBA8, width, height);
    gl.bindFramebuffer(gl.FRAMEBUFFER, buffer);
    gl.framebufferRenderbuffer(gl.FRAMEBUFFER, gl.COLOR_ATTACHMENT0, gl.RENDERBUFFER, pixels);
    return buffer;
  }

  /** @param {number} unit @param {number} wrap */
  _texture(unit, wrap) {
    const gl = this.gl, texture = gl.createTexture();
    gl.activeTexture(gl.TEXTURE0 + unit);
    gl.bindTexture(gl.TEXTURE_2D, texture);
    gl.texImage2D(gl.TEXTURE_2D, 0, gl.RGB8, 1, 1, 0, gl.RGB, gl.UNSIGNED_BYTE, new Uint8Array([9, 11, 14]));
    gl.texParameteri(gl.TEXTURE_2D, gl.TEXTURE_MIN_FILTER, gl.LINEAR);
    gl.texParameteri(gl.TEXTURE_2D, gl.TEXTURE_MAG_FILTER, gl.LINEAR);
    gl.texParameteri(gl.TEXTURE_2D, gl.TEXTURE_WRAP_S, wrap);
    gl.texParameteri(gl.TEXTURE_2D, gl.TEXTURE_WRAP_T, gl.CLAMP_TO_EDGE);
    return texture;
  }

  /** @param {number} unit @param {WebGLTexture} texture @param {ImageBitmap | OffscreenCanvas} bitmap */
  _upload(unit, texture, bitmap) {
    const gl = this.gl;
    gl.activeTexture(gl.TEXTURE0 + unit);
    gl.bindTexture(gl.TEXTURE_2D, texture);
    gl.texImage2D(gl.TEXTURE_2D, 0, gl.RGB8, gl.RGB, gl.UNSIGNED_BYTE, bitmap);
  }
}

/**
 * Whether the rendered view fills the window at any depth.
 * @param {Pick<Scene, "viewFromLook" | "tanHalf" | "viewTanHalf" | "moved">} scene
 * @param {number} mostInverse largest inverse depth by which the view is moved, 1/m
 */
export function covers({ viewFromLook, tanHalf, viewTanHalf, moved }, mostInverse) {
  const [forward, left, up] = moved ?? [0, 0, 0], aside = [-left / viewTanHalf[0], up / viewTanHalf[1]];
  return [[-1, -1], [-1, 1], [1, -1], [1, 1]].every(([x, y]) => {
    const d = rotate(viewFromLook, [1, -x * tanHalf[0], y * tanHalf[1]]);
    const at = [-d[1] / (d[0] * viewTanHalf[0]), d[2] / (d[0] * viewTanHalf[1])];
    // Linear in the inverse depth, so both ends decide.
    return d[0] > 0 && [0, mostInverse].every((inverse) =>
      at.every((value, i) => Math.abs(value + inverse * (aside[i] - forward * value)) <= EDGE));
  });
}

/**
 * Averages RGBA pixels over the cells: 3 colours and 1 alpha per cell, 0..1.
 * @param {Uint8Array | Uint8ClampedArray} pixels
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
