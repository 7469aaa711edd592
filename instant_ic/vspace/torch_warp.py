"""The warp's two kernels in plain torch: patches of a panorama's mesh into a depth buffer, and its colours averaged.

What the tests hold the Triton kernels against, and what runs on CUDA without Triton. The same as ``warp_kernels``.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import torch
from torch import Tensor

from instant_ic.vspace.warp import BLUR

NEAR_M = 0.02
EMPTY, FILLED, KNOWN, BEHIND = 0, 1, 2, 3
MARKS = 3
"""Bits of a depth buffer's entry that say what it is of; the others are those of the nearness as float32."""
MAX_TAPS = 8
NOWHERE = -1e9
"""Place of a pixel that shows nothing."""
FRAGMENTS = 1 << 20
"""Pixels under boxes round triangles that are worked on at once: bounds the memory."""


@dataclass(frozen=True)
class Mesh:
    """A panorama's directions and inverse depth, with a row more above and below for the poles.

    Attributes:
        inverse: (h + 2, w).
        rows: cosine and sine of the elevation at every half pixel, (2 h + 3, 2); row 2 v is pixel row v's.
        columns: the same of the azimuth, (2 w, 2).
    """

    inverse: Tensor
    rows: Tensor
    columns: Tensor


@dataclass(frozen=True)
class Patches:
    """Some quads of a mesh, or quarters of quads that cross a depth edge.

    Attributes:
        items: v · w + u of a quad's upper left pixel (v, u), int32 (N,); of a quarter four times that, plus its number.
            A quarter lies between its own pixel's direction and the quad's middle, all at that pixel's depth.
        marks: what a buffer's pixels get, 1 to 3, (N,) uint8; 3 from the back.
    """

    items: Tensor
    marks: Tensor
    mesh: Mesh
    quarters: bool


@dataclass(frozen=True)
class TorchPyramid:
    """A ``warp.Pyramid``: ``texels`` (N, 3) uint8, ``start`` (levels,) and ``sizes`` (levels, 2) int64 on the device;
    ``size``: height and width of the first level.
    """

    texels: Tensor
    start: Tensor
    sizes: Tensor
    size: tuple[int, int]


@dataclass(frozen=True)
class WarpKernels:
    """The functions that ``torch_canvas`` renders with; see this module's own."""

    draw_patches: Callable[[Patches, Tensor, float, Tensor], None]
    look_up: Callable[[TorchPyramid, Tensor, Tensor], Tensor]


def draw_patches(patches: Patches, view_from_camera: Tensor, half: float, buffer: Tensor) -> None:
    """Renders patches into a depth buffer.

    Args:
        patches: in the camera's frame.
        view_from_camera: (4, 4) float32; the view looks along x.
        half: tangent of half the horizontal field of view.
        buffer: in and out, (H, W) int32: bits of the inverse depth along the view's axis (float32, the last two bits
            left out) and the mark; the nearest counts. 0 where nothing is.
    """
    height, width = buffer.shape
    corners = _corners(patches)
    # Not by matmul: a GPU may multiply with fewer bits.
    corners = (corners[:, :, None] * view_from_camera[:3, :3]).sum(dim=3) + view_from_camera[:3, 3]
    x, y, z = corners.unbind(2)
    tall = half * height / width
    beyond = torch.stack([x < NEAR_M, y > half * x, y < -half * x, z > tall * x, z < -tall * x])
    visible = torch.nonzero(~beyond.all(dim=2).any(dim=0))[:, 0]
    triangles = torch.tensor([[0, 1, 2], [1, 3, 2]], device=buffer.device)
    corners = corners[visible][:, triangles].flatten(0, 1)  # (T, 3 corners, 3)
    marks = patches.marks[visible].repeat_interleave(2).int()
    a, b, c = corners.unbind(1)
    edges = torch.stack([torch.linalg.cross(b, c), torch.linalg.cross(c, a), torch.linalg.cross(a, b)], dim=1)
    volume = (a * edges[:, 0]).sum(dim=1)
    edges = edges / volume[:, None, None]
    marks = torch.where(volume < 0, BEHIND, marks)
    pixel = 2 * half / width
    left, top = half - 0.5 * pixel, (0.5 * height - 0.5) * pixel
    ahead = corners[:, :, 0].clamp(min=NEAR_M)
    box = torch.stack([(left - corners[:, :, 1] / ahead) / pixel, (top - corners[:, :, 2] / ahead) / pixel])
    last = torch.tensor([width - 1, height - 1], device=buffer.device)[:, None]
    first = (box.amin(dim=2) - 1e-3).ceil().clamp(min=0)
    end = torch.minimum((box.amax(dim=2) + 1e-3).floor(), last)
    clipped = (corners[:, :, 0] < NEAR_M).any(dim=1)  # has no place in the image to bound by: anywhere
    first = torch.where(clipped, 0, first).long()
    columns, rows = (torch.where(clipped, last, end).long() - first + 1).clamp(min=0)
    counts = torch.where(volume != 0, columns * rows, 0)
    ends = counts.cumsum(0)
    total, done = int(ends[-1]) if len(ends) else 0, 0
    while done < total:
        fragment = torch.arange(done, min(done + FRAGMENTS, total), device=buffer.device)
        triangle = torch.searchsorted(ends, fragment, right=True)
        inside = fragment - (ends - counts)[triangle]
        row, column = first[1][triangle] + inside // columns[triangle], first[0][triangle] + inside % columns[triangle]
        n = edges[triangle]
        weights = n[:, :, 0] + n[:, :, 1] * (left - column * pixel)[:, None] + n[:, :, 2] * (top - row * pixel)[:, None]
        near = weights.sum(dim=1)
        covered = (weights >= -1e-4 * near[:, None]).all(dim=1) & (near > 0) & (near < 1 / NEAR_M)
        value = (near.view(torch.int32) & ~MARKS) | marks[triangle]
        at = (row * width + column)[covered]
        buffer.view(-1).scatter_reduce_(0, at, value[covered], "amax")
        done += FRAGMENTS


def _corners(patches: Patches) -> Tensor:
    """Corners of patches in the camera's frame: upper left and right, lower left and right, (N, 4, 3)."""
    mesh, items = patches.mesh, patches.items.long()
    width = mesh.inverse.shape[1]
    quarter = items % 4 if patches.quarters else torch.zeros_like(items)
    quad = items // 4 if patches.quarters else items
    down, right = torch.tensor([[0, 0, 1, 1], [0, 1, 0, 1]], device=items.device)
    row, column = 2 * (quad // width), 2 * (quad % width)
    if patches.quarters:
        row, column = row + quarter // 2, column + quarter % 2
        own = mesh.inverse[(row + quarter // 2) // 2, ((column + quarter % 2) // 2) % width]
        rows, columns = row[:, None] + down, (column[:, None] + right) % (2 * width)
        depth = (1 / own)[:, None]
    else:
        rows, columns = row[:, None] + 2 * down, (column[:, None] + 2 * right) % (2 * width)
        depth = 1 / mesh.inverse[rows // 2, columns // 2]
    elevation, azimuth = mesh.rows[rows], mesh.columns[columns]
    directions = torch.cat([elevation[..., :1] * azimuth, elevation[..., 1:]], dim=2)
    return directions * depth[..., None]


def look_up(pyramid: TorchPyramid, places: Tensor, wanted: Tensor) -> Tensor:
    """Panorama colours under the pixels of a view, averaged over each pixel's footprint; as ``warp_kernels.look_up``.

    Args:
        pyramid: of the panorama.
        places: index coordinates (u, v) in it, (H, W, 2); ``NOWHERE`` where a pixel shows nothing.
        wanted: over 0 where a colour is asked for, (H, W).

    Returns:
        Colours in 0..1, (H, W, 3); 0 where none is asked for.
    """
    width = float(pyramid.size[1])
    ux, vx = _shorter_step(places, 1, width)
    uy, vy = _shorter_step(places, 0, width)
    # Half axes of the ellipse that a pixel covers: eigenvalues of J Jᵀ.
    p, q, r = ux * ux + uy * uy, ux * vx + uy * vy, vx * vx + vy * vy
    mean, half = 0.5 * (p + r), (0.25 * (p - r) ** 2 + q * q).sqrt()
    major, minor = BLUR * (mean + half).sqrt(), BLUR * (mean - half).clamp(min=0).sqrt()
    taps = (major / minor.clamp(min=1) - 0.25).ceil().clamp(1, MAX_TAPS)
    top = len(pyramid.start) - 1
    level = torch.maximum(minor, major / taps).clamp(min=1).log2().clamp(max=top)
    low = level.floor().long()
    mix = level - low
    # Direction of the longer axis.
    along = torch.where(
        (p < r)[..., None], torch.stack([q, mean + half - p], -1), torch.stack([mean + half - r, q], -1)
    )
    length = along.norm(dim=2, keepdim=True)
    along = torch.where(length > 0, along / length * major[..., None], along)
    total = torch.zeros(*wanted.shape, 3, device=places.device)
    for tap in range(MAX_TAPS):
        here = places + ((tap + 0.5) / taps - 0.5)[..., None] * along
        for k in range(2):
            weight = torch.where(tap < taps, (mix if k else 1 - mix) / taps, 0.0)
            total += weight[..., None] * _level_colour(pyramid, (low + k).clamp(max=top), here)
    return torch.where((wanted > 0)[..., None] & (places[..., :1] > 0.1 * NOWHERE), total / 255, 0.0)


def _shorter_step(places: Tensor, axis: int, width: float) -> tuple[Tensor, Tensor]:
    """Change of place over one pixel of the view; over a depth edge the side that jumps is left out."""
    step = places.diff(dim=axis)
    seen = places[..., :1] > 0.1 * NOWHERE
    count = seen.shape[axis] - 1
    both = seen.narrow(axis, 0, count) & seen.narrow(axis, 1, count)
    du = torch.where(step[..., :1] > 0.5 * width, step[..., :1] - width, step[..., :1])
    du = torch.where(du < -0.5 * width, du + width, du)
    step = torch.where(both, torch.cat([du, step[..., 1:]], dim=-1), -NOWHERE)
    none = torch.full_like(places.narrow(axis, 0, 1), -NOWHERE)
    after, before = torch.cat([step, none], dim=axis), torch.cat([none, step], dim=axis)
    lengths = (after * after).sum(dim=-1, keepdim=True), (before * before).sum(dim=-1, keepdim=True)
    chosen = torch.where(lengths[0] <= lengths[1], after, before)
    alone = torch.tensor([1.0, 0.0] if axis == 1 else [0.0, 1.0], device=places.device)
    return tuple(torch.where(chosen[..., :1] >= -NOWHERE, alone, chosen).unbind(-1))  # type: ignore[return-value]


def _level_colour(pyramid: TorchPyramid, level: Tensor, places: Tensor) -> Tensor:
    """Bilinear colours (…, 3), 0..255, of a level (…) at index coordinates of the first level (…, 2)."""
    height, width = pyramid.sizes[level].unbind(-1)
    start = pyramid.start[level]
    u, v = ((places + 0.5) / torch.exp2(level.float())[..., None] - 0.5).unbind(-1)
    v = torch.minimum(v.clamp(min=0), height - 1)
    u0, v0 = u.floor(), v.floor()
    fu, fv = (u - u0)[..., None], (v - v0)[..., None]
    left, upper = u0.long() % width, v0.long()
    right, lower = (left + 1) % width, torch.minimum(upper + 1, height - 1)
    a, b = (pyramid.texels[start + upper * width + column].float() for column in (left, right))
    c, d = (pyramid.texels[start + lower * width + column].float() for column in (left, right))
    return (a * (1 - fu) + b * fu) * (1 - fv) + (c * (1 - fu) + d * fu) * fv


KERNELS = WarpKernels(draw_patches, look_up)
