"""Planner: hybrid A* over position and heading for a robot that drives arcs, reverses and turns on the spot.

Source: Dolgov, Thrun, Montemerlo, Diebel: Path planning for autonomous vehicles in unknown semi-structured
environments, IJRR 29(5), 2010; primitives and collision checks for a skid-steer rectangle instead of a car. The
heuristic is the cost-to-go of the point robot over the same costs (Dijkstra from the goal).
"""

from __future__ import annotations

import heapq
import itertools
import math
from dataclasses import dataclass, field
from typing import NamedTuple

import numpy as np
from numba import njit
from numpy.typing import NDArray

from instant_ic.config.ranges import Checked, NotNegative, PositiveInt
from instant_ic.control.costmap import INSCRIBED, LETHAL, UNKNOWN, Costmap
from instant_ic.control.footprint import Footprint
from instant_ic.geometry.motion import along_arc

_along_arc = njit(cache=True)(along_arc)

SPACING_M = 0.05
"""Distance between the poses of a path."""
STEP_CELLS = 3.0
"""Length of a primitive."""
COST_PENALTY = 3.0
"""Higher: longer paths, farther from obstacles."""
TIGHT_COST, TIGHT_PENALTY = 165, 6.0
"""Above this cost the robot cannot turn on the spot (0.39 m from obstacles), and a metre costs up to so much more."""
UNKNOWN_PENALTY = 5.0
"""Extra cost of a metre through unseen cells."""
UNKNOWN_STANDOFF_M = 0.3
"""Distance that the path keeps to unseen cells."""
RETROSPECTIVE_GAIN = 0.15
"""Discount along the previous path: keeps the chosen side."""
LEAST_WEIGHT = 0.8
"""Lower bound of a cell's weight."""
BINS = 32
"""Headings per full turn in the search."""
REVERSE_PENALTY = 2.0
"""Cost factor of a metre driven backwards."""
CURVE_PENALTY = 1.05
"""Cost factor of a metre on a curve."""
CHANGE_PENALTY_M = 0.3
"""Cost of a change of direction."""
ROTATION_PENALTY_M = 0.3
"""Cost of one radian turned on the spot."""
ESCAPE_RADIUS_M = 0.6
"""How far a robot that stands on obstacles may drive to get off them."""
TOLERANCE_M = 0.5
"""A path that ends this near an occupied goal counts as a way."""
DEAR = np.float32(8.0)
"""Weight of cells that are closed, except for a robot that stands in them."""
HURRY = 1.2
"""Weight of the cost-to-go (weighted A*, Pohl 1970): paths cost at most this factor more, but come sooner."""


@dataclass(frozen=True)
class PlannerConfig(Checked):
    """What the planner may cross; names of nav2's Smac planner.

    Attributes:
        allow_unknown: plan through unseen cells; the driven path still ends before them.
        allow_reverse_expansion: allow driving backwards, out of dead ends for example.
        footprint_padding: m round the footprint.
        max_iterations: poses after which the search gives up.
    """

    allow_unknown: bool = True
    allow_reverse_expansion: bool = True
    footprint_padding: NotNegative = 0.02
    max_iterations: PositiveInt = 5000


@dataclass(frozen=True)
class Plan:
    """A path and how far it leads."""

    poses: NDArray[np.float64]
    """(N, 3) x, y, yaw in the map frame, at most 5 cm apart; empty when there is no way at all. A turn on the spot is
    a run of poses at one place."""
    reached: bool
    """The path ends at the goal (not in front of something)."""
    reason: str
    """Reason why the path does not end at the goal; empty when it does."""
    whole_length_m: float
    """Length to the goal, including the part through unknown space; inf when there is no way."""
    reverse: NDArray[np.bool_] = field(default_factory=lambda: np.zeros(0, dtype=bool))
    """(N,) whether the robot reaches a pose backwards."""
    iterations: int = 0
    """Number of poses that the search expanded."""


def no_plan(reason: str) -> Plan:
    """A plan without a path."""
    return Plan(np.zeros((0, 3)), False, reason, math.inf)


class HybridPlanner:
    """Finds paths for the true footprint from any pose of the robot.

    A step costs its length times (1 + COST_PENALTY·cost/252). Above ``TIGHT_COST``, where the robot cannot turn on the
    spot, up to ``TIGHT_PENALTY`` is added. Reversing, changing direction and turning cost more.
    No pose puts the footprint (with ``footprint_padding``) on a lethal cell. A robot that stands on lethal cells may
    leave them, but never go deeper. With ``allow_unknown`` a way may cross unknown cells, but the path ends
    ``UNKNOWN_STANDOFF_M`` before the first of them: the robot drives up, sees more, and plans again. Without it,
    unknown cells are walls. Cells near the previous path are a little cheaper (``RETROSPECTIVE_GAIN``), so that the
    planner does not alternate between two equally good ways.
    """

    def __init__(self, config: PlannerConfig, footprint: Footprint | None = None) -> None:
        self.config = config
        self.footprint = footprint or Footprint()

    def plan(
        self,
        costmap: Costmap,
        start: NDArray[np.float64],
        goal: NDArray[np.float64],
        before: Plan | None = None,
    ) -> Plan:
        """Path from pose ``start`` to pose ``goal`` (3,), or to the nearest reachable place."""
        start, goal = np.asarray(start, dtype=np.float64), np.asarray(goal, dtype=np.float64)
        height, width = costmap.costs.shape
        row, column = (int(i) for i in costmap.cells(start[:2]))
        if not (0 <= row < height and 0 <= column < width):
            return no_plan("the robot is outside the costmap")
        goal_row, goal_column = (int(i) for i in costmap.cells(goal[:2]))
        outside = not (0 <= goal_row < height and 0 <= goal_column < width)
        goal_row, goal_column = min(max(goal_row, 0), height - 1), min(max(goal_column, 0), width - 1)
        if (goal_row, goal_column) == (row, column) and not outside:
            return self._at_the_goal(start, goal)
        costs = costmap.costs
        grid = _Grid(self, costmap, before)
        goal_cost = int(costs[goal_row, goal_column])
        taken = goal_cost in (INSCRIBED, LETHAL) or (goal_cost == UNKNOWN and not self.config.allow_unknown)
        connected = grid.connected(row, column)
        reachable = bool(connected[goal_row, goal_column])
        target = None if taken or outside or not reachable else goal
        near = (goal_row, goal_column)
        if target is None:
            # Plan to the nearest reachable place instead; it is never one that was not seen.
            near = grid.nearest(connected, (row, column), near)
            place = costmap.centres(np.array(near[0]), np.array(near[1]))
            target = np.array([place[0], place[1], np.nan])
            reachable = False
        to_go = grid.cost_to_go(near[0], near[1], row, column)
        nodes, found, opened = grid.search(to_go, start, target)
        nodes = grid.smooth(nodes)
        poses, reverse = _resample(nodes, start, target if found else None)
        length = _length(poses)
        exact = reachable and found
        cut = _before_unknown(costmap, poses)
        if cut is not None:
            reason = "the way leads through space not seen yet"
            return Plan(poses[cut], False, reason, length if found else math.inf, reverse[cut], opened)
        if exact:
            return Plan(poses, True, "", length, reverse, opened)
        gap = float(np.linalg.norm(poses[-1, :2] - goal[:2]))
        whole = math.inf
        if outside:
            reason = f"the goal is outside the costmap, {gap:.1f} m beyond the path"
        elif taken and gap <= TOLERANCE_M:
            reason, whole = f"the goal is on an obstacle; the path ends {gap:.1f} m from it", length
        elif reachable and opened >= self.config.max_iterations:
            reason = f"no way found within {opened} steps of the search; the path ends {gap:.1f} m before the goal"
        elif reachable:
            reason = f"no way to the goal: it is too narrow for the robot {gap:.1f} m before it"
        elif goal_cost == UNKNOWN and not self.config.allow_unknown:
            reason = f"the goal is in space not seen yet; the path ends {gap:.1f} m before it"
        else:
            reason = f"no way to the goal: obstacles close it off {gap:.1f} m before it"
        return Plan(poses, False, reason, whole, reverse, opened)

    def _at_the_goal(self, start: NDArray[np.float64], goal: NDArray[np.float64]) -> Plan:
        # The robot may stand at the goal already, inside the inflation.
        back = (goal[:2] - start[:2]) @ np.array([math.cos(start[2]), math.sin(start[2])]) < 0.0
        return Plan(np.stack([start, goal]), True, "", _length(np.stack([start, goal])), np.array([False, back]))


def _before_unknown(costmap: Costmap, poses: NDArray[np.float64]) -> NDArray[np.bool_] | None:
    """Mask of the poses of a path before the first unknown cell; None when it crosses none."""
    costs = costmap.cost_at(poses[:, :2])
    from_start = np.linalg.norm(poses[:, :2] - poses[0, :2], axis=1)
    # The scan sees nothing close to the robot; the cells under it are free.
    unknown = np.flatnonzero((costs == UNKNOWN) & (from_start > UNKNOWN_STANDOFF_M))
    if unknown.size == 0:
        return None
    along = np.concatenate([[0.0], np.cumsum(np.linalg.norm(np.diff(poses[:, :2], axis=0), axis=1))])
    keep: NDArray[np.bool_] = along <= along[unknown[0]] - UNKNOWN_STANDOFF_M
    keep[0] = True
    return keep


class _Map(NamedTuple):
    """What the kernels know of a costmap. Positions are in cells (x along the columns), headings in bins."""

    costs: NDArray[np.uint8]
    weights: NDArray[np.float32]
    """(H, W) cost of one cell length; 0 where the robot's centre may not go."""
    clearance: NDArray[np.float32]
    """(H, W) distance to the nearest lethal cell."""
    body: NDArray[np.float64]
    """(M, 2) points of the footprint, farthest first."""
    bodies: NDArray[np.float64]
    """(bins, M, 2) the same at each heading."""
    reach: float
    """Nothing can touch where the clearance is larger."""


class _Pose(NamedTuple):
    x: float
    y: float
    yaw: float


class _Rules(NamedTuple):
    """Rules of the search, in cells."""

    may_reverse: bool
    change_price: float
    turn_price: float
    """Price of one radian."""
    escape: float
    max_iterations: int


class _Nodes(NamedTuple):
    """Poses that the search has reached, (N,) each."""

    place: NDArray[np.float64]
    """(N, 2)"""
    heading: NDArray[np.int32]
    parent: NDArray[np.int32]
    """-1 for the start."""
    drive: NDArray[np.int8]
    """How it was reached: FORWARD, BACKWARD or TURN."""
    price: NDArray[np.float32]
    overlap: NDArray[np.int32]
    """Points of the body on lethal cells."""


FORWARD, BACKWARD, TURN = 0, 1, 2
ROOM = 4096
"""Nodes for which the search reserves memory at first."""
TURNS = np.array([0, 1, -1, 2, -2, 1, -1, 0, 1, -1])
"""Change of heading of each primitive, in bins."""
LENGTHS = np.array([1.0, 1.0, 1.0, 1.0, 1.0, 0.0, 0.0, -1.0, -1.0, -1.0]) * STEP_CELLS
"""Signed length of each primitive; 0 turns on the spot. The last three need ``may_reverse``."""


class _Grid:
    """One costmap prepared for the search: cell weights, distance to obstacles, the footprint at each heading."""

    def __init__(self, planner: HybridPlanner, costmap: Costmap, before: Plan | None) -> None:
        import cv2

        config = planner.config
        self.planner, self.config, self.costmap = planner, config, costmap
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
        self.weights = _weights(costmap.costs, near, 1.0 + UNKNOWN_PENALTY if config.allow_unknown else 0.0)
        # The body in cells at each heading, filled: posts inside the outline count too. At a spacing of 0.7 cells
        # every cell whose middle is covered holds a point.
        body = planner.footprint.points(0.7 * costmap.resolution, config.footprint_padding) / costmap.resolution
        body = body[np.argsort(-(body**2).sum(axis=1), kind="stable")]
        yaw = 2.0 * math.pi * np.arange(BINS) / BINS
        c, s = np.cos(yaw)[:, None], np.sin(yaw)[:, None]
        bodies = np.stack([c * body[:, 0] - s * body[:, 1], s * body[:, 0] + c * body[:, 1]], axis=-1)
        # A pose may lie anywhere in its cell: nothing can touch from 0.71 cells farther on.
        reach = planner.footprint.circumscribed_radius_m + 1.5 * config.footprint_padding
        reach = reach / costmap.resolution + 1.42
        self.map = _Map(costmap.costs, self.weights, self.clearance, np.ascontiguousarray(body), bodies, reach)

    def connected(self, row: int, column: int) -> NDArray[np.bool_]:
        """Mask (H, W) of the cells that the robot's centre can reach from one."""
        import cv2

        open_ = (self.weights > 0).astype(np.uint8)
        reach = math.ceil(ESCAPE_RADIUS_M / self.costmap.resolution)
        near = slice(max(0, row - reach), row + reach + 1), slice(max(0, column - reach), column + reach + 1)
        costs = self.costmap.costs[near]
        rows, columns = np.ogrid[
            near[0].start : near[0].start + costs.shape[0], near[1].start : near[1].start + costs.shape[1]
        ]
        away = np.hypot(rows - row, columns - column) * self.costmap.resolution
        inscribed, lethal = costs == INSCRIBED, costs == LETHAL
        open_[near] |= (inscribed & (away <= ESCAPE_RADIUS_M)) | (lethal & (away <= 0.25 * ESCAPE_RADIUS_M))
        open_[row, column] = 1
        _, labels = cv2.connectedComponents(open_, connectivity=8)
        reached: NDArray[np.bool_] = labels == labels[row, column]
        return reached

    def cost_to_go(self, row: int, column: int, start_row: int, start_column: int) -> NDArray[np.float32]:
        """Cost in cells (H, W) of the point robot's way to one cell, from all cells that matter for the start."""
        escape = ESCAPE_RADIUS_M / self.costmap.resolution
        costs: NDArray[np.float32] = _cost_to_go(
            self.costmap.costs, self.weights, row, column, start_row, start_column, escape
        )
        return costs

    def nearest(self, connected: NDArray[np.bool_], start: tuple[int, int], goal: tuple[int, int]) -> tuple[int, int]:
        """The reachable, known cell nearest to the goal in which the robot may face any way except along a wall.

        Returns the start where none is nearer.
        """
        half = 0.5 * max(self.planner.footprint.length_m, self.planner.footprint.width_m)
        room = (half + self.config.footprint_padding) / self.costmap.resolution + 0.5
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
        self, to_go: NDArray[np.float32], start: NDArray[np.float64], goal: NDArray[np.float64]
    ) -> tuple[NDArray[np.float64], bool, int]:
        """Poses (N, 4) in cells and radians, the fourth 1 where reached backwards; found; number of poses expanded."""
        config, resolution = self.config, self.costmap.resolution
        rules = _Rules(
            config.allow_reverse_expansion,
            CHANGE_PENALTY_M / resolution,
            ROTATION_PENALTY_M / resolution,
            ESCAPE_RADIUS_M / resolution,
            config.max_iterations,
        )
        return _search(self.map, to_go, self._in_cells(start), self._in_cells(goal), rules)

    def _in_cells(self, pose: NDArray[np.float64]) -> _Pose:
        x, y = (pose[:2] - self.costmap.origin) / self.costmap.resolution
        return _Pose(float(x), float(y), float(pose[2]))

    def smooth(self, nodes: NDArray[np.float64]) -> NDArray[np.float64]:
        """Replace runs of poses by straight pieces where these cost no more; metres in the map frame."""
        kept = _smooth(self.map, nodes)
        kept[:, :2] = kept[:, :2] * self.costmap.resolution + self.costmap.origin
        return kept


def _length(poses: NDArray[np.float64]) -> float:
    return float(np.linalg.norm(np.diff(poses[:, :2], axis=0), axis=1).sum())


def _resample(
    nodes: NDArray[np.float64], start: NDArray[np.float64], goal: NDArray[np.float64] | None
) -> tuple[NDArray[np.float64], NDArray[np.bool_]]:
    """Poses at most ``SPACING_M`` apart along nodes (N, 4), from the true start to the true goal; and which reverse."""
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
        # On a straight line the robot turns before it drives; on an arc it turns on the way.
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


@njit(cache=True)
def _weights(costs: NDArray[np.uint8], near: NDArray[np.uint8], unknown: float) -> NDArray[np.float32]:
    """Cost (H, W) of one cell length in a cell; 0 where the robot's centre may not go.

    ``near``: the previous path. ``unknown``: cost in unseen cells.
    """
    weights = np.empty(costs.shape, dtype=np.float32)
    for r in range(costs.shape[0]):
        for c in range(costs.shape[1]):
            cost = costs[r, c]
            weight = 0.0
            if cost == 255:
                weight = unknown
            elif cost < 253:
                weight = 1.0 + COST_PENALTY * cost / 252.0
                if cost > TIGHT_COST:
                    weight += TIGHT_PENALTY * (cost - TIGHT_COST) / (252.0 - TIGHT_COST)
            weights[r, c] = weight * (1.0 - RETROSPECTIVE_GAIN if near[r, c] else 1.0)
    return weights


@njit(cache=True)
def _cost_to_go(
    costs: NDArray[np.uint8],
    weights: NDArray[np.float32],
    row: int,
    column: int,
    start_row: int,
    start_column: int,
    escape: float,
) -> NDArray[np.float32]:
    """Dijkstra from (row, column), limited to cells on possible ways to the robot's start.

    In these cells, cost plus straight distance to the start is little more than the cost of the best way (A*).

    Inscribed cells within ``escape`` of the start count as dear instead of closed (lethal ones within a quarter of
    that): the robot may stand there.
    """
    height, width = costs.shape
    best = np.full((height, width), np.inf, dtype=np.float32)
    closed = np.zeros((height, width), dtype=np.bool_)
    best[row, column] = 0.0
    queue = [(0.0, row * width + column)]
    bound = np.inf
    while len(queue) > 0:
        cost, cell = heapq.heappop(queue)
        if cost > bound:
            break
        r, c = cell // width, cell % width
        if closed[r, c]:
            continue
        closed[r, c] = True
        if r == start_row and c == start_column:
            bound = 1.1 * cost + 15.0
        for dr in range(-1, 2):
            for dc in range(-1, 2):
                y, x = r + dr, c + dc
                if (dr == 0 and dc == 0) or y < 0 or x < 0 or y >= height or x >= width or closed[y, x]:
                    continue
                weight = weights[y, x]
                if weight == 0.0:
                    kind = costs[y, x]
                    if kind == 255:
                        continue
                    away = math.hypot(y - start_row, x - start_column)
                    if away > (escape if kind == 253 else 0.25 * escape):
                        continue
                    weight = DEAR
                new = best[r, c] + weight * np.float32(1.4142135 if dr != 0 and dc != 0 else 1.0)
                if new < best[y, x]:
                    best[y, x] = new
                    ahead = LEAST_WEIGHT * math.hypot(y - start_row, x - start_column)
                    heapq.heappush(queue, (float(new + ahead), y * width + x))
    return best


@njit(cache=True)
def _overlap(
    costs: NDArray[np.uint8], clearance: NDArray[np.float32], x: float, y: float, body: NDArray[np.float64]
) -> int:
    """Number of the body's points, already rotated, in lethal cells; the centre at (x, y) in cells.

    The points are sorted farthest first: those nearer than the nearest lethal cell are skipped.
    """
    height, width = costs.shape
    nearest = max(clearance[math.floor(y), math.floor(x)] - 1.5, 0.0)
    count = 0
    for j in range(body.shape[0]):
        if body[j, 0] * body[j, 0] + body[j, 1] * body[j, 1] < nearest * nearest:
            break
        c, r = math.floor(x + body[j, 0]), math.floor(y + body[j, 1])
        if 0 <= r < height and 0 <= c < width and costs[r, c] == 254:
            count += 1
    return count


@njit(cache=True)
def _turned(body: NDArray[np.float64], yaw: float) -> NDArray[np.float64]:
    c, s = math.cos(yaw), math.sin(yaw)
    turned = np.empty_like(body)
    for j in range(body.shape[0]):
        turned[j, 0] = c * body[j, 0] - s * body[j, 1]
        turned[j, 1] = s * body[j, 0] + c * body[j, 1]
    return turned


@njit(cache=True)
def _line_cost(grid: _Map, ax: float, ay: float, bx: float, by: float, yaw: float, dearest: float) -> float:
    """Cost in cells of a straight way at a heading.

    Inf where the footprint meets something, or a cell is dearer than ``dearest``.
    """
    height, width = grid.costs.shape
    length = math.hypot(bx - ax, by - ay)
    count = max(1, math.ceil(length))
    turned = grid.body
    is_turned = False
    total = 0.0
    for k in range(count + 1):
        x, y = ax + (bx - ax) * k / count, ay + (by - ay) * k / count
        c, r = math.floor(x), math.floor(y)
        if c < 0 or r < 0 or c >= width or r >= height or grid.weights[r, c] == 0.0:
            return np.inf
        if grid.weights[r, c] > dearest:
            return np.inf
        if grid.clearance[r, c] <= grid.reach:
            if not is_turned:
                turned = _turned(grid.body, yaw)
                is_turned = True
            if _overlap(grid.costs, grid.clearance, x, y, turned) > 0:
                return np.inf
        if k > 0:
            total += grid.weights[r, c] * length / count
    return total


@njit(cache=True)
def _turn_is_free(grid: _Map, x: float, y: float, yaw: float, turn: float) -> bool:
    """Return whether the footprint can turn on the spot from ``yaw`` by ``turn`` without contact."""
    if grid.clearance[math.floor(y), math.floor(x)] > grid.reach:
        return True
    count = max(1, math.ceil(abs(turn) / 0.15))
    for k in range(count + 1):
        if _overlap(grid.costs, grid.clearance, x, y, _turned(grid.body, yaw + turn * k / count)) > 0:
            return False
    return True


@njit(cache=True)
def _wrapped(angle: float) -> float:
    return angle - 2.0 * math.pi * math.floor((angle + math.pi) / (2.0 * math.pi))


@njit(cache=True)
def _new_nodes(room: int) -> _Nodes:
    return _Nodes(
        np.empty((room, 2)),
        np.empty(room, dtype=np.int32),
        np.empty(room, dtype=np.int32),
        np.empty(room, dtype=np.int8),
        np.empty(room, dtype=np.float32),
        np.zeros(room, dtype=np.int32),
    )


@njit(cache=True)
def _doubled(nodes: _Nodes) -> _Nodes:
    """The same nodes with twice the room."""
    room = len(nodes.price)
    more = _new_nodes(2 * room)
    more.place[:room], more.heading[:room], more.parent[:room] = nodes.place, nodes.heading, nodes.parent
    more.drive[:room], more.price[:room], more.overlap[:room] = nodes.drive, nodes.price, nodes.overlap
    return more


@njit(cache=True)
def _set_node(
    nodes: _Nodes, node: int, x: float, y: float, heading: int, parent: int, drive: int, price: float, overlap: int
) -> None:
    nodes.place[node, 0], nodes.place[node, 1] = x, y
    nodes.heading[node], nodes.parent[node], nodes.drive[node] = heading, parent, drive
    nodes.price[node], nodes.overlap[node] = price, overlap


@njit(cache=True)
def _search(
    grid: _Map, to_go: NDArray[np.float32], start: _Pose, goal: _Pose, rules: _Rules
) -> tuple[NDArray[np.float64], bool, int]:
    """Hybrid A*. Headings stay on the bins, positions are continuous; one pose is kept per cell and heading."""
    height, width = grid.costs.shape
    bins = grid.bodies.shape[0]
    per_bin = 2.0 * math.pi / bins
    first = math.floor(start.yaw / per_bin + 0.5) % bins
    start_row, start_column = math.floor(start.y), math.floor(start.x)
    best = np.full(bins * height * width, np.inf, dtype=np.float32)
    closed = np.zeros(bins * height * width, dtype=np.bool_)
    best[(first * height + start_row) * width + start_column] = 0.0
    nodes = _new_nodes(ROOM)
    overlap = _overlap(grid.costs, grid.clearance, start.x, start.y, grid.bodies[first])
    _set_node(nodes, 0, start.x, start.y, first, -1, TURN, 0.0, overlap)
    count, opened = 1, 0
    queue = [(HURRY * float(to_go[start_row, start_column]), 0)]
    # The goal is one more node, reached from any node by a turn, a straight line and a turn.
    goal_price, goal_parent, goal_backwards = np.inf, -1, 0
    nearest, nearest_to_go = 0, np.float32(np.inf)
    while len(queue) > 0 and opened < rules.max_iterations:
        f, node = heapq.heappop(queue)
        if f >= goal_price:
            break
        x, y, heading = nodes.place[node, 0], nodes.place[node, 1], nodes.heading[node]
        row, column = math.floor(y), math.floor(x)
        state = (heading * height + row) * width + column
        if closed[state]:
            continue
        closed[state] = True
        opened += 1
        left = to_go[row, column]
        if left < nearest_to_go and (grid.costs[row, column] != 255):
            nearest, nearest_to_go = node, left
        # Try the straight way to the goal: always from near, sometimes from far.
        away = math.hypot(goal.x - x, goal.y - y)
        if nodes.overlap[node] == 0 and (away < 20.0 or opened % max(1, int(away / 12.0)) == 0):
            for backwards in range(2 if rules.may_reverse and 0.2 < away < 20.0 else 1):
                total = _price_to_goal(grid, nodes, node, goal, rules, backwards, left, goal_price)
                if total < goal_price:
                    goal_price, goal_parent, goal_backwards = total, node, backwards
        for k in range(len(TURNS) if rules.may_reverse else 7):
            new_x, new_y = _moved(x, y, heading, k, per_bin)
            c, r = math.floor(new_x), math.floor(new_y)
            if c < 0 or r < 0 or c >= width or r >= height or not np.isfinite(to_go[r, c]):
                continue
            other = (heading + TURNS[k]) % bins
            key = (other * height + r) * width + c
            if closed[key]:
                continue
            weight = grid.weights[r, c]
            if weight == 0.0:
                if nodes.overlap[node] == 0 and grid.costs[row, column] < 253:
                    continue  # out of closed cells, never into them
                weight = DEAR
            new = nodes.price[node] + _step_price(k, weight, nodes.drive[node], per_bin, rules)
            if new >= best[key] - 1e-4:
                continue
            touching = 0
            if grid.clearance[r, c] <= grid.reach:
                touching = _touching(grid, nodes, node, k, new_x, new_y, start, rules.escape)
                if touching < 0:
                    continue
                new += 2.0 * touching / grid.body.shape[0] * 100.0
            best[key] = new
            if count == len(nodes.price):
                nodes = _doubled(nodes)
            _set_node(nodes, count, new_x, new_y, other, node, _drive_of(k), new, touching)
            heapq.heappush(queue, (float(new + HURRY * to_go[r, c]), count))
            count += 1
    found = goal_parent >= 0
    return _path_to(nodes, goal_parent if found else nearest, bins, start, goal, found, goal_backwards), found, opened


@njit(cache=True)
def _drive_of(k: int) -> int:
    """Drive of primitive ``k``."""
    if LENGTHS[k] == 0.0:
        return TURN
    return BACKWARD if LENGTHS[k] < 0.0 else FORWARD


@njit(cache=True)
def _moved(x: float, y: float, heading: int, k: int, per_bin: float) -> tuple[float, float]:
    """End of primitive ``k`` from a place and a heading."""
    length = LENGTHS[k]
    if length == 0.0:
        return x, y
    to_x, to_y, _ = _along_arc(x, y, heading * per_bin, length, TURNS[k] * per_bin)
    return to_x, to_y


@njit(cache=True)
def _step_price(k: int, weight: float, before: int, per_bin: float, rules: _Rules) -> float:
    """Price of primitive ``k`` into a cell of ``weight``, from a node that was reached by the drive ``before``."""
    drive = _drive_of(k)
    if drive == TURN:
        return rules.turn_price * per_bin * weight
    price = abs(LENGTHS[k]) * weight * (CURVE_PENALTY if TURNS[k] != 0 else 1.0)
    if drive == BACKWARD:
        price *= REVERSE_PENALTY
    if before != TURN and before != drive:
        price += rules.change_price
    return price


@njit(cache=True)
def _touching(grid: _Map, nodes: _Nodes, node: int, k: int, x: float, y: float, start: _Pose, escape: float) -> int:
    """Points of the body on lethal cells at the end (x, y) of primitive ``k`` from ``node``; -1 where it may not go."""
    bins = grid.bodies.shape[0]
    heading, before = nodes.heading[node], nodes.overlap[node]
    touching = _overlap(grid.costs, grid.clearance, x, y, grid.bodies[(heading + TURNS[k]) % bins])
    if touching > 0:
        # Only for a robot that already stands on an obstacle, and only to leave it.
        near = math.hypot(x - start.x, y - start.y) <= escape
        return -1 if before == 0 or touching > before or not near else touching
    if LENGTHS[k] != 0.0 and before == 0:
        # Check halfway too: a primitive is three cells long.
        turned = grid.bodies[heading]
        if TURNS[k] != 0:
            turned = _turned(grid.body, (heading + 0.5 * TURNS[k]) * (2.0 * math.pi / bins))
        if (
            _overlap(
                grid.costs, grid.clearance, 0.5 * (nodes.place[node, 0] + x), 0.5 * (nodes.place[node, 1] + y), turned
            )
            > 0
        ):
            return -1
    return 0


@njit(cache=True)
def _price_to_goal(
    grid: _Map, nodes: _Nodes, node: int, goal: _Pose, rules: _Rules, backwards: int, left: float, most: float
) -> float:
    """Price of the goal by a turn, a straight line and a turn from ``node``; inf where not free or not below ``most``.

    ``left``: cost-to-go of the point robot.
    """
    x, y = nodes.place[node, 0], nodes.place[node, 1]
    heading = nodes.heading[node] * (2.0 * math.pi / grid.bodies.shape[0])
    away = math.hypot(goal.x - x, goal.y - y)
    yaw = math.atan2(goal.y - y, goal.x - x) + backwards * math.pi if away > 0.2 else heading
    turn = _wrapped(yaw - heading)
    end_turn = 0.0 if np.isnan(goal.yaw) else _wrapped(goal.yaw - yaw)
    total = nodes.price[node] + rules.turn_price * (abs(turn) + abs(end_turn))
    if backwards and nodes.drive[node] == FORWARD and abs(turn) < 0.1:
        total += rules.change_price
    share = REVERSE_PENALTY if backwards else 1.0
    if total + share * away >= most or not _turn_is_free(grid, x, y, heading, turn):
        return np.inf
    line = _line_cost(grid, x, y, goal.x, goal.y, yaw, np.inf)
    # The point robot's way gives no bound at a place beside a better line.
    return total + share * line if line <= 1.05 * left + 3.0 else np.inf


@njit(cache=True)
def _path_to(
    nodes: _Nodes, end: int, bins: int, start: _Pose, goal: _Pose, found: bool, goal_backwards: int
) -> NDArray[np.float64]:
    """Poses (N, 4) from the start to node ``end``, and on to the goal where it was found."""
    number, node = 0, end
    while node >= 0:
        number += 1
        node = int(nodes.parent[node])
    path = np.empty((number + (2 if found else 0), 4))
    node, i = end, number - 1
    while node >= 0:
        path[i, 0], path[i, 1] = nodes.place[node, 0], nodes.place[node, 1]
        path[i, 2] = nodes.heading[node] * (2.0 * math.pi / bins)
        path[i, 3] = 1.0 if nodes.drive[node] == BACKWARD else 0.0
        node, i = int(nodes.parent[node]), i - 1
    path[0, 2] = start.yaw
    if found:
        x, y = nodes.place[end, 0], nodes.place[end, 1]
        yaw = path[number - 1, 2]
        if math.hypot(goal.x - x, goal.y - y) > 0.2:
            yaw = math.atan2(goal.y - y, goal.x - x) + goal_backwards * math.pi
        for k in range(2):
            path[number + k, 0], path[number + k, 1] = (x, y) if k == 0 else (goal.x, goal.y)
            path[number + k, 2], path[number + k, 3] = yaw, float(k * goal_backwards)
    return path


@njit(cache=True)
def _weight_at(weights: NDArray[np.float32], node: NDArray[np.float64]) -> float:
    return weights[math.floor(node[1]), math.floor(node[0])]


@njit(cache=True)
def _smooth(grid: _Map, nodes: NDArray[np.float64]) -> NDArray[np.float64]:
    """Replace runs of forward nodes by straight lines that cost no more."""
    count = len(nodes)
    along = np.zeros(count)  # cost from the first node on
    for i in range(1, count):
        length = math.hypot(nodes[i, 0] - nodes[i - 1, 0], nodes[i, 1] - nodes[i - 1, 1])
        along[i] = along[i - 1] + length * max(_weight_at(grid.weights, nodes[i]), 1.0)
    kept = np.empty((2 * count, 4))
    kept[0] = nodes[0]
    number, i = 1, 0
    while i < count - 1:
        last = i + 1
        dearest = max(_weight_at(grid.weights, nodes[i]), _weight_at(grid.weights, nodes[i + 1]))
        for j in range(i + 2, min(count, i + 80)):
            if nodes[j, 3] != 0.0 or nodes[i + 1, 3] != 0.0:
                break
            dearest = max(dearest, _weight_at(grid.weights, nodes[j]))
            dx, dy = nodes[j, 0] - nodes[i, 0], nodes[j, 1] - nodes[i, 1]
            if math.hypot(dx, dy) < 1.0:
                continue
            yaw = math.atan2(dy, dx)
            line = _line_cost(grid, nodes[i, 0], nodes[i, 1], nodes[j, 0], nodes[j, 1], yaw, 1.05 * dearest)
            if line > 1.01 * (along[j] - along[i]) + 0.2:
                continue
            before = kept[number - 1, 2]
            turn = _wrapped(yaw - before)
            end_turn = _wrapped(nodes[j, 2] - yaw) if j < count - 1 else 0.0
            if _turn_is_free(grid, nodes[i, 0], nodes[i, 1], before, turn) and _turn_is_free(
                grid, nodes[j, 0], nodes[j, 1], yaw, end_turn
            ):
                last = j
        if last > i + 1:
            kept[number, 0], kept[number, 1] = nodes[last, 0], nodes[last, 1]
            kept[number, 2] = math.atan2(nodes[last, 1] - nodes[i, 1], nodes[last, 0] - nodes[i, 0])
            kept[number, 3] = 0.0
        else:
            kept[number] = nodes[last]
        number += 1
        i = last
    return kept[:number].copy()
