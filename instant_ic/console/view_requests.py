"""Requests for rendered views: which pose, how large and when."""

from __future__ import annotations

import math
from dataclasses import replace

from instant_ic.console.display import Display
from instant_ic.console.robot_poses import RobotPoses
from instant_ic.console.view import PROBE, PROBE_HZ, RESPONSE_TIMEOUT_S, Look, ViewConfig, view_shape
from instant_ic.msg import ViewRequest, header, pose_message

_MOST_PENDING = 8


class ViewRequests:
    """Requests for views: to be shown while a page needs them, else small ones for the expected PSNR.

    One request is outstanding at a time; the next follows its answer or time-out.

    Attributes:
        config: rate and size; may be replaced at any time.
        look: the driver's look direction.
    """

    def __init__(self, config: ViewConfig, poses: RobotPoses, display: Display) -> None:
        self.config = config
        self.look = Look()
        self._poses, self._display = poses, display
        self._newest, self._outstanding, self._asked_ns = 0, False, -math.inf
        self._sent_ns: dict[int, int | None] = {}  # recent requests: id -> send time (steady ns); None: only judged

    def next(self, renders: bool, needed: bool, stamp_ns: int, now_ns: int) -> ViewRequest | None:
        """Return the request that is due, or None.

        Args:
            renders: True if the virtual space can render.
            needed: True if a page shows rendered views.
            stamp_ns: stamp of the request.
            now_ns: steady clock.
        """
        virtual = self._display.with_vbot
        map_from_base = self._poses.vbot_pose() if virtual else self._poses.robot_pose()
        rate_hz = self.config.virtual_rate_hz if virtual and needed else PROBE_HZ
        if not (virtual or renders) or map_from_base is None or not self._due((now_ns - self._asked_ns) / 1e9, rate_hz):
            return None
        size = self.config if needed else replace(self.config, width=PROBE[0], height=PROBE[1])
        shape = view_shape(self.look, size)
        self._newest = self._newest % (2**32 - 1) + 1  # uint32 in ViewRequest; 0 stays unused
        self._outstanding, self._asked_ns = True, now_ns
        self._sent_ns[self._newest] = now_ns if needed else None
        while len(self._sent_ns) > _MOST_PENDING:
            del self._sent_ns[next(iter(self._sent_ns))]
        return ViewRequest(
            header=header("map", stamp_ns),
            id=self._newest,
            pose=pose_message(map_from_base @ self._poses.camera_mount() @ self.look.rotation()),
            fov_rad=shape.fov_rad,
            width=shape.width,
            height=shape.height,
        )

    def _due(self, since_s: float, rate_hz: float) -> bool:
        """Return whether to send a request ``since_s`` after the last one, at a rate of ``rate_hz``."""
        if self._outstanding and since_s < RESPONSE_TIMEOUT_S:
            return False
        return since_s >= 1.0 / rate_hz - 0.001

    def answered(self, request_id: int, now_ns: int) -> float | None:
        """Note an answer; return its delay in seconds, None for a view that is not shown.

        A slow renderer answers after the time-out, which is when its delay matters most.
        """
        if request_id == self._newest:
            self._outstanding = False
        sent_ns = self._sent_ns.get(request_id, now_ns)
        return None if sent_ns is None else (now_ns - sent_ns) / 1e9
