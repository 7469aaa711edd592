"""Edges that a spinning LiDAR and a panorama both see, which the calibration aligns. Arrays in, arrays out."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

Floats = NDArray[np.floating]
CUES = ("jump", "shade", "floor", "shade_across")
"""Kinds of edge. Vertical in the image: depth discontinuity along a ring, intensity step along a ring. Horizontal: foot
of a wall, intensity step between rings."""
UPRIGHT = ("jump", "shade")
_MARGIN = 32
_COLUMNS = 900
_INTENSITY_STEP = 6.0
"""Smallest step of the LiDAR's intensity that counts as an edge."""


@dataclass(frozen=True)
class LidarEdges:
    """Edge points of a revolution.

    Attributes:
        points: (N, 3) in the LiDAR's frame, metres.
        cue: index into ``CUES``, (N,).
    """

    points: NDArray[np.float64]
    cue: NDArray[np.int8]


@dataclass(frozen=True)
class FloorPlane:
    """Floor in the LiDAR's frame: upward normal (3,), and height in metres; normal · p = height for floor points p."""

    normal: NDArray[np.float64]
    height: float


def find_floor(points: Floats, most_tilt_deg: float = 15.0, seed: int = 0) -> FloorPlane | None:
    """Find the largest plane below the LiDAR that is level within ``most_tilt_deg``, by RANSAC; points (N, 3), finite.

    Returns:
        None if fewer than 200 points, or fewer than a tenth of the points below the LiDAR, lie on one plane.
    """
    low = np.asarray(points[points[:, 2] < -0.15], np.float64)
    if len(low) < 200:
        return None
    rng = np.random.default_rng(seed)
    some = low[rng.permutation(len(low))[:4000]]
    best, normal, height = 0, np.zeros(3), 0.0
    for a, b, c in some[rng.integers(0, len(some), (300, 3))]:
        across = np.cross(b - a, c - a)
        length = float(np.linalg.norm(across))
        if length < 0.05 or abs(across[2]) < math.cos(math.radians(most_tilt_deg)) * length:
            continue
        across *= np.sign(across[2]) / length
        count = int((np.abs(some @ across - across @ a) < 0.02).sum())
        if count > best:
            best, normal, height = count, across, float(across @ a)
    if best < max(200 * len(some) / len(low), 0.1 * len(some)):
        return None
    on_it = low[np.abs(low @ normal - height) < 0.03]
    near, far = np.quantile(np.hypot(on_it[:, 0], on_it[:, 1]), (0.1, 0.9))
    if far - near < 0.2:
        return None  # probably a single ring on the walls around; any single ring is planar
    centre = on_it.mean(axis=0)
    normal = np.linalg.svd(on_it - centre, full_matrices=False)[2][2]
    normal *= np.sign(normal[2])
    return FloorPlane(normal, float(normal @ centre))


def lidar_edges(points: Floats, intensity: Floats, ring: NDArray[np.integer], floor: FloorPlane | None) -> LidarEdges:
    """Find the edges in one revolution.

    Args:
        points: (N, 3) in the LiDAR's frame, metres, finite.
        intensity: (N,).
        ring: number of the laser, from the lowest upwards, (N,).
        floor: floor plane for the feet of walls; None leaves them out.
    """
    azimuth = np.arctan2(points[:, 1], points[:, 0])
    order = np.lexsort((azimuth, ring))
    points, intensity = np.asarray(points[order], np.float64), np.asarray(intensity[order], np.float64)
    rings, azimuth = ring[order].astype(np.int64), azimuth[order]
    range_m = np.linalg.norm(points, axis=1)
    found = [
        _jumps(points, range_m, rings, azimuth),
        _shades(points, range_m, intensity, rings, azimuth),
        *_across_rings(points, range_m, intensity, rings, azimuth, floor),
    ]
    cue = np.repeat(np.arange(len(found), dtype=np.int8), [len(part) for part in found])
    return LidarEdges(np.concatenate(found), cue)


def _between(points: Floats, range_m: Floats, a: NDArray[np.intp], b: NDArray[np.intp], at_m: Floats) -> Floats:
    """Return points (K, 3) at distance ``at_m`` in the directions halfway between points ``a`` and ``b``."""
    middle = points[a] / range_m[a][:, None] + points[b] / range_m[b][:, None]
    return np.asarray(middle * (at_m / np.linalg.norm(middle, axis=1))[:, None])


def _jumps(points: Floats, range_m: Floats, ring: NDArray[np.int64], azimuth: Floats) -> Floats:
    """Find the near side of depth discontinuities along a ring, where the near surface ends in the image too."""
    a = np.arange(max(len(range_m) - 1, 0))
    b = a + 1
    near = np.minimum(range_m[a], range_m[b])
    beside = (ring[a] == ring[b]) & (azimuth[b] - azimuth[a] < math.radians(0.9))
    a = a[beside & (np.abs(range_m[a] - range_m[b]) > np.maximum(0.2, 0.08 * near))]
    return _between(points, range_m, a, a + 1, np.minimum(range_m[a], range_m[a + 1]))


def _shades(points: Floats, range_m: Floats, intensity: Floats, ring: NDArray[np.int64], azimuth: Floats) -> Floats:
    """Find points on one surface where the mean intensities of the three points before and after differ most."""
    if len(range_m) < 7:
        return np.empty((0, 3))
    i = np.arange(3, len(range_m) - 2)
    window = np.stack([range_m[i + k] for k in range(-3, 3)])
    one_surface = window.max(axis=0) - window.min(axis=0) < 0.06 + 0.03 * window.min(axis=0)
    beside = (ring[i - 3] == ring[i + 2]) & (azimuth[i + 2] - azimuth[i - 3] < math.radians(3.0))
    total = np.concatenate([[0.0], np.cumsum(intensity)])
    change = np.abs(total[i + 3] - 2 * total[i] + total[i - 3]) / 3 * (one_surface & beside)
    before, after = np.append(0.0, change[:-1]), np.append(change[1:], 0.0)
    i = i[(change > _INTENSITY_STEP) & (change >= before) & (change > after)]
    return _between(points, range_m, i - 1, i, (range_m[i - 1] + range_m[i]) / 2)


def _across_rings(
    points: Floats,
    range_m: Floats,
    intensity: Floats,
    ring: NDArray[np.int64],
    azimuth: Floats,
    floor: FloorPlane | None,
) -> tuple[Floats, Floats]:
    """Find feet of walls, and intensity steps between neighbouring rings."""
    table = np.full((int(ring.max(initial=0)) + 1, _COLUMNS), -1)
    table[ring, ((azimuth + np.pi) * (_COLUMNS / (2 * np.pi))).astype(np.intp) % _COLUMNS] = np.arange(len(ring))
    low, high = table[:-1].ravel(), table[1:].ravel()
    both = (low >= 0) & (high >= 0)
    low, high = low[both], high[both]
    near = np.minimum(range_m[low], range_m[high])
    one_surface = np.abs(range_m[low] - range_m[high]) < 0.1 + 0.05 * near
    shade = one_surface & (np.abs(intensity[low] - intensity[high]) > 1.5 * _INTENSITY_STEP)
    lying = _between(points, range_m, low[shade], high[shade], near[shade])
    if floor is None:
        return np.empty((0, 3)), lying
    above = points @ floor.normal - floor.height
    out = np.linalg.norm(points - (points @ floor.normal)[:, None] * floor.normal, axis=1)
    # The lower beam hits the floor in front of the wall that the upper beam hits, so the wall meets the floor between
    # them. Wall and plane locate the foot far more accurately than the two degrees between the beams.
    foot = (np.abs(above[low]) < 0.05) & (above[high] > 0.08) & (out[high] > out[low]) & (out[high] < out[low] + 1.0)
    wall = high[foot]
    return points[wall] - above[wall][:, None] * floor.normal, lying


def image_edges(rgb: NDArray[np.uint8], sigma_px: float) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
    """Compute the strengths of a panorama's (H, W, 3) vertical and horizontal edges, (H, W), over their mean.

    Strengths are gradients of the logarithmic brightness, so that dark and bright corners count alike. The strongest
    twentieth is clipped, so that a lamp does not outweigh everything else.
    """
    import cv2

    grey = np.log(cv2.cvtColor(rgb, cv2.COLOR_RGB2GRAY).astype(np.float32) + 12.0)
    grey = np.pad(grey, ((_MARGIN, _MARGIN), (0, 0)), mode="edge")
    grey = cv2.GaussianBlur(np.pad(grey, ((0, 0), (_MARGIN, _MARGIN)), mode="wrap"), (0, 0), 0.7)
    strengths = []
    for dx, dy in ((1, 0), (0, 1)):
        strength = np.abs(cv2.Sobel(grey, cv2.CV_32F, dx, dy, ksize=3))
        strength = np.minimum(strength, max(float(np.percentile(strength, 95)), 1e-6))
        strength = cv2.GaussianBlur(strength / max(float(strength.mean()), 1e-6), (0, 0), sigma_px)
        strengths.append(np.ascontiguousarray(strength[_MARGIN:-_MARGIN, _MARGIN:-_MARGIN]))
    return strengths[0], strengths[1]
