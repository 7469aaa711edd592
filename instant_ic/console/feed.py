"""Images, state, plan, health and maps for the page, and requests for rendered views."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

from instant_ic import msg
from instant_ic.adapters.vspace import layers_of
from instant_ic.bus import Node
from instant_ic.bus.topics import Latest
from instant_ic.console import page_messages as page
from instant_ic.console.backend import PageServer
from instant_ic.console.config import ConsoleConfig
from instant_ic.console.display import Display, finite_pose
from instant_ic.console.faults import ERROR, OK, WARN, FaultList
from instant_ic.console.gridimage import grid_image
from instant_ic.console.layers import MOST_LAYERS, LayerMeshes, PageLayers
from instant_ic.console.protocol import FrameKind, PendingFrame
from instant_ic.console.server import PLAIN_HTTP
from instant_ic.console.view import ViewSchedule
from instant_ic.msg import grid_array, header, pose_message, stamp_ns
from instant_ic.util.pace import current

IMAGE_TIMEOUT_S = 2.0
STATE_PERIOD_S, PLAN_PERIOD_S = 0.05, 0.2
"""Periods at which the state (mode, poses, commands) and the plan are sent to the page."""


@dataclass(frozen=True)
class Inputs:
    """Newest messages of the topics that are read when data are sent to the page."""

    control: Latest  # ControlState
    vbot: Latest  # Odometry
    trajectory: Latest  # Path
    path: Latest  # Path
    subgoal: Latest  # PoseStamped
    vspace: Latest  # VspaceStatus
    battery: Latest  # BatteryState


class PageFeed:
    """Conversion of a node's messages for the page's server.

    Args:
        node: node ``console``.
        server: receiver of everything for the page.
        display: state of the page's main image.
        inputs: newest messages.
        send_request: function that requests a rendered view.
        send_shown: function that reports the available images to the arbiter. Any thread may call it.

    Attributes:
        watched: true while there is a page. Without a page, no state is sent, no view is requested and no report goes
            to the arbiter.
    """

    def __init__(
        self,
        node: Node[ConsoleConfig],
        server: PageServer,
        display: Display,
        inputs: Inputs,
        send_request: Callable[[msg.ViewRequest], None],
        send_shown: Callable[[msg.ShownPictures], None],
    ) -> None:
        self.watched = True
        self.server = server
        self.display = display
        self.views = ViewSchedule(node.config.view)
        self.faults = FaultList(node.clock)
        self._inputs, self._send_request, self._send_shown = inputs, send_request, send_shown
        self._clock, self._diagnose, self._mount = node.clock, node.diagnose, node.config.camera_mount.xyz
        self._meshes = LayerMeshes()
        self._grids: dict[FrameKind, msg.OccupancyGrid] = {}  # grids that have not been sent yet
        self._sent_grids: dict[FrameKind, PendingFrame] = {}
        self._state_sent_ns = 0

    # ---- messages ----------------------------------------------------------------------------------

    def take_panorama(self, message: msg.CompressedImage) -> None:
        """Forward a panorama unchanged, with the camera's rotation at its stamp."""
        stamp = stamp_ns(message)
        self.display.take_image(stamp)
        self.report_shown()
        fields = page.image_header(self._captured_ms(stamp), self.display.lookup("map", "camera", stamp))
        self.server.send_frame(FrameKind.PANORAMA, fields, bytes(message.data))

    def take_view(self, message: msg.RenderedView) -> None:
        """Forward a rendered view, then request the next one."""
        pose = finite_pose(message.pose)
        if pose is None or not (0 < message.fov_rad < math.pi):
            wrong = "pose is not finite" if pose is None else f"field of view is {message.fov_rad:.3g} rad"
            self._diagnose("view", ERROR, f"View not shown: its {wrong}. Restart nerf.")
            return
        request_id = int(message.request_id)
        delay_s = self.views.answered(request_id, self._clock.steady_ns())
        if delay_s is not None:
            self.display.take_view(request_id, delay_s, message.pose)
            self.report_shown()
            fields = page.image_header(self._captured_ms(stamp_ns(message)), pose)
            self.server.send_frame(FrameKind.VIEW, fields | {"fov": float(message.fov_rad)}, bytes(message.image.data))
        self._request_view()

    def layers_of(self, message: msg.VspaceLayers) -> PageLayers | str:
        """Return the layers that pages render, or an error as text. Runs on a worker thread."""
        try:
            layers = layers_of(message)
            made = PageLayers(layers.version, self._mount, self._meshes.layers(layers)[:MOST_LAYERS])
            made.check()
            _ = made.digests  # computed on this thread, because hashing takes milliseconds
            return made
        except ValueError as error:
            return str(error)

    def take_layers(self, layers: PageLayers | str) -> None:
        """Send a version of the virtual space that pages render by themselves, or report its error text."""
        if isinstance(layers, str):
            self._diagnose("layers", ERROR, f"Virtual space not shown: {layers}. The page keeps the previous version.")
            return
        self.server.send_layers(layers)
        self._diagnose("layers", OK, "", version=layers.version, layers=len(layers.layers))

    def take_control(self, message: msg.ControlState) -> None:
        """Send a change of mode at once, because both robots keep moving; show the driver and the emergency stop."""
        self.server.follow_robot(message.holder, bool(message.estop))
        if self.display.changes_mode(message):
            self.send_state()

    def take_vbot(self, message: msg.Odometry) -> None:
        """Send each step of the v-bot at once, because the timer would add half a period on average."""
        if self.display.with_vbot:
            self.send_state()

    def take_grid(self, kind: FrameKind, message: msg.OccupancyGrid) -> None:
        """Keep the newest map or costmap until it is sent."""
        self._grids[kind] = message

    def lose_driver(self) -> None:
        """Report a lost driver to the arbiter at once. Runs on the server's thread."""
        self.display.lose_driver()
        self.report_shown(always=True)

    # ---- timers --------------------------------------------------------------------------------------

    def send_state_if_due(self) -> None:
        """Send the state, unless a step of the v-bot has just triggered it."""
        if self._clock.steady_ns() - self._state_sent_ns > 0.6e9 * STATE_PERIOD_S:
            self.send_state()

    def send_state(self) -> None:
        """Send mode, poses and commands; request a view if one is due."""
        if not self.watched:
            return
        self._state_sent_ns = self._clock.steady_ns()
        self.display.step()
        if self.display.control.message is None:
            self.server.follow_robot(None)
        self.server.show(*self.display.foreground)
        self.server.publish("state", page.state_message(self.server.now_ms(), self.display))
        self.report_shown()
        self._request_view()

    def send_plan(self) -> None:
        """Send trajectory, path and subgoal."""
        newest = self._inputs.trajectory.message, self._inputs.path.message, self._inputs.subgoal.message
        self.server.publish("plan", page.plan_message(self.display.mode == "virtual", *newest))

    def send_health(self) -> None:
        """Send virtual space, battery, CPU load of the nodes, and faults as reported by the nodes."""
        age_s = self.display.image_age_s
        self._check("camera", age_s <= IMAGE_TIMEOUT_S, "no image from the camera", age_s=age_s)
        self._check("controller", self.display.control.message is not None, "no state from the arbiter")
        self._check("pose", self.display.robot_pose() is not None, "the robot's pose is unknown")
        faults = self.faults.worst()
        if self.server.plain_http:  # shown only on the page; not a diagnosis, because the node works
            faults.append({"level": "warn", "name": "network", "text": PLAIN_HTTP})
        newest = self._inputs.vspace.message, self._inputs.battery.message
        self.server.publish("health", page.health_message(*newest, faults, self.faults.nodes(), current().text))

    def send_grids(self) -> None:
        """Send map and costmap if they have changed."""
        while self._grids:
            kind, message = self._grids.popitem()
            image = grid_image(*grid_array(message))
            if image is not None and self._sent_grids.get(kind) != image:
                self._sent_grids[kind] = image
                self.server.send_frame(kind, image.header, image.payload)

    def report_shown(self, always: bool = False) -> None:
        """Report the available images and the loss of the driver. Any thread may call it."""
        if self.watched or always:
            self.display.take_drawn(self.server.drawn_ms(), self.server.now_ms())
            self._send_shown(self.display.report())

    def _request_view(self) -> None:
        """Request the due view: the v-bot's, or otherwise the robot's if the virtual space can render."""
        virtual, needed, now_ns = self.display.with_vbot, self.server.needs_views(), self._clock.steady_ns()
        status = self._inputs.vspace.message
        renders = status is not None and int(status.state) in (msg.VspaceStatus.TRAINING, msg.VspaceStatus.READY)
        map_from_base = self.display.vbot_pose() if virtual else self.display.robot_pose()
        if not self.watched or not (virtual or renders) or map_from_base is None:
            return
        if self.views.is_due(virtual and needed, now_ns):
            number, (fov_rad, width, height) = self.views.next(needed, now_ns)
            pose = pose_message(map_from_base @ self.display.camera_mount() @ self.views.look.rotation())
            head = header("map", self._clock.now_ns())
            self._send_request(msg.ViewRequest(head, number, pose, fov_rad, width, height))

    def _check(self, name: str, fine: bool, fault: str, **values: Any) -> None:
        self._diagnose(name, OK if fine else WARN, "" if fine else fault, **values)

    def _captured_ms(self, stamp: int) -> float:
        """Convert a stamp to the server's clock in ms; a stamp in the future counts as now."""
        return self.server.now_ms() - max((self._clock.now_ns() - stamp) / 1e6, 0.0)
