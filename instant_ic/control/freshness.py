"""How long a source may be silent before it counts as lost."""

from __future__ import annotations

import math
import statistics
from collections import deque
from dataclasses import dataclass
from typing import Annotated, TypeAlias

from ..ranges import Range, check_ranges

_Timeout: TypeAlias = Annotated[float, Range(above=0, high=10)]
"""Longer than this is no time-out: a robot must not drive on what it saw or was told so long ago."""


@dataclass(frozen=True)
class TimeoutConfig:
    """Seconds of silence after which a source is stale and the command is zero.

    A source that comes at a rate of its own (camera, view) is stale ``late_s`` after it usually comes, where that is
    later; a source slower than ``slowest_s`` is stale between any two messages.

    Attributes:
        scan: s; ``/scan``.
        points: s; ``/lidar/points``.
        odometry: s; ``/wheel/odom``.
        pose: s; ``/pose``.
        camera: s; camera pictures, here and at the operator's page.
        view: s; rendered views at the operator's page.
        vbot: s; ``/vbot/odom``.
        nav: s; ``/nav/cmd_vel``.
        command: s; ``/operator/cmd_vel``.
        estop_input: s; ``/robot/estop``, from a button that repeats its state; 0: it speaks only on a change.
        vspace: s; ``/vspace/status``.
        late_s: s after a source is usually there that make it late.
        slowest_s: s between two messages of a source beyond which its own rate no longer counts.
        stop_after_s: s of silence that lead to STOPPED.
        recover_s: s for which everything must be fresh before driving on.
    """

    scan: _Timeout = 0.3
    points: _Timeout = 0.3
    odometry: _Timeout = 0.3
    pose: _Timeout = 0.3
    camera: _Timeout = 0.3
    view: _Timeout = 0.3
    vbot: _Timeout = 0.3
    nav: _Timeout = 0.3
    command: _Timeout = 0.3
    estop_input: Annotated[float, Range(0, 10)] = 0.0
    vspace: _Timeout = 2.0
    late_s: _Timeout = 0.1
    slowest_s: _Timeout = 0.5
    stop_after_s: _Timeout = 1.5
    recover_s: _Timeout = 0.5

    def __post_init__(self) -> None:
        check_ranges(self)

    def allowed_s(self, key: str, usual_s: float | None = None) -> float:
        """Seconds that source ``key`` may be silent, which usually is ``usual_s`` old when the next message comes.

        >>> timeouts = TimeoutConfig()
        >>> [round(timeouts.allowed_s("camera", usual_s), 2) for usual_s in (0.1, 0.2, 0.33, 2.0)]
        [0.3, 0.3, 0.43, 0.6]
        """
        least = float(getattr(self, key))
        return least if usual_s is None else max(least, min(usual_s, self.slowest_s) + self.late_s)


class Rhythm:
    """How old a source usually is when its next message comes: its period, and its delay where age is since the stamp.

    The median of the last messages. Before ``_NEEDED`` have come it is not known: inf.
    """

    _NEEDED, _KEPT = 5, 20

    def __init__(self) -> None:
        self._ages: deque[float] = deque(maxlen=self._KEPT)

    def heard(self, age_s: float) -> None:
        """A message came, when the one before had this age. A pause or a clock that was set tells nothing."""
        if 0.0 <= age_s < 2.0:
            self._ages.append(age_s)

    @property
    def usual_s(self) -> float:
        """Seconds; inf while unknown."""
        return statistics.median(self._ages) if len(self._ages) >= self._NEEDED else math.inf
