"""The three nodes over the lockstep bus: wiring, time-outs, and the whole flow once."""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest
from control_world import matrix, ready_vspace, rectangle
from stack_world import START_NS, StackWorld

from instant_ic.bus import OK, WARN
from instant_ic.bus.lockstep import LockstepBus
from instant_ic.console.drive import DriveConfig, DriveGate
from instant_ic.control.arbiter_config import ArbiterConfig
from instant_ic.control.costmap import LETHAL
from instant_ic.control.freshness import TimeoutConfig
from instant_ic.control.states import Reason
from instant_ic.lidar.decode import POINT_DTYPE
from instant_ic.msg import (
    Bool,
    ControlState,
    PoseIntegrity,
    ShownPictures,
    cloud_message,
    compressed_image_message,
    grid_array,
    header,
    pose_message,
    to_time,
    twist_stamped,
    twist_values,
)
from nodes.arbiter import ArbiterNode

CONFIG = Path(__file__).resolve().parents[2] / "config" / "control.yaml"
STEP_NS = 50_000_000


def test_parameters_that_cannot_be_used_change_nothing(monkeypatch: pytest.MonkeyPatch) -> None:
    arbiter = LockstepBus().add(ArbiterNode)
    before = arbiter.config

    def too_large(*arguments: object) -> None:
        raise MemoryError

    with monkeypatch.context() as patched, pytest.raises(MemoryError):
        patched.setattr("instant_ic.control.arbiter.Predictor", too_large)
        arbiter.parameters.set({"limits.max_linear_m_s": 0.4, "prediction.padding_m": 0.1})
    assert arbiter.config is before and arbiter.arbiter.config is before
    assert arbiter.parameters.set({"switch.min_real_s": 2.0}) == {"switch.min_real_s": 2.0}


class Stack(StackWorld):
    """The three nodes, and a world that answers them at 20 Hz."""

    def __init__(self, obstacles: np.ndarray) -> None:
        super().__init__(LockstepBus(START_NS), obstacles)
        self.cloud: np.ndarray | None = None
        """(N, 3) places over ground and height in the world, seen wherever the robot is; None: no 3D points."""
        self.k = 0
        self.page = True
        """Whether the operator has a page, with views of the v-bot two steps old; none comes with "views" in silent."""
        self.picture_ns = self.view_ns = self.lost_ns = 0
        self.views: list[tuple[int, object]] = []

    def send(self, topic: str, message: object) -> None:
        if topic not in self.silent:
            self.bus.publish(topic, message)

    def step(self, command: tuple[float, float] | None) -> ControlState:
        now = self.now
        self.sense()
        if command is not None:
            self.operate(command)
        self.bus.advance_to(now + STEP_NS)
        self.move()
        return self.bus.last("/ic/state")

    def operate(self, command: tuple[float, float], ahead_s: float = 0.0) -> None:
        """The operator's command, with a stamp ``ahead_s`` ahead of the clock."""
        self.send("/operator/cmd_vel", twist_stamped(*command, self.now + round(ahead_s * 1e9)))

    def sense(self) -> None:
        """All but the operator's command."""
        now = self.now
        self.send("/tf", self.transforms())
        self.send("/wheel/odom", self.odometry())
        if self.k % 2 == 0:
            self.send("/scan", self.scan())
            self.send("/pose", self.pose())
            self.send("/camera/image/compressed", compressed_image_message(b"not a JPEG", "camera", now))
        if self.k % 2 == 0 and self.cloud is not None:
            points = np.zeros(len(self.cloud), POINT_DTYPE)
            seen = (self.cloud - [*self.base.pose[:2], 0.6]) @ matrix(self.base.pose)[:3, :3]
            points["x"], points["y"], points["z"] = seen.T
            self.send("/lidar/points", cloud_message(points, "velodyne", now))
        if self.k % 10 == 0:
            self.send("/vspace/status", ready_vspace(now))
        if self.page:
            self.show(now)

    def move(self) -> None:
        self.k += 1
        self.drive_base(twist_values(self.bus.last("/cmd_vel")))

    def show(self, now: int) -> None:
        """What the console tells of the pictures that the operator has."""
        if self.k % 2 == 0 and "/camera/image/compressed" not in self.silent:
            self.picture_ns = now
        vbot = self.bus.last("/vbot/odom")
        if vbot is not None and "views" not in self.silent:
            self.views.append((now, vbot.pose.pose))
            self.view_ns = now
        asked_ns, pose = self.views[max(0, len(self.views) - 3)] if self.views else (now, pose_message(np.eye(4)))
        self.bus.publish(
            "/view/shown",
            ShownPictures(
                header=header("map", now),
                picture_stamp=to_time(self.picture_ns),
                picture_age_s=(now - self.picture_ns) / 1e9,
                view_id=len(self.views),
                view_pose=pose,
                view_age_s=(now - self.view_ns) / 1e9 if self.views else math.inf,
                view_delay_s=(now - asked_ns) / 1e9,
                operator_lost=to_time(self.lost_ns),
            ),
        )

    def drive(self, seconds: float, command: tuple[float, float] | None) -> list[ControlState]:
        return [self.step(command) for _ in range(round(seconds * 20))]


def modes(states: list[ControlState]) -> list[int]:
    listed = [state.mode for state in states]
    return [mode for i, mode in enumerate(listed) if i == 0 or listed[i - 1] != mode]


@pytest.mark.parametrize(
    ("topic", "reason", "period_s"),
    [
        ("/wheel/odom", Reason.ODOMETRY_STALE, 0.05),
        ("/operator/cmd_vel", Reason.DRIVE_ROBOT, 0.05),
        ("/camera/image/compressed", Reason.CAMERA_STALE, 0.1),
    ],
)
def test_each_loss_sends_zero_within_0_3_s_of_the_next_message(topic: str, reason: Reason, period_s: float) -> None:
    stack = Stack(np.zeros((0, 2, 2)))
    stack.drive(1.5, None)
    assert twist_values(stack.drive(1.0, (0.4, 0.0))[-1].applied_command)[0] == pytest.approx(0.4)
    stack.silent.add(topic)
    # The next one was due a period after the last; a step of the loop comes on top.
    states = stack.drive(period_s + 0.3, (0.4, 0.0))
    assert twist_values(stack.bus.last("/cmd_vel")) == (0.0, 0.0)
    assert states[-1].reason_code == reason
    assert states[-1].mode == ControlState.REAL  # a short gap changes no view
    states = stack.drive(1.3, (0.4, 0.0))
    expected = ControlState.REAL if topic == "/operator/cmd_vel" else ControlState.STOPPED
    assert states[-1].mode == expected


def test_a_doubt_about_the_pose_holds_until_the_next_report() -> None:
    stack = Stack(np.zeros((0, 2, 2)))
    stack.drive(2.5, None)

    def report(lost_probability: float) -> None:
        stack.send(
            "/slam/integrity",
            PoseIntegrity(header("map", stack.now), lost_probability, 0.1, 0.1, True, "tracked", 0, 0),
        )

    def speed_m_s(seconds: float) -> float:
        return twist_values(stack.drive(seconds, (0.4, 0.0))[-1].applied_command)[0]

    report(0.2)
    assert speed_m_s(1.5) == pytest.approx(ArbiterConfig().pose_trust.speed_m_s)  # poses go on, reports do not
    report(0.0)
    assert speed_m_s(1.0) == pytest.approx(0.4)


def test_pictures_that_do_not_reach_the_operator_stop_the_robot() -> None:
    """The camera goes on at the robot; on the way to the page its pictures are lost."""
    stack = Stack(np.zeros((0, 2, 2)))
    stack.drive(1.5, None)
    stack.drive(1.0, (0.4, 0.0))
    frozen = stack.picture_ns
    for _ in range(10):
        stack.step((0.4, 0.0))
        stack.picture_ns = frozen
    assert twist_values(stack.bus.last("/cmd_vel")) == (0.0, 0.0)
    assert stack.bus.last("/ic/state").reason_code == Reason.CAMERA_STALE


def test_the_button_on_the_robot_stops_and_only_the_operator_ends_it_once_it_is_out() -> None:
    stack = Stack(np.zeros((0, 2, 2)))
    stack.drive(1.5, None)
    stack.drive(1.0, (0.4, 0.0))
    stack.bus.publish("/robot/estop", Bool(data=True), latched=True)
    assert twist_values(stack.bus.last("/cmd_vel")) == (0.0, 0.0)  # before any timer
    state = stack.drive(0.5, None)[-1]
    assert (state.mode, state.estop) == (ControlState.STOPPED, True)
    assert "Release it, then release the stop here" in state.reason
    assert state.reason_code == Reason.ESTOP_BUTTON
    stack.bus.publish("/operator/estop", Bool(data=False), latched=True)  # while it is pressed
    assert stack.drive(1.0, (0.0, 0.0))[-1].estop
    stack.bus.publish("/robot/estop", Bool(data=False), latched=True)
    state = stack.drive(1.0, (0.0, 0.0))[-1]
    assert (state.mode, state.estop) == (ControlState.STOPPED, True)
    assert state.reason_code == Reason.ESTOP
    stack.bus.publish("/operator/estop", Bool(data=False), latched=True)
    assert stack.drive(1.0, (0.0, 0.0))[-1].mode == ControlState.REAL


def test_a_button_that_repeats_its_state_is_missed_where_that_is_set() -> None:
    stack = Stack(np.zeros((0, 2, 2)))
    stack.arbiter.reconfigure(dataclasses.replace(stack.arbiter.config, timeouts=TimeoutConfig(estop_input=0.5)))
    stack.drive(1.5, None)  # none has spoken: there is none
    stack.bus.publish("/robot/estop", Bool(data=False), latched=True)
    assert twist_values(stack.drive(0.4, (0.4, 0.0))[-1].applied_command)[0] > 0.2
    state = stack.drive(0.2, (0.4, 0.0))[-1]
    assert twist_values(state.applied_command) == (0.0, 0.0)
    assert state.reason_code == Reason.ESTOP_INPUT_STALE


def test_a_changed_command_is_obeyed_before_the_next_timer() -> None:
    stack = Stack(np.zeros((0, 2, 2)))
    stack.drive(1.5, None)
    count = len(stack.bus.records("/cmd_vel"))
    stack.send("/operator/cmd_vel", twist_stamped(0.4, 0.0, stack.now))
    assert twist_values(stack.bus.last("/cmd_vel"))[0] == pytest.approx(0.4)
    for speed in (0.3, 0.2, 0.1):  # not more than one between two timers
        stack.send("/operator/cmd_vel", twist_stamped(speed, 0.0, stack.now))
    assert len(stack.bus.records("/cmd_vel")) == count + 1


def test_emergency_stop_acts_at_once_and_holds() -> None:
    stack = Stack(np.zeros((0, 2, 2)))
    stack.drive(1.5, None)
    stack.drive(1.0, (0.4, 0.0))
    stack.bus.publish("/operator/estop", Bool(data=True), latched=True)
    assert twist_values(stack.bus.last("/cmd_vel")) == (0.0, 0.0)  # before any timer
    states = stack.drive(1.0, (0.4, 0.0))
    assert {s.mode for s in states} == {ControlState.STOPPED}
    assert states[-1].estop
    stack.bus.publish("/operator/estop", Bool(data=False), latched=True)
    assert stack.drive(1.0, (0.4, 0.0))[-1].mode == ControlState.STOPPED  # the key is still down
    assert stack.drive(0.5, (0.0, 0.0))[-1].mode == ControlState.REAL


def lose_the_operator(stack: Stack, beats_end_s: float, hidden: bool = False, console_dies: bool = False) -> float:
    """Runs on in VIRTUAL with hands off and the console's gate before the arbiter; seconds to the zero command.

    Counted from the page's last beat, ``beats_end_s`` from now; with ``console_dies`` from the last that the console
    said. All in simulated time, in steps of a millisecond.
    """
    gate, began_ns, last_s, there = DriveGate(DriveConfig()), stack.now, 0.0, True
    gate.request(1, 0.0)
    for ms in range(round(1000 * beats_end_s) + 1000):
        now_s = ms / 1000
        dead = console_dies and now_s > beats_end_s
        if now_s <= beats_end_s and ms % 50 == 0:
            last_s = now_s
            gate.touch(1, now_s)
        if hidden and now_s == beats_end_s:
            last_s = now_s
            gate.touch(1, now_s, away=True)
        command = None if dead else gate.take_due(now_s)
        if command is not None:
            last_s = now_s if console_dies else last_s
            stack.send("/operator/cmd_vel", twist_stamped(*command, stack.now))
        if not dead and gate.driver_alive(now_s) != there:
            there = not there
            stack.lost_ns = 0 if there else stack.now
            stack.show(stack.now)
        if ms % 50 == 0:
            stack.page = not dead
            stack.sense()
        stack.bus.advance_to(began_ns + ms * 1_000_000)
        if ms % 50 == 0:
            stack.move()
        if now_s > beats_end_s and twist_values(stack.bus.last("/cmd_vel")) == (0.0, 0.0):
            return now_s - last_s
    raise AssertionError("the robot is never told to stand")


@pytest.fixture(scope="module")
def virtual_stack() -> Iterator[Stack]:
    """One that is in the virtual space, a metre before the box; for tests that leave it there."""
    stack = Stack(rectangle(2.5, -0.25, 3.0, 0.25))
    stack.drive(1.5, None)
    for _ in range(200):
        if stack.step((0.4, 0.0)).mode == ControlState.VIRTUAL:
            break
    yield stack
    stack.bus.close()


@pytest.mark.parametrize(
    ("fault", "beats_end_s", "most_s"),
    [({}, 0.449, 0.26), ({"hidden": True}, 0.43, 0.005), ({"console_dies": True}, 0.43, 0.305)],
    ids=["page falls silent", "page is hidden", "console dies"],
)
def test_the_robot_stands_within_0_3_s_of_the_loss_of_the_operators_page(
    virtual_stack: Stack, fault: dict[str, bool], beats_end_s: float, most_s: float
) -> None:
    stack = virtual_stack
    stack.lost_ns, stack.page = 0, True
    stack.drive(0.3, (0.4, 0.0))
    assert twist_values(stack.bus.last("/cmd_vel")) != (0.0, 0.0)
    assert lose_the_operator(stack, beats_end_s, **fault) <= most_s
    state = stack.bus.last("/ic/state")
    assert state.mode == ControlState.VIRTUAL
    assert state.reason_code == Reason.OPERATOR_LOST
    assert state.vbot_action == ControlState.VBOT_HELD
    # Back: the next command, and it goes on.
    stack.page = True
    assert twist_values(stack.drive(0.3, (0.4, 0.0))[-1].applied_command) != (0.0, 0.0)


def test_diagnoses_of_the_start_are_cleared() -> None:
    stack = Stack(np.zeros((0, 2, 2)))
    arbiter = next(node for node in stack.bus.nodes if isinstance(node, ArbiterNode))
    stack.silent.add("/tf")
    stack.drive(0.5, None)
    assert arbiter.diagnoses()["pose"][0] == WARN
    stack.silent.clear()
    stack.drive(2.0, None)
    stack.drive(1.0, (0.4, 0.0))
    for node in stack.bus.nodes:
        assert {name: d for name, d in node.diagnoses().items() if d[0] != OK} == {}, node.name


def kerb(x: float) -> np.ndarray:
    """Points (N, 3) of a kerb 0.09 m high across the corridor, under the flat scan's band."""
    ys = np.arange(-1.0, 1.0, 0.02)
    return np.array([[x + 0.02 * i, y, 0.09] for i in range(6) for y in ys])


def test_a_kerb_that_the_flat_scan_does_not_see_stops_the_robot() -> None:
    stack = Stack(np.zeros((0, 2, 2)))
    stack.cloud = kerb(2.5)
    states = stack.drive(1.5, None) + stack.drive(6.0, (0.4, 0.0))
    assert stack.base.pose[0] + 0.30 < 2.5
    assert stack.base.pose[0] > 1.5
    assert states[-1].blocked
    grid, resolution, origin = grid_array(stack.bus.last("/costmap"))
    column, row = (math.floor((v - o) / resolution) for v, o in zip((2.53, 0.1), origin, strict=True))
    assert grid[row, column] == 100
    arbiter = next(node for node in stack.bus.nodes if isinstance(node, ArbiterNode))
    assert arbiter.diagnoses()["points"][2]["obstacle"] == len(stack.cloud)


def test_3d_points_are_needed_once_they_have_come() -> None:
    stack = Stack(np.zeros((0, 2, 2)))
    assert stack.drive(1.5, None)[-1].mode == ControlState.REAL  # a robot without them drives by its scan
    stack.cloud = kerb(8.0)
    stack.drive(0.5, (0.4, 0.0))
    assert twist_values(stack.bus.last("/cmd_vel"))[0] == pytest.approx(0.4)
    stack.silent.add("/lidar/points")
    states = stack.drive(0.7, (0.4, 0.0))
    assert twist_values(stack.bus.last("/cmd_vel")) == (0.0, 0.0)
    assert states[-1].reason_code == Reason.POINTS_STALE
    assert stack.drive(1.5, (0.4, 0.0))[-1].mode == ControlState.STOPPED
    assert stack.drive(5.0, (0.0, 0.0))[-1].mode == ControlState.STOPPED  # however long they are gone
    stack.silent.clear()
    assert stack.drive(1.0, (0.0, 0.0))[-1].mode == ControlState.REAL


def test_points_without_coordinates_hold_the_robot_and_are_told() -> None:
    stack = Stack(np.zeros((0, 2, 2)))
    stack.drive(1.5, None)
    arbiter = next(node for node in stack.bus.nodes if isinstance(node, ArbiterNode))
    bare = cloud_message(np.zeros(4, np.dtype([("x", "<f4"), ("intensity", "<f4")])), "velodyne", stack.now)
    stack.send("/lidar/points", bare)
    states = stack.drive(0.3, (0.4, 0.0))
    level, words, _ = arbiter.diagnoses()["points"]
    assert level == WARN
    assert "x, intensity; x, y and z are needed" in words
    assert twist_values(states[-1].applied_command) == (0.0, 0.0)
    stack.cloud = kerb(8.0)
    stack.drive(2.5, (0.0, 0.0))
    assert arbiter.diagnoses()["points"][0] == OK
    assert twist_values(stack.drive(0.5, (0.4, 0.0))[-1].applied_command)[0] > 0.3


def test_at_rest_the_arbiter_works_rarely_and_a_start_is_checked_against_what_stands_there_now() -> None:
    stack = Stack(np.zeros((0, 2, 2)))
    stack.cloud = np.zeros((0, 3))
    stack.drive(2.0, None)
    updates = count_calls(stack.arbiter.surroundings, "update_costmap")
    before = len(stack.bus.records("/cmd_vel"))
    assert {state.mode for state in stack.drive(4.0, None)} == {ControlState.REAL}
    assert 35 <= len(stack.bus.records("/cmd_vel")) - before <= 41  # 10 a second: no receiver times out
    assert 7 <= len(updates) <= 9  # 2 a second, and no source counts as stale
    # A box 0.1 m high, 0.6 m ahead, that only 3D points see, appears between two updates.
    stack.cloud = np.array([[0.62, y, z] for y in np.arange(-0.2, 0.2, 0.02) for z in (0.08, 0.1)])
    stack.step(None)
    stack.step(None)
    seen, sent = len(updates), len(stack.bus.records("/cmd_vel"))
    state = stack.step((0.4, 0.0))
    assert len(updates) > seen
    costmap = stack.arbiter.surroundings.costmap
    assert costmap is not None and costmap.cost_at(np.array([0.62, 0.0])) == LETHAL
    assert state.blocked or state.mode != ControlState.REAL  # the robot is held, or the passage has begun
    assert all(twist_values(command)[0] < 0.4 for command in stack.bus.messages("/cmd_vel")[sent:])
    before = len(updates)
    stack.drive(1.0, (0.0, 0.5))
    assert len(updates) - before >= 19  # in motion, each timer


def count_calls(thing: object, name: str) -> list[object]:
    """Results of a method from now on, one for each call."""
    results: list[object] = []
    method = getattr(thing, name)

    def counted(*arguments: object) -> object:
        results.append(method(*arguments))
        return results[-1]

    setattr(thing, name, counted)
    return results
