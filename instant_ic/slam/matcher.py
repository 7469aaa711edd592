"""Scan matching against a likelihood field: correlative search, then Gauss-Newton.

The search scores every pose of a window (Olson, Real-time correlative scan matching, ICRA 2009). The refinement
minimises ``Σ (1 − M(T·p))²`` (Kohlbrecher et al., Hector SLAM, 2011). Both use the odometry guess as a Gaussian prior.
Odometry therefore decides along a featureless corridor, where the field is flat.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numba import njit

from instant_ic.geometry.poses import relative2, wrap_angle
from instant_ic.slam.keyframes import turned
from instant_ic.slam.likelihood_field import LikelihoodField
from instant_ic.slam.scan import FloatArray

RESIDUAL_SIGMA = 0.6
"""Standard deviation of ``1 − M`` for a point on its surface. A smaller value trusts the scan more and odometry, which
decides in bare corridors, less."""
ODOMETRY_CUTOFF = 4.0
"""Distance from the guess, in σ, beyond which its cost hardly grows, because odometry may be entirely wrong."""
COARSE_STEP_RAD, FINE_STEP_RAD = 0.02, 0.005
"""Heading steps of the two searches. At 2.5 m, the coarse step is a cell of the field."""
LEAST_INFORMATION = 0.01
"""Information added in 1/m² and 1/rad², which keeps that of a scan along a bare corridor invertible."""
REFINE_ITERATIONS = 20
"""Maximum number of Gauss-Newton steps. They end earlier once the step is below 0.01 mm."""


@njit(cache=True)
def correlate(  # type: ignore[no-untyped-def]
    field, origin, resolution, points, centre, cells, rotations, rotation_step, guess, information, cutoff, gain
):
    """Find the best pose of a window of ``(2·cells + 1)² × (2·rotations + 1)`` poses around ``centre``.

    The value of a pose is ``gain·mean(field at the points) − ½ c²·ln(1 + e²/c²)``. ``e²`` is its squared distance from
    ``guess`` in the metric of ``information``, with translation in the guess's own axes (along and across the direction
    of travel). ``c`` is the ``cutoff``, which limits the cost of a guess that is far off.

    Args:
        field: likelihood field, (H, W) float32.
        origin: centre of cell (0, 0), (2,).
        resolution: metres per cell.
        points: points in the base frame, (n, 2), n > 0.
        centre: field_from_base at the middle of the window, (3,).
        cells: half width of the window in cells.
        rotations: number of rotations to either side of the middle.
        rotation_step: heading step in radians.
        guess: field_from_base, the prior's mean, (3,).
        information: inverse variances of the prior along, across and in rotation, (3,).
        cutoff: distance from the guess beyond which its cost hardly grows, in σ.
        gain: weight of the mean field value against the prior.

    Returns:
        x, y, yaw, value.
    """
    n = points.shape[0]
    size = 2 * cells + 1
    sums = np.empty((size, size), dtype=np.float32)
    cutoff2 = cutoff * cutoff
    best_value = -1e30
    best_x, best_y, best_yaw = centre[0], centre[1], centre[2]
    cos_guess, sin_guess = math.cos(guess[2]), math.sin(guess[2])
    # Search from the middle outwards, so that among equal poses the one nearest to the centre wins.
    for turn in range(2 * rotations + 1):
        r = (turn + 1) // 2 if turn % 2 == 1 else -(turn // 2)
        yaw = centre[2] + r * rotation_step
        _add_field(field, origin, resolution, points, centre[0], centre[1], yaw, sums)
        dyaw = yaw - guess[2]
        turned = information[2] * dyaw * dyaw
        for v in range(size):
            for u in range(size):
                px = centre[0] + (u - cells) * resolution
                py = centre[1] + (v - cells) * resolution
                dx, dy = px - guess[0], py - guess[1]
                along = cos_guess * dx + sin_guess * dy
                across = -sin_guess * dx + cos_guess * dy
                squared = turned + information[0] * along * along + information[1] * across * across
                value = gain * sums[v, u] / n - 0.5 * cutoff2 * math.log1p(squared / cutoff2)
                if value > best_value + 1e-9:
                    best_value = value
                    best_x, best_y, best_yaw = px, py, yaw
    return best_x, best_y, best_yaw, best_value


@njit(cache=True)
def _add_field(field, origin, resolution, points, x0, y0, yaw, sums):  # type: ignore[no-untyped-def]
    """Set ``sums`` (2·cells + 1, 2·cells + 1) to the sum of the field over the points for translations about x0, y0."""
    height, width = field.shape
    size = sums.shape[0]
    cells = size // 2
    cos_yaw, sin_yaw = math.cos(yaw), math.sin(yaw)
    sums[:] = 0.0
    for i in range(points.shape[0]):
        x = x0 + cos_yaw * points[i, 0] - sin_yaw * points[i, 1]
        y = y0 + sin_yaw * points[i, 0] + cos_yaw * points[i, 1]
        ix = round((x - origin[0]) / resolution) - cells
        iy = round((y - origin[1]) / resolution) - cells
        if ix < 0 or iy < 0 or ix + size > width or iy + size > height:
            continue
        for v in range(size):
            for u in range(size):
                sums[v, u] += field[iy + v, ix + u]


@njit(cache=True)
def _normal_equations(  # type: ignore[no-untyped-def]
    field, origin, resolution, points, pose, guess, information, weight, hessian, gradient
):
    """Compute ``hessian`` (3, 3) and ``gradient`` (3,) of the Gauss-Newton system at ``pose``, in place.

    Returns:
        The cost, the mean field value over the points, the sum of squared residuals.
    """
    height, width = field.shape
    n = points.shape[0]
    cos_yaw, sin_yaw = math.cos(pose[2]), math.sin(pose[2])
    hessian[:] = 0.0
    gradient[:] = 0.0
    score = 0.0
    squares = 0.0
    for i in range(n):
        rx = cos_yaw * points[i, 0] - sin_yaw * points[i, 1]
        ry = sin_yaw * points[i, 0] + cos_yaw * points[i, 1]
        x = (pose[0] + rx - origin[0]) / resolution
        y = (pose[1] + ry - origin[1]) / resolution
        ix, iy = math.floor(x), math.floor(y)
        if ix < 0 or iy < 0 or ix + 1 >= width or iy + 1 >= height:
            squares += 1.0
            continue
        fx, fy = x - ix, y - iy
        m00, m10 = field[iy, ix], field[iy, ix + 1]
        m01, m11 = field[iy + 1, ix], field[iy + 1, ix + 1]
        value = (1 - fy) * ((1 - fx) * m00 + fx * m10) + fy * ((1 - fx) * m01 + fx * m11)
        gx = ((1 - fy) * (m10 - m00) + fy * (m11 - m01)) / resolution
        gy = ((1 - fx) * (m01 - m00) + fx * (m11 - m10)) / resolution
        residual = 1.0 - value
        score += value
        squares += residual * residual
        jyaw = -gx * ry + gy * rx
        gradient[0] -= gx * residual
        gradient[1] -= gy * residual
        gradient[2] -= jyaw * residual
        hessian[0, 0] += gx * gx
        hessian[0, 1] += gx * gy
        hessian[0, 2] += gx * jyaw
        hessian[1, 1] += gy * gy
        hessian[1, 2] += gy * jyaw
        hessian[2, 2] += jyaw * jyaw
    hessian *= weight
    gradient *= weight
    prior = _add_prior(pose, guess, information, hessian, gradient)
    return 0.5 * weight * squares + 0.5 * prior, score / n, squares


@njit(cache=True)
def _add_prior(pose, guess, information, hessian, gradient):  # type: ignore[no-untyped-def]
    """Add the prior, rotated from the guess's axes into the field's, to the Gauss-Newton system. Return its cost."""
    cos_guess, sin_guess = math.cos(guess[2]), math.sin(guess[2])
    pxx = information[0] * cos_guess * cos_guess + information[1] * sin_guess * sin_guess
    pyy = information[0] * sin_guess * sin_guess + information[1] * cos_guess * cos_guess
    pxy = (information[0] - information[1]) * cos_guess * sin_guess
    dx, dy, dyaw = pose[0] - guess[0], pose[1] - guess[1], pose[2] - guess[2]
    gradient[0] += pxx * dx + pxy * dy
    gradient[1] += pxy * dx + pyy * dy
    gradient[2] += information[2] * dyaw
    hessian[0, 0] += pxx
    hessian[0, 1] += pxy
    hessian[1, 1] += pyy
    hessian[2, 2] += information[2]
    hessian[1, 0] = hessian[0, 1]
    hessian[2, 0] = hessian[0, 2]
    hessian[2, 1] = hessian[1, 2]
    return pxx * dx * dx + 2 * pxy * dx * dy + pyy * dy * dy + information[2] * dyaw * dyaw


@njit(cache=True)
def _solve(hessian, gradient, damping):  # type: ignore[no-untyped-def]
    """Solve the damped system by Cramer's rule. The step is zero if the system is singular."""
    a = hessian[0, 0] * (1 + damping)
    b, c = hessian[0, 1], hessian[0, 2]
    d = hessian[1, 1] * (1 + damping)
    e = hessian[1, 2]
    f = hessian[2, 2] * (1 + damping)
    step = np.zeros(3)
    det = a * (d * f - e * e) - b * (b * f - c * e) + c * (b * e - c * d)
    if abs(det) < 1e-12:
        return step
    g0, g1, g2 = -gradient[0], -gradient[1], -gradient[2]
    step[0] = (g0 * (d * f - e * e) - b * (g1 * f - e * g2) + c * (g1 * e - d * g2)) / det
    step[1] = (a * (g1 * f - e * g2) - g0 * (b * f - c * e) + c * (b * g2 - g1 * c)) / det
    step[2] = (a * (d * g2 - g1 * e) - b * (b * g2 - g1 * c) + g0 * (b * e - c * d)) / det
    return step


@njit(cache=True)
def refine(field, origin, resolution, points, start, guess, information, weight, iterations, reach, turn):  # type: ignore[no-untyped-def]
    """Minimise ``½ weight Σ(1 − M)² + ½ eᵀ·diag(information)·e`` by Levenberg-Marquardt from ``start`` (3,).

    The result stays within ``reach`` metres of ``start`` along x and y and within ``turn`` radians, because the search
    has already rejected everything beyond.

    Returns:
        The pose (3,), the Hessian there (3, 3), the mean field value, the sum of squared residuals.
    """
    pose = start.copy()
    hessian = np.zeros((3, 3))
    gradient = np.zeros(3)
    trial_hessian = np.zeros((3, 3))
    trial_gradient = np.zeros(3)
    cost, score, squares = _normal_equations(
        field, origin, resolution, points, pose, guess, information, weight, hessian, gradient
    )
    damping = 1e-3
    for _ in range(iterations):
        step = _solve(hessian, gradient, damping)
        trial = pose + step
        trial_cost, trial_score, trial_squares = _normal_equations(
            field, origin, resolution, points, trial, guess, information, weight, trial_hessian, trial_gradient
        )
        far = abs(trial[0] - start[0]) > reach or abs(trial[1] - start[1]) > reach or abs(trial[2] - start[2]) > turn
        if trial_cost < cost and not far:
            pose, cost, score, squares = trial, trial_cost, trial_score, trial_squares
            hessian[:] = trial_hessian
            gradient[:] = trial_gradient
            damping = max(damping * 0.3, 1e-6)
        else:
            damping *= 10.0
            if damping > 1e4:
                break
        if abs(step[0]) + abs(step[1]) < 1e-5 and abs(step[2]) < 1e-6:
            break
    return pose, hessian, score, squares


@dataclass(frozen=True)
class SearchWindow:
    """Half widths of a search, in metres and radians."""

    translation_m: float
    rotation_rad: float


@dataclass(frozen=True)
class Match:
    """Pose at which a scan fits.

    Attributes:
        pose: field_from_base, (3,).
        covariance: covariance of the pose in the field's frame, (3, 3).
        score: mean field value over the points, 0..1.
        at_border: true if the search ended at the edge of its window, so that a better pose may lie outside.
        scan_covariance: covariance from the scan alone, without the guess, in the field's frame, (3, 3).
    """

    pose: FloatArray
    covariance: FloatArray
    score: float
    at_border: bool
    scan_covariance: FloatArray


def match_scan(
    field: LikelihoodField, points: FloatArray, guess: FloatArray, sigma: FloatArray, window: SearchWindow
) -> Match:
    """Find the pose of a scan in a likelihood field, within a window around a guess.

    Args:
        field: the local map.
        points: points of the scan in the base frame, (n, 2), n > 0.
        guess: predicted field_from_base, (3,).
        sigma: standard deviations of the guess along, across and in rotation, (3,).
        window: half widths of the search around the guess.
    """
    information = 1.0 / np.square(sigma)
    weight = 1.0 / RESIDUAL_SIGMA**2
    gain = weight * len(points)
    resolution = field.resolution
    cells = math.ceil(window.translation_m / resolution)
    rotations = math.ceil(window.rotation_rad / COARSE_STEP_RAD)
    x, y, yaw, _ = correlate(
        field.values, field.origin, resolution, points, guess, cells, rotations, COARSE_STEP_RAD, guess, information,
        ODOMETRY_CUTOFF, gain,
    )  # fmt: skip
    at_border = (
        max(abs(x - guess[0]), abs(y - guess[1])) > (cells - 0.5) * resolution
        or abs(yaw - guess[2]) > (rotations - 0.5) * COARSE_STEP_RAD
    )
    finer = math.ceil(COARSE_STEP_RAD / FINE_STEP_RAD) - 1
    x, y, yaw, _ = correlate(
        field.values, field.origin, resolution, points, np.array([x, y, yaw]), 1, finer, FINE_STEP_RAD, guess,
        information, ODOMETRY_CUTOFF, gain,
    )  # fmt: skip
    # During refinement, keep the prior's weight at the best pose of the search.
    error = relative2(guess, np.array([x, y, yaw]))
    information = information / (1.0 + float(information @ error**2) / ODOMETRY_CUTOFF**2)
    pose, hessian, score, squares = refine(
        field.values, field.origin, resolution, points, np.array([x, y, yaw]), guess, information, weight,
        REFINE_ITERATIONS, 3 * resolution, 2 * COARSE_STEP_RAD,
    )  # fmt: skip
    # Scale the covariance by the residuals, so that a poor fit gets a wide one.
    variance = max(squares / max(len(points) - 3, 1), 1e-3) * weight
    covariance = variance * np.linalg.inv(hessian)
    scan_information = hessian - turned(np.diag(information), float(guess[2])) + LEAST_INFORMATION * np.eye(3)
    scan_covariance = variance * np.linalg.inv(scan_information)
    pose[2] = wrap_angle(float(pose[2]))
    return Match(pose, 0.5 * (covariance + covariance.T), float(score), bool(at_border), scan_covariance)
