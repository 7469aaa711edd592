"""Covered sectors of the sensor: found in the sensor's frame, while the robot stands, drives and turns."""

from __future__ import annotations

import math

import numpy as np
import pytest

from instant_ic.lidar.cover import SECTORS, CoverWatch
from instant_ic.lidar.decode import POINT_DTYPE
from instant_ic.lidar.packets import LASERS
from instant_ic.lidar.stream import Revolution
from instant_ic.util.diagnosis import Level

FIRINGS = 900
HERE = np.zeros(3)


def revolution(number: int, share: np.ndarray, range_m: float = 3.0, measured: np.ndarray | None = None) -> Revolution:
    """A revolution with returns of ``share`` (72,) of the rays of each sector; ``measured`` (72,): with firings."""
    azimuth = (np.arange(FIRINGS) + 0.5) * 2.0 * math.pi / FIRINGS
    sector = (azimuth * SECTORS / (2.0 * math.pi)).astype(int)
    if measured is not None:
        azimuth, sector = azimuth[measured[sector]], sector[measured[sector]]
    rays = np.arange(LASERS)[None, :] < np.round(share[sector] * LASERS)[:, None]
    angle = np.repeat(azimuth, rays.sum(axis=1))
    points = np.zeros(len(angle), POINT_DTYPE)
    points["x"], points["y"] = range_m * np.cos(angle), -range_m * np.sin(angle)
    stamp_ns, time = number * 100_000_000, np.linspace(0.0, 0.1, len(azimuth), dtype=np.float32)
    nothing = np.zeros(len(azimuth), np.bool_)
    return Revolution(points, azimuth.astype(np.float32), time, nothing, 0.1, stamp_ns, stamp_ns + 100_000_000, True)


def shares(**sectors: float) -> np.ndarray:
    """0.6 everywhere, except in the sectors that are named: ``s4=0.0``."""
    values = np.full(SECTORS, 0.6)
    for name, value in sectors.items():
        values[int(name[1:])] = value
    return values


COVERED = shares(**{f"s{k}": 0.0 for k in range(10, 18)})


def test_a_cover_is_found_at_once_and_lifted_at_once() -> None:
    watch = CoverWatch()
    for k in range(10):
        watch.update(revolution(k, shares()), HERE)
        assert not watch.covered.any() and watch.diagnosis.level is Level.OK
    for k in range(10, 200):
        watch.update(revolution(k, COVERED), HERE)
        assert np.flatnonzero(watch.covered).tolist() == list(range(10, 18))
    assert "40° of the circle, from 50° on (clockwise from ahead)" in watch.diagnosis.text
    watch.update(revolution(200, shares()), HERE)
    assert not watch.covered.any()


@pytest.mark.parametrize("step", [(0.0, 0.0, 0.1), (0.04, 0.0, 0.0)])
def test_a_tape_on_the_sensor_stays_found_while_the_robot_moves(step: tuple[float, float, float]) -> None:
    watch, pose = CoverWatch(), np.zeros(3)
    for k in range(100):
        pose = pose + np.array(step)
        watch.update(revolution(k, shares() if k < 10 else COVERED), pose)
    assert np.flatnonzero(watch.covered).tolist() == list(range(10, 18))


def test_open_space_that_comes_gradually_or_by_a_turn_is_no_cover() -> None:
    watch = CoverWatch()
    for k in range(60):  # out of a hall, at 0.4 m/s
        share = shares(**{f"s{s}": max(0.0, 0.6 - 0.015 * k) for s in range(60, 70)})
        watch.update(revolution(k, share), np.array([0.04 * k, 0.0, 0.0]))
        assert not watch.covered.any(), k
    watch, open_side = CoverWatch(), shares(**{f"s{k}": 0.0 for k in range(20, 40)})
    for k in range(100):  # a robot beside a quay turns at 1 rad/s
        yaw = 0.1 * k
        watch.update(revolution(k, np.roll(open_side, round(yaw * SECTORS / (2 * math.pi)))), np.array([0, 0, yaw]))
        assert not watch.covered.any(), k


def test_what_was_not_measured_is_neither_covered_nor_free() -> None:
    watch = CoverWatch()
    seen = np.ones(SECTORS, np.bool_)
    seen[10:18] = False
    for k in range(20):
        watch.update(revolution(k, shares(), measured=seen if k > 10 else None), HERE)
    assert not watch.covered.any()
    watch.update(revolution(20, COVERED), HERE)
    watch.update(revolution(21, shares(), measured=seen), HERE)
    assert watch.covered[10:18].any()


def test_only_free_and_too_close_beams_of_a_covered_sector_are_withheld() -> None:
    watch = CoverWatch()
    for k in range(10):
        watch.update(revolution(k, shares() if k < 9 else COVERED), HERE)
    ranges = np.full(720, np.inf, np.float32)
    ranges[::2], ranges[1::8] = 3.0, -np.inf
    withheld = watch.withhold(ranges)
    azimuth_deg = -(-180.0 + 0.5 * np.arange(720)) % 360.0
    inside = (azimuth_deg >= 50.0) & (azimuth_deg < 90.0)
    assert np.array_equal(np.isnan(withheld), inside & np.isinf(ranges))
    assert np.array_equal(withheld[~np.isnan(withheld)], ranges[~np.isnan(withheld)])
