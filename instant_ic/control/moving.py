"""People and other moving things, as points with a velocity.

A tall thing counts as moving when its points lie in space that the LiDAR saw free shortly before, and when it keeps
moving as one body. Only its height matters, not its shape. Low and hanging things are left out: they come into view
and vanish as the robot drives, so their edges seem to move.
"""

from __future__ import annotations

import math
from collections import deque
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from instant_ic.control.heights import AZIMUTHS, SortedPoints

MOST_SPEED_M_S = 2.0
"""Highest speed of a person in a building."""
_LEAST_SPEED_M_S = 0.2
_RANGE_M = 4.0
_COMPARED_S = (0.3, 0.8)
"""Ages of the sweeps with which a new one is compared, in seconds."""
_KEPT_S = 0.8
"""Time in seconds for which a body that is out of sight (in the LiDAR's blind zone) is extrapolated."""
_MARGIN_M = 0.15
_BODY_M = 0.35
"""Points nearer than this to a body's centre belong to it."""
_LEAST_POINTS = 3
_TALL_ROWS = 6
"""Smallest number of elevations at which beams must hit a body."""


@dataclass(frozen=True)
class MovingPoints:
    """Points (N, 2) in metres and their velocities (N, 2) in m/s."""

    points: NDArray[np.float64]
    velocities: NDArray[np.float64]


NOTHING_MOVES = MovingPoints(np.zeros((0, 2)), np.zeros((0, 2)))


@dataclass(frozen=True)
class _Look:
    """The nearest thing in each horizontal direction of one sweep."""

    time_s: float
    origin: NDArray[np.float64]
    ranges: NDArray[np.float64]
    """(AZIMUTHS,) metres; inf where no beam returned."""
    tall: NDArray[np.bool_]
    """(AZIMUTHS,) true where beams of enough elevations end at this range."""

    def points(self) -> NDArray[np.float64]:
        """Return the points (M, 2) of tall things within ``_RANGE_M``, ordered by azimuth."""
        index = np.flatnonzero(self.tall & (self.ranges < _RANGE_M))
        angle = (index + 0.5) * (2 * math.pi / AZIMUTHS) - math.pi
        return self.origin + self.ranges[index, None] * np.stack([np.cos(angle), np.sin(angle)], axis=1)

    def free_at(self, points: NDArray[np.float64]) -> NDArray[np.bool_]:
        """Return the mask (M,) of the points (M, 2) that all beams beside them passed by a good margin."""
        away = points - self.origin
        column = np.floor((np.arctan2(away[:, 1], away[:, 0]) + math.pi) * (AZIMUTHS / (2 * math.pi))).astype(np.int64)
        around = self.ranges[(column[:, None] + np.arange(-2, 3)) % AZIMUTHS].min(axis=1)
        free: NDArray[np.bool_] = around > np.linalg.norm(away, axis=1) + _MARGIN_M
        return free


@dataclass
class _MovingBody:
    points: NDArray[np.float64]
    places: deque[tuple[float, NDArray[np.float64]]] = field(default_factory=lambda: deque(maxlen=8))
    """Times and centres (2,), newest last."""

    @property
    def velocity(self) -> NDArray[np.float64]:
        """Velocity over the last half second in m/s, (2,); zero while unknown."""
        (end_s, end), (start_s, start) = self.places[-1], self.places[0]
        for time_s, place in self.places:
            if end_s - time_s <= 0.6:
                start_s, start = time_s, place
                break
        return (end - start) / (end_s - start_s) if end_s - start_s >= 0.15 else np.zeros(2)

    @property
    def stands(self) -> bool:
        """True if the body has not moved since it was found: a thing, or a person who has stopped."""
        return len(self.places) >= 6 and float(np.hypot(*self.velocity)) < 0.5 * _LEAST_SPEED_M_S

    def at(self, time_s: float) -> NDArray[np.float64]:
        """Return the centre (2,) expected at a time."""
        return self.places[-1][1] + self.velocity * (time_s - self.places[-1][0])


class MovingThings:
    """A tracker of moving bodies from sweep to sweep, in a frame that does not jump (``odom``)."""

    def __init__(self) -> None:
        self._looks: deque[_Look] = deque()
        self._bodies: list[_MovingBody] = []

    def update(self, sweep: SortedPoints, time_s: float) -> None:
        """Add a sweep of 3D points, measured at ``time_s`` (seconds, steady); an earlier time restarts the tracks."""
        if self._looks and not 0.0 <= time_s - self._looks[-1].time_s <= _COMPARED_S[1]:
            self._looks.clear()
            self._bodies = []
        elif self._looks and time_s == self._looks[-1].time_s:
            return
        look = _look(sweep, time_s)
        while self._looks and time_s - self._looks[0].time_s > _COMPARED_S[1]:
            self._looks.popleft()
        points = look.points()
        fresh = np.zeros(len(points), dtype=bool)
        for old in self._looks:
            if time_s - old.time_s >= _COMPARED_S[0]:
                fresh |= old.free_at(points)
        self._looks.append(look)
        self._bodies = [b for b in self._bodies if time_s - b.places[-1][0] <= _KEPT_S and not b.stands]
        followed = [self._follow(body, points, time_s) for body in self._bodies]
        taken = np.logical_or.reduce([np.zeros(len(points), dtype=bool), *followed])
        for group in _groups(points[fresh & ~taken]):
            body = points[np.linalg.norm(points - group.mean(axis=0), axis=1) < _BODY_M]
            self._bodies.append(_MovingBody(body, deque([(time_s, _middle(body))], maxlen=8)))

    def _follow(self, body: _MovingBody, points: NDArray[np.float64], time_s: float) -> NDArray[np.bool_]:
        """Update a body from the newest sweep; return the mask (M,) of its points."""
        mine: NDArray[np.bool_] = np.linalg.norm(points - body.at(time_s), axis=1) < _BODY_M
        if mine.sum() >= _LEAST_POINTS:
            body.points = points[mine]
            body.places.append((time_s, _middle(points[mine])))
        return mine

    def moving(self, time_s: float) -> MovingPoints:
        """Return the points of all moving bodies, extrapolated to ``time_s``."""
        parts = []
        for body in self._bodies:
            velocity = body.velocity
            if _LEAST_SPEED_M_S <= float(np.hypot(*velocity)) <= MOST_SPEED_M_S:
                on = velocity * min(max(time_s - body.places[-1][0], 0.0), _KEPT_S)
                parts.append((body.points + on, np.tile(velocity, (len(body.points), 1))))
        if not parts:
            return NOTHING_MOVES
        return MovingPoints(np.concatenate([p for p, _ in parts]), np.concatenate([v for _, v in parts]))


def _look(sweep: SortedPoints, time_s: float) -> _Look:
    origin = sweep.origin[:2]
    away = sweep.nearest - origin
    column = np.floor((np.arctan2(away[:, 1], away[:, 0]) + math.pi) * (AZIMUTHS / (2 * math.pi))).astype(np.int64)
    ranges = np.full(AZIMUTHS, np.inf)
    np.minimum.at(ranges, column % AZIMUTHS, np.linalg.norm(away, axis=1))
    tall = ((sweep.ends > ranges - _MARGIN_M) & (sweep.ends < ranges + _MARGIN_M)).sum(axis=0) >= _TALL_ROWS
    return _Look(time_s, origin, ranges, tall)


def _middle(points: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return the centre (2,) of the box round points."""
    middle: NDArray[np.float64] = 0.5 * (points.min(axis=0) + points.max(axis=0))
    return middle


def _groups(points: NDArray[np.float64]) -> list[NDArray[np.float64]]:
    """Split points, ordered by azimuth, at gaps over ``_MARGIN_M``; return groups of ``_LEAST_POINTS`` or more."""
    gaps = np.flatnonzero(np.linalg.norm(np.diff(points, axis=0), axis=1) > _MARGIN_M) + 1
    return [group for group in np.split(points, gaps) if len(group) >= _LEAST_POINTS]
