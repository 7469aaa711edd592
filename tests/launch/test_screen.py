import io
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from rich.console import Console

from instant_ic.bus import RELIABLE
from instant_ic.bus.heartbeat import Flow, Heartbeat, from_message
from instant_ic.bus.local_transport import LocalTransport
from instant_ic.bus.registry import NodeInfo, prepare
from instant_ic.launch import NodeSpec
from instant_ic.launch.app import node_row, stack_view
from instant_ic.launch.health import HealthMonitor, TopicFault, console_address
from instant_ic.launch.node_table import NodeRow, TopicRow
from instant_ic.launch.process import ProcessState
from instant_ic.launch.screen import StackScreen, StackView
from instant_ic.msg import NodeStatus, header, serialize


@pytest.fixture
def out() -> io.StringIO:
    return io.StringIO()


@contextmanager
def screen_on(out: io.StringIO, live: bool, period_s: float = 0.0, verbose: bool = False) -> Iterator[StackScreen]:
    console = Console(file=out, width=120, force_terminal=live, color_system=None)
    screen = StackScreen(["slam", "page"], live, period_s, console, verbose)
    screen.start()
    try:
        yield screen
    finally:
        screen.stop()


def test_plain_lines_tell_what_is_waited_for(out: io.StringIO) -> None:
    with screen_on(out, live=False) as screen:
        screen.node_line("slam", "hello \x1b[31mred\x1b[0m")
        screen.refresh(StackView(looked=False, missing=("slam",)))  # nobody has listened yet: nothing to tell
        screen.refresh(StackView(missing=("slam", "page"), waiting=("map",)))
        screen.refresh(StackView(waiting=("map",)))
        screen.refresh(StackView(addresses={"console": "http://127.0.0.1:8080"}))
        screen.refresh(StackView(addresses={"console": "http://127.0.0.1:8080"}))
        screen.refresh(StackView(waiting=("map",), ending=True))
    lines = out.getvalue().splitlines()
    assert lines[0] == "  slam │ hello red"
    assert lines[1] == "launch │ 0 of 2 nodes are up, waiting for slam, page"
    assert lines[2].startswith("launch │ all 2 nodes are up after ")
    assert lines[3] == "launch │ waiting for map"
    assert lines[4] == "launch │ console: http://127.0.0.1:8080"
    assert lines[5].startswith("launch │ ready after ") and lines[5].endswith(": http://127.0.0.1:8080")
    assert len(lines) == 6  # said once, and nothing is waited for at the end


def test_plain_lines_tell_a_degraded_topic_once_and_its_recovery(out: io.StringIO) -> None:
    with screen_on(out, live=False) as screen:
        screen.refresh(StackView())
        screen.refresh(StackView(faults=("/pose of slam: 7.2 of 10 Hz", "/scan of lidar: stopped 3.0 s ago")))
        screen.refresh(StackView(faults=("/pose of slam: 7.9 of 10 Hz", "/scan of lidar: stopped 4.0 s ago")))
        screen.refresh(StackView(faults=("/pose of slam: 7.9 of 10 Hz",)))
        screen.refresh(StackView())
    assert out.getvalue().splitlines()[2:] == [
        "launch │ too slow: /pose of slam: 7.2 of 10 Hz, /scan of lidar: stopped 3.0 s ago",
        "launch │ back to the right rate: /scan of lidar",
        "launch │ back to the right rate: /pose of slam",
    ]


WARNED = "2026-03-04 12:00:00.000 WARNING slam: scan: 3 of 10 beams"


def test_a_nodes_warnings_are_shown_once_and_after_the_start_only(out: io.StringIO) -> None:
    with screen_on(out, live=False, period_s=60.0) as screen:
        screen.node_line("slam", "2026-03-04 12:00:00.000 INFO    slam: running")
        screen.node_line("slam", "2026-03-04 12:00:00.000 ERROR   slam: scan: none yet")
        screen.refresh(StackView((NodeRow("page", "degraded", "no camera"), NodeRow("slam", "running"))))
        screen.node_line("slam", WARNED)
        screen.node_line("slam", "  a line that belongs to it")
        screen.node_line("slam", WARNED.replace("3 of", "4 of").replace("12:", "13:"))
        screen.node_line("slam", "  a line that belongs to a line not shown")
        screen.node_line("slam", "2026-03-04 12:00:00.000 INFO    slam: running")
        screen.node_line("page", "Traceback (most recent call last):")
    lines = out.getvalue().splitlines()
    assert lines[1].startswith("launch │ ready after ")
    assert lines[2:] == [
        "launch │ page: no camera",
        f"  slam │ {WARNED[11:]}",
        "  slam │   a line that belongs to it",
        "  page │ Traceback (most recent call last):",
    ]


def test_warnings_of_a_start_that_does_not_end_are_shown(out: io.StringIO, monkeypatch: pytest.MonkeyPatch) -> None:
    with screen_on(out, live=False, period_s=60.0) as screen:
        screen.node_line("slam", WARNED)
        screen.refresh(StackView(missing=("page",)))
        assert out.getvalue() == ""
        later_s = time.monotonic() + 31.0
        monkeypatch.setattr(time, "monotonic", lambda: later_s)
        screen.refresh(StackView(missing=("page",)))
    assert out.getvalue().splitlines()[0] == f"  slam │ {WARNED[11:]}"


def test_table_of_nodes(out: io.StringIO) -> None:
    rows = (
        NodeRow("slam", "running", "", 12.3, 99.6, outputs=[TopicRow("/pose", 9.96, 0.1, 10.0)]),
        NodeRow("page", "silent", "", 1.0, 10.0, restarts=2, lost=7),
        NodeRow("gone", "failed", "hangs: no heartbeat for 10 s"),
        NodeRow("new", "starting"),
    )
    with screen_on(out, live=True) as screen:
        screen.refresh(StackView(rows, missing=("new",), pace="simulation at 0.6 of real time"))
    text = out.getvalue()
    assert " · simulation at 0.6 of real time · " in text
    found = {line.split()[0]: line.split()[1:] for line in text.splitlines() if line and line[0].isalpha()}
    assert found["slam"] == ["●", "running", "12", "100", "pose", "10.0/10"]
    assert found["page"] == ["●", "silent", "↻2", "1", "10", "7"]
    assert found["gone"] == ["●", "failed", "hangs:", "no", "heartbeat", "for", "10", "s"]
    assert found["new"] == ["◌", "starting"]
    assert found["waiting"][:2] == ["for", "new"]


def beat(node: str, state: int = 1, pid: int = 1, rate_hz: float = 10.0, age_s: float = 0.1) -> Any:
    empty, none = np.zeros(0, np.float32), np.zeros(0, np.uint64)
    return NodeStatus(
        header=header("", 5), node=node, pid=pid, state=state, message="all well", cpu_percent=3.0, rss_mb=4.0,
        inputs=[], input_rates_hz=empty, input_ages_s=empty, input_lost=none,
        lost_topics=[], lost_publishers=[], lost_counts=none,
        outputs=["/pose"], output_rates_hz=np.array([rate_hz], np.float32),
        output_ages_s=np.array([age_s], np.float32),
    )  # fmt: skip


@contextmanager
def listening(nodes: list[NodeSpec], run_dir: Path, *senders: tuple[Path, str]) -> Iterator[tuple[HealthMonitor, list]]:
    """A monitor, and a publisher of heartbeats for each folder and node."""
    transports = [LocalTransport(folder, name, lambda: 1) for folder, name in senders]
    monitor = HealthMonitor(nodes, run_dir)
    try:
        yield monitor, [t.advertise("/heartbeat", "instant_ic_msgs/msg/NodeStatus", RELIABLE) for t in transports]
    finally:
        for each in (monitor, *transports):
            each.close()


def hear(monitor: HealthMonitor, condition: Callable[[], object], send: Callable[[], object] = lambda: None) -> None:
    """Send until the subscription is connected and the monitor has heard it."""
    for _ in range(2000):
        send()
        monitor.poll()
        if condition():
            return
        time.sleep(0.01)
    raise AssertionError("nothing was heard")


def test_heartbeats_become_health(tmp_path: Path) -> None:
    nodes = [NodeSpec("my_slam", "grid_slam", ()), NodeSpec("other", "navigator", ())]
    wrong = beat("my_slam", pid=77)
    wrong.outputs = [*wrong.outputs, "/more"]
    with listening(nodes, tmp_path, (tmp_path, "my_slam")) as (monitor, [publisher]):
        assert monitor.nodes_missing() == ["my_slam", "other"] and monitor.waiting_for() == ["map"]

        def send() -> None:
            publisher.send(b"no CDR")  # wrong ones do not end the launcher
            publisher.send(serialize(wrong))

        hear(monitor, lambda: "my_slam" in monitor.nodes, send)
        health = monitor.nodes["my_slam"]
        assert (health.state, health.message, health.outputs["/pose"].rate_hz) == ("running", "all well", 10.0)
        assert "/more" not in health.outputs and not health.silent
        assert monitor.nodes_missing() == ["other"] and monitor.waiting_for() == []
        assert monitor.beat_s(nodes[0], 77) == health.seen_s
        assert monitor.beat_s(nodes[0], 78) is None  # of the process before
        assert monitor.beat_s(nodes[1], 77) is None


def test_fault_a_bridged_heartbeat_hides_that_a_node_hangs(tmp_path: Path) -> None:
    """A station's heartbeats come by the bridge: under a robot's name, and under ever new ones."""
    spec = NodeSpec("my_slam", "grid_slam", ())
    with listening([spec], tmp_path, (tmp_path, "host_bridge"), (tmp_path, "my_slam")) as (monitor, [bridge, own]):

        def send() -> None:
            for name in ("my_slam", "host_bridge", f"stranger{time.monotonic_ns()}"):
                bridge.send(serialize(beat(name, pid=5)))
            own.send(serialize(beat("my_slam", pid=77)))

        hear(monitor, lambda: {"my_slam", "host_bridge"} <= monitor.nodes.keys(), send)
        bridge.send(serialize(beat("my_slam", pid=5)))
        bridge.send(serialize(beat("host_bridge", pid=6)))
        hear(monitor, lambda: monitor.nodes["host_bridge"].pid == 6)
        assert monitor.beat_s(spec, 77) is not None
        assert monitor.nodes.keys() == {"my_slam", "host_bridge"}


def test_each_group_is_heard_in_its_own_run_directory(tmp_path: Path) -> None:
    left = tmp_path / "left"
    nodes = [NodeSpec("slam", "grid_slam", ()), NodeSpec("slam", "grid_slam", (), run_dir=left, group="left")]
    for folder in (tmp_path, left):
        prepare(folder)
    with listening(nodes, tmp_path, (left, "slam")) as (monitor, [publisher]):
        assert monitor.waiting_for() == ["map", "left/map"]
        hear(monitor, lambda: monitor.nodes, lambda: publisher.send(serialize(beat("slam"))))
        assert list(monitor.nodes) == ["left/slam"]
        assert monitor.nodes_missing() == ["slam"] and monitor.waiting_for() == ["map"]


def test_a_topic_that_flowed_and_slows_down_or_stops_is_a_fault_after_a_while(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    node = NodeSpec("my_slam", "grid_slam", ())
    monitor = HealthMonitor([node], tmp_path)
    now = [100.0]
    monkeypatch.setattr("instant_ic.launch.health.time.monotonic", lambda: now[0])

    def faults_after(seconds: float, rate_hz: float, age_s: float) -> list[str]:
        now[0] += seconds
        monitor.nodes["my_slam"] = from_message(beat("my_slam", rate_hz=rate_hz, age_s=age_s))
        return [fault.text for fault in monitor.topic_faults()]

    try:
        assert faults_after(0, 0.0, float("inf")) == []  # never came: that is what waiting_for() tells
        assert faults_after(60, 0.0, float("inf")) == []
        assert faults_after(1, 9.5, 0.1) == []
        assert faults_after(1, 8.0, 0.1) == []  # 8 of 10 Hz, but only just now
        assert faults_after(2, 8.0, 0.1) == []
        assert faults_after(1.5, 8.0, 0.1) == ["8.0 of 10 Hz"]
        assert faults_after(1, 1.0, 4.5) == ["stopped 4.5 s ago"]
        assert faults_after(1, 9.5, 0.1) == []
    finally:
        monitor.close()


@pytest.mark.parametrize(
    ("server", "address"),
    [
        ({"host": "127.0.0.1", "port": 8081}, "http://127.0.0.1:8081"),
        ({"host": "0.0.0.0", "port": 80}, "http://127.0.0.1:80"),
        ({"host": "10.1.1.1", "port": 80}, "http://10.1.1.1:80"),
        ({"host": "127.0.0.1", "port": 0}, ""),  # any free port: the console's log has it
    ],
)
def test_console_address(server: dict[str, object], address: str) -> None:
    assert console_address(NodeInfo("page", "m", 1, 0, {"server": server})) == address


def test_row_of_a_node_from_its_process_its_heartbeat_and_its_topics() -> None:
    process: Any = SimpleNamespace(
        spec=NodeSpec("lidar", "vlp16_driver", ()),
        state=ProcessState.RUNNING,
        limit=SimpleNamespace(retries=1),
        reason="",
        ending=False,
        started_s=50.0,
    )
    now_s = time.monotonic()
    rates = {"/heartbeat": 2.0, "/unknown": 3.0, "/lidar/points": 10.0, "/scan": 5.0, "/lidar/packets": 0.0}
    outputs = {topic: Flow(rate_hz, 0.0) for topic, rate_hz in rates.items()}
    health = Heartbeat("lidar", 1, "running", "", 7.0, 180.0, outputs=outputs, seen_s=now_s)
    monitor: Any = SimpleNamespace(nodes={"lidar": health})
    slow = TopicFault("lidar", "/scan", "5.0 of 10 Hz", stopped=False)
    row = node_row(process, monitor, [slow, TopicFault("other", "/pose", "stopped 3.0 s ago", stopped=True)])
    assert (row.state, row.restarts, row.message) == ("slow", 1, "")
    # Wrong ones first, then those whose rate is known.
    assert [output.topic for output in row.outputs] == ["/scan", "/lidar/packets", "/lidar/points", "/unknown"]
    assert row.outputs[0].fault == "5.0 of 10 Hz"
    stopped = node_row(process, monitor, [TopicFault("lidar", "/scan", "stopped 3.0 s ago", stopped=True)])
    assert (stopped.state, stopped.message) == ("slow", "scan stopped 3.0 s ago")
    process.started_s = now_s + 1.0  # started again: what its predecessor said counts no more
    assert node_row(process, monitor, []).state == "starting"
    process.ending, process.reason = True, "hangs: no heartbeat for 10 s"
    assert (node_row(process, monitor, []).state, node_row(process, monitor, []).message) == (
        "stopping",
        process.reason,
    )


def test_an_optional_node_that_has_ended_is_not_waited_for() -> None:
    recorder, slam = NodeSpec("recorder", "bag_recorder", ()), NodeSpec("slam", "grid_slam", (), respawn=True)
    monitor: Any = SimpleNamespace(
        nodes={},
        topic_faults=list,
        waiting_for=list,
        nodes_missing=lambda: ["recorder", "slam"],
        addresses=lambda with_token: {},
        publish=lambda down, faults: None,
    )
    processes: Any = [
        SimpleNamespace(spec=spec, state=ProcessState.FAILED, limit=SimpleNamespace(retries=0), reason="")
        for spec in (recorder, slam)
    ]
    assert stack_view(processes, monitor).missing == ("slam",)
