"""Training and rendering by plain torch: what numba and Triton are compared with."""

from __future__ import annotations

from typing import Any

import numpy as np
import torch
from torch import Tensor

from instant_ic.vspace.config import FieldConfig, TrainConfig
from instant_ic.vspace.nerf import reference
from instant_ic.vspace.nerf.field import (
    VOLUME_WEIGHTS,
    FieldParameters,
    Floats,
    Rays,
    TrainingScene,
    depth_trust,
    level_rates,
    ray_sources,
    sample_weights,
    volume_rays,
)
from instant_ic.vspace.nerf.reference import TorchField, TorchGrid, TorchPrior, TrainState
from instant_ic.vspace.view import LensRays
from tests.vspace import volume_reference

RAYS_AT_ONCE = 1 << 18


def torch_priors(scene: TrainingScene, device: str) -> list[TorchPrior]:
    """Return a scene's keyframes as tensors, newest first."""

    def tensor(array: Any, kind: torch.dtype = torch.float32) -> Tensor:
        return torch.from_numpy(np.ascontiguousarray(array)).to(device=device, dtype=kind)

    return [
        TorchPrior(
            rgb=tensor(prior.rgb),
            inverse_depth=tensor(prior.inverse_depth),
            known=tensor(prior.known, torch.bool),
            depth_edge=tensor(prior.depth_edge, torch.bool),
            usable=tensor(prior.usable, torch.bool),
            trust=tensor(depth_trust(prior)),
            map_from_camera=tensor(prior.map_from_camera),
            camera_from_map=tensor(np.linalg.inv(prior.map_from_camera)),
            band=prior.band,
            gain=tensor(gain),
        )
        for prior, gain in zip(scene.priors, scene.exposure, strict=True)
    ]


class TorchDevice:
    """See ``field.Device``."""

    def __init__(self, field: FieldConfig, train: TrainConfig, device: str) -> None:
        self._train = train
        self._density = field.geometry == "density"
        self._device = device
        self.name = torch.cuda.get_device_name() if device == "cuda" else f"{device} (torch)"
        weights = (torch.from_numpy(w).to(device) for w in sample_weights(train))
        self._colour_weight, self._distance_weight = weights
        self._level_rates = torch.from_numpy(level_rates(field.levels)).to(device)[:, None, None]
        self._newest_lens: tuple[Floats, Tensor] | None = None
        self.on_gpu = device == "cuda"
        self.load(FieldParameters.random(field, train.seed))

    def load(self, parameters: FieldParameters) -> None:
        arrays = (parameters.table, *parameters.network())
        tensors = [torch.from_numpy(a.copy()).to(self._device).requires_grad_() for a in arrays]
        levels = parameters.table.shape[0]
        lattice = [torch.zeros(n, device=self._device) for n in ((levels,), (3,), (1, 4))]  # until a scene comes
        self._field = TorchField(*tensors, *lattice)
        self._state = self._fresh_state()

    def set_scene(self, scene: TrainingScene, parameters: FieldParameters | None = None) -> None:
        if parameters is not None:
            self.load(parameters)
        grid, lattice = scene.occupancy, scene.lattice
        arrays = (grid.distance, grid.origin, lattice.cells_per_m, lattice.origin, scene.focus)
        # All that needs memory comes first: where there is none, the old scene stays whole.
        priors = torch_priors(scene, self._device)
        distance, corner, cells_per_m, origin, focus = (torch.from_numpy(a).to(self._device) for a in arrays)
        state = self._fresh_state()
        self._priors, self._grid, self._state = priors, TorchGrid(distance, corner, grid.cell_m), state
        self._field.cells_per_m, self._field.origin, self._field.focus = cells_per_m, origin, focus

    def _fresh_state(self) -> TrainState:
        moments = [(torch.zeros_like(p), torch.zeros_like(p)) for p in self._field.parameters()]
        return TrainState(moments, self._level_rates)

    def step(self, uniform: Floats, table_lr: float, network_lr: float) -> tuple[float, float]:
        """One training step; ``reference.train_step`` holds it whole."""
        batch, rates = torch.from_numpy(uniform).to(self._device), (table_lr, network_lr)
        if self._density:
            return self._density_step(batch, rates)
        weights = self._colour_weight, self._distance_weight
        return reference.train_step(self._field, self._priors, self._state, self._train, batch, rates, weights)

    def _density_step(self, uniform: Tensor, rates: tuple[float, float]) -> tuple[float, float]:
        self._state.steps += 1
        columns, rows = volume_rays(self._train)
        numbers = ray_sources(len(self._priors), columns * rows // 64, self._state.steps)
        sources = torch.from_numpy(numbers).to(self._device)
        points, target, weight = reference.sample_rays(uniform[: columns * rows], columns, rows, self._priors, sources)
        surface, colours, weight = (a.view(-1, 2, 64, a.shape[1])[:, 0].flatten(0, 1) for a in (points, target, weight))
        number = sources.long().repeat_interleave(64)
        cameras = torch.stack([prior.map_from_camera[:3, 3] for prior in self._priors])[number]
        band = torch.tensor([prior.band for prior in self._priors], device=self._device)[number]
        jitter = uniform[: columns * rows, 2]
        samples, offset, span = volume_reference.band_samples(cameras, surface, jitter, band, self._priors[0])
        output = reference.query(self._field, samples.reshape(-1, 3)).reshape(*offset.shape, 4)
        losses = volume_reference.volume_loss(output, offset, span, colours[:, :3], weight)
        weighted = (w * loss for w, loss in zip((1.0, *VOLUME_WEIGHTS), losses, strict=True))
        error = sum(weighted, torch.zeros((), device=self._device))
        reference.adam_step(self._field, self._state, torch.autograd.grad(error, self._field.parameters()), rates)
        share = weight.mean(dim=0).clamp(min=1e-3)
        return float((losses[0] / share[0]).detach()), float((losses[1] / share[1]).detach())

    @torch.no_grad()
    def render_rays(self, rays: Rays, panorama_share: float, depth_share: float) -> tuple[Floats, Floats, Floats]:
        origin, directions = torch.from_numpy(rays.origin).to(self._device), self._directions(rays)
        render = self._render_density if self._density else self._render_distance
        parts = [render(origin, part, panorama_share, depth_share) for part in directions.split(RAYS_AT_ONCE)]
        colour, depth, confidence = (torch.cat(tensors).cpu().numpy() for tensors in zip(*parts, strict=True))
        return colour, depth, confidence

    def _directions(self, rays: Rays) -> Tensor:
        """Return the directions of a view in the map, (P, 3); a lens is uploaded once, and turned on the device."""
        if not isinstance(rays, LensRays):
            return torch.from_numpy(rays.directions).to(self._device)
        if self._newest_lens is None or self._newest_lens[0] is not rays.lens:
            self._newest_lens = rays.lens, torch.from_numpy(rays.lens).to(self._device)
        return self._newest_lens[1] @ torch.from_numpy(rays.turn).to(self._device).T

    def _render_distance(
        self, origin: Tensor, directions: Tensor, panorama_share: float, depth_share: float
    ) -> tuple[Tensor, Tensor, Tensor]:
        depth, confidence = reference.trace(self._field, self._grid, self._priors, depth_share, origin, directions)
        met = torch.nonzero(depth)[:, 0]
        colour = torch.zeros_like(directions)
        points = origin + depth[met, None] * directions[met]
        colour[met] = (reference.query(self._field, points)[:, :3] + 0.5).clamp(0, 1)
        reference.mix_panorama(self._priors, origin, directions, depth, confidence, panorama_share, colour)
        return colour, depth, confidence

    def _render_density(
        self, origin: Tensor, directions: Tensor, panorama_share: float, depth_share: float
    ) -> tuple[Tensor, Tensor, Tensor]:
        guide, confidence = reference.trace(self._field, self._grid, self._priors, 1.0, origin, directions)
        colour, depth = volume_reference.composite(self._field, self._priors[0], depth_share, origin, directions, guide)
        reference.mix_panorama(self._priors, origin, directions, guide, confidence, panorama_share, colour)
        return colour, depth, confidence

    def parameters(self) -> FieldParameters:
        return FieldParameters(*(p.detach().cpu().numpy().copy() for p in self._field.parameters()))
