"""Layered drawing of a directed graph (Sugiyama's method): layers left to right, few crossings, short edges.

Steps: break cycles by reversing a few edges; assign layers by the longest path; give an edge over several layers a bend
in each; improve the order within the layers by medians; set the heights as close to the neighbours' as the minimum
distances allow.
"""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from itertools import pairwise

Edge = tuple[str, str]
Wire = tuple[str, str, str]
"""Source, target and kind. Wires with the same source and kind share their bends."""


@dataclass
class Layout:
    """Positions of the vertices and routes of the wires.

    Attributes:
        layer: vertex → index of its layer, from the left.
        order: layer → its vertices from top to bottom, including the bends of long wires (:func:`is_bend`).
        y: vertex → vertical position, downwards, in the unit of the given sizes.
        course: wire → the vertices on its route, from source to target.
    """

    layer: dict[str, int] = field(default_factory=dict)
    order: list[list[str]] = field(default_factory=list)
    y: dict[str, float] = field(default_factory=dict)
    course: dict[Wire, list[str]] = field(default_factory=dict)


def lay_out(wires: Sequence[Wire], height: Mapping[str, float], gap: float, sweeps: int = 24) -> Layout:
    """Compute the layout of a graph.

    Args:
        wires: without duplicates; source and target are vertices.
        height: vertex → its height; vertices without wires are placed too.
        gap: distance between two vertices of a layer.
        sweeps: number of sweeps that improve the order.
    """
    edges = list(dict.fromkeys((source, target) for source, target, _ in wires if source != target))
    layout = Layout(_layers(list(height), _open_cycles(list(height), edges)))
    links: list[Edge] = []
    for wire in wires:
        source, target, kind = wire
        first, last = layout.layer[source], layout.layer[target]
        step = 1 if last > first else -1
        # The direction is part of the name: wires of one kind may leave their source to both sides.
        bends = [f"\0{source} {kind} {step} {layer}" for layer in range(first + step, last, step)]
        for layer, bend in zip(range(first + step, last, step), bends, strict=True):
            layout.layer.setdefault(bend, layer)
        layout.course[wire] = [source, *bends, target]
        if source != target:
            links += [(a, b) if step > 0 else (b, a) for a, b in pairwise(layout.course[wire])]
    links = list(dict.fromkeys(links))
    layout.order = _order(layout.layer, links, sweeps)
    settle(layout, height, gap, {})
    return layout


def settle(layout: Layout, height: Mapping[str, float], gap: float, ports: Mapping[tuple[Wire, bool], float]) -> None:
    """Set the vertical positions for wires that join their vertices above or below the centre.

    Args:
        layout: its order is kept, its ``y`` is replaced.
        height: vertex → its height.
        gap: distance between two vertices of a layer.
        ports: (wire, True at its target) → offset of the joint below the centre of the vertex; default 0.
    """
    pulls: dict[Edge, tuple[float, float]] = {}
    for wire, course in layout.course.items():
        for number, pair in enumerate(pairwise(course)):
            below = ports.get((wire, False), 0.0) if number == 0 else 0.0
            end = ports.get((wire, True), 0.0) if number == len(course) - 2 else 0.0
            if pair[0] != pair[1]:
                pulls[pair] = (below, end)
    layout.y = _heights(layout.order, pulls, defaultdict(float, height), gap)


def is_bend(vertex: str) -> bool:
    """Whether a vertex of a layout is a bend of an edge."""
    return vertex.startswith("\0")


def _open_cycles(vertices: Sequence[str], edges: Sequence[Edge]) -> list[Edge]:
    """Edges, some reversed so that no cycle remains (greedy heuristic of Eades, Lin and Smyth, 1993)."""
    after: dict[str, set[str]] = {vertex: set() for vertex in vertices}
    before: dict[str, set[str]] = {vertex: set() for vertex in vertices}
    for source, target in edges:
        if source != target:
            after[source].add(target)
            before[target].add(source)
    left: list[str] = []
    right: list[str] = []
    remaining = list(vertices)
    while remaining:
        sink = next((v for v in remaining if not after[v]), None)
        start = next((v for v in remaining if not before[v]), None)
        if sink is not None:
            chosen = sink
            right.append(chosen)
        else:
            chosen = start if start is not None else max(remaining, key=lambda v: len(after[v]) - len(before[v]))
            left.append(chosen)
        remaining.remove(chosen)
        for other in after.pop(chosen):
            before[other].discard(chosen)
        for other in before.pop(chosen):
            after[other].discard(chosen)
    place = {vertex: number for number, vertex in enumerate([*left, *reversed(right)])}
    return [(s, t) if place[s] < place[t] else (t, s) for s, t in edges]


def _layers(vertices: Sequence[str], edges: Sequence[Edge]) -> dict[str, int]:
    """Assign layers by the longest path; then move a vertex with no more inputs than outputs next to a successor."""
    after: dict[str, list[str]] = defaultdict(list)
    before: dict[str, list[str]] = defaultdict(list)
    for source, target in edges:
        after[source].append(target)
        before[target].append(source)
    layer: dict[str, int] = {}

    def depth(vertex: str) -> int:
        if vertex not in layer:
            layer[vertex] = max((depth(other) + 1 for other in before[vertex]), default=0)
        return layer[vertex]

    for vertex in vertices:
        depth(vertex)
    for vertex in sorted(vertices, key=lambda v: -layer[v]):
        if after[vertex] and len(after[vertex]) >= len(before[vertex]):
            layer[vertex] = max(layer[vertex], min(layer[other] for other in after[vertex]) - 1)
    return layer


def _order(layer: Mapping[str, int], links: Sequence[Edge], sweeps: int) -> list[list[str]]:
    """Order the layers for few crossings: sweep both ways by the neighbours' medians and keep the best order."""
    neighbours: dict[str, dict[int, list[str]]] = defaultdict(lambda: {-1: [], 1: []})
    for source, target in links:
        neighbours[source][1].append(target)
        neighbours[target][-1].append(source)
    order: list[list[str]] = [[] for _ in range(max(layer.values(), default=-1) + 1)]
    for vertex, number in layer.items():
        order[number].append(vertex)
    best, fewest = [list(row) for row in order], _crossings(order, links, layer)
    for sweep in range(sweeps):
        side = -1 if sweep % 2 == 0 else 1
        rows = order if side == -1 else order[::-1]
        place = {v: i for row in order for i, v in enumerate(row)}
        for row in rows:
            keys = {}
            for vertex in row:
                places = sorted(place[other] for other in neighbours[vertex][side])
                middle = len(places) // 2
                median = (places[middle] + places[~middle]) / 2 if places else place[vertex]
                mean = sum(places) / len(places) if places else place[vertex]
                keys[vertex] = (median if sweep % 4 < 2 else mean, place[vertex])
            row.sort(key=lambda vertex: keys[vertex])
            place.update({vertex: i for i, vertex in enumerate(row)})
        crossings = _crossings(order, links, layer)
        if crossings < fewest:
            best, fewest = [list(row) for row in order], crossings
    return _swap(best, links, layer, neighbours)


def _swap(
    order: list[list[str]],
    links: Sequence[Edge],
    layer: Mapping[str, int],
    neighbours: Mapping[str, dict[int, list[str]]],
) -> list[list[str]]:
    """Swap neighbours within a layer as long as a swap removes crossings."""
    place = {v: i for row in order for i, v in enumerate(row)}

    def crossed(upper: str, lower: str) -> int:
        """Number of crossings that swapping two neighbours would remove."""
        count = 0
        for side in (-1, 1):
            for a in neighbours[upper][side]:
                for b in neighbours[lower][side]:
                    count += (place[a] > place[b]) - (place[a] < place[b])
        return count

    improved = True
    rounds = 0
    while improved and rounds < 50:
        improved, rounds = False, rounds + 1
        for row in order:
            for i in range(len(row) - 1):
                if crossed(row[i], row[i + 1]) > 0:
                    row[i], row[i + 1] = row[i + 1], row[i]
                    place[row[i]], place[row[i + 1]] = i, i + 1
                    improved = True
    return order


def _crossings(order: Sequence[Sequence[str]], links: Sequence[Edge], layer: Mapping[str, int]) -> int:
    place = {vertex: i for row in order for i, vertex in enumerate(row)}
    between: dict[int, list[tuple[int, int]]] = defaultdict(list)
    for source, target in links:
        between[layer[source]].append((place[source], place[target]))
    total = 0
    for pairs in between.values():
        pairs.sort()
        total += sum(a[1] > b[1] for i, a in enumerate(pairs) for b in pairs[i + 1 :] if a[0] < b[0])
    return total


def _heights(
    order: Sequence[Sequence[str]],
    pulls: Mapping[Edge, tuple[float, float]],
    height: Mapping[str, float],
    gap: float,
    rounds: int = 40,
) -> dict[str, float]:
    """Vertical positions as close to the neighbours' as the minimum distances allow."""
    neighbours: dict[str, list[tuple[str, float]]] = defaultdict(list)
    for (source, target), (below, end) in pulls.items():
        # Two consecutive bends are the straight middle of a wire: they attract each other more than a vertex.
        times = 4 if is_bend(source) and is_bend(target) else 1
        neighbours[source] += [(target, end - below)] * times
        neighbours[target] += [(source, below - end)] * times
    apart = {
        (a, b): (height[a] + height[b]) / 2 + (gap / 2 if is_bend(a) and is_bend(b) else gap)
        for row in order
        for a, b in pairwise(row)
    }
    y: dict[str, float] = {}
    for row in order:
        places = [0.0]
        for pair in pairwise(row):
            places.append(places[-1] + apart[pair])
        y.update({vertex: place - places[-1] / 2 for vertex, place in zip(row, places, strict=False)})
    for number in range(rounds):
        for row in order if number % 2 == 0 else order[::-1]:
            wanted = [
                sum(y[other] + shift for other, shift in neighbours[v]) / len(neighbours[v]) if neighbours[v] else y[v]
                for v in row
            ]
            y.update(zip(row, nearest(wanted, [apart[pair] for pair in pairwise(row)]), strict=True))
    return y


def nearest(wanted: Sequence[float], apart: Sequence[float]) -> list[float]:
    """Ascending numbers, at least ``apart`` from each other, with the least squared distance to those wanted.

    Without the minimum distances this is isotonic regression, solved by pooling adjacent violators. The distances are
    subtracted first and added back at the end.

    Args:
        wanted: (n,) preferred values.
        apart: (n - 1,) minimum distance between each value and the next.
    """
    shift = [0.0] if wanted else []
    for distance in apart:
        shift.append(shift[-1] + distance)
    pools: list[tuple[float, int]] = []  # mean and size of each pool
    for value, moved in zip(wanted, shift, strict=True):
        mean, count = value - moved, 1
        while pools and pools[-1][0] > mean:
            other, number = pools.pop()
            mean, count = (mean * count + other * number) / (count + number), count + number
        pools.append((mean, count))
    flat = [mean for mean, count in pools for _ in range(count)]
    return [value + moved for value, moved in zip(flat, shift, strict=True)]
