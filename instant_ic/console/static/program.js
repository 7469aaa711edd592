// @ts-check
// WebGL 2: programs with their uniforms, and textures.

/** @typedef {number | boolean | readonly number[] | WebGLTexture} Uniform Matrices are row-major. */

const WHOLE = `
out vec2 screen;
void main() {
  vec2 corner = vec2((gl_VertexID << 1) & 2, gl_VertexID & 2);
  screen = corner * 2.0 - 1.0;
  gl_Position = vec4(screen, 0.0, 1.0);
}`;

export class Program {
  /** Makes a program, which without a vertex shader fills the target. @param {WebGL2RenderingContext} gl @param {string} fragment @param {string} vertex */
  constructor(gl, fragment, vertex = WHOLE) {
    this._gl = gl;
    this.linked = link(gl, `#version 300 es\n${vertex}`, `#version 300 es\n${fragment}`);
    /** @type {Record<string, WebGLUniformLocation | null>} */
    this._places = {};
  }

  /** Makes this the current program, with all of its uniforms. @param {Record<string, Uniform>} uniforms */
  use(uniforms) {
    const gl = this._gl;
    let unit = 0;
    gl.useProgram(this.linked);
    for (const [name, value] of Object.entries(uniforms)) {
      const place = this._places[name] ??= gl.getUniformLocation(this.linked, name);
      if (value instanceof WebGLTexture) {
        gl.activeTexture(gl.TEXTURE0 + unit);
        gl.bindTexture(gl.TEXTURE_2D, value);
        gl.uniform1i(place, unit++);
      } else if (typeof value !== "object") gl.uniform1f(place, Number(value));
      else if (value.length === 9) gl.uniformMatrix3fv(place, true, value);
      else if (value.length === 3) gl.uniform3fv(place, value);
      else gl.uniform2fv(place, value);
    }
  }

  /** Fills the target by this program. @param {Record<string, Uniform>} uniforms */
  fill(uniforms) {
    this.use(uniforms);
    this._gl.drawArrays(this._gl.TRIANGLES, 0, 3);
  }
}

/** Compiles and links. @param {WebGL2RenderingContext} gl @param {string} vertexSource @param {string} fragmentSource */
function link(gl, vertexSource, fragmentSource) {
  const program = gl.createProgram();
  for (const [type, source] of /** @type {const} */ ([[gl.VERTEX_SHADER, vertexSource], [gl.FRAGMENT_SHADER, fragmentSource]])) {
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

/** Creates a texture of one colour that repeats horizontally. @param {WebGL2RenderingContext} gl @param {number[]} rgb 0 to 255 */
export function createTexture(gl, rgb) {
  const texture = gl.createTexture();
  gl.bindTexture(gl.TEXTURE_2D, texture);
  gl.texImage2D(gl.TEXTURE_2D, 0, gl.RGB8, 1, 1, 0, gl.RGB, gl.UNSIGNED_BYTE, new Uint8Array(rgb));
  gl.texParameteri(gl.TEXTURE_2D, gl.TEXTURE_WRAP_T, gl.CLAMP_TO_EDGE);
  gl.texParameteri(gl.TEXTURE_2D, gl.TEXTURE_MIN_FILTER, gl.LINEAR);
  return texture;
}

/** @param {WebGL2RenderingContext} gl @param {WebGLTexture} texture @param {ImageBitmap} bitmap */
export function setImage(gl, texture, bitmap) {
  gl.bindTexture(gl.TEXTURE_2D, texture);
  gl.texImage2D(gl.TEXTURE_2D, 0, gl.RGB8, gl.RGB, gl.UNSIGNED_BYTE, bitmap);
}
