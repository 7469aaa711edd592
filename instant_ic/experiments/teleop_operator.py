"""Operators for ``ic evaluate teleop``: a scripted one who looks at goals only, and one with recorded commands."""

from __future__ import annotations

import csv
import math
from collections import deque
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, TypeAlias

import numpy as np
from numpy.typing import NDArray

from instant_ic.experiments.teleop_worlds import route
from instant_ic.geometry.poses import relative2

if TYPE_CHECKING:
    from instant_ic.sim.contact import OccupancyMask

FloatArray: TypeAlias = NDArray[np.float64]
Twist2: TypeAlias = tuple[float, float]

CRUISE_M_S, TURN_RAD_S = 0.4, 0.8
"""The console's full speed (config/console.yaml: drive)."""
REACHED_M = 0.25
BACKS_OFF_S, BACKS_OFF_M_S = 2.0, 0.2
PASSED_M = 2.2
"""Distance from the blocked place at which a detour ends."""
GIVES_UP_AFTER = 4
"""Number of detours at one place."""
_AFTER_S = 2.0
HUMAN_SPARE_M = (0.10, 0.05)
"""Margin on every side that the operator keeps on a detour; the second if the first does not fit."""


@dataclass(frozen=True)
class Sight:
    """What the operator sees.

    Attributes:
        time_s: simulated.
        pose: (3,) of the shown robot in the world's frame; the position is as old as the image.
        virtual: the rendered view is shown.
        stopped: the robot is stopped until the controls are released.
        speed: (m/s, rad/s) of the shown robot.
        robot: (3,) true pose of the r-bot, for planning a detour while the operator looks at it.
    """

    time_s: float
    pose: FloatArray
    virtual: bool
    stopped: bool
    speed: Twist2
    robot: FloatArray


@dataclass(frozen=True)
class Manner:
    """How an operator drives.

    Attributes:
        speed: share of the forward speed.
        delay_s: from what is seen to the command.
        noise: standard deviation of both speeds, as a share of full speed; it lasts about half a second.
        notices_s: time without motion under a command after which the operator looks for the reason.
    """

    speed: float = 1.0
    delay_s: float = 0.0
    noise: float = 0.0
    notices_s: float = 1.5


_PLAIN = Manner()
MANNERS = {
    "plain": _PLAIN,
    "cautious": Manner(speed=0.5, notices_s=3.0),
    "hasty": Manner(notices_s=0.4),
    "late": Manner(delay_s=0.5),
    "noisy": Manner(noise=0.15),
}


class ScriptedOperator:
    """Turns towards the next goal and drives at it, through all obstacles; the same seed gives the same commands.

    Blocked for ``notices_s`` in the real view, the operator looks around with full knowledge: backs off, drives around
    along the shortest path with 10 cm margin, and looks at goals again after PASSED_M. In the virtual space the
    operator drives on.
    """

    def __init__(
        self, goals: FloatArray, plan: OccupancyMask, manner: Manner = MANNERS["plain"], seed: int = 0
    ) -> None:
        self.goals, self.plan, self.manner = goals, plan, manner
        self._rng, self._noise = np.random.default_rng([83, seed]), np.zeros(2)
        self._waiting: deque[tuple[float, Twist2]] = deque()
        self._now: Twist2 = (0.0, 0.0)
        self.at = 0
        self.detours = 0
        self.done = self.gave_up = False
        self._held_since: float | None = None
        self._let_go_until = 0.0
        self._backing_until: float | None = None
        self._route: FloatArray | None = None
        self._held_at: list[FloatArray] = []

    def command(self, sight: Sight) -> Twist2:
        """Return the command (m/s, rad/s) for the view of ``delay_s`` ago; called twenty times per second."""
        linear, angular = self._intended(sight)
        self._noise = 0.9 * self._noise + self.manner.noise * math.sqrt(0.19) * self._rng.normal(size=2)
        if linear or angular:
            angular += float(self._noise[1]) * TURN_RAD_S
            linear *= self.manner.speed if linear > 0 else 1.0
            linear += float(self._noise[0]) * CRUISE_M_S if linear else 0.0
        self._waiting.append((sight.time_s + self.manner.delay_s, (linear, angular)))
        while self._waiting and self._waiting[0][0] <= sight.time_s + 1e-9:
            self._now = self._waiting.popleft()[1]
        return self._now

    def _intended(self, sight: Sight) -> Twist2:
        if self.at < len(self.goals) and _far(sight.pose, self.goals[self.at]) < REACHED_M:
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
        if self._route is not None and _far(sight.pose, self._held_at[-1]) > PASSED_M:
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
        turn = min(max(1.5 * bearing, -TURN_RAD_S), TURN_RAD_S)
        if self._route is not None and abs(bearing) > 0.25:
            return 0.0, turn  # near an obstacle, turn first
        return (0.0 if abs(bearing) > 0.6 else CRUISE_M_S), turn

    def _watch(self, sight: Sight, wanted: Twist2) -> None:
        moves = abs(sight.speed[0]) > 0.03 or (wanted[0] == 0.0 and abs(sight.speed[1]) > 0.05)
        if moves or sight.virtual:
            self._held_since = None
        elif self._held_since is None:
            self._held_since = sight.time_s
        elif sight.time_s - self._held_since > self.manner.notices_s:
            self._held_since = None
            self._held_at.append(sight.robot[:2].copy())
            self.detours += 1
            here = [place for place in self._held_at if _far(place, sight.robot[:2]) < 1.0]
            self.gave_up = len(here) > GIVES_UP_AFTER
            self._backing_until = sight.time_s + BACKS_OFF_S

    def _back_off(self, sight: Sight) -> Twist2:
        assert self._backing_until is not None
        if sight.time_s < self._backing_until:
            return -BACKS_OFF_M_S, 0.0
        self._backing_until = None
        ways = (route(self.plan, sight.robot, self.goals[self.at :], spare) for spare in HUMAN_SPARE_M)
        self._route = next((way for way in ways if way is not None), None)
        return 0.0, 0.0


class RecordedOperator:
    """Commands of a log by time, independent of what the robot does."""

    def __init__(self, log: FloatArray) -> None:
        self.log = log
        self.done = self.gave_up = False
        self.detours = 0
        self._began_s: float | None = None
        self._next = 0

    def command(self, sight: Sight) -> Twist2:
        """Return the command at this time of the log."""
        if self._began_s is None:
            self._began_s = sight.time_s
        since = sight.time_s - self._began_s
        while self._next < len(self.log) and self.log[self._next, 0] <= since + 1e-9:
            self._next += 1
        self.done = since > self.log[-1, 0]
        row = self.log[self._next - 1] if self._next else None
        # A log may lack zeros during a pause: as in the console, a command that is not renewed expires.
        if self.done or row is None or since - row[0] > 0.5:
            return 0.0, 0.0
        return float(row[1]), float(row[2])


def read_commands(path: Path) -> FloatArray:
    """Read a log of commands (N, 3): seconds from the first that moves the robot, m/s, rad/s.

    From a bag's ``/operator/cmd_vel``, or a CSV file with the columns ``time_s, linear_m_s, angular_rad_s``. Rows
    before the first motion and later than ``_AFTER_S`` after the last are dropped.

    Raises:
        ValueError: no such file, no commands, or malformed rows; names file and row.
    """
    if not path.exists():
        raise ValueError(f"{path}: no such bag or CSV file")
    log = _read_csv(path) if path.suffix.lower() == ".csv" else _read_bag(path)
    if len(log) == 0:
        raise ValueError(f"{path}: contains no commands, only column names")
    table = np.array(log, dtype=np.float64)
    bad = np.flatnonzero(~np.isfinite(table).all(axis=1))
    if bad.size:
        raise ValueError(f"{path}: command {bad[0] + 1} of {len(table)} is not finite: {table[bad[0]].tolist()}")
    back = np.flatnonzero(np.diff(table[:, 0]) < 0)
    if back.size:
        first, then = table[back[0] : back[0] + 2, 0]
        raise ValueError(
            f"{path}: time goes back by {first - then:.3f} s at command {back[0] + 2} of {len(table)}; "
            "commands must be in the order of their times"
        )
    moves = np.flatnonzero(table[:, 1:].any(axis=1))
    if moves.size == 0:
        raise ValueError(f"{path}: all {len(table)} commands are zero")
    table = table[moves[0] :][table[moves[0] :, 0] <= table[moves[-1], 0] + _AFTER_S]
    table[:, 0] -= table[0, 0]
    return table


def _read_csv(path: Path) -> list[Sequence[float]]:
    names = ("time_s", "linear_m_s", "angular_rad_s")
    with path.open(newline="") as file:
        reader = csv.DictReader(file)
        missing = [name for name in names if name not in (reader.fieldnames or ())]
        if missing:
            raise ValueError(f"{path}: column {', '.join(missing)} is missing; required: {', '.join(names)}")
        rows: list[Sequence[float]] = []
        for row in reader:
            try:
                rows.append([float(row[name]) for name in names])
            except (TypeError, ValueError) as error:
                raise ValueError(f"{path}:{reader.line_num}: not a row of numbers ({error})") from error
    return rows


def _read_bag(path: Path) -> list[Sequence[float]]:
    from instant_ic.experiments.bags import opened
    from instant_ic.msg import deserialize, twist_values

    topic = "/operator/cmd_vel"
    with opened(path, {topic: ("TwistStamped", "Twist")}) as reader:
        rows: list[Sequence[float]] = [
            [message.stamp_ns / 1e9, *twist_values(deserialize(message.payload, message.type_name))]
            for message in reader.messages([topic])
        ]
    if not rows:
        raise ValueError(f"{path}: contains no message on {topic}")
    return rows


def _far(a: FloatArray, b: FloatArray) -> float:
    return float(np.linalg.norm(np.asarray(a)[:2] - np.asarray(b)[:2]))
