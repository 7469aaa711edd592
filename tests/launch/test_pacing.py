"""The pace that the launcher chooses: on traces of a machine, and from the machine's own counters."""

import itertools
import time

import numpy as np
import pytest

from instant_ic.bus import LATCHED, SENSOR
from instant_ic.bus.local_transport import LocalTransport
from instant_ic.bus.registry import prepare
from instant_ic.launch import pacing
from instant_ic.launch.description import NodeSpec
from instant_ic.launch.health import HealthMonitor
from instant_ic.launch.pacing import SLOWEST, PaceChooser, PaceSample, Pacing, pace_of
from instant_ic.msg import ControlState, Float32, header, pose_message, serialize, twist_message
from instant_ic.util import pace


class Machine:
    """A stack on a machine: late above the pace at which its cores are used up, which the trace gives by time.

    Args:
        feasible: machine time → largest pace at which the stack is punctual.
        alone: feasible pace without other processes; default: there are none.
        idle: whether what the stack leaves is idle; else other processes use it.
    """

    cores = 2

    def __init__(self, feasible, alone=None, idle=True):
        self.feasible, self.alone, self.idle = feasible, alone, idle
        self.chooser = PaceChooser(1.0)
        self.now_s, self.paces = 100.0, []

    def run(self, seconds):
        for _ in range(round(seconds / 0.25)):
            self.now_s += 0.25
            feasible, factor = self.feasible(self.now_s - 100.0), self.chooser.pace
            available = 2.0 * feasible / (self.alone or feasible)
            used = available * min(1.0, factor / feasible)
            idle = available - used + self.cores - 2 if self.idle else 0.0
            late = 0.2 if factor <= feasible else 1.0 + 5.0 * (factor / feasible - 1.0)
            self.paces.append(self.chooser.step(PaceSample(self.now_s, late, False, idle, used)))
        return self.paces[-1]


def test_a_machine_that_is_fast_enough_stays_at_real_time():
    assert set(Machine(lambda t: 1.3).paces + [Machine(lambda t: 1.3).run(60)]) == {1.0}


@pytest.mark.parametrize("feasible", [0.75, 0.45, 0.2])
@pytest.mark.parametrize("idle", [True, False])
def test_a_slow_machine_finds_its_pace_and_keeps_it(feasible, idle):
    machine = Machine(lambda t: feasible, idle=idle)
    machine.run(300)
    assert machine.paces[round(6.0 / 0.25)] <= feasible  # reached within seconds
    late = machine.paces[round(200 / 0.25) :]
    assert sum(late) / len(late) > 0.7 * feasible
    falls = sum(after < before for before, after in itertools.pairwise(late))
    assert falls <= 4  # no oscillation: the holds grow


def test_a_slow_thread_on_many_cores_slows_the_stack_too():
    machine = Machine(lambda t: 0.6)
    machine.cores = 16
    machine.run(200)
    assert all(0.3 < factor <= 0.65 for factor in machine.paces[round(60 / 0.25) :])


def test_a_fall_takes_at_most_a_second_and_a_rise_some():
    machine = Machine(lambda t: 0.4 if 10 <= t < 40 else 1.2, alone=1.2)
    assert machine.run(9.75) == 1.0
    assert machine.run(1.25) < 0.9
    assert machine.run(4.0) <= 0.4
    machine.run(25)
    assert machine.run(2.0) < 0.6  # the load is gone
    assert machine.run(60) == 1.0


def test_after_one_spike_the_pace_is_soon_real_time_again():
    machine = Machine(lambda t: 0.5 if 10 <= t < 10.5 else 1.2, alone=1.2)
    machine.run(12.0)
    assert 0.3 < min(machine.paces) < 1.0
    assert machine.run(25) == 1.0


def test_steps_are_small_and_within_bounds():
    machine = Machine(lambda t: 0.02 if t < 30 else 5.0)
    machine.run(200)
    assert min(machine.paces) == SLOWEST and max(machine.paces) == 1.0
    for before, after in itertools.pairwise(machine.paces):
        assert 0.6 * before - 1e-9 <= after <= before + PaceChooser.STEP + 1e-9


def test_no_rise_without_a_report():
    chooser = PaceChooser(0.5)
    assert {chooser.step(PaceSample(t / 4, None, False, 2.0)) for t in range(400)} == {0.5}


@pytest.mark.parametrize(("idle", "falls"), [(0.0, True), (1.0, False)])
def test_a_stale_source_is_the_machines_fault_only_while_the_machine_is_busy(idle, falls):
    chooser = PaceChooser(1.0)
    chooser.step(PaceSample(0.0, 0.1))
    assert (chooser.step(PaceSample(0.25, 0.1, True, idle)) < 1.0) == falls


def test_a_source_that_stays_stale_has_a_fault_of_its_own():
    chooser = PaceChooser(1.0)
    paces = [chooser.step(PaceSample(t / 4, 0.1, t > 4)) for t in range(800)]
    assert min(paces) > SLOWEST and paces[-1] > min(paces)


def test_first_pace_from_cores_speed_and_load():
    fast = 60e6
    assert pace_of(2, fast, 0.0) == 1.0
    assert pace_of(16, fast, 8.0) == 1.0
    assert pace_of(2, fast, 4.0) == pytest.approx(0.667, abs=0.01)  # a third of two cores, of 1.2 at 50e6
    assert pace_of(1, fast / 4, 0.0) == pytest.approx(0.25)
    assert pace_of(1, 1e6, 20.0) == SLOWEST


class Stack:
    """A stack that is as late as the test says."""

    cpu_cores, late = 1.0, 0.1

    def take_late(self):
        return self.late, False


def test_the_operator_learns_what_matters(tmp_path, monkeypatch):
    now = [5.0]
    monkeypatch.setattr(pacing.time, "monotonic", lambda: now[0])
    monkeypatch.setattr(pacing.time, "monotonic_ns", lambda: round(now[0] * 1e9))
    monkeypatch.setattr(pacing, "machine_pace", lambda: 1.0)
    monkeypatch.setattr(pacing, "idle_cores", lambda: 1.0)
    lines, stack = [], Stack()
    made = Pacing([tmp_path], lines.append)
    assert not pace.read(tmp_path).real and pace.read(tmp_path).factor == 1.0

    def go_on(seconds):
        for _ in range(round(seconds / 0.25)):
            now[0] += 0.25
            made.step(stack)

    go_on(20)
    assert lines == []
    stack.late = 1.7
    go_on(0.25)
    assert lines == ["simulation at 0.6 of real time: this machine is busy"]
    stack.late = 0.1
    go_on(120)
    assert lines[-1] == "simulation in real time" and len(lines) <= 4


def control(reason_code):
    """A ControlState with this reason."""
    pose, still = pose_message(np.eye(4)), twist_message()
    poses = dict.fromkeys(("robot_pose", "vbot_start", "vbot_pose", "vbot_target"), pose)
    twists = dict.fromkeys(("operator_command", "applied_command", "robot_twist"), still)
    zeros = dict.fromkeys(("mode", "transitions", "shown", "vbot_action"), 0)
    gaps = dict.fromkeys(("pose_gap_m", "yaw_gap_rad", "time_to_obstacle_s", "vbot_limit_m_s"), 0.0)
    flags = {"estop": False, "blocked": False, "header": header("map", 0), "reason_code": reason_code}
    return ControlState(reason="", holder="", **poses, **twists, **zeros, **gaps, **flags)


def test_delays_and_stale_sources_come_from_the_simulated_stack(tmp_path):
    group = tmp_path / "left"
    for folder in (tmp_path, group):
        prepare(folder)
    nodes = [NodeSpec("s", "simulator", (), run_dir=group, group="left"), NodeSpec("a", "arbiter", ())]
    devices, arbiter = LocalTransport(group, "s", lambda: 1), LocalTransport(tmp_path, "a", lambda: 1)
    monitor = HealthMonitor(nodes, tmp_path)
    try:
        assert monitor.take_late() == (None, False)
        late = devices.advertise("/simulation/late", "std_msgs/msg/Float32", SENSOR)
        state = arbiter.advertise("/ic/state", "instant_ic_msgs/msg/ControlState", LATCHED)
        found = set()
        for count in range(3000):  # until the subscriptions are connected
            late.send(serialize(Float32(1.5)))
            stale = ControlState.REASON_SCAN_STALE if count % 2 else ControlState.REASON_STARTING
            state.send(serialize(control(stale)))
            monitor.poll()
            found.add(monitor.take_late())
            if {(1.5, True), (1.5, False)} <= found:
                break
            time.sleep(0.01)
        assert {(1.5, True), (1.5, False)} <= found
    finally:
        for transport in (monitor, devices, arbiter):
            transport.close()
