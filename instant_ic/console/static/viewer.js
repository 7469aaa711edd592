// @ts-check
// The view in WebGL 2: panorama and rendered view in one projection and one pass.

/** @import { Scene } from "./images.js" */

const VERTEX = `#version 300 es
out vec2 screen;
void main() {
  vec2 corner = vec2((gl_VertexID << 1) & 2, gl_VertexID & 2);
  screen = corner * 2.0 - 1.0;
  gl_Position = vec4(screen, 0.0, 1.0);
}`;

const FRAGMENT = `#version 300 es
precision highp float;
in vec2 screen;
out vec4 colour;
uniform sampler2D panorama, view, mask, depth;
uniform bool hasPanorama;
uniform mat3 panoramaFromLook, viewFromLook;
uniform vec2 tanHalf;      // of the shown field of view
uniform vec2 viewTanHalf;  // of the rendered view
uniform vec2 viewSize;     // pixels
uniform float blend;       // 0 camera, 1 virtual space
uniform bool hasMask;
uniform bool slow;         // the CPU renders
uniform bool moved;        // the camera has moved since the view was rendered
uniform vec2 aside;        // motion to the right and up, divided by viewTanHalf, m
uniform float along;       // motion forward, m
uniform float perInverse;  // inverse depth along the axis of value 1 in the depth image, 1/m
uniform float mostInverse; // upper limit: nearer surfaces would tear
uniform int only;          // 0 the result; for samples: 1 the panorama, 2 the view with its confidence as alpha
uniform vec3 panoramaGain, panoramaOffset, viewGain, viewOffset;
const float PI = 3.14159265358979;
const vec3 NIGHT = vec3(0.035, 0.043, 0.055);
const vec3 GREY = vec3(0.30, 0.59, 0.11);
const float SOFT_LEVEL = 4.0; // mipmap level of the view for unseen places

vec3 fromPanorama(vec3 direction) {
  if (!hasPanorama) return NIGHT;
  vec3 d = panoramaFromLook * direction;
  float u = 0.5 - atan(d.y, d.x) / (2.0 * PI);
  float v = 0.5 - asin(clamp(d.z, -1.0, 1.0)) / PI;
  return textureLod(panorama, vec2(u, v), 0.0).rgb;
}

// Cubic B-spline by four bilinear look-ups: an enlarged small view stays smooth, without visible pixels.
vec3 smoothView(vec2 uv, float level) {
  if (slow && level == 0.0) return textureLod(view, uv, 0.0).rgb; // four look-ups would be a third of the CPU's work
  vec2 viewSize = max(floor(viewSize / exp2(level)), 1.0);
  vec2 p = uv * viewSize - 0.5;
  vec2 i = floor(p), f = p - i;
  vec2 f2 = f * f, f3 = f2 * f;
  vec2 w0 = (1.0 - 3.0 * f + 3.0 * f2 - f3) / 6.0;
  vec2 w1 = (4.0 - 6.0 * f2 + 3.0 * f3) / 6.0;
  vec2 w3 = f3 / 6.0;
  vec2 w2 = 1.0 - w0 - w1 - w3;
  vec2 low = w0 + w1, high = w2 + w3;
  vec2 a = (i - 0.5 + w1 / low) / viewSize, b = (i + 1.5 + w3 / high) / viewSize;
  return mix(
    mix(textureLod(view, vec2(a.x, a.y), level), textureLod(view, vec2(b.x, a.y), level), high.x),
    mix(textureLod(view, vec2(a.x, b.y), level), textureLod(view, vec2(b.x, b.y), level), high.x), high.y).rgb;
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

// Seen places are sharp; the rest is a guess from its surroundings, so it is shown blurred and paler.
vec3 fromView(vec2 uv) {
  float seen = hasMask ? smoothstep(0.0, 1.0, textureLod(mask, uv, 0.0).r) : 1.0;
  vec3 result = seen > 0.004 ? smoothView(uv, 0.0) : vec3(0.0);
  if (seen < 0.996) {
    vec3 soft = smoothView(uv, SOFT_LEVEL);
    result = mix(mix(soft, vec3(dot(soft, GREY)), 0.5), result, seen);
  }
  return result;
}

void main() {
  vec3 direction = normalize(vec3(1.0, -screen.x * tanHalf.x, screen.y * tanHalf.y));
  if (only == 1) {
    colour = vec4(fromPanorama(direction), 1.0);
    return;
  }
  vec3 d = viewFromLook * direction;
  vec2 uv = vec2(0.0);
  float inside = 0.0; // inside the rendered view, with a soft edge
  if (blend > 0.0 && d.x > 0.0) {
    vec2 at = vec2(-d.y, d.z) / (d.x * viewTanHalf);
    if (moved) at = before(at);
    vec2 edge = smoothstep(1.0, 0.94, abs(at));
    uv = vec2(0.5 + 0.5 * at.x, 0.5 - 0.5 * at.y);
    inside = edge.x * edge.y;
  }
  if (only == 2) {
    colour = vec4(smoothView(uv, 0.0), inside * (hasMask ? textureLod(mask, uv, 0.0).r : 1.0));
    return;
  }
  vec3 real = vec3(0.0), rendered = vec3(0.0);
  if (blend < 1.0 || inside < 1.0) real = fromPanorama(direction) * panoramaGain + panoramaOffset;
  if (inside > 0.0) rendered = fromView(uv) * viewGain + viewOffset;
  // Beyond the rendered view's edge the camera's image continues, dim and grey.
  vec3 around = mix(NIGHT, vec3(dot(real, GREY)), 0.35);
  colour = vec4(mix(real, mix(around, rendered, inside), blend), 1.0);
}`;

/** Size of the samples, cells; each is the mean of SAMPLE_FINE × SAMPLE_FINE pixels. */
export const SAMPLE = /** @type {const} */ ([40, 24]), SAMPLE_FINE = 4;
/** Largest motion over depth; nearer surfaces are moved by no more than this. */
export const MOST_PARALLAX = 0.5;
const MOST_REST_MS = 100; // longest pause between two frames that the CPU renders

/** @typedef {{image: ImageBitmap, near_m: number}} Depth Grey; value v is the depth near_m * 255 / v along the axis. */
/** @typedef {{1: number[], 2: number[], weights: number[]}} Samples Colours by kind of image. */

export class GlViewer {
  /** Throws when WebGL 2 is missing. @param {HTMLCanvasElement} canvas */
  constructor(canvas) {
    const gl = canvas.getContext("webgl2", { alpha: false, antialias: false, powerPreference: "high-performance" });
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
    this._program = link(gl, VERTEX, FRAGMENT);
    /** @type {Map<string, WebGLUniformLocation | null>} */
    const places = new Map();
    /** @param {string} name @returns {WebGLUniformLocation | null} */
    this._at = (name) => {
      if (!places.has(name)) places.set(name, gl.getUniformLocation(this._program, name));
      return places.get(name) ?? null;
    };
    this._panorama = this._texture(0, gl.REPEAT);
    this._view = this._texture(1, gl.CLAMP_TO_EDGE);
    this._mask = this._texture(2, gl.CLAMP_TO_EDGE);
    this._depth = this._texture(3, gl.CLAMP_TO_EDGE);
    gl.activeTexture(gl.TEXTURE1);
    gl.texParameteri(gl.TEXTURE_2D, gl.TEXTURE_MIN_FILTER, gl.LINEAR_MIPMAP_NEAREST);
    gl.generateMipmap(gl.TEXTURE_2D);
    this._hasPanorama = false;
    this._hasMask = false;
    this._perInverse = 0; // 1/m; 0: depth unknown
    this._viewSize = [1, 1];
    /** @type {WebGLSync | null} Signalled when the CPU has rendered the last frame. */
    this._fence = null;
    /** @type {WebGLFramebuffer | null} */
    this._samples = null;
    this._renderedAt = 0;
    this._restUntil = 0;
    gl.useProgram(this._program);
    gl.uniform1i(this._at("panorama"), 0);
    gl.uniform1i(this._at("view"), 1);
    gl.uniform1i(this._at("mask"), 2);
    gl.uniform1i(this._at("depth"), 3);
  }

  /** @param {ImageBitmap} bitmap */
  setPanorama(bitmap) {
    this._upload(0, this._panorama, bitmap);
    this._hasPanorama = true;
  }

  /**
   * @param {ImageBitmap} bitmap
   * @param {OffscreenCanvas | null} mask small grey image, bright where the view was seen; null: everywhere
   * @param {Depth | null} depth null: unknown
   */
  setView(bitmap, mask, depth) {
    this._upload(1, this._view, bitmap);
    this._viewSize = [bitmap.width, bitmap.height];
    this.gl.generateMipmap(this.gl.TEXTURE_2D); // to blur unseen places
    this._hasMask = mask !== null;
    if (mask) this._upload(2, this._mask, mask);
    this._perInverse = depth ? 1 / depth.near_m : 0;
    if (depth) this._upload(3, this._depth, depth.image);
  }

  /** @param {Scene} scene */
  render(scene) {
    const gl = this.gl;
    this._render(scene, this.canvas.width, this.canvas.height, 0);
    if (!this.slow) return;
    if (this._fence) gl.deleteSync(this._fence);
    this._fence = gl.fenceSync(gl.SYNC_GPU_COMMANDS_COMPLETE, 0);
    this._renderedAt = performance.now();
    gl.flush();
  }

  /**
   * Whether the CPU still renders the last frame, or has not yet paused for as long as that took (at most MOST_REST_MS).
   * Without the pause, rendering would delay messages and new views.
   */
  get busy() {
    const gl = this.gl;
    if (this._fence && !this.lost) {
      if (gl.getSyncParameter(this._fence, gl.SYNC_STATUS) !== gl.SIGNALED) return true;
      gl.deleteSync(this._fence);
      this._fence = null;
      const now = performance.now();
      this._restUntil = now + Math.min(now - this._renderedAt, MOST_REST_MS);
    }
    return performance.now() < this._restUntil;
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
    /** @param {number} only */
    const read = (only) => {
      this._render({ ...scene, blend: 1 }, width, height, only);
      gl.readPixels(0, 0, width, height, gl.RGBA, gl.UNSIGNED_BYTE, pixels);
      return cells(pixels);
    };
    const panorama = read(1), view = read(2);
    gl.bindFramebuffer(gl.FRAMEBUFFER, null);
    return { 1: panorama.colours, 2: view.colours, weights: view.alpha };
  }

  /** @param {Scene} scene @param {number} width @param {number} height @param {number} only see the shader */
  _render(scene, width, height, only) {
    const gl = this.gl;
    gl.viewport(0, 0, width, height);
    gl.uniform1i(this._at("only"), only);
    gl.uniform1i(this._at("hasMask"), this._hasMask ? 1 : 0);
    gl.uniform1i(this._at("slow"), this.slow ? 1 : 0);
    gl.uniform3fv(this._at("panoramaGain"), scene.panoramaColour.gain);
    gl.uniform3fv(this._at("panoramaOffset"), scene.panoramaColour.offset);
    gl.uniform3fv(this._at("viewGain"), scene.viewColour.gain);
    gl.uniform3fv(this._at("viewOffset"), scene.viewColour.offset);
    gl.uniform1i(this._at("hasPanorama"), this._hasPanorama ? 1 : 0);
    // transpose = true: our matrices are row-major.
    gl.uniformMatrix3fv(this._at("panoramaFromLook"), true, scene.panoramaFromLook);
    gl.uniformMatrix3fv(this._at("viewFromLook"), true, scene.viewFromLook);
    gl.uniform2fv(this._at("tanHalf"), scene.tanHalf);
    gl.uniform2fv(this._at("viewTanHalf"), scene.viewTanHalf);
    gl.uniform2fv(this._at("viewSize"), this._viewSize);
    const moved = this._perInverse > 0 ? scene.moved : null;
    gl.uniform1i(this._at("moved"), moved ? 1 : 0);
    if (moved) {
      const [forward, left, up] = moved;
      gl.uniform2f(this._at("aside"), -left / scene.viewTanHalf[0], up / scene.viewTanHalf[1]);
      gl.uniform1f(this._at("along"), forward);
      gl.uniform1f(this._at("perInverse"), this._perInverse);
      gl.uniform1f(this._at("mostInverse"), Math.min(this._perInverse, MOST_PARALLAX / Math.hypot(...moved)));
    }
    gl.uniform1f(this._at("blend"), scene.blend);
    gl.drawArrays(gl.TRIANGLES, 0, 3);
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

/** @param {WebGL2RenderingContext} gl @param {string} vertexSource @param {string} fragmentSource */
function link(gl, vertexSource, fragmentSource) {
  const program = gl.createProgram();
  for (const { type, source } of [
    { type: gl.VERTEX_SHADER, source: vertexSource }, { type: gl.FRAGMENT_SHADER, source: fragmentSource }]) {
    const shader = gl.createShader(type);
    if (!shader) throw new Error("the WebGL context is lost");
    gl.shaderSource(shader, source);
    gl.compileShader(shader);
    if (!gl.getShaderParameter(shader, gl.COMPILE_STATUS)) throw new Error(`shader: ${gl.getShaderInfoLog(shader)}`);
    gl.attachShader(program, shader);
  }
  gl.linkProgram(program);
  if (!gl.getProgramParameter(program, gl.LINK_STATUS)) throw new Error(`program: ${gl.getProgramInfoLog(program)}`);
  return program;
}
