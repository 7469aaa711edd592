"""Serves the operator's page: sends it images, state and map; takes its commands, emergency stop and look direction."""

from __future__ import annotations

import base64
import math
import os
import sys
from dataclasses import dataclass, field
from typing import Annotated, Any

import numpy as np

from instant_ic.bus import ERROR, LATCHED, OK, RELIABLE, SENSOR, WARN, Node, NodeError, main
from instant_ic.bus.control import ControlError, NodeControl, NodeMissingError
from instant_ic.config.ranges import Positive, Range, check_ranges
from instant_ic.config.robot import CAMERA_MOUNT, Mount, Rectangle
from instant_ic.console import (
    ConsoleError,
    ConsoleServer,
    FrameKind,
    Lead,
    LeadConfig,
    Look,
    ServerConfig,
    ViewConfig,
    ViewScheduler,
)
from instant_ic.console.gridimage import grey_png, grid_image
from instant_ic.console.recording import RecorderError, RecordingDesk
from instant_ic.console.server import PLAIN_HTTP
from instant_ic.console.view import view_shape
from instant_ic.geometry.poses import Matrix, pose2_from_matrix, quaternion_from_matrix, transform_points
from instant_ic.geometry.transforms import TransformError
from instant_ic.msg import (
    BatteryState,
    Bool,
    CompressedImage,
    ControlState,
    DiagnosticArray,
    NodeStatus,
    OccupancyGrid,
    Odometry,
    Path,
    PoseStamped,
    RenderedView,
    ShownPictures,
    String,
    TwistStamped,
    ViewRequest,
    VspaceStatus,
    grid_array,
    header,
    matrix_from_pose,
    path_array,
    pose_message,
    stamp_ns,
    to_time,
    twist_stamped,
    twist_values,
)
from instant_ic.paths import sign_in_file

MODES = {0: "real", 1: "virtual", 2: "stopped", 3: "entering", 4: "returning"}
VSPACE_STATES = {0: "empty", 1: "training", 2: "ready", 3: "failed"}
HEARTBEAT_TIMEOUT_S = 3.0
RECORDER_TIMEOUT_S = 3.0
PICTURE_TIMEOUT_S = 2.0
MAX_FAULTS = 4


@dataclass(frozen=True)
class ConsoleConfig:
    """Parameters.

    Attributes:
        lead: rendered views are moved to the v-bot's present position by their depth.
        state_rate_hz: rate at which mode, poses and commands are sent to the page.
        map_rate_hz: highest rate at which a changed map or costmap is sent to the page.
        dissolve_ms: duration of the dissolve between camera and rendered view; 0 = cut.
        ease_ms: time in which the remaining offset between the two robots' poses is eased out of the image; 0 = at
            once.
        colour_release_s: the new image at a switch takes the colours of the old one and returns to its own in this
            time; 0 = no colour matching.
        recorder: node behind the page's record, snapshot and bookmark buttons.
    """

    server: ServerConfig = field(default_factory=ServerConfig)
    view: ViewConfig = field(default_factory=ViewConfig)
    lead: LeadConfig = field(default_factory=LeadConfig)
    state_rate_hz: Positive = 20.0
    map_rate_hz: Positive = 2.0
    dissolve_ms: Annotated[float, Range(0, 5000)] = 250.0
    ease_ms: Annotated[float, Range(0, 5000)] = 400.0
    colour_release_s: Annotated[float, Range(0, 60)] = 6.0
    footprint: Rectangle = field(default_factory=Rectangle)
    camera_mount: Mount = CAMERA_MOUNT
    recorder: str = "operator_recorder"

    def __post_init__(self) -> None:
        check_ranges(self)


class ConsoleNode(Node[ConsoleConfig]):
    """Backend of a :class:`ConsoleServer`: connects the page to the topics."""

    name = "console"
    live_parameters = ("view",)

    def setup(self) -> None:
        config = self.config
        self.command_out = self.publisher("/operator/cmd_vel", TwistStamped, qos=SENSOR)
        self.estop_out = self.publisher("/operator/estop", Bool, qos=LATCHED)
        self.bookmark_out = self.publisher("/operator/bookmark", String, qos=RELIABLE)
        self.request_out = self.publisher("/view/request", ViewRequest, qos=SENSOR)
        self.shown_out = self.publisher("/view/shown", ShownPictures, qos=SENSOR)
        self.control = self.latest("/ic/state", ControlState, max_age_s=1.0, qos=LATCHED)
        self.subscribe("/ic/state", ControlState, self.on_control, qos=LATCHED)
        self.vbot = self.latest("/vbot/odom", Odometry, max_age_s=0.5)
        self.trajectory = self.latest("/ic/trajectory", Path, max_age_s=0.5)
        self.path = self.latest("/nav/path", Path, max_age_s=5.0)
        self.subgoal = self.latest("/ic/subgoal", PoseStamped, max_age_s=1.0)
        self.vspace = self.latest("/vspace/status", VspaceStatus, max_age_s=5.0, qos=LATCHED)
        self.battery = self.latest("/battery", BatteryState, max_age_s=5.0)
        self.subscribe("/camera/image/compressed", CompressedImage, self.on_panorama, qos=SENSOR)
        self.subscribe("/vspace/view", RenderedView, self.on_view, qos=SENSOR)
        self.subscribe("/vbot/odom", Odometry, self.on_vbot, qos=SENSOR)
        self.subscribe("/map", OccupancyGrid, self.on_map, qos=LATCHED)
        self.subscribe("/costmap", OccupancyGrid, self.on_costmap, qos=SENSOR)
        self.subscribe("/diagnostics", DiagnosticArray, self.on_diagnostics, qos=RELIABLE)
        self.subscribe("/heartbeat", NodeStatus, self.on_heartbeat, qos=RELIABLE)
        self.look = Look()
        self.views = ViewScheduler(config.view)
        self.mode = self.shown = "none"
        self._picture_ns: int | None = None
        self._picture_stamp = 0
        self._view = (0, 0, 0.0)  # driver's newest view: request id, arrival (steady ns), delay (s)
        self._drawn: tuple[Matrix, bool] | None = None  # that view's camera pose, and whether it carries depth
        self._displayed = pose_message(np.eye(4))  # pose from which the page shows that view
        self.lead = Lead(config.lead)
        self._told_ns = 0
        self._lost_ns: int | None = None  # when the driver was last lost
        self._wanted: tuple[Matrix, Look] | None = None  # pose and look of the last request
        self._asked: dict[int, int] = {}  # recent requests: id -> send time (steady ns)
        self._grids: dict[FrameKind, Any] = {}
        self._grid_digests: dict[FrameKind, int] = {}
        self._diagnoses_seen: dict[str, tuple[int, str, float]] = {}
        self._heartbeats: dict[str, tuple[float, bool]] = {}
        self.tf  # noqa: B018 - subscribes to /tf now, not at the first image
        page = {
            "dissolve_ms": config.dissolve_ms,
            "ease_ms": config.ease_ms,
            "colour_release_s": config.colour_release_s,
            "lead_max_m": config.lead.max_m,
            "footprint": [config.footprint.length_m, config.footprint.width_m],
            "camera": [0.0, 0.0, config.camera_mount.xyz[2]],
        }
        self._map: OccupancyGrid | None = None
        self.recording = RecordingDesk(self.ask_recorder, lambda told: self.server.publish("recording", told))
        try:
            self.server = ConsoleServer(self, config.server, page)
            if not self.lockstep:
                self.server.start()
                self.recording.start()
        except ConsoleError as error:
            raise NodeError(str(error)) from error
        if not self.lockstep:
            self.log.info("open %s in a browser", self.server.url)
            self.offer_sign_in()
        if self.server.plain_http:
            self.log.warning(PLAIN_HTTP)
        if self.server.access.unguarded:
            self.log.warning("anyone on the network may drive, because server.access.sign_in is never")
        self.timer(1.0 / config.state_rate_hz, self.tell_state)
        self.timer(0.2, self.send_plan)
        self.timer(1.0, self.send_health)
        self.timer(1.0 / config.map_rate_hz, self.send_grids)

    def offer_sign_in(self) -> None:
        """Write the address with the token to a private file, and to the terminal.

        The token is never logged, because the log goes to ``/rosout`` and into bags.
        """
        assert self.run_dir is not None
        file = sign_in_file(self.run_dir, self.node_name)
        try:
            file.unlink(missing_ok=True)  # left by a console that was killed
            if not self.server.access.made_token:
                return
            with os.fdopen(os.open(file, os.O_WRONLY | os.O_CREAT | os.O_EXCL, 0o600), "w") as out:
                out.write(f"{self.server.sign_in_url}\n")
        except OSError as error:
            raise NodeError(f"cannot write the address with the token to {file}: {error.strerror}") from error
        self.log.info("the address with the token is in %s", file)
        if sys.stdout.isatty():  # `ic run console`; the launcher shows the address itself
            sys.stdout.write(f"sign in at {self.server.sign_in_url}\n")
            sys.stdout.flush()

    def reconfigure(self, config: ConsoleConfig) -> None:
        super().reconfigure(config)
        self.views.config = config.view

    def teardown(self) -> None:
        if hasattr(self, "server"):
            self.server.stop()  # first, because it stops the robot
            if self.run_dir is not None:
                sign_in_file(self.run_dir, self.node_name).unlink(missing_ok=True)
            self.recording.stop()

    # ---- operator actions, called on the server's thread ----------------------------------------

    def on_drive(self, linear: float, angular: float) -> None:
        """Publish a command at once: a detour through the node's thread would add latency."""
        self.command_out.publish(twist_stamped(linear, angular, self.clock.now_ns()))

    def on_operator(self, there: bool) -> None:
        """Report a lost driver to the arbiter at once. His return shows in his commands."""
        if not there:
            self._lost_ns = self.clock.steady_ns()
            self.tell_shown()

    def on_estop(self, stop: bool) -> None:
        """Publish the emergency stop: set or released."""
        self.estop_out.publish(Bool(data=stop))

    def on_look(self, look: Look) -> None:
        """Store the look direction for the next view."""
        self.look = look

    def on_record(self, on: bool) -> None:
        """Start or stop a recording."""
        self.recording.record(on)

    def on_snapshot(self) -> None:
        """Save the last minute as a snapshot."""
        self.recording.snapshot()

    def on_bookmark(self, name: str) -> None:
        """Publish a bookmark for the present moment; the topic puts it into every recording and snapshot."""
        self.bookmark_out.publish(String(data=name))
        self.recording.bookmark(name)

    def ask_recorder(self, command: str, **arguments: Any) -> Any:
        """Call the recorder node, on the desk's thread; raise RecorderError with a message for the operator."""
        name = self.config.recorder
        if self.run_dir is None:
            raise RecorderError("The recorder is not available: this node has no run directory.")
        try:
            return NodeControl(self.run_dir, name, RECORDER_TIMEOUT_S).call(command, **arguments)
        except NodeMissingError:
            raise RecorderError(
                f"No recorder is running. Launch the station with recorder:=true (node {name})."
            ) from None
        except ControlError as error:
            raise RecorderError(f"recorder: {error}") from None

    def export_map(self) -> dict[str, bytes]:
        """Return the newest map in map_server's file format. Runs on a thread of the server."""
        from instant_ic.slam.map_files import ros_map  # imports numba

        message = self._map
        if message is None or message.info.width * message.info.height == 0:
            return {}
        grid, resolution, origin = grid_array(message)
        picture, text = ros_map(grid, round(resolution, 6), origin, "map.png")  # float32 in the message
        return {"map.png": grey_png(picture), "map.yaml": text.encode()}

    # ---- images ---------------------------------------------------------------------------------

    def on_panorama(self, message: CompressedImage) -> None:
        """Forward a panorama unchanged, with the camera's rotation at its stamp."""
        self._picture_ns = self.clock.steady_ns()
        self._picture_stamp = stamp = stamp_ns(message)
        self.tell_shown()
        map_from_camera = self.lookup("map", "camera", stamp)
        self.server.send_frame(
            FrameKind.PANORAMA,
            {
                "captured_ms": self.captured_ms(stamp),
                "q": None if map_from_camera is None else quaternion_from_matrix(map_from_camera).tolist(),
            },
            bytes(message.data),
        )

    def on_view(self, message: RenderedView) -> None:
        """Forward a rendered view, then request the next one."""
        camera = matrix_from_pose(message.pose)
        if not (0 < message.fov_rad < math.pi):
            self.diagnose("view", ERROR, f"rendered view dropped: its field of view is {message.fov_rad:.3g} rad")
            return
        near_m = float(message.depth_near_m)
        knows = math.isfinite(near_m) and near_m > 0
        words = f"depth images with an invalid range of {near_m:.3g} m: views stay at their rendered position"
        self.check("depth", knows or not len(message.depth_png), words)
        came_ns = self.clock.steady_ns()
        self.views.answered(int(message.request_id), came_ns / 1e9)
        page = self.views.page_of(int(message.request_id))
        if page is None:
            # A slow renderer answers after the time-out, which is when its delay matters most.
            delay_s = (came_ns - self._asked.get(int(message.request_id), came_ns)) / 1e9
            self._view = int(message.request_id), came_ns, delay_s
            self._drawn = camera, knows and len(message.depth_png) > 0
            self._displayed = self.displayed()
            self.tell_shown()
        self.server.send_frame(
            FrameKind.VIEW,
            {
                "captured_ms": self.captured_ms(stamp_ns(message)),
                "q": quaternion_from_matrix(camera).tolist(),
                "p": camera[:3, 3].tolist(),
                "fov": float(message.fov_rad),
                "confidence": _finite(message.confidence),
                "mask": base64.b64encode(bytes(message.confidence_png)).decode("ascii"),
                "depth": base64.b64encode(bytes(message.depth_png)).decode("ascii") if knows else "",
                "depth_near_m": near_m if knows else 0.0,
                "mount": self.camera_place()[:3, 3].tolist(),
                "render_ms": _finite(message.render_ms),
                "request_id": int(message.request_id),
            },
            bytes(message.image.data),
            client=page,
        )
        self.request_view()

    def request_view(self) -> None:
        """Request a view in the driver's look direction if one is due, else one for a watching page."""
        steady_s = self.clock.steady_ns() / 1e9
        virtual = self.with_vbot()
        if not (virtual or self.vspace_alive()):
            return
        map_from_base = self.vbot_pose() if virtual else self.robot_pose()
        if map_from_base is None:
            return
        wanted = map_from_base, self.look
        moves = (
            self._wanted is None
            or wanted[1] != self._wanted[1]
            or not np.allclose(wanted[0], self._wanted[0], atol=1e-4)
        )
        if self.views.due(steady_s, virtual=virtual, moves=moves):
            self._wanted = wanted
            self.ask_for_view(map_from_base, self.look, None)
        elif self.shown == "virtual":
            looks = self.server.watching()
            page = self.views.watcher(steady_s, self.look, looks)
            if page is not None:
                self.ask_for_view(map_from_base, looks[page], page)

    def ask_for_view(self, map_from_base: Matrix, look: Look, page: int | None) -> None:
        """Request one view for ``look``: the driver's (``page`` None) or that of a watching page."""
        # The look direction is relative to the robot's heading, so only the position of the mount counts.
        map_from_camera = map_from_base @ self.camera_place() @ look.rotation()
        shape = view_shape(look, self.config.view)
        steady_ns = self.clock.steady_ns()
        number = self.views.asked(steady_ns / 1e9, page)
        if page is None:
            self._asked[number] = steady_ns
            while len(self._asked) > 8:
                del self._asked[next(iter(self._asked))]
        self.request_out.publish(
            ViewRequest(
                header=header("map", self.clock.now_ns()),
                id=number,
                pose=pose_message(map_from_camera),
                fov_rad=shape.fov_rad,
                width=shape.width,
                height=shape.height,
            )
        )

    def tell_shown(self) -> None:
        """Report the available images, their age and the loss of the driver to the arbiter. Called on any thread."""
        now_ns, stamp, lost_ns = self.clock.steady_ns(), self.clock.now_ns(), self._lost_ns
        view_id, came_ns, delay_s = self._view
        self.shown_out.publish(
            ShownPictures(
                header=header("map", stamp),
                picture_stamp=to_time(self._picture_stamp),
                picture_age_s=math.inf if self._picture_ns is None else (now_ns - self._picture_ns) / 1e9,
                view_id=view_id,
                view_pose=self._displayed,
                view_age_s=math.inf if view_id == 0 else (now_ns - came_ns) / 1e9,
                view_delay_s=delay_s,
                # Steady clock: if the system clock is set back, new commands must not look older than the loss.
                operator_lost=to_time(0 if lost_ns is None else stamp - (now_ns - lost_ns)),
            )
        )

    def displayed(self) -> Any:
        """Return the pose message from which the page shows the newest view, moved towards the v-bot's present pose."""
        if self._drawn is None:
            return self._displayed
        camera, knows_depth = self._drawn
        shown, vbot = camera.copy(), self.vbot_pose()
        if knows_depth and vbot is not None and self.lead.share > 0:
            now = (vbot @ self.camera_place())[:2, 3]
            shown[:2, 3] = self.lead.displayed(camera[:2, 3], now)
        return pose_message(shown)

    def with_vbot(self) -> bool:
        """Whether the v-bot's view is shown or soon will be."""
        return self.mode in ("entering", "virtual", "returning")

    def vspace_alive(self) -> bool:
        """Whether the virtual space can render."""
        status = self.vspace.message
        return status is not None and int(status.state) in (VspaceStatus.TRAINING, VspaceStatus.READY)

    # ---- state ----------------------------------------------------------------------------------

    def on_control(self, message: ControlState) -> None:
        """Send a change of mode at once, because both robots keep moving."""
        if self.mode not in ("none", MODES.get(int(message.mode))):
            self.send_state()

    def on_vbot(self, message: Odometry) -> None:
        """Send each step of the v-bot at once: the timer would add half a period on average."""
        if self.with_vbot():
            self.send_state()

    def tell_state(self) -> None:
        """Send the state on the timer, unless the v-bot has just triggered it."""
        if self.clock.steady_ns() - self._told_ns > 0.6e9 / self.config.state_rate_hz:
            self.send_state()

    def send_state(self) -> None:
        """Send mode, poses and commands to the page; request views at the rate of the mode."""
        self._told_ns = self.clock.steady_ns()
        control = self.control.message
        self.mode = "none" if control is None else MODES.get(int(control.mode), "none")
        virtual = control is not None and int(control.shown) == ControlState.SHOWN_VIRTUAL
        self.shown = "none" if control is None else "virtual" if virtual else "real"
        if self.mode in ("entering", "returning"):  # the switch may come at any moment
            self.server.show(FrameKind.VIEW, FrameKind.PANORAMA)
        else:
            self.server.show(FrameKind.VIEW if virtual else FrameKind.PANORAMA)
        lead = self.lead.step(self._told_ns / 1e9, self.mode == "virtual")
        self._displayed = self.displayed()
        state: dict[str, Any] = {
            "at_ms": self.server.now_ms(),
            "mode": self.mode,
            "shown": self.shown,
            "lead": round(lead, 3),
            "robot": _planar(self.robot_pose()),
            "vbot": _planar(self.vbot_pose()) if self.with_vbot() else None,
            "twist": [_finite(value) or 0.0 for value in self.shown_twist()],
        }
        if control is not None:
            state |= {
                "reason": control.reason,
                "estop": bool(control.estop),
                "blocked": bool(control.blocked),
                "transitions": int(control.transitions),
                "command": [_finite(value) for value in twist_values(control.operator_command)],
                "applied": [_finite(value) for value in twist_values(control.applied_command)],
                "pose_gap_m": _finite(control.pose_gap_m),
                "yaw_gap_rad": _finite(control.yaw_gap_rad),
                "time_to_obstacle_s": _finite(control.time_to_obstacle_s),
            }
        self.server.publish("state", state)
        self.tell_shown()
        self.request_view()

    def shown_twist(self) -> tuple[float, float]:
        """Measured velocity (m/s, rad/s) of the shown robot."""
        if self.shown == "virtual" and self.vbot.message is not None:
            return twist_values(self.vbot.message)
        return (0.0, 0.0) if self.control.message is None else twist_values(self.control.message.robot_twist)

    def send_plan(self) -> None:
        """Send trajectory, path and subgoal to the page, all in the map frame."""
        virtual = self.mode == "virtual"
        subgoal = self.subgoal.message if virtual else None
        self.server.publish(
            "plan",
            {
                "trajectory": self.points(self.trajectory.message),
                "path": self.points(self.path.message) if virtual else [],
                "subgoal": None if subgoal is None else _planar(matrix_from_pose(subgoal)),
            },
        )

    def send_health(self) -> None:
        """Send virtual space, battery and faults to the page; faults carry the text of the node that found them."""
        age_s = math.inf if self._picture_ns is None else (self.clock.steady_ns() - self._picture_ns) / 1e9
        self.check("camera", age_s <= PICTURE_TIMEOUT_S, "no image from the camera", age_s=age_s)
        self.check("controller", self.control.message is not None, "no state from the arbiter")
        self.check("pose", self.robot_pose() is not None, "the robot's pose is unknown")
        # Shown on the page only, not as a diagnosis: the node itself works.
        plain = [{"level": "warn", "name": "network", "text": PLAIN_HTTP}] if self.server.plain_http else []
        self.server.publish(
            "health",
            {
                "vspace": _vspace(self.vspace.message),
                "battery": _battery(self.battery.message),
                "faults": self.faults() + plain,
                "nodes": sorted(self._heartbeats),
            },
        )

    def check(self, name: str, fine: bool, fault: str, **values: Any) -> None:
        """Set a diagnosis: OK, or a warning with the text ``fault``."""
        self.diagnose(name, OK if fine else WARN, "" if fine else fault, **values)

    def faults(self) -> list[dict[str, str]]:
        """Return the worst present fault of each node, worst first: ``level`` (warn, error), ``name``, ``text``."""
        now = self.clock.steady_ns() / 1e9
        found = [
            (level, name.partition(":")[0], text)
            for name, (level, text, seen) in self._diagnoses_seen.items()
            if level >= WARN and now - seen < HEARTBEAT_TIMEOUT_S
        ]
        found += [
            (ERROR, name, "does not answer")
            for name, (seen, stopping) in self._heartbeats.items()
            if not stopping and now - seen > HEARTBEAT_TIMEOUT_S
        ]
        worst: dict[str, tuple[int, str]] = {}
        for level, name, text in sorted(found, key=lambda fault: -fault[0]):
            worst.setdefault(name, (level, text))
        return [
            {"level": "error" if level >= ERROR else "warn", "name": name, "text": text}
            for name, (level, text) in list(worst.items())[:MAX_FAULTS]
        ]

    def on_diagnostics(self, message: DiagnosticArray) -> None:
        """Store the newest diagnosis of each name."""
        now = self.clock.steady_ns() / 1e9
        for status in message.status:
            self._diagnoses_seen[status.name] = (int(status.level), status.message, now)

    def on_heartbeat(self, message: NodeStatus) -> None:
        """Note a node's heartbeat. A node that announced its shutdown does not count as missing."""
        self._heartbeats[message.node] = (self.clock.steady_ns() / 1e9, int(message.state) == NodeStatus.STOPPING)

    # ---- map ------------------------------------------------------------------------------------

    def on_map(self, message: OccupancyGrid) -> None:
        """Store the newest map."""
        self._map = message
        self._grids[FrameKind.MAP] = message

    def on_costmap(self, message: OccupancyGrid) -> None:
        """Store the newest costmap."""
        self._grids[FrameKind.COSTMAP] = message

    def send_grids(self) -> None:
        """Send map and costmap if they have changed."""
        while self._grids:
            kind, message = self._grids.popitem()
            image = grid_image(*grid_array(message))
            if image is not None and self._grid_digests.get(kind) != image.digest:
                self._grid_digests[kind] = image.digest
                self.server.send_frame(kind, image.header, image.png)

    # ---- poses ----------------------------------------------------------------------------------

    def lookup(self, target: str, source: str, stamp: int | None = None) -> Matrix | None:
        """Return ``target_from_source`` at ``stamp``, else the newest one; None if the tree has a gap."""
        for when in (stamp, None):
            try:
                return self.tf.lookup(target, source, when)
            except TransformError:
                continue
        return None

    def robot_pose(self) -> Matrix | None:
        """Return map_from_base of the r-bot; the arbiter's estimate if the tree has a gap."""
        pose = self.lookup("map", "base_link")
        if pose is None and self.control.message is not None:
            return matrix_from_pose(self.control.message.robot_pose)
        return pose

    def vbot_pose(self) -> Matrix | None:
        """Return map_from_base of the v-bot; the arbiter's estimate until the v-bot publishes its own."""
        if self.vbot.message is not None:
            return matrix_from_pose(self.vbot.message)
        return None if self.control.message is None else matrix_from_pose(self.control.message.vbot_pose)

    def camera_place(self) -> Matrix:
        """Return base_from_camera with the identity as rotation."""
        place = np.eye(4)
        base_from_camera = self.lookup("base_link", "camera")
        place[:3, 3] = self.config.camera_mount.xyz if base_from_camera is None else base_from_camera[:3, 3]
        return place

    def points(self, path: Path | None) -> list[list[float]]:
        """Return the points [x, y] of a path in the map frame, rounded to 1 mm; empty without a path."""
        if path is None or not path.poses:
            return []
        xyz = np.pad(path_array(path)[:, :2], ((0, 0), (0, 1)))
        if path.header.frame_id not in ("", "map"):
            map_from_frame = self.lookup("map", path.header.frame_id)
            if map_from_frame is None:
                return []
            xyz = transform_points(map_from_frame, xyz).astype(np.float64)
        points: list[list[float]] = xyz[np.isfinite(xyz).all(axis=1), :2].round(3).tolist()
        return points

    def captured_ms(self, stamp: int) -> float:
        """Convert a stamp to the server's clock in ms; a stamp in the future counts as now."""
        age_ms = (self.clock.now_ns() - stamp) / 1e6
        return self.server.now_ms() - max(age_ms, 0.0)


def _planar(pose: Matrix | None) -> list[float] | None:
    return None if pose is None else [round(float(value), 4) for value in pose2_from_matrix(pose)]


def _finite(value: Any) -> float | None:
    number = float(value)
    return number if math.isfinite(number) else None


def _vspace(status: VspaceStatus | None) -> dict[str, Any] | None:
    if status is None:
        return None
    return {
        "state": VSPACE_STATES.get(int(status.state), "empty"),
        "psnr_db": _finite(status.psnr_db) or 0.0,
        "expected_psnr_db": _finite(status.expected_psnr_db) or 0.0,
        "unseen_share": _finite(status.unseen_share) or 0.0,
        "radius_m": _finite(status.ready_radius_m) or 0.0,
        "train_seconds": _finite(status.train_seconds) or 0.0,
        "message": status.message,
    }


def _battery(battery: BatteryState | None) -> dict[str, Any] | None:
    voltage = None if battery is None else _finite(battery.voltage)
    if battery is None or voltage is None:
        return None
    share = _finite(battery.percentage)  # 0..1; NaN where unknown (sensor_msgs/BatteryState)
    return {"voltage": voltage, "percent": None if share is None else 100.0 * share}


if __name__ == "__main__":
    main(ConsoleNode)
