"""Estimates camera_from_lidar from edges that both see: first the yaw around the full circle, then all six parameters.

The edges of each LiDAR revolution (``calibration.edges``) are projected into the panorama of the same moment. The
calibration is the pose under which they fall on the strongest image edges over all frames. The image edges are blurred,
less from level to level, so that the score rises smoothly to its maximum. The method follows Levinson and Thrun (RSS
2013). The foot of the walls is an additional cue, because rings two degrees apart locate horizontal edges poorly.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from instant_ic.calibration.edges import CUES, UPRIGHT, find_floor, image_edges, lidar_edges
from instant_ic.geometry.poses import Matrix, pose_matrix, transform_points

Floats = NDArray[np.floating]
_SECTORS = 16
AXES = ("x", "y", "z", "roll", "pitch", "yaw")
_WEIGHTS = {"jump": 1.0, "shade": 1.0, "floor": 0.5, "shade_across": 0.25}
_SYSTEMATIC = np.array([0.01] * 3 + [math.radians(0.1)] * 3)
"""Measured systematic error, which the scatter does not show. Causes are skirting boards in front of their walls and
rounded edges."""
_PLACES_FOR_HEIGHT, _UNCHECKED_HEIGHT = 3, 5.0
"""With fewer places, the upper edge of a skirting board can pass for the foot of its wall; z then gets an additional
standard deviation of this many units."""
_RIVAL_REACH = 12
"""Search radius for other maxima, in units: 12 cm, 2.4 degrees."""
_UNIT = np.array([0.01] * 3 + [math.radians(0.2)] * 3)
"""Unit of the search: a centimetre, and the angle that moves an edge 3 m away by about as much."""
_REACH_M, _REACH_DEG = 0.15, 5.0
"""Standard deviations of the given pose; a weak prior for directions without other evidence."""
_MOST_SIGMA_M, _MOST_SIGMA_DEG = 0.03, 0.5
"""A direction with a larger standard deviation is not constrained and keeps its given value."""
_MIN_EDGES = 500


class CalibrationError(ValueError):
    """The recording does not yield a calibration; the text says why and what to record."""


@dataclass(frozen=True)
class CalibrationFrame:
    """Panorama and revolution of the same moment.

    Attributes:
        rgb: (H, W, 3) uint8 panorama.
        points: (N, 3) in the LiDAR's frame at the time of the image, metres, finite.
        intensity: (N,).
        ring: number of the laser, from the lowest upwards, (N,).
        place: number of the place; frames of one place see the same things and count once in the uncertainty.
    """

    rgb: NDArray[np.uint8]
    points: Floats
    intensity: Floats
    ring: NDArray[np.integer]
    place: int = 0


@dataclass(frozen=True)
class Calibration:
    """Result of the calibration.

    Attributes:
        camera_from_lidar: (4, 4).
        sigma: standard deviations in x, y, z (metres), roll, pitch, yaw (radians) in the camera's frame, (6,).
        constrained: whether the recording constrains each of them, (6,); the others keep their given values.
        score_before, score_after: mean strength of the image edges under the LiDAR's edges; 1 is the level of chance.
        edges: number of edge points used, by cue.
        yaw_rival: score of the best yaw more than 20 degrees away divided by the best score, both above chance. Near 1,
            the place looks alike in two directions.
    """

    camera_from_lidar: Matrix
    sigma: NDArray[np.float64]
    constrained: NDArray[np.bool_]
    score_before: float
    score_after: float
    edges: dict[str, int]
    yaw_rival: float


@dataclass(frozen=True)
class _Edges:
    """LiDAR edges of all frames, and the block of each edge in the uncertainty estimate."""

    points: NDArray[np.float64]
    frame: NDArray[np.intp]
    upright: NDArray[np.bool_]
    weight: NDArray[np.float64]
    block: NDArray[np.intp]
    counts: dict[str, int]


class _EdgeLevel:
    """Score of a pose at one blur level of the image edges."""

    def __init__(self, edges: _Edges, frames: Sequence[CalibrationFrame], blur_px: float) -> None:
        sigma_px = blur_px * frames[0].rgb.shape[1] / 1024.0
        # A strongly blurred image needs fewer pixels.
        smaller = 2 ** max(int(math.log2(sigma_px / 2)), 0) if sigma_px >= 4 else 1
        strengths = [image_edges(_reduced(frame.rgb, smaller), sigma_px / smaller) for frame in frames]
        stack = np.stack([pair[kind] for kind in (0, 1) for pair in strengths])
        # One extra column, so that a point on the seam is interpolated between the last and the first column.
        self.strengths = np.ascontiguousarray(np.concatenate([stack, stack[:, :, :1]], axis=2))
        self.edges = edges
        self.plane = (edges.frame + np.where(edges.upright, 0, len(frames))).astype(np.int64)

    def each(self, camera_from_lidar: Matrix) -> NDArray[np.float64]:
        """Return the weighted strength under each edge point, (N,)."""
        from scipy.ndimage import map_coordinates

        height, width = self.strengths.shape[1], self.strengths.shape[2] - 1
        x, y, z = transform_points(camera_from_lidar, self.edges.points).T
        u = ((np.pi - np.arctan2(y, x)) * (width / (2 * np.pi)) - 0.5) % width
        v = (np.pi / 2 - np.arctan2(z, np.hypot(x, y))) * (height / np.pi) - 0.5
        strength = map_coordinates(self.strengths, (self.plane, v, u), np.float64, order=1, mode="nearest")
        return np.asarray(self.edges.weight * strength)

    def score(self, camera_from_lidar: Matrix) -> float:
        """Return the weighted mean strength under the edge points."""
        return float(self.each(camera_from_lidar).sum() / self.edges.weight.sum())


def _reduced(rgb: NDArray[np.uint8], factor: int) -> NDArray[np.uint8]:
    import cv2

    height, width = rgb.shape[:2]
    small = cv2.resize(rgb, (width // factor, height // factor), interpolation=cv2.INTER_AREA)
    return np.asarray(small, np.uint8)


def calibrate(
    frames: Sequence[CalibrationFrame],
    camera_from_lidar: Matrix,
    full_circle: bool = True,
    report: Callable[[str], None] = lambda line: None,
    blur_px: Sequence[float] = (8.0, 4.0, 2.0, 1.0),
    yaw_step_deg: float = 2.0,
) -> Calibration:
    """Estimate the pose of the LiDAR in the camera's frame.

    Args:
        frames: pairs of image and revolution, preferably from many places.
        camera_from_lidar: (4, 4) measured by hand; with ``full_circle`` the yaw may be far off.
        full_circle: whether to search the full circle; false if the given yaw is right within a few degrees.
        report: called with progress messages.
        blur_px: blur of the image edges at each level, for 1024 columns.
        yaw_step_deg: step of the yaw search around the full circle.

    Raises:
        CalibrationError: no frames, too few edges, or no pose fits better than chance.
    """
    edges = _edges(frames, camera_from_lidar)
    report(f"{len(frames)} frames, edges: " + ", ".join(f"{count} {cue}" for cue, count in edges.counts.items()))
    start, rival = camera_from_lidar, 0.0
    level = _EdgeLevel(edges, frames, blur_px[0])
    if full_circle:
        start, rival = _around(level, camera_from_lidar, yaw_step_deg)
        report(f"yaw {correction(camera_from_lidar, start)[5] / math.radians(1):+.1f} deg around the full circle")
    found = start
    for number, blur in enumerate(blur_px):
        level = level if number == 0 else _EdgeLevel(edges, frames, blur)
        found = _climb(level, start, found)
        report(f"blur {blur:g} px: score {level.score(found):.3f}")
    found, rivals = _among_rivals(level, start, found)
    for other in rivals:
        shift = correction(found, other)
        centimetres = ", ".join(f"{value:+.1f}" for value in shift[:3] * 100)
        report(f"a pose {centimetres} cm away fits as well")
    before, after = _above_chance(level, camera_from_lidar, found)
    covariance = _covariance(level, found)
    if len({frame.place for frame in frames}) < _PLACES_FOR_HEIGHT:
        covariance[2, 2] += _UNCHECKED_HEIGHT**2
    for other in rivals:  # either pose may be the true one: the error is nothing or the whole difference
        shift = correction(found, other) / _UNIT
        covariance += 0.5 * np.outer(shift, shift)
    units = correction(start, found) / _UNIT
    values, vectors = np.linalg.eigh(covariance)
    limit = np.array([_MOST_SIGMA_M] * 3 + [math.radians(_MOST_SIGMA_DEG)] * 3)
    loose = vectors[:, np.sqrt(values) > (limit / _UNIT).max()]
    units = units - loose @ (loose.T @ units)
    sigma = np.hypot(np.sqrt(np.diag(covariance)) * _UNIT, _SYSTEMATIC)
    return Calibration(
        camera_from_lidar=_moved(start, units),
        sigma=sigma,
        constrained=sigma <= limit,
        score_before=before,
        score_after=after,
        edges=edges.counts,
        yaw_rival=rival,
    )


def _edges(frames: Sequence[CalibrationFrame], camera_from_lidar: Matrix) -> _Edges:
    """Find the LiDAR's edges in all frames.

    Raises:
        CalibrationError: no frames, images of different sizes, or too few edges.
    """
    if not frames:
        raise CalibrationError("no pair of image and LiDAR revolution")
    if len({frame.rgb.shape for frame in frames}) != 1:
        raise CalibrationError(f"images have different sizes: {sorted({frame.rgb.shape for frame in frames})}")
    floor = find_floor(np.concatenate([frame.points[::7] for frame in frames]))
    found = [lidar_edges(f.points, f.intensity, f.ring, floor) for f in frames]
    cue = np.concatenate([edges.cue for edges in found])
    counts = {name: int((cue == k).sum()) for k, name in enumerate(CUES)}
    if len(cue) < _MIN_EDGES:
        raise CalibrationError(
            f"only {len(cue)} edge points in {len(frames)} frames, {_MIN_EDGES} are needed. "
            "Record in a furnished room, from several places."
        )
    points = np.concatenate([edges.points for edges in found]).astype(np.float64)
    number = np.repeat(np.arange(len(frames)), [len(edges.cue) for edges in found])
    # Edges of one direction at one place are one sample, because their errors are correlated.
    place = np.array([frame.place for frame in frames])[number]
    in_camera = transform_points(camera_from_lidar, points)
    azimuth = np.arctan2(in_camera[:, 1], in_camera[:, 0])
    sector = ((azimuth + np.pi) * (_SECTORS / (2 * np.pi))).astype(np.intp) % _SECTORS
    upright = np.isin(cue, [CUES.index(name) for name in UPRIGHT])
    block = np.unique((place * _SECTORS + sector) * 2 + upright, return_inverse=True)[1].astype(np.intp)
    return _Edges(
        points=points,
        frame=number,
        upright=upright,
        weight=np.array([_WEIGHTS[name] for name in CUES])[cue],
        block=block,
        counts=counts,
    )


def _above_chance(level: _EdgeLevel, before: Matrix, after: Matrix) -> tuple[float, float]:
    """Return the scores of two poses, relative to the mean over wrong yaws.

    Raises:
        CalibrationError: the second pose fits no better than chance.
    """
    chance = float(np.mean([level.score(_turned(after, yaw)) for yaw in np.radians(np.arange(15, 360, 15))]))
    chance = max(chance, 1e-9)  # an image without any edge
    ratio = level.score(after) / chance
    if ratio < 1.05:
        raise CalibrationError(
            f"no pose aligns the LiDAR's edges with the image edges better than chance ({ratio:.2f} times). Record in "
            "a lit, furnished room, and check that the stamps of images and LiDAR match."
        )
    return level.score(before) / chance, ratio


def _turned(camera_from_lidar: Matrix, yaw_rad: float) -> Matrix:
    """Turn the camera about its vertical axis."""
    return pose_matrix(yaw=yaw_rad) @ camera_from_lidar


def _moved(camera_from_lidar: Matrix, units: Floats) -> Matrix:
    """Apply a small motion (6,), in ``_UNIT`` in the camera's frame, to the pose."""
    step = np.asarray(units) * _UNIT
    change = np.eye(4)
    change[:3, :3] = Rotation.from_rotvec(step[3:]).as_matrix()
    change[:3, 3] = step[:3]
    return np.asarray(change @ camera_from_lidar)


def correction(before: Matrix, after: Matrix) -> NDArray[np.float64]:
    """Return the motion (6,) from one pose to another in the camera's frame, metres and radians."""
    change = after @ np.linalg.inv(before)
    return np.concatenate([change[:3, 3], Rotation.from_matrix(change[:3, :3]).as_rotvec()])


def _around(level: _EdgeLevel, camera_from_lidar: Matrix, step_deg: float) -> tuple[Matrix, float]:
    """Return the pose with the best yaw of the full circle, and the score ratio of its closest rival."""
    count = round(360 / step_deg)
    yaws = np.arange(count) * (2 * np.pi / count)
    scores = np.array([level.score(_turned(camera_from_lidar, yaw)) for yaw in yaws])
    best = int(np.argmax(scores))
    apart = np.abs((yaws - yaws[best] + np.pi) % (2 * np.pi) - np.pi)
    usual = float(np.median(scores))
    rival = float(scores[apart > math.radians(20)].max() - usual) / max(float(scores[best]) - usual, 1e-9)
    return _turned(camera_from_lidar, float(yaws[best])), max(rival, 0.0)


def _climb(level: _EdgeLevel, start: Matrix, found: Matrix) -> Matrix:
    """Return the pose of the highest score near ``found``, with a weak prior towards ``start``."""
    from scipy.optimize import minimize

    reach = np.array([_REACH_M] * 3 + [math.radians(_REACH_DEG)] * 3) / _UNIT
    base = max(level.score(found), 1e-9)

    def cost(units: Floats) -> float:
        return -level.score(_moved(start, units)) / base + 0.005 * float(((units / reach) ** 2).sum())

    def slope(units: Floats) -> NDArray[np.float64]:
        # A third of a unit, because smaller differences would show the steps of bilinear interpolation.
        steps = np.eye(6) / 3
        return np.array([(cost(units + step) - cost(units - step)) * 1.5 for step in steps])

    first = correction(start, found) / _UNIT
    result = minimize(cost, first, jac=slope, method="BFGS", options={"gtol": 2e-4, "maxiter": 25})
    return _moved(start, result.x)


def _among_rivals(level: _EdgeLevel, start: Matrix, found: Matrix) -> tuple[Matrix, list[Matrix]]:
    """Select the maximum; also return other maxima that fit as well, because parallel edges can be confused.

    With a camera height that is too low, the foot of a wall falls on the upper edge of its skirting board. From several
    places only one of the two heights fits; from one place both may. Among maxima that the scatter over the blocks
    cannot distinguish, the one nearest to the given pose is selected.
    """
    peaks = []
    for axis in np.eye(6):
        offsets = np.arange(-_RIVAL_REACH, _RIVAL_REACH + 1)
        scores = np.array([level.score(_moved(found, k * axis)) for k in offsets])
        for k in range(1, len(offsets) - 1):
            if abs(offsets[k]) >= 3 and scores[k] >= max(scores[k - 1], scores[k + 1], 0.9 * scores[_RIVAL_REACH]):
                peaks.append((scores[k], _moved(found, offsets[k] * axis)))
    peaks.sort(key=lambda peak: -peak[0])
    maxima = [found]
    up_and_down = [_moved(found, k * np.eye(6)[2]) for k in (-8, 8)]
    for pose in [pose for _, pose in peaks[:2]] + up_and_down:
        other = _climb(level, start, pose)
        if all(np.abs(correction(known, other) / _UNIT).max() > 2 for known in maxima):
            maxima.append(other)
    best = max(maxima, key=level.score)
    tied = [other for other in maxima if other is best or _difference(level, best, other) < 3.0]
    tied.sort(key=lambda pose: float(np.linalg.norm(correction(start, pose) / _UNIT)))
    return tied[0], tied[1:]


def _difference(level: _EdgeLevel, best: Matrix, other: Matrix) -> float:
    """Return the score difference between two poses in standard deviations of the scatter over the blocks."""
    apart = np.bincount(level.edges.block, level.each(best) - level.each(other))
    return float(apart.sum() / max(float(np.sqrt((apart**2).sum())), 1e-12))


def _covariance(level: _EdgeLevel, found: Matrix) -> NDArray[np.float64]:
    """Return the covariance (6, 6) of the maximum in ``_UNIT``: H^-1 G H^-1, G the scatter of block gradients."""
    edges, step = level.edges, 1.0

    def at(units: Floats) -> NDArray[np.float64]:
        return np.asarray(np.bincount(edges.block, level.each(_moved(found, units))), np.float64)

    unit = np.eye(6) * step
    centre = at(np.zeros(6))
    ahead, back = [at(d) for d in unit], [at(-d) for d in unit]
    gradients = np.stack([(a - b) / (2 * step) for a, b in zip(ahead, back, strict=True)], axis=1)
    hessian = np.empty((6, 6))
    for i in range(6):
        hessian[i, i] = (2 * centre - ahead[i] - back[i]).sum() / step**2
        for j in range(i):
            mixed = at(unit[i] + unit[j]) + at(-unit[i] - unit[j]) - at(unit[i] - unit[j]) - at(unit[j] - unit[i])
            hessian[i, j] = hessian[j, i] = -mixed.sum() / (4 * step**2)
    blocks = len(centre)
    scatter = gradients.T @ gradients * (blocks / max(blocks - 6, 1e-3))
    values, vectors = np.linalg.eigh(hessian)
    # A direction in which the score does not fall has no information.
    values = np.maximum(values, 1e-3 * max(float(values.max()), 1e-9))
    inverse = vectors @ np.diag(1 / values) @ vectors.T
    return np.asarray(inverse @ scatter @ inverse)
