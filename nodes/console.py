"""Node of the operator's page. It sends images, state and map, and receives commands, emergency stop and look."""

from __future__ import annotations

from datetime import datetime
from pathlib import Path
from typing import Any

from instant_ic import msg
from instant_ic.bus import LATCHED, RELIABLE, SENSOR, Node, NodeError, main
from instant_ic.bus.control import ControlError, NodeControl, NodeMissingError
from instant_ic.bus.timers import Timer
from instant_ic.bus.topics import Subscription
from instant_ic.console import ConsoleBackend, ConsoleError, ConsoleServer, FrameKind, Look
from instant_ic.console.backend import PageServer
from instant_ic.console.config import ConsoleConfig
from instant_ic.console.display import Display
from instant_ic.console.feed import PLAN_PERIOD_S, STATE_PERIOD_S, Inputs, PageFeed
from instant_ic.console.recording import RecorderError, RecordingDesk
from instant_ic.control.robot_lease import RELEASED
from instant_ic.util.paths import sign_in_file
from instant_ic.util.web_access import AccessError, offer_sign_in

RECORDER_TIMEOUT_S = 3.0


class ConsoleNode(Node[ConsoleConfig], ConsoleBackend):
    """Connects the page's server to topics. ``PageFeed`` feeds the page, the node handles the operator's actions."""

    name = "console"
    live_parameters = ("view",)
    feed: PageFeed

    def __init__(self, *wiring: Any, page: PageServer | None = None, **named: Any) -> None:
        super().__init__(*wiring, **named)
        self.page = page
        """Receiver of images and state, but not of layers; None uses the node's own server."""

    def setup(self) -> None:
        config = self.config
        self.command_out = self.publisher("/operator/cmd_vel", msg.TwistStamped, qos=SENSOR)
        self.estop_out = self.publisher("/operator/estop", msg.Bool, qos=LATCHED)
        self.bookmark_out = self.publisher("/operator/bookmark", msg.String, qos=RELIABLE)
        requests = self.publisher("/view/request", msg.ViewRequest, qos=SENSOR)
        shown = self.publisher("/view/shown", msg.ShownPictures, qos=SENSOR)
        inputs = Inputs(
            control=self.latest("/ic/state", msg.ControlState, 1.0, LATCHED, lambda m: self.feed.take_control(m)),
            vbot=self.latest("/vbot/odom", msg.Odometry, 0.5, SENSOR, lambda m: self.feed.take_vbot(m)),
            trajectory=self.latest("/ic/trajectory", msg.Path, max_age_s=0.5),
            path=self.latest("/nav/path", msg.Path, max_age_s=5.0),
            subgoal=self.latest("/ic/subgoal", msg.PoseStamped, max_age_s=1.0),
            vspace=self.latest("/vspace/status", msg.VspaceStatus, max_age_s=5.0, qos=LATCHED),
            battery=self.latest("/battery", msg.BatteryState, max_age_s=5.0),
        )
        try:
            self.server = ConsoleServer(self, config.server, config.page())
        except ConsoleError as error:
            raise NodeError(str(error)) from error
        self.recording = RecordingDesk(self.ask_recorder, lambda status: self.server.publish("recording", status))
        display = Display(self.tf, self.clock, inputs.control, inputs.vbot, config.camera_mount)
        self.feed = feed = PageFeed(self, self.page or self.server, display, inputs, requests.publish, shown.publish)
        self.subscribe("/camera/image/compressed", msg.CompressedImage, feed.take_panorama, qos=SENSOR)
        self.subscribe("/vspace/view", msg.RenderedView, feed.take_view, qos=SENSOR)
        self.subscribe("/map", msg.OccupancyGrid, lambda m: feed.take_grid(FrameKind.MAP, m), qos=LATCHED)
        self.subscribe("/costmap", msg.OccupancyGrid, lambda m: feed.take_grid(FrameKind.COSTMAP, m), qos=SENSOR)
        self.subscribe("/diagnostics", msg.DiagnosticArray, feed.faults.take_diagnoses, qos=RELIABLE)
        self.subscribe("/heartbeat", msg.NodeStatus, feed.faults.take_heartbeat, qos=RELIABLE)
        self.mesher = self.background(feed.layers_of, feed.take_layers)  # takes 30 ms, which must not delay commands
        self.layers: Subscription | None = None
        self.timer(1.0, feed.send_health)
        self.page_timers: list[Timer] = []
        self.feed_page(self.run_dir is None)  # in lockstep, no page connects later
        for warning in self.server.warnings:
            self.log.warning(warning)
        if self.run_dir is not None:
            self.start_server(sign_in_file(self.run_dir, self.node_name))

    def start_server(self, sign_in: Path) -> None:
        try:
            self.server.start()
            self.log.info("open %s in a browser", self.server.url)
            sign_in.unlink(missing_ok=True)  # may be left by a console that was killed
            if self.server.access.made_token:
                offer_sign_in(self.server.sign_in_url, sign_in)
        except (ConsoleError, AccessError) as error:
            raise NodeError(str(error)) from error
        self.timer(1.0, self.recording.poll)

    def feed_page(self, watched: bool) -> None:
        """Send everything while there is a page. Without one, keep only what a new page gets at once."""
        self.feed.watched = watched
        self.be_patient(not watched)
        if self.layers is not None:  # a subscription without a page would cost CPU, also in `nerf`
            self.drop(self.layers)
            self.layers = None
        if watched and self.page is None:
            self.layers = self.subscribe("/vspace/layers", msg.VspaceLayers, self.mesher.submit, qos=LATCHED)
        for timer in self.page_timers:
            timer.cancel()
        rates = (
            (STATE_PERIOD_S, self.feed.send_state_if_due),
            (PLAN_PERIOD_S, self.feed.send_plan),
            (1.0 / self.config.map_rate_hz, self.feed.send_grids),
        )
        self.page_timers = [self.timer(*rate) for rate in rates] if watched else []

    def reconfigure(self, config: ConsoleConfig) -> None:
        super().reconfigure(config)
        self.feed.views.config = config.view

    def teardown(self) -> None:
        if hasattr(self, "server"):
            self.server.stop()  # first, because it stops the robot
            if self.run_dir is not None:
                sign_in_file(self.run_dir, self.node_name).unlink(missing_ok=True)
        if hasattr(self, "recording"):
            self.recording.stop()

    # ---- Backend: the operator's actions, on the server's thread -----------------------------------

    def on_drive(self, linear: float, angular: float) -> None:
        # Publish from the server's thread, because a detour through the node's thread would add latency.
        self.command_out.publish(msg.twist_stamped(linear, angular, self.clock.now_ns(), self.server.drive.client))

    def on_released(self, client: str) -> None:
        self.command_out.publish(msg.twist_stamped(0.0, 0.0, self.clock.now_ns(), client + RELEASED))

    def on_operator(self, there: bool) -> None:
        if not there:
            self.feed.lose_driver()

    def on_estop(self, stop: bool) -> None:
        self.estop_out.publish(msg.Bool(data=stop))

    def on_look(self, look: Look) -> None:
        self.feed.views.look = look

    def on_watched(self, watched: bool) -> None:
        self.call_soon(self.feed_page, watched)

    def on_drawn(self) -> None:
        self.feed.report_shown()

    def on_recorder(self, command: str, on: bool) -> None:
        if command == "record":
            self.recording.record(on)
        elif command == "snapshot":
            self.recording.snapshot()
        else:
            name = f"bookmark {datetime.now():%H:%M:%S}"
            self.bookmark_out.publish(msg.String(data=name))  # recorded in every recording and snapshot
            self.recording.bookmark(name)

    def ask_recorder(self, command: str, **arguments: Any) -> Any:
        """Call the recorder node on the desk's thread. A RecorderError holds a message for the operator."""
        if self.run_dir is None:
            raise RecorderError("The recorder is not available: this node has no run directory.")
        try:
            return NodeControl(self.run_dir, self.config.recorder, RECORDER_TIMEOUT_S).call(command, **arguments)
        except NodeMissingError:
            text = f"No recorder is running. Launch the station with recorder:=true (node {self.config.recorder})."
            raise RecorderError(text) from None
        except ControlError as error:
            raise RecorderError(f"recorder: {error}") from None


if __name__ == "__main__":
    main(ConsoleNode)
