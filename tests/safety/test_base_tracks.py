"""A track that does not follow its command: dead or reversed encoder, stalled motor."""

import numpy as np
import pytest
from base_line import Base, NodeBench
from hypothesis import given, settings
from hypothesis import strategies as st

from instant_ic.base.config import RoboclawConfig
from instant_ic.base.controller import ControllerConfig
from instant_ic.base.following import TrackWatch
from instant_ic.base.limits import TwistLimiter
from instant_ic.bus import ERROR, OK


@pytest.mark.parametrize("counts", [0.0, -1.0], ids=["dead", "reversed"])
@pytest.mark.parametrize("motor", [0, 1])
@pytest.mark.parametrize("speed", [0.1, 0.4])
def test_a_motor_without_counts_does_not_run_on_at_full_speed(counts: float, motor: int, speed: float) -> None:
    base = Base()
    base.run(2.0, speed)
    assert not any(state.fault for state in base.states)
    base.line.encoders[motor] = counts
    took_s, _ = base.until_standing(speed)
    assert took_s <= 0.03 / speed + 0.15 + 0.5  # to notice, and to brake from full speed
    faults = [state.fault for state in base.states if state.fault]
    assert (
        len(faults) == 1
        and f"the {('left', 'right')[motor]} track does not follow its command of {speed:.2f} m/s" in faults[0]
    )
    assert "check its encoder" in faults[0]


def test_a_dead_encoder_is_found_while_the_robot_starts_or_turns() -> None:
    for v, w in ((0.4, 0.0), (-0.3, 0.0), (0.0, 0.6), (0.0, -0.6)):
        base = Base()
        base.run(1.0, 0.0)
        base.line.encoders[0] = 0.0
        base.run(3.0, v, w)
        assert base.line.speed == 0.0 and sum(bool(state.fault) for state in base.states) == 1


def test_two_dead_encoders_or_stalled_motors_stop_the_base_too() -> None:
    for stalled in (False, True):
        base = Base()
        base.run(2.0, 0.4)
        base.line.stalled, base.line.encoders[:] = stalled, float(stalled)
        took_s, _ = base.until_standing(0.4)
        assert took_s <= 1.0
        assert sum(bool(state.fault) for state in base.states) == 1
        assert base.states[-1].v == 0.0 and not base.line.emulator.target_speed_pps.any()


def test_the_stop_is_an_emergency_stop_that_the_operator_releases() -> None:
    bench = NodeBench()
    bench.run(1.0, 0.3)
    assert bench.diagnosis("tracks") == (OK, "both follow")
    bench.line.encoders[1] = 0.0
    bench.run(2.0, 0.3)
    assert bench.line.speed == 0.0
    level, text = bench.diagnosis("tracks")
    assert level == ERROR and "right track" in text and "release the emergency stop" in text
    pressed = [message.data for message in bench.bus.messages("/robot/estop")]
    assert pressed == [False, True, False], "pressed for the arbiter too, and let go so that it can be released"
    assert bench.node.latch.stopped
    bench.line.encoders[1] = 1.0
    bench.estop(False)
    bench.run(1.0, 0.3)
    assert bench.line.speed > 0.2
    assert bench.diagnosis("tracks") == (OK, "both follow")


@pytest.mark.parametrize("seed", [19, 23])
def test_a_loop_that_comes_late_makes_no_fault(seed: int) -> None:
    """On a busy machine a step may come 0.28 s after the last, and only then the tracks hear of the next speed."""
    rng = np.random.default_rng(seed)
    base = Base()
    for _ in range(12):
        v, w = rng.uniform(-0.5, 0.5), rng.uniform(-1.0, 1.0)
        for _ in range(rng.integers(1, 30)):
            base.line.advance(rng.uniform(1 / 30, 0.28) if rng.random() < 0.3 else 1 / 30)
            base.controller.command(v, w, base.steady_ns())
            assert base.step().fault == ""


@pytest.mark.parametrize("counts", [0.0, -1.0], ids=["dead", "reversed"])
def test_a_loop_that_comes_late_still_finds_a_fault(counts: float) -> None:
    base = Base()
    base.run(2.0, 0.4)
    base.line.encoders[0] = counts
    for _ in range(5):
        base.line.advance(0.15)
        base.controller.command(0.4, 0.0, base.steady_ns())
        base.step()
    assert sum(bool(state.fault) for state in base.states) == 1


@settings(max_examples=20, deadline=None)
@given(
    seed=st.integers(0, 2**32 - 1),
    lag_s=st.floats(0.02, 0.2),
    acceleration=st.floats(1.0, 3.0),
    late=st.floats(0.0, 0.3),
)
def test_sound_tracks_are_never_stopped(seed: int, lag_s: float, acceleration: float, late: float) -> None:
    """Any commands, motors of any lag and strength, steps of a busy machine."""
    drive(seed, late, Tracks(lag_s, acceleration), TrackWatch())


@settings(max_examples=20, deadline=None)
@given(seed=st.integers(0, 2**32 - 1), late=st.floats(0.0, 0.3))
def test_a_simulation_that_comes_late_or_pauses_makes_no_fault(seed: int, late: float) -> None:
    """It steps up to 0.25 s at once, with the newest speeds only, and leaves out what lacks beyond that."""
    drive(seed, late, LateTracks(np.random.default_rng([1, seed]), late), TrackWatch(simulated=True))


class Tracks:
    """Tracks that follow their set point with a lag and a limited acceleration."""

    def __init__(self, lag_s: float = 0.06, acceleration: float = 2.0) -> None:
        self.lag_s, self.acceleration = lag_s, acceleration
        self.wanted, self.speeds, self.counts = np.zeros(2), np.zeros(2), np.zeros(2)

    def advance(self, dt_s: float) -> None:
        count = int(dt_s / 0.01) + 1
        part_s = dt_s / count
        for _ in range(count):
            change = (self.wanted - self.speeds) * (1 - np.exp(-part_s / self.lag_s))
            most = self.acceleration * part_s
            self.speeds = self.speeds + np.clip(change, -most, most)
            self.counts = self.counts + self.speeds * part_s


class LateTracks(Tracks):
    """Tracks of a simulation whose steps wait for the processor: often for up to 0.25 s, sometimes for up to 0.4 s."""

    def __init__(self, rng: np.random.Generator, late: float) -> None:
        super().__init__()
        self.rng, self.late, self.since_s, self.due_s = rng, late, 0.0, 0.0

    def advance(self, dt_s: float) -> None:
        self.since_s += dt_s
        while self.since_s >= self.due_s:
            super().advance(min(self.due_s, 0.25))
            self.since_s -= self.due_s
            self.due_s = self.rng.uniform(0.0, 0.25) if self.rng.random() < self.late else 0.01
            if self.rng.random() < 0.004:
                self.due_s = self.rng.uniform(0.25, 0.4)


def drive(seed: int, late: float, tracks: Tracks, watch: TrackWatch) -> None:
    """Drives by random commands, in steps of 1/30 s of which a share comes late; no step may find a fault."""
    rng = np.random.default_rng(seed)
    config = ControllerConfig(roboclaw=RoboclawConfig(port="memory"))
    limiter, kinematics = TwistLimiter(config.limits), Base().controller.odometry.kinematics
    for _ in range(40):
        v, w = rng.uniform(-1, 1, 2) * rng.choice([0.0, 1.0, 3.0], 2)
        for _ in range(rng.integers(1, 40)):
            dt_s = 1 / 30 + (rng.uniform(0.0, 0.25) if rng.random() < late else 0.0)
            before = tracks.counts
            tracks.advance(dt_s)
            watch.commanded(tracks.wanted, dt_s)
            assert watch.counted(tracks.counts - before) == ""
            tracks.wanted = kinematics.tracks_from_twist(*limiter.step(v, w, dt_s))
