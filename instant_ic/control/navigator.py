"""Navigator of the r-bot to a subgoal: it plans on each new costmap and follows at the controller's rate."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from instant_ic.control.costmap import Costmap
from instant_ic.control.follower import FollowerCommand, PathFollower
from instant_ic.control.kinematics import move
from instant_ic.control.planner import TOLERANCE_M, HybridPlanner, Plan, no_plan
from instant_ic.control.progress import Progress
from instant_ic.control.snapshot import Twist2
from instant_ic.geometry.poses import relative2

_STUCK_AFTER_NS = 1_500_000_000
"""Time for which the robot is commanded to move and does not, before it backs off."""
_RECOVERY_NS = 1_500_000_000
"""Duration of backing off."""
_RECOVERY_M_S = 0.15
"""Speed of backing off: first backwards, the next time forwards."""
_MOVED_M, _TURNED_RAD = 0.03, 0.05
"""The robot counts as moving when it exceeds either limit."""
_GIVE_UP_AFTER_S = 8.0
"""Time without progress towards a standing goal, after which the robot stops and reports that there is no way."""
_KEEP_PLAN_NS = 3_000_000_000
"""Time for which the last path to the goal is kept, while it is free, if no new path is found."""
_NO_PLAN = no_plan("no plan yet")


@dataclass(frozen=True)
class NavigatorStep:
    """The command and the plan it is based on."""

    command: tuple[float, float]
    state: str
    plan: Plan
    replanned: bool


class Navigator:
    """Planner and follower behind one call, with a recovery when the collision monitor blocks the robot.

    A robot that is commanded to move and does not (because a corner would touch when it turns, for example) backs off a
    little and plans again; the next time it moves forwards. The collision monitor also checks these commands.

    In a passage hardly wider than the robot, noise opens and closes the way from one plan to the next. If no new path
    is found, the last path to the goal is therefore kept for ``_KEEP_PLAN_NS`` while it is free.

    A robot that shuttles between ways that turn out to be closed stops, and tries again when a way stays open.
    """

    def __init__(self, planner: HybridPlanner, follower: PathFollower, replan_period_s: float = 0.2) -> None:
        self.planner = planner
        self.follower = follower
        self.replan_period_s = replan_period_s
        self._progress = Progress(_GIVE_UP_AFTER_S)
        self._lost = False
        self._body = planner.footprint.points(0.045)
        self.reset()

    def reset(self) -> None:
        """Forget the plan and the follower's state."""
        self.follower.reset()
        self._progress.reset()
        self._lost = False
        self._plan = _NO_PLAN
        self._planned_ns: int | None = None
        self._found_ns: int | None = None  # time of the last plan that reached the goal
        self._moved_ns: int | None = None  # last time at which the robot moved, or had no command to move
        self._moved_pose: NDArray[np.float64] = np.zeros(3)
        self._recovering_ns: int | None = None
        self._direction = -1.0

    def step(
        self,
        pose: NDArray[np.float64],
        speed_m_s: float,
        subgoal: NDArray[np.float64],
        costmap: Costmap,
        now_ns: int,
        subgoal_velocity: tuple[float, float] = (0.0, 0.0),
    ) -> NavigatorStep:
        """Return the twist from ``pose`` to ``subgoal`` (x, y, yaw) in the same frame; zero if any is not finite."""
        if not np.isfinite([*pose, speed_m_s, *subgoal, *subgoal_velocity]).all():
            unknown = replace(self._plan, reached=False, reason="the pose, the subgoal or a speed is not a number")
            return NavigatorStep((0.0, 0.0), "end", unknown, False)
        due = self._planned_ns is None or now_ns - self._planned_ns >= self.replan_period_s * 1e9
        if due:
            self._plan = self._planned(costmap, pose, subgoal, now_ns)
            self._planned_ns = now_ns
            self._lost = self._progress.lost(self._plan, pose, subgoal, now_ns)
        plan = _with_end(self._plan, subgoal)
        if self._lost:
            self._recovering_ns, self._moved_ns = None, now_ns
            self.follower.reset()
            why = self._plan.reason or "a way opens and closes"
            reason = f"no way found in {_GIVE_UP_AFTER_S:.0f} s: {why}"
            return NavigatorStep((0.0, 0.0), "no_way", replace(plan, reached=False, reason=reason), due)
        if self._recovering(pose, now_ns):
            return NavigatorStep((self._direction * _RECOVERY_M_S, 0.0), "recover", plan, due)
        step: FollowerCommand = self.follower.step(pose, speed_m_s, plan, subgoal_velocity, costmap)
        if step.command == (0.0, 0.0) and step.state != "blocked":
            self._moved_ns = now_ns
        return NavigatorStep(step.command, step.state, plan, due)

    def _planned(self, costmap: Costmap, pose: NDArray[np.float64], subgoal: NDArray[np.float64], now_ns: int) -> Plan:
        before = self._plan
        plan = self.planner.plan(costmap, pose, subgoal, before)
        if plan.reached:
            self._found_ns = now_ns
            return plan
        young = self._found_ns is not None and now_ns - self._found_ns <= _KEEP_PLAN_NS
        if not before.reached or not young:
            return plan
        if float(np.linalg.norm(before.poses[-1, :2] - subgoal[:2])) > TOLERANCE_M:
            return plan
        rest = int(np.argmin(np.linalg.norm(before.poses[:, :2] - pose[:2], axis=1)))
        overlap = costmap.lethal_overlap(np.concatenate([pose[None], before.poses[rest:]]), self._body)
        if (overlap > overlap[0]).any():
            return plan
        return replace(before, poses=before.poses[rest:], reverse=before.reverse[rest:])

    def _recovering(self, pose: NDArray[np.float64], now_ns: int) -> bool:
        if self._recovering_ns is not None:
            if now_ns - self._recovering_ns < _RECOVERY_NS:
                return True
            self._recovering_ns, self._moved_ns = None, None
            self._direction = -self._direction
            self.follower.reset()
        moved = float(np.linalg.norm(pose[:2] - self._moved_pose[:2])) > _MOVED_M
        turned = abs(math.remainder(float(pose[2] - self._moved_pose[2]), 2 * math.pi)) > _TURNED_RAD
        if self._moved_ns is None or moved or turned:
            self._moved_ns, self._moved_pose = now_ns, np.array(pose, dtype=np.float64)
        if now_ns - self._moved_ns < _STUCK_AFTER_NS:
            return False
        self._recovering_ns = now_ns
        return True


_MOST_AHEAD_M = 0.2
"""Largest distance for which a late camera is compensated."""


def meeting_pose(
    vbot_pose: NDArray[np.float64], shown_pose: NDArray[np.float64], robot_pose: NDArray[np.float64]
) -> NDArray[np.float64]:
    """Return the goal pose (3,) of the r-bot at which the delayed camera image shows the v-bot's place.

    The goal lies ahead of the v-bot by the distance between ``shown_pose``, where the image that arrives with the next
    view was taken, and the r-bot's present ``robot_pose``. At the goal no error remains to be eased.
    """
    ahead = float(relative2(shown_pose, robot_pose)[0])
    lead = min(max(ahead, -_MOST_AHEAD_M), _MOST_AHEAD_M) if math.isfinite(ahead) else 0.0
    return move(vbot_pose, lead, 0.0, 1.0)


_AT_VBOT_M = 0.15
"""A subgoal nearer to the v-bot than this is the v-bot itself."""


def moving_subgoal(
    subgoal: NDArray[np.float64],
    vbot: tuple[NDArray[np.float64], Twist2] | None,
    shown_pose: NDArray[np.float64],
    robot_pose: NDArray[np.float64],
) -> tuple[NDArray[np.float64], Twist2]:
    """Return the subgoal (3,) and its velocity; at the v-bot: `meeting_pose`, and the v-bot's own twist."""
    if vbot is None or float(np.linalg.norm(vbot[0][:2] - subgoal[:2])) >= _AT_VBOT_M:
        return subgoal, (0.0, 0.0)
    return meeting_pose(vbot[0], shown_pose, robot_pose), vbot[1]


def _with_end(plan: Plan, subgoal: NDArray[np.float64]) -> Plan:
    """Return the plan with its last pose at the present subgoal, which may have moved since planning."""
    if not plan.reached or float(np.linalg.norm(plan.poses[-1, :2] - subgoal[:2])) > 0.3:
        return plan
    return replace(plan, poses=np.concatenate([plan.poses[:-1], subgoal[None]]))
