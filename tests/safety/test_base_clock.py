"""The machine's clock is set while the base runs: no command becomes fresh again, none is lost for long."""

import pytest
from base_line import NodeBench

S = 1_000_000_000


@pytest.mark.parametrize("back_s", [0.1, 3600.0])
def test_an_old_command_never_becomes_fresh_when_the_clock_is_set_back(back_s: float) -> None:
    bench = NodeBench()
    bench.run(1.0, v=0.43)
    bench.stopping()  # the arbiter is gone
    bench.run(back_s if back_s < 5.0 else 1.0)
    bench.clock.set_by_ns = -round(back_s * S)
    before_m = bench.line.travelled_m
    for _ in range(15):
        bench.run(0.1)
        bench.clock.set_by_ns -= S // 20  # and again and again
        assert bench.line.speed == 0.0
    assert bench.line.travelled_m == before_m


def test_a_command_stamped_ahead_is_refused() -> None:
    bench = NodeBench()
    bench.run(0.5)
    for ahead_s in (0.001, 0.1, 0.2, 5.0, 3600.0):
        bench.command(0.4, ahead_s=ahead_s)
        assert "ahead" in bench.diagnosis("command")[1]
    bench.run(1.0)
    assert bench.line.travelled_m == 0.0 and bench.node.source.dropped == 5


def test_the_time_on_the_way_counts_to_the_age() -> None:
    """A command that took 0.2 s to come holds for the rest of its time only."""
    bench = NodeBench(command_timeout_s=0.25)
    bench.run(1.0, v=0.4)
    bench.command(0.4, ahead_s=-0.2)
    stand_s, _ = bench.stopping()
    fresh = NodeBench(command_timeout_s=0.25)
    fresh.run(1.0, v=0.4)
    fresh.command(0.4)
    fresh_s, _ = fresh.stopping()
    assert stand_s == pytest.approx(fresh_s - 0.2, abs=0.034)


@pytest.mark.parametrize("set_s", [-3600.0, 3600.0], ids=["back", "forward"])
def test_driving_and_odometry_go_on_when_the_clock_is_set(set_s: float) -> None:
    bench = NodeBench()
    bench.run(1.0, v=0.4)
    bench.clock.set_by_ns = round(set_s * S)
    before = len(bench.bus.records("/wheel/odom"))
    bench.run(1.0, v=0.4)
    assert bench.line.speed == pytest.approx(0.4, abs=0.01)
    later = bench.bus.messages("/wheel/odom")[before:]
    assert len(later) >= 29
    assert all(abs(message.header.stamp.sec - bench.clock.now_ns() // S) <= 1 for message in later)
    assert later[-1].twist.twist.linear.x == pytest.approx(0.4, abs=0.02)
