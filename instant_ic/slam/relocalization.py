"""Search for the robot in a map other than the one being made: a saved map, or that of the session before.

While the robot is not located in that map, it maps in a frame of its own (a session). A search finds the session's
recent scans in the map (``localization``); the place that was found is recognized if the scans do not contradict the
map there. The map of a session before is not complete: the true place may be missing in it, and another one look like
it. A place far from where odometry says must therefore be found twice, from two places.
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
        max_contradiction: contradiction of the session with the map above which they are not joined; a right place has
            0.03.
        near_m: distance from odometry's place up to which one finding is enough, in metres.
        near_rad: the same for the heading, in radians.
        agree_m: distance up to which two findings agree, in metres.
        agree_rad: the same for the heading, in radians.
        confirm_after: way between two findings that confirm each other, metres plus radians.
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
        saved: the map.
        by_odometry: whether odometry says where in the map the session began: it is the map of the session before.

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
        """The map as cells, to compare scans with."""
        return OccupancyMap.of_grid(self.saved.grid)

    def lose(self, reach_m: float) -> None:
        """Note that the robot is lost in the map, by at most ``reach_m`` metres from where odometry says."""
        self.saved.located = False
        self.reach_m = self.config.near_m + reach_m
        self._found_before = None

    def recognized(self, recent: Sequence[ScanKeyframe], moved: FloatArray, here: FloatArray) -> bool:
        """Return whether a place that was found is the true one.

        Args:
            recent: the newest keyframes of the session.
            moved: pose (3,) of the session's frame in the map, by the place.
            here: pose (3,) of the scan that was found, in the session's frame.
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
