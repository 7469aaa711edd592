"""The whole stack in one process and in simulated time, for ``ic evaluate teleop``.

- Real: the nodes, their parameters and their messages, on a lockstep bus. These are base driver with the motor
  controller's protocol, LiDAR driver (packets in), SLAM, arbiter, v-bot, navigator and console; for illusory control
  also depth and virtual space.
- Simulated: the robot, its LiDAR and its camera (``sim``).
- Modelled: the delay of commands to the base and of images to the page; the age of depth (its network takes no
  simulated time); and the page itself, which shows what the console sends.

Camera images are rendered only where depth uses them. The console and the arbiter need only their stamps, and get an
empty image at the camera's rate.
"""

from __future__ import annotations

import math
from collections import deque
from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Any, TypeAlias

import numpy as np
from numpy.typing import NDArray

from instant_ic.bag.replay import make_node
from instant_ic.bus.lockstep import LockstepBus, Record
from instant_ic.console.backend import PageServer
from instant_ic.console.protocol import FrameKind
from instant_ic.experiments.plots import jpeg
from instant_ic.experiments.teleop_figures import DriveLog, Shown
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
from instant_ic.util.closing import Closing

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
_REMAPS = {
    "crawler_base": {"/cmd_vel": "/base/cmd_vel"},
    "depth_estimator": {"/camera/image/compressed": "/camera/for_depth"},
    "depth_scaler": {"/camera/image/compressed": "/camera/for_depth"},
}


@dataclass(frozen=True)
class StackConfig:
    """Configuration of the stack, and the delays that the lockstep bus does not model.

    Attributes:
        method: one of ``METHODS``.
        depth: depth source, ``completed``, ``fused`` or ``lidar``.
        seed: seed of the robot's slip, the LiDAR's noise and the delays.
        camera_hz: images per second.
        camera_latency_s: delay from the exposure to the page, as for the simulated camera.
        depth_latency_s: delay from the exposure to the keyframe.
        command_latency_s: least and largest delay from the arbiter to the base; each stack draws one value.
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
    overrides: tuple[str, ...] = ()

    def __post_init__(self) -> None:
        if self.method not in METHODS:
            raise ValueError(f"method must be one of {', '.join(METHODS)} (got {self.method!r})")
        names = (*NODES, *VSPACE_NODES, "theta_camera")
        for word in self.overrides:
            if word.partition(".")[0] not in names or ":=" not in word:
                raise ValueError(
                    f"parameter {word!r}: expected NODE.KEY:=VALUE with one of the nodes {', '.join(names)}"
                )


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
        """Do nothing: the line is in memory."""


class _Page(PageServer):
    """Passes on the images and the state that the console sends to its page."""

    def __init__(self, stack: SimulatedStack) -> None:
        self._stack = stack
        self.virtual = False
        self.state: dict[str, Any] = {}
        """Newest message."""

    def now_ms(self) -> float:
        return self._stack.bus.clock.now_ns() / 1e6

    def publish(self, kind: str, message: dict[str, Any]) -> None:
        """Keep the newest state; switch to the other kind of image if the state says so."""
        if kind != "state":
            return
        self.state = message
        virtual = message["shown"] == "virtual"
        if virtual != self.virtual:
            self.virtual = virtual
            self._stack.on_show()

    def send_frame(self, kind: FrameKind, header: dict[str, Any], payload: bytes) -> None:
        """Pass on images of camera and virtual space, but not maps."""
        if kind in (FrameKind.VIEW, FrameKind.PANORAMA):
            self._stack.on_frame(kind is FrameKind.VIEW, header, payload)


class SimulatedStack(Closing):
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
        self.log = DriveLog()
        self.state: Any = None
        self.vbot: FloatArray = self.start.copy()
        self.page = _Page(self)
        self.newest: dict[bool, Shown] = {}
        """Newest image that has arrived at the page: rendered views (True), camera images (False)."""
        self.command_delay_ns = round(1e9 * self.rng.uniform(*config.command_latency_s))
        self._commands: deque[tuple[int, Record]] = deque()
        self._steps = 0
        self._next_exposure_s = self._next_depth_s = 0.0
        self._exposed: deque[tuple[float, FloatArray]] = deque()  # camera images on their way to the page
        self._for_depth: deque[tuple[float, float, bytes]] = deque()  # due, exposure, JPEG
        self._keyframe_at: FloatArray | None = None
        self._drawn: dict[int, FloatArray] = {}  # images on their way to a keyframe: stamp, r-bot's true pose
        self.bus = LockstepBus(START_NS, keep=False, on_record=self.on_record)
        self._words = [
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
        self.nodes: dict[str, Any] = {}
        for name in names:
            self.start_node(name)
        if config.method == "ic":
            images_to = self.nodes["depth_estimator" if config.depth != "lidar" else "depth_scaler"]
            self._depth_hz = float(images_to.config.max_rate_hz)
        camera = make_node("theta_camera", None, self._words).config
        self._preview = camera.theta
        self.nodes["console"].transforms.broadcast_static("base_link", "camera", pose_matrix(*camera.camera_mount.pose))

    def start_node(self, name: str) -> None:
        """Start a node, also in place of one that was taken off the bus."""
        node = make_node(name, None, self._words)
        parts: dict[str, Any] = {}
        if name == "crawler_base":
            port = EmulatedPort(self.simulation.controller)
            parts["open_port"] = lambda _: port
        elif name == "console":
            parts["page"] = self.page
        self.nodes[name] = self.bus.add(node.node_class, node.config, name, remaps=_REMAPS.get(name), **parts)

    def close(self) -> None:
        """Close the nodes."""
        self.bus.close()

    def on_record(self, record: Record) -> None:
        """Take a message that a node has published."""
        topic = record.topic
        if topic == "/cmd_vel":
            self._commands.append((record.stamp_ns + self.command_delay_ns, record))
        elif topic == "/ic/state":
            self.state = deserialize(record.payload, record.type_name)
        elif topic == "/vbot/odom":
            message = deserialize(record.payload, record.type_name)
            self.vbot = self._in_world(pose2_from_message(message))
        elif topic == "/keyframe":
            self.log.keyframes += 1
            of = stamp_ns(deserialize(record.payload, record.type_name))
            self._keyframe_at = self._drawn.pop(of, self._keyframe_at)

    def _in_world(self, in_map: FloatArray) -> FloatArray:
        return np.asarray(compose2(self.start, in_map))

    # -- images

    def on_frame(self, virtual: bool, header: dict[str, Any], payload: bytes) -> None:
        """Take an image that arrives at the page."""
        if virtual:
            map_from_camera = matrix_from_quaternion(np.array(header["q"]))
            map_from_camera[:3, 3] = header["p"]
            pose = self._in_world(pose2_from_matrix(map_from_camera))
            now, fov_rad = self.time_s, float(header["fov"])
            shown = Shown(now, now, True, pose, pose[:2], float(pose[2]), payload, fov_rad)
        else:
            exposure_s, taken_from = self._exposed.popleft()
            stamp = START_NS + round(exposure_s * 1e9)
            known = self.nodes["console"].feed.display.lookup("map", "camera", stamp)
            place = taken_from if known is None else self._in_world(pose2_from_matrix(known))
            shown = Shown(self.time_s, self.time_s, False, taken_from, place[:2], float(self.robot[2]))
        self.newest[virtual] = shown
        if virtual == self.page.virtual:
            self.log.pictures.append(shown)

    def on_show(self) -> None:
        """Switch the page to the other kind of image: its newest one, if it is fresh."""
        newest = self.newest.get(self.page.virtual)
        if newest is not None and self.time_s - newest.time_s < 0.5:
            heading = newest.heading if newest.virtual else float(self.robot[2])
            self.log.pictures.append(replace(newest, time_s=self.time_s, heading=heading))

    def _photograph(self) -> None:
        now = self.time_s
        if now >= self._next_exposure_s - 1e-9:
            self._next_exposure_s += 1.0 / self.config.camera_hz
            self._exposed.append((now, self.robot))
            if self.config.method == "ic" and self._leads_to_keyframe():
                self._drawn[START_NS + round(now * 1e9)] = self.robot
                self._for_depth.append((now + self.config.depth_latency_s, now, self.photo_jpeg()))
        # Images in transit: the console itself takes the first off the queue.
        while self._exposed and now - self._exposed[0][0] >= self.config.camera_latency_s - 1e-9:
            waiting, exposure = len(self._exposed), self._exposed[0][0]
            self.publish_image("/camera/image/compressed", b"", exposure)
            if len(self._exposed) == waiting:  # the console is not available
                self._exposed.popleft()
        while self._for_depth and now >= self._for_depth[0][0] - 1e-9:
            _, exposure, image = self._for_depth.popleft()
            self.publish_image("/camera/for_depth", image, exposure)

    def publish_image(self, topic: str, image: bytes, exposure_s: float) -> None:
        """Publish a camera image (JPEG) that was exposed at a time in seconds."""
        message = compressed_image_message(image, "camera", START_NS + round(exposure_s * 1e9))
        self.bus.publish(topic, message)

    def _leads_to_keyframe(self) -> bool:
        """Return whether depth would make a keyframe of an image taken now, because none is near this position."""
        if self.time_s < self._next_depth_s - 1e-9:
            return False
        now_ns = START_NS + round(self.time_s * 1e9)
        wait_ns = (self.config.depth_latency_s + _OVERDUE_S) * 1e9
        while self._drawn and now_ns - next(iter(self._drawn)) > wait_ns:  # it did not become a keyframe
            del self._drawn[next(iter(self._drawn))]
        selector = self.nodes["depth_scaler"].chain.selector
        distance_m, angle_rad = selector.config.distance_m + 0.01, math.radians(selector.config.angle_deg + 0.5)
        places = [*self._drawn.values(), *([] if self._keyframe_at is None else [self._keyframe_at])]
        worth = all(_moved(self.robot, place, distance_m, angle_rad) for place in places)
        if worth:
            self._next_depth_s = self.time_s + 1.0 / self._depth_hz
        return worth

    def photo_jpeg(self) -> bytes:
        """Return the camera's image from the present pose, in the size of its preview."""
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
        seen = self.newest.get(False)
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
        log.yaw_gap_rad.append(float(state.yaw_gap_rad))
        log.command.append(command)
        log.blocked.append(bool(state.blocked))
        log.reason.append(str(state.reason))


def _moved(a: FloatArray, b: FloatArray, distance_m: float, angle_rad: float) -> bool:
    x, y, yaw = relative2(a, b)
    return math.hypot(float(x), float(y)) >= distance_m or abs(wrap_angle(float(yaw))) >= angle_rad
