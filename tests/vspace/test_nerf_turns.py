"""Pictures and training by turns, with a clock that only the work moves."""

import pytest

from instant_ic.vspace.worker import LEAST_SHARE, Turns


def run(render_ms, asks_fps, render_fps=10.0, train_ms=50.0, seconds=20.0, trains=True, iteration_ms=5.0):
    """A device for some seconds; somebody asks for the newest picture at a rate (0: nobody).

    Returns:
        Pictures a second, training's share of the time, and the longest that a picture asked for had to wait, ms.
    """
    turns, now, rendered, trained, waited = Turns(render_fps, train_ms), 0.0, 0, 0.0, 0.0
    next_ask, asked_at = (0.0 if asks_fps else float("inf")), None
    while now < seconds * 1e3:
        if now >= next_ask:
            asked_at = asked_at if asked_at is not None else now
            next_ask += 1e3 / asks_fps
        if asked_at is not None and turns.renders_next(trains):
            waited, asked_at = max(waited, now - asked_at), None
            now += render_ms
            rendered += 1
            turns.rendered(render_ms)
        elif trains:
            budget, start = turns.budget_ms(), now
            while now - start < budget:  # whole iterations, one at least
                now += iteration_ms
            trained += now - start
        else:
            now = next_ask if asked_at is None else now
    return rendered / seconds, trained / (seconds * 1e3), waited


def test_the_rate_that_is_asked_for_is_held_and_training_has_the_rest():
    rate, share, _ = run(render_ms=40, asks_fps=30, render_fps=10)
    assert rate >= 10 * 0.95  # an iteration that has begun is ended
    assert share == pytest.approx(0.55, abs=0.06)  # 50 of 90 ms
    rate, share, _ = run(render_ms=40, asks_fps=30, render_fps=20)
    assert rate == pytest.approx(20, rel=0.1)
    assert share == pytest.approx(0.2, abs=0.06)  # 10 of 50 ms


def test_a_slow_device_draws_most_of_the_time_and_training_does_not_starve():
    rate, share, _ = run(render_ms=200, asks_fps=30, render_fps=10)
    assert share == pytest.approx(LEAST_SHARE / (1 + LEAST_SHARE), abs=0.02)
    assert rate == pytest.approx(1 / 0.25, rel=0.05)


def test_a_picture_waits_no_longer_than_training_may_take():
    _, share, waited = run(render_ms=10, asks_fps=2, train_ms=30)
    assert waited <= 30 + 5
    assert share > 0.95  # between two pictures training has it all


def test_when_nobody_asks_training_has_it_all_and_idles_when_it_has_ended():
    assert run(render_ms=40, asks_fps=0)[1] == pytest.approx(1.0, abs=0.01)
    rate, share, waited = run(render_ms=40, asks_fps=15, trains=False)
    assert (share, waited) == (0, 0)
    assert rate == pytest.approx(15, rel=0.02)
