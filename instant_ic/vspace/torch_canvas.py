"""Composition of views by torch on a GPU: as ``canvas.CpuCanvas``, without leaving the device.

Two kernels do most of it, in plain torch (``torch_warp``) or in Triton (``triton_warp``). Nothing here waits for the
device before the finished image is fetched, but plain torch's kernels.
"""

from __future__ import annotations

import math
import weakref
from dataclasses import dataclass
from typing import Any

import numpy as np
import torch
import torch.nn.functional as nn
from numpy.typing import NDArray
from torch import Tensor

from instant_ic.vspace import torch_warp
from instant_ic.vspace.background import GUESS_REACH, GUESS_SHARE, Background
from instant_ic.vspace.canvas import Drawing, Painted, Picture
from instant_ic.vspace.compose import disagreement
from instant_ic.vspace.nerf.field import Floats, Rays
from instant_ic.vspace.nerf.reference import bilinear
from instant_ic.vspace.store import Keyframe, KeyframeSet
from instant_ic.vspace.torch_compose import TorchLayer, compose, panorama_places, points
from instant_ic.vspace.torch_warp import KERNELS, Mesh, Patches, TorchPyramid, WarpKernels
from instant_ic.vspace.view import LensRays
from instant_ic.vspace.warp import PanoramaWarp, pinhole


@dataclass(frozen=True)
class _Keyframe:
    """A keyframe on the device; ``depth_edge``, ``beside``, ``sure`` as in ``TorchLayer``; ``behind``: its
    background's mesh with its colours, where guesses are marked 1 and sky 2.
    """

    quads: Patches
    quarters: Patches
    pyramid: TorchPyramid
    depth_edge: Tensor
    beside: Tensor
    sure: Tensor
    behind: Patches | None
    behind_rgb: Tensor | None


@dataclass(frozen=True)
class _Eye:
    """A perspective view: ``directions`` (P, 3) unit vectors in its own frame, x forward, and ``half``: the tangent of
    half its horizontal field of view.
    """

    directions: Tensor
    map_from_view: NDArray[np.float64]
    half: float
    shape: tuple[int, int]

    @property
    def axial(self) -> Tensor:
        return self.directions[:, 0]


class TorchCanvas:
    """See ``canvas.Canvas``; its arrays are tensors. One thread at a time.

    A keyframe is uploaded when it is first rendered, and let go with its ``PanoramaWarp``.

    Args:
        device: torch's name of it.
        kernels: that do most of the work: ``torch_warp``'s or ``triton_warp``'s.
    """

    def __init__(self, device: str, kernels: WarpKernels = KERNELS) -> None:
        self._device = device
        self._kernels = kernels
        self._keyframes: weakref.WeakKeyDictionary[PanoramaWarp, _Keyframe] = weakref.WeakKeyDictionary()
        self._newest_lens: tuple[Floats, Tensor] | None = None
        self._confidence = torch.tensor([0.0, 0.5, 1.0, 0.0], device=device)  # of EMPTY, FILLED, KNOWN, BEHIND

    def draw(
        self,
        rays: Rays,
        shown: KeyframeSet | None,
        panorama_share: float,
        field: Drawing | None,
        layers: dict[int, Drawing],
    ) -> Picture:
        if shown is None:
            assert field is not None, "neither keyframes nor a field to render"
            colour, depth, confidence = (self._tensor(array) for array in field)
            return Picture(colour, depth, confidence, torch.zeros_like(depth, dtype=torch.bool))
        eye = self._eye(rays)
        if field is None:
            picture = self._warped(eye, shown, layers)
        else:
            colour, depth, confidence = (self._tensor(array) for array in field)
            picture = colour, depth, confidence
            if panorama_share > 0:
                picture = _dissolve(self._warped(eye, shown, layers), picture, panorama_share)
        colour, depth, confidence = picture
        guessed = torch.zeros_like(depth, dtype=torch.bool)
        for keyframe, gain in zip(shown.keyframes, shown.gains, strict=True):
            colour, depth, confidence, drawn = self._behind(keyframe, gain, eye, guessed, (colour, depth, confidence))
            guessed = guessed | drawn
        return Picture(colour, depth, confidence, guessed)

    def continued(self, picture: Picture, shape: tuple[int, int], wraps: bool) -> Tensor:
        drawn = picture.colour.reshape(*shape, 3)
        depth, confidence = picture.depth.reshape(shape), picture.confidence.reshape(shape)
        side = shape[1] // 4 if wraps else 0
        around = [torch.cat([a[:, a.shape[1] - side :], a, a[:, :side]], dim=1) for a in (drawn, depth, confidence)]
        image = _continue_unseen(*around)[:, side : side + shape[1]]
        return _mixed_in(image, drawn, picture.guessed.reshape(shape))

    def painted(self, picture: Picture, image: Tensor) -> Painted:
        rgb = (image.clamp(0, 1) * 255).round().to(torch.uint8)
        return rgb.cpu().numpy(), picture.depth.cpu().numpy(), picture.confidence.cpu().numpy()

    def _warped(self, eye: _Eye, shown: KeyframeSet, layers: dict[int, Drawing]) -> Drawing:
        """Compose the keyframes' panoramas, warped by their depth."""
        for keyframe in shown.keyframes:
            if id(keyframe.warp) not in layers:
                layers[id(keyframe.warp)] = self._warp(keyframe, eye)
        if len(shown.keyframes) == 1:
            return layers[id(shown.keyframes[0].warp)]
        drawn = [self._layer(one, gain, eye, layers) for one, gain in zip(shown.keyframes, shown.gains, strict=True)]
        room = [[disagreement(one, other) for other in shown.priors] for one in shown.priors]
        return compose(drawn, room, eye.directions)

    def _layer(self, keyframe: Keyframe, gain: Floats, eye: _Eye, layers: dict[int, Drawing]) -> TorchLayer:
        own, prior = self._uploaded(keyframe), keyframe.prior
        view_from_camera = self._view_from(prior.map_from_camera, eye)
        return TorchLayer(
            *(
                *layers[id(keyframe.warp)],
                self._tensor(gain),
                own.quads.mesh.inverse[1:-1],
                own.depth_edge,
                own.beside,
                own.sure,
            ),
            camera_from_view=self._camera_from(prior.map_from_camera, eye),
            camera=view_from_camera[:3, 3],
        )

    def _warp(self, keyframe: Keyframe, eye: _Eye) -> Drawing:
        """One keyframe's panorama; as ``PanoramaWarp.draw``."""
        own, pose = self._uploaded(keyframe), keyframe.prior.map_from_camera
        buffer = torch.zeros(eye.shape, dtype=torch.int32, device=self._device)
        for patches in (own.quads, own.quarters):
            self._kernels.draw_patches(patches, self._view_from(pose, eye), eye.half, buffer)
        depth, marks = _read(buffer, eye)
        confidence = self._confidence[marks.long()]
        wanted = torch.where(confidence.any(), confidence, depth)
        places = torch.stack(self._places(eye, pose, depth, own.pyramid.size), dim=1)
        places = torch.where(depth[:, None] > 0, places, torch.full_like(places, torch_warp.NOWHERE))
        colour = self._kernels.look_up(own.pyramid, places.reshape(*eye.shape, 2), wanted.reshape(eye.shape))
        return colour.reshape(-1, 3), depth, confidence

    def _behind(
        self, keyframe: Keyframe, gain: Floats, eye: _Eye, guessed: Tensor, picture: Drawing
    ) -> tuple[Tensor, Tensor, Tensor, Tensor]:
        """The image with a keyframe's background where nothing has been seen; as ``Background.draw``."""
        colour, depth, confidence = picture
        own, pose = self._uploaded(keyframe), keyframe.prior.map_from_camera
        if own.behind is None or own.behind_rgb is None:
            return colour, depth, confidence, torch.zeros_like(guessed)
        buffer = torch.zeros(eye.shape, dtype=torch.int32, device=self._device)
        self._kernels.draw_patches(own.behind, self._view_from(pose, eye), eye.half, buffer)
        away, marks = _read(buffer, eye)
        drawn = (confidence == 0) & ~guessed & (away > 0)
        height, width = own.behind_rgb.shape[:2]
        behind = bilinear(own.behind_rgb, *self._places(eye, pose, away, (height, width))) * (self._tensor(gain) / 255)
        colour = torch.where(drawn[:, None], behind, colour)
        depth = torch.where(drawn, away, depth)
        return colour, depth, torch.where(drawn & (marks == 2), 1.0, confidence), drawn

    def _view_from(self, map_from_camera: NDArray[np.float64], eye: _Eye) -> Tensor:
        return self._tensor((np.linalg.inv(eye.map_from_view) @ map_from_camera).astype(np.float32))

    def _camera_from(self, map_from_camera: NDArray[np.float64], eye: _Eye) -> Tensor:
        return self._tensor((np.linalg.inv(map_from_camera) @ eye.map_from_view).astype(np.float32))

    def _places(
        self, eye: _Eye, map_from_camera: NDArray[np.float64], depth: Tensor, size: tuple[int, int]
    ) -> tuple[Tensor, Tensor]:
        """Index coordinates (u, v) in a panorama (height, width) of places along the view's rays."""
        return panorama_places(points(self._camera_from(map_from_camera, eye), eye.directions, depth), size)

    def _eye(self, rays: Rays) -> _Eye:
        """A lens is uploaded once."""
        map_from_view, half = pinhole(rays)
        if not isinstance(rays, LensRays):
            turned = rays.directions @ map_from_view[:3, :3].astype(np.float32)
            return _Eye(self._tensor(turned), map_from_view, float(half), rays.shape)
        if self._newest_lens is None or self._newest_lens[0] is not rays.lens:
            self._newest_lens = rays.lens, self._tensor(rays.lens)
        return _Eye(self._newest_lens[1], map_from_view, float(half), rays.shape)

    def _uploaded(self, keyframe: Keyframe) -> _Keyframe:
        warp = keyframe.warp
        assert warp is not None, "warping needs numba"
        if warp not in self._keyframes:
            quads, quarters = _mesh_patches(
                self._tensor(warp.depth_edge), self._tensor(warp.known), self._mesh(warp.inverse)
            )
            pyramid = warp.pyramid
            behind = (None, None) if keyframe.background is None else self._background(keyframe.background)
            texels, start, sizes = (self._tensor(array) for array in (pyramid.texels, pyramid.start, pyramid.sizes))
            self._keyframes[warp] = _Keyframe(
                quads,
                quarters,
                TorchPyramid(texels, start, sizes, (int(pyramid.sizes[0, 0]), int(pyramid.sizes[0, 1]))),
                self._tensor(keyframe.prior.depth_edge != 0),
                self._tensor(keyframe.prior.beside_edge != 0),
                self._tensor(keyframe.prior.known == 1),
                *behind,
            )
        return self._keyframes[warp]

    def _background(self, background: Background) -> tuple[Patches, Tensor]:
        inverse = np.concatenate([background.inverse[:1], background.inverse, background.inverse[-1:]])
        width = inverse.shape[1]
        places = np.concatenate([background.guessed, background.sky])
        marks = np.repeat(np.array([1, 2], np.uint8), (len(background.guessed), len(background.sky)))
        items = ((places[:, 0] + 1) * width + places[:, 1]).astype(np.int32)
        patches = Patches(self._tensor(items), self._tensor(marks), self._mesh(inverse), False)
        return patches, self._tensor(background.rgb).float()

    def _mesh(self, inverse: Floats) -> Mesh:
        height, width = inverse.shape[0] - 2, inverse.shape[1]
        azimuth = math.pi - (np.arange(2 * width) + 1) * (math.pi / width)
        elevation = math.pi / 2 - (np.arange(-2, 2 * height + 1) + 1) * (math.pi / (2 * height))
        elevation = np.clip(elevation, -math.pi / 2, math.pi / 2)
        columns, rows = (
            np.stack([np.cos(angle), np.sin(angle)], axis=1).astype(np.float32) for angle in (azimuth, elevation)
        )
        return Mesh(self._tensor(inverse), self._tensor(rows), self._tensor(columns))

    def _tensor(self, array: NDArray[Any] | Tensor) -> Tensor:
        if isinstance(array, Tensor):
            return array.to(self._device)
        return torch.from_numpy(np.ascontiguousarray(array)).to(self._device)


def _mesh_patches(depth_edge: Tensor, known: Tensor, mesh: Mesh) -> tuple[Patches, Patches]:
    """A mesh's whole quads, and the quarters of those with a depth edge.

    Args:
        depth_edge, known: with a row more above and below, (h + 2, w), as ``warp_kernels.draw_mesh`` takes them.
    """
    right = known.roll(-1, 1)
    corners = torch.stack([known[:-1], right[:-1], known[1:], right[1:]], dim=-1).reshape(-1, 4)
    whole = depth_edge[:-1].reshape(-1) == 0
    quads, quarters = torch.nonzero(whole)[:, 0], torch.nonzero(~whole)[:, 0]
    items = (4 * quarters[:, None] + torch.arange(4, device=depth_edge.device)).reshape(-1)
    own = corners[quarters].reshape(-1)
    there = own < 2
    return (
        Patches(quads.int(), _marks((corners[quads] > 0).all(dim=1)), mesh, False),
        Patches(items[there].int(), _marks(own[there] > 0), mesh, True),
    )


def _marks(seen: Tensor) -> Tensor:
    return torch.where(seen, torch_warp.KNOWN, torch_warp.FILLED).to(torch.uint8)


def _read(buffer: Tensor, eye: _Eye) -> tuple[Tensor, Tensor]:
    """Depth along the rays (P,), 0 where nothing is, and marks (P,) of a buffer that was rendered into."""
    marks = buffer.reshape(-1) & torch_warp.MARKS
    nearness = (buffer.reshape(-1) & ~torch_warp.MARKS).view(torch.float32)
    return torch.where(nearness > 0, 1 / (eye.axial * nearness), 0.0), marks


def _dissolve(warped: Drawing, field: Drawing, share: float) -> Drawing:
    """As ``warp.dissolve``."""
    first, second = share * (warped[2] > 0), (1 - share) * (field[2] > 0)
    total = (first + second).clamp(min=1e-9)
    colour = warped[0] * (first / total)[:, None] + field[0] * (second / total)[:, None]
    more = first >= second
    return colour, torch.where(more, warped[1], field[1]), torch.where(more, warped[2], field[2])


def _continue_unseen(image: Tensor, depth: Tensor, confidence: Tensor) -> Tensor:
    """As ``view.continue_unseen`` of a flat image (H, W, 3): means down a pyramid, and up into the holes."""
    seen = confidence > 0
    weight = torch.where(seen, depth * depth, 0.0)
    level = torch.cat([image * weight[..., None], weight[..., None]], dim=2).permute(2, 0, 1)[None]
    levels = [level]
    while min(level.shape[2:]) > 1:
        height, width = level.shape[2:]
        level = 4 * nn.avg_pool2d(nn.pad(level, (0, width % 2, 0, height % 2)), 2)
        levels.append(level)
    for finer in reversed(levels[:-1]):
        height, width = finer.shape[2:]
        level = nn.interpolate(level, scale_factor=2, mode="bilinear", align_corners=False)[..., :height, :width]
        level = torch.where(finer[:, 3:] > 0, finer, 0.25 * level)
    sums = level[0].permute(1, 2, 0)
    filled = sums[..., :3] / sums[..., 3:].clamp(min=1e-30)
    # Where nothing is known there is nothing to continue.
    return torch.where((weight > 0)[..., None] | ~seen.any(), image, filled)


def _mixed_in(image: Tensor, guess: Tensor, guessed: Tensor) -> Tensor:
    """As ``background.mixed_in``: the more, the farther off (in city blocks) what is seen."""
    reach = max(1, round(GUESS_REACH * guessed.shape[1]))
    inside = torch.where(guessed, float(reach), 0.0)
    for axis in (0, 1):
        step = 1
        while step <= reach:  # steps of 1, 2, 4... together make every distance
            length = inside.shape[axis]
            if step < length:
                away = inside + step
                before, after = away.narrow(axis, 0, length - step), away.narrow(axis, step, length - step)
                kept = inside.clone()
                kept.narrow(axis, step, length - step).clamp_(max=before)
                kept.narrow(axis, 0, length - step).clamp_(max=after)
                inside = kept
            step *= 2
    weight = GUESS_SHARE * (inside / reach).clamp(max=1)
    return image + torch.where(guessed, weight, 0.0)[..., None] * (guess - image)
