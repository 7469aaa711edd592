"""The operator of ``ic evaluate teleop``: a script that looks at its goals only."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import TYPE_CHECKING, TypeAlias

import numpy as np
from numpy.typing import NDArray

from instant_ic.experiments.teleop_worlds import route
from instant_ic.geometry.poses import relative2

if TYPE_CHECKING:
    from instant_ic.sim.contact import OccupancyMask

FloatArray: TypeAlias = NDArray[np.float64]
Twist2: TypeAlias = tuple[float, float]


@dataclass(frozen=True)
class OperatorConfig:
    """How the operator drives.

    Attributes:
        cruise_m_s, turn_rad_s: the console's full speed (config/console.yaml: drive).
        reached_m: distance at which a goal counts as reached, metres.
        notices_s: time without motion under a command after which the operator looks for the reason.
        backs_off_s, backs_off_m_s: time and speed of driving back before a detour.
        passed_m: distance from the blocked place at which a detour ends, metres.
        gives_up_after: number of detours at one place.
        spare_m: margin on every side of a detour, metres; the second is used if the first does not fit.
    """

    cruise_m_s: float = 0.4
    turn_rad_s: float = 0.8
    reached_m: float = 0.25
    notices_s: float = 1.5
    backs_off_s: float = 2.0
    backs_off_m_s: float = 0.2
    passed_m: float = 2.2
    gives_up_after: int = 4
    spare_m: tuple[float, float] = (0.10, 0.05)


@dataclass(frozen=True)
class Sight:
    """The operator's knowledge at one moment.

    Attributes:
        time_s: simulated time.
        pose: (3,) of the shown robot in the world's frame; the position is as old as the image.
        virtual: True while the rendered view is shown.
        stopped: True while the robot is stopped until the controls are released.
        speed: (m/s, rad/s) of the shown robot.
        robot: (3,) true pose of the r-bot, for planning a detour while the operator looks at it.
    """

    time_s: float
    pose: FloatArray
    virtual: bool
    stopped: bool
    speed: Twist2
    robot: FloatArray


class ScriptedOperator:
    """Turns towards the next goal and drives at it, through all obstacles.

    If the robot is blocked for ``notices_s`` in the real view, the operator looks around with full knowledge, backs off
    and drives around the obstacle on the shortest path with ``spare_m``. After ``passed_m`` the operator again looks at
    goals only. In the virtual space the operator just drives on.

    Args:
        goals: (N, 2) positions in the world's frame.
        plan: cells in which the robot's body would touch something.
        config: how the operator drives.
    """

    def __init__(self, goals: FloatArray, plan: OccupancyMask, config: OperatorConfig | None = None) -> None:
        self.goals, self.plan, self.config = goals, plan, config or OperatorConfig()
        self.at = 0
        self.detours = 0
        self.done = self.gave_up = False
        self._held_since: float | None = None
        self._let_go_until = 0.0
        self._backing_until: float | None = None
        self._route: FloatArray | None = None
        self._held_at: list[FloatArray] = []

    def command(self, sight: Sight) -> Twist2:
        """Return the command (m/s, rad/s); called twenty times per second."""
        if self.at < len(self.goals) and _distance(sight.pose, self.goals[self.at]) < self.config.reached_m:
            self.at, self._route = self.at + 1, None
        self.done = self.at == len(self.goals)
        if sight.stopped:
            self._let_go_until = sight.time_s + 1.0
        if self.done or self.gave_up or sight.time_s < self._let_go_until:
            self._held_since = None
            return 0.0, 0.0
        if self._backing_until is not None:
            return self._back_off(sight)
        wanted = self._pursue(sight.pose, self._target(sight))
        self._watch(sight, wanted)
        return wanted

    def _target(self, sight: Sight) -> FloatArray:
        if self._route is not None and _distance(sight.pose, self._held_at[-1]) > self.config.passed_m:
            self._route = None
        if self._route is None:
            return np.asarray(self.goals[self.at])
        away = np.linalg.norm(self._route[:, :2] - sight.pose[:2], axis=1)
        near = int(np.argmin(away))
        self._route = self._route[near:]
        further = np.flatnonzero(away[near:] > 0.35)
        return np.asarray(self._route[int(further[0]) if further.size else -1, :2])

    def _pursue(self, pose: FloatArray, target: FloatArray) -> Twist2:
        x, y, _ = relative2(pose, np.array([*target, 0.0]))
        bearing = math.atan2(float(y), float(x))
        turn = min(max(1.5 * bearing, -self.config.turn_rad_s), self.config.turn_rad_s)
        if self._route is not None and abs(bearing) > 0.25:
            return 0.0, turn  # near an obstacle, turn first
        return (0.0 if abs(bearing) > 0.6 else self.config.cruise_m_s), turn

    def _watch(self, sight: Sight, wanted: Twist2) -> None:
        """Begin to back off once the robot has not moved for ``notices_s``."""
        moves = abs(sight.speed[0]) > 0.03 or (wanted[0] == 0.0 and abs(sight.speed[1]) > 0.05)
        if moves or sight.virtual:
            self._held_since = None
        elif self._held_since is None:
            self._held_since = sight.time_s
        elif sight.time_s - self._held_since > self.config.notices_s:
            self._held_since = None
            self._held_at.append(sight.robot[:2].copy())
            self.detours += 1
            here = [place for place in self._held_at if _distance(place, sight.robot[:2]) < 1.0]
            self.gave_up = len(here) > self.config.gives_up_after
            self._backing_until = sight.time_s + self.config.backs_off_s

    def _back_off(self, sight: Sight) -> Twist2:
        assert self._backing_until is not None
        if sight.time_s < self._backing_until:
            return -self.config.backs_off_m_s, 0.0
        self._backing_until = None
        ways = (route(self.plan, sight.robot, self.goals[self.at :], spare) for spare in self.config.spare_m)
        self._route = next((way for way in ways if way is not None), None)
        return 0.0, 0.0


def _distance(a: FloatArray, b: FloatArray) -> float:
    return float(np.linalg.norm(np.asarray(a)[:2] - np.asarray(b)[:2]))
