"""Time-outs: when a source counts as stale or lost."""

from __future__ import annotations

import math
import statistics
from collections import deque
from dataclasses import dataclass
from typing import Annotated, TypeAlias

from instant_ic.config.ranges import Checked, Plausible

_Timeout: TypeAlias = Annotated[float, Plausible(0.05, 2)]
"""At most 2 s: the robot must not drive on older data or commands."""
_ImageTimeout: TypeAlias = Annotated[float, Plausible(0.05, 10)]
"""Images may be older, because the robot then drives slower (``image_travel_m``)."""

IMAGES = ("camera", "view")
"""Sources that show the operator the robot's place."""
_LATE_SHARE = 0.25
"""Images may be late by this share of their period, if that is more than ``late_s``."""
_UNKNOWN_PERIOD_S = 0.5
"""Period assumed for images until their rate is known."""


@dataclass(frozen=True)
class TimeoutConfig(Checked):
    """Seconds of silence after which a source is stale and the command is zero.

    An image source (camera, view) has its own rate: it is stale ``late_s`` after its usual arrival, if that is later.
    Images may be up to ``slowest_image_s`` apart. The robot then drives slower, at most ``image_travel_m`` per image.
    All other sources keep the robot off obstacles and have fixed time-outs.

    Attributes:
        scan: s; ``/scan``.
        points: s; ``/lidar/points``.
        odometry: s; ``/wheel/odom``.
        pose: s; ``/pose``.
        camera: s; camera images, at the robot and at the operator's page.
        view: s; rendered views at the operator's page.
        vbot: s; ``/vbot/odom``.
        nav: s; ``/nav/cmd_vel``.
        command: s; ``/operator/cmd_vel``.
        estop_input: s; ``/robot/estop``, from a button that repeats its state; 0: the button reports only changes.
        vspace: s; ``/vspace/status``.
        late_s: seconds after its usual arrival at which an image counts as late.
        slowest_image_s: longest period of images in seconds at which the robot starts; an age of 2 s counts as a pause.
        image_travel_m: largest distance in metres driven before a missing image stops the robot; limits the speed at
            low image rates.
        stop_after_s: seconds of silence that lead to STOPPED.
        recover_s: seconds for which every source must be fresh before the robot drives on.
    """

    scan: _Timeout = 0.3
    points: _Timeout = 0.3
    odometry: _Timeout = 0.3
    pose: _Timeout = 0.3
    camera: _ImageTimeout = 0.3
    view: _ImageTimeout = 0.3
    vbot: _Timeout = 0.3
    nav: _Timeout = 0.3
    command: _Timeout = 0.3
    estop_input: Annotated[float, Plausible(0, 10)] = 0.0
    vspace: _ImageTimeout = 2.0
    late_s: Annotated[float, Plausible(0.01, 2)] = 0.1
    slowest_image_s: Annotated[float, Plausible(0.05, 1.5)] = 1.1
    image_travel_m: Annotated[float, Plausible(0.02, 2)] = 0.33
    stop_after_s: Annotated[float, Plausible(0.1, 10)] = 1.5
    recover_s: Annotated[float, Plausible(0.05, 10)] = 0.5

    def allowed_s(self, key: str, usual_s: float | None = None) -> float:
        """Return the allowed age of source ``key`` in seconds. ``usual_s`` is its usual age when a message arrives.

        >>> timeouts = TimeoutConfig()
        >>> [round(timeouts.allowed_s("camera", usual_s), 2) for usual_s in (0.1, 0.2, 0.33, 1.0, 2.0, math.inf)]
        [0.3, 0.3, 0.43, 1.25, 1.38, 0.62]
        """
        least = float(getattr(self, key))
        if usual_s is None:
            return least
        period_s = min(usual_s, self.slowest_image_s) if math.isfinite(usual_s) else _UNKNOWN_PERIOD_S
        return max(least, period_s + max(self.late_s, _LATE_SHARE * period_s))

    def lost_s(self, key: str, usual_s: float | None = None) -> float:
        """Return the seconds of silence after which source ``key`` counts as lost and the arbiter goes to STOPPED.

        A single missing image is never a loss.
        """
        return max(
            self.stop_after_s, 2.0 * self.allowed_s(key, usual_s) if key in IMAGES else self.allowed_s(key, usual_s)
        )


class Rhythm:
    """Usual age of a source when its next message arrives: its period, plus its delay if ages count from the stamp.

    The usual age is the larger of two medians, of the last ``_KEPT`` messages and of the last ``_NEWEST``: after two
    late images the robot drives slower, instead of stopping at each of the next ten.
    """

    _NEEDED, _KEPT, _NEWEST = 5, 20, 3

    def __init__(self) -> None:
        self._ages: deque[float] = deque(maxlen=self._KEPT)

    def heard(self, age_s: float) -> None:
        """Record the previous message's age when a new one arrives. Ages after a pause or clock change are ignored."""
        if 0.0 <= age_s < 2.0:
            self._ages.append(age_s)

    @property
    def usual_s(self) -> float:
        """Usual age in seconds; inf until ``_NEEDED`` messages have arrived."""
        ages = list(self._ages)
        if len(ages) < self._NEEDED:
            return math.inf
        return max(statistics.median(ages), statistics.median(ages[-self._NEWEST :]))
