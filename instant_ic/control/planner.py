"""Planner: hybrid A* over position and heading for a robot that drives arcs, reverses and turns on the spot.

`HybridPlanner.plan`:

1. ``_PlannerGrid``: price of one cell length in each cell, distance to the nearest obstacle, footprint at each heading.
2. ``connected``, ``nearest``: the goal, or the reachable place nearest to it.
3. ``cost_to_go``: cost of a point robot's way to the goal at the same prices (Dijkstra); the search's heuristic.
4. ``search``: hybrid A*. Each pose is continued by arcs, turns on the spot and reverse arcs, as long as the footprint
   meets nothing; a straight line to the goal ends it.
5. ``smooth``: runs of poses become straight lines where these cost no more.
6. ``_resample``, ``_before_unknown``: poses 5 cm apart, up to the first unseen cell.

Source: Dolgov, Thrun, Montemerlo, Diebel: Path planning for autonomous vehicles in unknown semi-structured
environments, IJRR 29(5), 2010; primitives and collision checks for a skid-steer rectangle instead of a car.
"""

from __future__ import annotations

import itertools
import math
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from instant_ic.control.costmap import INSCRIBED, LETHAL, UNKNOWN, Costmap
from instant_ic.control.footprint import Footprint
from instant_ic.control.hybrid_astar import (
    GridMap,
    GridPose,
    SearchRules,
    cell_weights,
    cost_to_go,
    search,
    smooth,
)

SPACING_M = 0.05
"""Distance between the poses of a path."""
BINS = 32
"""Headings per full turn in the search."""
TOLERANCE_M = 0.5
"""A path that ends this near to an occupied goal counts as a way to it."""


@dataclass(frozen=True)
class PlannerTuning:
    """Tuning of the search. Penalties are factors or metres of extra way, so that prices compare as lengths.

    Attributes:
        footprint_padding: padding of the footprint, in metres.
        cost_penalty: extra price of a metre at cost 252; higher: longer paths, farther from obstacles.
        tight_cost: cost above which the robot cannot turn on the spot (0.39 m from obstacles).
        tight_penalty: additional price of a metre above tight_cost, at cost 252.
        unknown_penalty: extra price of a metre through unseen cells.
        unknown_standoff_m: distance that the path keeps to unseen cells.
        retrospective_gain: discount along the previous path, which keeps the chosen side.
        least_weight: lower bound of a cell's weight.
        reverse_penalty: price factor of a metre driven backwards.
        curve_penalty: price factor of a metre on a curve.
        change_penalty_m: price of a change of direction.
        rotation_penalty_m: price of one radian turned on the spot.
        escape_radius_m: largest distance that a robot standing on obstacles may drive to get off them.
        closed_weight: price factor of closed cells, which only a robot that stands in them may cross.
        cost_to_go_weight: weight of the cost-to-go (weighted A*, Pohl 1970): the search is faster, and paths cost at
            most this factor more.
    """

    footprint_padding: float = 0.02
    cost_penalty: float = 3.0
    tight_cost: int = 165
    tight_penalty: float = 6.0
    unknown_penalty: float = 5.0
    unknown_standoff_m: float = 0.3
    retrospective_gain: float = 0.15
    least_weight: float = 0.8
    reverse_penalty: float = 2.0
    curve_penalty: float = 1.05
    change_penalty_m: float = 0.3
    rotation_penalty_m: float = 0.3
    escape_radius_m: float = 0.6
    closed_weight: float = 8.0
    cost_to_go_weight: float = 1.2


TUNING = PlannerTuning()


@dataclass(frozen=True)
class Plan:
    """A path, and whether it leads to the goal."""

    poses: NDArray[np.float64]
    """(N, 3) x, y, yaw in the map frame, at most 5 cm apart; empty when there is no way at all. A turn on the spot is
    a run of poses at one place."""
    reached: bool
    """The path ends at the goal, not in front of an obstacle or unseen space."""
    reason: str
    """Reason why the path does not end at the goal; empty if it does."""
    whole_length_m: float
    """Length to the goal, including the part through unknown space; inf when there is no way."""
    reverse: NDArray[np.bool_] = field(default_factory=lambda: np.zeros(0, dtype=bool))
    """(N,) true for poses that the robot reaches backwards."""


def no_plan(reason: str) -> Plan:
    """Return a plan without a path."""
    return Plan(np.zeros((0, 3)), False, reason, math.inf)


class HybridPlanner:
    """A planner of paths for the true footprint from any pose of the robot; `PlannerTuning` lists the prices.

    A step costs its length times (1 + cost_penalty·cost/252). Above ``tight_cost``, where the robot cannot turn on the
    spot, up to ``tight_penalty`` is added. Reversing, changing direction and turning cost more.

    No pose puts the footprint (with ``footprint_padding``) on a lethal cell. A robot that stands on lethal cells may
    leave them, but never go deeper. A way may cross unknown cells, but the path ends ``unknown_standoff_m`` before the
    first of them: the robot drives up, sees more, and plans again. Cells near the previous path are a little cheaper
    (``retrospective_gain``), so that the planner does not alternate between two equally good ways.
    """

    def __init__(self, footprint: Footprint | None = None, max_iterations: int = 5000) -> None:
        """Make a planner for a footprint; a search gives up after ``max_iterations`` poses."""
        self.footprint, self.max_iterations = footprint or Footprint(), max_iterations

    def plan(
        self,
        costmap: Costmap,
        start: NDArray[np.float64],
        goal: NDArray[np.float64],
        before: Plan | None = None,
    ) -> Plan:
        """Plan a path from pose ``start`` to pose ``goal`` (3,), or to the nearest reachable place.

        A way along the plan ``before`` is a little cheaper.
        """
        start, goal = np.asarray(start, dtype=np.float64), np.asarray(goal, dtype=np.float64)
        height, width = costmap.costs.shape
        row, column = (int(i) for i in costmap.cells(start[:2]))
        if not (0 <= row < height and 0 <= column < width):
            return no_plan("the robot is outside the costmap")
        goal_row, goal_column = (int(i) for i in costmap.cells(goal[:2]))
        outside = not (0 <= goal_row < height and 0 <= goal_column < width)
        near = min(max(goal_row, 0), height - 1), min(max(goal_column, 0), width - 1)
        if near == (row, column) and not outside:
            return self._at_the_goal(start, goal)
        grid = _PlannerGrid(self, costmap, before)
        taken = int(costmap.costs[near]) in (INSCRIBED, LETHAL)
        connected = grid.connected(row, column)
        reachable = bool(connected[near])
        target = goal
        if taken or outside or not reachable:
            # Plan to the reachable, known place nearest to the goal.
            near = grid.nearest(connected, (row, column), near)
            place = costmap.centres(np.array(near[0]), np.array(near[1]))
            target = np.array([place[0], place[1], np.nan])
            reachable = False
        nodes, found, opened = grid.search(near, row, column, start, target)
        poses, reverse = _resample(grid.smooth(nodes), start, target if found else None)
        length = _length(poses)
        cut = _before_unknown(costmap, poses)
        if cut is not None:
            reason = "the way leads through space not seen yet"
            return Plan(poses[cut], False, reason, length if found else math.inf, reverse[cut])
        if reachable and found:
            return Plan(poses, True, "", length, reverse)
        gap = float(np.linalg.norm(poses[-1, :2] - goal[:2]))
        on_obstacle = taken and not outside and gap <= TOLERANCE_M
        if on_obstacle:
            reason = f"the goal is on an obstacle; the path ends {gap:.1f} m from it"
        else:
            reason = self._why_short(gap, opened, outside=outside, reachable=reachable)
        return Plan(poses, False, reason, length if on_obstacle else math.inf, reverse)

    def _why_short(self, gap_m: float, opened: int, *, outside: bool, reachable: bool) -> str:
        """Return why a path ends ``gap_m`` metres before the goal."""
        if outside:
            return f"the goal is outside the costmap, {gap_m:.1f} m beyond the path"
        if reachable and opened >= self.max_iterations:
            return f"no way found within {opened} steps of the search; the path ends {gap_m:.1f} m before the goal"
        if reachable:
            return f"no way to the goal: it is too narrow for the robot {gap_m:.1f} m before it"
        return f"no way to the goal: obstacles close it off {gap_m:.1f} m before it"

    def _at_the_goal(self, start: NDArray[np.float64], goal: NDArray[np.float64]) -> Plan:
        # The robot may already be at the goal, inside the inflation.
        back = (goal[:2] - start[:2]) @ np.array([math.cos(start[2]), math.sin(start[2])]) < 0.0
        return Plan(np.stack([start, goal]), True, "", _length(np.stack([start, goal])), np.array([False, back]))


def _before_unknown(costmap: Costmap, poses: NDArray[np.float64]) -> NDArray[np.bool_] | None:
    """Return the mask (N,) of the poses before the path's first unknown cell; None if it crosses none."""
    costs = costmap.cost_at(poses[:, :2])
    from_start = np.linalg.norm(poses[:, :2] - poses[0, :2], axis=1)
    # The scan sees nothing close to the robot, so unknown cells there do not count.
    unknown = np.flatnonzero((costs == UNKNOWN) & (from_start > TUNING.unknown_standoff_m))
    if unknown.size == 0:
        return None
    along = np.concatenate([[0.0], np.cumsum(np.linalg.norm(np.diff(poses[:, :2], axis=0), axis=1))])
    keep: NDArray[np.bool_] = along <= along[unknown[0]] - TUNING.unknown_standoff_m
    keep[0] = True
    return keep


class _PlannerGrid:
    """One costmap prepared for the search: cell weights, distance to obstacles, the footprint at each heading."""

    def __init__(self, planner: HybridPlanner, costmap: Costmap, before: Plan | None) -> None:
        import cv2

        self.planner, self.costmap = planner, costmap
        free = (costmap.costs != LETHAL).astype(np.uint8)
        if free.all():
            self.clearance = np.full(free.shape, 1e6, dtype=np.float32)
        else:
            self.clearance = cv2.distanceTransform(free, cv2.DIST_L2, cv2.DIST_MASK_PRECISE)
        near = np.zeros(free.shape, dtype=np.uint8)
        if before is not None and len(before.poses) > 1:
            rows, columns = costmap.cells(before.poses[:, :2])
            line = np.clip(np.stack([columns, rows], axis=-1), -10000, 10000).astype(np.int32)
            cv2.polylines(near, [line], False, 1, thickness=round(0.3 / costmap.resolution))
        tight = (TUNING.tight_cost, TUNING.tight_penalty)
        unknown = 1.0 + TUNING.unknown_penalty
        self.weights = cell_weights(costmap.costs, near, unknown, TUNING.cost_penalty, tight, TUNING.retrospective_gain)
        # The footprint is filled with points, because posts inside the outline count too. At a spacing of 0.7 cells,
        # every cell whose middle is covered holds a point.
        body = planner.footprint.points(0.7 * costmap.resolution, TUNING.footprint_padding) / costmap.resolution
        body = body[np.argsort(-(body**2).sum(axis=1), kind="stable")]
        yaw = 2.0 * math.pi * np.arange(BINS) / BINS
        c, s = np.cos(yaw)[:, None], np.sin(yaw)[:, None]
        bodies = np.stack([c * body[:, 0] - s * body[:, 1], s * body[:, 0] + c * body[:, 1]], axis=-1)
        # A pose may lie anywhere in its cell, up to 0.71 cells from the centre: contact is impossible only beyond that.
        reach = planner.footprint.circumscribed_radius_m + 1.5 * TUNING.footprint_padding
        reach = reach / costmap.resolution + 1.42
        self.map = GridMap(costmap.costs, self.weights, self.clearance, np.ascontiguousarray(body), bodies, reach)

    def connected(self, row: int, column: int) -> NDArray[np.bool_]:
        """Return the mask (H, W) of the cells that the robot's centre can reach from cell (row, column)."""
        import cv2

        open_ = (self.weights > 0).astype(np.uint8)
        escape_m = TUNING.escape_radius_m
        reach = math.ceil(escape_m / self.costmap.resolution)
        near = slice(max(0, row - reach), row + reach + 1), slice(max(0, column - reach), column + reach + 1)
        costs = self.costmap.costs[near]
        rows, columns = np.ogrid[
            near[0].start : near[0].start + costs.shape[0], near[1].start : near[1].start + costs.shape[1]
        ]
        away = np.hypot(rows - row, columns - column) * self.costmap.resolution
        inscribed, lethal = costs == INSCRIBED, costs == LETHAL
        open_[near] |= (inscribed & (away <= TUNING.escape_radius_m)) | (
            lethal & (away <= 0.25 * TUNING.escape_radius_m)
        )
        open_[row, column] = 1
        _, labels = cv2.connectedComponents(open_, connectivity=8)
        reached: NDArray[np.bool_] = labels == labels[row, column]
        return reached

    def nearest(self, connected: NDArray[np.bool_], start: tuple[int, int], goal: tuple[int, int]) -> tuple[int, int]:
        """Return the reachable, known cell nearest to the goal that has room for the robot at nearly every heading.

        Return the start if no such cell is nearer.
        """
        half = 0.5 * max(self.planner.footprint.length_m, self.planner.footprint.width_m)
        room = (half + TUNING.footprint_padding) / self.costmap.resolution + 0.5
        rows, columns = np.nonzero(connected & (self.costmap.costs < INSCRIBED) & (self.clearance > room))
        if rows.size == 0:
            return start
        away = np.hypot(rows - goal[0], columns - goal[1])
        back = np.hypot(rows - start[0], columns - start[1])
        best = np.lexsort((back, np.round(away, 6)))[0]
        if away[best] >= math.hypot(start[0] - goal[0], start[1] - goal[1]):
            return start
        return int(rows[best]), int(columns[best])

    def search(
        self, near: tuple[int, int], row: int, column: int, start: NDArray[np.float64], goal: NDArray[np.float64]
    ) -> tuple[NDArray[np.float64], bool, int]:
        """Search from ``start`` in cell (row, column) to ``goal`` in cell ``near`` (`hybrid_astar.search`)."""
        resolution = self.costmap.resolution
        escape = TUNING.escape_radius_m / resolution
        to_go = cost_to_go(
            self.costmap.costs, self.weights, near, (row, column), escape, TUNING.least_weight, TUNING.closed_weight
        )
        rules = SearchRules(
            max_iterations=self.planner.max_iterations,
            escape=escape,
            change_price=TUNING.change_penalty_m / resolution,
            turn_price=TUNING.rotation_penalty_m / resolution,
            reverse_penalty=TUNING.reverse_penalty,
            curve_penalty=TUNING.curve_penalty,
            closed_weight=TUNING.closed_weight,
            cost_to_go_weight=TUNING.cost_to_go_weight,
        )
        return search(self.map, to_go, self._in_cells(start), self._in_cells(goal), rules)

    def _in_cells(self, pose: NDArray[np.float64]) -> GridPose:
        x, y = (pose[:2] - self.costmap.origin) / self.costmap.resolution
        return GridPose(float(x), float(y), float(pose[2]))

    def smooth(self, nodes: NDArray[np.float64]) -> NDArray[np.float64]:
        """Replace runs of poses by straight pieces where these cost no more; metres in the map frame."""
        kept = smooth(self.map, nodes)
        kept[:, :2] = kept[:, :2] * self.costmap.resolution + self.costmap.origin
        return kept


def _length(poses: NDArray[np.float64]) -> float:
    return float(np.linalg.norm(np.diff(poses[:, :2], axis=0), axis=1).sum())


def _resample(
    nodes: NDArray[np.float64], start: NDArray[np.float64], goal: NDArray[np.float64] | None
) -> tuple[NDArray[np.float64], NDArray[np.bool_]]:
    """Return poses at most ``SPACING_M`` apart along nodes (N, 4), and a mask of those that are reached backwards."""
    nodes = nodes.copy()
    nodes[0, :3] = start
    if goal is not None:
        nodes[-1, :2] = goal[:2]
    pieces, back = [nodes[:1, :3]], [False]
    for a, b in itertools.pairwise(nodes):
        step = b[:2] - a[:2]
        length = float(np.hypot(*step))
        count = max(1, math.ceil(length / SPACING_M - 1e-6))
        part = (np.arange(1, count + 1) / count)[:, None]
        piece = np.empty((count, 3))
        piece[:, :2] = a[:2] + step * part
        # On a straight line the robot turns before it drives; on an arc it turns while it drives.
        along = math.atan2(step[1], step[0]) + math.pi * b[3]
        straight = length > 1e-6 and abs(math.remainder(b[2] - along, 2 * math.pi)) < 1e-3
        piece[:, 2] = b[2] if straight else a[2] + math.remainder(b[2] - a[2], 2 * math.pi) * part[:, 0]
        pieces.append(piece)
        back += [bool(b[3]) and length > 1e-6] * count
    poses = np.concatenate(pieces)
    if goal is not None and np.isfinite(goal[2]):
        poses[-1, 2] = goal[2]
    poses[:, 2] = np.remainder(poses[:, 2] + math.pi, 2 * math.pi) - math.pi
    return poses, np.array(back)
