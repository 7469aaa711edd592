"""Baseline for illusory control: shared control that overrides the operator and drives around obstacles by itself."""

from __future__ import annotations

import math
from dataclasses import replace
from typing import TypeAlias

import numpy as np
from numpy.typing import NDArray

from instant_ic.control.arbiter import Arbiter, Decision
from instant_ic.control.arbiter_config import ArbiterConfig
from instant_ic.control.costmap import UNKNOWN, Costmap
from instant_ic.control.follower import FollowerConfig, PathFollower
from instant_ic.control.guards import MIN_SWITCH_SPEED_M_S, RETURN_SIDE_M
from instant_ic.control.navigator import Navigator
from instant_ic.control.planner import HybridPlanner, PlannerConfig
from instant_ic.control.prediction import Prediction
from instant_ic.control.snapshot import ArbiterInputs
from instant_ic.control.states import Mode, Reason
from instant_ic.control.subgoal import MAX_COST, extend_ahead
from instant_ic.geometry.poses import wrap_angle

FloatArray: TypeAlias = NDArray[np.float64]

BEHIND_M = 0.3
"""Distance of the goal behind the first free position, so that the whole body has passed the obstacle."""
ARRIVED_M, ALIGNED_RAD = 0.15, math.radians(15.0)


class SharedControl(Arbiter):
    """Arbiter without a virtual space: where its prediction meets an obstacle, planner and follower take over.

    The goal is the first free position straight behind the obstacle in the commanded direction. The r-bot gets there as
    in illusory control, with the same costmap, planner, follower and collision monitor. Meanwhile the operator's
    command is ignored, with two exceptions: releasing the controls stops the robot, and driving back returns control to
    the operator. Control also returns when the goal is reached or the commanded path is free again.
    """

    def __init__(self, config: ArbiterConfig | None = None) -> None:
        super().__init__(config)
        follower = PathFollower(FollowerConfig(), self.config.limits, self.config.footprint)
        self.navigator = Navigator(HybridPlanner(PlannerConfig(), self.config.footprint), follower)
        self.goal: FloatArray | None = None
        self._speed_m_s = 0.0

    def step(self, inputs: ArbiterInputs, now_ns: int) -> Decision:
        """One step, as ``Arbiter.step``; ``command`` is the planner's command during a detour."""
        decision = super().step(inputs, now_ns)
        command, costmap, pose = decision.operator_command, inputs.costmap, inputs.robot_pose
        if decision.mode != Mode.REAL or costmap is None or pose is None or command[0] < 0.0:
            return self._given_back(decision)
        if decision.reason_code >= Reason.ESTOP:  # held: nothing may move, not even by the planner
            return decision
        if command == (0.0, 0.0):
            self._speed_m_s = 0.0
            return decision
        if self.goal is None:
            if not decision.blocked or command[0] < MIN_SWITCH_SPEED_M_S:
                return decision
            ahead = self.predictor.predict(pose, inputs.robot_velocity, command, costmap)
            self.goal = _behind(costmap, ahead, self.config.passage.max_pass_m)
            self.navigator.reset()
            if self.goal is None:
                return decision
        if self._done(inputs, pose, costmap, command):
            return self._given_back(decision)
        step = self.navigator.step(pose, self._speed_m_s, self.goal, costmap, now_ns)
        self._speed_m_s = step.command[0]
        sent = self.rules.monitored(step.command, inputs)
        return replace(
            decision,
            command=sent.command,
            hard=sent.action == "stop",
            blocked=False,
            reason="the robot goes round by itself",
            reason_code=Reason.DRIVE_ROBOT,
        )

    def _given_back(self, decision: Decision) -> Decision:
        self.goal, self._speed_m_s = None, 0.0
        return decision

    def _done(self, inputs: ArbiterInputs, pose: FloatArray, costmap: Costmap, command: tuple[float, float]) -> bool:
        assert self.goal is not None
        if abs(wrap_angle(float(pose[2] - self.goal[2]))) > ALIGNED_RAD:
            return False
        if float(np.linalg.norm(pose[:2] - self.goal[:2])) < ARRIVED_M:
            return True
        margin_m = self.config.switch.return_margin_m
        ahead = self.predictor.predict(pose, inputs.robot_velocity, command, costmap, margin_m, RETURN_SIDE_M)
        return ahead.hit_index is None


def _behind(costmap: Costmap, ahead: Prediction, reach_m: float) -> FloatArray | None:
    """Pose (3,) straight behind the predicted obstacle; None if no pose within ``reach_m`` is free."""
    if ahead.hit_index is None:
        return None
    line = extend_ahead(ahead.poses[ahead.hit_index], reach_m, costmap.resolution)
    costs = costmap.cost_at(line[:, :2])
    free = (costs <= MAX_COST) | (costs == UNKNOWN)
    taken = np.flatnonzero(~free)
    free[: taken[0] if taken.size else 0] = False
    found = np.flatnonzero(free)
    if found.size == 0:
        return None
    further = min(int(found[0]) + round(BEHIND_M / costmap.resolution), len(line) - 1)
    return np.asarray(line[further if free[further] else int(found[0])])
