"""Fused depth for training a completion: from one faulty LiDAR revolution to a local 3D model."""

from __future__ import annotations

import math
from functools import lru_cache
from typing import TYPE_CHECKING

import cv2
import numpy as np
import torch
from numpy.typing import NDArray

from instant_ic.depth.model import DEFAULT_MODEL, DepthModel
from instant_ic.depth.sources import DepthSource, SourceConfig
from instant_ic.experiments.depth_lidar import RangeErrors, measure_world
from instant_ic.geometry.poses import pose_matrix
from instant_ic.mapping.local_model import LocalModel
from instant_ic.mapping.mapper import LocalView
from instant_ic.training.augment import photograph

if TYPE_CHECKING:
    from instant_ic.sim.render import EquirectRenderer

Floats = NDArray[np.floating]
MOST_REVOLUTIONS = 24
MODEL_SHARE, FAULTY_SHARE, BENT_SHARE = 0.3, 0.6, 0.6
"""Shares of priors that have a local model of 2 to ``MOST_REVOLUTIONS`` revolutions instead of one, that have faults
beyond noise, and that have network errors as in rooms unlike the training rooms."""
_MOST_BEND = 0.35
_MOST_TILT_DEG, _MOST_SHIFT_M = 1.0, 0.02
_UP = np.array([0.0, 0.0, 1.0])


def sample_prior(
    renderer: EquirectRenderer, map_from_camera: Floats, rgb: NDArray[np.uint8], depth_m: Floats,
    rng: np.random.Generator,
) -> NDArray[np.float32] | None:  # fmt: skip
    """Simulate the prior (6, H, W) (``depth.completion``) of a camera in a world; None if no depth could be fitted.

    Args:
        renderer: renderer of the world, whose floor is at 0.
        map_from_camera: pose of the camera, (4, 4).
        rgb: image of the camera, (H, W, 3) uint8.
        depth_m: true radial depth of the image in metres, (H, W).
        rng: source of faults and places.
    """
    camera_m = float(map_from_camera[2, 3])
    lidar_m = min(rng.uniform(0.35, 0.9), camera_m - 0.1)
    faulty, modelled = rng.random() < FAULTY_SHARE, rng.random() < MODEL_SHARE
    points = measure_world(renderer, map_from_camera, lidar_m, camera_m, _errors(rng, 0.05 if faulty else 0.0))
    local = None
    if modelled:
        local = LocalView(drive(renderer, map_from_camera, lidar_m, rng), np.asarray(map_from_camera, np.float64))
    up, mount = map_from_camera[:3, :3].T @ _UP, np.array([0.0, 0.0, lidar_m - camera_m])
    return _prior(rgb, depth_m, points, mount, faulty, up, camera_m + rng.normal(0, 0.01), local, rng)


def _errors(rng: np.random.Generator, outliers: float) -> RangeErrors:
    return RangeErrors(rng.uniform(0.01, 0.03), rng.uniform(0, outliers), int(rng.integers(1 << 31)))


def _prior(
    rgb: NDArray[np.uint8], depth_m: Floats, points: Floats, mount: Floats, faulty: bool, up: Floats,
    camera_m: float | None, local: LocalView | None, rng: np.random.Generator,
) -> NDArray[np.float32] | None:  # fmt: skip
    """Return the prior that ``DepthSource`` gives to a completion, with the network's depth of a degraded image."""
    if faulty:
        points = misplaced(spoiled(points - mount, rng) + mount, rng)
    image = torch.from_numpy(rgb.copy()).permute(2, 0, 1)[None].float() / 255
    generator = torch.Generator().manual_seed(int(rng.integers(1 << 31)))
    seen = photograph(image, torch.from_numpy(np.asarray(depth_m, np.float32))[None], generator)
    raw = _network().estimate((255 * seen[0]).byte().permute(1, 2, 0).numpy().copy())
    if raw.shape != depth_m.shape:
        raw = np.asarray(cv2.resize(raw, depth_m.shape[::-1], interpolation=cv2.INTER_NEAREST))
    if rng.random() < BENT_SHARE:
        raw = raw * bend(raw.shape, rng)
    prior = _source().estimate(raw, points, up, camera_m, local=local).prior
    return None if prior is None else prior.channels


def bend(size: tuple[int, ...], rng: np.random.Generator) -> NDArray[np.float32]:
    """Return smooth random factors (H, W) around 1, which vary over some 45 degrees."""
    coarse = rng.uniform(0, _MOST_BEND) * rng.standard_normal((5, 8))
    wide = np.concatenate((coarse[:, -1:], coarse, coarse[:, :1]), axis=1).astype(np.float32)
    step = size[1] // 8
    grown = cv2.resize(wide, (size[1] + 2 * step, size[0]), interpolation=cv2.INTER_CUBIC)
    return np.asarray(np.exp(grown[:, step:-step]), np.float32)


@lru_cache(maxsize=1)
def _source() -> DepthSource:
    return DepthSource(SourceConfig(source="completed"))


@lru_cache(maxsize=1)
def _network() -> DepthModel:
    return DepthModel.find(DEFAULT_MODEL, threads=1, provider="cpu")


@lru_cache(maxsize=1)
def _model() -> LocalModel:
    return LocalModel()


def drive(renderer: EquirectRenderer, map_from_camera: Floats, lidar_m: float, rng: np.random.Generator) -> LocalModel:
    """Return the local model after a straight drive in free space to the camera; each call reuses the same model."""
    model, end = _model(), np.asarray(map_from_camera[:3, 3])
    model.clear()
    heading = rng.uniform(-math.pi, math.pi)
    back = -np.array([math.cos(heading), math.sin(heading), 0.0])
    origins = np.array([[end[0], end[1], 0.15], [end[0], end[1], lidar_m]], np.float32)
    free_m, _ = renderer.cast(origins, np.repeat(back[None], 2, axis=0).astype(np.float32))
    length = min(float(np.min(free_m)) - 0.4, rng.uniform(0.3, 9.0))
    count = int(np.clip(length / 0.3, 2, MOST_REVOLUTIONS)) if length > 0.3 else 2
    for place in np.linspace(max(length, 0.0), 0.0, count):
        at = end + place * back
        pose = pose_matrix(at[0], at[1], lidar_m, yaw=heading)
        points = measure_world(renderer, pose, lidar_m, lidar_m, RangeErrors(0.02, 0.0, int(rng.integers(1 << 31))))
        x, y = at[:2] + rng.normal(0, 0.008, 2)
        drift = pose_matrix(x, y, lidar_m, yaw=heading + rng.normal(0, 0.002))
        model.add(points @ drift[:3, :3].T + drift[:3, 3], drift[:3, 3], max(length, 0.0) / count)
    return model


def spoiled(points: Floats, rng: np.random.Generator) -> NDArray[np.float64]:
    """Give points (N, 3) in the LiDAR's frame the faults of a real revolution; return (M, 3), M <= N.

    The faults are lost returns and rings, dark surfaces, glass, and mixed pixels at edges.
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
    """Move points (N, 3) in the camera's frame by a wrong mount (up to 1 degree, 2 cm) and a wrong time (a yaw)."""
    turn = np.clip(rng.normal(0, 0.4, 3), -_MOST_TILT_DEG, _MOST_TILT_DEG) * rng.random()
    turn[2] += rng.normal(0, 0.3)
    shift = np.clip(rng.normal(0, 0.008, 3), -_MOST_SHIFT_M, _MOST_SHIFT_M)
    rotation, _ = cv2.Rodrigues(np.radians(turn))
    return (points @ rotation.T + shift).astype(np.float32)
