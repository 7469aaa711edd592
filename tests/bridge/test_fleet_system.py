"""launch/fleet.yaml: three robots and a station, each in a run directory of its own, joined by Zenoh alone."""

import contextlib
import shutil
import tempfile
import time
from pathlib import Path

import numpy as np
import psutil
import pytest

from instant_ic.bus import LATCHED, SENSOR
from instant_ic.bus.registry import list_topics
from instant_ic.experiments.stack import Stack, free_port, free_ports, observer
from instant_ic.geometry.poses import pose2_from_matrix
from instant_ic.launch.pacing import machine_pace
from instant_ic.msg import ControlState, Odometry, TwistStamped, matrix_from_pose, twist_stamped
from instant_ic.util.pace import read as read_pace

pytest.importorskip("zenoh")
pytestmark = [pytest.mark.system, pytest.mark.xdist_group("stack"), pytest.mark.timeout(900)]
ROBOTS = ("robot1", "robot2", "robot3")
START_S = 400.0  # 30 processes on two cores, the first time with kernels to compile


class Fleet:
    """What happened: filled by one run, asked by the tests."""

    station_topics: set[str]
    moved_m: dict[str, float]
    speed_at_end: float
    exit_status: int
    left_processes: list[str]
    left_sockets: list[Path]
    log: str


def drive_robot2(stack, station, robots):
    """Drives robot2 by the station's /operator/cmd_vel and gives how far each robot went, and robot2's last speed."""
    truth = {}
    for name, node in robots.items():
        truth[name] = []
        node.subscribe("/ground_truth/odom", Odometry, truth[name].append, SENSOR)
    states = []
    station.subscribe("/ic/state", ControlState, states.append, LATCHED)

    def spin():
        station.spin_once()
        for node in robots.values():
            node.spin_once()
        return True

    def place(name):
        return pose2_from_matrix(matrix_from_pose(truth[name][-1]))[:2]

    stack.wait_for(lambda: spin() and all(truth.values()), START_S, "ground truth of every robot")
    stack.wait_for(lambda: spin() and states and states[-1].mode == ControlState.REAL, START_S, "robot2 in real mode")
    start = {name: place(name) for name in ROBOTS}
    out = station.publisher("/operator/cmd_vel", TwistStamped, SENSOR)
    pace = read_pace(stack.run_dir)

    def driven():
        spin()
        out.publish(twist_stamped(0.3, 0.0, pace.now_ns()))
        time.sleep(0.04)
        return np.linalg.norm(place("robot2") - start["robot2"]) > 0.4

    stack.wait_for(driven, 90, "0.4 m of robot2")
    # Now silence, as when the station's machine loses power: no zero command is sent.
    stack.wait_for(lambda: spin() and abs(truth["robot2"][-1].twist.twist.linear.x) < 0.01, 10, "robot2's stop")
    return {name: float(np.linalg.norm(place(name) - start[name])) for name in ROBOTS}


@pytest.fixture(scope="module")
def fleet():
    run_dir = Path(tempfile.mkdtemp(prefix="ic-"))
    arguments = {**free_ports(), "router_port": free_port(), "headless": True, "robot": "robot2"}
    result = Fleet()
    try:
        with contextlib.ExitStack() as stack_of:
            stack = stack_of.enter_context(Stack("fleet.yaml", run_dir, arguments, pace=machine_pace()))
            result.station_topics = set()

            def seen():
                result.station_topics = {info.topic for info in list_topics(run_dir / "station")}
                wanted = {f"/{name}/{topic}" for name in ROBOTS for topic in ("ic/state", "pose", "battery")}
                return wanted | {"/scan", "/map", "/tf", "/ic/state"} <= result.station_topics

            stack.wait_for(seen, START_S, "the robots' topics at the station")
            station = stack_of.enter_context(observer(run_dir / "station"))
            robots = {name: stack_of.enter_context(observer(run_dir / name)) for name in ROBOTS}
            result.moved_m = drive_robot2(stack, station, robots)
            children = psutil.Process(stack.process.pid).children(recursive=True)
            result.exit_status = stack.stop(30)
            result.left_processes = [p.name() for p in children if p.is_running()]
            observers = {"observer.sock"}
            result.left_sockets = [p for p in run_dir.glob("*/topics/*/*.sock") if p.name not in observers]
            result.log = stack.log_path.read_text(errors="replace")
        yield result
    finally:
        shutil.rmtree(run_dir, ignore_errors=True)


def test_station_sees_every_robot_under_its_name_and_the_chosen_one_as_its_own(fleet):
    for robot in ROBOTS:
        assert {f"/{robot}/ic/state", f"/{robot}/pose", f"/{robot}/battery"} <= fleet.station_topics
    assert {"/camera/image/compressed", "/scan", "/map", "/tf", "/tf_static", "/ic/state"} <= fleet.station_topics
    # Nothing of the other robots comes in by the chosen one's names, and no ground truth leaves a robot.
    assert not any("ground_truth" in topic for topic in fleet.station_topics)


def test_a_command_moves_the_chosen_robot_alone_and_its_silence_stops_it(fleet):
    assert fleet.moved_m["robot2"] > 0.4
    assert fleet.moved_m["robot1"] < 0.02
    assert fleet.moved_m["robot3"] < 0.02


def test_fleet_ends_cleanly(fleet):
    assert fleet.exit_status == 0
    assert fleet.left_processes == []
    assert fleet.left_sockets == []
    assert "Traceback" not in fleet.log
