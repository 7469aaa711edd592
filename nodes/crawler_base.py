"""Drives the tracked base through its RoboClaw controller; publishes odometry, battery and faults."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

from instant_ic.base.command_gate import CommandGate
from instant_ic.base.config import CrawlerBaseConfig, RoboclawConfig
from instant_ic.base.controller import BaseController, BaseState, ControllerThread, Health
from instant_ic.base.odometry import OdometryEstimate
from instant_ic.base.pace import refuse_pace
from instant_ic.base.report import BaseReport
from instant_ic.base.roboclaw import SerialPort, open_serial
from instant_ic.bus import ERROR, LATCHED, SENSOR, WARN, Node, NodeError, main
from instant_ic.bus.transport import Received
from instant_ic.control.estop import EstopLatch
from instant_ic.geometry.poses import matrix_from_pose2
from instant_ic.msg import (
    HARD_STOP,
    BatteryState,
    Bool,
    Odometry,
    Twist,
    TwistStamped,
    battery_message,
    deserialize,
    odometry_message,
    stamp_ns,
    twist_values,
    type_name,
)
from instant_ic.pace import PaceError, current

_TWISTS = (type_name(TwistStamped), type_name(Twist))
"""Types allowed on /cmd_vel."""


class CrawlerBaseNode(Node[CrawlerBaseConfig]):
    name = "crawler_base"
    live_parameters = ("battery_full_v", "battery_empty_v")
    open_port: Callable[[RoboclawConfig], SerialPort] = staticmethod(open_serial)

    def setup(self) -> None:
        """Create the topics and the control loop."""
        config = self.config
        self.thread: ControllerThread | None = None
        try:
            refuse_pace(current(), config.roboclaw.port, self.run_dir)
        except PaceError as error:
            raise NodeError(str(error)) from None
        self.controller = BaseController(config, self.clock.now_ns, self.clock.steady_ns, type(self).open_port)
        also = "/cmd_vel is also published by %s; it must be the arbiter alone"
        self.gate = CommandGate(config, lambda publisher: self.log.warning(also, publisher))
        self.report = BaseReport(config, self.controller, self.clock.steady_ns())
        self.latch = EstopLatch()
        self.button: bool | None = None  # state of the controller's emergency stop input
        self.hard = False  # the newest command is a hard stop
        self.odometry = self.publisher("/wheel/odom", Odometry, qos=SENSOR)
        self.button_out = self.publisher("/robot/estop", Bool, qos=LATCHED)
        self.battery = self.publisher("/battery", BatteryState, qos=SENSOR)
        self.diagnose("link", WARN, f"connecting to {config.roboclaw.port}")
        self.diagnose_all(self.latch.diagnosis, self.gate.publishers)
        self.timer(1.0, self.watch)
        if self.lockstep:
            self.timer(1.0 / config.rate_hz, self.hurry)
        else:
            self.thread = ControllerThread(
                self.controller,
                config.rate_hz,
                on_state=self.on_step,
                on_end=lambda fault, unstopped: self.call_soon(self.on_end, fault, unstopped),
            )
        self.subscribe_received("/operator/estop", self.on_estop, qos=LATCHED, message_class=Bool)
        self.subscribe_received("/robot/estop", self.on_button, qos=LATCHED, message_class=Bool)
        self.subscribe_received("/cmd_vel", self.on_command, qos=SENSOR)
        if self.thread is not None:
            self.thread.start()

    def reconfigure(self, config: CrawlerBaseConfig) -> None:
        super().reconfigure(config)
        self.report.config = config

    def hurry(self) -> None:
        """Make the controller step now."""
        if self.thread is not None:
            self.thread.hurry()
        else:
            self.on_step(self.controller.step())

    def on_command(self, received: Received) -> None:
        """Pass a command to the controller if the gate admits it."""
        if self.gate.admit_publisher(received.publisher, self.clock.steady_ns()):
            self.drive(received)
        self.diagnose_all(self.gate.publishers, self.gate.command)

    def drive(self, received: Received) -> None:
        """Decode the driving node's command and pass it on unless it is stale, unstamped or not finite."""
        name = received.type_name
        if name not in _TWISTS:
            raise NodeError(f"{received.topic} carries {name}; expected {' or '.join(_TWISTS)}")
        message: Any = deserialize(received.payload, name)
        stamp = stamp_ns(message) if hasattr(message, "header") else 0
        v, w = twist_values(message)
        if not self.gate.admit(v, w, stamp, received.received_ns, self.clock.steady_ns()):
            return
        hard = stamp != 0 and message.header.frame_id == HARD_STOP
        self.controller.command(v, w, received.given_ns(stamp) if stamp else received.steady_ns, hard)
        if hard and not self.hard:
            self.hurry()
        self.hard = hard

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
        self.diagnose_all(self.latch.diagnosis)

    def on_step(self, state: BaseState) -> None:
        """Publish the result of a controller step, the odometry at once; called on the serial thread."""
        if state.odometry is not None:
            self.publish_odometry(state.odometry)
        if state.link or state.health is not None:
            self.call_soon(self.on_state, state)

    def on_state(self, state: BaseState) -> None:
        """Publish the state of link and controller."""
        if state.link:
            self.diagnose_all(self.report.link(state.connected, state.link, self.clock.steady_ns()))
        if state.health is not None:
            self.publish_health(state.health)

    def publish_odometry(self, estimate: OdometryEstimate) -> None:
        """Publish the odometry message and its transform."""
        odom_from_base, frames = matrix_from_pose2(estimate.pose), (self.config.odom_frame, self.config.base_frame)
        v, lateral, w = (float(part) for part in estimate.twist)
        covariances = (estimate.pose_covariance, estimate.twist_covariance)
        message = odometry_message(odom_from_base, v, w, *frames, estimate.stamp_ns, *covariances)
        message.twist.twist.linear.y = lateral
        self.odometry.publish(message)
        self.tf_broadcast(*frames, odom_from_base, estimate.stamp_ns)

    def publish_health(self, health: Health) -> None:
        """Publish the battery message, the controller's faults and its emergency stop input."""
        charge = self.report.charge(health)
        self.battery.publish(battery_message(health.battery_v, charge, self.config.base_frame, health.stamp_ns))
        self.diagnose_all(*self.report.health(health))
        pressed = health.status.estop
        if pressed != self.button:
            self.button = pressed
            self.button_out.publish(Bool(data=pressed))
            self.latch.hear_button(pressed, self.node_name, self.clock.now_ns())
            self.obey_latch()

    def watch(self) -> None:
        """Report the last ``recent_s``: repeats, impossible readings, dropped commands."""
        now_ns = self.clock.steady_ns()
        self.gate.update(now_ns)
        self.diagnose_all(*self.report.recent(now_ns), self.gate.publishers, self.gate.command)

    def on_end(self, fault: BaseException | None, unstopped: str) -> None:
        """Report why the serial thread ended, and end the node unless it is ending anyway."""
        if unstopped:
            self.log.error("no stop could be sent to the motors (%s); the controller's watchdog stops them", unstopped)
        if fault is not None:
            self.diagnose("link", ERROR, f"serial thread failed: {fault!r}")
            self.log.error("serial thread failed", exc_info=fault)
            self.stop()

    def teardown(self) -> None:
        thread = getattr(self, "thread", None)
        if thread is not None:
            if not thread.end():
                self.log.error("the serial thread does not end; the controller's watchdog stops the motors")
        elif hasattr(self, "controller"):
            self.on_end(None, self.controller.close())


if __name__ == "__main__":
    main(CrawlerBaseNode)
