"""``ic top``: rows from heartbeats, processes and nominal rates; the live table on a real terminal."""

import io
import json
import math
import os
import pty
import re
import select
import signal
import subprocess
import sys
import time

import pytest
from cli_helpers import talking, wait_until
from rich.console import Console

from instant_ic.bus.heartbeat import Flow, Heartbeat
from instant_ic.bus.registry import NodeInfo
from instant_ic.cli.top import SORT_KEYS, Processes, as_json, make_rows, table
from instant_ic.launch.topics import expected_rate

NOW_NS = 100 * 10**9


def rows():
    infos = [
        NodeInfo(name, "m", pid, NOW_NS - 60 * 10**9, {}) for name, pid in (("slam", 11), ("lidar", 12), ("page", 13))
    ]
    seen_s = time.monotonic()
    flows = {"/map": Flow(0.0, math.inf), "/pose": Flow(4.0, 0.1), "/heartbeat": Flow(2.0, 0.1)}
    lost = {("/scan", "lidar"): 4, ("/tf", "base"): 1}
    slam = Heartbeat("slam", 11, "degraded", "", 30.0, 50.0, {"/scan": Flow(10.0, 0.1)}, flows, lost, seen_s)
    lidar = Heartbeat("lidar", 12, "running", "hot", 80.0, 70.0, {}, {"/scan": Flow(9.8, 0.1)}, {}, seen_s - 9)
    page = Heartbeat("page", 99, "running", "", 0.0, 0.0, {}, {}, {}, seen_s)  # of a process before this one
    known = {11: (math.nan, 51.0), 12: (85.0, 71.0), 13: (1.0, 20.0)}
    beats = {"slam": slam, "lidar": lidar, "page": page}
    return make_rows(infos, beats, known.__getitem__)


def test_rows():
    slam, lidar, page = rows()
    assert (slam.state, slam.cpu_percent, slam.rss_mb, slam.lost) == ("degraded", 30.0, 51.0, 5)
    assert slam.message == "/pose 4.0 of 10 Hz"
    assert [(topic.topic, topic.nominal_hz) for topic in slam.outputs] == [("/pose", 10)]
    assert (lidar.state, lidar.cpu_percent) == ("silent", 85.0) and "no heartbeat for " in lidar.message  # 9 s or more
    assert (page.state, page.message, page.outputs) == ("silent", "no heartbeat yet", [])


def test_orders():
    def order(key):
        return [row.node for row in sorted(rows(), key=SORT_KEYS[key])]

    assert order("cpu") == ["lidar", "slam", "page"] and order("memory") == ["lidar", "slam", "page"]
    assert order("name") == ["lidar", "page", "slam"] and order("lost")[0] == "slam"


def test_table_and_json():
    assert [row["cpu_percent"] for row in json.loads(json.dumps(as_json(rows()), allow_nan=False))] == [30.0, 85.0, 1.0]
    console = Console(file=io.StringIO(), width=200)
    console.print(table(rows(), "cpu"))
    lines = console.file.getvalue().splitlines()
    assert lines[0].startswith("3 nodes, 116 %") and lines[0].endswith("sorted by cpu")
    assert lines[3].split()[:6] == ["slam", "●", "degraded", "30", "51", "5"] and lines[3].rstrip().endswith(
        "pose 4.0/10"
    )


def test_nominal_rate_of_a_namespace():
    assert expected_rate("/scan").rate_hz == expected_rate("/robot_1/scan").rate_hz == 10
    assert expected_rate("/nonsense") is None


def test_processes():
    processes = Processes()
    cpu, memory = processes.look(os.getpid())
    assert math.isnan(cpu) and memory > 10
    while processes.look(os.getpid())[0] == 0.0:  # spends CPU until some is seen
        sum(range(100_000))
    child = subprocess.Popen([sys.executable, "-c", ""])
    child.wait()
    assert math.isnan(processes.look(child.pid)[1])


@pytest.fixture(scope="module")
def run_dir(tmp_path_factory):
    run_dir = tmp_path_factory.mktemp("r")
    with talking(run_dir):
        yield run_dir


def test_once_and_json(ic, run_dir, monkeypatch):
    monkeypatch.setenv("INSTANT_IC_RUN_DIR", str(run_dir))
    row_with_rate = r"talker +● running +\d+ +\d+ .*scan [\d.]+/10"
    wait_until(lambda: re.search(row_with_rate, ic("top", "--once")[1]), "a heartbeat with rates")
    row = json.loads(ic("top", "--json")[1])[0]
    assert row["node"] == "talker" and row["rss_mb"] > 10 and row["cpu_percent"] is not None


def test_nobody_runs(ic, tmp_path, monkeypatch):
    monkeypatch.setenv("INSTANT_IC_RUN_DIR", str(tmp_path))
    status, _, error = ic("top")
    assert status == 1 and "no node is running in" in error


def test_live_table_on_a_terminal(run_dir):
    """Drawn, sorted anew by a key, and left by q with the terminal as it was."""
    import fcntl
    import struct
    import termios

    master, slave = pty.openpty()
    fcntl.ioctl(slave, termios.TIOCSWINSZ, struct.pack("HHHH", 40, 150, 0, 0))
    before = termios.tcgetattr(slave)
    environment = {**os.environ, "INSTANT_IC_RUN_DIR": str(run_dir), "TERM": "xterm-256color"}
    process = subprocess.Popen(
        [sys.executable, "-m", "instant_ic.cli.main", "top", "-d", "0.2"],
        stdin=slave, stdout=slave, stderr=slave, env=environment,
    )  # fmt: skip
    seen = b""

    def until(words: bytes) -> None:
        nonlocal seen
        deadline_s = time.monotonic() + 40
        while words not in seen:
            assert time.monotonic() < deadline_s, seen[-2000:].decode(errors="replace")
            if select.select([master], [], [], 0.2)[0]:
                seen += os.read(master, 65536)

    try:
        until(b"talker")
        until(b"sorted by cpu")
        os.write(master, b"n")
        until(b"sorted by name")
        os.write(master, b"q")
        deadline_s = time.monotonic() + 20
        while process.poll() is None and time.monotonic() < deadline_s:
            if select.select([master], [], [], 0.1)[0]:
                seen += os.read(master, 65536)
        assert process.returncode == 0, seen[-2000:].decode(errors="replace")
        assert termios.tcgetattr(slave) == before
    finally:
        if process.poll() is None:
            process.send_signal(signal.SIGKILL)
        process.wait()
        os.close(master)
        os.close(slave)
