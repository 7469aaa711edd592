"""Simulated VLP-16 above or below the camera, measuring a depth image or a world."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

if TYPE_CHECKING:
    from instant_ic.sim.render import EquirectRenderer

Floats = NDArray[np.floating]
AZIMUTHS = 900
"""Azimuth steps per revolution: 0.4 degrees, as at 600 rpm."""
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
    depth_m: Floats,
    lidar_height_m: float,
    camera_height_m: float,
    errors: RangeErrors | None = None,
) -> NDArray[np.float32]:
    """Simulate one revolution of a VLP-16 on the camera's vertical, from a level depth image.

    LiDAR and camera share a vertical axis, so each beam stays in one column of the image. There the image is a profile
    of the room, and a beam ends where it first meets the profile. A beam gives no point where it passes behind a
    visible surface (through a depth discontinuity) or through unknown pixels, because its end is unknown.

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
    below_m = lidar_height_m - camera_height_m
    if not math.isfinite(below_m):
        raise ValueError(f"heights must be numbers (got {lidar_height_m}, {camera_height_m})")
    height = len(depth_m)
    known = np.isfinite(depth_m) & (depth_m > 1e-3)
    inverse = np.where(known, 1.0 / np.where(known, depth_m, 1.0), 0.0)
    azimuth = math.pi - (np.arange(AZIMUTHS) + 0.5) * (2 * math.pi / AZIMUTHS)
    profile = _profiles(inverse, azimuth)
    elevation = math.pi / 2 - (np.arange(height) + 0.5) * (math.pi / height)
    depth_edge = _depth_edges(profile, math.pi / height)[:-1] | ((profile[1:] > 0) ^ (profile[:-1] > 0))
    profile, depth_edge = _bridge_unknown(profile, depth_edge)
    radius = np.where(profile > 0, 1.0 / np.where(profile > 0, profile, 1.0), np.nan)
    across, up = radius * np.cos(elevation)[:, None], radius * np.sin(elevation)[:, None] - below_m

    points = []
    for omega in np.radians(np.linspace(-15, 15, 16)):
        range_m = _first_crossing(across, up, depth_edge, omega)
        hit = (range_m >= MIN_RANGE_M) & (range_m <= MAX_RANGE_M)
        points.append(_on_rays(omega, azimuth[hit], range_m[hit]))
    true = np.concatenate(points)
    return _measured(true, errors or RangeErrors(), np.array([0.0, 0.0, below_m]))


def measure_world(
    renderer: EquirectRenderer,
    map_from_camera: Floats,
    lidar_height_m: float,
    camera_height_m: float,
    errors: RangeErrors | None = None,
    through_glass: bool = False,
) -> NDArray[np.float32]:
    """Simulate one revolution of a VLP-16 by ray casting, also behind visible surfaces.

    Args:
        renderer: renderer of the world.
        map_from_camera: pose of the camera, (4, 4).
        lidar_height_m: height of the LiDAR above the floor.
        camera_height_m: height of the camera above the floor.
        errors: errors of the ranges; None: the default ones.
        through_glass: windows (upright surfaces that shine) return no points.

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


def _depth_edges(inverse: Floats, step_rad: float) -> NDArray[np.bool_]:
    """Mark depth discontinuities between each row of inverse depth (H, W) and the next, and between last and first row.

    An edge is marked where the surface is seen at less than 1 degree, or at less than 8 degrees while the inverse
    depth, which is smooth over any plane, jumps.
    """
    following = np.roll(inverse, -1, axis=0)
    jump = np.abs(following - inverse)
    # Legs of a right-angled triangle: step_rad * range across the ray, the range difference along it.
    slope = jump / np.maximum(step_rad * np.maximum(np.minimum(inverse, following), 1e-9), 1e-12)
    alike = np.maximum(np.roll(jump, 1, axis=0), np.roll(jump, -1, axis=0))
    return (slope > 1 / math.tan(math.radians(1))) | ((slope > 1 / math.tan(math.radians(8))) & (jump > 2 * alike))


def _profiles(inverse: Floats, azimuth: Floats) -> NDArray[np.float64]:
    """Return columns (H, N) of inverse depth (H, W) at azimuths (N,), interpolated only on a surface."""
    width = inverse.shape[1]
    u = (math.pi - azimuth) * (width / (2 * math.pi)) - 0.5
    left = np.floor(u).astype(np.intp)
    share = u - left
    depth_edge = _depth_edges(np.ascontiguousarray(inverse.T), 2 * math.pi / width).T
    a, b = inverse[:, left % width], inverse[:, (left + 1) % width]
    apart = depth_edge[:, left % width] | (a == 0) | (b == 0)
    return np.where(apart, np.where(share < 0.5, a, b), (1 - share) * a + share * b)


def _bridge_unknown(
    profile: NDArray[np.float64], depth_edge: NDArray[np.bool_]
) -> tuple[NDArray[np.float64], NDArray[np.bool_]]:
    """Fill unknown pixels from above (the first from below) and mark them: beams that pass through them have no end."""
    known = profile > 0
    row = np.where(known, np.arange(len(profile))[:, None], -1)
    above = np.maximum.accumulate(row, axis=0)
    first = np.where(known.any(axis=0), known.argmax(axis=0), -1)
    above = np.where(above < 0, first, above)
    filled = np.where(above < 0, 0.0, np.take_along_axis(profile, np.maximum(above, 0), axis=0))
    return filled, depth_edge | ~known[:-1] | ~known[1:]


def _first_crossing(across: Floats, up: Floats, depth_edge: NDArray[np.bool_], omega: float) -> NDArray[np.float64]:
    """Return the ranges (N,) at which beams of elevation ``omega`` first meet profiles (H, N).

    The range is inf where a beam meets none, or meets it at a discontinuity.
    """
    side = across * math.sin(omega) - up * math.cos(omega)
    along = across * math.cos(omega) + up * math.sin(omega)
    s0, s1 = side[:-1], side[1:]
    crosses = (s0 > 0) != (s1 > 0)
    with np.errstate(divide="ignore", invalid="ignore"):
        range_m = (along[:-1] * s1 - along[1:] * s0) / (s1 - s0)
    range_m = np.where(crosses & (range_m > 0), range_m, np.inf)
    nearest = np.argmin(range_m, axis=0)[None]
    end = np.take_along_axis(range_m, nearest, axis=0)[0]
    return np.where(np.take_along_axis(depth_edge, nearest, axis=0)[0], np.inf, end)
