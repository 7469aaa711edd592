"""State of the page's main image: mode, poses of both robots, newest camera image and newest rendered view."""

from __future__ import annotations

import math
from typing import Any

import numpy as np

from instant_ic.bus.clock import Clock
from instant_ic.bus.topics import Latest
from instant_ic.config.robot import Mount
from instant_ic.console.protocol import FrameKind
from instant_ic.control.states import Mode
from instant_ic.geometry.poses import Matrix
from instant_ic.geometry.transforms import TransformBuffer, TransformError
from instant_ic.msg import (
    ControlState,
    MessageError,
    Pose,
    ShownPictures,
    header,
    matrix_from_pose,
    pose_message,
    to_time,
)
from instant_ic.util.pace import current

MODES = {int(mode): mode.label for mode in Mode}


def finite_pose(message: Any) -> Matrix | None:
    """Return the matrix of a message's pose; None if it is not a finite pose, so that the page gets the rest."""
    try:
        matrix = matrix_from_pose(message)
    except MessageError:
        return None
    return matrix if np.isfinite(matrix).all() else None


class Display:
    """State of the page's main image, reported to the arbiter by :meth:`report`. Poses are in the map frame.

    Args:
        tf: transform tree.
        clock: time of the stamps, and a steady time.
        mount: camera mount used until the tree contains it.

    Attributes:
        control: newest ControlState.
        vbot: newest odometry of the v-bot.
        mode: name of the control mode; ``none`` without an arbiter.
        shown: ``real`` (camera image), ``virtual`` (rendered view) or ``none``.
        image_stamp_ns: stamp of the newest camera image; 0 if there is none.
    """

    def __init__(self, tf: TransformBuffer, clock: Clock, control: Latest, vbot: Latest, mount: Mount) -> None:
        self.mode = self.shown = "none"
        self.control, self.vbot = control, vbot
        self._tf, self._clock, self._mount = tf, clock, mount
        self._image_ns: int | None = None  # arrival of the newest camera image, steady clock
        self.image_stamp_ns = 0
        self._view = (0, 0, 0.0)  # driver's newest view: request id, arrival (steady ns), delay (s)
        self._view_pose = pose_message(np.eye(4))  # map_from_camera of that view
        self._drawn_ms: float | None = None  # time of the newest state that the driver's page has rendered by itself
        self._drawn_ns = self._drawn_id = 0  # the same time by the steady clock, and the number of such states
        self._lost_ns: int | None = None  # time of the driver's last loss, steady clock

    @property
    def with_vbot(self) -> bool:
        """True if the v-bot's view is shown or soon will be shown."""
        return self.mode in ("entering", "virtual", "returning")

    @property
    def foreground(self) -> tuple[FrameKind, ...]:
        """Kinds of images that the page shows or soon will show."""
        if self.mode in ("entering", "returning"):  # the switch may happen at any moment
            return FrameKind.VIEW, FrameKind.PANORAMA
        return (FrameKind.VIEW if self.shown == "virtual" else FrameKind.PANORAMA,)

    def changes_mode(self, control: ControlState) -> bool:
        """Return whether a new state of the arbiter changes the mode that the page shows."""
        return self.mode not in ("none", MODES.get(int(control.mode)))

    def step(self) -> None:
        """Follow the arbiter's newest state."""
        if (control := self.control.message) is None:
            self.mode = self.shown = "none"
        else:
            self.mode = MODES.get(int(control.mode), "none")
            self.shown = "virtual" if int(control.shown) == ControlState.SHOWN_VIRTUAL else "real"

    def take_image(self, stamp_ns: int) -> None:
        """Record the arrival of a camera image."""
        self._image_ns, self.image_stamp_ns = self._clock.steady_ns(), stamp_ns

    def take_view(self, request_id: int, delay_s: float, camera: Pose) -> None:
        """Record a view that was rendered for the driver at the pose ``camera``."""
        self._view, self._view_pose = (request_id, self._clock.steady_ns(), delay_s), camera

    def take_drawn(self, drawn_ms: float | None, server_ms: float) -> None:
        """Record the newest state that the driver's page has rendered by itself.

        Args:
            drawn_ms: time of that state by the server's clock; None if the page shows rendered views.
            server_ms: present time of the server's clock.
        """
        if drawn_ms is not None and drawn_ms != self._drawn_ms:
            self._drawn_ns = self._clock.steady_ns() - round(max(server_ms - drawn_ms, 0.0) * 1e6 * current().factor)
            self._drawn_id = self._drawn_id % (2**32 - 1) + 1  # uint32; 0 means no view
        self._drawn_ms = drawn_ms

    def lose_driver(self) -> None:
        """Record the loss of the driver."""
        self._lost_ns = self._clock.steady_ns()

    @property
    def image_age_s(self) -> float:
        """Age of the newest camera image since its arrival; infinite if there is none."""
        return math.inf if self._image_ns is None else (self._clock.steady_ns() - self._image_ns) / 1e9

    def report(self) -> ShownPictures:
        """Return the available images, their age and the loss of the driver. Any thread may call it."""
        stamp_ns, now_ns = self._clock.now_ns(), self._clock.steady_ns()
        lost_ns = self._lost_ns
        view_id, came_ns, delay_s = self._view
        pose = self._view_pose
        if self._drawn_ms is not None:  # the page renders the v-bot's pose in this state
            view_id, came_ns, delay_s = self._drawn_id, self._drawn_ns, 0.0
            if (vbot := self.vbot_pose()) is not None:
                pose = pose_message(vbot @ self.camera_mount())
        return ShownPictures(
            header=header("map", stamp_ns),
            picture_stamp=to_time(self.image_stamp_ns),
            picture_age_s=self.image_age_s,
            view_id=view_id,
            view_pose=pose,
            view_age_s=math.inf if view_id == 0 else (now_ns - came_ns) / 1e9,
            view_delay_s=delay_s,
            # By the steady clock, so that new commands never look older than the loss if the system clock is set back.
            operator_lost=to_time(0 if lost_ns is None else stamp_ns - (now_ns - lost_ns)),
        )

    def lookup(self, target: str, source: str, stamp_ns: int | None = None) -> Matrix | None:
        """Return ``target_from_source`` at ``stamp_ns``, or the newest transform; None if the tree has a gap."""
        for when in (stamp_ns, None):
            try:
                return self._tf.lookup(target, source, when)
            except TransformError:
                continue
        return None

    def robot_pose(self) -> Matrix | None:
        """Return map_from_base of the r-bot; the arbiter's estimate if the tree has a gap."""
        pose = self.lookup("map", "base_link")
        control = self.control.message
        return finite_pose(control.robot_pose) if pose is None and control is not None else pose

    def vbot_pose(self) -> Matrix | None:
        """Return map_from_base of the v-bot; the arbiter's estimate until the v-bot publishes its pose."""
        if self.vbot.message is not None:
            return finite_pose(self.vbot.message)
        control = self.control.message
        return None if control is None else finite_pose(control.vbot_pose)

    def camera_mount(self) -> Matrix:
        """Return base_from_camera without rotation, because look directions are relative to the heading."""
        mount = np.eye(4)
        base_from_camera = self.lookup("base_link", "camera")
        mount[:3, 3] = self._mount.xyz if base_from_camera is None else base_from_camera[:3, 3]
        return mount
