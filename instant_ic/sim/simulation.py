"""Simulation of the whole robot in a world: dynamics, pose history and device data, without threads or sockets."""

import math
import threading
from dataclasses import dataclass, field
from typing import Annotated

import numpy as np
import numpy.typing as npt

from instant_ic.base.config import SkidSteerConfig
from instant_ic.config.ranges import Checked, NotNegativeInt, Range, check_ranges
from instant_ic.config.robot import CAMERA_MOUNT, LIDAR_MOUNT, Mount, Rectangle
from instant_ic.geometry.poses import pose_matrix
from instant_ic.sim.render import EquirectRenderer, RenderedFrame
from instant_ic.sim.roboclaw_emulator import RoboclawEmulator
from instant_ic.sim.robot import RobotConfig, TrackedRobot
from instant_ic.sim.theta import SimThetaConfig
from instant_ic.sim.vlp16 import Vlp16, Vlp16Config
from instant_ic.sim.world import World
from instant_ic.sim.worlds import make_world

#: Longest step of the dynamics, seconds.
STEP_S = 0.02
#: Length of the pose history, seconds.
HISTORY_S = 3.0
#: Voltage of the full battery at rest.
BATTERY_V = 25.2


@dataclass(frozen=True)
class BaseConfig(Checked):
    """Parameters of the simulated motor controller.

    Attributes:
        enabled: whether the controller is simulated.
        address: packet serial address.
    """

    enabled: bool = True
    address: Annotated[int, Range(128, 135)] = 0x80


@dataclass(frozen=True)
class SimulationConfig:
    """Parameters of the simulation.

    Attributes:
        world: corridor, corridor:SEED, corridor-free, random:SEED, long:SEED, or a mesh file (see ``make_world``).
        start: start pose x, y (metres), yaw (radians) of the robot; empty selects the world's start.
        seed: seed of all noise.
        robot, camera, lidar, base: parameters of the parts.
        footprint: outline of the robot.
        geometry: tracks and encoders.
        camera_mount, lidar_mount: poses on base_link.
    """

    world: str = "corridor"
    start: tuple[Annotated[float, Range(-1000, 1000)], ...] = ()
    seed: NotNegativeInt = 0
    robot: RobotConfig = field(default_factory=RobotConfig)
    camera: SimThetaConfig = field(default_factory=SimThetaConfig)
    lidar: Vlp16Config = field(default_factory=Vlp16Config)
    base: BaseConfig = field(default_factory=BaseConfig)
    footprint: Rectangle = field(default_factory=Rectangle)
    geometry: SkidSteerConfig = field(default_factory=SkidSteerConfig)
    camera_mount: Mount = CAMERA_MOUNT
    lidar_mount: Mount = LIDAR_MOUNT

    def __post_init__(self) -> None:
        check_ranges(self)
        if len(self.start) not in (0, 3):
            raise ValueError(f"start must be empty or x, y, yaw (got {list(self.start)})")


class Simulation:
    """Robot and world, advanced by ``step`` as fast as the machine allows.

    Example:
        >>> simulation = Simulation(SimulationConfig(world="corridor"))       # doctest: +SKIP
        >>> simulation.drive(0.3, 0.0); simulation.step(1.0)                  # doctest: +SKIP
        >>> simulation.panorama(1024, 512).rgb.shape                          # doctest: +SKIP
        (512, 1024, 3)

    Attributes:
        time_s: simulated time since the start.
        lock: held during access to the controller, also by the code that serves it on a serial line.
    """

    def __init__(self, config: SimulationConfig, start_ns: int = 0, world: World | None = None) -> None:
        self.config = config
        self.start_ns = start_ns
        self.world = world or make_world(config.world)
        start = config.start or self.world.spawn
        mask = self.world.occupied(cell_m=0.01)
        pose = (start[0], start[1], start[2])
        self.robot = TrackedRobot(config.robot, mask, pose, config.seed, config.footprint, config.geometry)
        self.controller = RoboclawEmulator(config.base.address, ideal_motors=False)
        self.controller.battery_v = BATTERY_V
        self.lock = threading.Lock()
        self.renderer = EquirectRenderer(self.world)
        self.time_s = 0.0
        size = int(HISTORY_S / STEP_S) + 2
        self._history = np.column_stack([np.full(size, -1e9), np.tile(self.robot.pose, (size, 1))])
        self._remember()
        self.scanner = Vlp16(config.lidar, self.world, self.poses_at, self.epoch_ns, config.seed, config.lidar_mount)

    def epoch_ns(self, time_s: float) -> int:
        """Return the epoch time of a simulated time. After a pause of the simulation, ``start_ns`` is shifted."""
        return self.start_ns + round(time_s * 1e9)

    def step(self, dt_s: float) -> None:
        """Advance robot and controller by ``dt_s``."""
        if dt_s < 0:
            raise ValueError(f"dt_s must be >= 0 (got {dt_s})")
        count = max(1, math.ceil(dt_s / STEP_S - 1e-9)) if dt_s > 0 else 0
        for _ in range(count):
            part = dt_s / count
            with self.lock:
                self.controller.advance(part)
                drive(self.robot, self.controller, part)
                load = float(np.abs(self.robot.tracks).mean())
                used = self.time_s / 3600.0 * 0.4
                self.controller.battery_v = max(20.0, BATTERY_V - used - 0.6 * load)
            self.time_s += part
            self._remember()

    def drive(self, v: float, w: float) -> None:
        """Set the motors for a speed (m/s) and turn rate (rad/s), in simulations without a serial line."""
        kinematics = self.robot.kinematics
        pulses = kinematics.motors_from_tracks(kinematics.tracks_from_twist(v, w))
        with self.lock:
            self.controller.target_speed_pps[:] = pulses
            self.controller.acceleration_pps2 = 0.0
            self.controller.closed_loop = True

    def put_down(self, pose: tuple[float, float, float]) -> None:
        """Lift the robot and put it down at another pose (x, y, yaw); tracks and encoders do not notice.

        Raises:
            ValueError: an object is in the way.
        """
        with self.lock:
            self.robot.put_down(pose)

    def poses_at(self, times_s: npt.ArrayLike) -> npt.NDArray[np.float64]:
        """Interpolate x, y, yaw (N, 3) of base_link in the world at simulated times (N,), clamped at the ends."""
        times = np.asarray(times_s, float)
        history = self._history
        return np.stack([np.interp(times, history[:, 0], history[:, k]) for k in (1, 2, 3)], axis=-1)

    def world_from_base(self, time_s: float | None = None) -> npt.NDArray[np.float64]:
        """Return the pose (4, 4) of base_link at a simulated time, by default the current one."""
        x, y, yaw = self.robot.pose if time_s is None else self.poses_at([time_s])[0]
        return pose_matrix(x, y, 0.0, 0.0, 0.0, yaw)

    def panorama(self, width: int, height: int) -> RenderedFrame:
        """Render the camera's current view."""
        base_from_camera = pose_matrix(*self.config.camera_mount.pose)
        return self.renderer.render(self.world_from_base() @ base_from_camera, width, height)

    def scan_packets(self, count: int | None = None) -> list[bytes]:
        """Return the scanner's next ``count`` data packets, or all packets that are complete."""
        return self.scanner.make(self.scanner.due(self.time_s) if count is None else count)

    def _remember(self) -> None:
        # A new array instead of a shift in place, because another thread may be reading the old one.
        self._history = np.vstack([self._history[1:], [self.time_s, *self.robot.pose]])


def drive(robot: TrackedRobot, controller: RoboclawEmulator, dt_s: float) -> None:
    """Advance the robot under its controller's demands, and give the controller the measurements."""
    motors, kinematics = robot.motors, robot.kinematics
    motors.battery_v = controller.battery_v
    robot.step(controller.setpoint_pps, dt_s, controller.closed_loop)
    controller.encoder[:] = robot.encoder_pulses
    controller.speed_pps[:] = robot.motor_speed_pps
    controller.power[:] = kinematics.motors_from_tracks(motors.power) / kinematics.config.pulses_per_metre
    controller.currents_a[:] = kinematics.motors_from_tracks(motors.currents_a) / kinematics.config.pulses_per_metre


def warm_up() -> None:
    """Compile the kernels of the renderer and of the simulated lidar."""
    simulation = Simulation(SimulationConfig())
    simulation.panorama(64, 32)
    simulation.step(0.2)
    simulation.scanner.make(simulation.scanner.due(simulation.time_s))
