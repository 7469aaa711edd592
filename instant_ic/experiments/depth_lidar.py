"""Simulated VLP-16 above or below the camera, measuring a depth image or a world."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from instant_ic.geometry.projections import equirect_directions

if TYPE_CHECKING:
    from instant_ic.sim.render import EquirectRenderer

Floats = NDArray[np.floating]
AZIMUTHS = 900
"""Azimuth steps per revolution: 0.4 degrees, as at 1200 rpm; at 600 rpm the device has twice as many."""
MIN_RANGE_M, MAX_RANGE_M = 0.4, 100.0


@dataclass(frozen=True)
class RangeErrors:
    """Errors of measured ranges.

    Attributes:
        noise_m: standard deviation of a range, metres.
        outliers: share of the points, 0..1, at a wrong range on their ray: half nearer than the surface (dust, rain,
            mixed pixels), half up to three times as far (glass, mirrors).
        seed: seed of noise and outliers.
    """

    noise_m: float = 0.02
    outliers: float = 0.0
    seed: int = 0

    def __post_init__(self) -> None:
        if not self.noise_m >= 0:
            raise ValueError(f"noise_m must be >= 0 (got {self.noise_m})")
        if not 0 <= self.outliers <= 1:
            raise ValueError(f"outliers must lie between 0 and 1 (got {self.outliers})")

    def apply(self, range_m: Floats) -> NDArray[np.float64]:
        """Apply the errors to true ranges; both (N,) metres."""
        rng = np.random.default_rng([53, self.seed])
        measured = range_m + rng.normal(0, 1, len(range_m)) * self.noise_m
        wrong = rng.permutation(len(range_m))[: round(self.outliers * len(range_m))]
        nearer, share = rng.random(len(wrong)) < 0.5, rng.random(len(wrong))
        true = range_m[wrong]
        measured[wrong] = np.where(nearer, MIN_RANGE_M + share * (true - MIN_RANGE_M), true * (1 + 2 * share))
        return np.maximum(measured, MIN_RANGE_M)


def measure(
    depth_m: Floats, lidar_height_m: float, camera_height_m: float, errors: RangeErrors | None = None
) -> NDArray[np.float32]:
    """Simulate one revolution of a VLP-16 on the camera's vertical, from a level depth image.

    LiDAR and camera share a vertical axis, so each beam stays in one column of the image. It ends at the nearest pixel
    of its column that lies on its ring, within the height of a pixel. Hidden surfaces give no points.

    Args:
        depth_m: radial depth of a level panorama in metres, (H, W); 0 or not finite is unknown.
        lidar_height_m: height of the LiDAR above the floor.
        camera_height_m: height of the camera above the same floor.
        errors: errors of the ranges; None: the default ones.

    Returns:
        Points in the camera's frame in metres, (N, 3).

    Raises:
        ValueError: not a depth image, or a value out of bounds.
    """
    if depth_m.ndim != 2 or min(depth_m.shape) < 4:
        raise ValueError(f"depth_m must be (H, W) (got {depth_m.shape})")
    mount = np.array([0.0, 0.0, lidar_height_m - camera_height_m])
    if not math.isfinite(mount[2]):
        raise ValueError(f"heights must be numbers (got {lidar_height_m}, {camera_height_m})")
    height, width = depth_m.shape
    known = np.isfinite(depth_m) & (depth_m > 1e-3)
    points = equirect_directions(width, height) * np.where(known, depth_m, 1.0)[..., None] - mount
    range_m = np.linalg.norm(points, axis=2)
    elevation_deg = np.degrees(np.arcsin(points[..., 2] / np.maximum(range_m, 1e-9)))
    ring = np.clip(np.rint((elevation_deg + 15) / 2), 0, 15).astype(np.intp)
    on_ring = np.abs(elevation_deg - (2 * ring - 15)) < 0.5 * 180 / height
    row, column = np.nonzero(known & on_ring & (range_m >= MIN_RANGE_M) & (range_m <= MAX_RANGE_M))
    order = np.argsort(range_m[row, column])
    row, column = row[order], column[order]
    _, first = np.unique(ring[row, column] * width + column, return_index=True)  # the nearest on each beam
    return _measured(points[row[first], column[first]], errors or RangeErrors(), mount)


def measure_world(
    renderer: EquirectRenderer,
    map_from_camera: Floats,
    lidar_height_m: float,
    camera_height_m: float,
    errors: RangeErrors | None = None,
    through_glass: bool = False,
) -> NDArray[np.float32]:
    """Simulate one revolution of a VLP-16 by ray casting; it also hits surfaces that the camera does not see.

    Args:
        renderer: renderer of the world.
        map_from_camera: pose of the camera, (4, 4).
        lidar_height_m: height of the LiDAR above the floor.
        camera_height_m: height of the camera above the floor.
        errors: errors of the ranges; None: the default ones.
        through_glass: windows (upright surfaces that emit light) return no points.

    Returns:
        Points in the camera's frame in metres, (N, 3).
    """
    omega, azimuth = np.meshgrid(np.radians(np.linspace(-15, 15, 16)), np.arange(AZIMUTHS) * (2 * math.pi / AZIMUTHS))
    rays = _on_rays(omega.ravel(), azimuth.ravel(), np.ones(omega.size))
    mount = np.array([0.0, 0.0, lidar_height_m - camera_height_m])
    origin = map_from_camera[:3, :3] @ mount + map_from_camera[:3, 3]
    directions = np.ascontiguousarray(rays @ map_from_camera[:3, :3].T, np.float32)
    origins = np.ascontiguousarray(np.broadcast_to(origin, directions.shape), np.float32)
    range_m, face = renderer.cast(origins, directions)
    hit = (range_m >= MIN_RANGE_M) & (range_m <= MAX_RANGE_M)
    if through_glass:
        surface = renderer.world.face_surface[np.maximum(face, 0)]
        hit &= (renderer.world.emission[surface] == 0) | (np.abs(renderer.world.normal[surface, 2]) > 0.5)
    return _measured(rays[hit] * range_m[hit, None].astype(np.float64), errors or RangeErrors(), mount)


def _on_rays(omega: float | Floats, azimuth: Floats, range_m: Floats) -> NDArray[np.float64]:
    """Return points (N, 3) at ranges (N,) on rays of elevation ``omega`` and azimuths (N,), from the LiDAR."""
    flat = np.cos(omega) * range_m
    return np.stack([flat * np.cos(azimuth), flat * np.sin(azimuth), np.sin(omega) * range_m], axis=-1)


def _measured(points: Floats, errors: RangeErrors, mount: Floats) -> NDArray[np.float32]:
    """Apply errors along the rays to points (N, 3) from the LiDAR at ``mount`` (3,)."""
    range_m = np.linalg.norm(points, axis=1)
    return (points * (errors.apply(range_m) / range_m)[:, None] + mount).astype(np.float32)
