"""A simulated stack beside busy loops: it slows down instead of stopping."""

import os
import subprocess
import sys
import tempfile
from pathlib import Path

import pytest

from instant_ic.bus import LATCHED, SENSOR
from instant_ic.experiments.stack import Stack, free_ports
from instant_ic.msg import ControlState, Odometry, TwistStamped, stamp_ns, twist_stamped
from instant_ic.util import pace

pytestmark = [pytest.mark.system, pytest.mark.xdist_group("stack"), pytest.mark.timeout(900)]
ARGUMENTS = {"headless": True, "vspace": False, "world": "corridor-free"}
DRIVE_S = 5.0


@pytest.fixture
def busy_loops():
    loops = [subprocess.Popen([sys.executable, "-c", "while True: pass"]) for _ in range((os.cpu_count() or 1) + 1)]
    yield
    for loop in loops:
        loop.kill()
        loop.wait(30)


def test_a_busy_machine_slows_a_simulated_stack_and_stops_nothing(busy_loops):
    with (
        tempfile.TemporaryDirectory(prefix="ic-") as folder,
        Stack("sim.yaml", Path(folder), {**ARGUMENTS, **free_ports()}, pace=None) as stack,
    ):
        states = stack.collect("/ic/state", ControlState, LATCHED)
        truth = stack.collect("/ground_truth/odom", Odometry)
        out = stack.observer.publisher("/operator/cmd_vel", TwistStamped, qos=SENSOR)
        stack.wait_for(lambda: (Path(folder) / pace.FILE).exists(), 60, "pace")
        clock = pace.read(Path(folder))

        def driving():
            out.publish(twist_stamped(0.3, 0.0, clock.now_ns()))
            return states and states[-1].reason_code == ControlState.REASON_DRIVE_ROBOT

        stack.wait_for(lambda: states and states[-1].mode == ControlState.REAL, 240, "real mode")
        stack.wait_for(driving, 30, "drive")
        states.clear(), truth.clear()
        end_s, paces = clock.steady_s() + DRIVE_S, set()

        def over():
            paces.add(clock.factor)
            driving()
            return clock.steady_s() > end_s

        stack.wait_for(over, 2 * DRIVE_S, "end of the drive")
        assert ControlState.STOPPED not in {state.mode for state in states}, [state.reason for state in states]
        stamps = [stamp_ns(message) for message in truth]
        assert stamps == sorted(stamps) and abs(clock.now_ns() - stamps[-1]) < 1e9
        driven_m = truth[-1].pose.pose.position.x - truth[0].pose.pose.position.x
        assert driven_m > 0.6 * 0.3 * DRIVE_S, (driven_m, paces)
        if min(paces) < 0.9:
            assert "of real time: this machine is busy" in stack.log_path.read_text()
