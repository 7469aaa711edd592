"""Incomplete depth for training a completion: from nothing over one faulty LiDAR revolution to a local 3D model."""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import lru_cache
from typing import TYPE_CHECKING

import cv2
import numpy as np
from numpy.typing import NDArray

from instant_ic.depth.completion import prior_channels
from instant_ic.depth.sources import DepthSource, SourceConfig
from instant_ic.experiments.depth_lidar import Errors, measure, measure_world
from instant_ic.geometry.poses import pose_matrix
from instant_ic.mapping.local_model import LocalModel
from instant_ic.mapping.mapper import LocalView

if TYPE_CHECKING:
    from instant_ic.sim.render import EquirectRenderer

Floats = NDArray[np.floating]
MOST_REVOLUTIONS = 60
_MOST_TILT_DEG, _MOST_SHIFT_M = 1.0, 0.02
_UP = np.array([0.0, 0.0, 1.0])


@dataclass(frozen=True)
class Sparsity:
    """How much depth a training panorama comes with.

    Attributes:
        none: share of panoramas without any.
        model: share with a local 3D model of 2 to ``MOST_REVOLUTIONS`` revolutions; the others have one revolution.
        faulty: share of the revolutions with faults beyond noise.
    """

    none: float = 0.1
    model: float = 0.35
    faulty: float = 0.6

    def __post_init__(self) -> None:
        if min(self.none, self.model) < 0 or self.none + self.model > 1 or not 0 <= self.faulty <= 1:
            raise ValueError(f"shares must lie in 0..1, none and model together too (got {self})")


def sample_prior(
    renderer: EquirectRenderer,
    map_from_camera: Floats,
    rng: np.random.Generator,
    size: tuple[int, int],
    sparsity: Sparsity | None = None,
) -> NDArray[np.float32]:
    """Prior (5, H, W) of a camera (4, 4) in a world with its floor at 0; see ``prior_channels``."""
    sparsity = sparsity or Sparsity()
    kind = rng.random()
    camera_m = float(map_from_camera[2, 3])
    up = map_from_camera[:3, :3].T @ _UP
    if kind < sparsity.none:
        return nothing(size, up, camera_m if rng.random() < 0.5 else None)
    lidar_m = min(rng.uniform(0.35, 0.9), camera_m - 0.1)
    faulty = rng.random() < sparsity.faulty
    errors = Errors(rng.uniform(0.01, 0.03), rng.uniform(0, 0.05) if faulty else 0.0, int(rng.integers(1 << 31)))
    points = measure_world(renderer, map_from_camera, lidar_m, camera_m, errors)
    mount = np.array([0.0, 0.0, lidar_m - camera_m])
    if faulty:
        points = misplaced(spoiled(points - mount, rng) + mount, rng)
    local = None
    if kind < sparsity.none + sparsity.model:
        local = LocalView(drive(renderer, map_from_camera, lidar_m, rng), np.asarray(map_from_camera, np.float64))
    return _prior(points, up, camera_m + rng.normal(0, 0.01), size, local)


def prior_of_image(depth_m: Floats, rng: np.random.Generator) -> NDArray[np.float32]:
    """The same for a level panorama with true depth (H, W) instead of a world: none, or one revolution."""
    if rng.random() < Sparsity().none:
        return nothing(depth_m.shape, _UP, None)
    below_m = rng.uniform(0.1, 0.7)
    errors = Errors(rng.uniform(0.01, 0.03), 0.0, int(rng.integers(1 << 31)))
    points = measure(depth_m, 0.0, below_m, errors)
    mount = np.array([0.0, 0.0, -below_m])
    if rng.random() < Sparsity().faulty:
        points = misplaced(spoiled(points - mount, rng) + mount, rng)
    return _prior(points, _UP, None, depth_m.shape, None)


def nothing(size: tuple[int, ...], up: Floats, camera_m: float | None) -> NDArray[np.float32]:
    """Prior without any depth."""
    zero = np.zeros(size, np.float32)
    return prior_channels(zero, zero, zero, up, camera_m)


def _prior(
    points: Floats, up: Floats, camera_m: float | None, size: tuple[int, ...], local: LocalView | None
) -> NDArray[np.float32]:
    source, (height, width) = _source(), size
    built = source.estimate(None, points, up, camera_m, (height, width), local)
    if not built.ok:
        return nothing(size, up, camera_m)
    return prior_channels(built.depth_m, built.sigma, source.structure.ranges(points, (height, width)), up, camera_m)


@lru_cache(maxsize=1)
def _source() -> DepthSource:
    return DepthSource(SourceConfig(source="lidar"))


@lru_cache(maxsize=1)
def _model() -> LocalModel:
    return LocalModel()


def drive(renderer: EquirectRenderer, map_from_camera: Floats, lidar_m: float, rng: np.random.Generator) -> LocalModel:
    """Local model after a straight drive in free space that ends at the camera. The model is used again each time."""
    model, end = _model(), np.asarray(map_from_camera[:3, 3])
    model.clear()
    heading = rng.uniform(-math.pi, math.pi)
    back = -np.array([math.cos(heading), math.sin(heading), 0.0])
    origins = np.array([[end[0], end[1], 0.15], [end[0], end[1], lidar_m]], np.float32)
    free_m, _ = renderer.cast(origins, np.repeat(back[None], 2, axis=0).astype(np.float32))
    length = min(float(np.min(free_m)) - 0.4, rng.uniform(0.3, 9.0))
    count = int(np.clip(length / 0.15, 2, MOST_REVOLUTIONS)) if length > 0.3 else 2
    for place in np.linspace(max(length, 0.0), 0.0, count):
        at = end + place * back
        pose = pose_matrix(at[0], at[1], lidar_m, yaw=heading)
        points = measure_world(renderer, pose, lidar_m, lidar_m, Errors(0.02, 0.0, int(rng.integers(1 << 31))))
        x, y = at[:2] + rng.normal(0, 0.008, 2)
        drift = pose_matrix(x, y, lidar_m, yaw=heading + rng.normal(0, 0.002))
        model.add(points @ drift[:3, :3].T + drift[:3, 3], drift[:3, 3], max(length, 0.0) / count)
    return model


def spoiled(points: Floats, rng: np.random.Generator) -> NDArray[np.float64]:
    """Faults of a real revolution: lost returns and rings, dark surfaces, glass, mixed pixels at edges.

    Args:
        points: (N, 3) in the LiDAR's frame.
        rng: source of randomness.

    Returns:
        (M, 3), M <= N.
    """
    range_m = np.linalg.norm(points, axis=1)
    azimuth = np.arctan2(points[:, 1], points[:, 0])
    ring = np.rint(np.degrees(np.arcsin(np.clip(points[:, 2] / range_m, -1, 1)))).astype(int)
    kept = rng.random(len(points)) > rng.uniform(0, 0.15)
    if rng.random() < 0.25:
        kept &= ~np.isin(ring, rng.choice(np.arange(-15, 16, 2), rng.integers(1, 4)))
    factor = np.ones(len(points))
    for _ in range(rng.poisson(1.0)):
        away = np.abs(np.remainder(azimuth - rng.uniform(-math.pi, math.pi) + math.pi, 2 * math.pi) - math.pi)
        inside = (away < math.radians(rng.uniform(2, 15))) & (rng.random(len(points)) < rng.uniform(0.5, 1.0))
        if rng.random() < 0.5:
            kept &= ~inside  # dark, or a window to the outside
        else:
            factor[inside] = rng.uniform(1.1, 2.5)  # glass, a mirror
    order = np.lexsort((azimuth, ring))
    step = np.abs(np.diff(range_m[order]))
    edge = order[1:][(step > 0.3) & (np.diff(ring[order]) == 0)]
    mixed = edge[rng.random(len(edge)) < 0.5]
    before = np.empty(len(points), np.intp)
    before[order[1:]], before[order[:1]] = order[:-1], order[:1]
    share = rng.random(len(mixed))
    factor[mixed] = (share + (1 - share) * range_m[before[mixed]] / range_m[mixed]) * factor[mixed]
    return np.asarray((points * factor[:, None])[kept], np.float64)


def misplaced(points: Floats, rng: np.random.Generator) -> NDArray[np.float32]:
    """Points (N, 3) in the camera's frame under a wrong mount (up to 1 degree, 2 cm) and a wrong time (a yaw)."""
    turn = np.clip(rng.normal(0, 0.4, 3), -_MOST_TILT_DEG, _MOST_TILT_DEG) * rng.random()
    turn[2] += rng.normal(0, 0.3)
    shift = np.clip(rng.normal(0, 0.008, 3), -_MOST_SHIFT_M, _MOST_SHIFT_M)
    rotation, _ = cv2.Rodrigues(np.radians(turn))
    return (points @ rotation.T + shift).astype(np.float32)
