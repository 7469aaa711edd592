"""``ic graph``: the graph, its texts, and images rendered by Graphviz."""

import re
import shutil

import pytest
from cli_helpers import talking, wait_until

from instant_ic.bus.heartbeat import Flow, Heartbeat
from instant_ic.bus.registry import NodeInfo
from instant_ic.cli.graph import dot, make_graph, mermaid, rate_text, tree, write


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
    assert [rate_text(rate) for rate in (None, 0.0, 0.26, 9.4, 29.7)] == ["", "", "0.3 Hz", "9.4 Hz", "30 Hz"]


def test_files(tmp_path, monkeypatch):
    graph = make_graph(infos(), beats(), show_all=True)
    write(graph, tmp_path / "g.dot")
    assert (tmp_path / "g.dot").read_text() == dot(graph)
    write(graph, tmp_path / "g.mmd")
    assert (tmp_path / "g.mmd").read_text() == mermaid(graph)
    with pytest.raises(ValueError, match=r"must end in one of \.dot"):
        write(graph, tmp_path / "g.gif")
    programs = tmp_path / "bin"
    programs.mkdir()
    monkeypatch.setenv("PATH", str(programs))
    with pytest.raises(ValueError, match=r"apt install graphviz\)\. Or write .*g\.mmd"):
        write(graph, tmp_path / "g.svg")
    assert not (tmp_path / "g.svg").exists()
    program = programs / "dot"
    program.write_text('#!/bin/sh\necho "rendered $1"\n')
    program.chmod(0o755)
    write(graph, tmp_path / "g.svg")
    assert (tmp_path / "g.svg").read_text() == "rendered -Tsvg\n"
    program.write_text("#!/bin/sh\necho no such format >&2\nexit 1\n")
    with pytest.raises(ValueError, match="dot failed: no such format"):
        write(graph, tmp_path / "g.png")


@pytest.mark.skipif(shutil.which("dot") is None, reason="Graphviz is not installed")
def test_graphviz_accepts_the_text(tmp_path):
    write(make_graph(infos(), beats(), show_all=True), tmp_path / "g.svg")
    assert "lost 4" in (tmp_path / "g.svg").read_text()


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
        assert "No such file" in ic("graph", "-o", str(run_dir / "none" / "g.dot"))[2]
        assert ic("graph", "nobody")[0] == 1
