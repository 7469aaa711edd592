"""Likelihood field and matcher against a box room whose exact scans the test computes itself."""

from __future__ import annotations

import math

import numpy as np
import pytest
from slam_planar_world import PlanarWorld, box_room, corridor

from instant_ic.slam.config import MatchConfig
from instant_ic.slam.likelihood_field import FieldSurface, LikelihoodField
from instant_ic.slam.matcher import SearchWindow, match_scan
from instant_ic.slam.scan import ScanPoints, scan_points, thin

WIDE = np.array([0.3, 0.3, 0.3])


def points_at(world: PlanarWorld, pose: list[float], noise_m: float = 0.0, stamp: int = 1) -> ScanPoints:
    return scan_points(world.scan(np.array(pose), stamp, noise_m=noise_m), np.zeros(3))


def field_of(world: PlanarWorld, *poses: list[float], noise_m: float = 0.0) -> LikelihoodField:
    field = LikelihoodField(0.05, 25.0 + 1.7)
    surfaces = []
    for index, pose in enumerate(poses):
        points = points_at(world, pose, noise_m, stamp=index + 1)
        surfaces.append(FieldSurface(np.array(pose), points.points, points.joined))
    field.rebuild(np.array(poses[-1]), surfaces)
    return field


def match_points(points: ScanPoints) -> np.ndarray:
    return thin(points.points, points.joined, MatchConfig().max_points)


def value_at(field: LikelihoodField, x: float, y: float) -> float:
    column, row = np.round((np.array([x, y]) - field.origin) / field.resolution).astype(int)
    return float(field.values[row, column])


def test_field_is_a_gaussian_of_the_distance_to_the_wall() -> None:
    field = field_of(box_room(), [0.0, 0.0, 0.0])
    # The wall x = 4; exp(−d²/2σ²) with σ = 0.06 at 0, 5 and 10 cm, which are centres of cells.
    assert value_at(field, 4.0, 0.5) == pytest.approx(1.0, abs=0.02)
    assert value_at(field, 3.95, 0.5) == pytest.approx(math.exp(-0.5 * (0.05 / 0.06) ** 2), abs=0.03)
    assert value_at(field, 3.90, 0.5) == pytest.approx(math.exp(-0.5 * (0.10 / 0.06) ** 2), abs=0.03)
    assert value_at(field, 3.0, 0.0) == 0.0


def test_noisy_hits_are_averaged_to_one_surface() -> None:
    # Twenty scans with 2 cm of noise: the ridge stays a Gaussian of σ 6 cm round the true wall, no plateau.
    field = field_of(box_room(), *[[0.02 * k, 0.0, 0.0] for k in range(20)], noise_m=0.02)
    for y in (-0.5, 0.0, 0.5):
        assert value_at(field, 4.0, y) > 0.95
        assert value_at(field, 3.90, y) < 0.40  # 0.25 by the formula; 0.64 where the nearest stray hit counts


@pytest.mark.parametrize("moved", [[0.0, 0.0, 0.0], [-0.13, 0.21, -0.23], [0.28, 0.28, 0.0]])
def test_a_scan_moved_and_turned_by_known_amounts_is_found(moved: list[float]) -> None:
    room = box_room()
    field = field_of(room, [0.0, 0.0, 0.0])
    match = match_scan(field, match_points(points_at(room, moved)), np.zeros(3), WIDE, SearchWindow(0.35, 0.35))
    assert np.hypot(*(match.pose[:2] - moved[:2])) < 0.01
    assert abs(match.pose[2] - moved[2]) < 0.003
    assert match.score > 0.9


def test_a_heading_near_half_a_turn_is_wrapped() -> None:
    room = box_room()
    field = field_of(room, [0.0, 0.0, math.pi - 0.01])
    match = match_scan(
        field, match_points(points_at(room, [0.0, 0.0, -math.pi + 0.02])), np.array([0.0, 0.0, math.pi - 0.01]), WIDE,
        SearchWindow(0.1, 0.1),
    )  # fmt: skip
    assert match.pose[2] == pytest.approx(-math.pi + 0.02, abs=0.003)


def test_covariance_is_wide_along_a_corridor_and_narrow_across() -> None:
    world = corridor()
    field = field_of(world, [0.0, 0.0, 0.0], noise_m=0.01)
    sigma = np.array([0.05, 0.05, 0.05])
    match = match_scan(
        field, match_points(points_at(world, [0.02, 0.0, 0.0], 0.01, 7)), np.zeros(3), sigma, SearchWindow(0.1, 0.1)
    )
    along, across = np.sqrt(np.diag(match.covariance)[:2])
    assert along > 3 * across
    room = box_room()
    match = match_scan(
        field_of(room, [0.0, 0.0, 0.0]), match_points(points_at(room, [0.02, 0.0, 0.0])), np.zeros(3), sigma,
        SearchWindow(0.1, 0.1),
    )  # fmt: skip
    assert np.sqrt(np.diag(match.covariance)[:2]).max() < 0.01
    assert np.linalg.eigvalsh(match.covariance).min() > 0


def test_the_prior_decides_along_a_corridor_even_when_the_guess_is_off_across() -> None:
    world = corridor()
    field = field_of(world, *[[0.25 * k, 0.0, 0.0] for k in range(-8, 1)], noise_m=0.01)
    points = match_points(points_at(world, [0.1, 0.0, 0.0], 0.01, 99))
    guess = np.array([0.1, 0.08, 0.05])
    match = match_scan(field, points, guess, np.array([0.02, 0.1, 0.05]), SearchWindow(0.3, 0.2))
    assert abs(match.pose[0] - 0.1) < 0.03
    assert abs(match.pose[1]) < 0.01
    assert abs(match.pose[2]) < 0.005
