"""The field's parameters and lattice, and the interface of its backends."""

from __future__ import annotations

import math
from dataclasses import dataclass, field
from typing import Any, Protocol

import numpy as np
from numpy.typing import NDArray

from instant_ic.vspace.config import FieldConfig, TrainConfig
from instant_ic.vspace.nerf.occupancy import Occupancy
from instant_ic.vspace.prior import PanoramaPrior

Floats = NDArray[np.float32]
TABLE_LR, NETWORK_LR = 0.04, 0.02
"""Learning rates at the start of a run."""
FINAL_LR_SHARE = 0.03
"""Learning rates at the end of a run, relative to its start."""
REFRESH_LR_SHARE = 0.5
"""Learning rates at the start of a refresh with a new keyframe, relative to those of the first run."""
FINE_LR_SHARE = 0.1
"""Learning rate of the finest level relative to the coarsest; a lower value reduces grain but slows detail."""
DISTANCE_WEIGHT = 0.1
"""Weight of the distance error relative to the colour error."""
BAND_COLOUR_WEIGHT = 0.3
"""Weight of a colour error beside the surface relative to one on the surface."""
VOLUME_WEIGHTS = 0.1, 0.1, 0.01
"""Weights of a ray's depth error, opacity regulariser and distortion, for density geometry."""
BETA1, BETA2, EPSILON = 0.9, 0.99, 3e-7
"""Adam's constants, as in instant-ngp."""
VOLUME_SAMPLES = 8
"""Number of samples of a ray for density geometry, evenly spaced within the truncation distance."""
RAW_LIMITS = -10.0, 6.0
"""Limits of the logarithm of the density. Outside them its gradient is zero."""


@dataclass(frozen=True)
class Lattice:
    """Position and size of the hash grid's cells. The grid is unbounded, so every point of the map lies in a cell.

    Attributes:
        origin: corner of a cell in the map, metres, (3,) float32.
        cells_per_m: cells per metre of each level, coarse to fine, (levels,) float32.
    """

    origin: Floats
    cells_per_m: Floats

    @classmethod
    def for_prior(cls, prior: PanoramaPrior, config: FieldConfig) -> Lattice:
        """Fit the cells: the coarsest to a sixteenth of the scene, the finest to a panorama pixel at median depth."""
        extent = 2 * float(1.0 / np.quantile(prior.inverse_depth, 0.05))
        coarse = 16 / extent
        pixel = 2 * math.pi / prior.rgb.shape[1] * prior.median_depth_m
        fine = max(1 / pixel, 2 * coarse)
        # Offset by part of a fine cell: for a wall in the plane of a lattice face, rounding would select the side.
        origin = prior.map_from_camera[:3, 3] + 0.37 / fine
        return cls(origin.astype(np.float32), np.geomspace(coarse, fine, config.levels).astype(np.float32))

    def suits(self, other: Lattice) -> bool:
        """Return whether a scene with the lattice ``other`` can keep this one: their scales differ by less than 2."""
        ratio = self.cells_per_m[[0, -1]] / other.cells_per_m[[0, -1]]
        return bool(np.all((ratio > 0.5) & (ratio < 2.0)))


@dataclass
class FieldParameters:
    """Hash table (levels, size, features) and network (``w1``, ``b1``, ``w2``, ``b2``), all float32."""

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
class TrainingScene:
    """Input of training and rendering: keyframes, lattice and occupancy.

    Attributes:
        priors: the keyframes, newest first; all have the same size.
        lattice: lattice of the field.
        occupancy: cells around the surfaces of all keyframes.
        gains: factors that bring each keyframe's colours to the newest's exposure, (K, 3) float32; None if all are 1.
    """

    priors: tuple[PanoramaPrior, ...]
    lattice: Lattice
    occupancy: Occupancy
    gains: Floats | None = None

    def __post_init__(self) -> None:
        """Raise ValueError if there is no keyframe, or if sizes of keyframes or gains do not match."""
        if not self.priors:
            raise ValueError("a scene needs a keyframe")
        sizes = {(prior.rgb.shape, prior.inverse_depth.shape) for prior in self.priors}
        if len(sizes) > 1:
            raise ValueError(f"panoramas and depths of a scene's keyframes must have one size (got {sorted(sizes)})")
        if self.gains is not None and self.gains.shape != (len(self.priors), 3):
            raise ValueError(f"gains must be ({len(self.priors)}, 3), a row per keyframe (got {self.gains.shape})")

    @property
    def prior(self) -> PanoramaPrior:
        """The newest keyframe."""
        return self.priors[0]

    @property
    def exposure(self) -> Floats:
        """``gains``, or ones if there are none, (K, 3) float32."""
        return np.ones((len(self.priors), 3), np.float32) if self.gains is None else self.gains.astype(np.float32)

    @property
    def focus(self) -> Floats:
        """Position of each keyframe's camera in metres and angle of its panorama's pixels in radians, (K, 4).

        They limit the resolution of the field.
        """
        pixel = 2 * math.pi / self.prior.rgb.shape[1]
        return np.array([[*prior.map_from_camera[:3, 3], pixel] for prior in self.priors], np.float32)


def ray_sources(keyframes: int, tiles: int, step: int) -> NDArray[np.int32]:
    """Assign a keyframe to each tile of a batch, (tiles,): the newest to half of the tiles, older ones to the rest.

    A low-discrepancy sequence over tiles and steps ensures that each keyframe soon trains every tile.

    Args:
        keyframes: number of keyframes of the scene.
        tiles: number of tiles of 8 × 8 rays in a batch.
        step: number of the training step, from 1.
    """
    if keyframes == 1:
        return np.zeros(tiles, np.int32)
    place = (np.arange(tiles) * 0.7548776662 + step * 0.5698402910) % 1.0  # the plastic number's lattice
    older = 1 + np.floor((2 * place - 1) * (keyframes - 1))
    return np.where(place < 0.5, 0, older).astype(np.int32)


LEAST_TRUST = 0.1
"""Smallest weight of uncertain depth; depth of median uncertainty has weight 1."""


@dataclass(frozen=True)
class StackedPriors:
    """A scene's keyframes as input of the kernels: the arrays of ``PanoramaPrior``, stacked to (K, …), newest first.

    Attributes:
        trust: weight of each pixel's depth in the loss by its uncertainty, (K, h, w); 1 for the image's median.
    """

    rgb: NDArray[np.uint8]
    inverse_depth: Floats
    known: NDArray[np.uint8]
    depth_edge: NDArray[np.uint8]
    usable: NDArray[np.uint8]
    trust: Floats
    map_from_camera: Floats
    camera_from_map: Floats
    band: Floats
    gains: Floats

    @classmethod
    def of(cls, scene: TrainingScene) -> StackedPriors:
        def stacked(key: str) -> Any:
            if len(scene.priors) == 1:
                return getattr(scene.prior, key)[None]  # no copy
            return np.stack([getattr(prior, key) for prior in scene.priors])

        poses = [prior.map_from_camera for prior in scene.priors]
        return cls(
            rgb=stacked("rgb"),
            inverse_depth=stacked("inverse_depth"),
            known=stacked("known"),
            depth_edge=stacked("depth_edge"),
            usable=stacked("usable"),
            trust=np.stack([depth_trust(prior) for prior in scene.priors]),
            map_from_camera=np.array(poses, np.float32),
            camera_from_map=np.linalg.inv(poses).astype(np.float32),
            band=np.array([prior.band for prior in scene.priors], np.float32),
            gains=scene.exposure,
        )


def depth_trust(prior: PanoramaPrior) -> Floats:
    """Return the weight of each pixel's depth, (h, w) float32: the squared ratio of median to own uncertainty."""
    with np.errstate(divide="ignore", invalid="ignore"):
        ratio = np.where(prior.sigma > prior.relative_sigma, prior.relative_sigma / prior.sigma, 1.0)
    return np.clip(ratio * ratio, LEAST_TRUST, 1.0).astype(np.float32)


@dataclass(frozen=True)
class Rays:
    """Rays of a view, in the map's frame.

    Attributes:
        origin: position of the camera, (3,) float32.
        directions: unit vectors, (P, 3) float32.
        axial: depth along the view's axis per metre along the ray, (P,). On the image of a plane, the inverse of the
            axial depth is linear.
        shape: height and width of the view.
        stride: distance in pixels over which depth may be interpolated.
    """

    origin: Floats
    directions: Floats
    axial: Floats
    shape: tuple[int, int]
    stride: int = 4

    def some(self, chosen: NDArray[np.integer]) -> Rays:
        """Return the rays of some pixels, as one column."""
        return Rays(self.origin, self.directions[chosen], self.axial[chosen], (len(chosen), 1))


class Device(Protocol):
    """A backend that trains and renders: ``numba_device`` or ``triton_device``.

    Attributes:
        name: name of the hardware and the backend, for the status.
        on_gpu: True if the backend computes on a GPU.
    """

    name: str
    on_gpu: bool

    def load(self, parameters: FieldParameters) -> None:
        """Load parameters and reset the optimiser's moments."""

    def set_scene(self, scene: TrainingScene, parameters: FieldParameters | None = None) -> None:
        """Replace the scene and reset the moments. After a failure the old scene remains.

        Args:
            scene: scene to train and render from now on.
            parameters: parameters to start from; None keeps the present ones.
        """

    def step(self, uniform: Floats, table_lr: float, network_lr: float) -> tuple[float, float]:
        """Train one iteration on rays of the keyframes that ``ray_sources`` selects.

        Args:
            uniform: random numbers in [0, 1) that place the rays, (N, 3).
            table_lr: learning rate of the table.
            network_lr: learning rate of the network.

        Returns:
            Mean squared colour error (colours 0 to 1) and mean squared distance error (in truncation distances).
        """

    def render_rays(self, rays: Rays, panorama_share: float, depth_share: float) -> tuple[Floats, Floats, Floats]:
        """Render rays; return colours (P, 3), 0 to 1, depth (P,), 0 where a ray hits nothing, and confidence (P,).

        Args:
            rays: P rays of the view.
            panorama_share: weight of a keyframe's panorama in the colour of surfaces that the keyframe has seen; the
                field has the remaining weight. With 1, surfaces without confidence get no colour.
            depth_share: weight of the keyframes' depth in the signed distance; the field has the remaining weight.
        """

    def parameters(self) -> FieldParameters:
        """Return a copy of the present parameters."""


@dataclass
class Schedule:
    """A schedule of learning rates that fall exponentially over a run."""

    config: TrainConfig
    refresh: bool = False
    iteration: int = field(default=0)

    @property
    def finished(self) -> bool:
        return self.iteration >= self.config.iterations

    def rates(self) -> tuple[float, float]:
        """Return the learning rates of table and network in the present iteration."""
        share = FINAL_LR_SHARE ** min(1.0, self.iteration / self.config.iterations)
        if self.refresh:
            share *= REFRESH_LR_SHARE
        return TABLE_LR * share, NETWORK_LR * share


def sample_weights(config: TrainConfig) -> tuple[Floats, Floats]:
    """Return the weights of a batch's samples in the losses of colour and distance, (2 · rays,) each.

    Samples beside the surface also train their ray's colour, with less weight, because a view from another direction
    may hit the surface slightly in front of or behind it.
    """
    rays = config.ray_columns * config.ray_rows
    on_surface = np.repeat(np.tile([True, False], rays // 64), 64)
    colour = np.where(on_surface, 1.0, BAND_COLOUR_WEIGHT) / (3 * rays)
    distance = np.full(2 * rays, DISTANCE_WEIGHT / (2 * rays))
    return colour.astype(np.float32), distance.astype(np.float32)


def volume_rays(config: TrainConfig) -> tuple[int, int]:
    """Return columns and rows of a batch for density geometry, with as many field queries as for distance geometry."""
    return config.ray_columns // 2, config.ray_rows // 2


def level_rates(levels: int) -> Floats:
    """Return the learning rate of each level relative to the coarsest, (levels,)."""
    return np.geomspace(1.0, FINE_LR_SHARE, levels).astype(np.float32)


def adam_step_size(lr: float, step: int) -> float:
    """Return Adam's step size with both bias corrections for ``step``, counted from 1."""
    return lr * math.sqrt(1 - BETA2**step) / (1 - BETA1**step)
