"""The control nodes on a lockstep bus, in a corridor with a robot that drives by their command."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
from control_world import BEAMS, LIDAR_MAX_M, LIDAR_MIN_M, Base, World, corridor, draw_map, matrix

from instant_ic.bus.lockstep import LockstepBus
from instant_ic.msg import (
    PoseWithCovariance,
    PoseWithCovarianceStamped,
    TFMessage,
    grid_message,
    header,
    odometry_message,
    pose_message,
    scan_message,
    transform_message,
)
from nodes.arbiter import ArbiterNode
from nodes.navigator import NavigatorNode
from nodes.virtual_robot import VirtualRobotNode

START_NS = 1_000_000_000_000


class StackWorld:
    """V-bot, navigator and arbiter, with the map and the mounts; the messages of the sensors at the present time."""

    def __init__(self, bus: LockstepBus, obstacles: np.ndarray, length_m: float = 16.0) -> None:
        walls = corridor(length_m)
        self.bus, self.base, self.contact = bus, Base(), False
        self.world = World(np.concatenate([walls, obstacles]))
        self.silent: set[str] = set()
        """What does not come any more."""
        for node in (VirtualRobotNode, NavigatorNode):
            bus.add(node)
        self.arbiter = bus.add(ArbiterNode)
        static = draw_map(walls, (-2, -1.2, length_m - 2, 1.2))
        bus.publish("/map", grid_message(static.occupancy, 0.05, static.origin, "map", self.now), latched=True)
        mounts = []
        for frame, height_m in (("velodyne", 0.6), ("camera", 1.2)):
            place = np.eye(4)
            place[2, 3] = height_m
            mounts.append(transform_message(place, "base_link", frame, self.now))
        bus.publish("/tf_static", TFMessage(mounts), latched=True)

    @property
    def now(self) -> int:
        return self.bus.clock.now_ns()

    def drive_base(self, command: tuple[float, float]) -> None:
        self.base.step(command, 0.05)
        self.contact |= self.world.contact(self.base.pose)

    def transforms(self) -> TFMessage:
        frames = (("map", "odom", np.eye(4)), ("odom", "base_link", matrix(self.base.pose)))
        return TFMessage([transform_message(place, parent, child, self.now) for parent, child, place in frames])

    def odometry(self) -> Any:
        return odometry_message(matrix(self.base.pose), self.base.v, self.base.w, "odom", "base_link", self.now)

    def scan(self) -> Any:
        ranges = self.world.cast(*self.base.pose)
        return scan_message(ranges, -math.pi, 2 * math.pi / BEAMS, LIDAR_MIN_M, LIDAR_MAX_M, "velodyne", self.now)

    def pose(self) -> PoseWithCovarianceStamped:
        pose = PoseWithCovariance(pose=pose_message(matrix(self.base.pose)), covariance=np.zeros(36))
        return PoseWithCovarianceStamped(header=header("map", self.now), pose=pose)
