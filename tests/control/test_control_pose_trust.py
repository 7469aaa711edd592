"""What the robot may do while the SLAM doubts its pose: slow, stop, then slow driving until its place is recognized."""

from __future__ import annotations

import numpy as np
import pytest
from control_world import Loop, World, corridor, draw_map, rectangle

from instant_ic.control.arbiter_config import PoseTrustConfig
from instant_ic.control.states import Mode, Reason

FORWARD, NOTHING = (0.4, 0.0), (0.0, 0.0)


def loop() -> Loop:
    walls = corridor(16.0)
    world = World(np.concatenate([walls, rectangle(4.0, -0.25, 4.5, 0.25)]))
    made = Loop(world, draw_map(walls, (-2, -1.2, 14.0, 1.2)))
    made.start()
    return made


def drive(made: Loop, seconds: float, command: tuple[float, float]) -> None:
    for _ in range(round(seconds * 20)):
        made.step(command)


def test_a_doubt_slows_the_robot_and_a_lost_pose_stops_it() -> None:
    made = loop()
    drive(made, 2.0, FORWARD)
    made.pose_lost = 0.09
    drive(made, 0.5, FORWARD)
    assert made.frames[-1].command == pytest.approx(FORWARD)
    for probability in (0.1, 0.49):
        made.pose_lost = probability
        drive(made, 0.5, FORWARD)
        assert made.frames[-1].command[0] == pytest.approx(PoseTrustConfig().speed_m_s)
    made.pose_lost = 0.5
    drive(made, 0.1, FORWARD)
    stopped = made.frames[-1]
    assert stopped.decision.mode == Mode.STOPPED and stopped.command == NOTHING
    assert stopped.decision.reason == "The robot has lost its place on the map. Let go of the controls to continue."


def test_once_the_operator_has_let_go_the_robot_drives_slowly_until_its_place_is_recognized() -> None:
    made = loop()
    made.pose_lost = 0.9
    drive(made, 1.5, NOTHING)
    drive(made, 1.0, FORWARD)
    slow = made.frames[-1]
    assert slow.decision.mode == Mode.REAL
    assert slow.command[0] == pytest.approx(PoseTrustConfig().speed_m_s)
    assert "not sure of its place" in slow.decision.reason
    made.pose_lost = 0.0
    drive(made, 1.0, FORWARD)
    assert made.frames[-1].command == pytest.approx(FORWARD)
    made.pose_lost = 0.9  # lost a second time: stopped a second time
    drive(made, 0.1, FORWARD)
    assert made.frames[-1].decision.mode == Mode.STOPPED


@pytest.mark.parametrize("jump", [(0.0, 0.5, 0.0), (0.0, 0.0, 0.5)])
def test_a_pose_that_jumps_stops_the_robot_until_the_operator_lets_go(jump: tuple[float, float, float]) -> None:
    made = loop()
    drive(made, 2.0, FORWARD)
    made.base.pose = made.base.pose + np.array(jump)
    drive(made, 0.1, FORWARD)
    stopped = made.frames[-1]
    assert stopped.decision.mode == Mode.STOPPED and stopped.command == NOTHING
    assert stopped.decision.reason.startswith("The robot's place on the map has jumped. Check where it stands.")
    drive(made, 1.5, NOTHING)
    drive(made, 0.5, FORWARD)
    assert made.frames[-1].decision.mode == Mode.REAL


def test_what_the_robot_can_have_driven_during_a_pause_is_no_jump() -> None:
    made = loop()
    drive(made, 2.0, FORWARD)

    def mode_after_a_second_without_steps(moved: tuple[float, float, float]) -> Mode:
        made.k += 20
        made.cameras += made.cameras[-1:] * 20
        made.views += made.views[-1:] * 20
        made.base.pose = made.base.pose + np.array(moved)
        return made.step(FORWARD).decision.mode

    assert mode_after_a_second_without_steps((0.45, 0.0, 0.6)) == Mode.REAL
    assert mode_after_a_second_without_steps((0.96, 0.0, 0.0)) == Mode.STOPPED  # over 0.4 m + 0.5 m/s * 1.05 s


def test_no_switch_with_a_pose_in_doubt() -> None:
    made = loop()
    made.pose_lost = 0.2
    drive(made, 30.0, FORWARD)
    assert made.modes() == ["STOPPED", "REAL"]
    assert made.frames[-1].decision.reason_code == Reason.POSE_DOUBTFUL
    assert made.frames[-1].command == NOTHING


def test_the_thresholds_are_in_order() -> None:
    with pytest.raises(ValueError, match="stop must be >= slow"):
        PoseTrustConfig(slow=0.6, stop=0.5)
