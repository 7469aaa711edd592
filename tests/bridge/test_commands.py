"""Commands from several clients of one bridge: who drives, and that no robot starts under a held key."""

import pytest

from instant_ic.bridge.commands import CommandGate, CommandLimits, CommandRefused

SECOND = 1_000_000_000


def test_fault_a_second_clients_held_key_drives_when_the_first_one_leaves():
    gate, now_ns = CommandGate(CommandLimits(lease_s=2.0)), 0
    for now_ns in range(0, SECOND, SECOND // 10):
        gate.check_drive("first", 0.1, 0.0, now_ns)
        with pytest.raises(CommandRefused, match="may not drive while first does"):
            gate.check_drive("second", 0.2, 0.0, now_ns)
    assert gate.release("first")
    for later_ns in range(now_ns, now_ns + 5 * SECOND, SECOND // 10):
        with pytest.raises(CommandRefused, match="second must let go of the controls once"):
            gate.check_drive("second", 0.2, 0.0, later_ns)
    gate.check_drive("third", 0.1, 0.0, now_ns + 5 * SECOND)  # commanded nothing in vain
    assert gate.release("third")
    gate.check_drive("second", 0.0, 0.0, now_ns + 5 * SECOND)
    gate.check_drive("second", 0.2, 0.0, now_ns + 5 * SECOND)


def test_second_client_drives_once_both_have_been_silent_for_the_lease():
    gate = CommandGate(CommandLimits(lease_s=2.0))
    gate.check_drive("first", 0.1, 0.0, 0)
    with pytest.raises(CommandRefused):
        gate.check_drive("second", 0.2, 0.0, 0)
    gate.check_drive("second", 0.2, 0.0, 2 * SECOND + 1)
