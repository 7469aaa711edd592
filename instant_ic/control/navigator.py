"""Brings the r-bot to a subgoal: plans on each new costmap, follows at the controller's rate."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from .costmap import Costmap
from .follower import FollowerCommand, PathFollower
from .planner import GridPlanner, Plan

_NO_PLAN = Plan(np.zeros((0, 3)), False, "no plan yet", math.inf)


@dataclass(frozen=True)
class NavigatorStep:
    """What to send, and the plan it rests on."""

    command: tuple[float, float]
    state: str
    plan: Plan
    replanned: bool


class Navigator:
    """Planner and follower behind one call."""

    def __init__(self, planner: GridPlanner, follower: PathFollower, replan_period_s: float = 0.2) -> None:
        self.planner = planner
        self.follower = follower
        self.replan_period_s = replan_period_s
        self.reset()

    def reset(self) -> None:
        """Forgets plan and follower's state."""
        self.follower.reset()
        self._plan = _NO_PLAN
        self._planned_ns: int | None = None

    def step(
        self,
        pose: NDArray[np.float64],
        speed_m_s: float,
        subgoal: NDArray[np.float64],
        costmap: Costmap,
        now_ns: int,
        subgoal_velocity: tuple[float, float] = (0.0, 0.0),
    ) -> NavigatorStep:
        """Twist towards ``subgoal`` (x, y, yaw) from ``pose``, both in the costmap's frame."""
        due = self._planned_ns is None or now_ns - self._planned_ns >= self.replan_period_s * 1e9
        if due:
            self._plan = self.planner.plan(costmap, pose, subgoal)
            self._planned_ns = now_ns
        plan = _with_end(self._plan, subgoal)
        step: FollowerCommand = self.follower.step(pose, speed_m_s, plan, subgoal_velocity)
        return NavigatorStep(step.command, step.state, plan, due)


def _with_end(plan: Plan, subgoal: NDArray[np.float64]) -> Plan:
    """The plan with its end where the subgoal is by now: it moves between two plans."""
    if not plan.reached or float(np.linalg.norm(plan.poses[-1, :2] - subgoal[:2])) > 0.3:
        return plan
    return Plan(np.concatenate([plan.poses[:-1], subgoal[None]]), True, plan.reason, plan.whole_length_m)
