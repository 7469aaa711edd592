"""Drives the tracked base through its RoboClaw controller; publishes odometry, battery and faults."""

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
from instant_ic.bus.transport import Received
from instant_ic.config.ranges import NotNegative, Positive, Range, check_ranges
from instant_ic.control.estop import EstopLatch
from instant_ic.geometry.poses import matrix_from_pose2
from instant_ic.msg import (
    HARD_STOP,
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

_TWISTS = (type_name(TwistStamped), type_name(Twist))
"""Types allowed on /cmd_vel."""
_LEAST_PERIODS = 3
"""Commands that may be missing before the controller's watchdog stops the motors."""


@dataclass(frozen=True)
class CrawlerBaseConfig(ControllerConfig):
    """Parameters, in addition to those of the controller.

    Attributes:
        rate_hz: commands and odometry messages per second.
        odom_frame: parent of the base's frame.
        base_frame: the base's own frame.
        battery_full_v: main battery when full, volts.
        battery_empty_v: voltage of the main battery when it needs charging, volts; lower voltages warn.
        recent_s: seconds for which repeats, dropped commands and impossible readings remain a warning.
        connect_grace_s: seconds after the start for which a missing controller is not an error yet.
        command_source: name of the only node whose commands are obeyed; empty: any node.
        accept_unstamped: also obey commands without a stamp, with their arrival time as stamp.
    """

    rate_hz: Annotated[float, Range(5, 200)] = 30.0
    odom_frame: str = "odom"
    base_frame: str = "base_link"
    battery_full_v: float = 25.2
    battery_empty_v: float = 21.0
    recent_s: Positive = 10.0
    connect_grace_s: NotNegative = 5.0
    command_source: str = "arbiter"
    accept_unstamped: bool = False

    def __post_init__(self) -> None:
        super().__post_init__()
        check_ranges(self)
        if not 0.0 < self.battery_empty_v < self.battery_full_v:
            raise ValueError(
                "battery_empty_v must be > 0 and below battery_full_v "
                f"(got {self.battery_empty_v}, {self.battery_full_v})"
            )
        if self.roboclaw.watchdog_s < _LEAST_PERIODS / self.rate_hz:
            raise ValueError(
                f"roboclaw.watchdog_s must span {_LEAST_PERIODS} periods of rate_hz "
                f"(got {self.roboclaw.watchdog_s} s at {self.rate_hz} Hz)"
            )


class CrawlerBaseNode(Node[CrawlerBaseConfig]):
    name = "crawler_base"
    live_parameters = ("battery_full_v", "battery_empty_v")
    open_port: Callable[[RoboclawConfig], SerialPort] = staticmethod(open_serial)

    def setup(self) -> None:
        """Create the topics and the control loop."""
        self.thread: ControllerThread | None = None
        self.refuse_pace()
        self.controller = BaseController(self.config, self.clock.now_ns, self.clock.steady_ns, type(self).open_port)
        self.odometry = self.publisher("/wheel/odom", Odometry, qos=SENSOR)
        self.button_out = self.publisher("/robot/estop", Bool, qos=LATCHED)
        self.button: bool | None = None  # state of the controller's emergency stop input
        self.latch = EstopLatch()
        self.battery = self.publisher("/battery", BatteryState, qos=SENSOR)
        self.strangers: dict[str, int] = {}  # other publishers of /cmd_vel, with the time of their last message
        self.driver = self.config.command_source  # the obeyed node; with any source allowed, the last publisher
        self.hard = False  # the newest command is a hard stop
        self.diagnose("publishers", OK, "no second publisher of /cmd_vel")
        self.show_latch()
        self.started_ns = self.clock.steady_ns()
        self.linked = False  # connected once since the start
        self.dropped = self.retries_told = self.rejected_told = 0
        self.drops, self.repeats, self.jumps = (RecentCount(self.config.recent_s) for _ in range(3))
        self.diagnose("link", WARN, f"connecting to {self.config.roboclaw.port}")
        self.timer(1.0, self.tell_recent)
        if self.lockstep:
            self.timer(1.0 / self.config.rate_hz, self.hurry)
        else:
            self.thread = ControllerThread(
                self.controller,
                self.config.rate_hz,
                on_state=lambda state: self.call_soon(self.on_state, state),
                on_end=lambda fault, unstopped: self.call_soon(self.on_end, fault, unstopped),
            )
        self.subscribe_received("/operator/estop", self.on_estop, qos=LATCHED, message_class=Bool)
        self.subscribe_received("/robot/estop", self.on_button, qos=LATCHED, message_class=Bool)
        self.subscribe_received("/cmd_vel", self.on_command, qos=SENSOR)
        if self.thread is not None:
            self.thread.start()

    def hurry(self) -> None:
        """Make the controller step now."""
        if self.thread is not None:
            self.thread.hurry()
        else:
            self.on_state(self.controller.step())

    def refuse_pace(self) -> None:
        """Refuse to run a real base on scaled time: it would stop late. Only the simulator's base may.

        Raises:
            NodeError: the stack's time is not the machine's, and the port is not the simulator's in the run directory.
        """
        pace, folder = current(), self.run_dir
        if pace.real or (folder is not None and Path(self.config.roboclaw.port).is_relative_to(folder)):
            return
        raise NodeError(
            f"the stack runs at pace {pace.factor:g}, for simulated devices only, and {self.config.roboclaw.port} is "
            f"not the simulator's (in {folder}): start without --pace"
        )

    def on_command(self, received: Received) -> None:
        """Pass a command to the controller unless it is another node's, stale, unstamped or not a twist."""
        name = received.type_name
        if not self.accepted(received.publisher):
            return
        if name not in _TWISTS:
            raise NodeError(f"{received.topic} carries {name}; expected {' or '.join(_TWISTS)}")
        message: Any = deserialize(received.payload, name)
        stamp = stamp_ns(message) if hasattr(message, "header") else 0
        v, w = twist_values(message)
        age_s = (received.received_ns - stamp) * 1e-9
        if not (math.isfinite(v) and math.isfinite(w)):
            self.refuse(f"command is not finite (v={v}, w={w})")
        elif stamp == 0 and not self.config.accept_unstamped:
            self.refuse(f"command of {received.publisher} has no stamp (accept_unstamped is false)")
        elif stamp and age_s > self.config.command_timeout_s:
            self.refuse(f"command is {age_s:.2f} s old")
        elif age_s < 0:
            self.refuse(f"command's stamp is {-age_s:.2f} s ahead: set the clocks")
        else:
            hard = stamp != 0 and message.header.frame_id == HARD_STOP
            self.controller.command(v, w, received.given_ns(stamp) if stamp else received.steady_ns, hard)
            if hard and not self.hard:
                self.hurry()
            self.hard = hard
            if not self.drops.count(self.clock.steady_ns()):
                self.diagnose("command", OK, "driving by /cmd_vel", dropped=self.dropped)

    def accepted(self, publisher: str) -> bool:
        """Whether a node's commands are obeyed; warns of every publisher besides the driving node."""
        if not self.config.command_source and publisher != self.driver:
            if self.driver:
                self.warn_of(self.driver)
            self.driver = publisher
        if publisher == self.driver:
            return True
        self.warn_of(publisher)
        self.refuse(f"{publisher} may not drive, only {self.driver} (command_source)")
        return False

    def warn_of(self, publisher: str) -> None:
        """Report a second publisher of /cmd_vel."""
        if publisher not in self.strangers:
            self.log.warning("/cmd_vel is also published by %s; it must be the arbiter alone", publisher)
        self.strangers[publisher] = self.clock.steady_ns()
        self.diagnose("publishers", WARN, f"/cmd_vel is also published by {publisher}: stop that node")

    def on_estop(self, received: Received) -> None:
        """Obey any client's emergency stop here too, whatever the arbiter does."""
        pressed = bool(deserialize(received.payload, received.type_name).data)
        refused = self.latch.hear(pressed, received.publisher, received.publish_ns, received.received_ns)
        if refused:
            self.log.warning("emergency stop not released: %s", refused)
        self.obey_latch()

    def on_button(self, received: Received) -> None:
        """Obey another node's button; the controller's own input arrives with its status."""
        if received.publisher != self.node_name:
            pressed = bool(deserialize(received.payload, received.type_name).data)
            self.latch.hear_button(pressed, received.publisher, received.publish_ns)
            self.obey_latch()

    def obey_latch(self) -> None:
        """Hold the motors while the emergency stop is latched."""
        self.controller.emergency_stop(self.latch.stopped)
        if self.latch.stopped:
            self.hurry()
        self.show_latch()

    def show_latch(self) -> None:
        """Report the state of the emergency stop."""
        if not self.latch.stopped:
            self.diagnose("emergency stop", OK, "released")
            return
        by = "a button on the robot" if self.latch.button else self.latch.publisher
        self.diagnose("emergency stop", WARN, f"latched by {by}: release it on the operator's page")

    def refuse(self, reason: str) -> None:
        """Report a command that was refused."""
        self.dropped += 1
        self.drops.add(1, self.clock.steady_ns())
        self.diagnose("command", WARN, f"dropped: {reason}", dropped=self.dropped)

    def on_state(self, state: BaseState) -> None:
        """Publish the result of a controller step."""
        if state.link:
            self.tell_link(state.connected, state.link)
        if state.odometry is not None:
            self.publish_odometry(state.odometry)
        if state.health is not None:
            self.publish_health(state.health)

    def tell_link(self, connected: bool, text: str) -> None:
        """Report a change of the serial link; soon after the start, a missing controller is only a warning."""
        self.linked |= connected
        starting = not self.linked and self.clock.steady_ns() - self.started_ns < self.config.connect_grace_s * 1e9
        self.diagnose("link", OK if connected else WARN if starting else ERROR, text)

    def tell_recent(self) -> None:
        """Report the last ``recent_s``: repeats, impossible readings, dropped commands."""
        now_ns, counters, window = (
            self.clock.steady_ns(),
            self.controller.roboclaw.counters,
            f"{self.config.recent_s:g} s",
        )
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
            stops=counters.stops,
        )
        rejected = self.controller.odometry.rejected
        self.jumps.add(rejected - self.rejected_told, now_ns)
        self.rejected_told = rejected
        jumps = self.jumps.count(now_ns)
        text = f"{jumps} readings of the last {window} were impossible jumps and left out" if jumps else "plausible"
        self.diagnose("encoders", WARN if jumps else OK, text, rejected=rejected)
        if self.dropped and not self.drops.count(now_ns):
            self.diagnose("command", OK, f"none dropped in the last {window}", dropped=self.dropped)
        if self.strangers and now_ns - max(self.strangers.values()) > self.config.recent_s * 1e9:
            self.strangers.clear()
            self.diagnose("publishers", OK, f"no second publisher of /cmd_vel in the last {window}")

    def publish_odometry(self, estimate: OdometryEstimate) -> None:
        """Publish the odometry message and its transform."""
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
        """Publish the battery message and the controller's faults."""
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
            self.latch.hear_button(pressed, self.node_name, self.clock.now_ns())
            self.obey_latch()
        self.diagnose(
            "controller",
            ERROR if faults else WARN if warnings else OK,
            ", ".join(faults + warnings) or "no faults",
            status=f"0x{health.status.value:0{2 * health.status.size}x}",
        )

    def on_end(self, fault: BaseException | None, unstopped: str) -> None:
        """Report why the serial thread ended, and end the node unless it is ending anyway."""
        if unstopped:
            self.log.error("no stop could be sent to the motors (%s); the controller's watchdog stops them", unstopped)
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
