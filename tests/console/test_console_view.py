"""Look direction, shape and pace of the rendered views; maps as PNG."""

import math

import cv2
import numpy as np

from instant_ic.console.gridimage import grid_image
from instant_ic.console.view import Look, ViewConfig, view_shape


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
    fov_rad, width, height = view_shape(look, ViewConfig(width=320, height=180))
    assert fov_rad >= math.pi / 2 * 1.15 - 1e-9
    vertical = 2 * math.atan(math.tan(fov_rad / 2) * height / width)
    assert vertical >= look.vfov * 1.15 - 0.03
    assert width % 8 == height % 8 == 0
    assert abs(width * height / (320 * 180) - 1) < 0.1


def test_extreme_windows_stay_within_a_drawable_field_of_view():
    fov_rad, width, height = view_shape(Look(hfov=2.6, vfov=0.1), ViewConfig())
    assert fov_rad <= math.radians(150) + 1e-9
    assert width / height < 2.7


def test_grid_is_cropped_and_turned_top_down():
    grid = np.full((20, 30), -1, np.int8)
    grid[5, 10] = 100  # row 5: y = 2.5
    grid[8, 14] = 0
    image = grid_image(grid, 0.5, (-1.0, -2.0))
    # 2 cells of margin: columns 8..16, rows 3..10
    assert image.header == {"resolution": 0.5, "width": 9, "height": 8, "x": -1 + 8 * 0.5, "y": -2 + 3 * 0.5}
    cells = cv2.imdecode(np.frombuffer(image.payload, np.uint8), cv2.IMREAD_UNCHANGED)
    assert cells.shape == (8, 9)
    assert cells[7 - (5 - 3), 10 - 8] == 100
    assert cells[7 - (8 - 3), 14 - 8] == 0
    assert np.count_nonzero(cells == 255) == 70
