"""Compiled loops of the renderer: visibility, filtered texture lookup, shading. All release the GIL."""

from typing import Any

import numba
import numpy as np
import numpy.typing as npt

F32 = npt.NDArray[np.float32]
I32 = npt.NDArray[np.int32]
I64 = npt.NDArray[np.int64]
U8 = npt.NDArray[np.uint8]
U32 = npt.NDArray[np.uint32]
#: float32 in compiled code; numpy's stubs have several types for it.
Scalar = Any

#: Entries of the tone table, which maps the square root of radiance, 0..TONE_ROOT, to sRGB.
TONE_SIZE = 4096
TONE_ROOT = 2.0
_ROOT = np.float32((TONE_SIZE - 1) / TONE_ROOT)
#: Tone index of radiance 1.5, where samples of edge pixels are clipped like in a sensor: lamps keep smooth borders.
_WHITE = np.float32(_ROOT * np.sqrt(1.5))
#: A bilinear lookup gives albedo as a square root in units of 1 / (255 · 256).
_PER_LOOKUP = np.float32(_ROOT / (255 * 256))
#: Pixels between two light lookups; light is interpolated in between.
_LIGHT_STEP = 4
#: Most surfaces that an edge pixel is sampled from.
_MOST = 32
#: A surface's border is widened by this, so that no ray slips through between two surfaces, metres.
_GAP_M = np.float32(1e-4)

UNKNOWN = -2
SKY = -1

_jit = numba.njit(cache=True, nogil=True, fastmath={"contract", "arcp", "nsz", "reassoc"}, error_model="numpy")


@_jit
def _hit(forms: F32, s: int, dx: Scalar, dy: Scalar, dz: Scalar) -> Scalar:
    """Distance along a ray to surface ``s``, in units of the direction's length; infinite if the ray misses it."""
    along = forms[s, 0, 0] * dx + forms[s, 0, 1] * dy + forms[s, 0, 2] * dz
    t = -forms[s, 0, 3] / along
    if not t > 0:
        return np.float32(np.inf)
    for k in range(5, 9):
        if forms[s, k, 3] + t * (forms[s, k, 0] * dx + forms[s, k, 1] * dy + forms[s, k, 2] * dz) < -_GAP_M:
            return np.float32(np.inf)
    return t


@_jit
def fill_cells(surface: I32, step: int, wraps: bool) -> None:
    """Fill in the UNKNOWN pixels of the cells between every ``step``-th row and column that one surface covers.

    It does if it covers the four corners, because surfaces are planar and convex. The last row, and without ``wraps``
    the last column, also end cells.
    """
    height, width = surface.shape
    for top in range(0, height - 1, step):
        bottom = min(top + step, height - 1)
        for left in range(0, width if wraps else width - 1, step):
            end = min(left + step, width if wraps else width - 1)
            right = end if end < width else 0
            s = surface[top, left]
            if s >= 0 and surface[top, right] == s and surface[bottom, left] == s and surface[bottom, right] == s:
                for row in range(top, bottom + 1):
                    for column in range(left, min(end + 1, width)):
                        surface[row, column] = s


@_jit
def fill_guessed(surface: I32, across: F32, down: F32, scale: F32, forms: F32) -> None:
    """Fill in the UNKNOWN pixels with the nearest of the surfaces at their four neighbours that their ray hits."""
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


@_jit
def unknown(surface: I32, step: int, whole: bool, out: I64) -> int:
    """List the UNKNOWN pixels (flat indices) in every ``step``-th row and column, and in the last ones.

    Without ``whole`` those are left out that lie in odd rows and columns and not at the image's border.

    Returns:
        Their number.
    """
    height, width = surface.shape
    count = 0
    for row in range(0, height - 1 + step, step):
        row = min(row, height - 1)
        for column in range(0, width - 1 + step, step):
            column = min(column, width - 1)
            inner = row % 2 == 1 and column % 2 == 1 and 0 < row < height - 1 and 0 < column < width - 1
            if surface[row, column] == UNKNOWN and (whole or not inner):
                out[count] = row * width + column
                count += 1
    return count


@_jit
def rays(pixels: I64, width: int, across: F32, down: F32, scale: F32, out: F32) -> None:
    """Unit directions (N, 3) of pixels (N,), flat indices."""
    for i in range(pixels.shape[0]):
        row, column = pixels[i] // width + 1, pixels[i] % width + 1
        x = scale[row] * across[0, column] + down[0, row]
        y = scale[row] * across[1, column] + down[1, row]
        z = scale[row] * across[2, column] + down[2, row]
        part = np.float32(1) / np.sqrt(x * x + y * y + z * z)
        out[i, 0], out[i, 1], out[i, 2] = part * x, part * y, part * z


@_jit
def place(surface: I32, pixels: I64, face: I32, face_surface: I32) -> None:
    """Enter the surfaces of the faces (N,) that the rays of pixels (N,), flat indices, hit."""
    flat = surface.reshape(-1)
    for i in range(pixels.shape[0]):
        flat[pixels[i]] = face_surface[face[i]] if face[i] >= 0 else SKY


@_jit
def ranges(surface: I32, across: F32, down: F32, scale: F32, forms: F32, out: F32) -> None:
    """Radial distance (H, W) of every pixel's surface, 0 for the sky."""
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
                for column in range(first, end):
                    x = c * across[0, column + 1] + bx
                    y = c * across[1, column + 1] + by
                    z = c * across[2, column + 1] + bz
                    out[row, column] = over * np.sqrt(x * x + y * y + z * z) / (nx * x + ny * y + nz * z)
            first = end


@_jit
def _light_texel(
    light: F32, first: int, width: int, height: int, a: Scalar, b: Scalar
) -> tuple[Scalar, Scalar, Scalar]:
    """Bilinear lookup of a light map at texel coordinates (a, b)."""
    a = min(max(a, np.float32(0.0)), np.float32(width) - np.float32(1.001))
    b = min(max(b, np.float32(0.0)), np.float32(height) - np.float32(1.001))
    i = np.int32(a)
    j = np.int32(b)
    fa = a - np.float32(i)
    fb = b - np.float32(j)
    at = first + np.int64(j) * width + np.int64(i)
    below = at + width
    w11 = fa * fb
    w10 = fa - w11
    w01 = fb - w11
    w00 = np.float32(1) - fa - w01
    return (
        w00 * light[at, 0] + w10 * light[at + 1, 0] + w01 * light[below, 0] + w11 * light[below + 1, 0],
        w00 * light[at, 1] + w10 * light[at + 1, 1] + w01 * light[below, 1] + w11 * light[below + 1, 1],
        w00 * light[at, 2] + w10 * light[at + 1, 2] + w01 * light[below, 2] + w11 * light[below + 1, 2],
    )


@_jit
def _light(
    s: int, x: Scalar, y: Scalar, z: Scalar, forms: F32, light_at: I64, light_root: F32, tint_root: F32
) -> tuple[Scalar, Scalar, Scalar]:
    """Tone index per lookup unit (square root of light · tint) at o + (x, y, z), with o the camera."""
    a = forms[s, 3, 0] * x + forms[s, 3, 1] * y + forms[s, 3, 2] * z + forms[s, 3, 3]
    width = light_at[s, 1]
    if width == 0:
        e = np.sqrt(max(a, np.float32(0.02)))
        return e * tint_root[s, 0], e * tint_root[s, 1], e * tint_root[s, 2]
    b = forms[s, 4, 0] * x + forms[s, 4, 1] * y + forms[s, 4, 2] * z + forms[s, 4, 3]
    return _light_texel(light_root, light_at[s, 0], width, light_at[s, 2], a, b)


@_jit
def _lookup(texels: U32, first: int, width: int, height: int, u: Scalar, v: Scalar) -> Any:
    """Bilinear lookup at texture coordinates 0..1: three lanes of 16 bits (red, blue, green), see ``_PER_LOOKUP``."""
    # Sixteenths of a texel: the weights of the four texels sum to 256.
    x = np.int64(u * np.float32(16 * width) + np.float32(8.5))
    y = np.int64(v * np.float32(16 * height) + np.float32(8.5))
    at = first + (y >> 4) * (width + 2) + (x >> 4)
    below = at + width + 2
    fx = x & 15
    fy = y & 15
    gx = 16 - fx
    gy = 16 - fy
    mask = 0x00FF00FF00FF
    a = np.int64(texels[at])
    b = np.int64(texels[at + 1])
    c = np.int64(texels[below])
    d = np.int64(texels[below + 1])
    return (
        ((a | (a << 24)) & mask) * (gx * gy)
        + ((b | (b << 24)) & mask) * (fx * gy)
        + ((c | (c << 24)) & mask) * (gx * fy)
        + ((d | (d << 24)) & mask) * (fx * fy)
    )


@_jit
def _shade(
    s: int,
    first: int,
    end: int,
    ray: F32,
    footprint: Scalar,
    forms: F32,
    density: F32,
    texture: I32,
    texels: U32,
    level_offset: I64,
    level_size: I32,
    levels: I32,
    clamps: U8,
    light_at: I64,
    light_root: F32,
    tint_root: F32,
    emission: F32,
    work: F32,
    bits: I32,
    out: F32,
) -> None:
    """Tone indices of rays ``first`` to ``end`` of ``ray`` (3, N), which hit surface ``s``, into ``out`` (3, N).

    The texture is averaged over the pixel's footprint on the surface: two lookups along its long axis at oblique view
    angles, one elsewhere. ``footprint`` is the angle to average over; ``bits`` is the memory of ``work[0]``.
    """
    one = np.float32(1)
    if s < 0:
        # Open sky, for worlds that are not closed.
        for i in range(first, end):
            up = max(ray[2, i], np.float32(0.0))
            out[0, i] = _ROOT * np.sqrt(np.float32(0.62) - np.float32(0.30) * up)
            out[1, i] = _ROOT * np.sqrt(np.float32(0.72) - np.float32(0.22) * up)
            out[2, i] = _ROOT * np.sqrt(np.float32(0.85) - np.float32(0.05) * up)
        return
    nx, ny, nz, over = forms[s, 0, 0], forms[s, 0, 1], forms[s, 0, 2], -forms[s, 0, 3]
    ux, uy, uz, uw = forms[s, 1, 0], forms[s, 1, 1], forms[s, 1, 2], forms[s, 1, 3]
    vx, vy, vz, vw = forms[s, 2, 0], forms[s, 2, 1], forms[s, 2, 2], forms[s, 2, 3]
    scale = footprint * density[s]
    fine, us, vs, du, dv, ts = work[0], work[1], work[2], work[3], work[4], work[5]
    lr, lg, lb = work[6], work[7], work[8]
    for i in range(first, end):
        x, y, z = ray[0, i], ray[1, i], ray[2, i]
        side = nx * x + ny * y + nz * z
        t = over / side
        ts[i] = t
        ud = ux * x + uy * y + uz * z
        vd = vx * x + vy * y + vz * z
        us[i] = uw + t * ud
        vs[i] = vw + t * vd
        side = max(abs(side), np.float32(0.0625))
        stretch = one / side
        oblique = stretch > np.float32(2.0)
        size = t * scale * (np.float32(0.5) * stretch if oblique else np.sqrt(stretch))
        # The square of the size, rounded to the nearest half octave by its exponent.
        fine[i] = np.float32(1.4142135) * size * size
        reach = np.float32(0.25) * t * footprint * stretch / np.sqrt(max(one - side * side, np.float32(0.1)))
        reach = reach if oblique else np.float32(0)
        du[i] = ud * reach
        dv[i] = vd * reach
    if emission[s] > 0:
        glow = np.sqrt(emission[s])
        for i in range(first, end):
            lr[i], lg[i], lb[i] = glow * tint_root[s, 0], glow * tint_root[s, 1], glow * tint_root[s, 2]
    else:
        i = first
        t = ts[i]
        r0, g0, b0 = _light(s, t * ray[0, i], t * ray[1, i], t * ray[2, i], forms, light_at, light_root, tint_root)
        lr[i], lg[i], lb[i] = r0, g0, b0
        while i < end - 1:
            j = min(i + _LIGHT_STEP, end - 1)
            t = ts[j]
            r1, g1, b1 = _light(s, t * ray[0, j], t * ray[1, j], t * ray[2, j], forms, light_at, light_root, tint_root)
            part = one / np.float32(j - i)
            r0, g0, b0 = part * (r1 - r0), part * (g1 - g0), part * (b1 - b0)
            for k in range(i + 1, j + 1):
                lr[k], lg[k], lb[k] = lr[k - 1] + r0, lg[k - 1] + g0, lb[k - 1] + b0
            r0, g0, b0 = r1, g1, b1
            i = j
    tex = texture[s]
    top = levels[tex] - 1
    clamp = clamps[tex] != 0
    for i in range(first, end):
        level = min(max((bits[i] >> 23) - 127, 0), top)
        offset = level_offset[tex, level]
        width, height = np.int64(level_size[tex, level, 0]), np.int64(level_size[tex, level, 1])
        u, v = us[i] + du[i], vs[i] + dv[i]
        if clamp:
            u, v = min(max(u, np.float32(0)), one), min(max(v, np.float32(0)), one)
        else:
            u, v = u - np.floor(u), v - np.floor(v)
        lanes = _lookup(texels, offset, width, height, u, v)
        if du[i] != 0 or dv[i] != 0:
            u, v = us[i] - du[i], vs[i] - dv[i]
            if clamp:
                u, v = min(max(u, np.float32(0)), one), min(max(v, np.float32(0)), one)
            else:
                u, v = u - np.floor(u), v - np.floor(v)
            mask = 0x7FFF7FFF7FFF
            lanes = ((lanes >> 1) & mask) + ((_lookup(texels, offset, width, height, u, v) >> 1) & mask)
        out[0, i] = np.float32(lanes & 0xFFFF) * lr[i]
        out[1, i] = np.float32(lanes >> 32) * lg[i]
        out[2, i] = np.float32((lanes >> 16) & 0xFFFF) * lb[i]


@_jit
def _is_edge(s: int, o: int, dx: Scalar, dy: Scalar, dz: Scalar, forms: F32, texture: I32) -> bool:
    """Whether surfaces ``s`` and ``o`` of two neighbouring pixels look different.

    Adjoining surfaces of the same texture (one wall in two pieces, the triangles of a smooth mesh) do not.
    """
    if s < 0 or o < 0 or texture[s] != texture[o]:
        return True
    ax, ay, az = forms[s, 0, 0], forms[s, 0, 1], forms[s, 0, 2]
    bx, by, bz = forms[o, 0, 0], forms[o, 0, 1], forms[o, 0, 2]
    if ax * bx + ay * by + az * bz < np.float32(0.95):
        return True
    r = forms[s, 0, 3] / (ax * dx + ay * dy + az * dz)
    q = forms[o, 0, 3] / (bx * dx + by * dy + bz * dz)
    return abs(r - q) > np.float32(0.08) * min(abs(r), abs(q))


@_jit
def _around(
    surface: I32, row: int, first: int, stride: int, wraps: bool, across: F32, down: F32, scale: F32, forms: F32,
    texture: I32, near: I32,
) -> tuple[int, bool]:  # fmt: skip
    """Enter the surfaces in and around pixel (``row``, ``first * stride``) into ``near``, itself first.

    Returns:
        Their number, and whether the pixel lies on an edge.
    """
    height, width = surface.shape
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
            edge = _is_edge(s, o, dx, dy, dz, forms, texture)
    return known, edge


@_jit
def _add_adjoining(forms: F32, adjoining: I32, near: I32, known: int) -> int:
    """Add to ``known`` surfaces in ``near`` those that adjoin them and face the camera; return the new number.

    The sides of a thin board are narrower than a pixel, so that no pixel around may show them.
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


@_jit
def _sample(
    row: int, first: int, stride: int, wraps: bool, dr: Scalar, dc: Scalar, across: F32, down: F32, scale: F32
) -> tuple[Scalar, Scalar, Scalar]:
    """Direction at ``dr`` rows and ``dc`` strides from the centre of pixel (``row``, ``first * stride``)."""
    half = np.float32(0.5)
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


@_jit
def edge_rays(
    surface: I32, across: F32, down: F32, scale: F32, strides: I32, wraps: bool, subpixels: F32, forms: F32,
    texture: I32, out: F32,
) -> int:  # fmt: skip
    """Directions (N, 3) of the samples of all edge pixels, in the order of ``compose``; return N.

    Nothing is written beyond the end of ``out``.
    """
    near = np.empty(9, np.int32)
    count = 0
    for row in range(surface.shape[0]):
        for first in range((surface.shape[1] + strides[row] - 1) // strides[row]):
            if _around(surface, row, first, strides[row], wraps, across, down, scale, forms, texture, near)[1]:
                for n in range(subpixels.shape[0]):
                    if count < out.shape[0]:
                        out[count] = _sample(
                            row, first, strides[row], wraps, subpixels[n, 0], subpixels[n, 1], across, down, scale
                        )
                    count += 1
    return count


@_jit
def compose(
    surface: I32,
    across: F32,
    down: F32,
    scale: F32,
    strides: I32,
    wraps: bool,
    subpixels: F32,
    sampled: I32,
    adjoining: I32,
    footprint: Scalar,
    edge_footprint: Scalar,
    forms: F32,
    density: F32,
    texture: I32,
    texels: U32,
    level_offset: I64,
    level_size: I32,
    levels: I32,
    clamps: U8,
    light_at: I64,
    light_root: F32,
    tint_root: F32,
    emission: F32,
    tone: U8,
    out: U8,
) -> None:
    """Shade the image (H, W, 3), sRGB, with anti-aliased edges.

    In a row with a stride only every stride-th pixel is shaded; the pixels in between are interpolated. A sample of an
    edge pixel shows its surface in ``sampled`` (N,), or if that is empty the nearest of those that the pixels around
    it show, and of those ``adjoining`` (S, 4) them.
    """
    height, width = surface.shape
    samples = subpixels.shape[0]
    one = np.float32(1)
    ray = np.empty((3, width), np.float32)
    root = np.empty((3, width), np.float32)
    work = np.empty((9, width), np.float32)
    bits = work[0].view(np.int32)
    line = np.empty(width, np.int32)
    differs = np.empty(width, np.uint8)
    near = np.empty(_MOST, np.int32)
    weight = np.empty(_MOST, np.float32)
    shift = np.empty((_MOST, 2), np.float32)
    some_ray = np.empty((3, 1), np.float32)
    some_root = np.empty((3, 1), np.float32)
    taken = 0
    for row in range(height):
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
                part = one / np.sqrt(ray[0, i] * ray[0, i] + ray[1, i] * ray[1, i] + ray[2, i] * ray[2, i])
                ray[0, i] *= part
                ray[1, i] *= part
                ray[2, i] *= part
        for i in range(1, count):
            differs[i] |= line[i] != line[i - 1]
        for i in range(count - 1):
            differs[i] |= line[i] != line[i + 1]
        if wraps and line[0] != line[count - 1]:
            differs[0] = differs[count - 1] = 1

        first = 0
        while first < count:
            s = line[first]
            known, edge = 0, False
            if differs[first]:
                known, edge = _around(surface, row, first, stride, wraps, across, down, scale, forms, texture, near)
            if not edge:
                end = first + 1
                while end < count and line[end] == s and not differs[end]:
                    end += 1
                _shade(
                    s, first, end, ray, footprint, forms, density, texture, texels, level_offset, level_size, levels,
                    clamps, light_at, light_root, tint_root, emission, work, bits, root,
                )  # fmt: skip
                first = end
                continue
            known = _add_adjoining(forms, adjoining, near, known)
            for m in range(known):
                weight[m] = shift[m, 0] = shift[m, 1] = np.float32(0)
            for n in range(samples):
                dr, dc = subpixels[n, 0], subpixels[n, 1]
                best = 0
                if sampled.shape[0]:
                    while best < known and near[best] != sampled[taken]:
                        best += 1
                    if best == known:
                        near[best] = sampled[taken]
                        weight[best] = shift[best, 0] = shift[best, 1] = np.float32(0)
                        known += 1
                    taken += 1
                else:
                    x, y, z = _sample(row, first, stride, wraps, dr, dc, across, down, scale)
                    nearest = np.float32(np.inf)
                    for m in range(known):
                        if near[m] < 0:
                            best = m if nearest == np.inf else best
                        else:
                            t = _hit(forms, near[m], x, y, z)
                            if t < nearest:
                                nearest = t
                                best = m
                weight[best] += one
                shift[best, 0] += dr
                shift[best, 1] += dc
            for k in range(3):
                root[k, first] = np.float32(0)
            for m in range(known):
                if weight[m] == 0:
                    continue
                part = one / weight[m]
                x, y, z = _sample(
                    row, first, stride, wraps, part * shift[m, 0], part * shift[m, 1], across, down, scale
                )
                some_ray[0, 0], some_ray[1, 0], some_ray[2, 0] = x, y, z
                _shade(
                    near[m], 0, 1, some_ray, edge_footprint, forms, density, texture, texels, level_offset, level_size,
                    levels, clamps, light_at, light_root, tint_root, emission, work, bits, some_root,
                )  # fmt: skip
                for k in range(3):
                    value = min(some_root[k, 0], _WHITE)
                    root[k, first] += weight[m] / np.float32(samples) * value * value
            for k in range(3):
                root[k, first] = np.sqrt(root[k, first])
            first += 1

        top = np.float32(TONE_SIZE - 1)
        if stride == 1:
            for i in range(count):
                out[row, i, 0] = tone[np.int32(min(root[0, i], top))]
                out[row, i, 1] = tone[np.int32(min(root[1, i], top))]
                out[row, i, 2] = tone[np.int32(min(root[2, i], top))]
        else:
            for i in range(count):
                j = i + 1 if i + 1 < count else 0
                for k in range(min(stride, width - i * stride)):
                    share = np.float32(k) / np.float32(stride)
                    for m in range(3):
                        value = root[m, i] + share * (root[m, j] - root[m, i])
                        out[row, i * stride + k, m] = tone[np.int32(min(value, top))]


@_jit
def _irradiance(
    s: int,
    x: Scalar,
    y: Scalar,
    z: Scalar,
    light_at: npt.NDArray[np.int64],
    light_uv: F32,
    light_linear: F32,
    light: F32,
) -> tuple[Scalar, Scalar, Scalar]:
    """Baked light at a point of surface ``s``, bilinear in its light map."""
    width, height = light_at[s, 1], light_at[s, 2]
    if width == 0:
        e = light_linear[s, 0] * x + light_linear[s, 1] * y + light_linear[s, 2] * z + light_linear[s, 3]
        e = max(e, np.float32(0.02))
        return e, e, e
    a = light_uv[s, 0, 0] * x + light_uv[s, 0, 1] * y + light_uv[s, 0, 2] * z + light_uv[s, 0, 3]
    b = light_uv[s, 1, 0] * x + light_uv[s, 1, 1] * y + light_uv[s, 1, 2] * z + light_uv[s, 1, 3]
    return _light_texel(light, light_at[s, 0], width, height, a, b)


@_jit
def light_at_hits(
    surface: I32,
    range_m: F32,
    origins: F32,
    directions: F32,
    light_at: npt.NDArray[np.int64],
    light_uv: F32,
    light_linear: F32,
    light: F32,
    albedo: F32,
    out: F32,
) -> None:
    """Light (N, 3) reflected by the surfaces that rays hit (irradiance · albedo); zero where the range is negative."""
    for i in range(surface.shape[0]):
        r = range_m[i]
        if r < 0:
            continue
        s = surface[i]
        x = origins[i, 0] + r * directions[i, 0]
        y = origins[i, 1] + r * directions[i, 1]
        z = origins[i, 2] + r * directions[i, 2]
        er, eg, eb = _irradiance(s, x, y, z, light_at, light_uv, light_linear, light)
        out[i, 0] = er * albedo[s, 0]
        out[i, 1] = eg * albedo[s, 1]
        out[i, 2] = eb * albedo[s, 2]
