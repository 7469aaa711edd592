"""Drives the tracked base through its RoboClaw controller; publishes odometry, battery and faults."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

from instant_ic.adapters.base import estimate_message, read_command
from instant_ic.base.command_source import CommandSource
from instant_ic.base.config import CrawlerBaseConfig, RoboclawConfig
from instant_ic.base.controller import BaseController, BaseState, ControllerThread, Health, SteppedController
from instant_ic.base.pace import refuse_pace
from instant_ic.base.report import BaseReport
from instant_ic.base.roboclaw import ControllerStatus, SerialPort, open_serial
from instant_ic.bus import ERROR, LATCHED, SENSOR, WARN, Node, NodeError, main
from instant_ic.bus.transport import Received
from instant_ic.control.estop import EstopLatch
from instant_ic.geometry.poses import matrix_from_pose2
from instant_ic.msg import BatteryState, Bool, ControlState, Odometry, battery_message, deserialize
from instant_ic.util.pace import PaceError, current
from instant_ic.util.step_gap import BRIEF_S

OWN_STEP_S = 0.1
"""Period at which the node's thread records that it is running, for the serial thread."""

STATE_S = 1.0
"""Age in seconds up to which the arbiter's state is used."""


class CrawlerBaseNode(Node[CrawlerBaseConfig]):
    name = "crawler_base"
    live_parameters = ("battery_full_v", "battery_empty_v")

    def __init__(
        self, *wiring: Any, open_port: Callable[[RoboclawConfig], SerialPort] = open_serial, **named: Any
    ) -> None:
        super().__init__(*wiring, **named)
        self.open_port = open_port

    def setup(self) -> None:
        config = self.config
        try:
            refuse_pace(current(), config.roboclaw.port, self.run_dir)
        except PaceError as error:
            raise NodeError(str(error)) from None
        clock = self.clock
        self.controller = BaseController(config, clock.now_ns, clock.steady_ns, self.open_port, clock.suspended_ns)
        self.stepped_ns = clock.steady_ns()  # last step of the node's thread
        also = "/cmd_vel is also published by %s. Stop that node: only the arbiter may publish it"
        self.source = CommandSource(config, lambda publisher: self.log.warning(also, publisher))
        self.report = BaseReport(config, self.controller, self.clock.steady_ns())
        self.latch = EstopLatch()
        self.button: bool | None = None  # whether the controller or a faulty track holds the base stopped
        self.status: ControllerStatus | None = None  # newest status; used only on the serial thread
        self.hard = False  # whether the newest command is a hard stop
        self.odometry = self.publisher("/wheel/odom", Odometry, qos=SENSOR)
        self.button_out = self.publisher("/robot/estop", Bool, qos=LATCHED)
        self.battery = self.publisher("/battery", BatteryState, qos=SENSOR)
        self.diagnose("link", WARN, f"connecting to {config.roboclaw.port}")
        if config.unprotected_by:
            text = f"Protection is off ({', '.join(config.unprotected_by)}): commands of any node or age move the robot"
            self.diagnose("protection", WARN, text)
        if not config.roboclaw.estop_pin:
            text = "No stop button (roboclaw.estop_pin is empty): only the operator's page can stop the robot"
            self.diagnose("button", WARN, f"{text}. Wire one to the controller")
        self.diagnose_all(self.latch.diagnosis, self.source.publishers, self.report.tracks())
        self.timer(1.0, self.watch)
        self.timer(OWN_STEP_S, self.note_step)
        loop_class = SteppedController if self.lockstep else ControllerThread
        self.loop = loop_class(self.controller, config.rate_hz, self.on_step, self.on_end)
        if self.lockstep:
            self.timer(1.0 / config.rate_hz, self.loop.hurry)
        self.state = self.latest("/ic/state", ControlState, STATE_S, LATCHED)  # who may release the emergency stop
        self.subscribe_received("/operator/estop", self.on_estop, qos=LATCHED, message_class=Bool)
        self.subscribe_received("/robot/estop", self.on_button, qos=LATCHED, message_class=Bool)
        self.subscribe_received("/cmd_vel", self.on_command, qos=SENSOR)
        self.loop.start()

    def reconfigure(self, config: CrawlerBaseConfig) -> None:
        super().reconfigure(config)
        self.report.config = config

    def on_command(self, received: Received) -> None:
        """Pass on a command of the driving node unless it is stale, unstamped or not finite."""
        now_ns = self.clock.steady_ns()
        if self.source.admit_publisher(received.publisher, now_ns):
            command = read_command(received)
            if self.source.admit(command.v, command.w, command.stamp_ns, received.received_ns, now_ns):
                self.controller.command(command.v, command.w, command.given_ns, command.hard)
                if command.hard and not self.hard:
                    self.loop.hurry()
                self.hard = command.hard
        self.diagnose_all(self.source.publishers, self.source.command)

    def on_estop(self, received: Received) -> None:
        """Obey any client's emergency stop here too, independent of the arbiter."""
        pressed = bool(deserialize(received.payload, received.type_name).data)
        holder = None if self.state.message is None else self.state.message.holder
        refused = self.latch.hear(pressed, received.publisher, received.publish_ns, received.received_ns, holder)
        if refused:
            self.log.warning("emergency stop not released: %s", refused)
        self.obey_latch()

    def on_button(self, received: Received) -> None:
        """Obey another node's stop button. The controller's own input arrives with its status."""
        if received.publisher != self.node_name:
            pressed = bool(deserialize(received.payload, received.type_name).data)
            self.latch.hear_button(pressed, received.publisher, received.publish_ns)
            self.obey_latch()

    def obey_latch(self) -> None:
        """Hold the motors while the emergency stop is latched."""
        self.controller.emergency_stop(self.latch.stopped)
        if self.latch.stopped:
            self.loop.hurry()
        else:
            self.report.release()
            self.diagnose_all(self.report.tracks())
        self.diagnose_all(self.latch.diagnosis)

    def on_step(self, state: BaseState) -> None:
        """Publish the result of a controller step, the odometry at once, on the serial thread."""
        # If the node's thread hangs, no command arrives. The arbiter must see this as a loss of the base.
        if state.odometry is not None and self.clock.steady_ns() - self.stepped_ns <= BRIEF_S * 1e9:
            self.odometry.publish(estimate_message(state.odometry))
            matrix, stamp = matrix_from_pose2(state.odometry.pose), state.odometry.stamp_ns
            self.transforms.broadcast("odom", "base_link", matrix, stamp)
        changed, self.status = state.status != self.status, state.status
        if state.link or state.fault or changed or state.health is not None:
            self.call_soon(self.on_state, state)

    def note_step(self) -> None:
        """Record a step of the node's own thread."""
        self.stepped_ns = self.clock.steady_ns()

    def on_state(self, state: BaseState) -> None:
        if state.link:
            self.diagnose_all(self.report.link(state.connected, state.link, self.clock.steady_ns()))
        if state.restarted:
            self.report.restarted()
            self.press(True)
        if state.health is not None:
            self.publish_health(state.health)
        if state.status is not None:
            self.diagnose_all(self.report.controller(state.status))
            self.press(bool(state.status.faults))
        if state.fault:
            self.press(True)
            found = self.report.tracks(state.fault)
            self.log.error("%s", found.text)
            self.diagnose_all(found)

    def publish_health(self, health: Health) -> None:
        """Publish the battery message."""
        charge = self.report.charge(health)
        self.battery.publish(battery_message(health.battery_v, charge, "base_link", health.stamp_ns))
        self.diagnose_all(self.report.battery(health))

    def press(self, pressed: bool) -> None:
        """Report the robot's stop button. A controller fault counts as pressed, a faulty track does for a moment."""
        if pressed != self.button:
            self.button = pressed
            self.button_out.publish(Bool(data=pressed))
            self.latch.hear_button(pressed, self.node_name, self.clock.now_ns())
            self.obey_latch()

    def watch(self) -> None:
        """Report repeats, impossible readings and dropped commands in the last ``recent_s``."""
        now_ns = self.clock.steady_ns()
        self.source.update(now_ns)
        self.diagnose_all(*self.report.recent(now_ns), self.source.publishers, self.source.command)

    def on_end(self, fault: BaseException | None, unstopped: str) -> None:
        """Report why the loop ended, on the serial thread. After a fault, end the node."""
        if unstopped:
            self.log.error("no stop could be sent to the motors (%s); the controller's watchdog stops them", unstopped)
        if fault is not None:
            self.log.error("serial thread failed", exc_info=fault)
            self.call_soon(self.diagnose, "link", ERROR, f"serial thread failed: {fault!r}")
            self.call_soon(self.stop)

    def teardown(self) -> None:
        if hasattr(self, "loop") and not self.loop.end():
            self.log.error("the serial thread does not end; the controller's watchdog stops the motors")


if __name__ == "__main__":
    main(CrawlerBaseNode)
