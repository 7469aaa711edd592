"""Look direction, shape and pace of the rendered views; maps as PNG."""

import math
from types import SimpleNamespace

import cv2
import numpy as np
import pytest

from instant_ic.console.gridimage import grid_image
from instant_ic.console.view import Look, ViewConfig, view_shape
from instant_ic.console.view_requests import ViewRequests


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
    shape = view_shape(look, ViewConfig(width=320, height=180))
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


def requested(views, at_s, needed=True):
    """Id of the request that is made at a time; None if none is due."""
    request = views.next(renders=True, needed=needed, stamp_ns=0, now_ns=round(1e9 * at_s))
    return request and request.id


@pytest.fixture
def views():
    scene = SimpleNamespace(vbot_pose=lambda: np.eye(4), camera_mount=lambda: np.eye(4))
    config = ViewConfig(virtual_rate_hz=10)
    return ViewRequests(config, scene, SimpleNamespace(with_vbot=True))


def test_one_request_outstanding_and_the_wanted_rate(views):
    assert requested(views, 5.0) == 1
    assert requested(views, 5.2) is None  # unanswered
    views.answered(8, round(5.2e9))
    assert requested(views, 5.2) is None
    assert views.answered(1, round(5.2e9)) == pytest.approx(0.2)
    assert requested(views, 5.09) is None
    assert requested(views, 5.2, needed=False) is None  # only judged: once a second
    assert requested(views, 5.2) == 2


def test_answer_that_never_comes_does_not_stop_the_requests(views):
    assert requested(views, 5.0) == 1
    assert requested(views, 5.49) is None
    assert requested(views, 5.5) == 2
    assert views.answered(1, round(6e9)) == pytest.approx(1.0)  # late: its delay counts
    assert requested(views, 5.9) is None  # the second is still outstanding


@pytest.mark.parametrize(("key", "value"), [("width", 8), ("virtual_rate_hz", 0)])
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


def test_every_cell_value_becomes_a_grey_value_with_any_numpy() -> None:
    """NumPy 2.5 refuses ``np.where(cells < 0, 255, cells)`` for int8 cells: no map appeared."""
    grid = np.arange(-128, 128).astype(np.int8).reshape(16, 16)
    image = grid_image(np.ascontiguousarray(grid), 0.1, (0, 0))
    assert image is not None
    grey = cv2.imdecode(np.frombuffer(image.png, np.uint8), cv2.IMREAD_GRAYSCALE)[::-1]
    assert grey[-8:].ravel().tolist() == list(range(128))
    assert np.all(grey[:-8] == 255)  # the margin, unknown


def test_unknown_grid_is_no_picture_and_same_grid_same_digest():
    assert grid_image(np.full((4, 4), -1, np.int8), 0.1, (0, 0)) is None
    grid = np.zeros((4, 4), np.int8)
    assert grid_image(grid, 0.1, (0, 0)).digest == grid_image(grid.copy(), 0.1, (0, 0)).digest
    assert grid_image(grid, 0.1, (0, 0)).digest != grid_image(grid, 0.1, (1, 0)).digest
