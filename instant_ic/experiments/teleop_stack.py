"""The whole stack in one process and in simulated time, for ``ic evaluate teleop``.

- Real: the nodes, their parameters and their messages, on a lockstep bus. These are base driver with the motor
  controller's protocol, LiDAR driver (packets in), SLAM, arbiter, v-bot, navigator and console; for illusory control
  also depth and virtual space.
- Simulated: the robot, its LiDAR and its camera (``sim``).
- Modelled: the delay of commands to the base and of images to the page; the age of depth (its network takes no
  simulated time); and the page itself, which shows what the console sends.

Camera images are rendered only where depth uses them. The console and the arbiter need only their stamps, and get a
small placeholder at the camera's rate. Rendered views are small, except on either side of a switch, where they are
compared at full size.
"""

from __future__ import annotations

import copy
import math
from collections import deque
from collections.abc import Callable
from dataclasses import dataclass, field, replace
from typing import TYPE_CHECKING, Any, TypeAlias

import numpy as np
from numpy.typing import NDArray

from instant_ic.bag.replay import make_node
from instant_ic.bus.lockstep import LockstepBus, Record
from instant_ic.console.server import ConsoleServer
from instant_ic.experiments.plots import jpeg
from instant_ic.geometry.poses import (
    compose2,
    matrix_from_quaternion,
    pose2_from_matrix,
    pose_matrix,
    relative2,
    wrap_angle,
)
from instant_ic.msg import (
    VelodynePacket,
    VelodyneScan,
    compressed_image_message,
    deserialize,
    header,
    pose2_from_message,
    stamp_ns,
    to_time,
)
from instant_ic.vspace.jobs import EncodedView, Job, JobOutcome, SpaceWorker

if TYPE_CHECKING:
    from instant_ic.sim.roboclaw_emulator import RoboclawEmulator
    from instant_ic.sim.simulation import Simulation
    from instant_ic.sim.world import World

FloatArray: TypeAlias = NDArray[np.float64]

METHODS = ("ic", "stop")
NODES = ("crawler_base", "vlp16_driver", "grid_slam", "virtual_robot", "navigator", "arbiter", "console")
VSPACE_NODES = ("depth_estimator", "depth_scaler", "nerf")
STEP_S = 1 / 60
START_NS = 1_700_000_000_000_000_000
CAMERA_HEIGHT_M = 1.2
_EVERY = 3
"""Steps between two commands of the operator (20 Hz)."""
_FIRST_CUT_S = 0.05
"""The driver cuts revolutions at 180°."""
_OVERDUE_S = 0.5
"""Time beyond the depth latency after which an image passed to depth no longer leads to a keyframe."""
_SMALLER = 4
"""Scale factor of each side of a view that is not compared."""


@dataclass(frozen=True)
class StackConfig:
    """Configuration of the stack, and the delays that the lockstep bus does not model.

    Attributes:
        method: of ``METHODS``.
        depth: depth source, ``completed``, ``fused`` or ``lidar``.
        seed: of the robot's slip, the LiDAR's noise and the delays.
        camera_hz: images per second.
        camera_latency_s: from the exposure to the page, as for the simulated camera.
        depth_latency_s: from the exposure to the keyframe.
        command_latency_s: minimum and maximum from the arbiter to the base; one value is drawn per stack.
        whole_views: render all views at full size, for a video; else only those on either side of a switch.
        overrides: further parameters ``node.key:=value``; the images for depth and virtual space have the size of
            ``theta_camera.theta``.
    """

    method: str = "ic"
    depth: str = "completed"
    seed: int = 0
    camera_hz: float = 5.0
    camera_latency_s: float = 0.2
    depth_latency_s: float = 1.0
    command_latency_s: tuple[float, float] = (0.02, 0.08)
    whole_views: bool = False
    overrides: tuple[str, ...] = ()

    def __post_init__(self) -> None:
        if self.method not in METHODS:
            raise ValueError(f"method must be one of {', '.join(METHODS)} (got {self.method!r})")
        for word in self.overrides:
            if word.partition(".")[0] not in (*NODES, *VSPACE_NODES, "theta_camera") or ":=" not in word:
                names = ", ".join((*NODES, *VSPACE_NODES, "theta_camera"))
                raise ValueError(f"parameter {word!r}: expected NODE.KEY:=VALUE with one of the nodes {names}")


@dataclass(frozen=True)
class Shown:
    """An image on the operator's screen.

    Attributes:
        time_s: when it was displayed.
        came_s: when it arrived at the page; a switch shows the newest image that has already arrived.
        virtual: True for a rendered view, False for the camera's image.
        pose: (3,) of the robot from which the image was taken, in the world's frame; the true pose for a camera image.
        place: (2,) its position, as the stack knows it.
        heading: yaw at which it is shown: the page rotates the camera's image to the newest heading.
        jpeg, fov_rad: of a rendered view.
        draw: renders the JPEG of this view at full size.
    """

    time_s: float
    came_s: float
    virtual: bool
    pose: FloatArray
    place: FloatArray
    heading: float
    jpeg: bytes = b""
    fov_rad: float = math.pi / 2
    draw: Callable[[], bytes] | None = None


class EmulatedPort:
    """The motor controller's serial line, in memory."""

    def __init__(self, controller: RoboclawEmulator) -> None:
        self.controller, self.received = controller, bytearray()

    def write(self, data: bytes, /) -> int:
        self.received += self.controller.feed(bytes(data))
        return len(data)

    def read(self, size: int = 1, /) -> bytes:
        taken = bytes(self.received[:size])
        del self.received[:size]
        return taken

    def reset_input_buffer(self) -> None:
        self.received.clear()

    def close(self) -> None:
        pass


class SilentPage:
    """Replaces the console's server; no page is connected."""

    plain_http = False

    def now_ms(self) -> float:
        return 0.0

    def needs_views(self) -> bool:
        return True

    def __getattr__(self, name: str) -> Any:
        """Method that ignores what it is given; ``drawn_ms`` is None as it shows rendered views."""
        if not hasattr(ConsoleServer, name):
            raise AttributeError(f"the console's server has no {name}")
        return lambda *_: None


class _Page(SilentPage):
    """Records what the console's server is given to show."""

    def __init__(self, stack: SimulatedStack) -> None:
        self._stack = stack
        self.virtual = False
        self.state: dict[str, Any] = {}  # newest message

    def now_ms(self) -> float:
        return self._stack.bus.clock.now_ns() / 1e6

    def publish(self, kind: str, message: dict[str, Any]) -> None:
        if kind != "state":
            return
        self.state = message
        virtual = message["shown"] == "virtual"
        if virtual != self.virtual:
            self.virtual = virtual
            self._stack.on_show()

    def send_frame(self, kind: Any, header: dict[str, Any], payload: bytes) -> None:
        if kind.name in ("VIEW", "PANORAMA"):  # but not the map
            self._stack.on_frame(kind.name == "VIEW", header, payload)


@dataclass
class Log:
    """Events of a drive, one row per twentieth of a second; poses (x, y, yaw) in the world's frame."""

    time_s: list[float] = field(default_factory=list)
    mode: list[int] = field(default_factory=list)
    virtual: list[bool] = field(default_factory=list)
    """Whether the rendered view is shown."""
    robot: list[FloatArray] = field(default_factory=list)
    estimate: list[FloatArray] = field(default_factory=list)
    """The r-bot's pose as the stack knows it."""
    vbot: list[FloatArray] = field(default_factory=list)
    yaw_gap_rad: list[float] = field(default_factory=list)
    """v-bot heading minus the r-bot's true heading at the time of the v-bot's message."""
    known_yaw_gap_rad: list[float] = field(default_factory=list)
    """The same from the headings the arbiter knows; the page rotates the images to these."""
    command: list[tuple[float, float]] = field(default_factory=list)
    blocked: list[bool] = field(default_factory=list)
    reason: list[str] = field(default_factory=list)
    pictures: list[Shown] = field(default_factory=list)
    keyframes: int = 0


class SimulatedStack:
    """A robot in a world with the nodes that drive it; ``step`` advances everything by ``STEP_S``."""

    def __init__(self, world: World, config: StackConfig) -> None:
        from instant_ic.sim.simulation import Simulation, SimulationConfig

        self.config = config
        self.simulation: Simulation = Simulation(SimulationConfig(seed=config.seed), START_NS, world)
        # Start at the driver's first cut: a map started from the half revolution before it would not match the next
        # scan.
        self.simulation.scanner.skip_to(_FIRST_CUT_S)
        self.rng = np.random.default_rng([53, config.seed])
        self.start = np.array(world.spawn)
        self.log = Log()
        self.state: Any = None
        self.vbot: FloatArray = self.start.copy()
        self.yaw_gap_rad = 0.0
        self.page = _Page(self)
        self.command_delay_ns = round(1e9 * self.rng.uniform(*config.command_latency_s))
        self._commands: deque[tuple[int, Record]] = deque()
        self._steps = 0
        self._next_exposure_s = self._next_depth_s = 0.0
        self._exposed: deque[tuple[float, FloatArray]] = deque()  # camera images on their way to the page
        self._for_depth: deque[tuple[float, float, bytes]] = deque()  # due, exposure, JPEG
        self._keyframe_at: FloatArray | None = None
        self._drawn: dict[int, FloatArray] = {}  # images on their way to a keyframe: stamp, r-bot's true pose
        # newest view: its request, and a function that renders it at full size
        self._whole: tuple[int, Callable[[], EncodedView]] | None = None
        self._newest: dict[bool, Shown] = {}
        self.bus = LockstepBus(START_NS, keep=False, on_record=self._on_record)
        self._add_nodes()

    def close(self) -> None:
        """Close the nodes."""
        self.bus.close()

    def __enter__(self) -> SimulatedStack:
        return self

    def __exit__(self, *_: object) -> None:
        """Close the nodes at the end of the block."""
        self.close()

    # -- nodes

    def _add_nodes(self) -> None:
        config = self.config
        words = [
            "vlp16_driver.source:=topic",
            "nerf.space.source:=warp",
            f"depth_scaler.source:={config.depth}",
            "theta_camera.source:=files",
            "console.map_rate_hz:=0.1",
            *config.overrides,
        ]
        names = list(NODES)
        if config.method == "ic":
            names += [name for name in VSPACE_NODES if name != "depth_estimator" or config.depth != "lidar"]
        pictures = {"/camera/image/compressed": "/camera/for_depth"}
        remaps = {
            "crawler_base": {"/cmd_vel": "/base/cmd_vel"},
            "depth_estimator": pictures,
            "depth_scaler": pictures,
        }
        port = EmulatedPort(self.simulation.controller)
        self.nodes: dict[str, Any] = {}
        for name in names:
            node = make_node(name, None, words)
            node_class: Any = node.node_class
            if name == "crawler_base":
                node_class = type(node_class.__name__, (node_class,), {"open_port": staticmethod(lambda _: port)})
            if name == "nerf" and not config.whole_views:
                node_class = type(node_class.__name__, (node_class,), {"worker_class": self._small_views()})
            self.nodes[name] = self.bus.add(node_class, node.config, name, remaps=remaps.get(name))
        if config.method == "ic":
            looks = self.nodes["depth_estimator" if config.depth != "lidar" else "depth_scaler"]
            self._depth_hz = float(looks.config.max_rate_hz)
        camera = make_node("theta_camera", None, words).config
        self._preview = camera.theta
        mount = pose_matrix(*camera.camera_mount.pose)
        self.nodes["console"].tf_broadcast_static("base_link", "camera", mount)
        self.nodes["console"].feed.server = self.page

    def _on_record(self, record: Record) -> None:
        topic = record.topic
        if topic == "/cmd_vel":
            self._commands.append((record.stamp_ns + self.command_delay_ns, record))
        elif topic == "/ic/state":
            self.state = deserialize(record.payload, record.type_name)
        elif topic == "/vbot/odom":
            message = deserialize(record.payload, record.type_name)
            self.vbot = self._in_world(pose2_from_message(message))
            truth = self.simulation.poses_at([(stamp_ns(message) - START_NS) / 1e9])[0]
            self.yaw_gap_rad = wrap_angle(float(self.vbot[2] - truth[2]))
        elif topic == "/keyframe":
            self.log.keyframes += 1
            of = stamp_ns(deserialize(record.payload, record.type_name))
            self._keyframe_at = self._drawn.pop(of, self._keyframe_at)

    def _small_views(self) -> type[SpaceWorker]:
        """A virtual space's worker that renders views small, and keeps what a full-size render of the newest needs."""
        stack = self

        class SmallViews(SpaceWorker):
            def do(self, job: Job) -> JobOutcome:
                order = job.view
                if order is None:
                    return super().do(job)
                as_now = copy.copy(self)
                as_now.space = copy.copy(self.space)  # rendering changes the space's state; the keyframes stay the same
                stack._whole = int(order.id), lambda: _encoded(SpaceWorker.do(as_now, job))
                width, height = (max(16, int(side) // _SMALLER) for side in (order.width, order.height))
                return super().do(replace(job, view=replace(order, width=width, height=height)))

        return SmallViews

    def _in_world(self, in_map: FloatArray) -> FloatArray:
        return np.asarray(compose2(self.start, in_map))

    # -- images

    def on_frame(self, virtual: bool, header: dict[str, Any], payload: bytes) -> None:
        """Handle an image that arrives at the page."""
        if virtual:
            map_from_camera = matrix_from_quaternion(np.array(header["q"]))
            map_from_camera[:3, 3] = header["p"]
            pose = self._in_world(pose2_from_matrix(map_from_camera))
            now, fov, whole = self.time_s, float(header["fov"]), self._whole_view(header)
            draw = None if whole is None else lambda: whole().jpeg
            shown = Shown(now, now, True, pose, pose[:2], float(pose[2]), payload, fov, draw)
        else:
            exposure_s, taken_from = self._exposed.popleft()
            stamp = START_NS + round(exposure_s * 1e9)
            known = self.nodes["console"].feed.scene.lookup("map", "camera", stamp)
            place = taken_from if known is None else self._in_world(pose2_from_matrix(known))
            shown = Shown(self.time_s, self.time_s, False, taken_from, place[:2], float(self.robot[2]))
        self._newest[virtual] = shown
        if virtual == self.page.virtual:
            self._show(shown)

    def _whole_view(self, header: dict[str, Any]) -> Callable[[], EncodedView] | None:
        """Function that renders the view of a frame's header at full size; None if another view is the newest."""
        return self._whole[1] if self._whole is not None and self._whole[0] == header["request_id"] else None

    def on_show(self) -> None:
        """Switch the page to the other kind of image: its newest one, if it is fresh."""
        newest = self._newest.get(self.page.virtual)
        if newest is not None and self.time_s - newest.time_s < 0.5:
            heading = newest.heading if newest.virtual else float(self.robot[2])
            self._show(replace(newest, time_s=self.time_s, heading=heading))

    def _show(self, shown: Shown) -> None:
        """Display an image; at a switch, render it and the previous one at full size. Drop other views' renderers."""
        pictures = self.log.pictures
        if pictures:
            switched = pictures[-1].virtual != shown.virtual
            pictures[-1] = _settled(pictures[-1], switched)
            shown = _settled(shown, True) if switched else shown
        pictures.append(shown)

    def _photograph(self) -> None:
        now = self.time_s
        if now >= self._next_exposure_s - 1e-9:
            self._next_exposure_s += 1.0 / self.config.camera_hz
            self._exposed.append((now, self.robot))
            if self.config.method == "ic" and self._worth_drawing():
                self._drawn[START_NS + round(now * 1e9)] = self.robot
                self._for_depth.append((now + self.config.depth_latency_s, now, self._draw()))
        # Images in transit: the console itself takes the first off the queue.
        while self._exposed and now - self._exposed[0][0] >= self.config.camera_latency_s - 1e-9:
            waiting, exposure = len(self._exposed), self._exposed[0][0]
            self._publish_picture("/camera/image/compressed", b"", exposure)
            if len(self._exposed) == waiting:  # the console is not available
                self._exposed.popleft()
        while self._for_depth and now >= self._for_depth[0][0] - 1e-9:
            _, exposure, image = self._for_depth.popleft()
            self._publish_picture("/camera/for_depth", image, exposure)

    def _publish_picture(self, topic: str, image: bytes, exposure_s: float) -> None:
        message = compressed_image_message(image, "camera", START_NS + round(exposure_s * 1e9))
        self.bus.publish(topic, message)

    def _worth_drawing(self) -> bool:
        """Whether depth would make a keyframe of an image taken now, because there is none near this position."""
        if self.time_s < self._next_depth_s - 1e-9:
            return False
        now_ns = START_NS + round(self.time_s * 1e9)
        wait_ns = (self.config.depth_latency_s + _OVERDUE_S) * 1e9
        while self._drawn and now_ns - next(iter(self._drawn)) > wait_ns:  # not used
            del self._drawn[next(iter(self._drawn))]
        selector = self.nodes["depth_scaler"].chain.selector
        distance_m, angle_rad = selector.distance_m + 0.01, math.radians(selector.config.angle_deg + 0.5)
        places = [*self._drawn.values(), *([] if self._keyframe_at is None else [self._keyframe_at])]
        worth = all(_moved(self.robot, place, distance_m, angle_rad) for place in places)
        if worth:
            self._next_depth_s = self.time_s + 1.0 / self._depth_hz
        return worth

    def _draw(self) -> bytes:
        return jpeg(self.simulation.panorama(self._preview.width, self._preview.height).rgb, 92)

    # -- time

    @property
    def time_s(self) -> float:
        return self.simulation.time_s

    @property
    def robot(self) -> FloatArray:
        """True pose (3,) of the r-bot in the world's frame."""
        return self.simulation.robot.pose.copy()

    @property
    def shown_pose(self) -> FloatArray:
        """Pose (3,) of the shown robot: the r-bot's position as in the newest image, with its current heading."""
        if self.page.virtual:
            return self.vbot
        seen = self._newest.get(False)
        place = self.robot[:2] if seen is None else seen.pose[:2]
        return np.array([*place, self.robot[2]])

    def step(self, operate: Callable[[], tuple[float, float]] | None = None) -> None:
        """Advance by one sixtieth of a second; ``operate`` returns the command at 20 Hz."""
        simulation = self.simulation
        simulation.step(STEP_S)
        now_ns = START_NS + round(simulation.time_s * 1e9)
        self.bus.advance_to(now_ns)
        # Just after the driver's cut, so that no scan is late.
        packets = simulation.scan_packets() if self._steps % 6 == 3 else []
        if packets:
            scan = VelodyneScan(
                header=header("velodyne", now_ns),
                packets=[VelodynePacket(stamp=to_time(now_ns), data=np.frombuffer(p, np.uint8)) for p in packets],
            )
            self.bus.publish("/lidar/packets", scan)
        while self._commands and self._commands[0][0] <= now_ns:
            _, record = self._commands.popleft()
            self.bus.publish_bytes("/base/cmd_vel", record.type_name, record.payload, publisher=record.node)
        self._photograph()
        if operate is not None and self._steps % _EVERY == 0:
            command = operate()
            self.nodes["console"].on_drive(*command)
            self.bus.advance_to(now_ns)
            self._note(command)
        self._steps += 1

    def _note(self, command: tuple[float, float]) -> None:
        log, state = self.log, self.state
        if state is None:
            return
        log.time_s.append(self.time_s)
        log.mode.append(int(state.mode))
        log.virtual.append(self.page.virtual)
        log.robot.append(self.robot)
        log.estimate.append(self._in_world(pose2_from_message(state.robot_pose)))
        log.vbot.append(self.vbot.copy())
        log.yaw_gap_rad.append(self.yaw_gap_rad)
        log.known_yaw_gap_rad.append(float(state.yaw_gap_rad))
        log.command.append(command)
        log.blocked.append(bool(state.blocked))
        log.reason.append(str(state.reason))


def _encoded(outcome: JobOutcome) -> EncodedView:
    assert outcome.encoded is not None
    return outcome.encoded


def _settled(shown: Shown, whole: bool) -> Shown:
    if shown.draw is None:
        return shown
    return replace(shown, jpeg=shown.draw() if whole else shown.jpeg, draw=None)


def _moved(a: FloatArray, b: FloatArray, distance_m: float, angle_rad: float) -> bool:
    x, y, yaw = relative2(a, b)
    return math.hypot(float(x), float(y)) >= distance_m or abs(wrap_angle(float(yaw))) >= angle_rad
