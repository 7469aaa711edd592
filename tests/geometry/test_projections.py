"""Projections: directions by hand, there and back, faces that join."""

import math

import numpy as np
import pytest

from instant_ic.geometry import projections as pr


def test_equirect_conventions_by_hand():
    directions = pr.equirect_directions(8, 4)
    assert directions.shape == (4, 8, 3)
    assert np.linalg.norm(directions, axis=-1) == pytest.approx(np.ones((4, 8)))
    # The seam between columns 3 and 4 looks forward; columns to its right look to the right (y < 0).
    forward = directions[1:3, 3:5].mean(axis=(0, 1))
    assert forward[0] > 0.8 and forward[1:] == pytest.approx([0, 0], abs=1e-6)
    assert directions[1, 5, 1] < 0 < directions[1, 2, 1]
    assert directions[0, 0, 2] > 0 > directions[3, 0, 2]
    assert directions[1, 0, 0] < 0 and directions[1, 7, 0] < 0  # both edges look back
    # Row 0 of four is centred on 67.5° elevation.
    assert math.asin(directions[0, 0, 2]) == pytest.approx(math.radians(67.5), abs=1e-6)


def test_pixels_of_directions_there_and_back():
    directions = pr.equirect_directions(64, 32)
    u, v = pr.equirect_pixels(directions, 64, 32)
    assert u == pytest.approx(np.broadcast_to(np.arange(64), (32, 64)), abs=1e-4)
    assert v == pytest.approx(np.broadcast_to(np.arange(32)[:, None], (32, 64)), abs=1e-4)


def test_pixel_of_forward_left_and_behind():
    axes = np.array([[1.0, 0, 0], [0, 1, 0], [0, -1, 0], [-1, 1e-9, 0], [0, 0, 1]])
    u, v = pr.equirect_pixels(axes, 100, 50)
    assert u[:4] == pytest.approx([49.5, 24.5, 74.5, -0.5])
    assert v == pytest.approx([24.5, 24.5, 24.5, 24.5, -0.5])


def test_perspective_by_hand():
    directions = pr.perspective_directions(4, 2, math.pi / 2)
    # 90° over four pixels: centres at ±0.25 and ±0.75 of the plane x = 1; left is y > 0, up is z > 0.
    assert directions[0, :, 1] == pytest.approx([0.75, 0.25, -0.25, -0.75])
    assert directions[:, 0, 2] == pytest.approx([0.25, -0.25])
    with pytest.raises(ValueError, match="hfov_rad must lie"):
        pr.perspective_directions(4, 2, math.pi)


def test_sampling_wraps_at_the_seam():
    image = np.zeros((2, 4), np.float32)
    image[:, 0], image[:, 3] = 10, 20
    behind = np.array([[-1.0, 0.0, 0.0]])
    assert pr.sample_equirect(image, behind) == pytest.approx([15])


def test_faces_join_and_hold_the_direction_they_look_along():
    directions = pr.equirect_directions(256, 128)
    faces = pr.equirect_to_cube(directions, 32)  # a panorama whose colour is its direction
    for face, rotation in zip(faces, pr.CUBE_FACES.values(), strict=True):
        centre = face[15:17, 15:17].mean(axis=(0, 1))
        assert centre / np.linalg.norm(centre) == pytest.approx(rotation[:, 0], abs=5e-3)
    front, left, _, right, up, down = faces
    assert front[:, 0] == pytest.approx(left[:, -1], abs=0.06)  # neighbours half a pixel to either side of the edge
    assert front[:, -1] == pytest.approx(right[:, 0], abs=0.06)
    assert front[0] == pytest.approx(up[-1], abs=0.06)
    assert front[-1] == pytest.approx(down[0], abs=0.06)
