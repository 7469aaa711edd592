"""The paper's "Ours (-depth)": a radiance field trained on the panorama's colours alone.

Density and colour use the same hash grid and network as the virtual space and are composited along each ray (paper,
III.B). Without depth, nothing determines the position of a colour on its ray; the ablation shows the effect.
"""

from __future__ import annotations

import math
import time

import numpy as np
import torch
from numpy.typing import NDArray
from torch.nn import functional

from instant_ic.geometry.image_quality import psnr_of_mse
from instant_ic.vspace import View, VirtualSpaceConfig
from instant_ic.vspace.nerf import kernels
from instant_ic.vspace.nerf.field import (
    BETA1,
    BETA2,
    EPSILON,
    FieldParameters,
    Lattice,
    Schedule,
    adam_step_size,
    level_rates,
)
from instant_ic.vspace.prior import prepare
from instant_ic.vspace.view import check_size, checked_pose, perspective_rays

Floats = NDArray[np.float32]
NEAR_M, FAR_M = 0.2, 12.0
RAYS, SAMPLES = 512, 32
"""Rays per training step and samples per ray: as many field queries as a step of the virtual space."""
_DRAWN_SAMPLES = 64


class ColourOnlyField:
    """Colour-only field, trained by ``train`` and rendered by ``render``, on one CPU thread."""

    def __init__(
        self, rgb: NDArray[np.uint8], map_from_camera: NDArray[np.floating], config: VirtualSpaceConfig | None = None
    ) -> None:
        """Create the field for a panorama (H, 2 H, 3) uint8 and its pose (4, 4)."""
        config = config or VirtualSpaceConfig()
        # The sphere only sets the scale of the lattice; no surface position is derived from it.
        sphere = np.full((32, 64), FAR_M / 3, np.float32)
        prior = prepare(rgb, sphere, map_from_camera, 0.1, config.geometry, config.panorama_width)
        self._rgb, self._pose = prior.rgb, prior.map_from_camera
        lattice = Lattice.for_prior(prior, config.field)
        focus = np.array([[*self._pose[:3, 3], 2 * math.pi / prior.rgb.shape[1]]], np.float32)
        self._lattice = lattice.cells_per_m, lattice.origin, focus
        self._p = FieldParameters.random(config.field, config.train.seed)
        self._rng = np.random.default_rng(config.train.seed)
        self._schedule = Schedule(config.train)
        self._level_rates = level_rates(config.field.levels)
        self._grads = [np.zeros_like(a) for a in (self._p.table, *self._p.network())]
        self._moments = [(np.zeros_like(g), np.zeros_like(g)) for g in self._grads]
        self._touched = kernels.no_marks(self._p.table)

    @property
    def iterations(self) -> int:
        return self._schedule.iteration

    def train(self, cpu_seconds: float = math.inf, iterations: int | None = None) -> float:
        """Train until the CPU time is spent, the iterations are done or the schedule has ended.

        Returns:
            PSNR of the last step's rays, dB.
        """
        limit = self.iterations + (iterations if iterations is not None else self._schedule.config.iterations)
        start, error = time.process_time(), math.nan
        while not self._schedule.finished and self.iterations < limit:
            error = self._step()
            self._schedule.iteration += 1
            if time.process_time() - start >= cpu_seconds:
                break
        return psnr_of_mse(error)

    def _step(self) -> float:
        height, width = self._rgb.shape[:2]
        z, turn = self._rng.uniform(-1, 1, RAYS), self._rng.uniform(0, 1, RAYS)
        rows = np.minimum(((0.5 - np.arcsin(z) / math.pi) * height).astype(int), height - 1)
        columns = (turn * width).astype(int)
        azimuth, flat = math.pi * (1 - 2 * turn), np.sqrt(1 - z * z)
        directions = np.stack([flat * np.cos(azimuth), flat * np.sin(azimuth), z], axis=1) @ self._pose[:3, :3].T
        target = self._rgb[rows, columns].astype(np.float32) / 255 - np.float32(0.5)
        depth, step = _samples(RAYS, SAMPLES, self._rng.random((RAYS, SAMPLES)))
        points = (self._pose[:3, 3] + depth[..., None] * directions[:, None]).astype(np.float32).reshape(-1, 3)
        out = np.empty((len(points), 4), np.float32)
        kernels.query(self._p.table, *self._p.network(), *self._lattice, points, out)
        field = torch.from_numpy(out.reshape(RAYS, SAMPLES, 4)).requires_grad_()
        colour, _ = composite(field, torch.from_numpy(step))
        error = functional.mse_loss(colour, torch.from_numpy(target))
        (upstream,) = torch.autograd.grad(error, field)
        # The kernel minimises a weighted squared error; with this target its gradient equals the desired one. The
        # weight keeps target and output at the same magnitude, so that their difference keeps its precision.
        weight = np.float32(1 / RAYS)
        aim = out - (upstream.numpy() / (2 * weight)).reshape(-1, 4)
        same = np.full(len(points), weight, np.float32)
        table_grad, *network_grads = self._grads
        kernels.gradient(
            self._p.table, *self._p.network(), *self._lattice, points, aim, same, same,
            table_grad, self._touched, *network_grads,
        )  # fmt: skip
        self._adam()
        return float(error.detach())

    def _adam(self) -> None:
        table_lr, network_lr = self._schedule.rates()
        count = self.iterations + 1
        betas = np.float32(BETA1), np.float32(BETA2), np.float32(EPSILON)
        step_sizes = self._level_rates * np.float32(adam_step_size(table_lr, count))
        kernels.adam_touched(self._p.table, self._grads[0], self._touched, *self._moments[0], step_sizes, *betas)
        step_size = np.float32(adam_step_size(network_lr, count))
        for value, grad, (m, v) in zip(self._p.network(), self._grads[1:], self._moments[1:], strict=True):
            m += (1 - betas[0]) * (grad - m)
            v += (1 - betas[1]) * (grad * grad - v)
            value -= step_size * m / (np.sqrt(v) + betas[2])
            grad[...] = 0

    def render(self, map_from_camera: NDArray[np.floating], width: int, height: int, fov_rad: float) -> View:
        """Render a perspective image; depth is the mean along the ray, confidence its opacity."""
        check_size(width, height)
        rays = perspective_rays(checked_pose(map_from_camera), width, height, fov_rad)
        depth, step = _samples(1, _DRAWN_SAMPLES, np.full((1, _DRAWN_SAMPLES), 0.5))
        parts = []
        for directions in np.array_split(rays.directions, math.ceil(width * height / 8192)):
            points = (rays.origin + depth[..., None] * directions[:, None]).astype(np.float32).reshape(-1, 3)
            out = np.empty((len(points), 4), np.float32)
            kernels.query(self._p.table, *self._p.network(), *self._lattice, points, out)
            colour, weight = composite(torch.from_numpy(out.reshape(-1, _DRAWN_SAMPLES, 4)), torch.from_numpy(step))
            opacity = weight.sum(dim=1)
            mean_depth = (weight @ torch.from_numpy(depth[0])) / opacity.clamp(min=0.05)
            parts.append(torch.column_stack([colour + 0.5 * opacity[:, None], mean_depth, opacity]).numpy())
        image = np.concatenate(parts).reshape(height, width, 5)
        return View(np.rint(255 * np.clip(image[..., :3], 0, 1)).astype(np.uint8), image[..., 3], image[..., 4])


def _samples(rays: int, samples: int, place: NDArray[np.floating]) -> tuple[Floats, Floats]:
    """Sample depths and their interval lengths, (rays, samples) metres; strata of equal ratio, ``place`` in each."""
    edges = np.geomspace(NEAR_M, FAR_M, samples + 1)
    depth = edges[:-1] * (edges[1:] / edges[:-1]) ** place
    step = np.broadcast_to(np.diff(edges), (rays, samples)).copy()
    step[:, -1] = 1e3  # the rest of the ray belongs to the far wall
    return depth.astype(np.float32), step.astype(np.float32)


def composite(field: torch.Tensor, step: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
    """Composite samples along rays (paper, III.B); the density is a bounded exponential as in instant-ngp.

    Args:
        field: colours minus 0.5 and logarithm of the density in 1/m of the samples, (N, S, 4).
        step: lengths of the samples' intervals in metres, (N, S) or (1, S).

    Returns:
        Colours of the rays minus 0.5 times their opacity, (N, 3), and weights of the samples, (N, S).
    """
    left = torch.exp(-torch.cumsum(field[..., 3].clamp(-10, 6).exp() * step, dim=1))
    before = functional.pad(left[:, :-1], (1, 0), value=1.0)
    weight = before - left
    return (weight[..., None] * field[..., :3]).sum(dim=1), weight
