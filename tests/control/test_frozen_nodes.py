"""Arbiter, navigator and v-bot that stood still, were suspended or restarted, in simulated time.

The operator holds the key all the time. A frozen node is taken off the bus, and reads what has waited when it is back.
"""

from __future__ import annotations

from collections.abc import Sequence
from itertools import pairwise

import pytest
from control_world import rectangle
from test_control_nodes import STEP_NS, Stack

from instant_ic.bus import Node
from instant_ic.control.interruptions import Interruptions
from instant_ic.control.states import Mode, Reason
from instant_ic.msg import HARD_STOP, ControlState, twist_values
from instant_ic.util.pace import suspended_ns
from instant_ic.util.step_gap import StepGap

KEY, NOTHING = (0.4, 0.0), (0.0, 0.0)
ALL = ("arbiter", "navigator", "virtual_robot")


def stack_in(mode: Mode) -> Stack:
    """A stack that is driven through the obstacle until it is in this mode."""
    stack = Stack(rectangle(2.5, -0.25, 3.0, 0.25))
    stack.drive(1.5, NOTHING)
    stack.drive(0.5, KEY)
    for _ in range(600):
        if stack.step(KEY).mode == mode and (mode != Mode.VIRTUAL or stack.base.v > 0.1):
            return stack
    raise AssertionError(f"never in {mode.label}")


def node_of(stack: Stack, name: str) -> Node:
    return next(node for node in stack.bus.nodes if node.node_name == name)


def freeze(stack: Stack, names: Sequence[str], seconds: float, held: bool = True) -> None:
    """Freeze nodes for a while; afterwards they read what has waited, as if it had just arrived."""
    nodes = [node_of(stack, name) for name in names]
    for node in nodes:
        stack.bus.nodes.remove(node)
    for k in range(round(seconds * 20)):
        now = stack.now
        stack.sense()
        if held:
            stack.operate(KEY)
        stack.bus.advance_to(now + STEP_NS)
        # The base by itself: hard stop 0.25 s after the last command.
        fresh = "arbiter" not in names or k < 5
        stack.k += 1
        stack.base.step(twist_values(stack.bus.last("/cmd_vel")) if fresh else NOTHING, 0.05)
    now = stack.now
    for subscription in (one for node in nodes for one in node.subscriptions):
        queue = subscription.raw.queue
        for i, received in enumerate(queue):
            queue[i] = received._replace(received_ns=now, steady_ns=now)
    stack.bus.nodes.extend(nodes)


def restart(stack: Stack, name: str, within_s: float = 0.5) -> None:
    node = node_of(stack, name)
    stack.bus.nodes.remove(node)
    stack.drive(within_s, KEY)
    stack.bus.add(type(node))


def commands(stack: Stack, since: int) -> list[tuple[float, float]]:
    return [twist_values(message) for message in stack.bus.messages("/cmd_vel")[since:]]


def assert_waits_for_a_release(stack: Stack, text: str) -> None:
    """Nothing moves under the held key for 2 s; after its release the robot can be driven again."""
    since = len(stack.bus.records("/cmd_vel"))
    states = stack.drive(2.0, KEY)
    assert set(commands(stack, since)) == {NOTHING}
    assert {message.header.frame_id for message in stack.bus.messages("/cmd_vel")[since:]} == {HARD_STOP}
    assert states[-1].mode == Mode.STOPPED
    assert states[-1].reason_code == Reason.RELEASE_CONTROLS
    assert states[-1].reason.endswith(" Let go of the controls to continue.")
    assert text in states[-1].reason
    assert stack.drive(1.0, NOTHING)[-1].mode == Mode.REAL


@pytest.mark.parametrize(("mode", "seconds"), [(Mode.REAL, 1.6), (Mode.VIRTUAL, 2.0)])
def test_a_frozen_arbiter_waits_for_a_release(mode: Mode, seconds: float) -> None:
    stack = stack_in(mode)
    freeze(stack, ["arbiter"], seconds)
    assert_waits_for_a_release(stack, "The robot's controller paused for")


@pytest.mark.parametrize("names", [("virtual_robot",), ALL], ids="+".join)
def test_frozen_nodes_in_virtual_wait_for_a_release(names: tuple[str, ...]) -> None:
    stack = stack_in(Mode.VIRTUAL)
    freeze(stack, names, 2.0)
    assert_waits_for_a_release(stack, "paused for" if "arbiter" in names else "")


@pytest.mark.parametrize("mode", [Mode.REAL, Mode.RETURNING])
def test_a_suspended_machine_waits_for_a_release(mode: Mode) -> None:
    """The steady clock stands still in suspend: every age looks as before."""
    stack = stack_in(mode)
    stack.bus.clock.suspend(60.0)
    assert_waits_for_a_release(stack, "This computer was suspended")


@pytest.mark.parametrize(
    ("name", "mode"), [("navigator", Mode.REAL), ("navigator", Mode.VIRTUAL), ("virtual_robot", Mode.REAL)]
)
def test_a_restarted_node_waits_for_a_release(name: str, mode: Mode) -> None:
    """Back within 1.5 s, so that no source counts as lost."""
    stack = stack_in(mode)
    restart(stack, name)
    stack.drive(0.3, KEY)
    assert_waits_for_a_release(stack, f"({name}) was restarted")


def test_a_restarted_arbiter_waits_for_a_release() -> None:
    stack = stack_in(Mode.REAL)
    arbiter = node_of(stack, "arbiter")
    stack.bus.nodes.remove(arbiter)
    stack.drive(0.3, KEY)
    stack.bus.add(type(arbiter))
    since = len(stack.bus.records("/cmd_vel"))
    assert stack.drive(2.0, KEY)[-1].reason_code == Reason.RELEASE_CONTROLS
    assert set(commands(stack, since)) == {NOTHING}


@pytest.mark.parametrize("mode", [Mode.REAL, Mode.VIRTUAL])
def test_after_a_short_freeze_the_motion_resumes_by_itself(mode: Mode) -> None:
    stack = stack_in(mode)
    freeze(stack, ["arbiter"], 0.8)
    since = len(stack.bus.records("/cmd_vel"))
    states = stack.drive(2.0, KEY)
    sent = stack.bus.messages("/cmd_vel")[since:]
    assert twist_values(sent[0]) == NOTHING
    assert sent[0].header.frame_id == HARD_STOP
    assert Mode.STOPPED not in {state.mode for state in states}
    assert max(abs(v) for v, _ in commands(stack, since)) > 0.1


def test_short_freezes_that_repeat_never_let_the_robot_move() -> None:
    stack = stack_in(Mode.REAL)
    freeze(stack, ["arbiter"], 0.4)
    since = len(stack.bus.records("/cmd_vel"))
    for _ in range(5):
        stack.drive(0.2, KEY)
        freeze(stack, ["arbiter"], 0.4)
    assert set(commands(stack, since)) == {NOTHING}


@pytest.mark.parametrize("set_s", [-3600, 3600], ids=["back", "forward"])
def test_a_source_that_ended_in_a_freeze_moves_nothing_even_if_the_clock_was_set(set_s: int) -> None:
    """Its last message waits and carries a stamp of the old clock; set back, it looks as if it had just arrived."""
    stack = stack_in(Mode.REAL)
    freeze(stack, ["arbiter"], 0.8, held=False)
    stack.operate(KEY, ahead_s=-set_s)
    since = len(stack.bus.records("/cmd_vel"))
    stack.drive(2.0, None)
    assert set(commands(stack, since)) == {NOTHING}


def test_silence_after_a_held_key_is_no_release() -> None:
    """The console is frozen, or its link is cut, while the arbiter waits."""
    stack = stack_in(Mode.REAL)
    freeze(stack, ["arbiter"], 2.0)
    stack.drive(0.5, KEY)
    assert {state.mode for state in stack.drive(2.0, None)} == {Mode.STOPPED}
    assert_waits_for_a_release(stack, "paused")


def test_a_single_zero_of_a_page_that_comes_back_is_no_release() -> None:
    """The console sends a zero before it hears that the key is still held."""
    stack = stack_in(Mode.REAL)
    freeze(stack, ["arbiter"], 2.0)
    stack.drive(0.5, KEY)
    stack.drive(1.2, None)
    stack.drive(0.05, NOTHING)
    assert ControlState.REAL not in {state.mode for state in stack.drive(1.0, KEY)}


@pytest.mark.parametrize("mode", [Mode.REAL, Mode.VIRTUAL])
def test_a_key_held_through_a_long_silence_of_the_commands_waits_for_a_release(mode: Mode) -> None:
    stack = stack_in(mode)
    stack.drive(2.0, None)
    assert_waits_for_a_release(stack, "The operator's link")


def test_a_key_held_while_its_commands_are_late_for_long_waits_for_a_release() -> None:
    """Each of them is old, but none is older than stop_after_s."""
    stack = stack_in(Mode.REAL)
    for _ in range(60):
        stack.operate(KEY, ahead_s=-0.5)
        stack.step(None)
    assert_waits_for_a_release(stack, "The operator's link")


def test_a_page_that_is_lost_for_a_moment_is_no_release_after_another_loss() -> None:
    stack = stack_in(Mode.REAL)
    stack.silent.add("/camera/image/compressed")
    stack.drive(2.0, KEY)
    stack.silent.clear()
    stack.drive(0.05, NOTHING)  # the console's zero at the loss
    stack.lost_ns = stack.now
    stack.drive(1.2, None)
    assert stack.drive(0.05, NOTHING)[-1].mode == Mode.STOPPED
    assert_waits_for_a_release(stack, "No camera image")


def test_a_page_that_is_lost_and_comes_back_with_its_key_held_waits_for_a_release() -> None:
    """The console sends a zero at the loss, and another one before it hears of the key."""
    stack = stack_in(Mode.REAL)
    stack.drive(0.05, NOTHING)
    stack.lost_ns = stack.now
    stack.drive(2.0, None)
    stack.drive(0.05, NOTHING)
    assert_waits_for_a_release(stack, "The operator's link was lost")


@pytest.mark.parametrize("before", [(NOTHING, 0.3), (None, 2.0)], ids=["let go", "no page"])
def test_who_held_nothing_before_a_silence_need_not_release_it(before: tuple[tuple[float, float], float]) -> None:
    stack = stack_in(Mode.REAL)
    stack.drive(0.3, NOTHING)
    stack.drive(before[1], before[0])
    stack.drive(3.0, None)
    assert {state.mode for state in stack.drive(1.0, KEY)} == {Mode.REAL}
    assert stack.base.v > 0.2


@pytest.mark.parametrize("order", ["command first", "timer first"])
def test_the_first_step_after_a_freeze_stops_whatever_it_handles_first(order: str) -> None:
    stack = stack_in(Mode.REAL)
    arbiter = node_of(stack, "arbiter")
    freeze(stack, ["arbiter"], 2.0, held=order == "command first")
    since = len(stack.bus.records("/cmd_vel"))
    if order == "timer first":
        arbiter.on_timer()
    stack.operate((0.3, 0.0))
    assert commands(stack, since)[0] == NOTHING
    assert_waits_for_a_release(stack, "paused for 2.0 s")


def test_gaps_count_in_steps_of_the_process_and_in_time_of_suspend() -> None:
    gap, s = StepGap(), 10**9
    steps = [(5 * s, 7 * s), (5.3 * s, 7 * s), (5.7 * s, 7 * s), (5.8 * s, 8 * s), (5.9 * s, 7.9 * s), (6 * s, 8 * s)]
    found = [gap.step(round(steady), round(asleep)) for steady, asleep in steps]
    assert found == [0.0, 0.0, pytest.approx(0.4), float("inf"), 0.0, 0.0]
    assert gap.settles(6 * s) and not gap.settles(round(6.2 * s))
    gap.pause()
    assert gap.step(9 * s, 8 * s) == 0.0


def test_this_machine_reports_its_time_in_suspend() -> None:
    values = [suspended_ns() for _ in range(100)]
    assert values[0] > -(10**9)
    assert max(after - before for before, after in pairwise(values)) < 50_000_000


def test_several_consoles_with_interleaved_commands_are_no_restart() -> None:
    watch, instances = Interruptions(), {("command", "console"): b"a", ("command", "zenoh_gateway"): b"b"}
    assert watch.step(0, 0, instances, 1.5) is None
    assert watch.step(1, 0, dict(reversed(instances.items())), 1.5) is None
    found = watch.step(2, 0, instances | {("command", "console"): b"c"}, 1.5)
    assert found is not None and found.text == "The operator's console (console) was restarted."
