"""Motion that contradicts the tracks, and a covered LiDAR: the robot stops, says why, and can be driven free.

Real nodes with the shipped parameters against the simulated robot, in simulated time.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator
from dataclasses import replace

import numpy as np
import pytest

from instant_ic.base.config import SkidSteerConfig
from instant_ic.base.kinematics import SkidSteer
from instant_ic.bus import ERROR
from instant_ic.control.arbiter_config import PoseTrustConfig
from instant_ic.control.states import Reason
from instant_ic.experiments.teleop_stack import SimulatedStack, StackConfig
from instant_ic.geometry.poses import wrap_angle
from instant_ic.msg import ControlState
from instant_ic.sim.worlds import make_world
from instant_ic.util.contradiction import Contradiction

FORWARD, TURN, NOTHING = (0.38, 0.0), (0.0, 0.8), (0.0, 0.0)
TRACKS = SkidSteerConfig()
INVERTED = replace(TRACKS, invert_left=True, invert_right=True)
SWAPPED = replace(TRACKS, left_motor=2)
TOO_FEW_PULSES = replace(TRACKS, pulses_per_metre=TRACKS.pulses_per_metre / 5)


class Stack(SimulatedStack):
    """A stack at whose images nobody looks."""

    def on_frame(self, *_: object) -> None:
        pass

    def drive(self, command: tuple[float, float], seconds: float, until: Callable[[], bool] = lambda: False) -> float:
        """Hold a command until something happens; return the seconds that it took."""
        began_s = self.time_s
        while not until() and self.time_s - began_s < seconds:
            self.step(lambda: command)
        return self.time_s - began_s

    @property
    def stopped(self) -> bool:
        return bool(self.state.mode == ControlState.STOPPED)

    @property
    def tracks_stand(self) -> bool:
        return bool((abs(self.simulation.robot.tracks) < 0.01).all())


@pytest.fixture
def stack() -> Iterator[Stack]:
    with Stack(make_world("random:3"), StackConfig(method="stop", command_latency_s=(0.0, 0.0))) as made:
        made.drive(NOTHING, 3.0)
        yield made


def stops(stack: Stack, command: tuple[float, float], kind: Contradiction, within_s: float) -> None:
    """Hold a command: the robot is stopped in time, says why, and the held key does not start it again."""
    assert stack.drive(command, 6.0, until=lambda: stack.stopped) <= within_s
    stack.drive(command, 1.0)
    assert stack.stopped and stack.tracks_stand
    assert stack.page.state["reason"] == f"{kind.text} Let go of the controls to continue."
    assert stack.state.reason_code == Reason.RELEASE_CONTROLS


@pytest.mark.parametrize(
    ("broken", "command", "kind", "within_s", "within"),
    [
        (INVERTED, FORWARD, Contradiction.OTHER_WAY, 0.8, 0.2),
        (SWAPPED, TURN, Contradiction.OTHER_WAY, 0.9, 0.5),
        (TOO_FEW_PULSES, FORWARD, Contradiction.FARTHER, 0.8, 0.75),
    ],
    ids=["inverted motors", "swapped motors", "pulses per metre five times too large"],
)
def test_a_robot_that_moves_otherwise_than_its_tracks_stops(
    stack: Stack,
    broken: SkidSteerConfig,
    command: tuple[float, float],
    kind: Contradiction,
    within_s: float,
    within: float,
) -> None:
    stack.simulation.robot.kinematics = SkidSteer(broken)
    before = stack.robot
    stops(stack, command, kind, within_s)
    moved = stack.robot - before
    assert math.hypot(moved[0], moved[1]) < within and abs(wrap_angle(float(moved[2]))) < within


@pytest.mark.parametrize(
    ("command", "tracks", "within_s", "within_m"),
    [((0.03, 0.0), [0], 2.0, 0.2), (FORWARD, [0, 1], 0.8, 0.85), ((0.0, 0.4), [0], 1.4, 0.55)],
    ids=["0.03 m/s", "0.38 m/s", "turning"],
)
def test_an_encoder_that_counts_30_percent_stops_the_robot(
    stack: Stack, command: tuple[float, float], tracks: list[int], within_s: float, within_m: float
) -> None:
    """The base sees a track that follows, which in truth is three times too fast: only the scans contradict it."""
    stack.drive(command, 1.5)
    motors = stack.simulation.robot.motors
    motors.encoders[tracks] = 0.3
    before = motors.travelled
    assert stack.drive(command, 6.0, until=lambda: stack.stopped) <= within_s
    stack.drive(command, 1.0)
    assert stack.stopped and stack.tracks_stand
    assert np.abs(motors.travelled - before).max() <= within_m
    assert "check" in stack.page.state["reason"].lower()


def test_tracks_that_slip_on_the_spot_stop_and_the_operator_drives_free_slowly(stack: Stack) -> None:
    stack.drive(FORWARD, 2.0)
    robot = stack.simulation.robot
    touches = robot.touches
    robot.touches = lambda pose: True  # it hangs on a sill that no sensor sees
    stops(stack, FORWARD, Contradiction.SLIPPING, 0.7)
    # It still hangs: slow, and stopped again.
    stack.drive(NOTHING, 1.5)
    stack.drive((-0.38, 0.0), 0.5)
    assert not stack.stopped and abs(robot.tracks).max() < PoseTrustConfig().speed_m_s + 0.01
    stops(stack, (-0.38, 0.0), Contradiction.SLIPPING, 1.5)
    # Free: slow until tracks and LiDAR have agreed, then as ever.
    robot.touches = touches
    stack.drive(NOTHING, 1.5)
    stack.drive((-0.38, 0.0), 1.0)
    assert abs(robot.tracks).max() < PoseTrustConfig().speed_m_s + 0.01
    assert stack.page.state["reason"].startswith(f"{Contradiction.SLIPPING.text} The robot is slow until both agree.")
    stack.drive((-0.38, 0.0), 3.0)
    assert abs(robot.tracks).min() > 0.3 and not stack.stopped


def test_fault_slow_tracks_that_slip_on_the_spot_run_on(stack: Stack) -> None:
    """At 0.02 m/s they ran 0.25 m; slower ones: ``slam/test_slam_contradiction.py``."""
    stack.drive(FORWARD, 2.0)
    stack.drive(NOTHING, 1.0)
    stack.simulation.robot.touches = lambda pose: True
    assert stack.drive((0.02, 0.0), 8.0, until=lambda: stack.stopped) * 0.02 < 0.15
    assert stack.stopped and stack.state.reason_code == Reason.RELEASE_CONTROLS


def covered(packet: bytes, first_deg: float, end_deg: float) -> bytes:
    """A data packet without the returns between two azimuths, clockwise from ahead."""
    data = np.frombuffer(packet, np.uint8).copy()
    for block in data[:1200].reshape(12, 100):
        azimuth_deg = int(block[2:4].view("<u2")[0]) / 100.0
        if (azimuth_deg - first_deg) % 360.0 < end_deg - first_deg:
            block[4:] = 0
    return data.tobytes()


def test_a_lidar_that_is_covered_ahead_stops_the_robot_and_lets_it_turn_and_back_off(stack: Stack) -> None:
    stack.drive(FORWARD, 2.0)
    scan = stack.simulation.scan_packets
    stack.simulation.scan_packets = lambda: [covered(packet, 330.0, 390.0) for packet in scan()]
    robot = stack.simulation.robot
    assert stack.drive(FORWARD, 2.0, until=lambda: stack.state.reason_code == Reason.BLIND) <= 0.45
    stack.drive(FORWARD, 0.6)
    assert stack.tracks_stand
    ahead = "The LiDAR is covered ahead. Uncover it, or drive another way."
    assert stack.page.state["reason"] == ahead
    level, text, _ = stack.nodes["vlp16_driver"].diagnoses()["cover"]
    assert level == ERROR and "from 330° on (clockwise from ahead)" in text and "Uncover the sensor" in text
    stack.drive(TURN, 1.5)
    assert robot.twist[2] > 0.5
    stack.drive((-0.2, 0.0), 1.0)
    assert robot.twist[0] < -0.1
    stack.drive(FORWARD, 1.0)  # what is covered now was seen before the turn
    assert stack.tracks_stand and stack.page.state["reason"] == ahead
    stack.simulation.scan_packets = scan
    stack.drive(FORWARD, 1.0)
    assert robot.twist[0] > 0.1
