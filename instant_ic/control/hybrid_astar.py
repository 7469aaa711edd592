"""Hybrid A* on a costmap, compiled: cell weights, cost-to-go, search and smoothing (`control.planner`)."""

from __future__ import annotations

import heapq
import math
from typing import NamedTuple

import numpy as np
from numba import njit
from numpy.typing import NDArray

from instant_ic.geometry.motion import along_arc

_along_arc = njit(cache=True)(along_arc)


class GridMap(NamedTuple):
    """A costmap, prepared for the search. Positions are in cells (x along the columns), headings in bins."""

    costs: NDArray[np.uint8]
    weights: NDArray[np.float32]
    """(H, W) cost of one cell length; 0 where the robot's centre may not go."""
    clearance: NDArray[np.float32]
    """(H, W) distance to the nearest lethal cell."""
    body: NDArray[np.float64]
    """(M, 2) points of the footprint, farthest first."""
    bodies: NDArray[np.float64]
    """(bins, M, 2) these points at each heading."""
    reach: float
    """Clearance above which no part of the footprint can touch anything."""


class GridPose(NamedTuple):
    """A pose: position in cells, heading in radians."""

    x: float
    y: float
    yaw: float


class SearchRules(NamedTuple):
    """Prices and limits of the search; lengths in cells (`planner.PlannerTuning`)."""

    max_iterations: int
    escape: float
    change_price: float
    turn_price: float
    """Price of one radian turned on the spot."""
    reverse_penalty: float
    curve_penalty: float
    closed_weight: float
    cost_to_go_weight: float


class _Nodes(NamedTuple):
    """Poses that the search has reached, (N,) each."""

    place: NDArray[np.float64]
    """(N, 2) positions in cells."""
    heading: NDArray[np.int32]
    parent: NDArray[np.int32]
    """Node before this one; -1 for the start."""
    drive: NDArray[np.int8]
    """Motion that reached the node: FORWARD, BACKWARD or TURN."""
    price: NDArray[np.float32]
    overlap: NDArray[np.int32]
    """Number of the body's points on lethal cells."""


FORWARD, BACKWARD, TURN = 0, 1, 2
ROOM = 4096
"""Nodes for which the search reserves memory at first."""
TURNS = np.array([0, 1, -1, 2, -2, 1, -1, 0, 1, -1])
"""Change of heading of each primitive, in bins."""
LENGTHS = np.array([3.0, 3.0, 3.0, 3.0, 3.0, 0.0, 0.0, -3.0, -3.0, -3.0])
"""Signed length of each primitive in cells; 0 turns on the spot."""


@njit(cache=True)
def cell_weights(
    costs: NDArray[np.uint8],
    near: NDArray[np.uint8],
    unknown: float,
    cost_penalty: float,
    tight: tuple[int, float],
    retrospective_gain: float,
) -> NDArray[np.float32]:
    """Return the cost (H, W) of one cell length in each cell; 0 where the robot's centre may not go.

    Args:
        costs: the costmap, (H, W).
        near: mask (H, W) of the previous path.
        unknown: cost of one cell length in unseen cells.
        cost_penalty: extra price of a cell length at cost 252.
        tight: cost above which the robot cannot turn on the spot, and the additional price at cost 252.
        retrospective_gain: discount along the previous path.
    """
    tight_cost, tight_penalty = tight
    weights = np.empty(costs.shape, dtype=np.float32)
    for r in range(costs.shape[0]):
        for c in range(costs.shape[1]):
            cost = costs[r, c]
            weight = 0.0
            if cost == 255:
                weight = unknown
            elif cost < 253:
                weight = 1.0 + cost_penalty * cost / 252.0
                if cost > tight_cost:
                    weight += tight_penalty * (cost - tight_cost) / (252.0 - tight_cost)
            weights[r, c] = weight * (1.0 - retrospective_gain if near[r, c] else 1.0)
    return weights


@njit(cache=True)
def cost_to_go(
    costs: NDArray[np.uint8],
    weights: NDArray[np.float32],
    goal: tuple[int, int],
    start: tuple[int, int],
    escape: float,
    least_weight: float,
    closed_weight: float,
) -> NDArray[np.float32]:
    """Return the cost in cells (H, W) of a point robot's way to a goal (row, column), by Dijkstra's method.

    Only cells on likely ways to the start get a cost: those whose cost plus straight distance to the start is little
    more than the cost of the best way (A*). All others are inf. Closed cells near the start get ``closed_weight``,
    because the robot may stand there: inscribed cells within ``escape`` cells, lethal ones within a quarter of that.
    ``least_weight`` is the lower bound of ``weights``, the cost of one cell length, (H, W).
    """
    start_row, start_column = start
    row, column = goal
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
                    weight = np.float32(closed_weight)
                new = best[r, c] + weight * np.float32(1.4142135 if dr != 0 and dc != 0 else 1.0)
                if new < best[y, x]:
                    best[y, x] = new
                    ahead = least_weight * math.hypot(y - start_row, x - start_column)
                    heapq.heappush(queue, (float(new + ahead), y * width + x))
    return best


@njit(cache=True)
def _overlap(
    costs: NDArray[np.uint8], clearance: NDArray[np.float32], x: float, y: float, body: NDArray[np.float64]
) -> int:
    """Count the points of a rotated ``body`` on lethal cells; its centre is at (x, y) in cells.

    The points are sorted farthest first, so that those nearer than the nearest lethal cell are skipped.
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
def _line_cost(grid: GridMap, ax: float, ay: float, bx: float, by: float, yaw: float, dearest: float) -> float:
    """Return the cost in cells of a straight way from a to b at a heading.

    The cost is inf if the footprint meets an obstacle, or if a cell costs more than ``dearest``.
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
def _turn_is_free(grid: GridMap, x: float, y: float, yaw: float, turn: float) -> bool:
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
    """Return the same nodes in arrays of twice the size."""
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
def search(
    grid: GridMap, to_go: NDArray[np.float32], start: GridPose, goal: GridPose, rules: SearchRules
) -> tuple[NDArray[np.float64], bool, int]:
    """Search by hybrid A*. Headings are bins, positions are continuous; one pose is kept per cell and heading.

    ``to_go`` is the point robot's cost-to-go in cells, (H, W). A goal whose yaw is nan may be reached at any heading.
    Returns poses (N, 4) in cells and radians, the fourth column 1 where the robot drives backwards; whether they reach
    the goal; and the number of poses expanded.
    """
    nodes, best, closed = _begin(grid, start)
    bins, height, width = best.shape
    per_bin = 2.0 * math.pi / bins
    count, opened = 1, 0
    queue = [(rules.cost_to_go_weight * float(to_go[math.floor(start.y), math.floor(start.x)]), 0)]
    # The goal is one more node, reached from any node by a turn, a straight line and a turn.
    goal_price, goal_parent, goal_backwards = np.inf, -1, 0
    nearest, nearest_to_go = 0, np.float32(np.inf)
    while len(queue) > 0 and opened < rules.max_iterations:
        f, node = heapq.heappop(queue)
        if f >= goal_price:
            break
        x, y, heading = nodes.place[node, 0], nodes.place[node, 1], nodes.heading[node]
        row, column = math.floor(y), math.floor(x)
        if closed[heading, row, column]:
            continue
        closed[heading, row, column] = True
        opened += 1
        left = to_go[row, column]
        if left < nearest_to_go and (grid.costs[row, column] != 255):
            nearest, nearest_to_go = node, left
        total, backwards = _straight_to_goal(grid, nodes, node, goal, rules, opened, left, goal_price)
        if total < goal_price:
            goal_price, goal_parent, goal_backwards = total, node, backwards
        for k in range(len(TURNS)):
            new_x, new_y = _moved(x, y, heading, k, per_bin)
            c, r = math.floor(new_x), math.floor(new_y)
            if c < 0 or r < 0 or c >= width or r >= height or not np.isfinite(to_go[r, c]):
                continue
            other = (heading + TURNS[k]) % bins
            weight = grid.weights[r, c]
            if closed[other, r, c] or (weight == 0.0 and nodes.overlap[node] == 0 and grid.costs[row, column] < 253):
                continue  # the robot may leave closed cells, but never enter them
            weight = weight if weight != 0.0 else np.float32(rules.closed_weight)
            new = nodes.price[node] + _step_price(k, weight, nodes.drive[node], per_bin, rules)
            if new >= best[other, r, c] - 1e-4:
                continue
            touching = 0
            if grid.clearance[r, c] <= grid.reach:
                touching = _touching(grid, nodes, node, k, new_x, new_y, start, rules.escape)
                if touching < 0:
                    continue
                new += 2.0 * touching / grid.body.shape[0] * 100.0
            best[other, r, c] = new
            if count == len(nodes.price):
                nodes = _doubled(nodes)
            _set_node(nodes, count, new_x, new_y, other, node, _drive_of(k), new, touching)
            heapq.heappush(queue, (float(new + rules.cost_to_go_weight * to_go[r, c]), count))
            count += 1
    found = goal_parent >= 0
    return _path_to(nodes, goal_parent if found else nearest, bins, start, goal, found, goal_backwards), found, opened


@njit(cache=True)
def _begin(grid: GridMap, start: GridPose) -> tuple[_Nodes, NDArray[np.float32], NDArray[np.bool_]]:
    """Return the nodes with the start as node 0, and for each heading and cell the lowest price and a closed flag."""
    height, width = grid.costs.shape
    bins = grid.bodies.shape[0]
    first = math.floor(start.yaw / (2.0 * math.pi / bins) + 0.5) % bins
    best = np.full((bins, height, width), np.inf, dtype=np.float32)
    best[first, math.floor(start.y), math.floor(start.x)] = 0.0
    nodes = _new_nodes(ROOM)
    overlap = _overlap(grid.costs, grid.clearance, start.x, start.y, grid.bodies[first])
    _set_node(nodes, 0, start.x, start.y, first, -1, TURN, 0.0, overlap)
    return nodes, best, np.zeros((bins, height, width), dtype=np.bool_)


@njit(cache=True)
def _straight_to_goal(
    grid: GridMap,
    nodes: _Nodes,
    node: int,
    goal: GridPose,
    rules: SearchRules,
    opened: int,
    left: float,
    goal_price: float,
) -> tuple[float, int]:
    """Try the straight way to the goal, always when near and sometimes from far.

    ``opened`` is the number of poses expanded, ``left`` the point robot's cost-to-go. Returns ``goal_price``, or the
    price of this way if that is lower, and 1 if the way is driven backwards.
    """
    backwards = 0
    away = math.hypot(goal.x - nodes.place[node, 0], goal.y - nodes.place[node, 1])
    if nodes.overlap[node] == 0 and (away < 20.0 or opened % max(1, int(away / 12.0)) == 0):
        for way in range(2 if 0.2 < away < 20.0 else 1):
            total = _price_to_goal(grid, nodes, node, goal, rules, way, left, goal_price)
            if total < goal_price:
                goal_price, backwards = total, way
    return goal_price, backwards


@njit(cache=True)
def _drive_of(k: int) -> int:
    """Return the motion of primitive ``k``: FORWARD, BACKWARD or TURN."""
    if LENGTHS[k] == 0.0:
        return TURN
    return BACKWARD if LENGTHS[k] < 0.0 else FORWARD


@njit(cache=True)
def _moved(x: float, y: float, heading: int, k: int, per_bin: float) -> tuple[float, float]:
    """Return the position at the end of primitive ``k``, from a position and a heading."""
    length = LENGTHS[k]
    if length == 0.0:
        return x, y
    to_x, to_y, _ = _along_arc(x, y, heading * per_bin, length, TURNS[k] * per_bin)
    return to_x, to_y


@njit(cache=True)
def _step_price(k: int, weight: float, before: int, per_bin: float, rules: SearchRules) -> float:
    """Return the price of primitive ``k`` into a cell of ``weight``, after the motion ``before``."""
    drive = _drive_of(k)
    if drive == TURN:
        return rules.turn_price * per_bin * weight
    price = abs(LENGTHS[k]) * weight * (rules.curve_penalty if TURNS[k] != 0 else 1.0)
    if drive == BACKWARD:
        price *= rules.reverse_penalty
    if before != TURN and before != drive:
        price += rules.change_price
    return price


@njit(cache=True)
def _touching(
    grid: GridMap, nodes: _Nodes, node: int, k: int, x: float, y: float, start: GridPose, escape: float
) -> int:
    """Count the body's points on lethal cells at the end (x, y) of primitive ``k``; -1 if that end is not allowed."""
    bins = grid.bodies.shape[0]
    heading, before = nodes.heading[node], nodes.overlap[node]
    touching = _overlap(grid.costs, grid.clearance, x, y, grid.bodies[(heading + TURNS[k]) % bins])
    if touching > 0:
        # Contact is allowed only if the robot stands on an obstacle already, so that it can leave.
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
    grid: GridMap,
    nodes: _Nodes,
    node: int,
    goal: GridPose,
    rules: SearchRules,
    backwards: int,
    left: float,
    most: float,
) -> float:
    """Return the price of the goal by a turn, a straight line and a turn; inf if not free or not below ``most``.

    ``left`` is the point robot's cost-to-go.
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
    share = rules.reverse_penalty if backwards else 1.0
    if total + share * away >= most or not _turn_is_free(grid, x, y, heading, turn):
        return np.inf
    line = _line_cost(grid, x, y, goal.x, goal.y, yaw, np.inf)
    # Beside a better line, the point robot's cost-to-go is no bound on the price.
    return total + share * line if line <= 1.05 * left + 3.0 else np.inf


@njit(cache=True)
def _path_to(
    nodes: _Nodes, end: int, bins: int, start: GridPose, goal: GridPose, found: bool, goal_backwards: int
) -> NDArray[np.float64]:
    """Return the poses (N, 4) from the start to node ``end``, and on to the goal if it was found."""
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
def smooth(grid: GridMap, nodes: NDArray[np.float64]) -> NDArray[np.float64]:
    """Replace runs of forward poses (N, 4) by straight lines that cost no more."""
    count = len(nodes)
    along = np.zeros(count)  # cost from the first node to each node
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
