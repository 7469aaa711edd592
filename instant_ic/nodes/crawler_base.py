"""Drives the tracked base over its RoboClaw controller and tells its odometry, battery and faults."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any

import numpy as np

from instant_ic.base.config import RoboclawConfig
from instant_ic.base.controller import BaseController, BaseState, ControllerConfig, ControllerThread, Health
from instant_ic.base.odometry import OdometryEstimate
from instant_ic.base.recent import RecentCount
from instant_ic.base.roboclaw import SerialPort, open_serial
from instant_ic.bus import ERROR, LATCHED, OK, SENSOR, WARN, Node, NodeError, main
from instant_ic.geometry.poses import matrix_from_pose2
from instant_ic.msg import (
    BatteryState,
    Bool,
    Odometry,
    Twist,
    TwistStamped,
    deserialize,
    header,
    odometry_message,
    stamp_ns,
    twist_values,
    type_name,
)
from instant_ic.pace import current
from instant_ic.ranges import NotNegative, Positive, Range, check_ranges

_TWISTS = {type_name(Twist): False, type_name(TwistStamped): True}
"""Types that /cmd_vel may carry, and whether they have a stamp."""


@dataclass(frozen=True)
class CrawlerBaseConfig(ControllerConfig):
    """Parameters, on top of those of the controller.

    Attributes:
        rate_hz: commands and odometry a second.
        odom_frame: parent of the base's frame.
        base_frame: the base's own frame.
        battery_full_v: main battery when full, volts.
        battery_empty_v: main battery when it has to be charged, volts; lower is a warning.
        recent_s: repeats, dropped commands and impossible readings are a warning for this long.
        connect_grace_s: a controller that is not there yet is an error only this long after the start.
    """

    rate_hz: Annotated[float, Range(5, 200)] = 30.0
    odom_frame: str = "odom"
    base_frame: str = "base_link"
    battery_full_v: float = 25.2
    battery_empty_v: float = 21.0
    recent_s: Positive = 10.0
    connect_grace_s: NotNegative = 5.0

    def __post_init__(self) -> None:
        """Check the values."""
        super().__post_init__()
        check_ranges(self)
        if not 0.0 < self.battery_empty_v < self.battery_full_v:
            raise ValueError(
                "battery_empty_v must be > 0 and below battery_full_v "
                f"(got {self.battery_empty_v}, {self.battery_full_v})"
            )


class CrawlerBaseNode(Node[CrawlerBaseConfig]):
    """See the module."""

    name = "crawler_base"
    live_parameters = ("battery_full_v", "battery_empty_v")
    open_port: Callable[[RoboclawConfig], SerialPort] = staticmethod(open_serial)

    def setup(self) -> None:
        """Topics, and the loop that talks to the controller."""
        self.thread: ControllerThread | None = None
        self.refuse_pace()
        self.controller = BaseController(self.config, self.clock.now_ns, type(self).open_port)
        self.odometry = self.publisher("/wheel/odom", Odometry, qos=SENSOR)
        self.button_out = self.publisher("/robot/estop", Bool, qos=LATCHED)
        self.button: bool | None = None  # the controller's emergency stop input
        self.battery = self.publisher("/battery", BatteryState, qos=SENSOR)
        self.subscribe_raw("/cmd_vel", self.on_command, qos=SENSOR)
        self.started_ns = self.clock.now_ns()
        self.linked = False  # since the start, once
        self.dropped = self.retries_told = self.rejected_told = 0
        self.drops, self.repeats, self.jumps = (RecentCount(self.config.recent_s) for _ in range(3))
        self.diagnose("link", WARN, f"connecting to {self.config.roboclaw.port}")
        self.timer(1.0, self.tell_recent)
        if self.lockstep:
            self.timer(1.0 / self.config.rate_hz, lambda: self.on_state(self.controller.step()))
            return
        self.thread = ControllerThread(
            self.controller,
            self.config.rate_hz,
            on_state=lambda state: self.call_soon(self.on_state, state),
            on_end=lambda fault, unstopped: self.call_soon(self.on_end, fault, unstopped),
        )
        self.thread.start()

    def refuse_pace(self) -> None:
        """A real base in slow motion would be stopped late: only the simulator's, in the run directory, may be.

        Raises:
            NodeError: the stack's time is not the machine's, and the port is not the simulator's.
        """
        pace, folder = current(), self.run_dir
        if pace.real or (folder is not None and Path(self.config.roboclaw.port).is_relative_to(folder)):
            return
        raise NodeError(
            f"the stack runs at pace {pace.factor:g}, for simulated devices only, and {self.config.roboclaw.port} is "
            f"not the simulator's (in {folder}): start without --pace"
        )

    def on_command(self, topic: str, name: str, payload: bytes | memoryview, published_ns: int) -> None:
        """Hand a command on, unless it is too old or no twist."""
        if name not in _TWISTS:
            raise NodeError(f"{topic} carries {name}; expected {' or '.join(_TWISTS)}")
        message: Any = deserialize(payload, name)
        now_ns = self.clock.now_ns()
        stamp = stamp_ns(message) if _TWISTS[name] else 0
        stamp = stamp or now_ns
        v, w = twist_values(message)
        age_s = (now_ns - stamp) * 1e-9
        if not (math.isfinite(v) and math.isfinite(w)):
            self.refuse(f"command is not finite (v={v}, w={w})")
        elif abs(age_s) > self.config.command_timeout_s:
            self.refuse(
                f"command is {age_s:.2f} s old"
                if age_s > 0
                else f"command's stamp is {-age_s:.2f} s ahead: set the clocks"
            )
        else:
            self.controller.command(v, w, stamp)
            if not self.drops.count(now_ns):
                self.diagnose("command", OK, "driving by /cmd_vel", dropped=self.dropped)

    def refuse(self, reason: str) -> None:
        """Tell of a command that is not obeyed."""
        self.dropped += 1
        self.drops.add(1, self.clock.now_ns())
        self.diagnose("command", WARN, f"dropped: {reason}", dropped=self.dropped)

    def on_state(self, state: BaseState) -> None:
        """Publish what a step of the controller gave."""
        if state.link:
            self.tell_link(state.connected, state.link)
        if state.odometry is not None:
            self.publish_odometry(state.odometry)
        if state.health is not None:
            self.publish_health(state.health)

    def tell_link(self, connected: bool, text: str) -> None:
        """What happened on the line; at start, while the controller may still be coming, its absence is a warning."""
        self.linked |= connected
        starting = not self.linked and self.clock.now_ns() - self.started_ns < self.config.connect_grace_s * 1e9
        self.diagnose("link", OK if connected else WARN if starting else ERROR, text)

    def tell_recent(self) -> None:
        """What happened in the last ``recent_s``: repeats, impossible readings, dropped commands."""
        now_ns, counters, window = self.clock.now_ns(), self.controller.roboclaw.counters, f"{self.config.recent_s:g} s"
        self.repeats.add(counters.retries - self.retries_told, now_ns)
        self.retries_told = counters.retries
        repeated = self.repeats.count(now_ns)
        self.diagnose(
            "replies",
            WARN if repeated else OK,
            f"{repeated} commands repeated in the last {window}" if repeated else "no command had to be repeated",
            repeated=counters.retries,
            timeouts=counters.timeouts,
            crc_errors=counters.crc_errors,
            transactions=counters.transactions,
        )
        rejected = self.controller.odometry.rejected
        self.jumps.add(rejected - self.rejected_told, now_ns)
        self.rejected_told = rejected
        jumps = self.jumps.count(now_ns)
        text = f"{jumps} readings of the last {window} were impossible jumps and left out" if jumps else "plausible"
        self.diagnose("encoders", WARN if jumps else OK, text, rejected=rejected)
        if self.dropped and not self.drops.count(now_ns):
            self.diagnose("command", OK, f"none dropped in the last {window}", dropped=self.dropped)

    def publish_odometry(self, estimate: OdometryEstimate) -> None:
        """Odometry message and transform."""
        odom_from_base = matrix_from_pose2(estimate.pose)
        message = odometry_message(
            odom_from_base,
            float(estimate.twist[0]),
            float(estimate.twist[2]),
            self.config.odom_frame,
            self.config.base_frame,
            estimate.stamp_ns,
            pose_covariance=estimate.pose_covariance,
            twist_covariance=estimate.twist_covariance,
        )
        message.twist.twist.linear.y = float(estimate.twist[1])
        self.odometry.publish(message)
        self.tf_broadcast(self.config.odom_frame, self.config.base_frame, odom_from_base, estimate.stamp_ns)

    def publish_health(self, health: Health) -> None:
        """Battery message, and what the controller says of its faults."""
        config = self.config
        charge = (health.battery_v - config.battery_empty_v) / (config.battery_full_v - config.battery_empty_v)
        nan, none = float("nan"), np.zeros(0, np.float32)
        self.battery.publish(
            BatteryState(
                header=header(config.base_frame, health.stamp_ns),
                voltage=health.battery_v,
                temperature=nan,
                current=nan,
                charge=nan,
                capacity=nan,
                design_capacity=nan,
                percentage=min(1.0, max(0.0, charge)),
                power_supply_status=BatteryState.POWER_SUPPLY_STATUS_DISCHARGING,
                power_supply_health=BatteryState.POWER_SUPPLY_HEALTH_UNKNOWN,
                power_supply_technology=BatteryState.POWER_SUPPLY_TECHNOLOGY_UNKNOWN,
                present=True,
                cell_voltage=none,
                cell_temperature=none,
                location="base",
                serial_number="",
            )
        )
        low = health.battery_v < config.battery_empty_v
        text = f"{health.battery_v:.1f} V" + (f", below {config.battery_empty_v} V: charge it" if low else "")
        self.diagnose("battery", WARN if low else OK, text)
        faults, warnings = health.status.faults, health.status.warnings
        pressed = "emergency stop" in faults
        if pressed != self.button:
            self.button = pressed
            self.button_out.publish(Bool(data=pressed))
        self.diagnose(
            "controller",
            ERROR if faults else WARN if warnings else OK,
            ", ".join(faults + warnings) or "no faults",
            status=f"0x{health.status.value:0{2 * health.status.size}x}",
        )

    def on_end(self, fault: BaseException | None, unstopped: str) -> None:
        """The serial thread has ended: tell why, and end the node unless it is ending anyway."""
        if unstopped:
            self.log.error("motors could not be told to stop (%s); the controller's watchdog does it", unstopped)
        if fault is not None:
            self.diagnose("link", ERROR, f"serial thread failed: {fault!r}")
            self.log.error("serial thread failed", exc_info=fault)
            self.stop()

    def teardown(self) -> None:
        """Stop the motors."""
        thread = getattr(self, "thread", None)
        if thread is not None:
            if not thread.end():
                self.log.error("the serial thread does not end; the controller's watchdog stops the motors")
        elif hasattr(self, "controller"):
            self.on_end(None, self.controller.close())


if __name__ == "__main__":
    main(CrawlerBaseNode)
