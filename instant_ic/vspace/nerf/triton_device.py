"""Training and rendering on an NVIDIA GPU with the Triton kernels. A training step is one CUDA graph."""

from __future__ import annotations

import math
import os
from dataclasses import dataclass, field
from typing import Any

import numpy as np
import torch
from torch import Tensor

from instant_ic.util import paths
from instant_ic.vspace.config import FieldConfig, TrainConfig
from instant_ic.vspace.nerf.field import (
    BAND_COLOUR_WEIGHT,
    BETA1,
    BETA2,
    DISTANCE_WEIGHT,
    EPSILON,
    FieldParameters,
    Floats,
    Rays,
    StackedPriors,
    TrainingScene,
    adam_step_size,
    level_rates,
    ray_sources,
    sample_weights,
)
from instant_ic.vspace.view import LensRays

# Compiled kernels are cached with the project's other files. This must be set before triton is imported.
os.environ.setdefault("TRITON_CACHE_DIR", str(paths.cache_dir() / "triton"))

from instant_ic.vspace.nerf import triton_kernels as kernels

TRAIN_BLOCK = 64
ENTRIES = 256
"""Table entries that one program of Adam updates. Every table has a multiple of it."""
TILE = 64
"""Rays that one program handles: an 8 × 8 tile of a batch's strata or of a view."""


@dataclass
class _Parameters:
    """A field's parameters: table as float32 (``master``) and as float16 for the kernels, and network as one vector."""

    master: Tensor
    table: Tensor
    network: Tensor


@dataclass(frozen=True)
class _GpuScene:
    """A scene's arrays as tensors, in the shapes of ``StackedPriors``, ``Lattice`` and ``Occupancy``."""

    priors: dict[str, Tensor]
    cells_per_m: Tensor
    origin: Tensor
    focus: Tensor
    grid: Tensor
    low: Tensor
    cell_m: float
    camera: Tensor
    keyframes: int


@dataclass
class _StepBuffers:
    """Buffers of a training step. They are never reallocated, because the CUDA graph holds their addresses."""

    uniform: Tensor
    sources: Tensor
    rates: Tensor
    points: Tensor
    target: Tensor
    weight: Tensor
    table_grad: Tensor
    network_grad: Tensor
    table_moments: tuple[Tensor, Tensor]
    network_moments: tuple[Tensor, Tensor]
    sums: Tensor
    graph: Any = field(default=None)


def kernel_shape(field: FieldConfig) -> dict[str, int]:
    """Return the kernels' compile-time arguments for a field's size. Tile sizes are powers of two of at least 16."""
    return {
        "LEVELS": field.levels,
        "LP": max(_power_of_two(field.levels), 16 // field.features),
        "F": field.features,
        "HIDDEN": field.hidden,
        "HP": max(_power_of_two(field.hidden), 16),
    }


class TritonDevice:
    """Backend on an NVIDIA GPU (see ``field.Device``); not thread-safe.

    Args:
        device: ``cuda``; ``cpu`` for tests, with ``TRITON_INTERPRET=1``.

    Raises:
        ValueError: the kernels do not support the field's geometry.
    """

    def __init__(self, field: FieldConfig, train: TrainConfig, device: str = "cuda") -> None:
        if field.geometry != "distance":
            raise ValueError(f"the Triton kernels support only distance as geometry (got {field.geometry!r})")
        self._train, self._device = train, device
        self.on_gpu = device == "cuda"
        self.name = f"{torch.cuda.get_device_name()} (triton)" if self.on_gpu else f"{device} (triton)"
        features, inputs = field.features, field.levels * field.features
        self._shape = kernel_shape(field)
        self._table_shape = (field.levels, 1 << field.log2_table, features)
        self._network_shapes = ((field.hidden, inputs), (field.hidden,), (4, field.hidden), (4,))
        self._colour_weight, self._distance_weight = (self._tensor(w) for w in sample_weights(train))
        self._level_rates = level_rates(field.levels)
        self._scene: _GpuScene | None = None
        self._newest_lens: tuple[Floats, Tensor] | None = None
        self._p = self._uploaded(FieldParameters.random(field, train.seed))
        self._buffers = self._new_buffers()
        self._steps = 0

    def load(self, parameters: FieldParameters) -> None:
        self._p = self._uploaded(parameters)
        self._forget()

    def set_scene(self, scene: TrainingScene, parameters: FieldParameters | None = None) -> None:
        # Allocate everything first, so that the old scene remains usable if memory runs out.
        loaded = self._p if parameters is None else self._uploaded(parameters)
        self._scene, self._p = self._uploaded_scene(scene), loaded
        self._forget()

    def step(self, uniform: Floats, table_lr: float, network_lr: float) -> tuple[float, float]:
        scene, b = self._scene, self._buffers
        assert scene is not None, "set_scene first"
        self._steps += 1
        rates = np.append(self._level_rates * adam_step_size(table_lr, self._steps), 0.0).astype(np.float32)
        rates[-1] = adam_step_size(network_lr, self._steps)
        b.uniform.copy_(torch.from_numpy(np.ascontiguousarray(uniform)))
        b.rates.copy_(torch.from_numpy(rates))
        if scene.keyframes > 1 or self._steps == 1:
            b.sources.copy_(torch.from_numpy(ray_sources(scene.keyframes, len(b.sources), self._steps)))
        # The first step compiles, which is not allowed during a capture. The second step captures the graph.
        if self.on_gpu and b.graph is None and self._steps == 2:
            b.graph = torch.cuda.CUDAGraph()
            with torch.cuda.graph(b.graph):
                self._launch_step(scene)
        if b.graph is not None:
            b.graph.replay()
        else:
            self._launch_step(scene)
        colour, distance, shown, sure = b.sums.tolist()
        count = len(b.points)
        colour /= max(shown / count, 1e-3) * (1 + BAND_COLOUR_WEIGHT)
        return colour, distance / max(sure / count, 1e-3) / DISTANCE_WEIGHT

    def _launch_step(self, scene: _GpuScene) -> None:
        self._launch_gradient(scene)
        b, p = self._buffers, self._p
        levels, size, features = self._table_shape
        kernels.adam_table[(levels * size // ENTRIES,)](
            p.master, p.table, b.table_grad, *b.table_moments, b.rates, size, BETA1, BETA2, EPSILON,
            F=features, B=ENTRIES,
        )  # fmt: skip
        kernels.adam_network[(1,)](
            p.network, b.network_grad, *b.network_moments, b.rates[-1:], BETA1, BETA2, EPSILON,
            COUNT=len(p.network), B=_power_of_two(len(p.network)),
        )  # fmt: skip

    def _launch_gradient(self, scene: _GpuScene) -> None:
        """Sample the batch's rays and add their gradients to the buffers. Adam clears the buffers."""
        b, p, q, train = self._buffers, self._p, scene.priors, self._train
        size = self._table_shape[1]
        height, width = q["rgb"].shape[1:3]
        h, w = q["inverse_depth"].shape[1:]
        b.sums.zero_()
        kernels.sample_rays[(len(b.sources),)](
            b.uniform, b.sources, q["rgb"], q["inverse_depth"], q["depth_edge"], q["usable"], q["trust"],
            q["map_from_camera"], q["band"], q["gains"],
            train.ray_columns, train.ray_rows, width, height, w, h, b.points, b.target, b.weight, TILE,
        )  # fmt: skip
        count = len(b.points)
        kernels.gradient[(math.ceil(count / TRAIN_BLOCK),)](
            p.table, size, p.network, scene.cells_per_m, scene.origin, scene.focus, scene.keyframes,
            b.points, b.target, b.weight, self._colour_weight, self._distance_weight, count,
            b.table_grad, b.network_grad, b.sums, **self._shape, B=TRAIN_BLOCK,
        )  # fmt: skip

    def render_rays(self, rays: Rays, panorama_share: float, depth_share: float) -> tuple[Floats, Floats, Floats]:
        assert self._scene is not None, "set_scene first"
        p, scene = self._p, self._scene
        q = scene.priors
        rows, columns = rays.shape
        size = self._table_shape[1]
        pixels = rows * columns
        directions, turn = self._lens(rays)
        view = self._tensor(np.concatenate([rays.origin, turn.reshape(-1)]))
        room = -(-pixels // 4) * 4  # the compiled kernel needs all three outputs aligned to 16 bytes
        out = torch.empty(5 * room, device=self._device)
        colour, depth, confidence = out[: 3 * room], out[3 * room : 4 * room], out[4 * room :]
        height, width = q["rgb"].shape[1:3]
        h, w = q["inverse_depth"].shape[1:]
        kernels.render_rays[(math.ceil(rows / 8) * math.ceil(columns / 8),)](
            p.table, size, p.network, scene.cells_per_m, scene.origin, scene.focus, scene.grid, scene.low,
            q["rgb"], q["inverse_depth"], q["depth_edge"], q["known"], q["camera_from_map"], scene.camera, q["band"],
            q["gains"], scene.keyframes, view, view[3:], directions, columns, rows, width, height, w, h,
            *scene.grid.shape, scene.cell_m, float(panorama_share), float(depth_share), colour, depth, confidence,
            **self._shape, B=TILE,
        )  # fmt: skip
        fetched = out.cpu().numpy()
        colours = fetched[: 3 * pixels].reshape(pixels, 3)
        return colours, fetched[3 * room : 3 * room + pixels], fetched[4 * room : 4 * room + pixels]

    def _lens(self, rays: Rays) -> tuple[Tensor, Floats]:
        """Return a view's directions on the GPU and their rotation into the map. Each lens is uploaded once."""
        if not isinstance(rays, LensRays):
            return self._tensor(rays.directions), np.eye(3, dtype=np.float32)
        if self._newest_lens is None or self._newest_lens[0] is not rays.lens:
            self._newest_lens = rays.lens, self._tensor(rays.lens)
        return self._newest_lens[1], rays.turn

    def parameters(self) -> FieldParameters:
        p = self._p
        network = p.network.cpu().numpy()
        ends = np.cumsum([math.prod(shape) for shape in self._network_shapes])
        parts = np.split(network, ends[:-1])
        shaped = (part.reshape(shape).copy() for part, shape in zip(parts, self._network_shapes, strict=True))
        return FieldParameters(p.master.cpu().numpy().reshape(self._table_shape).copy(), *shaped)

    def _tensor(self, array: np.ndarray) -> Tensor:
        return torch.from_numpy(np.ascontiguousarray(array)).to(self._device)

    def _uploaded(self, parameters: FieldParameters) -> _Parameters:
        master = torch.from_numpy(parameters.table.reshape(-1).copy()).to(self._device)
        network = np.concatenate([array.reshape(-1) for array in parameters.network()])
        return _Parameters(master, master.half(), self._tensor(network))

    def _uploaded_scene(self, scene: TrainingScene) -> _GpuScene:
        stacked = StackedPriors.of(scene)
        keys = (
            *("rgb", "inverse_depth", "known", "depth_edge", "usable", "trust"),
            *("map_from_camera", "camera_from_map", "band", "gains"),
        )
        grid, lattice = scene.occupancy, scene.lattice
        return _GpuScene(
            priors={key: self._tensor(getattr(stacked, key)) for key in keys},
            cells_per_m=self._tensor(lattice.cells_per_m),
            origin=self._tensor(lattice.origin),
            focus=self._tensor(scene.focus),
            grid=self._tensor(grid.distance),
            low=self._tensor(grid.origin.astype(np.float32)),
            cell_m=float(grid.cell_m),
            camera=self._tensor(scene.prior.map_from_camera[:3, 3].astype(np.float32)),
            keyframes=len(scene.priors),
        )

    def _new_buffers(self) -> _StepBuffers:
        rays = self._train.ray_columns * self._train.ray_rows

        def zeros(*shape: int, kind: torch.dtype = torch.float32) -> Tensor:
            return torch.zeros(shape, dtype=kind, device=self._device)

        table, network = len(self._p.master), len(self._p.network)
        return _StepBuffers(
            uniform=zeros(rays, 3),
            sources=zeros(rays // TILE, kind=torch.int32),
            rates=zeros(self._shape["LEVELS"] + 1),
            points=zeros(2 * rays, 3),
            target=zeros(2 * rays, 4),
            weight=zeros(2 * rays, 2),
            table_grad=zeros(table),
            network_grad=zeros(network),
            table_moments=(zeros(table), zeros(table)),
            network_moments=(zeros(network), zeros(network)),
            sums=zeros(4),
        )

    def _forget(self) -> None:
        """Clear the moments and the graph, because the graph holds addresses of the earlier scene and parameters."""
        b = self._buffers
        for moment in (*b.table_moments, *b.network_moments, b.table_grad, b.network_grad):
            moment.zero_()
        b.graph = None
        self._steps = 0


def _power_of_two(number: int) -> int:
    """Return the smallest power of two that is not less than ``number``."""
    return 1 << (number - 1).bit_length()
