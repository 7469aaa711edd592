"""Ages over the whole stack: by the stamp once on arrival, by the steady clock from then on."""

from pathlib import Path

import cv2
import numpy as np
import pytest
from base_line import SetClock

from instant_ic.bus import ERROR, SENSOR
from instant_ic.bus.lockstep import LockstepBus
from instant_ic.camera.files import FileCamera
from instant_ic.cli.message_input import build
from instant_ic.control.arbiter_config import ArbiterConfig
from instant_ic.control.freshness import TimeoutConfig
from instant_ic.geometry.poses import pose_matrix
from instant_ic.msg import (
    Bool,
    TFMessage,
    compressed_image_message,
    odometry_message,
    scan_message,
    serialize,
    transform_message,
    twist_stamped,
    type_name,
)
from nodes.arbiter import ArbiterNode
from nodes.grid_slam import GridSlamNode
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


@JUMPS
def test_setting_the_clock_makes_nothing_older_or_younger(jump_s: int) -> None:
    bus, clock = clocked()
    arbiter = bus.add(ArbiterNode)
    latest = arbiter.inbox.sources["command"]
    bus.publish("/operator/cmd_vel", twist_stamped(0.2, 0.0, clock.now_ns() - S // 5))
    assert (latest.age_s, latest.stamp_age_s) == (0.0, pytest.approx(0.2))
    clock.set_by_ns = jump_s * S
    assert latest.stamp_age_s == pytest.approx(0.2)
    assert command_age(arbiter) == pytest.approx(0.2)
    clock.set(clock.steady_ns() + S)
    assert command_age(arbiter) == pytest.approx(1.2)


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
    assert (level, text) == (ERROR, "no scan for 2.0 s")


def test_images_from_files_go_on_when_the_clock_is_set_back(tmp_path: Path) -> None:
    cv2.imwrite(str(tmp_path / "a.png"), np.zeros((16, 32, 3), np.uint8))
    now, waits = [START_NS], []
    with FileCamera(tmp_path, now_ns=lambda: now[0], sleep=waits.append) as camera:
        camera.read()
        now[0] -= 3600 * S
        camera.read()
        camera.read()
    assert max(waits, default=0.0) <= 1.0 / camera.config.rate_hz


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
