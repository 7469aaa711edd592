"""Compiled loops of the renderer: visibility, filtered texture lookup and shading. All of them release the GIL."""

from typing import Any, NamedTuple

import numba
import numpy as np
import numpy.typing as npt

F32 = npt.NDArray[np.float32]
I32 = npt.NDArray[np.int32]
I64 = npt.NDArray[np.int64]
U8 = npt.NDArray[np.uint8]
U32 = npt.NDArray[np.uint32]
#: float32 in compiled code, for which numpy's stubs have several types.
Scalar = Any

#: Entries of the tone table, which maps the square root of radiance, 0..TONE_ROOT, to sRGB.
TONE_SIZE = 4096
TONE_ROOT = 2.0
_ROOT = np.float32((TONE_SIZE - 1) / TONE_ROOT)
#: Tone index of radiance 1.5. Samples of edge pixels are clipped there, as by a sensor, so that lamps look smooth.
_WHITE = np.float32(_ROOT * np.sqrt(1.5))
#: A bilinear lookup gives albedo as a square root in units of 1 / (255 · 256).
_PER_LOOKUP = np.float32(_ROOT / (255 * 256))
#: Number of pixels from one light lookup to the next; the light in between is interpolated.
_LIGHT_STEP = 4
#: Number of rays that are shaded together.
_SPAN = 256
#: Largest number of surfaces among which an edge pixel is sampled.
_MOST = 32
#: Distance in metres by which a surface's border is widened, so that no ray slips through between two surfaces.
_GAP_M = np.float32(1e-4)

UNKNOWN = -2
SKY = -1

#: Number of samples of an edge pixel: one in each eighth of its rows and of its columns.
_SAMPLES = 8
_SAMPLE_ROWS = (np.arange(_SAMPLES, dtype=np.float32) + np.float32(0.5)) / 8 - np.float32(0.5)
_SAMPLE_COLUMNS = (np.arange(0, 3 * _SAMPLES, 3, dtype=np.float32) % 8 + np.float32(0.5)) / 8 - np.float32(0.5)


class Projection(NamedTuple):
    """Directions of an image's pixels.

    Attributes:
        across, down, scale: tables of the lens, see ``render._Lens``.
        strides: (H,) columns per shaded pixel.
        wraps: True for a panorama, whose last column adjoins the first.
    """

    across: F32
    down: F32
    scale: F32
    strides: I32
    wraps: bool


class Scene(NamedTuple):
    """The surfaces of a world with textures and light.

    Attributes:
        forms: (S, 9, 4) affine functions of a point relative to the camera, see ``World.forms``.
        looks: (S, 5) texels per metre; root of the tint, in tone indices per lookup; root of the emission.
        owns: (S, 6) texture, its last level, 1 if it is clamped, first texel of the light map, its width and height.
        levels: (T, L, 3) first texel, width and height of each level of each texture.
        texels: texels of all textures.
        light: (L, 3) square root of light times tint, in tone indices per lookup.
    """

    forms: F32
    looks: F32
    owns: I64
    levels: I64
    texels: U32
    light: F32


_FLAGS = {
    "cache": True, "nogil": True, "error_model": "numpy", "fastmath": {"contract", "arcp", "nsz", "reassoc"},
}  # fmt: skip
_jit = numba.njit(**_FLAGS)
#: Compiler without reference counts of arrays, which cost more than the lookups; the functions cannot make arrays.
_bare = numba.njit(_nrt=False, **_FLAGS)

#: Compiler for functions with one caller, which are separate functions only for readability.
_inlined = numba.njit(_nrt=False, inline="always", **_FLAGS)


@_bare
def _along(forms: F32, s: int, k: int, d: tuple[Scalar, Scalar, Scalar]) -> Scalar:
    """Return the rate of change of form ``k`` of surface ``s`` along ``d``."""
    return forms[s, k, 0] * d[0] + forms[s, k, 1] * d[1] + forms[s, k, 2] * d[2]


@_bare
def _border(forms: F32, s: int, k: int, q: Any, ray: Any, by_row: Any, by_column: Any) -> tuple[Scalar, Scalar, Scalar]:
    """Return the distance from border ``k`` divided by the range, at the pixel's centre, and its change per row and
    column.
    """
    w = forms[s, k, 3] + _GAP_M
    return (
        w * q[0] + _along(forms, s, k, ray),
        w * q[1] + _along(forms, s, k, by_row),
        w * q[2] + _along(forms, s, k, by_column),
    )


@_bare
def _hit(forms: F32, s: int, dx: Scalar, dy: Scalar, dz: Scalar) -> Scalar:
    """Return the distance along a ray to surface ``s`` in units of the direction's length; inf if it misses."""
    along = forms[s, 0, 0] * dx + forms[s, 0, 1] * dy + forms[s, 0, 2] * dz
    t = -forms[s, 0, 3] / along
    if not t > 0:
        return np.float32(np.inf)
    for k in range(5, 9):
        if forms[s, k, 3] + t * (forms[s, k, 0] * dx + forms[s, k, 1] * dy + forms[s, k, 2] * dz) < -_GAP_M:
            return np.float32(np.inf)
    return t


@_bare
def fill_cells(surface: I32, step: int, wraps: bool) -> None:
    """Fill in the UNKNOWN pixels of cells that one surface covers. Cells lie between every ``step``-th row and column.

    A surface covers a cell if it covers the four corners, because surfaces are planar and convex. Cells also end at the
    last row and, without ``wraps``, at the last column.
    """
    height, width = surface.shape
    for top in range(0, height - 1, step):
        bottom = min(top + step, height - 1)
        for left in range(0, width if wraps else width - 1, step):
            end = min(left + step, width if wraps else width - 1)
            right = end if end < width else 0
            s = surface[top, left]
            if s < 0 or surface[top, right] != s or surface[bottom, left] != s or surface[bottom, right] != s:
                continue
            if surface[min(top + 1, height - 1), min(left + 1, width - 1)] != UNKNOWN:
                continue  # part of a larger cell
            for row in range(np.uint64(top), np.uint64(bottom + 1)):
                for column in range(np.uint64(left), np.uint64(min(end + 1, width))):
                    surface[row, column] = s


@_bare
def fill_guessed(surface: I32, across: F32, down: F32, scale: F32, forms: F32) -> None:
    """Fill in each UNKNOWN pixel with the nearest surface that its ray hits among those of its four neighbours."""
    height, width = surface.shape
    for row in range(1, height - 1, 2):
        for column in range(1, width - 1, 2):
            if surface[row, column] != UNKNOWN:
                continue
            dx = scale[row + 1] * across[0, column + 1] + down[0, row + 1]
            dy = scale[row + 1] * across[1, column + 1] + down[1, row + 1]
            dz = scale[row + 1] * across[2, column + 1] + down[2, row + 1]
            nearest = np.float32(np.inf)
            for k in range(4):
                s = surface[row + (k - 1 if k % 2 == 0 else 0), column + (k - 2 if k % 2 == 1 else 0)]
                if s >= 0:
                    t = _hit(forms, s, dx, dy, dz)
                    if t < nearest:
                        nearest = t
                        surface[row, column] = s


@_bare
def unknown(surface: I32, step: int, whole: bool, out: I64) -> int:
    """List the UNKNOWN pixels (flat indices) in every ``step``-th row and column, and in the last ones.

    Without ``whole``, pixels in both an odd row and an odd column are left out, except at the image's border.

    Returns:
        Number of listed pixels.
    """
    height, width = surface.shape
    count = 0
    for top in range(0, height - 1 + step, step):
        row = np.uint64(min(top, height - 1))
        between = not whole and row % 2 == 1 and row < height - 1
        for left in range(0, width - 1 + step, step):
            column = np.uint64(min(left, width - 1))
            if surface[row, column] == UNKNOWN and not (between and column % 2 == 1 and column < width - 1):
                out[count] = row * np.uint64(width) + column
                count += 1
    return count


@_bare
def rays(pixels: I64, width: int, across: F32, down: F32, scale: F32, out: F32) -> None:
    """Write the unit directions (N, 3) of pixels (N,), flat indices, to ``out``."""
    for i in range(pixels.shape[0]):
        row, column = pixels[i] // width + 1, pixels[i] % width + 1
        x = scale[row] * across[0, column] + down[0, row]
        y = scale[row] * across[1, column] + down[1, row]
        z = scale[row] * across[2, column] + down[2, row]
        part = np.float32(1) / np.sqrt(x * x + y * y + z * z)
        out[i, 0], out[i, 1], out[i, 2] = part * x, part * y, part * z


@_bare
def place(surface: I32, pixels: I64, face: I32, face_surface: I32) -> None:
    """Write the surface of the face (N,) that each ray hit to its pixel (N,), a flat index of ``surface``."""
    flat = surface.reshape(-1)
    for i in range(pixels.shape[0]):
        flat[pixels[i]] = face_surface[face[i]] if face[i] >= 0 else SKY


@_bare
def ranges(surface: I32, across: F32, down: F32, scale: F32, forms: F32, out: F32) -> None:
    """Write the radial distance (H, W) of every pixel's surface to ``out``; 0 for the sky."""
    height, width = surface.shape
    for row in range(height):
        c, bx, by, bz = scale[row + 1], down[0, row + 1], down[1, row + 1], down[2, row + 1]
        first = 0
        while first < width:
            s = surface[row, first]
            end = first + 1
            while end < width and surface[row, end] == s:
                end += 1
            if s < 0:
                out[row, first:end] = 0
            else:
                nx, ny, nz, over = forms[s, 0, 0], forms[s, 0, 1], forms[s, 0, 2], -forms[s, 0, 3]
                for column in range(np.uint64(first), np.uint64(end)):
                    k = column + np.uint64(1)
                    x = c * across[0, k] + bx
                    y = c * across[1, k] + by
                    z = c * across[2, k] + bz
                    out[row, column] = over * np.sqrt(x * x + y * y + z * z) / (nx * x + ny * y + nz * z)
            first = end


@_bare
def _light_texel(
    light: F32, first: int, width: int, height: int, a: Scalar, b: Scalar
) -> tuple[Scalar, Scalar, Scalar]:
    """Look up a light map bilinearly at texel coordinates (a, b)."""
    a = min(max(a, np.float32(0.0)), np.float32(width) - np.float32(1.001))
    b = min(max(b, np.float32(0.0)), np.float32(height) - np.float32(1.001))
    i = np.int32(a)
    j = np.int32(b)
    fa = a - np.float32(i)
    fb = b - np.float32(j)
    at = np.uint64(first + np.int64(j) * width + np.int64(i))
    below = at + np.uint64(width)
    at1, below1 = at + np.uint64(1), below + np.uint64(1)
    w11 = fa * fb
    w10 = fa - w11
    w01 = fb - w11
    w00 = np.float32(1) - fa - w01
    return (
        w00 * light[at, 0] + w10 * light[at1, 0] + w01 * light[below, 0] + w11 * light[below1, 0],
        w00 * light[at, 1] + w10 * light[at1, 1] + w01 * light[below, 1] + w11 * light[below1, 1],
        w00 * light[at, 2] + w10 * light[at1, 2] + w01 * light[below, 2] + w11 * light[below1, 2],
    )


@_bare
def _light(s: int, x: Scalar, y: Scalar, z: Scalar, scene: Scene) -> tuple[Scalar, Scalar, Scalar]:
    """Return the square root of light · tint, in tone indices per lookup unit, at (x, y, z) from the camera."""
    forms, looks, owns = scene.forms, scene.looks, scene.owns
    e = looks[s, 4]
    if e == 0:
        a = forms[s, 3, 0] * x + forms[s, 3, 1] * y + forms[s, 3, 2] * z + forms[s, 3, 3]
        if owns[s, 4] > 0:
            b = forms[s, 4, 0] * x + forms[s, 4, 1] * y + forms[s, 4, 2] * z + forms[s, 4, 3]
            return _light_texel(scene.light, owns[s, 3], owns[s, 4], owns[s, 5], a, b)
        e = np.sqrt(max(a, np.float32(0.02)))
    return e * looks[s, 1], e * looks[s, 2], e * looks[s, 3]


@_bare
def _lookup(texels: U32, first: int, width: int, height: int, u: Scalar, v: Scalar) -> Any:
    """Look up a texture bilinearly at (u, v), 0..1. Returns three lanes of 16 bits (red, blue, green), see
    ``_PER_LOOKUP``.
    """
    # Positions are in sixteenths of a texel, so that the weights of the four texels sum to 256.
    x = np.int64(u * np.float32(16 * width) + np.float32(8.5))
    y = np.int64(v * np.float32(16 * height) + np.float32(8.5))
    at = np.uint64(first + (y >> 4) * (width + 2) + (x >> 4))
    below = at + np.uint64(width + 2)
    one = np.uint64(1)
    fx = x & 15
    fy = y & 15
    gx = 16 - fx
    gy = 16 - fy
    mask = 0x00FF00FF00FF
    a = np.int64(texels[at])
    b = np.int64(texels[at + one])
    c = np.int64(texels[below])
    d = np.int64(texels[below + one])
    return (
        ((a | (a << 24)) & mask) * (gx * gy)
        + ((b | (b << 24)) & mask) * (fx * gy)
        + ((c | (c << 24)) & mask) * (gx * fy)
        + ((d | (d << 24)) & mask) * (fx * fy)
    )


@_bare
def _texel(texture: tuple[Any, Any, bool], fine: Scalar, u: Scalar, v: Scalar, levels: I64, texels: U32) -> Any:
    """Look up a texture (number, last level, clamped) at the level whose texels have the size sqrt(``fine``)."""
    one = np.float32(1)
    number, last, clamped = texture
    level = np.uint64(min(max(np.int64(np.float32(fine).view(np.int32) >> 23) - 127, 0), last))
    if clamped:
        u, v = min(max(u, np.float32(0)), one), min(max(v, np.float32(0)), one)
    else:
        u, v = u - np.floor(u), v - np.floor(v)
    return _lookup(texels, levels[number, level, 0], levels[number, level, 1], levels[number, level, 2], u, v)


@_bare
def _albedo(
    texture: tuple[Any, Any, bool], fine: Scalar, u: Scalar, v: Scalar, du: Scalar, dv: Scalar, levels: I64, texels: U32
) -> Any:
    """Look up a texture averaged over a footprint: at (u, v), or along its long axis at (u ± du, v ± dv)."""
    lanes = _texel(texture, fine, u + du, v + dv, levels, texels)
    if du != 0 or dv != 0:
        mask = 0x7FFF7FFF7FFF
        lanes = ((lanes >> 1) & mask) + ((_texel(texture, fine, u - du, v - dv, levels, texels) >> 1) & mask)
    return lanes


@_bare
def _texture(scene: Scene, s: int) -> tuple[Any, Any, bool]:
    """Return the texture of surface ``s``: number, last level, and whether it is clamped."""
    return np.uint64(scene.owns[s, 0]), scene.owns[s, 1], scene.owns[s, 2] != 0


@_bare
def _plane(s: int, f: F32) -> Any:
    """Return the coefficients of surface ``s``: those of its plane, and of its texture coordinates u and v."""
    return (
        f[s, 0, 0], f[s, 0, 1], f[s, 0, 2], -f[s, 0, 3],
        f[s, 1, 0], f[s, 1, 1], f[s, 1, 2], f[s, 1, 3],
        f[s, 2, 0], f[s, 2, 1], f[s, 2, 2], f[s, 2, 3],
    )  # fmt: skip


@_bare
def _meet(plane: Any, size: Scalar, footprint: Scalar, x: Scalar, y: Scalar, z: Scalar) -> Any:
    """Intersect a ray with a plane. ``size`` is the ray's footprint in texels at 1 m.

    Returns the range, the texture coordinates, half the footprint's long axis (0 at steep view angles, where one lookup
    covers the footprint), and the squared size of a texel.
    """
    one = np.float32(1)
    nx, ny, nz, over, ux, uy, uz, uw, vx, vy, vz, vw = plane
    side = nx * x + ny * y + nz * z
    t = over / side
    ud = ux * x + uy * y + uz * z
    vd = vx * x + vy * y + vz * z
    side = abs(side)
    side = side if side > np.float32(0.0625) else np.float32(0.0625)
    stretch = one / side
    oblique = stretch > np.float32(2.0)
    across = t * size
    # This is the square of the texel size; its exponent rounds the size to the nearest half octave.
    fine = np.float32(1.4142135) * across * across * (np.float32(0.25) * stretch * stretch if oblique else stretch)
    flat = one - side * side
    flat = flat if flat > np.float32(0.1) else np.float32(0.1)
    reach = np.float32(0.25) * t * footprint * stretch / np.sqrt(flat)
    reach = reach if oblique else np.float32(0)
    return t, uw + t * ud, vw + t * vd, ud * reach, vd * reach, fine


@_bare
def _sky(z: Scalar) -> tuple[Scalar, Scalar, Scalar]:
    """Return the tone indices of the sky, which worlds without a closed roof show."""
    up = max(z, np.float32(0.0))
    return (
        _ROOT * np.sqrt(np.float32(0.62) - np.float32(0.30) * up),
        _ROOT * np.sqrt(np.float32(0.72) - np.float32(0.22) * up),
        _ROOT * np.sqrt(np.float32(0.85) - np.float32(0.05) * up),
    )


@_bare
def _shade(s: int, first: int, end: int, ray: F32, footprint: Scalar, scene: Scene, work: F32, out: F32) -> None:
    """Write the tone indices of rays ``first`` to ``end`` of ``ray`` (3, N), all on surface ``s``, to ``out`` (3, N).

    The texture is averaged over the angle ``footprint``. ``work`` is a buffer of six values for each of ``_SPAN`` rays.
    """
    if s < 0:
        for i in range(first, end):
            out[0, i], out[1, i], out[2, i] = _sky(ray[2, i])
        return
    plane, texture, size = _plane(s, scene.forms), _texture(scene, s), footprint * scene.looks[s, 0]
    while first < end:
        count = min(end - first, _SPAN)
        start = np.uint64(first)
        for k in range(np.uint64(count)):
            n = start + k
            t, u, v, du, dv, fine = _meet(plane, size, footprint, ray[0, n], ray[1, n], ray[2, n])
            work[k], work[_SPAN + k], work[2 * _SPAN + k] = t, u, v
            work[3 * _SPAN + k], work[4 * _SPAN + k], work[5 * _SPAN + k] = du, dv, fine
        t = work[0]
        r, g, b = _light(s, t * ray[0, first], t * ray[1, first], t * ray[2, first], scene)
        at = 0
        while at < count:
            to = min(at + _LIGHT_STEP, count - 1)
            dr = dg = db = np.float32(0)
            if to > at:
                i, t, part = first + to, work[to], np.float32(1) / np.float32(to - at)
                dr, dg, db = _light(s, t * ray[0, i], t * ray[1, i], t * ray[2, i], scene)
                dr, dg, db = part * (dr - r), part * (dg - g), part * (db - b)
            to = max(to, at + 1)
            for k in range(np.uint64(at), np.uint64(to)):
                lanes = _albedo(
                    texture, work[5 * _SPAN + k], work[_SPAN + k], work[2 * _SPAN + k], work[3 * _SPAN + k],
                    work[4 * _SPAN + k], scene.levels, scene.texels,
                )  # fmt: skip
                out[0, start + k] = np.float32(lanes & 0xFFFF) * r
                out[1, start + k] = np.float32(lanes >> 32) * g
                out[2, start + k] = np.float32((lanes >> 16) & 0xFFFF) * b
                r, g, b = r + dr, g + dg, b + db
            at = to
        first += count


@_bare
def _point(s: int, footprint: Scalar, x: Scalar, y: Scalar, z: Scalar, scene: Scene) -> tuple[Scalar, Scalar, Scalar]:
    """Return the tone indices of one ray that hits surface ``s``."""
    if s < 0:
        return _sky(z)
    t, u, v, du, dv, fine = _meet(_plane(s, scene.forms), footprint * scene.looks[s, 0], footprint, x, y, z)
    lanes = _albedo(_texture(scene, s), fine, u, v, du, dv, scene.levels, scene.texels)
    r, g, b = _light(s, t * x, t * y, t * z, scene)
    return np.float32(lanes & 0xFFFF) * r, np.float32(lanes >> 32) * g, np.float32((lanes >> 16) & 0xFFFF) * b


@_bare
def _is_edge(s: int, o: int, dx: Scalar, dy: Scalar, dz: Scalar, forms: F32, owns: I64) -> bool:
    """Return whether surfaces ``s`` and ``o`` of two neighbouring pixels look different.

    Adjoining surfaces of the same texture (one wall in two pieces, the triangles of a smooth mesh) look alike.
    """
    if s < 0 or o < 0 or owns[s, 0] != owns[o, 0]:
        return True
    ax, ay, az = forms[s, 0, 0], forms[s, 0, 1], forms[s, 0, 2]
    bx, by, bz = forms[o, 0, 0], forms[o, 0, 1], forms[o, 0, 2]
    if ax * bx + ay * by + az * bz < np.float32(0.95):
        return True
    r = forms[s, 0, 3] / (ax * dx + ay * dy + az * dz)
    q = forms[o, 0, 3] / (bx * dx + by * dy + bz * dz)
    return abs(r - q) > np.float32(0.08) * min(abs(r), abs(q))


@_bare
def _around(
    surface: I32, row: int, first: int, projection: Projection, forms: F32, owns: I64, near: I32
) -> tuple[int, bool]:
    """Write the surfaces in and around pixel (``row``, ``first`` strides) to ``near``, the pixel's own surface first.

    Returns:
        Number of surfaces, and whether the pixel lies on an edge.
    """
    across, down, scale, strides, wraps = projection
    height, width = surface.shape
    stride = strides[row]
    count = (width + stride - 1) // stride
    k = first * stride + 1
    dx = scale[row + 1] * across[0, k] + down[0, row + 1]
    dy = scale[row + 1] * across[1, k] + down[1, row + 1]
    dz = scale[row + 1] * across[2, k] + down[2, row + 1]
    s = surface[row, first * stride]
    near[0] = s
    known = 1
    edge = False
    for k in range(9):
        a = row + k // 3 - 1
        b = first + k % 3 - 1
        if a < 0 or a >= height:
            continue
        if b < 0 or b >= count:
            if not wraps:
                continue
            b = b % count
        o = surface[a, b * stride]
        new = True
        for m in range(known):
            new = new and near[m] != o
        if new:
            near[known] = o
            known += 1
        if k % 2 == 1 and o != s and not edge:
            edge = _is_edge(s, o, dx, dy, dz, forms, owns)
    return known, edge


@_bare
def _add_adjoining(forms: F32, adjoining: I32, near: I32, known: int) -> int:
    """Add the surfaces that adjoin the ``known`` ones in ``near`` and face the camera; return the new number.

    They are needed because the sides of a thin board are narrower than a pixel: maybe no pixel around shows them.
    """
    before = known
    for m in range(before):
        if near[m] < 0:
            continue
        for k in range(adjoining.shape[1]):
            o = adjoining[near[m], k]
            if o < 0 or forms[o, 0, 3] <= 0 or known == _MOST:
                continue
            new = True
            for n in range(known):
                new = new and near[n] != o
            if new:
                near[known] = o
                known += 1
    return known


@_bare
def _sample(row: int, first: int, dr: Scalar, dc: Scalar, projection: Projection) -> tuple[Scalar, Scalar, Scalar]:
    """Return the direction at ``dr`` rows and ``dc`` strides from the centre of pixel (``row``, ``first`` strides)."""
    across, down, scale, strides, wraps = projection
    stride, half = strides[row], np.float32(0.5)
    k = first * stride + 1
    c = scale[row + 1] + dr * half * (scale[row + 2] - scale[row])
    dc *= half * np.float32(stride)
    dr *= half
    x = c * (across[0, k] + dc * (across[0, k + 1] - across[0, k - 1])) + down[0, row + 1]
    y = c * (across[1, k] + dc * (across[1, k + 1] - across[1, k - 1])) + down[1, row + 1]
    z = c * (across[2, k] + dc * (across[2, k + 1] - across[2, k - 1])) + down[2, row + 1]
    x += dr * (down[0, row + 2] - down[0, row])
    y += dr * (down[1, row + 2] - down[1, row])
    z += dr * (down[2, row + 2] - down[2, row])
    part = np.float32(1) if wraps else np.float32(1) / np.sqrt(x * x + y * y + z * z)
    return part * x, part * y, part * z


@_bare
def _cover(
    row: int, first: int, projection: Projection, forms: F32, near: I32, known: int, inverse: F32, shown: I32
) -> None:
    """Write the nearest surface at each sample of a pixel, as its index in ``near``, to ``shown``.

    Over a pixel, the inverse of the range is affine, and so is the distance from each border divided by the range.
    """
    across, down, scale, strides, _ = projection
    stride, half = strides[row], np.float32(0.5)
    k = first * stride + 1
    c, dc = scale[row + 1], half * np.float32(stride) * scale[row + 1]
    dr = half * (scale[row + 2] - scale[row])
    ray = (
        c * across[0, k] + down[0, row + 1],
        c * across[1, k] + down[1, row + 1],
        c * across[2, k] + down[2, row + 1],
    )
    by_row = (
        dr * across[0, k] + half * (down[0, row + 2] - down[0, row]),
        dr * across[1, k] + half * (down[1, row + 2] - down[1, row]),
        dr * across[2, k] + half * (down[2, row + 2] - down[2, row]),
    )
    by_column = (
        dc * (across[0, k + 1] - across[0, k - 1]),
        dc * (across[1, k + 1] - across[1, k - 1]),
        dc * (across[2, k + 1] - across[2, k - 1]),
    )
    fallback = np.int32(0)
    for m in range(known):
        if near[m] < 0:
            fallback = np.int32(m)
    for n in range(_SAMPLES):
        inverse[n] = np.float32(0)
        shown[n] = fallback
    for m in range(known):
        s = near[m]
        if s < 0:
            continue
        part = np.float32(-1) / forms[s, 0, 3]
        q0, q1, q2 = (
            part * _along(forms, s, 0, ray), part * _along(forms, s, 0, by_row), part * _along(forms, s, 0, by_column)
        )  # fmt: skip
        a0, a1, a2 = _border(forms, s, 5, (q0, q1, q2), ray, by_row, by_column)
        b0, b1, b2 = _border(forms, s, 6, (q0, q1, q2), ray, by_row, by_column)
        c0, c1, c2 = _border(forms, s, 7, (q0, q1, q2), ray, by_row, by_column)
        d0, d1, d2 = _border(forms, s, 8, (q0, q1, q2), ray, by_row, by_column)
        for n in range(_SAMPLES):
            y, x = _SAMPLE_ROWS[n], _SAMPLE_COLUMNS[n]
            q = q0 + y * q1 + x * q2
            hit = (q > inverse[n]) & (a0 + y * a1 + x * a2 >= 0) & (b0 + y * b1 + x * b2 >= 0)
            hit &= (c0 + y * c1 + x * c2 >= 0) & (d0 + y * d1 + x * d2 >= 0)
            inverse[n] = q if hit else inverse[n]
            shown[n] = np.int32(m) if hit else shown[n]


class Work(NamedTuple):
    """Buffers of ``compose``: for a row of N shaded pixels, and for an edge pixel.

    Attributes:
        ray: directions of the row's pixels, (3, N).
        root: tone indices of the row's pixels, (3, N).
        values: buffer of ``_shade``.
        line: surface of each pixel of the row, (N,).
        differs: True where a neighbour shows another surface, (N,).
        near: surfaces in and around the edge pixel.
        weight: number of samples of each of ``near``.
        shift: sum of the samples' rows and columns, for each of ``near``.
        inverse: inverse range of each sample.
        shown: index in ``near`` of each sample's surface.
    """

    ray: F32
    root: F32
    values: F32
    line: I32
    differs: U8
    near: I32
    weight: F32
    shift: F32
    inverse: F32
    shown: I32


@_jit
def compose(
    surface: I32, projection: Projection, adjoining: I32, footprint: Scalar, edge_footprint: Scalar, scene: Scene,
    tone: U8, out: U8,
) -> None:  # fmt: skip
    """Shade the image (H, W, 3), sRGB, with anti-aliased edges.

    In a row with a stride, only every stride-th pixel is shaded and the pixels in between are interpolated. A sample of
    an edge pixel shows the nearest among the surfaces of the pixels around it and those that adjoin these
    (``adjoining``, (S, 4)).
    """
    width = surface.shape[1]
    work = Work(
        np.empty((3, width), np.float32),
        np.empty((3, width), np.float32),
        np.empty(6 * _SPAN, np.float32),
        np.empty(width, np.int32),
        np.empty(width, np.uint8),
        np.empty(_MOST, np.int32),
        np.empty(_MOST, np.float32),
        np.empty((_MOST, 2), np.float32),
        np.empty(_SAMPLES, np.float32),
        np.empty(_SAMPLES, np.int32),
    )
    for row in range(surface.shape[0]):
        _read_row(surface, row, projection, work)
        _shade_row(surface, row, projection, adjoining, edge_footprint, footprint, scene, work)
        _write_row(out[row], projection.strides[row], work.root, tone)


@_inlined
def _read_row(surface: I32, row: int, projection: Projection, work: Work) -> None:
    """Write directions and surfaces of a row's shaded pixels to ``work``; mark pixels with a different neighbour."""
    across, down, scale, strides, wraps = projection
    ray, line, differs = work.ray, work.line, work.differs
    height, width = surface.shape
    stride = strides[row]
    count = (width + stride - 1) // stride
    above, under = surface[max(row - 1, 0)], surface[min(row + 1, height - 1)]
    here = surface[row]
    c, bx, by, bz = scale[row + 1], down[0, row + 1], down[1, row + 1], down[2, row + 1]
    if stride == 1:
        for i in range(count):
            line[i] = here[i]
            differs[i] = (above[i] != here[i]) | (under[i] != here[i])
            ray[0, i] = c * across[0, i + 1] + bx
            ray[1, i] = c * across[1, i + 1] + by
            ray[2, i] = c * across[2, i + 1] + bz
    else:
        for i in range(count):
            k = i * stride
            line[i] = here[k]
            differs[i] = (above[k] != here[k]) | (under[k] != here[k])
            ray[0, i] = c * across[0, k + 1] + bx
            ray[1, i] = c * across[1, k + 1] + by
            ray[2, i] = c * across[2, k + 1] + bz
    if not wraps:
        for i in range(count):
            part = np.float32(1) / np.sqrt(ray[0, i] * ray[0, i] + ray[1, i] * ray[1, i] + ray[2, i] * ray[2, i])
            ray[0, i] *= part
            ray[1, i] *= part
            ray[2, i] *= part
    for i in range(1, count):
        differs[i] |= line[i] != line[i - 1]
    for i in range(count - 1):
        differs[i] |= line[i] != line[i + 1]
    if wraps and line[0] != line[count - 1]:
        differs[0] = differs[count - 1] = 1


@_inlined
def _shade_row(
    surface: I32, row: int, projection: Projection, adjoining: I32, edge_footprint: Scalar, footprint: Scalar,
    scene: Scene, work: Work,
) -> None:  # fmt: skip
    """Shade a row: each run of one surface at once, and edge pixels by their samples."""
    line, differs, near = work.line, work.differs, work.near
    forms, owns = scene.forms, scene.owns
    stride = projection.strides[row]
    count = (surface.shape[1] + stride - 1) // stride
    first = 0
    while first < count:
        s = line[first]
        known, edge = 0, False
        if differs[first]:
            known, edge = _around(surface, row, first, projection, forms, owns, near)
        if not edge:
            end = first + 1
            while end < count and line[end] == s and not differs[end]:
                end += 1
            _shade(s, first, end, work.ray, footprint, scene, work.values, work.root)
            first = end
            continue
        known = _add_adjoining(forms, adjoining, near, known)
        _cover(row, first, projection, forms, near, known, work.inverse, work.shown)
        _shade_edge(row, first, projection, known, edge_footprint, scene, work)
        first += 1


@_inlined
def _shade_edge(
    row: int, first: int, projection: Projection, known: int, footprint: Scalar, scene: Scene, work: Work
) -> None:
    """Shade an edge pixel: the mean of its surfaces' colours at their samples' centres, weighted by their samples."""
    near, weight, shift, shown, root = work.near, work.weight, work.shift, work.shown, work.root
    one = np.float32(1)
    for m in range(known):
        weight[m] = shift[m, 0] = shift[m, 1] = np.float32(0)
    for n in range(_SAMPLES):
        weight[shown[n]] += one
        shift[shown[n], 0] += _SAMPLE_ROWS[n]
        shift[shown[n], 1] += _SAMPLE_COLUMNS[n]
    red = green = blue = np.float32(0)
    for m in range(known):
        if weight[m] == 0:
            continue
        part = one / weight[m]
        x, y, z = _sample(row, first, part * shift[m, 0], part * shift[m, 1], projection)
        r, g, b = _point(near[m], footprint, x, y, z, scene)
        r, g, b = min(r, _WHITE), min(g, _WHITE), min(b, _WHITE)
        part = weight[m] / np.float32(_SAMPLES)
        red, green, blue = red + part * r * r, green + part * g * g, blue + part * b * b
    root[0, first], root[1, first], root[2, first] = np.sqrt(red), np.sqrt(green), np.sqrt(blue)


@_inlined
def _write_row(out: U8, stride: int, root: F32, tone: U8) -> None:
    """Write a row (W, 3) from the tone indices of its shaded pixels."""
    width = out.shape[0]
    count = (width + stride - 1) // stride
    top = np.float32(TONE_SIZE - 1)
    if stride == 1:
        for i in range(count):
            out[i, 0] = tone[np.int32(min(root[0, i], top))]
            out[i, 1] = tone[np.int32(min(root[1, i], top))]
            out[i, 2] = tone[np.int32(min(root[2, i], top))]
        return
    for i in range(count):
        j = i + 1 if i + 1 < count else 0
        for k in range(min(stride, width - i * stride)):
            share = np.float32(k) / np.float32(stride)
            for m in range(3):
                value = root[m, i] + share * (root[m, j] - root[m, i])
                out[i * stride + k, m] = tone[np.int32(min(value, top))]


@_jit
def light_at_hits(
    surface: I32, range_m: F32, origins: F32, directions: F32, light_at: I64, light_uv: F32, light: F32, albedo: F32,
    out: F32,
) -> None:  # fmt: skip
    """Write the light (N, 3) that surfaces reflect where rays hit to ``out``; zero where the range is negative.

    The irradiance is bilinear in each surface's light map.
    """
    for i in range(surface.shape[0]):
        r = range_m[i]
        if r < 0:
            continue
        s = surface[i]
        x = origins[i, 0] + r * directions[i, 0]
        y = origins[i, 1] + r * directions[i, 1]
        z = origins[i, 2] + r * directions[i, 2]
        a = light_uv[s, 0, 0] * x + light_uv[s, 0, 1] * y + light_uv[s, 0, 2] * z + light_uv[s, 0, 3]
        b = light_uv[s, 1, 0] * x + light_uv[s, 1, 1] * y + light_uv[s, 1, 2] * z + light_uv[s, 1, 3]
        er, eg, eb = _light_texel(light, light_at[s, 0], light_at[s, 1], light_at[s, 2], a, b)
        out[i, 0] = er * albedo[s, 0]
        out[i, 1] = eg * albedo[s, 1]
        out[i, 2] = eb * albedo[s, 2]
