"""Poses of both robots and of the camera's mount, from the transform tree or else from the arbiter."""

from __future__ import annotations

import numpy as np

from instant_ic.bus.topics import Latest
from instant_ic.config.robot import Mount
from instant_ic.geometry.poses import Matrix, pose2_from_matrix
from instant_ic.geometry.transforms import TransformBuffer, TransformError
from instant_ic.msg import Path, matrix_from_pose, path_array


class RobotPoses:
    """Poses of both robots, all in the map frame.

    Args:
        tf: transform tree.
        control: newest ControlState.
        vbot: newest odometry of the v-bot.
        mount: mount of the camera while the tree lacks it.
    """

    def __init__(self, tf: TransformBuffer, control: Latest, vbot: Latest, mount: Mount) -> None:
        self._tf, self._control, self._vbot, self._mount = tf, control, vbot, mount

    def lookup(self, target: str, source: str, stamp_ns: int | None = None) -> Matrix | None:
        """Return ``target_from_source`` at ``stamp_ns``, else the newest one; None if the tree has a gap."""
        for when in (stamp_ns, None):
            try:
                return self._tf.lookup(target, source, when)
            except TransformError:
                continue
        return None

    def robot_pose(self) -> Matrix | None:
        """Return map_from_base of the r-bot; the arbiter's estimate if the tree has a gap."""
        pose = self.lookup("map", "base_link")
        control = self._control.message
        return matrix_from_pose(control.robot_pose) if pose is None and control is not None else pose

    def vbot_pose(self) -> Matrix | None:
        """Return map_from_base of the v-bot; the arbiter's estimate until the v-bot publishes its own."""
        if self._vbot.message is not None:
            return matrix_from_pose(self._vbot.message)
        control = self._control.message
        return None if control is None else matrix_from_pose(control.vbot_pose)

    def camera_mount(self) -> Matrix:
        """Return base_from_camera with the identity as rotation: look directions are relative to the heading."""
        mount = np.eye(4)
        base_from_camera = self.lookup("base_link", "camera")
        mount[:3, 3] = self._mount.xyz if base_from_camera is None else base_from_camera[:3, 3]
        return mount

    def points(self, path: Path | None) -> list[list[float]]:
        """Return the points [x, y] of a path in the map frame, rounded to 1 mm; empty without one in this frame."""
        if path is None or not path.poses or path.header.frame_id not in ("", "map"):
            return []
        xy = path_array(path)[:, :2]
        points: list[list[float]] = xy[np.isfinite(xy).all(axis=1)].round(3).tolist()
        return points


def planar(pose: Matrix | None) -> list[float] | None:
    """Return [x, y, yaw] of a pose, m and rad; None without one."""
    return None if pose is None else [round(float(value), 4) for value in pose2_from_matrix(pose)]
