"""The warp's two kernels for NVIDIA GPUs (Triton), with ``torch_warp``'s signatures; ``TRITON_INTERPRET=1`` for tests.

A lane of a program has one patch; patches of many pixels are rendered by all lanes together. Only ``triton_device``
imports this module.
"""

# mypy: disable-error-code="no-untyped-def"
# Triton compiles these functions by its own types.

from __future__ import annotations

import torch
import triton
import triton.language as tl
from torch import Tensor

from instant_ic.vspace import torch_warp
from instant_ic.vspace.torch_warp import Patches, TorchPyramid, WarpKernels
from instant_ic.vspace.warp import BLUR

PATCHES = 128
"""Of one program."""
SMALL = 64
"""Pixels of a box round a patch that one lane goes through by itself."""
PIXELS = 128
"""Of one program of the look-up."""
_NEAR_M = tl.constexpr(torch_warp.NEAR_M)
_BEHIND = tl.constexpr(torch_warp.BEHIND)
_MARKS = tl.constexpr(torch_warp.MARKS)
_NOWHERE = tl.constexpr(torch_warp.NOWHERE)
_MAX_TAPS = tl.constexpr(torch_warp.MAX_TAPS)
_BLUR = tl.constexpr(BLUR)


def draw_patches(patches: Patches, view_from_camera: Tensor, half: float, buffer: Tensor) -> None:
    """See ``torch_warp.draw_patches``."""
    height, width = buffer.shape
    count, mesh = len(patches.items), patches.mesh
    if count:
        _draw_patches[(triton.cdiv(count, PATCHES),)](
            patches.items, patches.marks, count, mesh.inverse, mesh.rows, mesh.columns, mesh.inverse.shape[1],
            view_from_camera, float(half), 2 * float(half) / width, buffer, width, height,
            QUARTERS=patches.quarters, B=PATCHES, MOST=SMALL,
        )  # fmt: skip


def look_up(pyramid: TorchPyramid, places: Tensor, wanted: Tensor) -> Tensor:
    """See ``torch_warp.look_up``."""
    height, width = wanted.shape
    colour = torch.empty(height, width, 3, device=places.device)
    _look_up[(triton.cdiv(height * width, PIXELS),)](
        pyramid.texels, pyramid.start, pyramid.sizes, len(pyramid.start), pyramid.size[1], places, wanted, width,
        height, colour, B=PIXELS,
    )  # fmt: skip
    return colour


@triton.jit
def _place(rows, columns, view, row, column, w, depth, wanted):
    """A corner in the view's frame."""
    column = tl.where(column >= 2 * w, column - 2 * w, column)
    flat = depth * tl.load(rows + 2 * row, mask=wanted, other=0.0)
    z = depth * tl.load(rows + 2 * row + 1, mask=wanted, other=0.0)
    x = flat * tl.load(columns + 2 * column, mask=wanted, other=0.0)
    y = flat * tl.load(columns + 2 * column + 1, mask=wanted, other=0.0)
    return (
        tl.load(view) * x + tl.load(view + 1) * y + tl.load(view + 2) * z + tl.load(view + 3),
        tl.load(view + 4) * x + tl.load(view + 5) * y + tl.load(view + 6) * z + tl.load(view + 7),
        tl.load(view + 8) * x + tl.load(view + 9) * y + tl.load(view + 10) * z + tl.load(view + 11),
    )


@triton.jit
def _edges(ax, ay, az, bx, by, bz, cx, cy, cz):
    """Edge functions of a triangle over its volume: nine numbers; and the volume, 0 where it has no area."""
    ux, uy, uz = by * cz - bz * cy, bz * cx - bx * cz, bx * cy - by * cx
    vx, vy, vz = cy * az - cz * ay, cz * ax - cx * az, cx * ay - cy * ax
    wx, wy, wz = ay * bz - az * by, az * bx - ax * bz, ax * by - ay * bx
    volume = ax * ux + ay * uy + az * uz
    s = tl.where(volume == 0, 0.0, 1 / tl.where(volume == 0, 1.0, volume))
    return ux * s, uy * s, uz * s, vx * s, vy * s, vz * s, wx * s, wy * s, wz * s, volume


@triton.jit
def _fragment(y, z, ux, uy, uz, vx, vy, vz, wx, wy, wz, mark):
    """A triangle at places (1, y, z) of the view: what the buffer gets, 0 beside it."""
    a, b, c = ux + uy * y + uz * z, vx + vy * y + vz * z, wx + wy * y + wz * z
    near = a + b + c
    slack = -1e-4 * near
    covered = (a >= slack) & (b >= slack) & (c >= slack) & (near > 0) & (near < 1 / _NEAR_M)
    return tl.where(covered, (near.to(tl.int32, bitcast=True) & ~_MARKS) | mark, 0)


@triton.jit
def _one(value, chosen):
    """One lane's value for all."""
    return tl.sum(tl.where(chosen, value, 0), axis=0)


@triton.jit(do_not_specialize=["count", "w", "width", "height"])
def _draw_patches(
    items, marks, count, inverse, rows, columns, w, view, half, pixel, buffer, width, height,
    QUARTERS: tl.constexpr, B: tl.constexpr, MOST: tl.constexpr,
):  # fmt: skip
    lane = tl.arange(0, B)
    n = tl.program_id(0) * B + lane
    exists = n < count
    item = tl.load(items + n, mask=exists, other=0)
    quad = item >> 2 if QUARTERS else item
    v, u = quad // w, quad % w
    row, column = 2 * v, 2 * u
    if QUARTERS:
        down, right = (item >> 1) & 1, item & 1
        at = (v + down) * w + tl.where(u + right >= w, 0, u + right)
        of_a = 1 / tl.load(inverse + at, mask=exists, other=1.0)
        of_b, of_c, of_d = of_a, of_a, of_a
        row, column = row + down, column + right
    else:
        beside = tl.where(u + 1 >= w, 0, u + 1)
        of_a = 1 / tl.load(inverse + v * w + u, mask=exists, other=1.0)
        of_b = 1 / tl.load(inverse + v * w + beside, mask=exists, other=1.0)
        of_c = 1 / tl.load(inverse + (v + 1) * w + u, mask=exists, other=1.0)
        of_d = 1 / tl.load(inverse + (v + 1) * w + beside, mask=exists, other=1.0)
    step: tl.constexpr = 1 if QUARTERS else 2
    ax, ay, az = _place(rows, columns, view, row, column, w, of_a, exists)
    bx, by, bz = _place(rows, columns, view, row, column + step, w, of_b, exists)
    cx, cy, cz = _place(rows, columns, view, row + step, column, w, of_c, exists)
    dx, dy, dz = _place(rows, columns, view, row + step, column + step, w, of_d, exists)

    tall = half * height / width
    seen = exists & ((ax >= _NEAR_M) | (bx >= _NEAR_M) | (cx >= _NEAR_M) | (dx >= _NEAR_M))
    seen &= (ay <= half * ax) | (by <= half * bx) | (cy <= half * cx) | (dy <= half * dx)
    seen &= (ay >= -half * ax) | (by >= -half * bx) | (cy >= -half * cx) | (dy >= -half * dx)
    seen &= (az <= tall * ax) | (bz <= tall * bx) | (cz <= tall * cx) | (dz <= tall * dx)
    seen &= (az >= -tall * ax) | (bz >= -tall * bx) | (cz >= -tall * cx) | (dz >= -tall * dx)
    if tl.max(seen.to(tl.int32), axis=0) > 0:
        left, top = half - 0.5 * pixel, (0.5 * height - 0.5) * pixel
        # A patch with a corner behind the view has no place in the image to bound by: anywhere.
        clipped = (ax < _NEAR_M) | (bx < _NEAR_M) | (cx < _NEAR_M) | (dx < _NEAR_M)
        sa, sb = tl.maximum(ax, _NEAR_M), tl.maximum(bx, _NEAR_M)
        sc, sd = tl.maximum(cx, _NEAR_M), tl.maximum(dx, _NEAR_M)
        ua, ub, uc, ud = ay / sa, by / sb, cy / sc, dy / sd
        va, vb, vc, vd = az / sa, bz / sb, cz / sc, dz / sd
        x0 = tl.ceil((left - tl.maximum(tl.maximum(ua, ub), tl.maximum(uc, ud))) / pixel - 1e-3)
        x1 = tl.floor((left - tl.minimum(tl.minimum(ua, ub), tl.minimum(uc, ud))) / pixel + 1e-3)
        y0 = tl.ceil((top - tl.maximum(tl.maximum(va, vb), tl.maximum(vc, vd))) / pixel - 1e-3)
        y1 = tl.floor((top - tl.minimum(tl.minimum(va, vb), tl.minimum(vc, vd))) / pixel + 1e-3)
        x0 = tl.where(clipped, 0.0, tl.maximum(x0, 0.0)).to(tl.int32)
        y0 = tl.where(clipped, 0.0, tl.maximum(y0, 0.0)).to(tl.int32)
        x1 = tl.where(clipped, width - 1.0, tl.minimum(x1, width - 1.0)).to(tl.int32)
        y1 = tl.where(clipped, height - 1.0, tl.minimum(y1, height - 1.0)).to(tl.int32)
        wide = tl.maximum(x1 - x0 + 1, 0)
        total = tl.where(seen, wide * tl.maximum(y1 - y0 + 1, 0), 0)

        e0, e1, e2, e3, e4, e5, e6, e7, e8, first = _edges(ax, ay, az, bx, by, bz, cx, cy, cz)
        f0, f1, f2, f3, f4, f5, f6, f7, f8, second = _edges(bx, by, bz, dx, dy, dz, cx, cy, cz)
        mark = tl.load(marks + n, mask=exists, other=0).to(tl.int32)
        first_mark, second_mark = tl.where(first < 0, _BEHIND, mark), tl.where(second < 0, _BEHIND, mark)

        most = tl.max(tl.where(total <= MOST, total, 0), axis=0)
        x, y = x0, y0
        i = 0
        while i < most:
            py, pz = left - x.to(tl.float32) * pixel, top - y.to(tl.float32) * pixel
            value = tl.maximum(
                _fragment(py, pz, e0, e1, e2, e3, e4, e5, e6, e7, e8, first_mark),
                _fragment(py, pz, f0, f1, f2, f3, f4, f5, f6, f7, f8, second_mark),
            )
            met = (total <= MOST) & (i < total) & (value > 0)
            tl.atomic_max(buffer + y * width + x, value, mask=met, sem="relaxed")
            over = x >= x1
            x, y = tl.where(over, x0, x + 1), tl.where(over, y + 1, y)
            i += 1

        left_over = total > MOST
        number = tl.min(tl.where(left_over, lane, B), axis=0)
        while number < B:
            chosen = lane == number
            g0, g1, g2 = _one(e0, chosen), _one(e1, chosen), _one(e2, chosen)
            g3, g4, g5 = _one(e3, chosen), _one(e4, chosen), _one(e5, chosen)
            g6, g7, g8 = _one(e6, chosen), _one(e7, chosen), _one(e8, chosen)
            h0, h1, h2 = _one(f0, chosen), _one(f1, chosen), _one(f2, chosen)
            h3, h4, h5 = _one(f3, chosen), _one(f4, chosen), _one(f5, chosen)
            h6, h7, h8 = _one(f6, chosen), _one(f7, chosen), _one(f8, chosen)
            g_mark, h_mark = _one(first_mark, chosen), _one(second_mark, chosen)
            bx0, by0, bwide, pixels = _one(x0, chosen), _one(y0, chosen), _one(wide, chosen), _one(total, chosen)
            i = 0
            while i < pixels:
                x, y = bx0 + (i + lane) % bwide, by0 + (i + lane) // bwide
                py, pz = left - x.to(tl.float32) * pixel, top - y.to(tl.float32) * pixel
                value = tl.maximum(
                    _fragment(py, pz, g0, g1, g2, g3, g4, g5, g6, g7, g8, g_mark),
                    _fragment(py, pz, h0, h1, h2, h3, h4, h5, h6, h7, h8, h_mark),
                )
                met = (i + lane < pixels) & (value > 0)
                tl.atomic_max(buffer + y * width + x, value, mask=met, sem="relaxed")
                i += B
            left_over = left_over & ~chosen
            number = tl.min(tl.where(left_over, lane, B), axis=0)


@triton.jit
def _step(places, at, other, exists, u, v, full, forward):
    """Change of place to a neighbour, over the seam where that is shorter; far where it shows nothing."""
    eu = tl.load(places + 2 * other, mask=exists, other=_NOWHERE)
    ev = tl.load(places + 2 * other + 1, mask=exists, other=_NOWHERE)
    there = eu > 0.1 * _NOWHERE
    du, dv = (eu - u) * forward, (ev - v) * forward
    du = tl.where(du > 0.5 * full, du - full, du)
    du = tl.where(du < -0.5 * full, du + full, du)
    return tl.where(there, du, -_NOWHERE), tl.where(there, dv, 0.0), there


@triton.jit
def _texel(texels, start, u0, v0, u1, v1, fu, fv, width, wanted, channel: tl.constexpr):
    """Bilinear, one colour, 0..255."""
    a = tl.load(texels + (start + v0 * width + u0) * 3 + channel, mask=wanted, other=0).to(tl.float32)
    b = tl.load(texels + (start + v0 * width + u1) * 3 + channel, mask=wanted, other=0).to(tl.float32)
    c = tl.load(texels + (start + v1 * width + u0) * 3 + channel, mask=wanted, other=0).to(tl.float32)
    d = tl.load(texels + (start + v1 * width + u1) * 3 + channel, mask=wanted, other=0).to(tl.float32)
    return (a * (1 - fu) + b * fu) * (1 - fv) + (c * (1 - fu) + d * fu) * fv


@triton.jit(do_not_specialize=["levels", "panorama_width", "width", "height"])
def _look_up(
    texels, starts, sizes, levels, panorama_width, places, wanted, width, height, colour, B: tl.constexpr
):  # fmt: skip
    at = tl.program_id(0) * B + tl.arange(0, B)
    inside = at < width * height
    row, column = at // width, at % width
    u = tl.load(places + 2 * at, mask=inside, other=_NOWHERE)
    v = tl.load(places + 2 * at + 1, mask=inside, other=_NOWHERE)
    asked = inside & (tl.load(wanted + at, mask=inside, other=0.0) > 0) & (u > 0.1 * _NOWHERE)
    full = panorama_width.to(tl.float32)
    ax, ay, after = _step(places, at, at + 1, asked & (column + 1 < width), u, v, full, 1.0)
    bx, by, before = _step(places, at, at - 1, asked & (column > 0), u, v, full, -1.0)
    first = ax * ax + ay * ay <= bx * bx + by * by
    none = ~after & ~before
    ux, vx = tl.where(none, 1.0, tl.where(first, ax, bx)), tl.where(none, 0.0, tl.where(first, ay, by))
    ax, ay, after = _step(places, at, at + width, asked & (row + 1 < height), u, v, full, 1.0)
    bx, by, before = _step(places, at, at - width, asked & (row > 0), u, v, full, -1.0)
    first = ax * ax + ay * ay <= bx * bx + by * by
    none = ~after & ~before
    uy, vy = tl.where(none, 0.0, tl.where(first, ax, bx)), tl.where(none, 1.0, tl.where(first, ay, by))
    # Half axes of the ellipse that a pixel covers: eigenvalues of J Jᵀ.
    p, q, r = ux * ux + uy * uy, ux * vx + uy * vy, vx * vx + vy * vy
    mean, half = 0.5 * (p + r), tl.sqrt(0.25 * (p - r) * (p - r) + q * q)
    major, minor = tl.sqrt(mean + half) * _BLUR, tl.sqrt(tl.maximum(mean - half, 0.0)) * _BLUR
    taps = tl.ceil(major / tl.maximum(minor, 1.0) - 0.25)
    taps = tl.minimum(tl.maximum(taps, 1.0), _MAX_TAPS)
    level = tl.log2(tl.maximum(tl.maximum(minor, major / taps), 1.0))
    level = tl.minimum(level, levels - 1.0)
    low = level.to(tl.int32)
    mix = level - low.to(tl.float32)
    # Direction of the longer axis.
    along_u, along_v = tl.where(p < r, q, mean + half - r), tl.where(p < r, mean + half - p, q)
    length = tl.sqrt(along_u * along_u + along_v * along_v)
    stretch = tl.where(length > 0, major / tl.where(length > 0, length, 1.0), 1.0)
    along_u, along_v = along_u * stretch, along_v * stretch
    red, green, blue = u * 0, u * 0, u * 0
    most = tl.max(tl.where(asked, taps, 0.0), axis=0)
    tap = 0.0
    while tap < most:
        offset = (tap + 0.5) / taps - 0.5
        here_u, here_v = u + offset * along_u, v + offset * along_v
        for k in tl.static_range(2):
            share = tl.where(tap < taps, (mix if k else 1 - mix) / taps, 0.0)
            read = asked & (share > 0)
            number = tl.minimum(low + k, levels - 1)
            start = tl.load(starts + number, mask=read, other=0)
            h = tl.load(sizes + 2 * number, mask=read, other=1).to(tl.int32)
            w = tl.load(sizes + 2 * number + 1, mask=read, other=1).to(tl.int32)
            shrink = tl.exp2(-number.to(tl.float32))
            x = tl.where(read, (here_u + 0.5) * shrink - 0.5, 0.0)
            y = (here_v + 0.5) * shrink - 0.5
            y = tl.minimum(tl.maximum(y, 0.0), h.to(tl.float32) - 1.0)
            x_low, y_low = tl.floor(x), tl.floor(y)
            u0, v0 = x_low.to(tl.int32) % w, y_low.to(tl.int32)
            u0 = tl.where(u0 < 0, u0 + w, u0)  # the remainder has the sign of what is divided
            u1, v1 = tl.where(u0 + 1 >= w, 0, u0 + 1), tl.minimum(v0 + 1, h - 1)
            fu, fv = x - x_low, y - y_low
            red += share * _texel(texels, start, u0, v0, u1, v1, fu, fv, w, read, 0)
            green += share * _texel(texels, start, u0, v0, u1, v1, fu, fv, w, read, 1)
            blue += share * _texel(texels, start, u0, v0, u1, v1, fu, fv, w, read, 2)
        tap += 1.0
    tl.store(colour + 3 * at, tl.where(asked, red / 255, 0.0), mask=inside)
    tl.store(colour + 3 * at + 1, tl.where(asked, green / 255, 0.0), mask=inside)
    tl.store(colour + 3 * at + 2, tl.where(asked, blue / 255, 0.0), mask=inside)


KERNELS = WarpKernels(draw_patches, look_up)
