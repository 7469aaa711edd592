"""Lease, watchdog and emergency stop, by a clock that the test sets."""

import asyncio

import pytest
from console_servers import Backend

from instant_ic.console.drive import DriveConfig, DriveGate, DriveService
from instant_ic.control.robot_lease import Verdict
from instant_ic.util.pace import current

CONFIG = DriveConfig(max_linear_mps=0.4, max_angular_rps=0.8, rate_hz=20, watchdog_s=0.25, stop_repeat_s=0.3)


def driving_gate(now=0.0):
    gate = DriveGate(CONFIG)
    assert gate.request(1, now)
    assert gate.receive(1, 1, 0.0, 0.3, 0.1, now) is Verdict.ACCEPTED
    assert gate.take_due(now) == (0.3, 0.1)
    return gate


def run(gate, start, end, step=0.01):
    """Commands given on in [start, end): list of (time, command)."""
    given = []
    for i in range(round((end - start) / step)):
        command = gate.take_due(start + i * step)
        if command is not None:
            given.append((round(start + i * step, 3), command))
    return given


def test_commands_are_given_on_at_the_rate_and_a_change_at_once():
    gate = driving_gate()
    assert gate.take_due(0.02) is None
    gate.receive(1, 2, 0.0, 0.3, -0.2, 0.03)
    assert gate.take_due(0.03) == (0.3, -0.2)
    assert gate.take_due(0.06) is None
    assert gate.take_due(0.08) == (0.3, -0.2)  # 1/20 s after the last


def test_fault_robot_runs_its_last_command_after_the_link_is_lost():
    """Robot runs its last command after the link is lost: zero 0.25 s after the last command."""
    given = run(driving_gate(), 0.01, 1.0)
    first_zero = next(time for time, command in given if command == (0.0, 0.0))
    assert first_zero == 0.25
    assert [t for t, c in given if c == (0.3, 0.1)] == [0.05, 0.1, 0.15, 0.2]
    # One zero, then silence: the arbiter must see that nobody is there.
    assert [t for t, c in given if c == (0.0, 0.0)] == [0.25]


def test_a_driver_that_stops_commanding_while_driving_counts_as_lost():
    """Its page lives and beats, but the commands cease: the arbiter is told, so that the stop is a hard one."""
    gate = driving_gate()
    for i in range(1, 26):
        gate.touch(1, i * 0.01)
        gate.take_due(i * 0.01)
        assert gate.driver_alive(i * 0.01) is (i < 25)
    assert gate.watchdog_trips == 1
    assert gate.touch(1, 0.3)  # with the next beat it is back
    assert gate.driver_alive(0.3)


def test_watchdog_counts_and_lets_a_fresh_command_through():
    gate = driving_gate()
    run(gate, 0.0, 0.5)
    assert gate.watchdog_trips == 1
    assert gate.receive(1, 2, 0.0, 0.2, 0.0, 0.6) is Verdict.ACCEPTED
    assert gate.take_due(0.6) == (0.2, 0.0)


def test_one_zero_goes_out_even_without_repetition():
    gate = DriveGate(DriveConfig(stop_repeat_s=0.0))
    gate.request(1, 0.0)
    gate.receive(1, 1, 0.0, 0.3, 0.0, 0.0)
    gate.take_due(0.0)
    gate.receive(1, 2, 0.0, 0.0, 0.0, 0.01)
    assert gate.take_due(0.02) == (0.0, 0.0)
    gate.leave(1, 0.03)
    assert run(gate, 0.03, 0.5) == []


def test_fault_idle_zeros_of_one_client_fight_anothers_commands():
    gate = driving_gate()
    assert gate.receive(2, 1, 0.0, 0.0, 0.0, 0.01) is Verdict.NOT_DRIVER
    assert gate.command == (0.3, 0.1)
    assert gate.receive(2, 2, 0.0, 0.4, 0.0, 0.02) is Verdict.NOT_DRIVER


def beating(gate, start, end, *, away=False):
    """What is given on while the driver's page beats at 10 Hz."""
    given = []
    for i in range(round((end - start) / 0.1)):
        gate.touch(1, start + 0.1 * i, away=away)
        given += run(gate, start + 0.1 * i, start + 0.1 * (i + 1))
    return given


def test_an_idle_driver_is_told_by_zeros_as_long_as_its_page_beats():
    gate = DriveGate(CONFIG)
    assert run(gate, 0.0, 0.5) == []  # nobody drives
    gate.request(1, 1.0)
    given = beating(gate, 1.0, 2.0)
    assert {command for _, command in given} == {(0.0, 0.0)}
    assert 10 <= len(given) <= 11  # keep_alive_hz
    assert gate.next_deadline(1.99) == pytest.approx(given[-1][0] + 0.1, abs=0.011)
    # The last beat was at 1.9: 0.25 s later it is over, long before the lease is.
    given = run(gate, 2.0, 3.0)
    assert 2.04 < given[-1][0] < 2.16
    assert gate.driver == 1
    assert gate.next_deadline(3.0) == pytest.approx(3.9)  # of the lease alone
    assert not gate.driver_alive(3.49)
    assert gate.touch(1, 3.5)  # back
    assert gate.take_due(3.5) == (0.0, 0.0)
    assert not gate.touch(1, 3.6)


def test_a_page_that_nobody_looks_at_keeps_the_lease_but_is_nobody():
    gate = DriveGate(CONFIG)
    gate.request(1, 0.0)
    assert gate.touch(1, 0.0, away=True)  # at once: the arbiter must hear of it
    assert not gate.driver_alive(0.0)
    assert beating(gate, 0.0, 5.0, away=True) == []
    assert gate.driver == 1


def test_the_server_wakes_when_an_idle_drivers_beat_is_overdue():
    gate = DriveGate(CONFIG)
    gate.request(1, 0.0)
    now, woken = 0.0, []
    while (deadline := gate.next_deadline(now)) is not None and deadline < 1.9:
        now = max(deadline, now + 0.001)
        gate.take_due(now)
        woken.append((round(now, 3), gate.driver_alive(now)))
    assert woken[-1][0] < 0.4
    assert all(alive for at, alive in woken if at < 0.25)
    assert (0.25, False) in woken  # to the millisecond


def test_a_zero_of_a_hidden_page_does_not_make_it_seen():
    gate = driving_gate()
    gate.touch(1, 0.1, away=True)
    assert gate.receive(1, 2, 0.0, 0.0, 0.0, 0.11) is Verdict.ACCEPTED  # the page stops as it is hidden
    assert gate.take_due(0.11) == (0.0, 0.0)
    assert not gate.driver_alive(0.11)


def test_a_hidden_page_stops_the_robot_even_if_it_sends_no_zero():
    gate = driving_gate()
    assert gate.touch(1, 0.01, away=True)
    assert run(gate, 0.01, 0.5) == [(0.01, (0.0, 0.0))]  # each later command would end the loss again
    assert not gate.driver_alive(0.01)


@pytest.mark.parametrize("leave", ["leave", "forget"])
def test_an_idle_driver_that_goes_leaves_silence(leave):
    gate = DriveGate(CONFIG)
    gate.request(1, 0.0)
    assert beating(gate, 0.0, 0.5)
    getattr(gate, leave)(1, 0.5)
    assert run(gate, 0.5, 2.0) == []
    assert gate.next_deadline(2.0) is None


def test_take_over_stops_the_robot_and_the_old_driver_no_longer_counts():
    gate = driving_gate()
    assert not gate.request(2, 0.01)
    assert gate.driver == 1
    assert gate.request(2, 0.02, take=True)
    assert gate.take_due(0.02) == (0.0, 0.0)
    assert gate.receive(1, 2, 0.0, 0.3, 0.0, 0.03) is Verdict.NOT_DRIVER


def test_fault_socket_close_leaves_the_throttle():
    gate = driving_gate()
    gate.forget(1, 0.01)
    assert gate.take_due(0.01) == (0.0, 0.0)
    assert gate.driver is None
    assert gate.request(2, 0.02)


def test_fault_silent_driver_keeps_the_lease():
    gate = driving_gate()
    gate.touch(1, 1.5)
    run(gate, 1.6, 3.4, step=0.01)
    assert gate.driver == 1
    run(gate, 3.5, 3.6, step=0.01)
    assert gate.driver is None


def test_fault_old_future_and_out_of_order_commands_are_obeyed():
    gate = driving_gate()
    assert gate.receive(1, 2, 0.31, 0.4, 0.0, 0.01) is Verdict.OLD
    assert gate.receive(1, 2, -0.31, 0.4, 0.0, 0.01) is Verdict.FUTURE
    assert gate.receive(1, 1, 0.0, 0.4, 0.0, 0.01) is Verdict.OUT_OF_ORDER
    assert gate.command == (0.3, 0.1)
    assert gate.receive(1, 2, 0.29, 0.4, 0.0, 0.01) is Verdict.ACCEPTED


def test_commands_are_clamped():
    gate = driving_gate()
    gate.receive(1, 2, 0.0, 9.0, -9.0, 0.01)
    assert gate.command == (0.4, -0.8)


def test_emergency_stop_is_latched_and_only_the_driver_releases_it():
    gate = driving_gate()
    gate.set_estop(0.01)
    assert gate.take_due(0.01) == (0.0, 0.0)
    assert gate.receive(1, 2, 0.0, 0.3, 0.0, 0.02) is Verdict.STOPPED
    gate.request(2, 0.03, take=True)
    assert not gate.release_estop(1)
    assert gate.estop
    assert gate.release_estop(2)
    assert gate.receive(2, 1, 0.0, 0.3, 0.0, 0.04) is Verdict.ACCEPTED


@pytest.mark.parametrize(
    ("key", "value"),
    [
        ("max_linear_mps", 0.0),
        ("watchdog_s", float("nan")),
        ("stop_repeat_s", -1.0),
        ("lease_timeout_s", 0),
        ("keep_alive_hz", 0),
        ("beat_timeout_s", -0.4),
        ("rate_hz", 5),
    ],
)
def test_bad_parameters_are_refused_by_name(key, value):
    with pytest.raises(ValueError, match="watchdog_s" if key == "rate_hz" else key):
        DriveConfig(**{key: value})


def frozen(gate, seconds, at=1.0, suspended_s=0.0):
    """Hold the key until ``at``, then freeze the console; return the time of its end."""
    for i in range(round(at / 0.05)):
        look_and_drive(gate, i * 0.05, 2 + i)
    assert gate.moving
    gate.look(at + seconds, round(suspended_s * 1e9))
    return at + seconds


def look_and_drive(gate, now, sequence, linear=0.3, suspended_s=0.0):
    """One message of the driver's page; return what becomes of it."""
    gate.look(now, round(suspended_s * 1e9))
    gate.touch(1, now)
    verdict = gate.receive(1, sequence, 0.0, linear, 0.0, now)
    gate.take_due(now)
    return verdict


@pytest.mark.parametrize(("seconds", "suspended_s"), [(1.6, 0.0), (8.0, 0.0), (0.02, 5.0)])
def test_a_console_that_stood_still_waits_for_a_release(seconds, suspended_s):
    """Frozen or suspended under a held key, which the page has sent all the time and goes on sending."""
    gate = driving_gate()
    now = frozen(gate, seconds, suspended_s=suspended_s)
    assert not gate.moving and not gate.driver_alive(now)
    verdicts = {look_and_drive(gate, now + i * 0.05, 100 + i, suspended_s=suspended_s) for i in range(60)}
    assert verdicts == {Verdict.HELD}
    assert not gate.moving
    for i in range(6):  # released: beats alone, and the page's zero
        assert look_and_drive(gate, now + 3.0 + i * 0.05, 200 + i, 0.0, suspended_s) is Verdict.ACCEPTED
    assert look_and_drive(gate, now + 3.3, 300, suspended_s=suspended_s) is Verdict.ACCEPTED
    assert gate.moving


def test_a_console_counts_as_long_still_after_stop_after_s():
    gate = DriveGate(DriveConfig(stop_after_s=0.5))
    assert gate.request(1, 0.0)
    assert look_and_drive(gate, frozen(gate, 0.6), 100) is Verdict.HELD


def test_after_a_short_freeze_of_the_console_the_held_key_drives_on():
    gate = driving_gate()
    now = frozen(gate, 0.8)
    assert not gate.moving and not gate.driver_alive(now)
    assert look_and_drive(gate, now, 100) is Verdict.ACCEPTED


@pytest.mark.parametrize("first", ["beat", "old command", "timer", "new lease"])
def test_what_a_thawed_console_handles_first_does_not_matter(first):
    gate = driving_gate()
    now = frozen(gate, 2.5)
    if first == "timer":
        assert gate.take_due(now) == (0.0, 0.0)
        assert gate.driver is None  # the lease has run out
    elif first == "old command":
        assert gate.receive(1, 99, 2.0, 0.3, 0.0, now) is Verdict.OLD
    elif first == "new lease":
        gate.leave(1, now)
    gate.request(1, now)
    gate.touch(1, now)
    assert look_and_drive(gate, now + 0.01, 100) is Verdict.HELD
    assert look_and_drive(gate, now + 0.24, 101) is Verdict.HELD
    assert look_and_drive(gate, now + 0.6, 102) is Verdict.HELD  # silence is no release: no page was heard
    gate.touch(1, now + 0.7)
    assert look_and_drive(gate, now + 0.86, 103) is Verdict.ACCEPTED


async def test_the_watchdog_outlives_an_error_of_the_bus(monkeypatch):
    backend, failed = Backend(), asyncio.Event()
    service = DriveService(backend, DriveConfig())
    service.gate.request(1, current().steady_s())
    service.command(1, 1, 0.0, 0.3, 0.0, current().steady_s())

    def fail(linear, angular):
        failed.set()
        raise RuntimeError

    with monkeypatch.context() as broken:
        broken.setattr(backend, "on_drive", fail)
        running = asyncio.create_task(service.run())
        await failed.wait()
    await backend.wait(lambda backend: backend.commands[-1] == (0.0, 0.0) and backend.operator[-1:] == [False])
    running.cancel()
