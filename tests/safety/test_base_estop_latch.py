"""The rule by which the arbiter and the base latch and release the emergency stop."""

import pytest

from instant_ic.control.estop import EstopLatch

S = 1_000_000_000


def test_a_press_of_anybody_latches_and_a_newer_release_of_anybody_ends_it() -> None:
    latch = EstopLatch()
    assert not latch.stopped
    assert latch.hear(True, "console", 10 * S, 10 * S) == ""
    assert latch.stopped and latch.publisher == "console"
    assert latch.hear(False, "foxglove_bridge", 11 * S, 11 * S) == ""
    assert not latch.stopped


@pytest.mark.parametrize("order", [(0, 1), (1, 0)])
def test_an_old_release_ends_no_newer_stop_in_whatever_order_they_arrive(order: tuple[int, int]) -> None:
    latch = EstopLatch()
    kept = [(True, "console", 10 * S), (False, "foxglove_bridge", 9 * S)]
    for index in order:
        latch.hear(*kept[index], received_ns=20 * S)
    assert latch.stopped


def test_a_release_from_before_the_clock_was_set_back_ends_nothing() -> None:
    latch = EstopLatch()
    latch.hear(True, "console", 50 * S, 50 * S)  # the clock was set back from 100 s
    assert "ahead" in latch.hear(False, "host_bridge", 90 * S, 51 * S)
    assert latch.stopped
    assert latch.hear(False, "console", 52 * S, 52 * S) == ""
    assert not latch.stopped


def test_a_release_that_comes_again_later_ends_nothing() -> None:
    """Released at 100 s, clock set back, button pressed at 50 s; a bridge restarts at 105 s and sends it again."""
    latch = EstopLatch()
    latch.hear_button(True, "crawler_base", 50 * S)
    latch.hear_button(False, "crawler_base", 51 * S)
    assert "5.0 s old" in latch.hear(False, "host_bridge", 100 * S, 105 * S)
    assert latch.stopped
    assert latch.hear(True, "console", 49 * S, 106 * S) == ""  # comes again too, and changes nothing
    assert "6.0 s old" in latch.hear(False, "host_bridge", 100 * S, 106 * S)
    assert latch.hear(False, "host_bridge", 106 * S, 107 * S) == ""


def test_a_restarted_node_stays_released_if_the_last_release_is_newer_than_the_last_press() -> None:
    latch = EstopLatch()
    latch.hear(True, "foxglove_bridge", 105 * S, 200 * S)
    assert latch.stopped
    assert latch.hear(False, "console", 110 * S, 200 * S) == ""
    assert not latch.stopped


def test_stop_and_release_of_one_publisher_go_together_after_its_clock_was_set_back() -> None:
    latch = EstopLatch()
    latch.hear(True, "console", 100 * S, 100 * S)
    assert "older" in latch.hear(False, "console", 50 * S, 50 * S)
    latch.hear(True, "console", 51 * S, 51 * S)
    assert latch.hear(False, "console", 52 * S, 52 * S) == ""


def test_nothing_is_released_while_a_button_is_pressed() -> None:
    latch = EstopLatch()
    latch.hear_button(True, "crawler_base", 10 * S)
    latch.hear_button(False, "second_button", 11 * S)  # another button's value says nothing about the first
    assert "button" in latch.hear(False, "console", 12 * S, 12 * S)
    latch.hear_button(False, "crawler_base", 13 * S)
    assert latch.stopped  # releasing the button ends nothing by itself
    assert latch.hear(False, "console", 14 * S, 14 * S) == ""
    assert not latch.stopped


def test_a_release_older_than_the_button_press_is_refused() -> None:
    latch = EstopLatch()
    latch.hear_button(True, "crawler_base", 10 * S)
    latch.hear_button(False, "crawler_base", 11 * S)
    assert "older" in latch.hear(False, "console", 9 * S, 12 * S)
    assert latch.stopped


def test_only_the_node_through_which_the_driver_drives_releases_the_stop() -> None:
    latch = EstopLatch()
    latch.hear(True, "foxglove_bridge", 10 * S, 10 * S)
    assert "only console/page 1 may" in latch.hear(False, "foxglove_bridge", 11 * S, 11 * S, "console/page 1")
    assert "nobody drives" in latch.hear(False, "console", 11 * S, 11 * S, "")
    assert latch.stopped
    assert latch.hear(False, "console", 11 * S, 11 * S, "console/page 1") == ""
    assert not latch.stopped


def test_a_restarted_node_needs_no_driver_to_hear_again_of_a_stop_that_was_released() -> None:
    latch = EstopLatch()
    latch.hear(True, "foxglove_bridge", 105 * S, 200 * S)
    assert latch.hear(False, "console", 110 * S, 200 * S, "") == ""
    assert not latch.stopped
