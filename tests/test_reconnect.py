"""Waits between attempts to connect."""

from instant_ic.util.reconnect import Backoff


def test_the_wait_stays_short_while_the_device_may_still_start_then_doubles() -> None:
    backoff = Backoff(min_s=0.5, max_s=2.0)
    waits = [backoff.fail(now_s) for now_s in (100.0, 100.5, 114.9, 115.0, 115.5, 116.5, 118.5)]
    assert waits == [0.5, 0.5, 0.5, 0.5, 1.0, 2.0, 2.0]


def test_a_lost_connection_is_no_start() -> None:
    backoff = Backoff(min_s=0.5, max_s=2.0)
    backoff.succeed()
    assert [backoff.fail(now_s) for now_s in (0.0, 0.5, 1.5)] == [0.5, 1.0, 2.0]
    backoff.succeed()
    assert backoff.fail(10.0) == 0.5
