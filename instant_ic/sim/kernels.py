"""Compiled loops of the renderer: adaptive ray casting, filtered texture lookup, shading. All release the GIL."""

from typing import Any

import numba
import numpy as np
import numpy.typing as npt

F32 = npt.NDArray[np.float32]
I32 = npt.NDArray[np.int32]
U8 = npt.NDArray[np.uint8]
#: float32 in compiled code; numpy's stubs have several types for it.
Scalar = Any

#: Entries of the tone table, which maps radiance 0..TONE_MAX to sRGB.
TONE_SIZE = 8192
TONE_MAX = 4.0

_jit = numba.njit(cache=True, nogil=True, fastmath={"contract", "arcp", "nsz", "reassoc"}, error_model="numpy")


@_jit
def rotate(directions: F32, rotation: F32, out: F32) -> None:
    """Rotate directions (N, 3) by ``rotation`` (3, 3) into ``out`` (N, 3)."""
    for i in range(directions.shape[0]):
        x, y, z = directions[i, 0], directions[i, 1], directions[i, 2]
        for k in range(3):
            out[i, k] = rotation[k, 0] * x + rotation[k, 1] * y + rotation[k, 2] * z


@_jit
def surfaces_of(face: I32, face_surface: I32) -> None:
    """Replace face numbers by surface numbers in place; -1 stays."""
    for i in range(face.shape[0]):
        if face[i] >= 0:
            face[i] = face_surface[face[i]]


@_jit
def refine(
    surface: I32,
    range_m: F32,
    directions: F32,
    origin: F32,
    normal: F32,
    offset: F32,
    step: int,
    wraps: bool,
    todo: I32,
) -> int:
    """Fill in the pixels between those of a coarse grid.

    ``surface`` and ``range_m`` (H, W) are known where both row and column are multiples of ``2 * step``. If all known
    neighbours of a pixel at multiples of ``step`` lie on one surface, the pixel lies on it too, because surfaces are
    planar and convex; its range is computed. Other pixels are listed in ``todo`` (flat indices).

    Returns:
        Number of listed pixels.
    """
    height, width = surface.shape
    coarse = 2 * step
    count = 0
    for row in range(0, height, step):
        above = row - row % coarse
        below = above if row % coarse == 0 else min(above + coarse, height - 1)
        # The last rows have no coarse row below them, so they are cast.
        row_open = below != above and below % coarse != 0
        for column in range(0, width, step):
            left = column - column % coarse
            right = left if column % coarse == 0 else left + coarse
            if above == row and left == column:
                continue
            column_open = False
            if right >= width:
                right = 0
                column_open = not wraps
            s = surface[above, left]
            if (
                row_open
                or column_open
                or s < 0
                or surface[above, right] != s
                or surface[below, left] != s
                or surface[below, right] != s
            ):
                todo[count] = row * width + column
                count += 1
                continue
            i = row * width + column
            nx, ny, nz = normal[s, 0], normal[s, 1], normal[s, 2]
            along = nx * directions[i, 0] + ny * directions[i, 1] + nz * directions[i, 2]
            height_over = offset[s] - (nx * origin[0] + ny * origin[1] + nz * origin[2])
            surface[row, column] = s
            range_m[row, column] = height_over / along
    return count


@_jit
def _bilinear(
    texels: npt.NDArray[np.uint32], first: int, width: int, height: int, u: Scalar, v: Scalar, clamp: bool
) -> tuple[Scalar, Scalar, Scalar]:
    """Bilinear colour at texture coordinates 0..1, linear · 65025 (square of the square-root-coded 0..255)."""
    x = u * np.float32(width) - np.float32(0.5)
    y = v * np.float32(height) - np.float32(0.5)
    floor_x = np.floor(x)
    floor_y = np.floor(y)
    fx = x - floor_x
    fy = y - floor_y
    x0 = np.int32(floor_x)
    y0 = np.int32(floor_y)
    x1 = x0 + np.int32(1)
    y1 = y0 + np.int32(1)
    if clamp:
        x0 = max(x0, np.int32(0))
        y0 = max(y0, np.int32(0))
        x1 = min(x1, np.int32(width - 1))
        y1 = min(y1, np.int32(height - 1))
    else:
        if x0 < 0:
            x0 += np.int32(width)
        if y0 < 0:
            y0 += np.int32(height)
        if x1 >= width:
            x1 -= np.int32(width)
        if y1 >= height:
            y1 -= np.int32(height)
    row0 = first + np.int64(y0) * np.int64(width)
    row1 = first + np.int64(y1) * np.int64(width)
    a, b, c, d = texels[row0 + x0], texels[row0 + x1], texels[row1 + x0], texels[row1 + x1]
    w11 = fx * fy
    w10 = fx - w11
    w01 = fy - w11
    w00 = np.float32(1) - fx - w01
    mask = np.uint32(255)
    ra, rb = np.float32(np.int32(a & mask)), np.float32(np.int32(b & mask))
    rc, rd = np.float32(np.int32(c & mask)), np.float32(np.int32(d & mask))
    e = np.uint32(8)
    ga, gb = np.float32(np.int32((a >> e) & mask)), np.float32(np.int32((b >> e) & mask))
    gc, gd = np.float32(np.int32((c >> e) & mask)), np.float32(np.int32((d >> e) & mask))
    e = np.uint32(16)
    ba, bb = np.float32(np.int32(a >> e)), np.float32(np.int32(b >> e))
    bc, bd = np.float32(np.int32(c >> e)), np.float32(np.int32(d >> e))
    return (
        w00 * ra * ra + w10 * rb * rb + w01 * rc * rc + w11 * rd * rd,
        w00 * ga * ga + w10 * gb * gb + w01 * gc * gc + w11 * gd * gd,
        w00 * ba * ba + w10 * bb * bb + w01 * bc * bc + w11 * bd * bd,
    )


@_jit
def _albedo(
    texels: npt.NDArray[np.uint32],
    level_offset: npt.NDArray[np.int64],
    level_size: I32,
    levels: I32,
    clamps: U8,
    t: int,
    u: Scalar,
    v: Scalar,
    lod: Scalar,
) -> tuple[Scalar, Scalar, Scalar]:
    """Trilinear lookup of the linear albedo of texture ``t``."""
    clamp = clamps[t] != 0
    if clamp:
        u = min(max(u, np.float32(0.0)), np.float32(1.0))
        v = min(max(v, np.float32(0.0)), np.float32(1.0))
    else:
        u -= np.floor(u)
        v -= np.floor(v)
    top = levels[t] - 1
    lod = min(max(lod, np.float32(0.0)), np.float32(top))
    level = int(lod)
    part = np.float32(lod - np.float32(level))
    r, g, b = _bilinear(texels, level_offset[t, level], level_size[t, level, 0], level_size[t, level, 1], u, v, clamp)
    if part > np.float32(0.03) and level < top:
        level += 1
        r1, g1, b1 = _bilinear(
            texels, level_offset[t, level], level_size[t, level, 0], level_size[t, level, 1], u, v, clamp
        )
        r += part * (r1 - r)
        g += part * (g1 - g)
        b += part * (b1 - b)
    scale = np.float32(1.0 / 65025.0)
    return r * scale, g * scale, b * scale


@_jit
def _log2(value: Scalar) -> Scalar:
    """Binary logarithm of a positive float32."""
    return np.float32(np.log2(value))


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
def shade(
    surface: I32,
    range_m: F32,
    directions: F32,
    origin: F32,
    pixel_rad: Scalar,
    normal: F32,
    uv: F32,
    texture: I32,
    tint: F32,
    emission: F32,
    texel_per_m: F32,
    texels: npt.NDArray[np.uint32],
    level_offset: npt.NDArray[np.int64],
    level_size: I32,
    levels: I32,
    clamps: U8,
    light_at: npt.NDArray[np.int64],
    light_uv: F32,
    light_linear: F32,
    light: F32,
    listed: I32,
    out: F32,
) -> None:
    """Compute the radiance of rays with known surface (N,) and range (N,); ``pixel_rad`` is the angle of a pixel.

    Only the rays in ``listed`` are written to ``out`` (N, 3).

    The texture is averaged over the pixel's footprint on the surface: two trilinear lookups along its long axis at
    oblique view angles, one elsewhere.
    """
    last = np.int32(-1)
    one = np.float32(1)
    half = np.float32(0.5)
    angle = np.float32(pixel_rad)
    ox, oy, oz = origin[0], origin[1], origin[2]
    # Surface data is reloaded only when the surface changes, which is rare along a row.
    nx = ny = nz = ux = uy = uz = uw = vx = vy = vz = vw = np.float32(0)
    tr = tg = tb = glow = density = np.float32(0)
    ax = ay = az = aw = bx = by = bz = bw = np.float32(0)
    columns = rows = np.int64(0)
    first = np.int64(0)
    t = np.int32(0)
    for k in range(listed.shape[0]):
        i = listed[k]
        s = surface[i]
        dx, dy, dz = directions[i, 0], directions[i, 1], directions[i, 2]
        if s < 0:
            # Open sky, for worlds that are not closed.
            up = max(dz, np.float32(0.0))
            out[i, 0] = np.float32(0.62) - np.float32(0.30) * up
            out[i, 1] = np.float32(0.72) - np.float32(0.22) * up
            out[i, 2] = np.float32(0.85) - np.float32(0.05) * up
            continue
        if s != last:
            last = s
            nx, ny, nz = normal[s, 0], normal[s, 1], normal[s, 2]
            ux, uy, uz, uw = uv[s, 0, 0], uv[s, 0, 1], uv[s, 0, 2], uv[s, 0, 3]
            vx, vy, vz, vw = uv[s, 1, 0], uv[s, 1, 1], uv[s, 1, 2], uv[s, 1, 3]
            tr, tg, tb = tint[s, 0], tint[s, 1], tint[s, 2]
            glow, density, t = emission[s], texel_per_m[s], texture[s]
            first, columns, rows = light_at[s, 0], light_at[s, 1], light_at[s, 2]
            if columns == 0:
                ax, ay, az, aw = light_linear[s, 0], light_linear[s, 1], light_linear[s, 2], light_linear[s, 3]
            else:
                ax, ay, az, aw = light_uv[s, 0, 0], light_uv[s, 0, 1], light_uv[s, 0, 2], light_uv[s, 0, 3]
                bx, by, bz, bw = light_uv[s, 1, 0], light_uv[s, 1, 1], light_uv[s, 1, 2], light_uv[s, 1, 3]
        r = range_m[i]
        x, y, z = ox + r * dx, oy + r * dy, oz + r * dz
        u = ux * x + uy * y + uz * z + uw
        v = vx * x + vy * y + vz * z + vw
        side = nx * dx + ny * dy + nz * dz
        minor = r * angle
        stretch = min(one / max(abs(side), np.float32(0.02)), np.float32(16.0))
        if stretch < np.float32(2.2):
            lod = _log2(minor * stretch * density)
            cr, cg, cb = _albedo(texels, level_offset, level_size, levels, clamps, t, u, v, lod)
        else:
            px, py, pz = dx - side * nx, dy - side * ny, dz - side * nz
            reach = np.float32(0.25) * minor * stretch / np.sqrt(px * px + py * py + pz * pz)
            du = (ux * px + uy * py + uz * pz) * reach
            dv = (vx * px + vy * py + vz * pz) * reach
            lod = _log2(minor * max(stretch * half, one) * density)
            cr, cg, cb = _albedo(texels, level_offset, level_size, levels, clamps, t, u + du, v + dv, lod)
            r2, g2, b2 = _albedo(texels, level_offset, level_size, levels, clamps, t, u - du, v - dv, lod)
            cr = half * (cr + r2)
            cg = half * (cg + g2)
            cb = half * (cb + b2)
        if glow > 0:
            er = eg = eb = glow
        elif columns == 0:
            er = eg = eb = max(ax * x + ay * y + az * z + aw, np.float32(0.02))
        else:
            a = ax * x + ay * y + az * z + aw
            b = bx * x + by * y + bz * z + bw
            er, eg, eb = _light_texel(light, first, columns, rows, a, b)
        out[i, 0] = cr * tr * er
        out[i, 1] = cg * tg * eg
        out[i, 2] = cb * tb * eb


@_jit
def edges(surface: I32, range_m: F32, normal: F32, texture: I32, wraps: bool, out: I32) -> int:
    """List the pixels (flat indices) whose right or lower neighbour shows something else; return their number.

    Two adjoining surfaces of the same texture (one wall in two pieces, the triangles of a smooth mesh) do not form an
    edge.
    """
    height, width = surface.shape
    count = 0
    for row in range(height):
        for column in range(width):
            s = surface[row, column]
            r = range_m[row, column]
            found = False
            for k in range(4):
                a, b = row, column
                if k == 0:
                    b = column + 1
                elif k == 1:
                    a = row + 1
                elif k == 2:
                    b = column - 1
                else:
                    a = row - 1
                if a < 0 or a >= height:
                    continue
                if b < 0 or b >= width:
                    if not wraps:
                        continue
                    b = b % width
                o = surface[a, b]
                if o == s:
                    continue
                if s < 0 or o < 0 or texture[s] != texture[o]:
                    found = True
                    break
                bend = normal[s, 0] * normal[o, 0] + normal[s, 1] * normal[o, 1] + normal[s, 2] * normal[o, 2]
                q = range_m[a, b]
                if bend < np.float32(0.95) or abs(r - q) > np.float32(0.08) * min(r, q):
                    found = True
                    break
            if found:
                out[count] = row * width + column
                count += 1
    return count


@_jit
def plain_pixels(strides: I32, edge: U8, out: I32) -> int:
    """List the non-edge pixels (flat indices) at multiples of their row's stride; return their number."""
    height, width = edge.shape
    count = 0
    for row in range(height):
        for column in range(0, width, strides[row]):
            if not edge[row, column]:
                out[count] = row * width + column
                count += 1
    return count


@_jit
def anchored(listed: I32, strides: I32, width: int) -> int:
    """Keep in ``listed`` only the pixels at multiples of their row's stride, in place; return their number."""
    count = 0
    for k in range(listed.shape[0]):
        row = listed[k] // width
        if (listed[k] - row * width) % strides[row] == 0:
            listed[count] = listed[k]
            count += 1
    return count


@_jit
def fill_rows(radiance: F32, strides: I32) -> None:
    """Interpolate linearly the pixels between multiples of their row's stride; rows wrap."""
    height, width = radiance.shape[:2]
    for row in range(height):
        stride = strides[row]
        if stride == 1:
            continue
        part = np.float32(1) / np.float32(stride)
        for left in range(0, width, stride):
            right = left + stride
            end = min(right, width)
            if right >= width:
                right = 0
            for column in range(left + 1, end):
                share = np.float32(column - left) * part
                for c in range(3):
                    a = radiance[row, left, c]
                    radiance[row, column, c] = a + share * (radiance[row, right, c] - a)


@_jit
def tone(radiance: F32, table: U8, out: U8) -> None:
    """Convert radiance (N, 3) to sRGB bytes (N, 3) with the tone table."""
    scale = np.float32((TONE_SIZE - 1) / TONE_MAX)
    for i in range(radiance.shape[0]):
        for k in range(3):
            out[i, k] = table[int(min(max(radiance[i, k], np.float32(0.0)), np.float32(TONE_MAX)) * scale)]


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
