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


def test_fault_a_key_held_through_a_slow_network_drives_when_the_first_client_has_left():
    gate, old = CommandGate(CommandLimits(max_age_s=0.3, lease_s=2.0)), (0, SECOND)
    gate.check_drive("first", 0.1, 0.0, 0)
    for now_ns in range(0, 5 * SECOND, SECOND // 10):
        gate.check_drive("first", 0.1, 0.0, now_ns)
        with pytest.raises(CommandRefused, match="1\\.00 s old"):
            gate.check_drive("second", 0.2, 0.0, now_ns, old)
    assert gate.release("first")
    with pytest.raises(CommandRefused, match="second must let go of the controls once"):
        gate.check_drive("second", 0.2, 0.0, now_ns, (0, 0))
    assert gate.refused == {"old": 50, "held": 1}
    with pytest.raises(CommandRefused, match="1\\.00 s old"):
        gate.check_drive("third", 0.1, 0.0, now_ns, old)
    gate.check_drive("second", 0.0, 0.0, now_ns, (0, 0))  # the old command took no lease
