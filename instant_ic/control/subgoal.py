"""Subgoal of the r-bot while the operator drives the v-bot (paper, III.A)."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from instant_ic.control.costmap import UNKNOWN, Costmap
from instant_ic.control.prediction import Prediction
from instant_ic.control.walls import WallMap

MAX_COST = 150
"""Highest cost of a free place; a place 0.42 m from obstacles has it."""
WALL_CLEARANCE_M = 0.25
"""A search straight ahead ends where the line comes nearer to a wall than this."""
_SEARCH_RADIUS_M = 1.5
"""Radius of the search round the v-bot if nothing is free straight ahead."""


@dataclass(frozen=True)
class Subgoal:
    """Pose (x, y, yaw) for the r-bot, and the rule that chose it."""

    pose: NDArray[np.float64]
    rule: str
    """``vbot``, ``trajectory``, ``ahead`` or ``around``."""


def extend_ahead(pose: NDArray[np.float64], length_m: float, step_m: float) -> NDArray[np.float64]:
    """Return the poses (N, 3) straight ahead of ``pose``, ``step_m`` apart, without ``pose`` itself."""
    distance = step_m * np.arange(1, math.floor(length_m / step_m) + 1)
    direction = np.array([math.cos(pose[2]), math.sin(pose[2])])
    ahead = np.asarray(pose)[:2] + distance[:, None] * direction
    return np.concatenate([ahead, np.full((len(ahead), 1), pose[2])], axis=1)


_UNSEEN_DEPTH_M = 0.6
"""Unseen space behind an obstacle's near side counts as part of the obstacle up to this depth."""


def behind_obstacle(costmap: Costmap, ahead: NDArray[np.float64]) -> NDArray[np.bool_]:
    """Mark the poses (N, 3) straight ahead, one cell apart, that lie behind the first obstacle on the line.

    Free space before the obstacle does not count. Without an obstacle every free place counts.
    """
    costs = costmap.cost_at(ahead[:, :2])
    unseen = (costs == UNKNOWN) & costmap.contains(ahead[:, :2])
    taken = (costs > MAX_COST) & ~unseen
    if not taken.any():
        return ~taken
    index = np.arange(len(ahead))
    behind_m = (index - np.maximum.accumulate(np.where(taken, index, -1))) * costmap.resolution
    free: NDArray[np.bool_] = ~taken & (~unseen | (behind_m >= _UNSEEN_DEPTH_M))
    free[: int(np.argmax(taken))] = False
    return free


def _free(costmap: Costmap, points: NDArray[np.float64]) -> NDArray[np.bool_]:
    """Mark the points (..., 2) that may be the subgoal."""
    costs = costmap.cost_at(points)
    # The place behind an obstacle has not been seen yet, so unknown cells may be a goal. The planner stops before them
    # and goes on when the robot sees more.
    return (costs <= MAX_COST) | ((costs == UNKNOWN) & costmap.contains(points))


def choose_subgoal(
    costmap: Costmap,
    vbot_pose: NDArray[np.float64],
    prediction: Prediction,
    forward: bool,
    walls: WallMap | None,
    extend_m: float,
) -> Subgoal | None:
    """Return the subgoal for the v-bot's pose (3,) and its predicted trajectory.

    It is the first of these that exists: the v-bot's pose if free; the farthest free point of the trajectory; the first
    free point straight ahead of its end, within ``extend_m`` and before any wall; the free cell nearest to the v-bot.
    If a free v-bot is about to pass an obstacle, the r-bot is already sent behind the obstacle, so that it does not
    first follow up to it and turn there.
    """
    vbot_pose = np.asarray(vbot_pose, dtype=np.float64)
    if _free(costmap, vbot_pose[:2]):
        if prediction.hit_index is not None:
            behind = _straight_on(costmap, prediction.poses[prediction.hit_index], forward, walls, extend_m)
            if behind is not None:
                return Subgoal(behind, "ahead")
        return Subgoal(vbot_pose, "vbot")
    trajectory = prediction.poses
    free = np.flatnonzero(_free(costmap, trajectory[:, :2]))
    if free.size:
        return Subgoal(trajectory[free[-1]], "trajectory")
    beyond = _straight_on(costmap, trajectory[-1], forward, walls, extend_m)
    if beyond is not None:
        return Subgoal(beyond, "ahead")
    rows, columns = np.nonzero(costmap.costs <= MAX_COST)
    if rows.size == 0:
        return None
    centres = costmap.centres(rows, columns)
    distance = np.linalg.norm(centres - vbot_pose[:2], axis=1)
    nearest = int(np.argmin(distance))
    if distance[nearest] > _SEARCH_RADIUS_M:
        return None
    return Subgoal(np.array([*centres[nearest], vbot_pose[2]]), "around")


def _straight_on(
    costmap: Costmap, pose: NDArray[np.float64], forward: bool, walls: WallMap | None, length_m: float
) -> NDArray[np.float64] | None:
    """Return the first free pose (3,) behind the obstacle ahead of ``pose``; None when a wall comes first."""
    heading = pose if forward else pose + np.array([0.0, 0.0, math.pi])
    ahead = extend_ahead(heading, length_m, costmap.resolution)
    index = np.flatnonzero(behind_obstacle(costmap, ahead))
    if index.size == 0:
        return None
    first = int(index[0])
    if walls is not None and (walls.distance(ahead[: first + 1, :2]) < WALL_CLEARANCE_M).any():
        return None
    return np.array([*ahead[first, :2], pose[2]])
