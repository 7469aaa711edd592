// @ts-check
// WebGL 2 programs and their uniforms.

const WHOLE = `
out vec2 screen;
void main() {
  vec2 corner = vec2((gl_VertexID << 1) & 2, gl_VertexID & 2);
  screen = corner * 2.0 - 1.0;
  gl_Position = vec4(screen, 0.0, 1.0);
}`;

export class Program {
  /** Without a vertex shader it fills the target. @param {WebGL2RenderingContext} gl @param {string} fragment @param {string} vertex */
  constructor(gl, fragment, vertex = WHOLE) {
    this._gl = gl;
    this.linked = link(gl, `#version 300 es\n${vertex}`, `#version 300 es\n${fragment}`);
    /** @type {Map<string, WebGLUniformLocation | null>} */
    this._places = new Map();
  }

  /** Uses it; returns its uniforms by name. */
  use() {
    this._gl.useProgram(this.linked);
    return this._at;
  }

  /** @param {string} name @returns {WebGLUniformLocation | null} */
  _at = (name) => {
    let place = this._places.get(name);
    if (place === undefined) this._places.set(name, place = this._gl.getUniformLocation(this.linked, name));
    return place;
  };
}

/** Compiles and links. @param {WebGL2RenderingContext} gl @param {string} vertexSource @param {string} fragmentSource */
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
