"""Wheels against scans: step by step, by hand."""

from __future__ import annotations

import math

import numpy as np
import pytest

from instant_ic.slam.motion import MotionMonitor, MotionState


def steps(
    monitor: MotionMonitor,
    count: int,
    wheels: tuple[float, float] = (0.0, 0.0),
    seen: tuple[float, float] = (0.0, 0.0),
    matched: bool = True,
) -> MotionState:
    """``count`` steps of 0.1 s: metres and radians by the wheels, and as seen."""
    for _ in range(count):
        monitor.update(np.array([wheels[0], 0, wheels[1]]), np.array([seen[0], 0, seen[1]]), 0.1, matched)
    return monitor.state


def test_a_robot_that_moves_as_its_tracks_do_is_normal() -> None:
    monitor = MotionMonitor()
    assert steps(monitor, 30, (0.05, 0.0), (0.047, 0.0)) is MotionState.NORMAL
    assert monitor.slip == pytest.approx(0.06)
    assert steps(monitor, 30) is MotionState.NORMAL
    assert steps(monitor, 30, (-0.05, 0.0), (-0.05, 0.001)) is MotionState.NORMAL


def test_slip_and_stuck() -> None:
    monitor = MotionMonitor()
    assert steps(monitor, 30, (0.05, 0.0), (0.025, 0.0)) is MotionState.SLIPPING
    assert monitor.slip == pytest.approx(0.5)
    assert steps(monitor, 30, (0.05, 0.0), (0.001, 0.0)) is MotionState.STUCK
    assert steps(monitor, 30, (0.05, 0.0), (0.05, 0.0)) is MotionState.NORMAL
    assert steps(monitor, 30, (0.0, 0.1), (0.0, 0.004)) is MotionState.STUCK
    # Tracks that turn twice as far as the robot, always, are a wide track and no slip.
    assert steps(monitor, 60, (0.0, 0.1), (0.0, 0.05)) is MotionState.NORMAL
    assert monitor.turn_factor == pytest.approx(2.0, abs=0.01)


def test_pushed_and_carried() -> None:
    monitor = MotionMonitor()
    assert steps(monitor, 30, (0.0, 0.0), (0.02, 0.0)) is MotionState.PUSHED
    assert steps(monitor, 30) is MotionState.NORMAL
    assert steps(monitor, 30, seen=(0.0, 0.02)) is MotionState.PUSHED
    assert steps(monitor, 30) is MotionState.NORMAL
    assert steps(monitor, 1, seen=(0.8, 0.0)) is MotionState.CARRIED
    assert steps(monitor, 25) is MotionState.NORMAL
    assert steps(monitor, 15, matched=False) is MotionState.CARRIED
    # Lost while driving is not carried.
    assert steps(MotionMonitor(), 30, (0.05, 0.0), matched=False) is MotionState.NORMAL


def test_noise_of_a_standing_robot_is_no_push() -> None:
    monitor = MotionMonitor()
    rng = np.random.default_rng(0)
    for noise in rng.standard_normal((200, 3)) * [0.005, 0.005, 0.003]:
        assert monitor.update(np.zeros(3), noise, 0.1, True) is MotionState.NORMAL


def test_the_turn_factor_is_learnt() -> None:
    monitor = MotionMonitor()
    assert monitor.turn_factor == 1.0 and math.isinf(monitor.turn_factor_sigma)
    rng = np.random.default_rng(1)
    for k in range(1500):
        seen = 0.05 * math.copysign(1.0, math.sin(k / 40))
        wheels = 1.3 * seen * (1 + 0.1 * rng.standard_normal())
        monitor.update(np.array([0.02, 0, wheels]), np.array([0.02, 0, seen]), 0.1, True)
    # Encoders say 1.3 times the turn: the effective track is that much wider than assumed.
    assert monitor.turn_factor == pytest.approx(1.3, abs=0.03)
    assert 0 < monitor.turn_factor_sigma < 0.05
    assert monitor.state is MotionState.NORMAL
