"""Ages over the whole stack: by the stamp once on arrival, by the steady clock from then on, if a clock is set too."""

from pathlib import Path

import cv2
import numpy as np
import pytest
from base_line import SetClock

from instant_ic.bus import ERROR, SENSOR
from instant_ic.bus.lockstep import LockstepBus
from instant_ic.camera.config import ThetaCameraConfig
from instant_ic.cli.message_input import build
from instant_ic.control.arbiter_config import ArbiterConfig
from instant_ic.control.freshness import TimeoutConfig
from instant_ic.geometry.poses import pose_matrix
from instant_ic.msg import (
    Bool,
    ControlState,
    TFMessage,
    compressed_image_message,
    odometry_message,
    scan_message,
    serialize,
    stamp_ns,
    transform_message,
    twist_stamped,
    type_name,
)
from nodes.arbiter import ArbiterNode
from nodes.grid_slam import GridSlamNode
from nodes.theta_camera import ThetaCameraNode
from nodes.virtual_robot import VirtualRobotNode

S = 1_000_000_000
START_NS = 1_700_000_000 * S
JUMPS = pytest.mark.parametrize("jump_s", [-3600, 3600])


def clocked() -> tuple[LockstepBus, SetClock]:
    bus = LockstepBus(START_NS)
    clock = bus.clock = SetClock(START_NS)
    return bus, clock


def command_age(arbiter: ArbiterNode) -> float:
    return arbiter.inbox.ages(arbiter.config.timeouts)["command"]


def test_a_stamp_ahead_counts_from_its_arrival() -> None:
    bus, clock = clocked()
    latest = bus.add(ArbiterNode).inbox.sources["command"]
    bus.publish("/operator/cmd_vel", twist_stamped(0.2, 0.0, clock.now_ns() + 100 * S))
    clock.set(clock.steady_ns() + 2 * S)
    assert latest.stamp_age_s == pytest.approx(2.0)


@JUMPS
def test_the_virtual_robot_obeys_no_old_state_after_the_clock_was_set(jump_s: int) -> None:
    bus, clock = clocked()
    node = bus.add(VirtualRobotNode)
    state = build("instant_ic_msgs/msg/ControlState", {"header": {"stamp": "now"}}, clock.now_ns() - S // 5)
    bus.publish("/ic/state", state, latched=True)
    assert node.state.fresh is not None
    clock.set_by_ns = jump_s * S
    assert node.state.fresh is not None
    clock.set(clock.steady_ns() + 2 * S // 5)  # 0.6 s since it was given, 0.4 s since it came
    assert node.state.fresh is None


@JUMPS
def test_silent_scans_are_reported_after_the_clock_was_set(jump_s: int) -> None:
    bus, clock = clocked()
    node = bus.add(GridSlamNode)
    mount = transform_message(pose_matrix(z=0.6), "base_link", "velodyne", clock.now_ns())
    bus.publish("/tf_static", TFMessage([mount]), latched=True)
    bus.publish("/wheel/odom", odometry_message(np.eye(4), 0.0, 0.0, "odom", "base_link", clock.now_ns()))
    ranges = np.full(720, 3.0, np.float32)
    bus.publish("/scan", scan_message(ranges, -np.pi, np.pi / 360, 0.1, 30.0, "velodyne", clock.now_ns()))
    assert node.queue.last_ns is not None
    clock.set_by_ns = jump_s * S
    clock.set(clock.steady_ns() + 2 * S)
    node.watch()
    level, text, _ = node.diagnoses()["scan"]
    assert (level, text) == (ERROR, "No scan for 2.0 s. Check vlp16_driver")


def test_images_from_files_go_on_when_the_clock_is_set_back(tmp_path: Path) -> None:
    cv2.imwrite(str(tmp_path / "a.png"), np.zeros((16, 32, 3), np.uint8))
    bus, clock = clocked()
    bus.add(ThetaCameraNode, ThetaCameraConfig(source="files", url=str(tmp_path)))
    bus.advance(1.0)
    before = len(bus.messages("/camera/image/compressed"))
    clock.set_by_ns = -3600 * S
    bus.advance_to(clock.steady_ns() + S)
    assert before > 0 and len(bus.messages("/camera/image/compressed")) == 2 * before


def test_images_and_the_button_count_from_their_publication() -> None:
    """They are not decoded, or have no stamp; a busy arbiter reads them up to 0.2 s after their publication."""
    bus, clock = clocked()
    arbiter = bus.add(ArbiterNode, ArbiterConfig(timeouts=TimeoutConfig(estop_input=1.0)))
    image = compressed_image_message(b"jpeg", "camera", clock.now_ns() - S)
    for topic, message in (("/camera/image/compressed", image), ("/robot/estop", Bool(data=False))):
        payload = bytes(serialize(message))
        bus.route(topic, type_name(message), payload, "device", SENSOR, clock.now_ns() - S // 5)
    bus.advance(0.0)
    ages = arbiter.inbox.ages(arbiter.config.timeouts)
    assert (ages["camera"], ages["estop_input"]) == (pytest.approx(0.2), pytest.approx(0.2))


def test_a_command_without_a_stamp_is_stale_from_the_start() -> None:
    bus, _ = clocked()
    arbiter = bus.add(ArbiterNode)
    bus.publish("/operator/cmd_vel", twist_stamped(0.2, 0.0, 0))
    assert command_age(arbiter) > 1e9


@JUMPS
def test_silent_sources_stop_the_robot_after_the_clock_was_set(jump_s: int) -> None:
    bus, clock = clocked()
    arbiter = bus.add(ArbiterNode)
    bus.publish("/camera/image/compressed", compressed_image_message(b"jpeg", "camera", clock.now_ns()))
    assert arbiter.inbox.ages(arbiter.config.timeouts)["camera"] == 0.0
    clock.set_by_ns = jump_s * S
    for _ in range(300):  # 3 s without any message
        clock.set(clock.steady_ns() + S // 100)
        arbiter.spin_once()
    assert arbiter.inbox.ages(arbiter.config.timeouts)["camera"] == pytest.approx(3.0)
    state = bus.last("/ic/state")
    assert state.mode == ControlState.STOPPED and "No camera image for 3.0 s" in state.reason
    assert 0 <= clock.now_ns() - stamp_ns(state) < S // 5  # stamps are those of the clock as it is now
    assert len(bus.records("/cmd_vel")) >= 25  # 10 a second for a robot that stands, none left out
    assert all(message.twist.linear.x == 0.0 for message in bus.messages("/cmd_vel"))


@pytest.mark.parametrize("back_s", [10, 3600])
def test_obstacles_come_nearer_after_the_clock_was_set_back(back_s: int) -> None:
    bus, clock = clocked()
    arbiter = bus.add(ArbiterNode)

    def at(x_m: float) -> tuple[float, float]:
        """Places of the robot in the map, and of a thing at x = 5 m ahead of it, as the arbiter knows them."""
        clock.set(clock.steady_ns() + S // 10)
        stamp = clock.now_ns()
        for parent, child, x in (("map", "odom", 0.0), ("odom", "base_link", x_m), ("base_link", "velodyne", 0.0)):
            bus.publish("/tf", TFMessage([transform_message(pose_matrix(x=x), parent, child, stamp)]))
        bus.publish("/scan", scan_message(np.full(3, 5.0 - x_m), -0.01, 0.01, 0.4, 20.0, "velodyne", stamp))
        arbiter.spin_once()
        pose, near = arbiter.surroundings.robot_pose(), arbiter.surroundings.near_points(arbiter.inbox.scan())
        assert pose is not None and near is not None
        return float(pose[0]), float(near[1, 0])

    assert at(1.0) == pytest.approx((1.0, 4.0))
    clock.set_by_ns = -back_s * S
    assert at(2.0) == pytest.approx((2.0, 3.0))
    assert at(3.0) == pytest.approx((3.0, 2.0))


def test_v_bot_makes_no_leap_when_the_clock_is_set() -> None:
    bus, clock = clocked()
    node = bus.add(VirtualRobotNode)
    before_ns = node.stepped_ns
    clock.set_by_ns = -3600 * S
    clock.set(clock.steady_ns() + S // 5)
    node.spin_once()
    assert node.stepped_ns - before_ns == S // 5
