// @ts-check
// Renderer in WebGL 2 for layers, the triangles around a keyframe (Python: vspace/layers.py). It renders them from any place,
// in their own colours or with the camera's image on them. It also renders the camera's image as taken, without depth.

/** @import { Mat3, Vec3 } from "./math.js" */
/** @import { Mesh } from "./messages.js" */
import { multiply, rotate, times, transpose } from "./math.js";
import { plain } from "./colour.js";
import { createTexture, Program, setImage } from "./program.js";

/** @typedef {Omit<Mesh, "image" | "confidence"> & {image: ImageBitmap, confidence: ImageBitmap | null}} Surface A mesh with decoded images. */
/**
 * A surface round a keyframe.
 * @typedef {object} Layer
 * @property {Surface} surface
 * @property {Vec3} gain factors of the colours
 * @property {Mat3} mapFromCamera rotation of the keyframe
 * @property {Vec3} position of the keyframe in the map frame, m
 */
/**
 * @typedef {object} Camera
 * @property {Mat3} mapFromLook rotation of the view
 * @property {Vec3} position of the view in the map frame, m
 * @property {[number, number]} tanHalf tangents of half the field of view
 */
/**
 * A camera image that replaces the layers' own colours.
 * @typedef {object} Photo
 * @property {WebGLTexture} image equirectangular
 * @property {Mat3} mapFromCamera rotation of the camera
 * @property {Vec3} position of the camera in the map frame, m
 */
/** @typedef {{vertices: WebGLVertexArrayObject, count: number, image: WebGLTexture, confidence: WebGLTexture, surface: Surface, buffers: WebGLBuffer[]}} Loaded */

const NEAR_M = 0.02;
const WHITE = [255, 255, 255];
const BEYOND_LEVEL = 4; // mipmap level shown where no layer has a surface

// Homogeneous coordinates are divided by the vertex's distance, so that vertices at infinity have finite coordinates.
const VERTEX = `
in vec2 corner;
in float inverse;
uniform vec2 size;
uniform mat3 lookFromPanorama, imageFromPanorama;
uniform vec3 position, imagePosition; // of the view and of the image's camera, in the keyframe's frame
uniform vec2 tanHalf;
out vec3 direction; // in the image's frame; not a unit vector, so that it interpolates correctly
void main() {
  float azimuth = ${Math.PI} * (1.0 - 2.0 * corner.x / size.y), elevation = ${Math.PI} * (0.5 - corner.y / size.x);
  vec3 ray = vec3(cos(elevation) * vec2(cos(azimuth), sin(azimuth)), sin(elevation));
  direction = imageFromPanorama * (ray - imagePosition * inverse);
  vec3 place = lookFromPanorama * (ray - position * inverse);
  gl_Position = vec4(-place.y / tanHalf.x, place.z / tanHalf.y, place.x - 2.0 * ${NEAR_M} * inverse, place.x);
}`;

const ANGLES = `
const vec3 GREY = vec3(0.30, 0.59, 0.11);
const float PI = ${Math.PI};

// Azimuth and angle from the zenith. On the CPU, atan and acos would take a seventh of the rendering time. These
// polynomials (Abramowitz and Stegun, 4.4.45 and 4.4.49) are exact to 7e-5 rad, a fiftieth of a pixel.
vec2 angles(vec3 d) {
  if (SHARP) return vec2(atan(d.y, d.x), acos(clamp(d.z, -1.0, 1.0)));
  vec2 a = abs(d.xy);
  float q = min(a.x, a.y) / max(max(a.x, a.y), 1e-9), s = q * q, z = abs(d.z);
  float azimuth = q * (0.9998660 + s * (-0.3302995 + s * (0.1801410 + s * (-0.0851330 + s * 0.0208351))));
  azimuth = a.y > a.x ? 0.5 * PI - azimuth : azimuth;
  azimuth = d.x < 0.0 ? PI - azimuth : azimuth;
  float down = sqrt(max(1.0 - z, 0.0)) * (1.5707288 + z * (-0.2121144 + z * (0.0742610 - z * 0.0187293)));
  return vec2(d.y < 0.0 ? -azimuth : azimuth, d.z < 0.0 ? PI - down : down);
}`;

const FRAGMENT = `
in vec3 direction;
out vec4 colour;
uniform sampler2D image, confidence;
uniform vec3 gain;
uniform bool soft; // estimated surfaces are blurred and paler

void main() {
  vec2 angle = angles(normalize(direction)), uv = vec2(0.5 - angle.x / (2.0 * PI), angle.y / PI);
  if (SHARP) {
    vec2 across = dFdx(uv), down = dFdy(uv);
    across.x -= round(across.x); // across the seam at the back
    down.x -= round(down.x);
    colour = vec4(textureGrad(image, uv, across * SHARPNESS, down * SHARPNESS).rgb, 1.0);
  } else colour = vec4(textureLod(image, uv, 0.0).rgb, 1.0);
  if (soft) {
    float seen = textureLod(confidence, uv, 0.0).r;
    colour.a = seen;
    if (seen < 1.0) {
      vec3 estimate = textureLod(image, uv, 2.0).rgb;
      colour.rgb = mix(mix(estimate, vec3(dot(estimate, GREY)), 0.5), colour.rgb, seen);
    }
  }
  colour.rgb *= gain;
}`;

// A panorama by direction only: a camera image as taken, or blurred colours where no layer has a surface.
const FAR = `
in vec2 screen;
out vec4 colour;
uniform sampler2D image;
uniform mat3 panoramaFromLook;
uniform vec2 tanHalf;
uniform vec3 gain;
uniform float level, dim; // mipmap level; share of grey
void main() {
  vec2 angle = angles(panoramaFromLook * normalize(vec3(1.0, -screen.x * tanHalf.x, screen.y * tanHalf.y)));
  vec3 rgb = gain * textureLod(image, vec2(0.5 - angle.x / (2.0 * PI), angle.y / PI), level).rgb;
  colour = vec4(mix(rgb, vec3(0.023, 0.028, 0.036) + 0.35 * dot(rgb, GREY), dim), 0.0);
}`;

/** A renderer into the bound framebuffer, which needs depth and stencil. */
export class LayerRenderer {
  /** @param {WebGL2RenderingContext} gl @param {boolean} slow software rendering: plain look-ups */
  constructor(gl, slow) {
    this._gl = gl;
    const sharp = `precision highp float;\nconst bool SHARP = ${!slow};\nconst float SHARPNESS = 0.7;\n${ANGLES}`;
    this._program = new Program(gl, sharp + FRAGMENT, VERTEX);
    this._far = new Program(gl, sharp + FAR);
    this._minification = slow ? gl.LINEAR_MIPMAP_NEAREST : gl.LINEAR_MIPMAP_LINEAR; // one level is faster on the CPU
    this._anisotropy = slow ? null : gl.getExtension("EXT_texture_filter_anisotropic");
    /** @type {(Loaded & {layer: Layer})[]} Each layer is shown where the layers before it show nothing. */
    this._layers = [];
    this._seen = createTexture(gl, WHITE); // confidence of a surface that was seen completely
  }

  /** Replaces the layers. Surfaces that are still used stay loaded. @param {Layer[]} layers */
  load(layers) {
    /** @type {Map<Surface, Loaded>} */
    const before = new Map(this._layers.map((loaded) => [loaded.surface, loaded]));
    this._layers = layers.map((layer) => ({ ...(before.get(layer.surface) ?? this._upload(layer.surface)), layer }));
    for (const { surface } of layers) before.delete(surface);
    for (const old of before.values()) this._forget(old);
  }

  get ready() {
    return this._layers.length > 0;
  }

  /**
   * Renders the layers; alpha is 1 where a keyframe has seen the surface.
   * @param {Camera} camera @param {number} width @param {number} height
   * @param {Vec3} tint gains of the colours
   * @param {Photo | null} photo replaces the layers' own colours; of estimated surfaces, only the depth counts then
   * @param {boolean} mixed blending is on: the nearest surface is found first, then each pixel is written once
   */
  render(camera, width, height, tint, photo = null, mixed = false) {
    const gl = this._gl;
    gl.viewport(0, 0, width, height);
    gl.enable(gl.DEPTH_TEST);
    gl.enable(gl.STENCIL_TEST);
    gl.depthFunc(gl.LESS);
    gl.stencilMask(0xff);
    gl.clear(gl.STENCIL_BUFFER_BIT);
    // Stencil bit k: layer k shows a surface here. A surface seen from behind hides what is behind it, but lets the pixel
    // show the layers below.
    this._layers.forEach(({ vertices, count, image, confidence, surface, layer }, k) => {
      const panoramaFromMap = transpose(layer.mapFromCamera), source = photo ?? layer;
      /** @param {Vec3} place in the map frame @returns {Vec3} in the keyframe's frame */
      const local = ([x, y, z]) => {
        const [px, py, pz] = layer.position;
        return rotate(panoramaFromMap, [x - px, y - py, z - pz]);
      };
      this._program.use({
        size: surface.size,
        tanHalf: camera.tanHalf,
        lookFromPanorama: multiply(transpose(camera.mapFromLook), layer.mapFromCamera),
        position: local(camera.position),
        imageFromPanorama: multiply(transpose(source.mapFromCamera), layer.mapFromCamera),
        imagePosition: local(source.position),
        image: photo?.image ?? image,
        confidence,
        soft: !photo && surface.confidence !== null,
        gain: photo ? tint : times(layer.gain, tint),
      });
      gl.clear(gl.DEPTH_BUFFER_BIT);
      gl.stencilMask(1 << k);
      gl.stencilFunc(gl.EQUAL, 1 << k, (1 << k) - 1);
      gl.stencilOpSeparate(gl.FRONT, gl.KEEP, gl.KEEP, gl.REPLACE);
      gl.stencilOpSeparate(gl.BACK, gl.KEEP, gl.KEEP, gl.ZERO);
      gl.bindVertexArray(vertices);
      if (mixed) {
        gl.colorMask(false, false, false, false);
        gl.drawElements(gl.TRIANGLES, count, gl.UNSIGNED_INT, 0);
        gl.colorMask(true, true, true, true);
        gl.depthFunc(gl.EQUAL);
        gl.stencilFunc(gl.EQUAL, 1 << k, (2 << k) - 1);
        gl.stencilOp(gl.KEEP, gl.KEEP, gl.KEEP);
      }
      gl.drawElements(gl.TRIANGLES, count, gl.UNSIGNED_INT, 0);
      gl.depthFunc(gl.LESS);
    });
    gl.bindVertexArray(null);
    gl.disable(gl.DEPTH_TEST);
    gl.stencilFunc(gl.EQUAL, 0, 0xff);
    gl.stencilOp(gl.KEEP, gl.KEEP, gl.KEEP);
    const last = this._layers[this._layers.length - 1], { image, mapFromCamera } = photo ?? { ...last, ...last.layer };
    const beyond = photo ? tint : times(last.layer.gain, tint);
    this.renderFar(image, multiply(transpose(mapFromCamera), camera.mapFromLook), camera.tanHalf, beyond, photo ? 0 : BEYOND_LEVEL);
    gl.disable(gl.STENCIL_TEST);
  }

  /**
   * Renders a panorama by direction alone; its alpha is 0.
   * @param {WebGLTexture} image @param {Mat3} panoramaFromLook @param {[number, number]} tanHalf @param {Vec3} gain of the colours
   * @param {number} level mipmap level @param {number} dim 1: dim and grey
   */
  renderFar(image, panoramaFromLook, tanHalf, gain = plain, level = 0, dim = 0) {
    this._far.fill({ image, panoramaFromLook, tanHalf, gain, level, dim });
  }

  /** @param {Surface} surface @returns {Loaded} */
  _upload(surface) {
    const gl = this._gl, vertices = gl.createVertexArray(), buffers = [0, 1, 2].map(() => gl.createBuffer());
    const attributes = /** @type {const} */ ([
      ["corner", surface.corners, 2, gl.UNSIGNED_SHORT], ["inverse", surface.inverse, 1, gl.FLOAT]]);
    gl.bindVertexArray(vertices);
    attributes.forEach(([name, values, size, type], i) => {
      const place = gl.getAttribLocation(this._program.linked, name);
      gl.bindBuffer(gl.ARRAY_BUFFER, buffers[i]);
      gl.bufferData(gl.ARRAY_BUFFER, values, gl.STATIC_DRAW);
      gl.enableVertexAttribArray(place);
      gl.vertexAttribPointer(place, size, type, false, 0, 0);
    });
    gl.bindBuffer(gl.ELEMENT_ARRAY_BUFFER, buffers[2]);
    gl.bufferData(gl.ELEMENT_ARRAY_BUFFER, surface.triangles, gl.STATIC_DRAW);
    gl.bindVertexArray(null);
    const confidence = surface.confidence ? this._texture(surface.confidence) : this._seen;
    return { vertices, count: surface.triangles.length, image: this._texture(surface.image), confidence, surface, buffers };
  }

  /** @param {Loaded} old */
  _forget({ vertices, image, confidence, buffers }) {
    const gl = this._gl;
    gl.deleteVertexArray(vertices);
    gl.deleteTexture(image);
    if (confidence !== this._seen) gl.deleteTexture(confidence);
    for (const buffer of buffers) gl.deleteBuffer(buffer);
  }

  /** @param {ImageBitmap} bitmap */
  _texture(bitmap) {
    const gl = this._gl, texture = createTexture(gl, WHITE), extension = this._anisotropy;
    setImage(gl, texture, bitmap);
    gl.generateMipmap(gl.TEXTURE_2D);
    gl.texParameteri(gl.TEXTURE_2D, gl.TEXTURE_MIN_FILTER, this._minification);
    if (extension) gl.texParameterf(gl.TEXTURE_2D, extension.TEXTURE_MAX_ANISOTROPY_EXT, 8);
    return texture;
  }
}
