"""``ic top``: rows from heartbeats and nominal rates; the live table on a real terminal."""

import math
import re
import time

import pytest
from cli_helpers import talking, wait_until

from instant_ic.bus.heartbeat import Flow, Heartbeat
from instant_ic.bus.registry import NodeInfo
from instant_ic.cli.top import SORT_KEYS, make_rows

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
    beats = {"slam": slam, "lidar": lidar, "page": page}
    return make_rows(infos, beats)


def test_rows():
    slam, lidar, page = rows()
    assert (slam.state, slam.cpu_percent, slam.rss_mb, slam.lost) == ("degraded", 30.0, 50.0, 5)
    assert slam.message == "/pose 4.0 of 10 Hz"
    assert [(topic.topic, topic.nominal_hz) for topic in slam.outputs] == [("/pose", 10)]
    assert lidar.state == "silent" and "no heartbeat for " in lidar.message  # 9 s or more
    assert (page.state, page.message, page.outputs) == ("silent", "no heartbeat yet", [])


def test_orders():
    def order(key):
        return [row.node for row in sorted(rows(), key=SORT_KEYS[key])]

    assert order("cpu")[0] == order("memory")[0] == order("lost")[0] == "slam"
    assert order("name") == ["lidar", "page", "slam"]


@pytest.fixture(scope="module")
def run_dir(tmp_path_factory):
    run_dir = tmp_path_factory.mktemp("r")
    with talking(run_dir):
        yield run_dir


def test_once(ic, run_dir, monkeypatch):
    monkeypatch.setenv("INSTANT_IC_RUN_DIR", str(run_dir))
    row_with_rate = r"talker +● running +\d+ +\d+ .*scan [\d.]+/10"
    wait_until(lambda: re.search(row_with_rate, ic("top", "--once")[1]), "a heartbeat with rates")


def test_nobody_runs(ic, tmp_path, monkeypatch):
    monkeypatch.setenv("INSTANT_IC_RUN_DIR", str(tmp_path))
    status, _, error = ic("top")
    assert status == 1 and "no node is running in" in error
