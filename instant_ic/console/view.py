"""Look direction of the operator, and scheduling of requests for rendered views."""

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
"""Smallest angle from the driver's look at which a watcher gets views of his own."""
ELSEWHERE_M = 1.0
"""A view rendered farther away shows another place; the page does not move it to the v-bot."""


@dataclass(frozen=True)
class ViewConfig:
    """Requests for rendered views.

    Attributes:
        width: width * height is the number of pixels of a rendered view; its shape follows the driver's window.
        height: see width.
        fov_margin: requested over shown field of view; larger: more room to re-aim, coarser pixels.
        virtual_rate_hz: requests a second in the virtual space (one outstanding at a time).
        still_rate_hz: requests a second in the virtual space while nothing moves, which leaves the renderer free.
        watcher_rate_hz: requests a second for each page that looks elsewhere than the driver's, if time is left; 0 =
            none.
        real_rate_hz: requests a second while the camera is shown, to keep the renderer warm; 0 = none.
        response_timeout_s: an unanswered request counts as lost after this time.
    """

    width: Annotated[int, Range(16, 4096)] = 320  # times height: pixels of a view; its shape is the window's
    height: Annotated[int, Range(16, 4096)] = 180
    fov_margin: Annotated[float, Range(1, 2)] = 1.15  # requested over shown field of view: room to re-aim
    virtual_rate_hz: Positive = 10.0  # while the virtual space is shown
    still_rate_hz: Positive = 5.0  # while nothing moves there, so that the renderer is free when motion starts
    watcher_rate_hz: NotNegative = 2.0  # for a page that looks elsewhere than the driver's, if time is left; 0 = none
    real_rate_hz: NotNegative = 1.0  # while the camera is shown, to keep the renderer warm; 0 = none
    response_timeout_s: Positive = 0.5  # an unanswered request counts as lost after this time

    def __post_init__(self) -> None:
        check_ranges(self)


@dataclass(frozen=True)
class LeadConfig:
    """Showing rendered views from the v-bot's present position (``geometry.depth_picture``).

    Attributes:
        max_m: largest distance from the rendered position; 0 = views are not moved.
        seconds: time of the transition after a switch, and back before the return; 0 = at once.
    """

    max_m: NotNegative = 0.3  # largest distance from the rendered position; 0: views are not moved
    seconds: NotNegative = 0.8  # time of the transition after a switch, and back before the return

    def __post_init__(self) -> None:
        check_ranges(self)


@dataclass(frozen=True)
class Look:
    """Look direction relative to the robot's heading, and the shown field of view, in radians.

    Yaw is positive to the left (counter-clockwise), pitch is positive upwards.
    """

    yaw: float = 0.0
    pitch: float = 0.0
    hfov: float = math.radians(90)
    vfov: float = math.radians(58.7)

    def rotation(self) -> NDArray[np.float64]:
        """Return camera_from_look (4, 4): x along the line of sight, y left, z up."""
        # In x-forward, y-left axes a positive turn about y lowers the line of sight.
        return pose_matrix(0.0, 0.0, 0.0, 0.0, -self.pitch, self.yaw)

    def apart(self, other: Look) -> float:
        """Return the angle between the two lines of sight, rad."""
        cosine = float(self.rotation()[:3, 0] @ other.rotation()[:3, 0])
        return math.acos(min(max(cosine, -1.0), 1.0))


@dataclass(frozen=True)
class ViewShape:
    """Horizontal field of view (rad) and size (pixels) of a requested view."""

    fov_rad: float
    width: int
    height: int


def view_shape(look: Look, config: ViewConfig) -> ViewShape:
    """Return the shape of a view that covers ``look`` with the margin, in the window's aspect ratio.

    The number of pixels follows the configuration for any window shape, because it determines the render time.
    Width and height are multiples of 8.
    """
    half_width = math.tan(min(look.hfov * config.fov_margin, MAX_FOV_RAD) / 2)
    half_height = math.tan(min(look.vfov * config.fov_margin, MAX_FOV_RAD) / 2)
    aspect = min(max(half_width / half_height, 0.5), 2.5)
    pixels = config.width * config.height
    width = max(16, 8 * round(math.sqrt(pixels * aspect) / 8))
    height = max(16, 8 * round(math.sqrt(pixels / aspect) / 8))
    # If the aspect ratio was clamped or rounded, the larger field of view wins.
    fov = 2 * math.atan(max(half_width, half_height * width / height))
    return ViewShape(fov, width, height)


class Lead:
    """Share of the way from a view's rendered position to the v-bot's present position at which the page shows it.

    0 at a switch: every image is shown from where it was made, so that nothing jumps. 1 while the v-bot drives.
    """

    def __init__(self, config: LeadConfig) -> None:
        self.config = config
        self.share = 0.0
        self._at_s: float | None = None

    def step(self, now_s: float, driven: bool) -> float:
        """Advance to ``now_s`` (steady clock) and return the share; ``driven``: the operator drives the v-bot."""
        passed_s = 0.0 if self._at_s is None else now_s - self._at_s
        self._at_s = now_s
        step = passed_s / self.config.seconds if self.config.seconds > 0 else 1.0
        self.share = min(self.share + step, 1.0) if driven else max(self.share - step, 0.0)
        return self.share

    def displayed(self, place: NDArray[np.float64], now: NDArray[np.float64]) -> NDArray[np.float64]:
        """Return the position from which the page shows a view, (N,) m.

        Args:
            place: camera position for which the view was rendered, (N,) m.
            now: present position of the v-bot's camera, (N,) m.
        """
        way = now - place
        far = float(np.linalg.norm(way))
        if far > ELSEWHERE_M or far == 0.0:
            return place
        shown: NDArray[np.float64] = place + min(self.share, self.config.max_m / far) * way
        return shown


class ViewScheduler:
    """Schedules view requests: one outstanding at a time, the next after the answer or time-out, at the mode's rate.

    The first motion after a rest is requested at once, because the operator waits for it. Watchers' views are
    requested between the driver's views, if they do not delay his next one.
    """

    def __init__(self, config: ViewConfig) -> None:
        self.config = config
        self.lost = 0
        self._next_id = 1
        self._outstanding: int | None = None
        self._asked_s = -math.inf  # time of the last request
        self._due_s = -math.inf  # time of the driver's last request
        self._takes_s = 0.0  # duration of the last request
        self._still = False
        self._rate_hz = 0.0
        self._watchers: dict[int, int] = {}  # recent requests: id -> page
        self._served_s: dict[int, float] = {}  # page -> time of its last request

    def due(self, now_s: float, *, virtual: bool, moves: bool = True) -> bool:
        """Whether to send a request now. ``moves``: the view would differ from the last one."""
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
        """Return the page whose own view is due: the one unserved for longest among those that look elsewhere."""
        rate, config = self._rate_hz, self.config
        if not (rate > 0 and config.watcher_rate_hz > 0) or self._waits(now_s):
            return None
        if now_s + self._takes_s > self._due_s + 1.0 / rate:
            return None  # it would delay the driver's next view
        self._served_s = {page: at for page, at in self._served_s.items() if page in watchers}
        last = {page: self._served_s.get(page, -math.inf) for page in watchers}
        waiting = [
            page
            for page, look in watchers.items()
            if look.apart(driver) > WATCHER_APART_RAD and now_s - last[page] >= 1.0 / config.watcher_rate_hz - 0.001
        ]
        return min(waiting, key=lambda page: last[page], default=None)

    def asked(self, now_s: float, watcher: int | None = None) -> int:
        """Record a request for the driver or a watching page, and return its id."""
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
        """Record an answer; return whether it answers the outstanding request."""
        if request_id != self._outstanding:
            return False
        self._outstanding = None
        if now_s is not None:
            self._takes_s = now_s - self._asked_s
        return True

    def page_of(self, request_id: int) -> int | None:
        """Return the watching page of a request; None if it was for the driver, whose view goes to all pages."""
        return self._watchers.get(request_id)

    def _waits(self, now_s: float) -> bool:
        if self._outstanding is None:
            return False
        if now_s - self._asked_s < self.config.response_timeout_s:
            return True
        self.lost += 1
        self._outstanding = None
        return False
