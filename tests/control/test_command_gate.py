"""May this command drive? The checks of values, age and lease, and that no robot starts under a held key."""

import math

import pytest

from instant_ic.control.command_gate import CommandGate, GateLimits
from instant_ic.control.robot_lease import Lease, Verdict

SECOND = 1_000_000_000
REMOTE = GateLimits(max_age_s=0.3, max_ahead_s=0.3, max_linear_mps=2.0, max_angular_rps=4.0)
LOCAL = GateLimits(max_age_s=0.25, max_ahead_s=0.0)
UNPROTECTED = GateLimits(max_age_s=0.25, max_ahead_s=0.0, accept_unstamped=True)


@pytest.mark.parametrize(
    ("limits", "v", "w", "age_s", "verdict"),
    [
        (REMOTE, 2.0, -4.0, 0.3, None),
        (REMOTE, -0.1, 0.0, -0.3, None),
        (REMOTE, math.nan, 0.0, 0.0, Verdict.NOT_FINITE),
        (REMOTE, 0.0, math.inf, 0.0, Verdict.NOT_FINITE),
        (REMOTE, -math.inf, 0.0, 0.0, Verdict.NOT_FINITE),
        (REMOTE, 0.1, 0.0, math.nan, Verdict.NOT_FINITE),
        (REMOTE, 2.01, 0.0, 0.0, Verdict.TOO_FAST),
        (REMOTE, 0.0, -4.01, 0.0, Verdict.TOO_FAST),
        (REMOTE, 0.1, 0.0, 0.31, Verdict.OLD),
        (REMOTE, 0.1, 0.0, -0.31, Verdict.FUTURE),
        (REMOTE, 0.0, 0.0, 0.31, Verdict.OLD),
        (REMOTE, 0.1, 0.0, None, Verdict.UNSTAMPED),
        (LOCAL, 50.0, 0.0, 0.25, None),
        (LOCAL, 0.1, 0.0, -0.001, Verdict.FUTURE),
        (LOCAL, 0.1, 0.0, None, Verdict.UNSTAMPED),
        (UNPROTECTED, 0.1, 0.0, None, None),
        (UNPROTECTED, 0.1, 0.0, 0.26, Verdict.OLD),
    ],
)
def test_a_command_drives_only_with_plausible_values_and_a_recent_stamp(limits, v, w, age_s, verdict):
    for gate in (CommandGate(limits), CommandGate(limits, Lease(2.0))):
        refusal = gate.admit(v, w, age_s, "sender", SECOND)
        assert (None if refusal is None else refusal.verdict) is verdict
        assert gate.refused == ({} if verdict is None else {verdict: 1})
        if gate.lease is not None:  # a refused command takes no lease
            assert gate.lease.holder == ("sender" if verdict is None else "")


def test_each_receiver_may_ask_for_values_and_age_alone():
    gate = CommandGate(REMOTE)
    assert gate.check_twist(2.0, 4.0) is None and gate.check_age(0.3) is None
    assert gate.check_twist(math.nan, 0.0).text == "command is not finite (v=nan, w=0.0)"
    assert gate.check_age(1.0).text == "command is 1.00 s old, at most 0.3 s allowed"


@pytest.fixture
def drive():
    """Send a command of 0.1 m/s, or another one; return the verdict."""

    def send(sender, now_ns, v=0.1, age_s=0.0):
        refusal = gate.admit(v, 0.0, age_s, sender, now_ns)
        return None if refusal is None else refusal.verdict

    gate = CommandGate(REMOTE, Lease(2.0))
    send.gate = gate
    return send


def test_fault_a_second_clients_held_key_drives_when_the_first_one_leaves(drive):
    now_ns = 0
    for now_ns in range(0, SECOND, SECOND // 10):
        assert drive("first", now_ns) is None
        assert drive("second", now_ns) is Verdict.NOT_DRIVER
    assert drive.gate.lease.release("first")
    for later_ns in range(now_ns, now_ns + 5 * SECOND, SECOND // 10):
        assert drive("second", later_ns) is Verdict.HELD
    assert drive("third", now_ns + 5 * SECOND) is None  # commanded nothing in vain
    assert drive.gate.lease.release("third")
    assert drive("second", now_ns + 5 * SECOND, v=0.0) is None
    assert drive("second", now_ns + 5 * SECOND) is None


def test_second_client_drives_once_both_have_been_silent_for_the_lease(drive):
    assert drive("first", 0) is None
    assert drive("second", 0) is Verdict.NOT_DRIVER
    assert drive("second", 2 * SECOND + 1) is None


def test_fault_a_key_held_through_a_slow_network_drives_when_the_first_client_has_left(drive):
    now_ns = 0
    for now_ns in range(0, 5 * SECOND, SECOND // 10):
        assert drive("first", now_ns) is None
        assert drive("second", now_ns, age_s=1.0) is Verdict.OLD
    assert drive.gate.lease.release("first")
    assert drive("second", now_ns) is Verdict.HELD
    assert drive.gate.refused == {Verdict.OLD: 50, Verdict.HELD: 1}
    assert drive("third", now_ns, age_s=1.0) is Verdict.OLD
    assert drive("second", now_ns, v=0.0) is None  # the old command took no lease


def test_only_the_driver_releases_the_emergency_stop_and_only_by_a_recent_message(drive):
    assert drive("first", 0) is None
    for sender, age_s, now_ns, verdict in [
        ("first", 0.0, SECOND, None),
        ("first", 0.31, SECOND, Verdict.OLD),
        ("first", -0.31, SECOND, Verdict.FUTURE),
        ("second", 0.0, SECOND, Verdict.RELEASE),
        ("", 0.0, SECOND, Verdict.RELEASE),
        ("first", 0.0, 2 * SECOND + 1, Verdict.RELEASE),  # its lease has run out
    ]:
        refusal = drive.gate.admit_release(sender, age_s, now_ns)
        assert (None if refusal is None else refusal.verdict) is verdict
