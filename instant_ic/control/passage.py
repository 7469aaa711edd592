"""Check of a switch to the v-bot: space behind the obstacle, and a way round it for the r-bot."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from instant_ic.config.ranges import Checked, NotNegative
from instant_ic.control.costmap import Costmap
from instant_ic.control.planner import HybridPlanner, Plan
from instant_ic.control.prediction import Prediction
from instant_ic.control.reasons import Notice
from instant_ic.control.states import Reason
from instant_ic.control.subgoal import WALL_CLEARANCE_M, behind_obstacle, extend_ahead
from instant_ic.control.walls import WallMap


@dataclass(frozen=True)
class PassageConfig(Checked):
    """Limits on the obstacle's depth and on the length of the detour.

    Attributes:
        max_pass_m: m; free space must begin within this distance behind the obstacle, for a switch to the v-bot and for
            a subgoal.
        max_detour_m: m; largest additional length of the way round, compared with the straight line.
    """

    max_pass_m: NotNegative = 3.0
    max_detour_m: NotNegative = 4.0


def find_passage(
    costmap: Costmap,
    prediction: Prediction,
    forward: bool,
    walls: WallMap | None,
    planner: HybridPlanner,
    config: PassageConfig,
) -> Notice | None:
    """Return why the r-bot cannot get behind the obstacle ahead; None if it can.

    The search starts where the predicted trajectory meets the obstacle and goes straight on. The first place behind it
    that is free, or not seen yet, must come before any wall. The planned path to that place may be at most
    ``max_detour_m`` longer than the straight line.
    """
    if prediction.hit_index is None:
        return None
    hit = prediction.poses[prediction.hit_index]
    heading = hit if forward else hit + np.array([0.0, 0.0, math.pi])
    ahead = extend_ahead(heading, config.max_pass_m, costmap.resolution)
    free = behind_obstacle(costmap, ahead)
    exit_index = int(np.flatnonzero(free)[0]) if free.any() else len(ahead)
    if walls is not None:
        at_wall = np.flatnonzero(walls.distance(ahead[:exit_index, :2]) < WALL_CLEARANCE_M)
        if at_wall.size:
            return Notice(Reason.WALL_AHEAD, "A wall is in the way. Drive round it.")
    if exit_index == len(ahead):
        text = f"There is no free space within {config.max_pass_m:.1f} m behind it. Drive another way."
        return Notice(Reason.NO_SPACE_BEHIND, text)
    goal = ahead[exit_index]
    start = prediction.poses[0]
    plan = planner.plan(costmap, start, goal)
    straight = float(np.linalg.norm(goal[:2] - start[:2]))
    if plan.whole_length_m > straight + config.max_detour_m:
        text = f"There is no way round it ({_why(plan, straight, config)}). Drive another way."
        return Notice(Reason.NO_WAY_ROUND, text)
    return None


def _why(plan: Plan, straight_m: float, config: PassageConfig) -> str:
    if math.isfinite(plan.whole_length_m):
        return f"{plan.whole_length_m - straight_m:.1f} m longer than straight on, {config.max_detour_m:.1f} m allowed"
    return plan.reason or "none found"
