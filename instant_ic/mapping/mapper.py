"""Mapper that feeds the local model with LiDAR revolutions and transforms."""

from __future__ import annotations

import math
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from instant_ic.config.ranges import Checked, Positive
from instant_ic.geometry.poses import Matrix, inverse
from instant_ic.geometry.transforms import TransformBuffer, TransformError
from instant_ic.lidar.deskew import TimedPoints, points_at
from instant_ic.mapping.local_model import STRIDE, LocalDepth, LocalModel, LocalModelConfig


@dataclass(frozen=True)
class MapperTuning:
    """Tuning of the mapper.

    Attributes:
        jump_m: change of the pose's correction, beyond drift, that counts as a jump, in metres.
        jump_rad: the same in angle.
        drift: share of the motion by which odometry may drift.
        keep_s: time in motion, such as turning on the spot, that counts as a path of ``keep_m``, in seconds.
        back_ns: step back in time above which the model is cleared.
        most_points: largest number of points of a revolution; one with more is refused.
        enough_points: number of points of a revolution above which only a part is used.
        still_m: motion up to which the robot counts as standing, in metres.
        still_rad: the same in angle.
    """

    jump_m: float = 0.2
    jump_rad: float = math.radians(2.0)
    drift: float = 0.3
    keep_s: float = 60.0
    back_ns: int = 1_000_000_000
    most_points: int = 200_000
    enough_points: int = 16_000
    still_m: float = 0.01
    still_rad: float = math.radians(1.0)


TUNING = MapperTuning()


class CloudError(ValueError):
    """A revolution cannot be added."""


@dataclass(frozen=True)
class MapperConfig(Checked):
    """Parameters of the local 3D model.

    Attributes:
        model: parameters of the model.
        every_m: motion between two revolutions that are added, in metres.
        every_s: time between two revolutions while the robot stands, in seconds, for objects that move around it.
    """

    model: LocalModelConfig = field(default_factory=LocalModelConfig)
    every_m: Positive = 0.15
    every_s: Positive = 1.0


class LocalMapper:
    """Adds revolutions to a ``LocalModel``. Each is added when the next arrives, because its odometry is then known.

    Small corrections of the pose shift new revolutions in the model, so that surfaces fit together better than with
    odometry alone. At a jump (a loop closure, a relocalization), the model moves with the robot instead.

    Args:
        transforms: poses of the sensors over time.
        config: parameters.
    """

    def __init__(self, transforms: TransformBuffer, config: MapperConfig | None = None) -> None:
        self.transforms, self.config = transforms, config or MapperConfig()
        self.model = LocalModel(self.config.model)
        self.clear()

    def clear(self) -> None:
        """Forget everything."""
        self.model.clear()
        self._held: TimedPoints | None = None
        self._taken_ns: int | None = None
        self._taken_at: Matrix | None = None
        self._reference: tuple[int, Matrix] | None = None  # stamp and map_from_odom at the last look-up
        self._model_from_map = np.eye(4)

    def revolution(self, new: TimedPoints) -> None:
        """Hold a revolution, and add the previous one if it is due. Only revolutions that are added are decoded.

        Raises:
            CloudError: the revolution is empty or too large, or time went back, which clears the model.
            TransformError: the pose of the LiDAR is not known.
        """
        held, self._held = self._held, None
        newest = self._taken_ns if held is None else held.stamp_ns
        if newest is not None and new.stamp_ns < newest - TUNING.back_ns:
            self.clear()
            self._held = new
            raise CloudError(f"time went back by {(newest - new.stamp_ns) / 1e9:.1f} s: the local model starts again")
        count = len(new.time_s)
        if not 0 < count <= TUNING.most_points:
            raise CloudError(f"a revolution of {count} points is ignored (1 to {TUNING.most_points} are allowed)")
        self._held = new
        if held is not None:
            self._add(held)

    def _add(self, revolution: TimedPoints) -> None:
        """Add a revolution if the robot has moved or enough time has passed."""
        frame, stamp_ns, middle_ns = revolution.frame, revolution.stamp_ns, revolution.middle_ns
        odom_from_lidar = self.transforms.lookup("odom", frame, middle_ns)
        moved_m, turned_rad = math.inf, math.inf
        if self._taken_at is not None and self._taken_ns is not None:
            moved_m = float(np.linalg.norm(odom_from_lidar[:3, 3] - self._taken_at[:3, 3]))
            turned_rad = _angle(self._taken_at, odom_from_lidar)
            waited_s = (stamp_ns - self._taken_ns) / 1e9
            if moved_m < self.config.every_m and 0 <= waited_s < self.config.every_s:
                return
        model_from_map = self._model_from_map_at(frame, middle_ns)
        time_s, points = revolution.time_s, revolution.xyz()
        if len(points) != len(time_s):
            raise CloudError(f"a revolution of {len(points)} points with {len(time_s)} times is ignored")
        step = -(-len(points) // TUNING.enough_points)
        # Start at another point each time. Beams fire in a fixed order, so a fixed start would use only some rings.
        first = self.model.revolutions % step
        lidar = points_at(
            points[first::step], time_s[first::step], stamp_ns,
            lambda at_ns: model_from_map @ self._map_from(frame, at_ns),
        )  # fmt: skip
        if len(lidar) == 0:
            raise CloudError("a revolution without a finite point is ignored")
        advance_m = 0.0
        if self._taken_ns is not None and (moved_m > TUNING.still_m or turned_rad > TUNING.still_rad):
            since_s = max(stamp_ns - self._taken_ns, 0) / 1e9
            advance_m = max(moved_m, min(since_s, self.config.every_s) * self.config.model.keep_m / TUNING.keep_s)
        # At rest, few revolutions are added. All their beams free space, so that removed objects vanish soon.
        stride = 1 if moved_m < self.config.every_m else STRIDE
        self.model.add(lidar, (model_from_map @ self._map_from(frame, middle_ns))[:3, 3], advance_m, stride)
        self._taken_ns, self._taken_at = stamp_ns, odom_from_lidar

    def _map_from(self, frame: str, stamp_ns: int) -> Matrix:
        """Return the pose of a sensor in the map at a time, or in odometry if there is no map."""
        return self._correction(stamp_ns) @ self.transforms.lookup("odom", frame, stamp_ns)

    def _correction(self, stamp_ns: int) -> Matrix:
        try:
            return correction(self.transforms, stamp_ns)
        except TransformError:
            return np.eye(4) if self._reference is None else self._reference[1]

    def _model_from_map_at(self, frame: str, stamp_ns: int) -> Matrix:
        """Return the pose of the map in the model. A jump since the last call moves the model with the robot.

        Images and revolutions come in any order of their stamps. The change of the correction is therefore compared
        with the motion over the same time. A turn on slipping tracks may change it by degrees without being a jump.
        """
        map_from_odom = self._correction(stamp_ns)
        if self._reference is not None:
            reference_ns, before = self._reference
            odom_from_sensor = self.transforms.lookup("odom", frame, stamp_ns)
            try:
                start = self.transforms.lookup("odom", frame, reference_ns)
            except TransformError:  # the reference is older than the buffer
                start = odom_from_sensor
            moved_m = float(np.linalg.norm(odom_from_sensor[:3, 3] - start[:3, 3]))
            shift = (map_from_odom - before) @ np.append(odom_from_sensor[:3, 3], 1.0)
            if float(np.linalg.norm(shift[:3])) > TUNING.jump_m + TUNING.drift * moved_m or (
                _angle(before, map_from_odom) > TUNING.jump_rad + TUNING.drift * _angle(start, odom_from_sensor)
            ):
                self._model_from_map = self._model_from_map @ before @ inverse(map_from_odom)
        self._reference = stamp_ns, map_from_odom
        return self._model_from_map

    def model_from_camera(self, camera: str, stamp_ns: int) -> Matrix:
        """Return the pose of a camera in the model.

        Raises:
            TransformError: the pose is not known.
        """
        return self._model_from_map_at(camera, stamp_ns) @ self._map_from(camera, stamp_ns)

    def cloud(self) -> NDArray[np.float32]:
        """Return the points of the model in the map frame, (N, 3); (0, 3) before the first revolution."""
        if self.model.revolutions == 0:
            return np.empty((0, 3), np.float32)
        map_from_model = inverse(self._model_from_map)
        points = self.model.points()
        return (points @ map_from_model[:3, :3].T + map_from_model[:3, 3]).astype(np.float32)


@dataclass(frozen=True)
class LocalView:
    """The model and the pose of a camera in it."""

    model: LocalModel
    model_from_camera: Matrix

    @property
    def ceiling_m(self) -> float | None:
        """Height of the ceiling above the camera; None if none was seen."""
        found = self.model.ceiling_m(self.model_from_camera[:3, 3])
        return None if found is None else found - float(self.model_from_camera[2, 3])

    def render(self, size: tuple[int, int], ceiling_m: float | None) -> LocalDepth:
        """Render a depth image; ``ceiling_m`` above the camera is used if the model has seen no ceiling."""
        over_floor = None if ceiling_m is None else ceiling_m + float(self.model_from_camera[2, 3])
        return self.model.render(self.model_from_camera, size, over_floor)


def correction(transforms: TransformBuffer, stamp_ns: int) -> Matrix:
    """Return map_from_odom at a time, or the newest if that time is not covered.

    Raises:
        TransformError: the transform is not known.
    """
    try:
        return transforms.lookup("map", "odom", stamp_ns)
    except TransformError:
        return transforms.lookup("map", "odom")


def _angle(first: Matrix, second: Matrix) -> float:
    """Return the angle between two poses, radians."""
    return math.acos(min(1.0, max(-1.0, float(np.trace(first[:3, :3].T @ second[:3, :3]) - 1) / 2)))
