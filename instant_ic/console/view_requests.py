"""Requests for rendered views: which pose, for whom and when."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from instant_ic.console.display import Display
from instant_ic.console.scene import Scene
from instant_ic.console.view import Look, ViewConfig, ViewScheduler, view_shape
from instant_ic.geometry.poses import Matrix
from instant_ic.msg import ViewRequest, header, pose_message

_MOST_PENDING = 8


class ViewRequests:
    """Makes the requests of the driver and, in spare time, of watching pages.

    Attributes:
        config: rates and sizes; may be replaced at any time.
        look: the driver's look direction.
    """

    def __init__(self, config: ViewConfig, scene: Scene, display: Display) -> None:
        self.look = Look()
        self._scheduler = ViewScheduler(config)
        self._scene, self._display = scene, display
        self._last: tuple[Matrix, Look] | None = None  # pose and look of the last request
        self._sent_ns: dict[int, int] = {}  # the driver's recent requests: id -> send time (steady ns)

    @property
    def config(self) -> ViewConfig:
        return self._scheduler.config

    @config.setter
    def config(self, config: ViewConfig) -> None:
        self._scheduler.config = config

    def next(
        self, renders: bool, watching: Callable[[], dict[int, Look]], stamp_ns: int, now_ns: int
    ) -> ViewRequest | None:
        """Return the request that is due: the driver's, else a watching page's, else None.

        Args:
            renders: whether the virtual space can render.
            watching: returns the looks of the watching pages, by client.
            stamp_ns: stamp of the request.
            now_ns: steady clock.
        """
        virtual = self._display.with_vbot
        map_from_base = self._scene.vbot_pose() if virtual else self._scene.robot_pose()
        if not (virtual or renders) or map_from_base is None:
            return None
        moves = (
            self._last is None or self._last[1] != self.look or not np.allclose(map_from_base, self._last[0], atol=1e-4)
        )
        if self._scheduler.due(now_ns / 1e9, virtual=virtual, moves=moves):
            self._last = map_from_base, self.look
            return self._request(map_from_base, self.look, None, stamp_ns, now_ns)
        if self._display.shown == "virtual":
            looks = watching()
            page = self._scheduler.watcher(now_ns / 1e9, self.look, looks)
            if page is not None:
                return self._request(map_from_base, looks[page], page, stamp_ns, now_ns)
        return None

    def answered(self, request_id: int, now_ns: int) -> tuple[int | None, float]:
        """Note an answer; return the watching page it is for (None: the driver's), and its delay in seconds.

        A slow renderer answers after the time-out, which is when its delay matters most.
        """
        self._scheduler.answered(request_id, now_ns / 1e9)
        return self._scheduler.page_of(request_id), (now_ns - self._sent_ns.get(request_id, now_ns)) / 1e9

    def _request(self, map_from_base: Matrix, look: Look, page: int | None, stamp_ns: int, now_ns: int) -> ViewRequest:
        shape = view_shape(look, self.config)
        number = self._scheduler.asked(now_ns / 1e9, page)
        if page is None:
            self._sent_ns[number] = now_ns
            while len(self._sent_ns) > _MOST_PENDING:
                del self._sent_ns[next(iter(self._sent_ns))]
        return ViewRequest(
            header=header("map", stamp_ns),
            id=number,
            pose=pose_message(map_from_base @ self._scene.camera_mount() @ look.rotation()),
            fov_rad=shape.fov_rad,
            width=shape.width,
            height=shape.height,
        )
