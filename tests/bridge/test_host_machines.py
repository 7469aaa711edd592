"""Robot and station as two machines: two network namespaces, a cable of 20 ± 5 ms with losses, real launch files."""

import shutil
import tempfile
import time
from pathlib import Path

import numpy as np
import pytest

from instant_ic.bus import LATCHED, RELIABLE, registry
from instant_ic.evaluation.stack import processes_of
from instant_ic.evaluation.two_machines import Hand, TwoMachines, missing
from instant_ic.msg import CompressedImage, ControlState, DiagnosticArray, OccupancyGrid, Odometry, stamp_ns

pytestmark = [
    pytest.mark.system,
    pytest.mark.xdist_group("stack"),
    pytest.mark.timeout(600),
    pytest.mark.skipif(bool(missing()), reason=missing() or "-"),
]


class Diagnoses:
    """The newest diagnoses on a stack's bus: name -> words."""

    def __init__(self, stack):
        self.words, self.values = {}, {}
        stack.observer.subscribe("/diagnostics", DiagnosticArray, self._take, RELIABLE)

    def _take(self, message):
        for status in message.status:
            self.words[status.name] = status.message
            self.values[status.name] = {v.key: v.value for v in status.values}


@pytest.fixture(scope="module")
def machines():
    folder = Path(tempfile.mkdtemp(prefix="ic2"))
    try:
        with TwoMachines(folder, delay_ms=20, jitter_ms=5, loss=0.005) as machines:
            yield machines
            assert [p.pid for host in ("robot", "station") for p in processes_of(machines.run_dir(host))] == []
    finally:
        shutil.rmtree(folder, ignore_errors=True)


def test_the_operator_drives_a_robot_on_another_machine_and_a_cut_cable_stops_it(machines):
    params = Path(__file__).with_name("busy_machine.yaml")
    with (
        machines.robot(params=params) as robot,
        machines.station(depth=False, vspace=False, console_port=8080) as station,
    ):
        speeds, states = robot.collect("/wheel/odom", Odometry), robot.collect("/ic/state", ControlState, LATCHED)
        truth = robot.collect("/ground_truth/odom", Odometry)
        pictures = station.collect("/camera/image/compressed", CompressedImage)
        maps = station.collect("/map", OccupancyGrid, LATCHED)
        seen, told = Diagnoses(station), Diagnoses(robot)
        hand = Hand(station)

        def both(condition, timeout_s, what):
            def look():
                robot.observer.spin_once()
                return condition()

            return station.wait_for(look, timeout_s, what)

        # What the operator needs comes over: picture, state, poses, map, in the console's own judgement.
        both(lambda: pictures and maps, 180, "picture and map at the station")
        for name in ("camera", "controller", "pose"):
            both(lambda name=name: seen.words.get(f"console: {name}") == "", 120, f"console that misses no {name}")
        age_s = (time.time_ns() - stamp_ns(pictures[-1])) / 1e9
        assert bytes(pictures[-1].data[:2]) == b"\xff\xd8" and age_s < 5.0

        # The command moves the robot.
        both(lambda: states and states[-1].mode == ControlState.REAL, 120, "a robot that may drive")
        start = position(truth[-1])
        hand.command = (0.25, 0.0)
        both(lambda: np.linalg.norm(position(truth[-1]) - start) > 0.3, 60, "motion")
        both(lambda: speed(speeds) > 0.15, 60, "speed")  # no command older than 0.3 s is obeyed: a busy machine jerks

        # The cable is pulled: the robot stands, by itself.
        machines.cut()
        moved_s = cut_s = time.monotonic()

        def stands():
            nonlocal moved_s
            if any(abs(message.twist.twist.linear.x) > 0.01 for message in speeds):
                moved_s = time.monotonic()
            speeds.clear()
            return time.monotonic() - moved_s > 1.5

        both(stands, 30, "a robot that stands")
        assert moved_s - cut_s < 5.0  # 0.3 s and the way to brake (0.5 s); the machine may be busy
        both(lambda: "nothing heard" in told.words.get("host_bridge: link", ""), 30, "words at the robot")
        both(lambda: seen.words.get("host_bridge: link", "").startswith(("robot:", "tcp:")), 30, "words at the station")
        standing = position(truth[-1])

        # It stays there, and no command from before the cut moves it when the cable is back.
        hand.command = (0.0, 0.0)
        machines.mend()
        both(lambda: seen.words.get("host_bridge: link", "").startswith("linked with robot"), 60, "link")
        assert np.linalg.norm(position(truth[-1]) - standing) < 0.05
        count = len(pictures)
        both(lambda: len(pictures) > count + 3, 60, "pictures again")

        # And the operator drives on.
        both(lambda: states[-1].mode == ControlState.REAL, 120, "a robot that may drive")
        start = position(truth[-1])
        hand.command = (-0.25, 0.0)
        both(lambda: np.linalg.norm(position(truth[-1]) - start) > 0.2, 60, "motion after the cut")
        hand.let_go()
        offset_ms = float(seen.values["host_bridge: clock of robot"]["offset_ms"])
        rtt_ms = float(seen.values["host_bridge: clock of robot"]["rtt_ms"])
        assert (
            abs(offset_ms) < 15 and 25 < rtt_ms < 500
        )  # one machine has one clock; 2 x (20 ± 5) ms and a busy machine
        nodes = {info.name for info in registry.list_nodes(machines.run_dir("station"))}
        assert nodes == {"console", "host_bridge"}
        assert station.stop() == 0
        assert robot.stop() == 0
        for stack in (robot, station):
            assert "Traceback" not in stack.log_path.read_text(errors="replace")


def position(message):
    place = message.pose.pose.position
    return np.array([place.x, place.y])


def speed(messages):
    return messages[-1].twist.twist.linear.x if messages else 0.0
