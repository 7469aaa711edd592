"""Where the operator looks, and which rendered view to ask for next."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Annotated

import numpy as np
from numpy.typing import NDArray

from instant_ic.config.ranges import NotNegative, Positive, Range, check_ranges
from instant_ic.geometry.poses import pose_matrix

MAX_FOV_RAD = math.radians(150)
WATCHER_APART_RAD = math.radians(15)
"""Who looks elsewhere than the driver by less has enough of the driver's view."""
ELSEWHERE_M = 1.0
"""A view from farther off is no earlier look at the same place: it is shown as it was drawn."""


@dataclass(frozen=True)
class ViewConfig:
    """Rendered views that the console asks for."""

    width: Annotated[int, Range(16, 4096)] = 320  # with height: number of pixels; the shape is the window's
    height: Annotated[int, Range(16, 4096)] = 180
    fov_margin: Annotated[float, Range(1, 2)] = 1.15  # asked field of view over the shown one, to be re-aimed
    virtual_rate_hz: Positive = 10.0  # while the virtual space is shown
    still_rate_hz: Positive = 5.0  # likewise, while nothing moves: the renderer is then free when it does
    watcher_rate_hz: NotNegative = (
        2.0  # for a page that looks elsewhere than the driver's, where there is time; 0 = none
    )
    real_rate_hz: NotNegative = 1.0  # while the camera is shown, to keep the renderer warm; 0 = none
    response_timeout_s: Positive = 0.5  # a request without an answer counts as lost after this

    def __post_init__(self) -> None:
        check_ranges(self)


@dataclass(frozen=True)
class LeadConfig:
    """Rendered views shown from where the v-bot is now (``geometry.depth_picture``)."""

    max_m: NotNegative = 0.3  # at most so far from where a view was drawn for; 0: each as it was drawn
    seconds: NotNegative = 0.8  # after the switch until the v-bot's place is shown, and before the return back

    def __post_init__(self) -> None:
        check_ranges(self)


@dataclass(frozen=True)
class Look:
    """Look direction relative to the robot's heading, and the shown field of view.

    Yaw is counter-clockwise (left positive), pitch is up positive; radians.
    """

    yaw: float = 0.0
    pitch: float = 0.0
    hfov: float = math.radians(90)
    vfov: float = math.radians(58.7)

    def rotation(self) -> NDArray[np.float64]:
        """camera_from_look as a 4x4 pose: x along the line of sight, y left, z up."""
        # In x-forward, y-left axes a positive turn about y lowers the line of sight.
        return pose_matrix(0.0, 0.0, 0.0, 0.0, -self.pitch, self.yaw)

    def apart(self, other: Look) -> float:
        """Angle (rad) between the two lines of sight."""
        cosine = float(self.rotation()[:3, 0] @ other.rotation()[:3, 0])
        return math.acos(min(max(cosine, -1.0), 1.0))


@dataclass(frozen=True)
class ViewShape:
    """Horizontal field of view (rad) and size (pixels) of a view to be asked for."""

    fov_rad: float
    width: int
    height: int


def view_shape(look: Look, config: ViewConfig) -> ViewShape:
    """Shape of the view that covers ``look`` with the margin, in the operator's aspect ratio.

    The number of pixels stays that of the configuration, whatever the window's shape, because it
    sets the renderer's time. Sizes are multiples of 8.
    """
    half_width = math.tan(min(look.hfov * config.fov_margin, MAX_FOV_RAD) / 2)
    half_height = math.tan(min(look.vfov * config.fov_margin, MAX_FOV_RAD) / 2)
    aspect = min(max(half_width / half_height, 0.5), 2.5)
    pixels = config.width * config.height
    width = max(16, 8 * round(math.sqrt(pixels * aspect) / 8))
    height = max(16, 8 * round(math.sqrt(pixels / aspect) / 8))
    # Where the aspect was clamped or rounded, the wider need decides.
    fov = 2 * math.atan(max(half_width, half_height * width / height))
    return ViewShape(fov, width, height)


class Lead:
    """How far a rendered view is shown on its way from the place that it was drawn for to the v-bot's place now.

    0 at a switch, where every picture is shown from where it was made, so that nothing jumps; 1 while the v-bot drives.
    """

    def __init__(self, config: LeadConfig) -> None:
        self.config = config
        self.share = 0.0
        self._at_s: float | None = None

    def step(self, now_s: float, driven: bool) -> float:
        """The share now, on the steady clock; ``driven``: the operator drives the v-bot."""
        passed_s = 0.0 if self._at_s is None else now_s - self._at_s
        self._at_s = now_s
        step = passed_s / self.config.seconds if self.config.seconds > 0 else 1.0
        self.share = min(self.share + step, 1.0) if driven else max(self.share - step, 0.0)
        return self.share

    def displayed(self, place: NDArray[np.float64], now: NDArray[np.float64]) -> NDArray[np.float64]:
        """Where the page shows a view from that was drawn for ``place``, with the v-bot's camera at ``now``, (N,) m."""
        way = now - place
        far = float(np.linalg.norm(way))
        if far > ELSEWHERE_M or far == 0.0:
            return place
        shown: NDArray[np.float64] = place + min(self.share, self.config.max_m / far) * way
        return shown


class ViewScheduler:
    """One request outstanding; the next after the answer or the time-out, at the rate of the mode.

    What moves after a rest is asked for at once: the operator waits for it. Between the driver's views those come in
    that look elsewhere, as long as the driver's next does not have to wait for them.
    """

    def __init__(self, config: ViewConfig) -> None:
        self.config = config
        self.lost = 0
        self._next_id = 1
        self._outstanding: int | None = None
        self._asked_s = -math.inf  # of any request
        self._due_s = -math.inf  # the driver's last request
        self._takes_s = 0.0  # from a request to its answer, the last time
        self._still = False
        self._rate_hz = 0.0
        self._watchers: dict[int, int] = {}  # request -> page, the newest few
        self._served_s: dict[int, float] = {}  # page -> when its last request went out

    def due(self, now_s: float, *, virtual: bool, moves: bool = True) -> bool:
        """Whether a request should go out now. ``moves``: the view would be another than the last."""
        if self._waits(now_s):
            return False
        still, before = virtual and not moves, self._still
        moving_hz = self.config.virtual_rate_hz if virtual else self.config.real_rate_hz
        self._rate_hz = self.config.still_rate_hz if still else moving_hz
        at_once = virtual and before and not still
        fits = self._rate_hz > 0 and (at_once or now_s - self._due_s >= 1.0 / self._rate_hz - 0.001)
        if fits or at_once:
            self._still = still
        return fits

    def watcher(self, now_s: float, driver: Look, watchers: dict[int, Look]) -> int | None:
        """The page whose own view should be asked for now: of those that look elsewhere, the longest unserved."""
        rate, config = self._rate_hz, self.config
        if not (rate > 0 and config.watcher_rate_hz > 0) or self._waits(now_s):
            return None
        if now_s + self._takes_s > self._due_s + 1.0 / rate:
            return None  # the driver's next would wait
        self._served_s = {page: at for page, at in self._served_s.items() if page in watchers}
        last = {page: self._served_s.get(page, -math.inf) for page in watchers}
        waiting = [
            page
            for page, look in watchers.items()
            if look.apart(driver) > WATCHER_APART_RAD and now_s - last[page] >= 1.0 / config.watcher_rate_hz - 0.001
        ]
        return min(waiting, key=lambda page: last[page], default=None)

    def asked(self, now_s: float, watcher: int | None = None) -> int:
        """Notes a request made now, for the driver or a watching page; returns its id."""
        number = self._outstanding = self._next_id
        self._next_id = self._next_id % (2**32 - 1) + 1  # uint32 in ViewRequest; 0 stays unused
        self._asked_s = now_s
        if watcher is None:
            self._due_s = now_s
        else:
            self._served_s[watcher] = now_s
            self._watchers[number] = watcher
            while len(self._watchers) > 8:
                del self._watchers[next(iter(self._watchers))]
        return number

    def answered(self, request_id: int, now_s: float | None = None) -> bool:
        """Notes an answer; True when it is the one that was waited for."""
        if request_id != self._outstanding:
            return False
        self._outstanding = None
        if now_s is not None:
            self._takes_s = now_s - self._asked_s
        return True

    def page_of(self, request_id: int) -> int | None:
        """The watching page that a request was for; None: for the driver, and so for all."""
        return self._watchers.get(request_id)

    def _waits(self, now_s: float) -> bool:
        if self._outstanding is None:
            return False
        if now_s - self._asked_s < self.config.response_timeout_s:
            return True
        self.lost += 1
        self._outstanding = None
        return False
