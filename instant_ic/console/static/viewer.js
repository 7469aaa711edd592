// The feedback picture in WebGL 2: panorama and rendered view through one projection, one pass.

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
uniform sampler2D panorama, view;
uniform bool hasPanorama;
uniform mat3 panoramaFromLook, viewFromLook;
uniform vec2 tanHalf;      // of the shown field of view
uniform vec2 viewTanHalf;  // of the rendered view
uniform vec2 viewSize;     // pixels
uniform float blend;       // 0 camera, 1 virtual space
const float PI = 3.14159265358979;
const vec3 NIGHT = vec3(0.035, 0.043, 0.055);

vec3 fromPanorama(vec3 direction) {
  if (!hasPanorama) return NIGHT;
  vec3 d = panoramaFromLook * direction;
  float u = 0.5 - atan(d.y, d.x) / (2.0 * PI);
  float v = 0.5 - asin(clamp(d.z, -1.0, 1.0)) / PI;
  return texture(panorama, vec2(u, v)).rgb;
}

// Cubic B-spline by four bilinear look-ups: a small view enlarged stays soft, without squares.
vec3 smoothView(vec2 uv) {
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
    mix(texture(view, vec2(a.x, a.y)), texture(view, vec2(b.x, a.y)), high.x),
    mix(texture(view, vec2(a.x, b.y)), texture(view, vec2(b.x, b.y)), high.x), high.y).rgb;
}

void main() {
  vec3 direction = normalize(vec3(1.0, -screen.x * tanHalf.x, screen.y * tanHalf.y));
  vec3 real = fromPanorama(direction);
  vec3 result = real;
  if (blend > 0.0) {
    // Beyond the rendered view's edge the camera's picture goes on, dim and grey.
    vec3 around = mix(NIGHT, vec3(dot(real, vec3(0.30, 0.59, 0.11))), 0.35);
    vec3 d = viewFromLook * direction;
    vec3 rendered = around;
    if (d.x > 0.0) {
      vec2 at = vec2(-d.y, d.z) / (d.x * viewTanHalf);
      vec2 edge = smoothstep(1.0, 0.94, abs(at));
      vec2 uv = vec2(0.5 + 0.5 * at.x, 0.5 - 0.5 * at.y);
      rendered = mix(around, smoothView(uv), edge.x * edge.y);
    }
    result = mix(real, rendered, blend);
  }
  colour = vec4(result, 1.0);
}`;

/** Throws when WebGL 2 is missing. Pictures are {bitmap, rotation, tanHalf}. */
export class GlViewer {
  constructor(canvas) {
    const gl = canvas.getContext("webgl2", { alpha: false, antialias: false, powerPreference: "high-performance" });
    if (!gl) throw new Error("WebGL 2 is missing");
    this.gl = gl;
    this.canvas = canvas;
    this.name = "webgl";
    const info = gl.getExtension("WEBGL_debug_renderer_info");
    const renderer = String(gl.getParameter(info ? info.UNMASKED_RENDERER_WEBGL : gl.RENDERER));
    // Drawn by the CPU: the page then does with fewer pixels and no blur.
    this.slow = /swiftshader|llvmpipe|software|basic render/i.test(renderer);
    this.lost = false;
    canvas.addEventListener("webglcontextlost", () => { this.lost = true; });
    this._program = link(gl, VERTEX, FRAGMENT);
    this._at = (name) => gl.getUniformLocation(this._program, name);
    this._panorama = this._texture(0, gl.REPEAT);
    this._view = this._texture(1, gl.CLAMP_TO_EDGE);
    this._hasPanorama = false;
    this._viewSize = [1, 1];
    gl.useProgram(this._program);
    gl.uniform1i(this._at("panorama"), 0);
    gl.uniform1i(this._at("view"), 1);
  }

  setPanorama(bitmap) {
    this._upload(0, this._panorama, bitmap);
    this._hasPanorama = true;
  }

  setView(bitmap) {
    this._upload(1, this._view, bitmap);
    this._viewSize = [bitmap.width, bitmap.height];
  }

  /** `scene`: tanHalf, panoramaFromLook, viewFromLook, viewTanHalf, blend. */
  draw(scene) {
    const gl = this.gl;
    gl.viewport(0, 0, this.canvas.width, this.canvas.height);
    gl.uniform1i(this._at("hasPanorama"), this._hasPanorama ? 1 : 0);
    // transpose = true: our matrices are row-major.
    gl.uniformMatrix3fv(this._at("panoramaFromLook"), true, scene.panoramaFromLook);
    gl.uniformMatrix3fv(this._at("viewFromLook"), true, scene.viewFromLook);
    gl.uniform2fv(this._at("tanHalf"), scene.tanHalf);
    gl.uniform2fv(this._at("viewTanHalf"), scene.viewTanHalf);
    gl.uniform2fv(this._at("viewSize"), this._viewSize);
    gl.uniform1f(this._at("blend"), scene.blend);
    gl.drawArrays(gl.TRIANGLES, 0, 3);
  }

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

  _upload(unit, texture, bitmap) {
    const gl = this.gl;
    gl.activeTexture(gl.TEXTURE0 + unit);
    gl.bindTexture(gl.TEXTURE_2D, texture);
    gl.texImage2D(gl.TEXTURE_2D, 0, gl.RGB8, gl.RGB, gl.UNSIGNED_BYTE, bitmap);
  }
}

function link(gl, vertexSource, fragmentSource) {
  const program = gl.createProgram();
  for (const [type, source] of [[gl.VERTEX_SHADER, vertexSource], [gl.FRAGMENT_SHADER, fragmentSource]]) {
    const shader = gl.createShader(type);
    gl.shaderSource(shader, source);
    gl.compileShader(shader);
    if (!gl.getShaderParameter(shader, gl.COMPILE_STATUS)) throw new Error(`shader: ${gl.getShaderInfoLog(shader)}`);
    gl.attachShader(program, shader);
  }
  gl.linkProgram(program);
  if (!gl.getProgramParameter(program, gl.LINK_STATUS)) throw new Error(`program: ${gl.getProgramInfoLog(program)}`);
  return program;
}
