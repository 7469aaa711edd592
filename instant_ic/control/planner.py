"""Grid planner: A* over inflated costs, from where the robot stands to a subgoal."""

from __future__ import annotations

import heapq
import itertools
import math
from dataclasses import dataclass

import numpy as np
from numba import njit
from numpy.typing import NDArray

from .costmap import INSCRIBED, LETHAL, UNKNOWN, Costmap


@dataclass(frozen=True)
class PlannerConfig:
    """What the planner may cross, and at what price."""

    cost_travel_multiplier: float = 3.0
    allow_unknown: bool = True
    unknown_penalty: float = 5.0
    tight_cost: int = 165
    tight_penalty: float = 6.0
    unknown_standoff_m: float = 0.3
    escape_radius_m: float = 0.6
    tolerance_m: float = 0.5

    def __post_init__(self) -> None:
        for key in (
            "cost_travel_multiplier",
            "unknown_penalty",
            "tight_penalty",
            "unknown_standoff_m",
            "escape_radius_m",
            "tolerance_m",
        ):
            if not getattr(self, key) >= 0:
                raise ValueError(f"planner.{key} must be >= 0 (got {getattr(self, key)})")
        if not 0 <= self.tight_cost < INSCRIBED - 1:
            raise ValueError(f"planner.tight_cost must be 0..251 (got {self.tight_cost})")


@dataclass(frozen=True)
class Plan:
    """A path and how far it gets."""

    poses: NDArray[np.float64]
    """(N, 3) x, y, yaw in the map frame, 5 cm or less apart; empty when there is no way at all."""
    reached: bool
    """The path ends at the goal (not in front of something)."""
    reason: str
    """Why it does not end at the goal; empty when it does."""
    whole_length_m: float
    """Length to the goal, the part through unknown space included; inf when there is no way."""


def _nothing(reason: str) -> Plan:
    return Plan(np.zeros((0, 3)), False, reason, math.inf)


class GridPlanner:
    """A* with eight neighbours; a step costs its length times (1 + cost_travel_multiplier·cost/252).

    Above ``tight_cost``, where the robot cannot turn on the spot, up to ``tight_penalty`` comes on top.
    Lethal and inscribed cells are never entered; a robot that stands in them is led out. With ``allow_unknown`` a
    way through unknown cells is taken into account, but the path ends ``unknown_standoff_m`` before the first of
    them: the robot drives up, sees more, and plans again. Without it, unknown cells are walls.
    """

    def __init__(self, config: PlannerConfig) -> None:
        self.config = config

    def plan(self, costmap: Costmap, start: NDArray[np.float64], goal: NDArray[np.float64]) -> Plan:
        """Path from pose ``start`` to pose ``goal`` (3,); to the nearest place where the goal is out of reach."""
        height, width = costmap.costs.shape
        row, column = (int(i) for i in costmap.cells(np.asarray(start)[:2]))
        if not (0 <= row < height and 0 <= column < width):
            return _nothing("the robot is outside the costmap")
        goal_row, goal_column = (int(i) for i in costmap.cells(np.asarray(goal)[:2]))
        outside = not (0 <= goal_row < height and 0 <= goal_column < width)
        goal_row, goal_column = min(max(goal_row, 0), height - 1), min(max(goal_column, 0), width - 1)
        goal_cost = int(costmap.costs[goal_row, goal_column])
        # The robot may stand at the goal already, and that inside inflation.
        at_start = (goal_row, goal_column) == (row, column)
        taken = not at_start and (
            goal_cost in (INSCRIBED, LETHAL) or (goal_cost == UNKNOWN and not self.config.allow_unknown)
        )
        cells, found = _search(
            costmap.costs,
            row,
            column,
            goal_row,
            goal_column,
            self.config.cost_travel_multiplier,
            self.config.tight_cost,
            self.config.tight_penalty,
            self.config.unknown_penalty if self.config.allow_unknown else -1.0,
            self.config.escape_radius_m / costmap.resolution,
        )
        kept = _shortcut(costmap.costs, cells)
        points = costmap.centres(kept[:, 0], kept[:, 1])
        points[0] = np.asarray(start)[:2]
        exact = bool(found) and not taken and not outside
        if exact:
            points = np.concatenate([points[:-1], np.asarray(goal)[None, :2]]) if len(points) > 1 else points
            if len(points) == 1:
                points = np.concatenate([points, np.asarray(goal)[None, :2]])
        poses = _resample(points, 0.05, float(start[2]), float(goal[2]) if exact else None)
        length = _length(poses)
        cut = self._before_unknown(costmap, poses)
        if cut is not None:
            return Plan(cut, False, "the way leads through space not seen yet", length if found else math.inf)
        if exact:
            return Plan(poses, True, "", length)
        gap = float(np.linalg.norm(poses[-1, :2] - np.asarray(goal)[:2]))
        if outside:
            return Plan(poses, False, f"the goal is outside the costmap, {gap:.1f} m beyond the path", math.inf)
        if taken and gap <= self.config.tolerance_m:
            return Plan(poses, False, f"the goal is on an obstacle; the path ends {gap:.1f} m from it", length)
        return Plan(poses, False, f"no way to the goal: obstacles close it off {gap:.1f} m before it", math.inf)

    def _before_unknown(self, costmap: Costmap, poses: NDArray[np.float64]) -> NDArray[np.float64] | None:
        """The part of a path before the first unknown cell; None when there is none on it."""
        costs = costmap.cost_at(poses[:, :2])
        start = np.linalg.norm(poses[:, :2] - poses[0, :2], axis=1)
        # Right round the robot the scan sees nothing; where it stands is free.
        unknown = np.flatnonzero((costs == UNKNOWN) & (start > self.config.unknown_standoff_m))
        if unknown.size == 0:
            return None
        along = np.concatenate([[0.0], np.cumsum(np.linalg.norm(np.diff(poses[:, :2], axis=0), axis=1))])
        keep = along <= along[unknown[0]] - self.config.unknown_standoff_m
        keep[0] = True
        return poses[keep]


def _length(poses: NDArray[np.float64]) -> float:
    return float(np.linalg.norm(np.diff(poses[:, :2], axis=0), axis=1).sum())


def _resample(
    points: NDArray[np.float64], spacing: float, start_yaw: float, goal_yaw: float | None
) -> NDArray[np.float64]:
    """Poses no farther apart than ``spacing`` along a polyline (N, 2), facing along it."""
    pieces = [points[:1]]
    for a, b in itertools.pairwise(points):
        count = max(1, math.ceil(float(np.linalg.norm(b - a)) / spacing))
        pieces.append(a + (b - a) * (np.arange(1, count + 1) / count)[:, None])
    line = np.concatenate(pieces)
    yaw = np.full(len(line), start_yaw)
    if len(line) > 1:
        step = np.diff(line, axis=0)
        yaw[:-1] = np.arctan2(step[:, 1], step[:, 0])
        yaw[-1] = yaw[-2]
    if goal_yaw is not None:
        yaw[-1] = goal_yaw
    return np.column_stack([line, yaw])


@njit(cache=True)
def _search(
    costs: NDArray[np.uint8],
    start_row: int,
    start_column: int,
    goal_row: int,
    goal_column: int,
    multiplier: float,
    tight_cost: int,
    tight_penalty: float,
    unknown_penalty: float,
    escape_cells: float,
) -> tuple[NDArray[np.int64], bool]:
    """Cells (N, 2) from the start to the goal, or to the cell nearest to it that can be reached."""
    height, width = costs.shape
    best = np.full(height * width, np.inf)
    parent = np.full(height * width, -1, dtype=np.int64)
    closed = np.zeros(height * width, dtype=np.bool_)
    start, goal = start_row * width + start_column, goal_row * width + goal_column
    best[start] = 0.0
    queue = [(math.hypot(goal_row - start_row, goal_column - start_column), start)]
    nearest, nearest_distance, nearest_best = start, np.inf, np.inf
    while len(queue) > 0:
        _, cell = heapq.heappop(queue)
        if closed[cell]:
            continue
        closed[cell] = True
        row, column = cell // width, cell % width
        away = math.hypot(goal_row - row, goal_column - column)
        # A way that ends in what was never seen is no use as a stand-in for the goal.
        closer = away < nearest_distance - 1e-9 or (away <= nearest_distance and best[cell] < nearest_best)
        if closer and (costs[row, column] < 253 or cell == start):
            nearest, nearest_distance, nearest_best = cell, away, best[cell]
        if cell == goal:
            break
        here = costs[row, column]
        for dr in range(-1, 2):
            for dc in range(-1, 2):
                r, c = row + dr, column + dc
                if (dr == 0 and dc == 0) or r < 0 or c < 0 or r >= height or c >= width:
                    continue
                cost = costs[r, c]
                if cost == 255:
                    if unknown_penalty < 0.0:
                        continue
                    weight = 1.0 + unknown_penalty
                elif cost >= 253:
                    # Out of inflation, never into it: only from cells of the same kind round the start.
                    if here < 253 or here == 255:
                        continue
                    from_start = math.hypot(r - start_row, c - start_column)
                    if from_start > (escape_cells if cost == 253 else 0.25 * escape_cells):
                        continue
                    weight = 1.0 + 4.0 * (multiplier + tight_penalty)
                else:
                    weight = 1.0 + multiplier * cost / 252.0
                    if cost > tight_cost:
                        weight += tight_penalty * (cost - tight_cost) / (252.0 - tight_cost)
                length = 1.4142135623730951 if dr != 0 and dc != 0 else 1.0
                new = best[cell] + length * weight
                other = r * width + c
                if new < best[other]:
                    best[other] = new
                    parent[other] = cell
                    heapq.heappush(queue, (new + math.hypot(goal_row - r, goal_column - c), other))
    found = closed[goal]
    cell = goal if found else nearest
    count, walk = 1, cell
    while parent[walk] >= 0:
        walk = parent[walk]
        count += 1
    path = np.empty((count, 2), dtype=np.int64)
    for i in range(count - 1, -1, -1):
        path[i, 0], path[i, 1] = cell // width, cell % width
        cell = parent[cell]
    return path, found


@njit(cache=True)
def _shortcut(costs: NDArray[np.uint8], cells: NDArray[np.int64]) -> NDArray[np.int64]:
    """Corners of a path whose straight pieces touch nothing dearer than the cells they replace."""
    kept = np.empty_like(cells)
    kept[0] = cells[0]
    count, i = 1, 0
    while i < len(cells) - 1:
        dearest, unknown, last = 0, False, i + 1
        for j in range(i, min(len(cells), i + 120)):
            cost = costs[cells[j, 0], cells[j, 1]]
            if cost == 255:
                unknown = True
            elif cost >= 253:  # inside inflation the path is walked cell by cell
                if j > i + 1 or costs[cells[i, 0], cells[i, 1]] < 253:
                    break
            elif cost > dearest:
                dearest = cost
            if j > i + 1 and _line_is_free(costs, cells[i], cells[j], dearest, unknown):
                last = j
        kept[count] = cells[last]
        count += 1
        i = last
    return kept[:count]


@njit(cache=True)
def _line_is_free(
    costs: NDArray[np.uint8], a: NDArray[np.int64], b: NDArray[np.int64], dearest: int, unknown: bool
) -> bool:
    steps = 2 * max(abs(b[0] - a[0]), abs(b[1] - a[1]))
    for k in range(steps + 1):
        row = round(a[0] + (b[0] - a[0]) * k / steps)
        column = round(a[1] + (b[1] - a[1]) * k / steps)
        cost = costs[int(row), int(column)]
        if cost == 255:
            if not unknown:
                return False
        elif cost >= 253 or cost > dearest:
            return False
    return True
