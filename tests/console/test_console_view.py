"""Look direction, shape and pace of the rendered views; maps as PNG."""

import math

import cv2
import numpy as np
import pytest

from instant_ic.console.gridimage import grid_image
from instant_ic.console.view import Lead, LeadConfig, Look, ViewConfig, ViewScheduler, view_shape


def test_look_left_and_up():
    line_of_sight = Look(yaw=math.pi / 2).rotation()[:3, 0]
    np.testing.assert_allclose(line_of_sight, [0, 1, 0], atol=1e-12)  # left is +y
    line_of_sight = Look(pitch=math.pi / 6).rotation()[:3, 0]
    np.testing.assert_allclose(line_of_sight, [math.sqrt(3) / 2, 0, 0.5], atol=1e-12)  # up is +z
    line_of_sight = Look(yaw=math.pi / 2, pitch=math.pi / 6).rotation()[:3, 0]
    np.testing.assert_allclose(line_of_sight, [0, math.sqrt(3) / 2, 0.5], atol=1e-12)


def test_view_covers_what_is_shown_with_the_margin():
    # 16:9 window: tan(45°) = 1, tan(vfov/2) = 9/16
    look = Look(hfov=math.pi / 2, vfov=2 * math.atan(9 / 16))
    shape = view_shape(look, ViewConfig(width=320, height=180, fov_margin=1.15))
    assert shape.fov_rad >= math.pi / 2 * 1.15 - 1e-9
    vertical = 2 * math.atan(math.tan(shape.fov_rad / 2) * shape.height / shape.width)
    assert vertical >= look.vfov * 1.15 - 0.03
    assert shape.width % 8 == shape.height % 8 == 0
    assert abs(shape.width * shape.height / (320 * 180) - 1) < 0.1


def test_portrait_window_gets_a_portrait_view_of_as_many_pixels():
    shape = view_shape(Look(hfov=0.6, vfov=1.2), ViewConfig())
    assert shape.height > shape.width
    assert abs(shape.width * shape.height / (320 * 180) - 1) < 0.1


def test_extreme_windows_stay_within_a_drawable_field_of_view():
    shape = view_shape(Look(hfov=2.6, vfov=0.1), ViewConfig())
    assert shape.fov_rad <= math.radians(150) + 1e-9
    assert shape.width / shape.height < 2.7


def test_one_request_outstanding_and_the_rate_of_the_mode():
    views = ViewScheduler(ViewConfig(virtual_rate_hz=10, real_rate_hz=1, response_timeout_s=0.5))
    assert views.due(0.0, virtual=True)
    first = views.asked(0.0)
    assert not views.due(0.2, virtual=True)  # unanswered
    assert not views.answered(first + 7)
    assert not views.due(0.2, virtual=True)
    assert views.answered(first)
    assert views.due(0.2, virtual=True)
    assert not views.due(0.2, virtual=False)  # 1 Hz in the real mode
    assert views.due(1.0, virtual=False)


def test_what_moves_after_a_rest_is_asked_for_at_once():
    views = ViewScheduler(ViewConfig(virtual_rate_hz=10, still_rate_hz=5))
    assert views.due(0.0, virtual=True, moves=False)
    views.answered(views.asked(0.0))
    assert not views.due(0.12, virtual=True, moves=False)  # 5 Hz
    assert views.due(0.03, virtual=True, moves=True)
    views.answered(views.asked(0.03))
    assert not views.due(0.10, virtual=True, moves=True)  # then 10 Hz
    assert views.due(0.13, virtual=True, moves=True)


def test_watchers_are_served_in_turn_where_the_driver_does_not_wait_for_it():
    views = ViewScheduler(ViewConfig(virtual_rate_hz=10, watcher_rate_hz=2))
    driver, watchers = Look(), {1: Look(yaw=1.0), 2: Look(pitch=-0.6), 3: Look(yaw=0.2)}

    def one_for_the_driver(at, takes):
        assert views.due(at, virtual=True)
        views.answered(views.asked(at), at + takes)

    one_for_the_driver(0.0, takes=0.07)
    assert views.watcher(0.07, driver, watchers) is None  # ready at 0.14: the driver's next is due at 0.1
    one_for_the_driver(0.1, takes=0.03)
    first = views.watcher(0.13, driver, watchers)
    number = views.asked(0.13, first)
    assert views.watcher(0.14, driver, watchers) is None and not views.due(0.2, virtual=True)  # one outstanding
    assert views.answered(number, 0.16)
    assert views.page_of(number) == first
    one_for_the_driver(0.2, takes=0.03)
    second = views.watcher(0.23, driver, watchers)
    assert {first, second} == {1, 2}  # 3 looks where the driver looks
    views.answered(views.asked(0.23, second), 0.26)
    one_for_the_driver(0.3, takes=0.03)
    assert views.watcher(0.33, driver, watchers) is None  # each has had one within half a second
    assert views.watcher(0.33, driver, {}) is None
    one_for_the_driver(0.7, takes=0.03)
    assert views.watcher(0.73, driver, watchers) == first
    assert views.page_of(99) is None


def test_lines_of_sight_apart():
    assert Look(yaw=0.3).apart(Look(yaw=-0.2)) == pytest.approx(0.5)
    assert Look(yaw=3.0).apart(Look(yaw=-3.0)) == pytest.approx(2 * math.pi - 6.0)
    assert Look(pitch=0.4).apart(Look(pitch=0.4)) == pytest.approx(0.0, abs=1e-6)


def test_answer_that_never_comes_does_not_stop_the_requests():
    views = ViewScheduler(ViewConfig(response_timeout_s=0.5))
    views.asked(0.0)
    assert not views.due(0.49, virtual=True)
    assert views.due(0.5, virtual=True)
    assert views.lost == 1


def test_no_requests_at_rate_zero():
    assert not ViewScheduler(ViewConfig(real_rate_hz=0)).due(100.0, virtual=False)


@pytest.mark.parametrize(
    ("key", "value"), [("width", 8), ("fov_margin", 0.9), ("virtual_rate_hz", 0), ("response_timeout_s", 0)]
)
def test_bad_view_parameters_are_refused_by_name(key, value):
    with pytest.raises(ValueError, match=key):
        ViewConfig(**{key: value})


def test_grid_is_cropped_and_turned_top_down():
    grid = np.full((20, 30), -1, np.int8)
    grid[5, 10] = 100  # row 5: y = 2.5
    grid[8, 14] = 0
    image = grid_image(grid, 0.5, (-1.0, -2.0))
    # 2 cells of margin: columns 8..16, rows 3..10
    assert image.header == {"resolution": 0.5, "width": 9, "height": 8, "x": -1 + 8 * 0.5, "y": -2 + 3 * 0.5}
    cells = cv2.imdecode(np.frombuffer(image.png, np.uint8), cv2.IMREAD_UNCHANGED)
    assert cells.shape == (8, 9)
    assert cells[7 - (5 - 3), 10 - 8] == 100
    assert cells[7 - (8 - 3), 14 - 8] == 0
    assert np.count_nonzero(cells == 255) == 70


def test_unknown_grid_is_no_picture_and_same_grid_same_digest():
    assert grid_image(np.full((4, 4), -1, np.int8), 0.1, (0, 0)) is None
    grid = np.zeros((4, 4), np.int8)
    assert grid_image(grid, 0.1, (0, 0)).digest == grid_image(grid.copy(), 0.1, (0, 0)).digest
    assert grid_image(grid, 0.1, (0, 0)).digest != grid_image(grid, 0.1, (1, 0)).digest


def test_the_lead_comes_and_goes_in_its_time():
    lead = Lead(LeadConfig(seconds=0.8))
    assert lead.step(10.0, True) == 0.0
    assert lead.step(10.2, True) == pytest.approx(0.25)
    assert lead.step(11.2, True) == 1.0
    assert lead.step(11.4, False) == pytest.approx(0.75)
    assert lead.step(13.0, False) == 0.0
    at_once = Lead(LeadConfig(seconds=0.0))
    assert [at_once.step(t, t < 2) for t in (0, 1, 2)] == [1.0, 1.0, 0.0]


def test_the_displayed_place_goes_with_the_vbot_up_to_the_limit_and_no_other_place_counts():
    lead = Lead(LeadConfig(max_m=0.3, seconds=0.0))
    here = np.array([1.0, 2.0])
    assert lead.displayed(here, here + [0.2, 0]) == pytest.approx(here)  # at the switch
    lead.step(0.0, True)
    assert lead.displayed(here, here + [0.2, 0]) == pytest.approx([1.2, 2.0])
    assert lead.displayed(here, here + [0.3, -0.4]) == pytest.approx([1.18, 1.76])  # 0.3 of 0.5 m
    assert lead.displayed(here, here) == pytest.approx(here)
    assert lead.displayed(here, here + [1.2, 0]) == pytest.approx(here)
    never = Lead(LeadConfig(max_m=0.0, seconds=0.0))
    never.step(0.0, True)
    assert never.displayed(here, here + [0.2, 0]) == pytest.approx(here)
