"""Recognition of the robot's place in another map than the one being made: a saved map, or the previous session's.

While the robot is not located in that map, it maps in a frame of its own (a session). A search finds the session's
recent scans in the map (``localization``). The place is recognized if the scans do not contradict the map there. The
map of a previous session is incomplete: the true place may be missing, and another place may look like it. A place far
from odometry's must therefore be found twice, from two positions of the robot.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np

from instant_ic.geometry.poses import compose2, relative2
from instant_ic.slam.keyframes import ScanKeyframe
from instant_ic.slam.localization import SavedMap
from instant_ic.slam.occupancy import OccupancyMap
from instant_ic.slam.scan import FloatArray


@dataclass(frozen=True)
class RelocalizationConfig:
    """Tuning of the recognition of a place.

    Attributes:
        max_contradiction: largest mean contradiction of the recent scans at which session and map are joined; it is
            0.03 at the right place.
        near_m: distance from odometry's place up to which one finding is enough, in metres.
        near_rad: the same for the heading, in radians.
        agree_m: distance up to which two findings agree, in metres.
        agree_rad: the same for the heading, in radians.
        confirm_after: smallest way between two findings that confirm each other, metres plus radians.
    """

    max_contradiction: float = 0.1
    near_m: float = 1.5
    near_rad: float = 0.4
    agree_m: float = 0.3
    agree_rad: float = 0.1
    confirm_after: float = 1.0


class Relocalization:
    """Finds the robot in a map.

    Args:
        saved: map in which the robot is searched for.
        by_odometry: true if odometry gives the place in the map, because it is the map of the previous session.

    Attributes:
        reach_m: distance from odometry's place within which the robot is searched for, in metres.
    """

    def __init__(self, saved: SavedMap, by_odometry: bool = False) -> None:
        self.saved = saved
        self.by_odometry = by_odometry
        self.config = RelocalizationConfig()
        self.reach_m = math.inf
        self._found_before: tuple[FloatArray, FloatArray] | None = None

    @cached_property
    def cells(self) -> OccupancyMap:
        """The map as cells, for comparison with scans."""
        return OccupancyMap.of_grid(self.saved.grid)

    def lose(self, reach_m: float) -> None:
        """Start a search for a lost robot, which is at most ``reach_m`` metres from odometry's place."""
        self.saved.located = False
        self.reach_m = self.config.near_m + reach_m
        self._found_before = None

    def recognized(self, recent: Sequence[ScanKeyframe], moved: FloatArray, here: FloatArray) -> bool:
        """Return whether a place that was found is the true place.

        Args:
            recent: newest keyframes of the session.
            moved: pose of the session's frame in the map that follows from the place, (3,).
            here: pose of the found scan in the session's frame, (3,).
        """
        config = self.config
        shares = [self.cells.contradiction(compose2(moved, k.map_from_base), k.scan) for k in recent]
        if float(np.mean(shares)) > config.max_contradiction:
            return False
        step = relative2(here, compose2(moved, here))
        near = math.hypot(step[0], step[1]) < config.near_m and abs(step[2]) < config.near_rad
        if not self.by_odometry or near:
            return True
        before, self._found_before = self._found_before, (here, moved)
        if before is None:
            return False
        apart = relative2(compose2(before[1], here), compose2(moved, here))
        if math.hypot(apart[0], apart[1]) > config.agree_m or abs(apart[2]) > config.agree_rad:
            return False
        way = relative2(before[0], here)
        if math.hypot(way[0], way[1]) + abs(way[2]) >= config.confirm_after:
            return True
        self._found_before = before
        return False
