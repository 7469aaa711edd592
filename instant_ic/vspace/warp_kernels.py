"""CPU kernels of the depth warp in numba: rendering of the panorama's mesh, and anti-aliased panorama look-up."""

from __future__ import annotations

import math

import numpy as np
from numba import njit

from instant_ic.vspace.nerf.kernels import _OPTIONS
from instant_ic.vspace.nerf.march import along

NEAR_M = 0.02
"""Depth along the view's axis below which surfaces are cut away."""
EMPTY, FILLED, KNOWN, BEHIND = 0, 1, 2, 3
"""Content of a pixel: nothing, a surface of filled depth, a surface of known depth, or the back of a surface."""
MAX_TAPS = 8
"""Largest number of samples along a stretched footprint."""


@njit(**_OPTIONS)
def beyond(x, y, z, half, tall):  # type: ignore[no-untyped-def]
    """Return the view's clipping planes beyond which a point lies, as bits.

    ``half`` and ``tall`` are the tangents of half the horizontal and vertical field of view.
    """
    code = 1 if x < NEAR_M else 0
    code |= 2 if y > half * x else 0
    code |= 4 if y < -half * x else 0
    code |= 8 if z > tall * x else 0
    code |= 16 if z < -tall * x else 0
    return code


@njit(**_OPTIONS)
def place_vertices(inverse, directions, view_from_camera, half, aspect, vertices, outside):  # type: ignore[no-untyped-def]
    """Transform the mesh's corners to the view's frame, and find the clipping planes beyond which they lie.

    Args:
        inverse, directions: inverse depth, (h, w), and unit vectors, (h, w, 3).
        view_from_camera: pose of the panorama's camera in the view's frame, (4, 4) float32.
        half, aspect: tangent of half the horizontal field of view, and height over width of the view.
        vertices: corners in the view's frame, (h, w, 3); written.
        outside: one bit per clipping plane, (h, w) uint8; written.
    """
    height, width = inverse.shape
    m = view_from_camera
    tall, origin = half * aspect, np.zeros(3, np.float32)
    for v in range(height):
        for u in range(width):
            x, y, z = along(m, origin, directions[v, u], np.float32(1) / inverse[v, u])
            vertices[v, u, 0], vertices[v, u, 1], vertices[v, u, 2] = x, y, z
            code = beyond(x, y, z, half, tall)
            outside[v, u] = code


@njit(**_OPTIONS)
def rasterize_triangle(a, b, c, clipped, mark, half, nearness, marks):  # type: ignore[no-untyped-def]
    """Rasterize a triangle into the z-buffer. Its corners are (x, y, z) in the view's frame, x forward.

    Edge functions are computed in homogeneous coordinates (Olano and Greer, 1997), so that triangles need no clipping.
    ``clipped`` is true if a corner lies behind the view, so that the corners give no bounding box in the image.
    """
    height, width = nearness.shape
    pixel = np.float32(2) * half / np.float32(width)
    left, top = half - np.float32(0.5) * pixel, np.float32(0.5 * height - 0.5) * pixel
    x0, x1, y0, y1 = 0, width - 1, 0, height - 1
    if not clipped:
        ua, ub, uc = (left - a[1] / a[0]) / pixel, (left - b[1] / b[0]) / pixel, (left - c[1] / c[0]) / pixel
        va, vb, vc = (top - a[2] / a[0]) / pixel, (top - b[2] / b[0]) / pixel, (top - c[2] / c[0]) / pixel
        x0, x1 = max(x0, math.ceil(min(ua, ub, uc) - 1e-3)), min(x1, math.floor(max(ua, ub, uc) + 1e-3))
        y0, y1 = max(y0, math.ceil(min(va, vb, vc) - 1e-3)), min(y1, math.floor(max(va, vb, vc) + 1e-3))
        if x0 > x1 or y0 > y1:
            return
    nax, nay, naz = b[1] * c[2] - b[2] * c[1], b[2] * c[0] - b[0] * c[2], b[0] * c[1] - b[1] * c[0]
    nbx, nby, nbz = c[1] * a[2] - c[2] * a[1], c[2] * a[0] - c[0] * a[2], c[0] * a[1] - c[1] * a[0]
    ncx, ncy, ncz = a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0]
    volume = a[0] * nax + a[1] * nay + a[2] * naz
    if volume == 0:
        return
    if volume < 0:
        mark = BEHIND
    scale = np.float32(1) / volume
    for row in range(y0, y1 + 1):
        z = top - np.float32(row) * pixel
        for column in range(x0, x1 + 1):
            y = left - np.float32(column) * pixel
            ea, eb, ec = nax + nay * y + naz * z, nbx + nby * y + nbz * z, ncx + ncy * y + ncz * z
            ea, eb, ec = ea * scale, eb * scale, ec * scale
            near = ea + eb + ec
            slack = np.float32(-1e-4) * near  # tolerates rounding, so that there are no cracks between neighbours
            inside = ea >= slack and eb >= slack and ec >= slack
            if inside and nearness[row, column] < near < np.float32(1 / NEAR_M):
                nearness[row, column] = near
                marks[row, column] = mark


@njit(**_OPTIONS)
def render_mesh(  # type: ignore[no-untyped-def]
    vertices, outside, inverse, depth_edge, known, corners, view_from_camera, half, nearness, marks
):
    """Render the panorama's mesh into a z-buffer.

    A quad that crosses a depth edge is rendered as four quarters, each at the depth of its own corner. Seen from the
    panorama's position nothing is missing, and seen from the side the edge opens.

    Args:
        vertices, outside: results of ``place_vertices``.
        inverse, depth_edge, known: arrays of the ``PanoramaPrior`` with one more row above and below, for the poles;
            pixels whose ``known`` is 2 are not rendered.
        corners: unit vectors half a pixel up and left of each pixel, (h + 1, w, 3).
        nearness: inverse depth along the view's axis, 0 where there is no surface, (H, W); updated in place.
        marks: ``EMPTY``, ``FILLED``, ``KNOWN`` or ``BEHIND``, (H, W) uint8; updated in place.
    """
    height, width = inverse.shape
    m = view_from_camera
    aspect = np.float32(nearness.shape[0]) / np.float32(nearness.shape[1])
    origin = np.zeros(3, np.float32)
    patch = np.zeros((4, 3), np.float32)
    for v in range(height - 1):
        for u in range(width):
            right = (u + 1) % width
            if not depth_edge[v, u]:
                codes = outside[v, u] | outside[v, right] | outside[v + 1, u] | outside[v + 1, right]
                if outside[v, u] & outside[v, right] & outside[v + 1, u] & outside[v + 1, right]:
                    continue
                a, b, c, d = vertices[v, u], vertices[v, right], vertices[v + 1, u], vertices[v + 1, right]
                seen = known[v, u] and known[v, right] and known[v + 1, u] and known[v + 1, right]
                mark = KNOWN if seen else FILLED
                rasterize_triangle(a, b, c, codes & 1, mark, half, nearness, marks)
                rasterize_triangle(b, d, c, codes & 1, mark, half, nearness, marks)
                continue
            for corner in range(4):
                row, column = v + corner // 2, right if corner % 2 else u
                if known[row, column] > 1:
                    continue
                # The quarter between the pixel's direction and the middle of the quad.
                depth = np.float32(1) / inverse[row, column]
                tangled, common = False, 31
                for k in range(4):
                    if (k // 2 == 0) == (corner // 2 == 0):
                        down = 2 * v + (0 if corner // 2 == 0 else 2)
                    else:
                        down = 2 * v + 1
                    if (k % 2 == 0) == (corner % 2 == 0):
                        across = 2 * u + (0 if corner % 2 == 0 else 2)
                    else:
                        across = 2 * u + 1
                    x, y, z = along(m, origin, corners[down, across % (2 * width)], depth)
                    patch[k, 0], patch[k, 1], patch[k, 2] = x, y, z
                    tangled = tangled or x < NEAR_M
                    common &= beyond(x, y, z, half, half * aspect)
                if common:
                    continue
                mark = KNOWN if known[row, column] else FILLED
                rasterize_triangle(patch[0], patch[1], patch[2], tangled, mark, half, nearness, marks)
                rasterize_triangle(patch[1], patch[3], patch[2], tangled, mark, half, nearness, marks)


@njit(**_OPTIONS)
def _angle(y, x):  # type: ignore[no-untyped-def]
    """Return ``atan2`` within 1e-6 rad by the polynomial of SLEEF's ``atanf_u35``, three times as fast as numba's."""
    ax, ay = abs(x), abs(y)
    t = min(ax, ay) / max(ax, ay, np.float32(1e-30))
    s = t * t
    p = np.float32(0.00282363896258175373077393) * s + np.float32(-0.0159569028764963150024414)
    p = p * s + np.float32(0.0425049886107444763183594)
    p = p * s + np.float32(-0.0748900920152664184570312)
    p = p * s + np.float32(0.106347933411598205566406)
    p = p * s + np.float32(-0.142027363181114196777344)
    p = p * s + np.float32(0.199926957488059997558594)
    p = p * s + np.float32(-0.333331018686294555664062)
    angle = p * s * t + t
    if ay > ax:
        angle = np.float32(math.pi / 2) - angle
    if x < 0:
        angle = np.float32(math.pi) - angle
    return -angle if y < 0 else angle


@njit(**_OPTIONS)
def panorama_places(camera_from_map, origin, directions, depth, height, width, places):  # type: ignore[no-untyped-def]
    """Write the panorama's index coordinates (u, v) of points on rays to ``places`` (P, 2); −1e9 if the depth is 0."""
    for n in range(depth.shape[0]):
        if depth[n] <= 0:
            places[n, 0] = places[n, 1] = np.float32(-1e9)
            continue
        x, y, z = along(camera_from_map, origin, directions[n], depth[n])
        places[n, 0] = (math.pi - _angle(y, x)) * (width / (2 * math.pi)) - 0.5
        places[n, 1] = (math.pi / 2 - _angle(z, math.sqrt(x * x + y * y))) * (height / math.pi) - 0.5


@njit(**_OPTIONS)
def _step(places, n, other, width):  # type: ignore[no-untyped-def]
    """Return the step from place ``n`` to place ``other``, across the panorama's seam if that is shorter."""
    du, dv = places[other, 0] - places[n, 0], places[other, 1] - places[n, 1]
    if du > 0.5 * width:
        du -= width
    elif du < -0.5 * width:
        du += width
    return du, dv


@njit(**_OPTIONS)
def _shorter_step(places, n, before, after, width):  # type: ignore[no-untyped-def]
    """Return the change of place per pixel of the view, taken at a depth edge on the side without a jump."""
    du, dv = _step(places, n, after, width) if after >= 0 else (np.float32(1e9), np.float32(0))
    eu, ev = _step(places, before, n, width) if before >= 0 else (np.float32(1e9), np.float32(0))
    return (du, dv) if du * du + dv * dv <= eu * eu + ev * ev else (eu, ev)


@njit(**_OPTIONS)
def _bilinear(texels, start, height, width, u, v, weight, out):  # type: ignore[no-untyped-def]
    """Add ``weight`` × the bilinear colour of one level, at index coordinates of that level, to ``out``."""
    v = min(max(v, np.float32(0)), np.float32(height - 1))
    u0, v0 = math.floor(u), math.floor(v)
    fu, fv = u - np.float32(u0), v - np.float32(v0)
    v1 = min(v0 + 1, height - 1)
    left, right = u0 % width, (u0 + 1) % width
    a, b = start + v0 * width + left, start + v0 * width + right
    c, d = start + v1 * width + left, start + v1 * width + right
    one = np.float32(1)
    wa, wb, wc, wd = (one - fu) * (one - fv), fu * (one - fv), (one - fu) * fv, fu * fv
    for k in range(3):
        value = wa * np.float32(texels[a, k]) + wb * np.float32(texels[b, k])
        value += wc * np.float32(texels[c, k]) + wd * np.float32(texels[d, k])
        out[k] += weight * value


@njit(**_OPTIONS)
def _footprint(places, row, column, height, width, sizes, blur):  # type: ignore[no-untyped-def]
    """Return the ellipse in the panorama that a pixel of the view covers.

    Returns:
        Longer axis (u, v) of the ellipse, number of samples along it, and level of the pyramid.
    """
    full = np.float32(sizes[0, 1])
    n = row * width + column
    left = n - 1 if column > 0 and places[n - 1, 0] > -1e8 else -1
    right = n + 1 if column + 1 < width and places[n + 1, 0] > -1e8 else -1
    above = n - width if row > 0 and places[n - width, 0] > -1e8 else -1
    below = n + width if row + 1 < height and places[n + width, 0] > -1e8 else -1
    ux, vx = _shorter_step(places, n, left, right, full)
    uy, vy = _shorter_step(places, n, above, below, full)
    if left < 0 and right < 0:
        ux, vx = np.float32(1), np.float32(0)
    if above < 0 and below < 0:
        uy, vy = np.float32(0), np.float32(1)
    # The eigenvalues of J Jᵀ are the squares of the ellipse's half axes.
    p, q, r = ux * ux + uy * uy, ux * vx + uy * vy, vx * vx + vy * vy
    mean, half = np.float32(0.5) * (p + r), math.sqrt(np.float32(0.25) * (p - r) * (p - r) + q * q)
    major = blur * math.sqrt(mean + half)
    minor = blur * math.sqrt(max(mean - half, np.float32(0)))
    taps = min(max(math.ceil(major / max(minor, np.float32(1)) - np.float32(0.25)), 1), MAX_TAPS)
    level = math.log2(max(minor, major / np.float32(taps), np.float32(1)))
    level = min(float(level), float(sizes.shape[0] - 1))
    # Eigenvector of the longer axis.
    along_u, along_v = (q, mean + half - p) if p < r else (mean + half - r, q)
    length = math.sqrt(along_u * along_u + along_v * along_v)
    if length > 0:
        along_u, along_v = along_u / length * major, along_v / length * major
    return along_u, along_v, taps, level


@njit(**_OPTIONS)
def look_up(texels, level_start, sizes, places, height, width, blur, wanted, share, colour):  # type: ignore[no-untyped-def]
    """Blend the panorama's colours, averaged over each pixel's footprint, into a view.

    The footprint follows from the places of neighbouring pixels. A stretched footprint gets up to ``MAX_TAPS`` samples
    along its longer side (anisotropic filtering).

    Args:
        texels, level_start, sizes: arrays of the ``Pyramid``.
        places: result of ``panorama_places`` for all pixels of the view, (P, 2), P = height · width.
        height, width: size of the view.
        blur: share of a pixel over which a colour is averaged.
        wanted: positive where a colour is wanted, (P,).
        share: weight of the panorama in the result, 0 to 1.
        colour: RGB of the view, 0 to 1, (P, 3); updated in place.
    """
    out = np.zeros(3, np.float32)
    for row in range(height):
        for column in range(width):
            n = row * width + column
            if wanted[n] <= 0 or places[n, 0] < -1e8:
                continue
            along_u, along_v, taps, level = _footprint(places, row, column, height, width, sizes, blur)
            low = int(level)
            mix = level - np.float32(low)
            out[:] = 0
            for tap in range(taps):
                offset = (np.float32(tap) + np.float32(0.5)) / np.float32(taps) - np.float32(0.5)
                u, v = places[n, 0] + offset * along_u, places[n, 1] + offset * along_v
                for k in range(2):
                    weight = (np.float32(1) - mix if k == 0 else mix) / np.float32(taps)
                    if weight == 0:
                        continue
                    shrink = np.float32(1) / np.float32(1 << (low + k))
                    at_u, at_v = (u + np.float32(0.5)) * shrink, (v + np.float32(0.5)) * shrink
                    _bilinear(
                        texels, level_start[low + k], sizes[low + k, 0], sizes[low + k, 1],
                        at_u - np.float32(0.5), at_v - np.float32(0.5), weight, out,
                    )  # fmt: skip
            for k in range(3):
                colour[n, k] += share * (out[k] * np.float32(1 / 255) - colour[n, k])
