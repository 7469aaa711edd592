"""What the robot may do when wheels and LiDAR contradict each other: stop, then slow driving until they agree."""

from __future__ import annotations

import pytest
from control_world import Loop, World, corridor, draw_map

from instant_ic.control.arbiter_config import PoseTrustConfig
from instant_ic.control.states import Mode, Reason
from instant_ic.util.contradiction import Contradiction

FORWARD, NOTHING = (0.4, 0.0), (0.0, 0.0)


def drive(made: Loop, seconds: float, command: tuple[float, float]) -> None:
    for _ in range(round(seconds * 20)):
        made.step(command)


@pytest.fixture
def made() -> Loop:
    walls = corridor(16.0)
    loop = Loop(World(walls), draw_map(walls, (-2, -1.2, 14.0, 1.2)))
    loop.start()
    drive(loop, 1.5, FORWARD)
    assert loop.frames[-1].command == pytest.approx(FORWARD)
    return loop


def test_each_contradiction_stops_the_robot_hard_until_the_operator_lets_go(made: Loop) -> None:
    for count in (1, 2):
        made.contradiction, made.contradictions = Contradiction.OTHER_WAY, count
        drive(made, 1.0, FORWARD)
        stopped = made.frames[-1].decision
        assert stopped.mode == Mode.STOPPED and stopped.command == NOTHING and stopped.hard
        assert stopped.reason == f"{Contradiction.OTHER_WAY.text} Let go of the controls to continue."
        drive(made, 1.5, NOTHING)
        drive(made, 0.5, FORWARD)
        slow = made.frames[-1]
        assert slow.decision.mode == Mode.REAL
        assert slow.decision.reason == f"{Contradiction.OTHER_WAY.text} The robot is slow until both agree."
        assert slow.command[0] == pytest.approx(PoseTrustConfig().speed_m_s)
    made.contradiction = Contradiction.NONE
    drive(made, 0.5, FORWARD)
    assert made.frames[-1].command == pytest.approx(FORWARD)


def test_a_contradiction_between_two_steps_is_not_missed(made: Loop) -> None:
    made.contradictions = 3
    drive(made, 0.05, FORWARD)
    assert made.frames[-1].decision.mode == Mode.STOPPED


def test_a_slam_that_starts_again_counts_again(made: Loop) -> None:
    made.contradictions = 3
    drive(made, 0.1, FORWARD)
    drive(made, 1.5, NOTHING)
    made.contradictions = 0
    drive(made, 0.5, FORWARD)
    assert made.frames[-1].decision.mode == Mode.REAL
    made.contradictions = 1
    drive(made, 0.1, FORWARD)
    assert made.frames[-1].decision.mode == Mode.STOPPED


def test_the_reason_has_its_own_code(made: Loop) -> None:
    made.contradiction, made.contradictions = Contradiction.SLIPPING, 1
    drive(made, 0.05, FORWARD)
    drive(made, 0.05, NOTHING)
    stopped = made.frames[-1].decision
    assert stopped.reason_code == Reason.CONTRADICTION
    assert stopped.reason == Contradiction.SLIPPING.text
