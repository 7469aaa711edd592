"""Training and rendering on one CPU thread with the numba kernels."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from instant_ic.vspace.config import FieldConfig, TrainConfig
from instant_ic.vspace.nerf import kernels, march, volume
from instant_ic.vspace.nerf.field import (
    BAND_COLOUR_WEIGHT,
    BETA1,
    BETA2,
    DISTANCE_WEIGHT,
    EPSILON,
    VOLUME_WEIGHTS,
    FieldParameters,
    Floats,
    Rays,
    StackedPriors,
    TrainingScene,
    adam_step_size,
    level_rates,
    ray_sources,
    sample_weights,
    volume_rays,
)

FIRST_STRIDE = 4
"""Distance in pixels between the rays that are always traced, a power of two; ``Rays.stride`` may lower it.

Pixels between them are interpolated where their neighbours' depths agree; 1 traces all pixels.
"""
DEPTH_TOLERANCE = 0.08
"""Largest relative difference of neighbouring depths between which a pixel is interpolated."""


class NumbaDevice:
    """Backend on the CPU (see ``field.Device``); not thread-safe."""

    name = "cpu (numba)"
    on_gpu = False

    def __init__(self, field: FieldConfig, train: TrainConfig) -> None:
        self.first_stride = FIRST_STRIDE
        self._train = train
        self._density = field.geometry == "density"
        self._rays = train.ray_columns * train.ray_rows
        self._points = np.zeros((2 * self._rays, 3), np.float32)
        self._target = np.zeros((2 * self._rays, 4), np.float32)
        self._weight = np.zeros((2 * self._rays, 2), np.float32)
        self._colour_weight, self._distance_weight = sample_weights(train)
        self._level_rates = level_rates(field.levels)
        self.load(FieldParameters.random(field, train.seed))

    def load(self, parameters: FieldParameters) -> None:
        self._p = parameters
        table = parameters.table
        self._table_grad = np.zeros_like(table)
        self._touched = kernels.no_marks(table)
        self._table_moments = (np.zeros_like(table), np.zeros_like(table))
        self._network_grads = tuple(np.zeros_like(a) for a in parameters.network())
        self._network_moments = tuple((np.zeros_like(a), np.zeros_like(a)) for a in parameters.network())
        self._steps = 0

    def set_scene(self, scene: TrainingScene, parameters: FieldParameters | None = None) -> None:
        self.load(self._p if parameters is None else parameters)
        self._scene, self._focus, self._priors = scene, scene.focus, StackedPriors.of(scene)

    def step(self, uniform: Floats, table_lr: float, network_lr: float) -> tuple[float, float]:
        """Train one step like ``reference.train_step``: sample rays, add gradients, update by Adam."""
        self._steps += 1
        weight, sources = self._sample_rays(uniform)
        colour, distance = self._gradient(uniform, weight, sources)
        self._adam(table_lr, network_lr)
        share = np.maximum(weight.mean(axis=0), np.float32(1e-3)).tolist()  # mean weight, for errors per counted sample
        return colour / share[0], distance / share[1]

    def _sample_rays(self, uniform: Floats) -> tuple[Floats, NDArray[np.int32]]:
        """Fill the batch's points and targets; return weights (2 N, 2) and the keyframe of each tile."""
        priors = self._priors
        columns, rows = volume_rays(self._train) if self._density else (self._train.ray_columns, self._train.ray_rows)
        weight = self._weight[: 2 * columns * rows]
        sources = ray_sources(len(priors.band), columns * rows // 64, self._steps)
        march.sample_rays(
            uniform, columns, rows, sources,
            priors.rgb, priors.inverse_depth, priors.depth_edge, priors.usable, priors.trust,
            priors.map_from_camera, priors.gains, priors.band, self._points, self._target, weight,
        )  # fmt: skip
        return weight, sources

    def _gradient(self, uniform: Floats, weight: Floats, sources: NDArray[np.int32]) -> tuple[float, float]:
        """Add the batch's gradient to the stored gradients; return colour and distance error."""
        p, place = self._p, self._place
        grads = self._table_grad, self._touched, *self._network_grads
        if self._density:
            colour, distance = volume.volume_gradient(
                p.table, *p.network(), *place, self._points, self._target, weight,
                uniform[: len(weight) // 2, 2].copy(), sources, self._focus[:, :3].copy(), self._priors.band,
                np.array(VOLUME_WEIGHTS, np.float32), *grads,
            )  # fmt: skip
            return colour, distance
        colour, distance = kernels.gradient(
            p.table, *p.network(), *place, self._points, self._target,
            self._colour_weight * weight[:, 0], self._distance_weight * weight[:, 1], *grads,
        )  # fmt: skip
        return colour / (1 + BAND_COLOUR_WEIGHT), distance / DISTANCE_WEIGHT

    def _adam(self, table_lr: float, network_lr: float) -> None:
        """Update table and network by one Adam step; clear the gradients."""
        p = self._p
        betas = np.float32(BETA1), np.float32(BETA2), np.float32(EPSILON)
        step_sizes = self._level_rates * np.float32(adam_step_size(table_lr, self._steps))
        kernels.adam_touched(p.table, self._table_grad, self._touched, *self._table_moments, step_sizes, *betas)
        step_size = np.float32(adam_step_size(network_lr, self._steps))
        for value, grad, (m, v) in zip(p.network(), self._network_grads, self._network_moments, strict=True):
            m += (1 - betas[0]) * (grad - m)
            v += (1 - betas[1]) * (grad * grad - v)
            value -= step_size * m / (np.sqrt(v) + betas[2])
            grad[...] = 0

    def render_rays(self, rays: Rays, panorama_share: float, depth_share: float) -> tuple[Floats, Floats, Floats]:
        # Density geometry is composited around the keyframes' depth, so that the march needs no field.
        axial_depth, confidence = self._trace(rays, 1.0 if self._density else depth_share)
        depth = axial_depth / rays.axial
        guide, colour = depth, np.zeros((len(depth), 3), np.float32)
        if panorama_share < 1 and self._density:
            p, depth = self._p, guide.copy()
            volume.composite(
                p.table, *p.network(), *self._place, self._priors.band[0], np.float32(depth_share),
                rays.origin, rays.directions, depth, colour,
            )  # fmt: skip
        elif panorama_share < 1:
            met = np.flatnonzero(depth)
            out = np.empty((met.size, 4), np.float32)
            points = rays.origin + depth[met, None] * rays.directions[met]
            kernels.query(self._p.table, *self._p.network(), *self._place, points, out)
            colour[met] = np.clip(out[:, :3] + np.float32(0.5), 0, 1)
        if panorama_share > 0:
            priors = self._priors
            march.mix_panorama(
                priors.rgb, priors.inverse_depth, priors.depth_edge, priors.known, priors.camera_from_map, priors.gains,
                priors.band, rays.origin, rays.directions, guide, confidence, np.float32(panorama_share), colour,
            )  # fmt: skip
        return colour, depth, confidence

    @property
    def _place(self) -> tuple[Floats, Floats, Floats]:
        """Cells and origin of the lattice, and ``focus`` of the scene, as arguments of the kernels."""
        return self._scene.lattice.cells_per_m, self._scene.lattice.origin, self._focus

    def _trace(self, rays: Rays, depth_share: float) -> tuple[Floats, Floats]:
        """Return depth along the view's axis and confidence.

        Every ``first_stride``-th pixel is traced first, then those that cannot be interpolated.
        """
        height, width = rays.shape
        depth = np.zeros(height * width, np.float32)
        confidence = np.zeros(height * width, np.float32)
        index = np.arange(height * width, dtype=np.int32).reshape(height, width)
        stride = min(self.first_stride, rays.stride)
        self._march(rays, depth_share, index[::stride, ::stride].reshape(-1).copy(), depth, confidence)
        listed = np.empty(height * width, np.int32)
        stride //= 2
        while stride >= 1:
            images = depth.reshape(height, width), confidence.reshape(height, width)
            count = march.interpolate_depth(*images, stride, np.float32(DEPTH_TOLERANCE), listed)
            self._march(rays, depth_share, listed[:count], depth, confidence)
            stride //= 2
        return depth, confidence

    def _march(self, rays: Rays, depth_share: float, pixels: np.ndarray, depth: Floats, confidence: Floats) -> None:
        p, priors, grid = self._p, self._priors, self._scene.occupancy
        march.trace(
            p.table, *p.network(), *self._place, grid.distance, grid.origin, np.float32(grid.cell_m),
            priors.inverse_depth, priors.depth_edge, priors.known, priors.camera_from_map, priors.band,
            np.float32(depth_share), rays.origin, rays.directions, pixels, depth, confidence,
        )  # fmt: skip
        depth[pixels] *= rays.axial[pixels]

    def parameters(self) -> FieldParameters:
        p = self._p
        return FieldParameters(p.table.copy(), *(a.copy() for a in p.network()))
