"""The node in lockstep with an emulated controller: driving, stopping, losing and finding it again."""

from __future__ import annotations

import dataclasses
import threading

import numpy as np
import pytest
from base_ports import EmulatorPort, opener

from instant_ic.base.config import RoboclawConfig
from instant_ic.base.controller import RECONNECT_MAX_S, BaseController, ControllerConfig, ControllerThread
from instant_ic.bus import ERROR, OK, WARN
from instant_ic.bus.lockstep import LockstepBus
from instant_ic.msg import Twist, Vector3, matrix_from_pose, stamp_ns, twist_stamped, twist_values
from instant_ic.sim.roboclaw_emulator import RoboclawEmulator
from instant_ic.util.diagnosis import RecentCount
from nodes.crawler_base import CrawlerBaseConfig, CrawlerBaseNode

MILLISECOND = 1_000_000


class Bench:
    """A bus with the node on it, and an emulator whose time moves with the bus."""

    def __init__(self, **changes: object) -> None:
        self.emulator = RoboclawEmulator()
        self.port = EmulatorPort(self.emulator)

        self.bus = LockstepBus(start_ns=1_000_000_000_000)
        config = CrawlerBaseConfig(roboclaw=RoboclawConfig(port="memory"))
        self.node = self.bus.add(CrawlerBaseNode, dataclasses.replace(config, **changes), open_port=opener(self.port))

    def run(self, seconds: float, v: float | None = None, w: float = 0.0) -> None:
        """Move on in steps of a millisecond; with v, a command comes each 50 ms."""
        for step in range(round(seconds * 1000)):
            now_ns = self.bus.clock.now_ns()
            if v is not None and step % 50 == 0:
                self.command(twist_stamped(v, w, now_ns))
            self.emulator.advance(0.001)
            self.bus.advance_to(now_ns + MILLISECOND)

    def command(self, message: object, publisher: str = "arbiter") -> None:
        self.bus.publish("/cmd_vel", message, publisher=publisher)

    def level(self, name: str) -> int:
        return self.node.diagnoses()[name][0]


@pytest.fixture
def bench() -> Bench:
    return Bench()


def test_drives_forward_and_tells_odometry_transform_and_battery(bench: Bench) -> None:
    bench.run(2.0, v=0.4)
    # 4000 pulses a metre: 0.4 m/s are 1600 pulses/s on both motors.
    np.testing.assert_allclose(bench.emulator.target_speed_pps, 1600.0, atol=1.0)
    odometry = bench.bus.last("/wheel/odom")
    assert (odometry.header.frame_id, odometry.child_frame_id) == ("odom", "base_link")
    assert twist_values(odometry)[0] == pytest.approx(0.4, abs=0.02)
    # 0.5 s of ramp (0.8 m/s^2) lose 0.1 m of 0.8 m; connecting and steps lose a little more.
    assert 0.60 < matrix_from_pose(odometry)[0, 3] < 0.71
    assert len(bench.bus.records("/wheel/odom")) > 50
    transform = bench.bus.last("/tf").transforms[0]
    assert transform.transform.translation.x == pytest.approx(matrix_from_pose(odometry)[0, 3])
    assert stamp_ns(transform) == stamp_ns(odometry)
    assert bench.bus.last("/battery").voltage == pytest.approx(24.1)
    assert bench.level("link") == bench.level("battery") == bench.level("controller") == OK


def test_old_and_senseless_commands_are_dropped_and_told(bench: Bench) -> None:
    bench.run(0.2)
    now_ns = bench.bus.clock.now_ns()
    bench.command(twist_stamped(0.5, 0.0, now_ns - 310 * MILLISECOND))
    assert bench.node.diagnoses()["command"][:2] == (WARN, "dropped: command is 0.31 s old, at most 0.25 s allowed")
    bench.command(twist_stamped(0.5, 0.0, now_ns + 900 * MILLISECOND))
    assert "0.90 s ahead" in bench.node.diagnoses()["command"][1]
    bench.command(twist_stamped(float("nan"), 0.0, now_ns))
    assert "not finite" in bench.node.diagnoses()["command"][1]
    bench.run(0.2)
    assert bench.emulator.target_speed_pps.tolist() == [0.0, 0.0]
    assert bench.node.source.dropped == 3


def test_unstamped_twist_is_refused_or_counts_from_its_arrival() -> None:
    bench = Bench(accept_unstamped=True, unprotected=True)
    bench.run(0.1)
    zero = Vector3(x=0.0, y=0.0, z=0.0)
    bench.command(Twist(linear=Vector3(x=0.2, y=0.0, z=0.0), angular=zero))
    bench.run(0.2)
    assert bench.emulator.target_speed_pps.min() > 0.0
    bench.run(0.7)
    assert bench.emulator.target_speed_pps.max() == 0.0
    refusing = Bench()
    refusing.run(0.1)
    refusing.command(Twist(linear=Vector3(x=0.2, y=0.0, z=0.0), angular=zero))
    refusing.command(twist_stamped(0.2, 0.0, 0))
    refusing.run(0.2)
    assert refusing.emulator.target_speed_pps.max() == 0.0
    assert "has no stamp" in refusing.node.diagnoses()["command"][1] and refusing.node.source.dropped == 2


def test_closing_the_node_stops_the_motors_at_once(bench: Bench) -> None:
    bench.run(1.0, v=0.5)
    bench.bus.close()
    assert bench.emulator.target_speed_pps.tolist() == [0.0, 0.0]
    assert bench.port.closed


def test_unplugged_and_plugged_in_again(bench: Bench) -> None:
    bench.run(0.5, v=0.3)
    bench.port.unplugged = True
    bench.run(0.1)
    assert bench.level("link") == ERROR
    before = len(bench.bus.records("/wheel/odom"))
    bench.run(1.0)
    assert len(bench.bus.records("/wheel/odom")) == before
    bench.port.unplugged = False
    bench.run(2.0)  # within the backoff that has grown by now
    assert bench.level("link") == OK
    assert len(bench.bus.records("/wheel/odom")) > before
    assert bench.emulator.timeout_s == pytest.approx(0.3)  # the watchdog is set again


def test_low_battery_and_faults_are_told(bench: Bench) -> None:
    bench.emulator.battery_v = 20.4
    bench.emulator.status = 0x0040
    bench.run(1.5)
    assert bench.node.diagnoses()["battery"][:2] == (WARN, "20.4 V, below 21.0 V: charge it")
    level, text, _ = bench.node.diagnoses()["controller"]
    assert level == ERROR and text.startswith("driver fault M1. The robot has stopped")
    assert bench.bus.last("/battery").percentage == 0.0


def test_recent_events_leave_the_window() -> None:
    recent = RecentCount(10.0)
    assert recent.count(0) == 0
    recent.add(2, 0)
    recent.add(0, 10**9)
    recent.add(3, 4 * 10**9)
    assert [recent.count(t * 10**9) for t in (5, 9, 10, 13, 14)] == [5, 5, 3, 3, 0]


def test_repeats_are_told() -> None:
    bench = Bench(recent_s=2.0)
    bench.run(0.2)
    damages = iter([True])
    bench.port.damage = lambda reply: b"\x00" * len(reply) if next(damages, False) else reply
    bench.run(1.1)
    level, text, values = bench.node.diagnoses()["replies"]
    assert (level, text, values["repeated"]) == (WARN, "1 commands repeated in the last 2 s", 1)
    bench.run(1.0)
    assert bench.level("replies") == WARN
    bench.run(1.1)
    assert bench.level("replies") == OK


def test_a_controller_that_is_not_there_yet_is_an_error_only_after_a_while(bench: Bench) -> None:
    bench.port.unplugged = True
    bench.run(4.9)
    assert bench.level("link") == WARN
    bench.run(2.1)  # the longest wait between two tries
    assert bench.level("link") == ERROR
    bench.port.unplugged = False
    bench.run(2.1)
    assert bench.level("link") == OK


def test_thread_stops_the_motors_when_its_work_fails() -> None:
    emulator = RoboclawEmulator()
    port = EmulatorPort(emulator)
    now = [10**12]
    controller = BaseController(
        ControllerConfig(roboclaw=RoboclawConfig(port="memory")), lambda: now[0], lambda: now[0], opener(port)
    )
    ended = threading.Event()
    told: list[object] = []
    states = []

    def on_state(state: object) -> None:
        states.append(state)
        now[0] += 30 * MILLISECOND
        controller.command(0.5, 0.0, now[0])
        if len(states) == 10:
            assert emulator.target_speed_pps.max() > 0.0
            raise RuntimeError("broken")

    def on_end(fault: BaseException | None, unstopped: str) -> None:
        told.extend((str(fault), unstopped))
        ended.set()

    thread = ControllerThread(controller, 500.0, on_state, on_end)
    thread.start()
    assert ended.wait(30.0)
    assert thread.end()
    assert told == ["broken", ""]
    assert emulator.target_speed_pps.tolist() == [0.0, 0.0]
    assert port.closed


def test_clock_set_back_delays_neither_the_next_connection_nor_the_next_battery_reading() -> None:
    port = EmulatorPort(RoboclawEmulator())
    now, steady = [10**15], [10**12]
    config = ControllerConfig(roboclaw=RoboclawConfig(port="memory"))
    controller = BaseController(config, lambda: now[0], lambda: steady[0], opener(port))
    assert controller.step().connected and controller.step().health is not None
    port.unplugged = True
    assert not controller.step().connected
    port.unplugged = False
    now[0] -= 3600 * 1000 * MILLISECOND  # an hour back, while a new try is planned by the old time
    for _ in range(2):
        steady[0] += int(RECONNECT_MAX_S * 1000) * MILLISECOND
        state = controller.step()
    assert state.connected
    steady[0] += int(config.health_period_s * 1000) * MILLISECOND
    assert controller.step().health is not None


def test_an_encoder_reading_that_is_picked_up_late_costs_no_motion_and_gives_no_false_speed() -> None:
    """At 0.4 m/s. The counts are right, but 120 ms old when the busy process takes them; the next ones are not."""
    emulator = RoboclawEmulator()
    port, now = EmulatorPort(emulator), [10**12]
    config = ControllerConfig(roboclaw=RoboclawConfig(port="memory"))
    controller = BaseController(config, lambda: now[0], lambda: now[0], opener(port))
    controller.step()
    controller.step()  # the first reading
    read = controller.roboclaw.encoders
    late_s = 0.0

    def drive(seconds: float) -> None:
        now[0] += round(seconds * 1e9)
        emulator.encoder += 0.4 * seconds * config.geometry.pulses_per_metre

    def encoders() -> np.ndarray:
        counts = read()
        drive(late_s)
        return counts

    controller.roboclaw.encoders = encoders  # type: ignore[method-assign]
    estimates = []
    for after_s, late_s in ((0.03, 0.0), (0.03, 0.12), (0.01, 0.0), (0.03, 0.0)):  # noqa: B007 - read by `encoders`
        drive(after_s)
        estimates.append(controller.step().odometry)
    assert controller.odometry.rejected == 0
    assert estimates[1] is None
    taken = [one for one in estimates if one is not None]
    assert [float(one.pose[0]) for one in taken] == pytest.approx([0.012, 0.076, 0.088], abs=1e-3)
    assert [float(one.twist[0]) for one in taken] == pytest.approx([0.4, 0.4, 0.4], abs=0.01)


def test_readings_that_are_all_late_are_taken_now_and_then() -> None:
    now = [10**12]
    config = ControllerConfig(roboclaw=RoboclawConfig(port="memory"))
    controller = BaseController(config, lambda: now[0], lambda: now[0], opener(EmulatorPort(RoboclawEmulator())))
    read = controller.roboclaw.encoders

    def encoders() -> np.ndarray:
        now[0] += 50 * MILLISECOND
        return read()

    controller.roboclaw.encoders = encoders  # type: ignore[method-assign]
    taken = [controller.step().odometry is not None for _ in range(10)]
    assert taken == [False, False, False, False, False, True, False, False, False, True]  # the first gives no estimate
