"""Base, arbiter and console that stood still, were suspended or restarted: nothing drives on under the held key.

Real nodes against the simulated robot, in simulated time, until 2 s after the end of the freeze.
"""

from __future__ import annotations

import math
from collections.abc import Iterator

import pytest
from base_line import NodeBench
from test_stopping_losses import STANDS_M_S, Rig

from instant_ic.control.states import Reason
from instant_ic.experiments.teleop_stack import STEP_S
from instant_ic.msg import HARD_STOP, ControlState

ALL = ("arbiter", "crawler_base", "console", "navigator", "virtual_robot")
"""The processes that command motion."""
AFTER_S = 2.0
BRAKING_M = 0.16
"""Longest way to a stand after a loss."""


@pytest.fixture(scope="module")
def rig() -> Iterator[Rig]:
    made = Rig()
    yield made
    made.stack.close()


def run(rig: Rig, seconds: float) -> None:
    for _ in range(round(seconds / STEP_S)):
        rig.step()


def thaw(rig: Rig) -> None:
    """Bring the frozen nodes back; what has waited looks as if it had just arrived."""
    now = rig.bus.clock.now_ns()
    for subscription in (one for node in rig.dead for one in node.subscriptions):
        queue = subscription.raw.queue
        for i, received in enumerate(queue):
            queue[i] = received._replace(received_ns=now, steady_ns=now)
    rig.heal()


def restart(rig: Rig, name: str, after_s: float) -> None:
    """Kill a node and start it again."""
    rig.freeze(name)
    run(rig, after_s)
    rig.dead.clear()
    rig.operates = True
    rig.stack.start_node(name)


def assert_stands(rig: Rig, start: tuple[float, float], text: str = "") -> None:
    """The robot stands within the braking distance and stays there, under the held key, until it is released."""
    run(rig, 0.3)
    stands = rig.stack.robot[:2]
    run(rig, AFTER_S - 0.3)
    assert math.dist(start, stands) <= BRAKING_M
    assert math.dist(stands, rig.stack.robot[:2]) < 0.005
    assert rig.speed() < STANDS_M_S
    assert rig.stack.state.mode == ControlState.STOPPED
    assert rig.stack.state.reason_code == Reason.RELEASE_CONTROLS
    assert text in rig.stack.state.reason
    rig.drive()


@pytest.mark.parametrize(
    ("names", "seconds"), [(("arbiter",), 1.6), (("crawler_base",), 1.6), (("console",), 1.6), (ALL, 3.0)]
)
def test_after_a_freeze_the_robot_stands_until_the_controls_are_released(
    rig: Rig, names: tuple[str, ...], seconds: float
) -> None:
    rig.drive()
    start = rig.stack.robot[:2]
    for name in names:
        rig.freeze(name)
    run(rig, seconds)
    thaw(rig)
    assert_stands(rig, start)


def test_a_restarted_base_or_console_waits_for_a_release_even_within_1_5_s() -> None:
    rig = Rig()  # a new base counts its odometry from zero: the other tests have another SLAM
    for name in ("console", "crawler_base"):
        rig.drive()
        start = rig.stack.robot[:2]
        restart(rig, name, 0.7)
        assert_stands(rig, start, f"({name}) was restarted")
    rig.stack.close()


@pytest.mark.parametrize("name", ["arbiter", "crawler_base"])
def test_after_a_short_freeze_the_robot_drives_on(rig: Rig, name: str) -> None:
    rig.drive()
    rig.freeze(name)
    run(rig, 0.8)
    thaw(rig)
    run(rig, 1.2)
    assert rig.speed() > 0.2
    assert rig.stack.state.reason_code == Reason.DRIVE_ROBOT


def test_a_base_that_was_suspended_does_not_apply_its_old_set_point() -> None:
    """The steady clock stands still in suspend, so the command looks fresh; the watchdog has stopped the motors."""
    bench = NodeBench()
    bench.run(2.0, v=0.38)
    bench.command(0.38)
    bench.line.advance(5.0)
    bench.clock.suspend(5.0)
    assert bench.line.speed == 0.0
    before_m = bench.line.travelled_m
    bench.run(1.0)
    assert bench.line.travelled_m == before_m


def test_a_base_whose_node_thread_stands_still_shows_the_arbiter_no_odometry() -> None:
    """The serial thread goes on, but no command arrives: the arbiter must see the loss, and demand the release."""
    bench = NodeBench()
    bench.run(1.0, v=0.2)
    counts = []
    for _ in range(8):
        bench.line.advance(0.1)
        bench.clock.set(bench.clock.steady_ns() + 100_000_000)
        bench.node.loop.hurry()  # a step of the serial thread
        counts.append(len(bench.bus.records("/wheel/odom")))
    assert counts[3:] == [counts[3]] * 5
    bench.run(0.3)
    assert len(bench.bus.records("/wheel/odom")) > counts[-1]


@pytest.mark.parametrize("source", ["operator", "arbiter"])
def test_the_last_velocity_never_persists_when_its_source_ends(rig: Rig, source: str) -> None:
    """navigation2 #6548; killed: ``test_stopping_losses.py``, the navigator: ``control/test_stopping_virtual.py``."""
    rig.drive()
    rig.stack.sent.clear()
    console, arbiter = rig.stack.nodes["console"], rig.stack.nodes["arbiter"]
    if source == "operator":
        rig.operates = False  # as the page's server does
        console.on_drive(0.0, 0.0)
        console.on_operator(False)
    else:
        arbiter.teardown()
        rig.freeze("arbiter")
    run(rig, 0.6)
    stands = rig.stack.robot[:2]
    run(rig, 2.0)
    rig.heal()
    assert math.dist(stands, rig.stack.robot[:2]) < 0.005
    if source == "operator":
        assert {command for _, command, _ in rig.stack.sent[-20:]} == {(0.0, 0.0)}
        assert rig.stack.sent[-1][2] == HARD_STOP
