"""``ic graph``: the layered layout held to its rules, the texts, and the picture."""

import itertools
import random
import re
import xml.etree.ElementTree as ET

import pytest
from cli_helpers import talking, wait_until
from hypothesis import given, settings
from hypothesis import strategies as st

from instant_ic.bus.registry import NodeInfo
from instant_ic.cli.graph import StackGraph, dot, make_graph, mermaid, rate_words, tree
from instant_ic.cli.graph_picture import write
from instant_ic.cli.heartbeats import Flow, Heartbeat
from instant_ic.cli.layered import is_bend, lay_out, nearest


def test_nearest_numbers_with_distances():
    """By hand: 0, 0, 0 with distances 1 lie best at -1, 0, 1; what lies apart already stays."""
    assert nearest([0.0, 0.0, 0.0], [1.0, 1.0]) == pytest.approx([-1.0, 0.0, 1.0])
    assert nearest([0.0, 5.0], [1.0]) == [0.0, 5.0]
    assert nearest([5.0, 0.0, 9.0], [1.0, 1.0]) == pytest.approx([2.0, 3.0, 9.0])
    assert nearest([], []) == []


@given(st.lists(st.floats(-50, 50), min_size=1, max_size=8), st.data())
def test_nearest_keeps_the_distances_and_nothing_near_is_better(wanted, data):
    apart = data.draw(st.lists(st.floats(0, 5), min_size=len(wanted) - 1, max_size=len(wanted) - 1))
    found = nearest(wanted, apart)
    assert all(b - a >= d - 1e-9 for (a, b), d in zip(itertools.pairwise(found), apart, strict=True))

    def cost(values):
        return sum((v - w) ** 2 for v, w in zip(values, wanted, strict=True))

    # A convex problem: if no feasible step along random directions helps, it is the minimum.
    chance = random.Random(1)
    for _ in range(50):
        step = [v + chance.uniform(-0.01, 0.01) for v in found]
        if all(b - a >= d for (a, b), d in zip(itertools.pairwise(step), apart, strict=True)):
            assert cost(step) >= cost(found) - 1e-6


graphs = st.lists(st.tuples(st.integers(0, 7), st.integers(0, 7), st.integers(0, 3)), max_size=25)


@settings(max_examples=60, deadline=None)
@given(graphs)
def test_layout_of_any_graph(edges):
    """Every wire runs through neighbouring layers one way; nothing in a layer overlaps."""
    wires = list(dict.fromkeys((f"n{a}", f"n{b}", f"t{k}") for a, b, k in edges if a != b))
    height = {f"n{i}": 10.0 + i for i in range(8)}
    layout = lay_out(wires, height, 5.0)
    assert set(layout.course) == set(wires)
    for (source, target, _), course in layout.course.items():
        assert course[0] == source and course[-1] == target and all(is_bend(name) for name in course[1:-1])
        steps = {layout.layer[b] - layout.layer[a] for a, b in itertools.pairwise(course)}
        assert steps in ({1}, {-1})
    assert {name for row in layout.order for name in row} == set(layout.layer) == set(layout.y) | set()
    for row in layout.order:
        for a, b in itertools.pairwise(row):
            least = (height.get(a, 0.0) + height.get(b, 0.0)) / 2
            assert layout.y[b] - layout.y[a] >= least + 2.5 - 1e-6


def test_layout_without_cycles_runs_to_the_right_and_shares_bends():
    wires = [("a", "b", "x"), ("b", "c", "y"), ("c", "d", "y"), ("a", "d", "x"), ("a", "c", "x")]
    layout = lay_out(wires, dict.fromkeys("abcd", 10.0), 5.0)
    assert [layout.layer[v] for v in "abcd"] == [0, 1, 2, 3]
    # x runs from a to c and to d: one wire up to c's layer, not two.
    assert layout.course["a", "d", "x"][1] == layout.course["a", "c", "x"][1]


def test_layout_takes_crossings_out():
    """a→2, b→1 in the given order cross; exchanged they do not."""
    wires = [("a", "p", "t"), ("b", "q", "t"), ("p", "y", "t"), ("q", "x", "t")]
    layout = lay_out(wires, dict.fromkeys("abpqxy", 10.0), 5.0)
    upper = {name for name in "abpqxy" if layout.y[name] < 0}
    assert upper in ({"a", "p", "y"}, {"b", "q", "x"})


def infos():
    return [
        NodeInfo("lidar", "m", 1, 0, {}, {"/scan": "sensor_msgs/msg/LaserScan", "/rosout": "rcl_interfaces/msg/Log"}),
        NodeInfo(
            "slam", "m", 2, 0, {}, {"/map": "nav_msgs/msg/OccupancyGrid", "/tf": "tf2_msgs/msg/TFMessage"},
            {"/scan": "sensor_msgs/msg/LaserScan", "/clue": "std_msgs/msg/Bool"},
        ),
        NodeInfo("page", "m", 3, 0, {}, {}, {"/map": "any", "/tf": "tf2_msgs/msg/TFMessage"}),
    ]  # fmt: skip


def beats():
    import time

    now = time.monotonic()
    lidar = Heartbeat("lidar", 1, "running", "", 1.0, 1.0, {}, {"/scan": Flow(10.04, 0.1)}, seen_s=now)
    slam = Heartbeat(
        "slam", 2, "degraded", "lost", 1.0, 1.0, {}, {"/map": Flow(0.5, 1.0)}, {("/scan", "lidar"): 4}, now
    )
    return {"lidar": lidar, "slam": slam}


def test_graph_of_nodes():
    graph = make_graph(infos(), beats())
    assert graph.nodes == {"lidar": "running", "slam": "degraded", "page": ""}
    assert graph.topics == {"/map": "nav_msgs/msg/OccupancyGrid", "/scan": "sensor_msgs/msg/LaserScan"}
    assert graph.publishes == {("slam", "/map"): 0.5, ("lidar", "/scan"): 10.04}
    assert graph.subscribes == {("/map", "page"): 0, ("/scan", "slam"): 4}
    assert graph.hidden == ["/clue", "/rosout", "/tf"]
    assert set(make_graph(infos(), {}, transforms=True).topics) == {"/map", "/scan", "/tf"}
    assert set(make_graph(infos(), {}, show_all=True).topics) == {"/map", "/scan", "/tf", "/rosout", "/clue"}
    only = make_graph(infos(), {}, only=["lidar"])
    assert set(only.nodes) == {"lidar", "slam"} and set(only.topics) == {"/scan"}


def test_texts():
    graph = make_graph(infos(), beats())
    assert tree(graph) == (
        "lidar\n"
        "  └─ /scan [LaserScan] 10 Hz → slam (lost 4)\n"
        "slam  (degraded)\n"
        "  └─ /map [OccupancyGrid] 0.5 Hz → page\n"
        "page"
    )
    assert "/clue [std_msgs/msg/Bool] has no publisher → slam" in tree(make_graph(infos(), {}, show_all=True))
    text = dot(graph)
    assert '"lidar" -> "/scan" [label="10 Hz"];' in text and '"/scan" -> "slam" [label="lost 4", color=red];' in text
    text = mermaid(graph)
    assert text.startswith("flowchart LR\n") and '-->|"lost 4"|' in text and '(["/map"])' in text
    assert [rate_words(rate) for rate in (None, 0.0, 0.26, 9.4, 29.7)] == ["", "", "0.3 Hz", "9.4 Hz", "30 Hz"]


def test_picture(tmp_path):
    graph = make_graph(infos(), beats(), show_all=True)
    write(graph, tmp_path / "g.svg")
    root = ET.parse(tmp_path / "g.svg").getroot()
    texts = ["".join(node.itertext()) for node in root.iter("{http://www.w3.org/2000/svg}text")]
    assert {"lidar", "slam", "page", "/scan", "10 Hz", "lost 4"} <= set(texts)
    assert texts.count("/scan") == 2  # where it goes out and where it comes in
    write(graph, tmp_path / "g.png")
    data = (tmp_path / "g.png").read_bytes()
    assert data[:8] == b"\x89PNG\r\n\x1a\n" and int.from_bytes(data[16:20], "big") > 600
    with pytest.raises(ValueError, match=r"must end in one of \.svg"):
        write(graph, tmp_path / "g.gif")
    write(StackGraph({"alone": "running"}), tmp_path / "one.svg")
    assert "alone" in (tmp_path / "one.svg").read_text()


def test_verb(ic, tmp_path_factory, monkeypatch):
    run_dir = tmp_path_factory.mktemp("r")
    monkeypatch.setenv("INSTANT_IC_RUN_DIR", str(run_dir))
    status, _, error = ic("graph")
    assert status == 1 and "no node is running in" in error
    with talking(run_dir):
        flow = r"[├└]─ /scan \[LaserScan\] [\d.]+ Hz → no subscriber\n"
        wait_until(lambda: re.search(flow, ic("graph", "--all")[1]), "the first heartbeat with rates")
        status, out, _ = ic("graph", "--all")
        assert status == 0
        assert "/order [geometry_msgs/msg/TwistStamped] has no publisher → talker" in out
        assert "not shown: " in ic("graph", "talker")[1]
        status, out, _ = ic("graph", "-o", str(run_dir / "g.dot"))
        assert status == 0 and "1 nodes, 0 topics" in out
        assert ic("graph", "-o", str(run_dir / "g.gif"))[0] == 2
        assert "cannot be written" in ic("graph", "-o", str(run_dir / "none" / "g.dot"))[2]
        assert ic("graph", "nobody")[0] == 1
