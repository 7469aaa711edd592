"""The graph of nodes and topics as an image: a box per node, its topics as rows, wires between the rows."""

from __future__ import annotations

import itertools
from collections import defaultdict
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from instant_ic.cli.graph import StackGraph, dot, mermaid, rate_words
from instant_ic.cli.layered import Layout, Wire, is_bend, lay_out, settle

_STATE_COLOURS = {
    "": "#6b7685",
    "running": "#2c6fb0",
    "starting": "#b8860b",
    "degraded": "#c8640a",
    "failed": "#b02a2a",
    "silent": "#b02a2a",
    "stopping": "#6b7685",
}
_TEXT, _DIM, _RATE, _LOST, _BOX = "#1d2733", "#7a8694", "#2e7d4f", "#c62828", "#f7f9fb"
_WIRES = ("#4c78a8", "#b07a2a", "#3f8f6b", "#8a5fa8", "#a8554c", "#4f8fa0", "#7a7f35", "#95577f", "#5b6b8c", "#9a6a4f")
_FONT = "DejaVu Sans Mono"
_CHARACTER = 0.602  # width of a character of the font, in units of the font size
_NAME, _ROW, _SMALL = 11.0, 8.0, 6.8  # points
_HEAD, _LINE, _PAD = 21.0, 13.0, 6.0
_LAYER_GAP, _BOX_GAP = 64.0, 22.0


@dataclass
class _Box:
    """A node: its size, and its rows from top to bottom as (topic, is_output)."""

    width: float
    height: float
    rows: list[tuple[str, bool]] = field(default_factory=list)

    def row_y(self, topic: str, out: bool) -> float:
        """Vertical offset of a row's centre from the centre of the box, downwards."""
        return -self.height / 2 + _HEAD + _PAD / 2 + (self.rows.index((topic, out)) + 0.5) * _LINE


_FORMATS = ("svg", "png", "pdf", "dot", "mmd")


def write(graph: StackGraph, path: Path) -> None:
    """Write the graph as an image or text; the file suffix selects the format.

    Raises:
        ValueError: the suffix is not supported.
        OSError: the file cannot be written.
    """
    kind = path.suffix.lstrip(".").lower()
    if kind not in _FORMATS:
        raise ValueError(f"{path}: the name must end in one of {', '.join('.' + known for known in _FORMATS)}")
    if kind == "dot":
        path.write_text(dot(graph))
    elif kind == "mmd":
        path.write_text(mermaid(graph))
    else:
        draw(graph, path)


def draw(graph: StackGraph, path: Path) -> None:
    """Draw the graph with matplotlib, layers from left to right."""
    import matplotlib
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    boxes = {node: _box(graph, node) for node in graph.nodes}
    wires: list[Wire] = [
        (source, target, topic)
        for source, topic in graph.publishes
        for name, target in graph.subscribes
        if name == topic and target != source
    ]
    linked = {end for wire in wires for end in wire[:2]}
    heights = {node: box.height for node, box in boxes.items() if node in linked}
    layout = lay_out(wires, heights, _BOX_GAP)
    for _ in range(2):  # sort the rows by where their wires lead, then place the boxes by their rows
        _sort_rows(layout, boxes)
        settle(layout, heights, _BOX_GAP, _ports(layout, boxes))
    x, columns, total = _columns(layout, boxes)
    _place_alone(boxes, linked, layout, x)
    total = max([total, *(x[node] + box.width / 2 for node, box in boxes.items())])
    ends = {name: boxes[name].height / 2 if name in boxes else 0.0 for name in layout.y}
    top = min((layout.y[name] - half for name, half in ends.items()), default=0.0)
    bottom = max((layout.y[name] + half for name, half in ends.items()), default=0.0)
    margin = 18.0
    width, height = total + 2 * margin, bottom - top + 2 * margin + 16.0
    figure = Figure(figsize=(width / 72, height / 72), facecolor="white")
    FigureCanvasAgg(figure)
    axes = figure.add_axes((0, 0, 1, 1))
    axes.set_xlim(-margin, total + margin)
    axes.set_ylim(bottom + margin + 16.0, top - margin)
    axes.axis("off")
    colours = {topic: _WIRES[number % len(_WIRES)] for number, topic in enumerate(graph.topics)}
    _draw_wires(axes, graph, layout, boxes, x, columns, colours)
    for node, box in boxes.items():
        _draw_box(axes, graph, node, box, x[node], layout.y[node])
    if graph.hidden:
        words = f"not shown: {', '.join(graph.hidden)}"
        most = int(total / (_CHARACTER * _SMALL))
        text = words if len(words) <= most else words[: max(0, most - 3)] + "..."
        axes.text(0, bottom + margin + 6.0, text, fontsize=_SMALL, family=_FONT, color=_DIM)
    with matplotlib.rc_context({"svg.fonttype": "none"}):
        figure.savefig(path, dpi=144)


def _box(graph: StackGraph, node: str) -> _Box:
    rows = [(topic, False) for topic, name in graph.subscribes if name == node]
    rows += [(topic, True) for name, topic in graph.publishes if name == node]
    widest = max([len(topic) + len(_beside(graph, node, topic, out)) for topic, out in rows], default=0)
    width = max(_CHARACTER * _NAME * len(node), _CHARACTER * _ROW * (widest + 2)) + 22.0
    return _Box(width, _HEAD + len(rows) * _LINE + (_PAD if rows else 0.0), rows)


def _beside(graph: StackGraph, node: str, topic: str, out: bool) -> str:
    """Label beside a topic: its rate for an output, its losses for an input."""
    if out:
        return rate_words(graph.publishes[node, topic])
    lost = graph.subscribes[topic, node]
    return f"lost {lost}" if lost else ""


def _sort_rows(layout: Layout, boxes: dict[str, _Box]) -> None:
    """Sort the rows: inputs first, then outputs, each by the height of its wires' other ends."""
    leads: dict[tuple[str, str, bool], list[float]] = defaultdict(list)
    for (source, target, topic), course in layout.course.items():
        leads[source, topic, True].append(layout.y[course[1]])
        leads[target, topic, False].append(layout.y[course[-2]])
    for node, box in boxes.items():

        def key(row: tuple[str, bool], node: str = node) -> tuple[bool, float]:
            heights = leads.get((node, *row), [layout.y[node]])
            return row[1], sum(heights) / len(heights)

        box.rows.sort(key=key)


def _ports(layout: Layout, boxes: dict[str, _Box]) -> dict[tuple[Wire, bool], float]:
    ports = {}
    for wire in layout.course:
        source, target, topic = wire
        ports[wire, False] = boxes[source].row_y(topic, True)
        ports[wire, True] = boxes[target].row_y(topic, False)
    return ports


def _columns(layout: Layout, boxes: dict[str, _Box]) -> tuple[dict[str, float], dict[int, float], float]:
    """Horizontal centre of each box and bend, width of each layer, and total width."""
    x: dict[str, float] = {}
    widths: dict[int, float] = {}
    left = 0.0
    for number, row in enumerate(layout.order):
        widths[number] = max([boxes[n].width for n in row if not is_bend(n)], default=0.0)
        x.update(dict.fromkeys(row, left + widths[number] / 2))
        left += widths[number] + _LAYER_GAP
    return x, widths, max(left - _LAYER_GAP, 200.0)


def _place_alone(boxes: dict[str, _Box], linked: set[str], layout: Layout, x: dict[str, float]) -> None:
    """Place boxes without wires in lines below the others."""
    heights = [y + (boxes[name].height / 2 if name in boxes else 0.0) for name, y in layout.y.items()]
    bottom = max(heights, default=-_BOX_GAP) + _BOX_GAP
    left = 0.0
    for node, box in boxes.items():
        if node in linked:
            continue
        x[node], layout.y[node] = left + box.width / 2, bottom + box.height / 2
        left += box.width + _BOX_GAP


def _draw_box(axes: Any, graph: StackGraph, node: str, box: _Box, x: float, y: float) -> None:
    from matplotlib.patches import FancyBboxPatch

    colour = _STATE_COLOURS.get(graph.nodes[node], _STATE_COLOURS[""])
    left, top = x - box.width / 2, y - box.height / 2
    style = "round,pad=0,rounding_size=5"
    axes.add_patch(FancyBboxPatch((left, top), box.width, box.height, style, fc=_BOX, ec=colour, lw=1.3, zorder=3))
    axes.add_patch(FancyBboxPatch((left, top), box.width, _HEAD - 2, style, fc=colour, ec=colour, lw=1.3, zorder=4))
    place = {"va": "center_baseline", "family": _FONT, "zorder": 5}
    axes.text(x, top + (_HEAD - 2) / 2, node, fontsize=_NAME, weight="bold", color="white", ha="center", **place)
    for topic, out in box.rows:
        at = y + box.row_y(topic, out)
        beside = _beside(graph, node, topic, out)
        axes.text(left + 9, at, topic, fontsize=_ROW, color=_TEXT if out else "#55606e", ha="left", **place)
        axes.text(left + box.width - 9, at, beside, fontsize=_ROW, color=_RATE if out else _LOST, ha="right", **place)


def _draw_wires(
    axes: Any,
    graph: StackGraph,
    layout: Layout,
    boxes: dict[str, _Box],
    x: dict[str, float],
    columns: dict[int, float],
    colours: dict[str, str],
) -> None:
    """Draw each segment once, even where several wires of a topic share it: level in a layer, an S between layers."""
    drawn: set[tuple[Any, ...]] = set()
    for (source, target, topic), course in layout.course.items():
        lost = graph.subscribes.get((topic, target), 0)
        forward = layout.layer[target] > layout.layer[source]
        sign = 1.0 if forward else -1.0
        points = [(x[source] + sign * boxes[source].width / 2, layout.y[source] + boxes[source].row_y(topic, True))]
        for name in course[1:-1]:
            half = columns[layout.layer[name]] / 2
            points += [(x[name] - sign * half, layout.y[name]), (x[name] + sign * half, layout.y[name])]
        points.append(
            (x[target] - sign * boxes[target].width / 2, layout.y[target] + boxes[target].row_y(topic, False))
        )
        for number, (a, b) in enumerate(itertools.pairwise(points)):
            if (a, b, topic) not in drawn:
                drawn.add((a, b, topic))
                _draw_piece(axes, a, b, number % 2 == 1, colours[topic])
        _draw_end(axes, points[-1], sign, _LOST if lost else colours[topic])
        if (points[0], topic) not in drawn:
            drawn.add((points[0], topic))
            axes.plot(*points[0], marker="o", ms=4.2, mfc=colours[topic], mec="white", mew=0.6, zorder=6)


def _draw_piece(axes: Any, a: tuple[float, float], b: tuple[float, float], level: bool, colour: str) -> None:
    from matplotlib.patches import PathPatch
    from matplotlib.path import Path as Outline

    middle = (a[0] + b[0]) / 2
    if level:
        outline = Outline([a, b], [Outline.MOVETO, Outline.LINETO])
    else:
        curve = [Outline.MOVETO, *[Outline.CURVE4] * 3]
        outline = Outline([a, (middle, a[1]), (middle, b[1]), b], curve)
    axes.add_patch(PathPatch(outline, fc="none", ec=colour, lw=1.15, alpha=0.85, zorder=1))


def _draw_end(axes: Any, end: tuple[float, float], sign: float, colour: str) -> None:
    from matplotlib.patches import Polygon

    back = end[0] - sign * 6.5
    axes.add_patch(Polygon([end, (back, end[1] - 3.0), (back, end[1] + 3.0)], fc=colour, ec="none", zorder=6))
