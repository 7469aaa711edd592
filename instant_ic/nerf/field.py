"""The field's parameters and lattice, and what every device has to be able to do with them."""

from __future__ import annotations

import math
from dataclasses import dataclass, field
from typing import Any, Protocol

import numpy as np
from numpy.typing import NDArray

from .config import FieldConfig, TrainConfig
from .occupancy import Occupancy
from .prior import PanoramaPrior

Floats = NDArray[np.float32]
BETA1, BETA2, EPSILON = 0.9, 0.99, 3e-7
"""Adam's constants, as in instant-ngp."""


@dataclass(frozen=True)
class Lattice:
    """Where the hash grid's cells lie. It has no border: every place of the map has its cells.

    Attributes:
        origin: map frame, metres, (3,) float32.
        cells_per_m: of each level, coarse to fine, (levels,) float32.
    """

    origin: Floats
    cells_per_m: Floats

    @classmethod
    def for_prior(cls, prior: PanoramaPrior, config: FieldConfig) -> Lattice:
        """Coarsest cell: the scene over ``base_resolution``; finest: a panorama pixel at the median depth."""
        extent = 2 * float(1.0 / np.quantile(prior.inverse_depth, 0.05))
        coarse = config.base_resolution / extent
        pixel = 2 * math.pi / prior.rgb.shape[1] * prior.median_depth_m
        fine = max(1 / pixel, 2 * coarse)
        # Half a fine cell aside: a wall in the plane of a lattice face would use one side's entries only by chance.
        origin = prior.map_from_camera[:3, 3] + 0.37 / fine
        return cls(origin.astype(np.float32), np.geomspace(coarse, fine, config.levels).astype(np.float32))

    def suits(self, other: Lattice) -> bool:
        """Whether a scene that asks for ``other`` can go on with this one: scales within a factor of 2."""
        ratio = self.cells_per_m[[0, -1]] / other.cells_per_m[[0, -1]]
        return bool(np.all((ratio > 0.5) & (ratio < 2.0)))


@dataclass
class FieldParameters:
    """Table (levels, size, features) and network (``w1``, ``b1``, ``w2``, ``b2``), float32."""

    table: Floats
    w1: Floats
    b1: Floats
    w2: Floats
    b2: Floats

    @classmethod
    def random(cls, config: FieldConfig, seed: int) -> FieldParameters:
        rng = np.random.default_rng(seed)
        inputs = config.levels * config.features
        shape = (config.levels, 1 << config.log2_table, config.features)

        def uniform(limit: float, *size: int) -> Floats:
            return (rng.random(size, np.float32) * 2 - 1) * np.float32(limit)

        return cls(
            table=uniform(1e-3, *shape),
            w1=uniform(math.sqrt(6 / inputs), config.hidden, inputs),
            b1=np.zeros(config.hidden, np.float32),
            w2=uniform(math.sqrt(3 / config.hidden), 4, config.hidden),
            b2=np.zeros(4, np.float32),
        )

    def network(self) -> tuple[Floats, Floats, Floats, Floats]:
        return self.w1, self.b1, self.w2, self.b2


@dataclass(frozen=True)
class Scene:
    """What a device trains on and renders from: keyframe, lattice and occupancy."""

    prior: PanoramaPrior
    lattice: Lattice
    occupancy: Occupancy

    @property
    def focus(self) -> Floats:
        """Place of the keyframe's camera and radians of a panorama's pixel, (4,): how fine the field may be where."""
        pixel = 2 * math.pi / self.prior.rgb.shape[1]
        return np.array([*self.prior.map_from_camera[:3, 3], pixel], np.float32)


@dataclass(frozen=True)
class Rays:
    """A view's rays: ``origin`` (3,) float32 map frame; ``directions`` (P, 3) float32 unit vectors, map frame;
    ``axial`` (P,): the depth times it has an inverse that is linear over a plane in the picture (depth along the view's
    axis per metre along the ray); ``shape`` (height, width); ``stride``: between so many pixels it may be interpolated.
    """

    origin: Floats
    directions: Floats
    axial: Floats
    shape: tuple[int, int]
    stride: int = 4


class Device(Protocol):
    """One device's way to train and render; ``numba_device`` and ``torch_device`` have it."""

    name: str

    def load(self, parameters: FieldParameters) -> None:
        """Takes parameters over and forgets the optimiser's moments."""

    def set_scene(self, scene: Scene) -> None:
        """Trains and renders this scene from now on, with the present parameters; forgets the moments."""

    def step(self, uniform: Floats, table_lr: float, network_lr: float) -> tuple[float, float]:
        """One iteration on the rays drawn by ``uniform`` (N, 3).

        Returns:
            Mean squared colour error (0..1 units) and mean squared distance error (units of the band).
        """

    def freeze(self) -> Any:
        """The present scene and a copy of the parameters, for ``draw``; training does not change it."""

    def draw(
        self, rays: Rays, panorama_share: float, depth_share: float, frozen: Any = None
    ) -> tuple[Floats, Floats, Floats]:
        """Colours (P, 3) in 0..1, depth along the ray (P,) with 0 where nothing is met, confidence (P,).

        Args:
            rays: of the view.
            panorama_share: of the keyframe's panorama in the colour of surfaces that it has seen; the rest is the
                field's. With 1 the colour of surfaces without confidence is not worked out.
            depth_share: of the keyframe's depth in the signed distance; the rest is the field's.
            frozen: what ``freeze`` gave, or the present field.
        """

    def parameters(self, frozen: Any = None) -> FieldParameters:
        """A copy of the present parameters, or of the frozen ones."""


@dataclass
class Schedule:
    """Learning rates that fall exponentially over a run."""

    config: TrainConfig
    refresh: bool = False
    iteration: int = field(default=0)

    @property
    def finished(self) -> bool:
        return self.iteration >= self.config.iterations

    def rates(self) -> tuple[float, float]:
        """Table's and network's rates of the present iteration."""
        share = self.config.final_lr_share ** min(1.0, self.iteration / self.config.iterations)
        if self.refresh:
            share *= self.config.refresh_lr_share
        return self.config.table_lr * share, self.config.network_lr * share


def sample_weights(config: TrainConfig) -> tuple[Floats, Floats]:
    """Weights of a batch's samples in the loss, colour's and distance's, each (2 · rays,).

    Samples in the band carry their ray's colour too, at less weight: a view from aside may meet the surface a little
    off its place.
    """
    rays = config.ray_columns * config.ray_rows
    on_surface = np.repeat(np.tile([True, False], rays // 64), 64)
    colour = np.where(on_surface, 1.0, config.band_colour_weight) / (3 * rays)
    distance = np.full(2 * rays, config.distance_weight / (2 * rays))
    return colour.astype(np.float32), distance.astype(np.float32)


def level_rates(config: TrainConfig, levels: int) -> Floats:
    """Learning rate of each level against the coarsest's, (levels,)."""
    return np.geomspace(1.0, config.fine_lr_share, levels).astype(np.float32)


def adam_step_size(lr: float, step: int) -> float:
    """Adam's step with both bias corrections in it; ``step`` counts from 1."""
    return lr * math.sqrt(1 - BETA2**step) / (1 - BETA1**step)
