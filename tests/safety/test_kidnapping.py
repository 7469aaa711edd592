"""A robot that is lifted while it drives and put down elsewhere: stopped, said on the page, and placed again.

Real nodes with the shipped parameters against the simulated robot, in simulated time.
"""

from __future__ import annotations

import math
from collections.abc import Callable

import pytest

from instant_ic.experiments.teleop_stack import SimulatedStack, StackConfig
from instant_ic.geometry.poses import compose2, pose2_from_matrix, wrap_angle
from instant_ic.msg import ControlState, matrix_from_pose
from instant_ic.sim.worlds import make_world

FORWARD, NOTHING = (0.38, 0.0), (0.0, 0.0)
SCAN_S = 0.1


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
    def stands(self) -> bool:
        return abs(float(self.simulation.robot.twist[0])) < 0.01

    @property
    def misplaced(self) -> bool:
        """Whether the stack's pose is more than 0.5 m or 15° off."""
        pose = compose2(self.start, pose2_from_matrix(matrix_from_pose(self.state.robot_pose)))
        far = math.dist(pose[:2], self.robot[:2]) > 0.5
        return far or abs(wrap_angle(float(pose[2] - self.robot[2]))) > math.radians(15)


@pytest.mark.timeout(600)
def test_a_robot_that_is_carried_off_while_it_drives_stops_and_says_so() -> None:
    with Stack(make_world("random:3"), StackConfig(method="stop", command_latency_s=(0.0, 0.0))) as stack:
        stack.drive(NOTHING, 3.0)
        stack.drive(FORWARD, 4.0)
        assert stack.robot[0] > 1.0 and not stack.stands and not stack.misplaced, stack.state.reason

        # Back to where it came from: it is stopped, and placed again.
        stack.simulation.put_down((0.0, 0.4, 2.5))
        assert stack.drive(FORWARD, 3.0, until=lambda: stack.stopped) <= 10 * SCAN_S
        stack.drive(FORWARD, 0.6)
        assert stack.stopped and stack.stands and not stack.misplaced  # a held key does not start it again
        assert stack.page.state["mode"] == "stopped"
        jumped = "The robot's place on the map has jumped. Check where it stands."
        assert stack.page.state["reason"] == f"{jumped} Let go of the controls to continue."
        stack.drive(NOTHING, 2.0)
        stack.drive((0.0, 0.3), 0.5)
        assert stack.page.state["mode"] == "real" and not stack.misplaced

        # To where it has never been: stopped, whether the SLAM knows that it is lost or takes it for another.
        stack.simulation.put_down((3.0, 3.0, 1.5))
        assert stack.drive((0.0, 0.3), 3.0, until=lambda: stack.stopped) <= 10 * SCAN_S
        stack.drive((0.0, 0.3), 0.6)
        assert stack.stopped and stack.stands and "the robot" in stack.page.state["reason"].lower()
