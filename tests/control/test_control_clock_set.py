"""The machine's clock is set back while the arbiter runs: what falls silent then is still seen to be silent."""

import numpy as np
import pytest

from instant_ic.bus.clock import ManualClock
from instant_ic.bus.lockstep import LockstepBus
from instant_ic.geometry.poses import pose_matrix
from instant_ic.msg import (
    ControlState,
    TFMessage,
    compressed_image_message,
    scan_message,
    stamp_ns,
    transform_message,
)
from nodes.arbiter import ArbiterNode
from nodes.virtual_robot import VirtualRobotNode

S = 1_000_000_000


class SetClock(ManualClock):
    """A machine's clock that was set by ``set_by`` nanoseconds."""

    set_by = 0

    def now_ns(self) -> int:
        return self._now_ns + self.set_by

    def steady_ns(self) -> int:
        return self._now_ns


@pytest.mark.parametrize("jump_s", [-3600, 3600], ids=["back", "forward"])
def test_silent_sources_stop_the_robot_after_the_clock_was_set(jump_s: int) -> None:
    bus = LockstepBus(1_700_000_000 * S)
    clock = bus.clock = SetClock(1_700_000_000 * S)
    arbiter = bus.add(ArbiterNode)
    bus.publish("/camera/image/compressed", compressed_image_message(b"jpeg", "camera", clock.now_ns()))
    assert arbiter.inbox.ages(arbiter.config.timeouts)["camera"] == 0.0
    clock.set_by = jump_s * S
    for _ in range(300):  # 3 s without any message
        clock.set(clock.steady_ns() + S // 100)
        arbiter.spin_once()
    assert arbiter.inbox.ages(arbiter.config.timeouts)["camera"] == pytest.approx(3.0)
    state = bus.last("/ic/state")
    assert state.mode == ControlState.STOPPED and "no camera image for 3.0 s" in state.reason
    assert 0 <= clock.now_ns() - stamp_ns(state) < S // 5  # stamps are those of the clock as it is now
    assert len(bus.records("/cmd_vel")) >= 25  # 10 a second for a robot that stands, none left out
    assert all(message.twist.linear.x == 0.0 for message in bus.messages("/cmd_vel"))


@pytest.mark.parametrize("back_s", [10, 3600])
def test_obstacles_come_nearer_after_the_clock_was_set_back(back_s: int) -> None:
    bus = LockstepBus(1_700_000_000 * S)
    clock = bus.clock = SetClock(1_700_000_000 * S)
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
    clock.set_by = -back_s * S
    assert at(2.0) == pytest.approx((2.0, 3.0))
    assert at(3.0) == pytest.approx((3.0, 2.0))


def test_v_bot_makes_no_leap_when_the_clock_is_set() -> None:
    bus = LockstepBus(1_700_000_000 * S)
    clock = bus.clock = SetClock(1_700_000_000 * S)
    node = bus.add(VirtualRobotNode)
    before_ns = node.stepped_ns
    clock.set_by = -3600 * S
    clock.set(clock.steady_ns() + S // 5)
    node.spin_once()
    assert node.stepped_ns - before_ns == S // 5
