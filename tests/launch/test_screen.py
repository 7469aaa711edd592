import io
import time
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from rich.console import Console

from instant_ic.bus import RELIABLE
from instant_ic.bus.registry import NodeInfo
from instant_ic.bus.zmq_transport import ZmqTransport
from instant_ic.launch import NodeSpec
from instant_ic.launch.health import HealthMonitor, NodeHealth, find_console
from instant_ic.launch.process import State
from instant_ic.launch.screen import Screen
from instant_ic.msg import NodeStatus, header, serialize


class Health:
    """What a monitor would say, set by hand."""

    def __init__(self) -> None:
        self.nodes: dict[str, NodeHealth] = {}
        self.missing = ["slam", "page"]
        self.waiting = ["map"]
        self.address: str | None = None

    def poll(self) -> None:
        pass

    def nodes_missing(self) -> list[str]:
        return self.missing

    def waiting_for(self) -> list[str]:
        return self.waiting

    def console_address(self) -> str | None:
        return self.address


def process(name: str, state: State = State.RUNNING) -> Any:
    return SimpleNamespace(spec=SimpleNamespace(name=name), state=state)


@pytest.fixture
def out() -> io.StringIO:
    return io.StringIO()


def screen_on(out: io.StringIO, live: bool, period_s: float = 0.0) -> Screen:
    console = Console(file=out, width=120, force_terminal=live, color_system=None)
    return Screen(["slam", "page"], live, period_s, console)


def test_plain_lines_tell_what_is_waited_for(out: io.StringIO) -> None:
    health = Health()
    with screen_on(out, live=False) as screen:
        screen.health = health  # type: ignore[assignment]
        screen.node_line("slam", "hello \x1b[31mred\x1b[0m")
        screen.refresh([])
        health.missing = []
        screen.refresh([])
        health.waiting, health.address = [], "http://127.0.0.1:8080"
        screen.refresh([])
        screen.refresh([])
        screen.ending = True
        health.waiting = ["map"]
        screen.refresh([])
    lines = out.getvalue().splitlines()
    assert lines[0] == "  slam | hello red"
    assert lines[1] == "launch | waiting for slam, page"
    assert lines[2].startswith("launch | all 2 nodes are up after ")
    assert lines[3] == "launch | waiting for map"
    assert lines[4] == "launch | console: http://127.0.0.1:8080"
    assert lines[5].startswith("launch | ready after ") and lines[5].endswith(": http://127.0.0.1:8080")
    assert len(lines) == 6  # said once, and nothing is waited for at the end


def test_table_of_nodes(out: io.StringIO) -> None:
    health = Health()
    rates = {"/pose": 9.96, "/heartbeat": 2.0, "/map": 0.0}
    health.nodes["slam"] = NodeHealth("running", "", 12.3, 99.6, rates, time.monotonic())
    health.nodes["page"] = NodeHealth("running", "", 1.0, 10.0, {}, time.monotonic() - 60)
    with screen_on(out, live=True) as screen:
        screen.health = health  # type: ignore[assignment]
        screen.refresh([process("slam"), process("page"), process("gone", State.FAILED), process("new")])
    text = out.getvalue()
    rows = {line.split()[0]: line.split()[1:] for line in text.splitlines() if line and line[0].isalpha()}
    assert rows["slam"] == ["running", "12", "100", "pose", "10.0"]
    assert rows["page"][0] == "silent"
    assert rows["gone"] == ["failed"] and rows["new"] == ["starting"]


def test_heartbeats_become_health(tmp_path: Path) -> None:
    nodes = [NodeSpec("my_slam", "grid_slam", ()), NodeSpec("other", "navigator", ())]
    transport = ZmqTransport(tmp_path, "test", lambda: 1)
    monitor = HealthMonitor(nodes, tmp_path)
    try:
        assert monitor.nodes_missing() == ["my_slam", "other"] and monitor.waiting_for() == ["map"]
        publisher = transport.advertise("/heartbeat", "instant_ic_msgs/msg/NodeStatus", RELIABLE)
        empty = np.zeros(0, np.float32)
        beat = NodeStatus(
            header=header("", 5),
            node="my_slam",
            pid=1,
            state=1,
            message="all well",
            cpu_percent=3.0,
            rss_mb=4.0,
            inputs=[],
            input_rates_hz=empty,
            input_ages_s=empty,
            input_lost=np.zeros(0, np.uint64),
            lost_topics=[],
            lost_publishers=[],
            lost_counts=np.zeros(0, np.uint64),
            outputs=["/pose"],
            output_rates_hz=np.array([10.0], np.float32),
        )
        for _ in range(2000):  # until the subscription is connected
            publisher.send(serialize(beat))
            monitor.poll()
            if "my_slam" in monitor.nodes:
                break
            time.sleep(0.01)
        health = monitor.nodes["my_slam"]
        assert (health.state, health.message, health.rates_hz) == ("running", "all well", {"/pose": 10.0})
        assert monitor.nodes_missing() == ["other"] and monitor.waiting_for() == []
        assert not health.silent
    finally:
        monitor.close()
        transport.close()


@pytest.mark.parametrize(
    ("server", "address"),
    [
        ({"host": "127.0.0.1", "port": 8081}, "http://127.0.0.1:8081"),
        ({"host": "0.0.0.0", "port": 80}, "http://127.0.0.1:80"),
        ({"host": "10.1.1.1", "port": 80}, "http://10.1.1.1:80"),
        ({"host": "127.0.0.1", "port": 0}, None),  # any free port: the console's log tells it
    ],
)
def test_console_address(server: dict[str, object], address: str | None) -> None:
    info = NodeInfo("page", "m", 1, 0, {"server": server})
    assert find_console([info], ["page"]) == address
    assert find_console([info], ["another"]) is None
