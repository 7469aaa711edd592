"""The serial line breaks while the tracks run: replies lost, commands lost or damaged, or both."""

import random
from collections.abc import Callable

import pytest
from base_line import Base, Line

from instant_ic.base.config import ControllerConfig, RoboclawConfig
from instant_ic.base.protocol import MOTORS_OFF, Command, write_frame
from instant_ic.base.roboclaw import LinkError, Roboclaw

STOP = write_frame(0x80, Command.DUTY_ACCELERATION_BOTH, MOTORS_OFF)
LOST: Callable[[bytes], bytes] = lambda data: b""  # noqa: E731 - a line, not a function


def driving(v: float = 0.5, phase_s: float = 0.0, **roboclaw: object) -> Base:
    base = Base(ControllerConfig(roboclaw=RoboclawConfig(port="memory", **roboclaw)))  # type: ignore[arg-type]
    base.run(1.5 + phase_s, v)
    assert base.line.speed == pytest.approx(v, abs=0.01)
    return base


@pytest.mark.parametrize(("command", "phase_s"), [(0.0, 0.008), (0.5, 0.0), (0.5, 0.017)])
def test_lost_replies_stop_the_tracks_within_0_45_s(command: float, phase_s: float) -> None:
    base = driving(phase_s=phase_s)
    base.line.back = LOST
    stand_s, distance_m = base.until_standing(command)
    assert stand_s <= 0.45
    assert distance_m <= 0.15


def test_a_cut_line_stops_the_tracks_by_the_controllers_watchdog() -> None:
    base = driving()
    base.line.back = base.line.forward = LOST
    stand_s, _ = base.until_standing(0.5)
    assert base.line.emulator.watchdog_fired
    assert stand_s <= 0.55


def test_nothing_that_feeds_the_watchdog_but_a_stop_is_sent_until_a_stop_is_acknowledged() -> None:
    """Noise that damages long frames lets short requests through: only speed zero may go out."""
    base = driving()
    base.line.forward = lambda data: data if len(data) == 2 else data[:-1] + bytes((data[-1] ^ 1,))
    base.line.back = LOST
    before, lost_s = len(base.line.written), base.line.time_s
    stand_s, _ = base.until_standing(0.5)
    first, *later = (frame for _, frame in base.line.written[before:])
    assert first[1] in (Command.SPEED_ACCELERATION_BOTH, Command.READ_ENCODERS)  # what was under way
    frames = set(later)
    assert STOP in frames and len(later) > 10
    assert frames == {STOP}
    assert base.line.emulator.watchdog_fired and stand_s <= 0.6
    assert base.line.opened > 2, "it went on trying"
    assert base.line.time_s - lost_s > 1.0


def test_a_stop_is_written_before_the_port_is_closed_and_first_on_every_reconnect() -> None:
    base = driving()
    closings: list[bytes] = []
    close = base.line.close

    def watch() -> None:
        closings.append(base.line.written[-1][1])
        close()

    base.line.close = watch  # type: ignore[method-assign]
    base.line.back = LOST
    opened = base.line.opened
    base.run(6.0, 0.5)
    assert len(closings) >= 3 and set(closings) == {STOP}
    assert base.line.opened - opened >= 3
    base.line.back = bytes
    base.run(2.5, 0.5)
    assert base.states[-1].connected
    assert base.line.emulator.timeout_s == pytest.approx(0.3)
    assert base.line.speed > 0.3  # and it drives again


def test_one_missing_reply_stops_and_goes_on_without_a_new_connection() -> None:
    base = driving()
    missing = [True]
    base.line.back = lambda reply: b"" if missing and missing.pop() else reply
    base.run(0.25, 0.5)
    assert base.controller.roboclaw.counters.stops == 1
    assert base.line.speed < 0.5
    base.run(1.5, 0.5)
    assert base.line.opened == 1
    assert base.line.speed == pytest.approx(0.5, abs=0.01)


def test_a_command_to_drive_is_not_repeated_after_a_missing_reply() -> None:
    base = driving(retries=5)
    base.line.back = LOST
    lost = len(base.line.written)
    base.run(1.0, 0.5)
    drives = [frame for _, frame in base.line.written[lost:] if frame[1] == Command.SPEED_ACCELERATION_BOTH]
    assert len(drives) <= 1


@pytest.mark.parametrize("seed", range(2))
def test_a_noisy_line_never_lets_the_tracks_run_on(seed: int) -> None:
    """Each frame and each reply is lost, damaged or cut at random; no command comes any more: the tracks stand."""
    base = driving()
    rng = random.Random(seed)

    def noise(data: bytes) -> bytes:
        kind = rng.randrange(4)
        if not data or kind == 0:
            return data
        if kind == 1:
            return b""
        at = rng.randrange(len(data))
        return data[:at] if kind == 2 else data[:at] + bytes((data[at] ^ 1 << rng.randrange(8),)) + data[at + 1 :]

    base.line.forward = base.line.back = noise
    stand_s, _ = base.until_standing(None, limit_s=8.0)
    # No worse than all that there is in a row: the command's age, a step, the watchdog and the tracks' own time.
    assert stand_s <= 0.25 + 0.034 + 0.3 + 0.26


def test_unplugged_while_driving_the_watchdog_stops_the_tracks() -> None:
    base = driving()

    def gone(data: bytes) -> bytes:
        raise OSError(5, "Input/output error")

    base.line.forward = gone
    stand_s, _ = base.until_standing(0.5)
    assert stand_s <= 0.55


def late_line(seed: int) -> tuple[Roboclaw, Line, list[int]]:
    """A line at 38400 baud whose replies come up to 110 ms late and whose frames are lost now and then."""
    line, rng, understood = Line(RoboclawConfig(port="memory", baud=38400), ideal_motors=True), random.Random(seed), []
    roboclaw = Roboclaw(line.config, line.open, line.advance)
    roboclaw.connect()

    def forward(data: bytes) -> bytes:
        if rng.random() < 0.2:
            return b""
        understood.append(data[1])
        return data

    line.forward, line.late_s = forward, lambda: rng.choice([0.002, 0.002, 0.11])
    return roboclaw, line, understood


@pytest.mark.parametrize("seed", range(3))
def test_an_acknowledgement_110_ms_late_never_acknowledges_the_next_command(seed: int) -> None:
    """The controller has understood each command that counts as acknowledged; a command to drive, or a stop for it."""
    roboclaw, line, understood = late_line(seed)
    acknowledged = 0
    for number in range(30):
        understood.clear()
        moves = number % 3 != 0
        try:
            if moves:
                roboclaw.drive([100.0, 100.0], 4000.0)
            else:
                roboclaw.set_watchdog(0.3)
        except LinkError:
            line.advance(0.3)
            continue
        acknowledged += 1
        wanted = {Command.SPEED_ACCELERATION_BOTH, Command.DUTY_ACCELERATION_BOTH} if moves else {Command.SET_TIMEOUT}
        assert wanted & set(understood)
    assert acknowledged > 5
