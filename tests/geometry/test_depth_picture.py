"""The depth picture of a rendered view, and the view seen from a little beside its place."""

import math

import cv2
import numpy as np
import pytest

from instant_ic.console import demo_world
from instant_ic.geometry.depth_picture import NEAREST_M, decode_depth, encode_depth, positions_before
from instant_ic.geometry.poses import pose_matrix
from instant_ic.geometry.projections import perspective_directions

FOV = math.radians(100)


def room(x, y=0.0, yaw=0.0, width=240, height=136):
    """Picture (H, W, 3) of the room, its depth (H, W), and camera_from_map."""
    turn = (pose_matrix(yaw=yaw) @ pose_matrix(pitch=math.radians(10)))[:3, :3].astype(np.float32)
    fine = perspective_directions(2 * width, 2 * height, FOV) @ turn.T
    picture = cv2.resize(demo_world.shade((x, y, 1.2), fine), (width, height), interpolation=cv2.INTER_AREA)
    return picture, demo_world.distances((x, y, 1.2), perspective_directions(width, height, FOV) @ turn.T), turn.T


def psnr_db(a, b):
    """Of two pictures softened to the same sharpness: what is moved is drawn by bilinear look-ups."""
    soft = [cv2.blur(picture.astype(float), (3, 3)) for picture in (a, b)]
    return 10 * math.log10(255**2 / np.mean((soft[0] - soft[1]) ** 2))


def test_a_wall_straight_ahead_has_one_depth_along_the_axis():
    rays = np.linalg.norm(perspective_directions(192, 108, FOV), axis=2)
    png, near_m = encode_depth(3.0 * rays, FOV)
    assert near_m == pytest.approx(3.0, rel=1e-5)
    inverse = decode_depth(png, near_m)
    assert inverse.shape == (54, 96)
    np.testing.assert_allclose(inverse, 1 / 3, rtol=1e-5)


def test_the_nearest_depth_of_a_pixel_counts_and_what_is_very_near_is_as_far_as_the_limit():
    depth = np.full((96, 192), 4.0, np.float32)
    depth[40, 100] = 1.0
    depth[0, 0] = 0.01
    png, near_m = encode_depth(depth, math.radians(1))  # rays that run side by side
    assert near_m == pytest.approx(NEAREST_M, rel=1e-3)
    inverse = decode_depth(png, near_m)
    assert inverse[20, 50] == pytest.approx(1.0, abs=0.02)
    assert inverse[30, 70] == pytest.approx(0.25, abs=0.01)


def test_where_nothing_is_met_the_picture_is_empty():
    assert encode_depth(np.zeros((60, 80)), FOV) == (b"", 0.0)
    assert encode_depth(np.full((60, 80), np.nan), FOV) == (b"", 0.0)
    png, near_m = encode_depth(np.pad(np.full((60, 40), 2.0), ((0, 0), (0, 40))), 1e-3)
    assert near_m == pytest.approx(2.0)
    assert (decode_depth(png, near_m)[:, 45:] == 0).all()


@pytest.mark.parametrize("png", [b"", b"\x89PNG\r\n\x1a\n", cv2.imencode(".png", np.zeros((4, 4, 3)))[1].tobytes()])
def test_what_is_no_depth_picture_is_refused(png):
    with pytest.raises(ValueError, match="not an 8-bit grey PNG"):
        decode_depth(png, 1.0)
    with pytest.raises(ValueError, match="shape"):
        encode_depth(np.zeros((2, 2, 2)), FOV)


def reproject(picture, inverse, moved_m, fov_rad):
    """An image as a moved camera sees it, by ``positions_before``."""
    rows, columns = picture.shape[:2]
    half = math.tan(fov_rad / 2) * np.array([1, rows / columns])
    x, y = (2 * np.arange(columns) + 1) / columns - 1, 1 - (2 * np.arange(rows) + 1) / rows
    at = positions_before(np.stack(np.meshgrid(x, y), axis=2).astype(np.float32), inverse, moved_m, half)
    u, v = (1 + at[..., 0]) * (columns / 2) - 0.5, (1 - at[..., 1]) * (rows / 2) - 0.5
    return cv2.remap(picture, u, v, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE).astype(np.uint8)


def test_a_point_moves_by_its_parallax():
    """A white spot 2 m ahead and 0.5 m to the left, seen from 0.2 m ahead and 0.1 m to the left: 0.4 m at 1.8 m."""
    picture, inverse = np.zeros((101, 201, 1), np.uint8), np.full((25, 50), 0.5, np.float32)
    fov = math.pi / 2  # a column is 0.01 of the tangent
    cv2.circle(picture, (100 - round(0.5 / 2 * 100.5), 50), 3, 255, -1)
    seen = reproject(picture, inverse, np.array([0.2, 0.1, 0.0]), fov)
    row, column = (seen[..., None] if seen.ndim == 2 else seen)[..., 0].nonzero()
    assert column.mean() == pytest.approx(100 - 0.4 / 1.8 * 100.5, abs=0.3)
    assert row.mean() == pytest.approx(50, abs=0.3)


@pytest.mark.parametrize(
    ("start", "motion", "gain_db"),
    [
        ((0, 0, 0), (0.1, 0), 12),  # the open room
        ((2.0, 0, 0), (0.1, 0), 12),  # a box 1 m ahead, over whose edge the room is seen
        ((2.2, 0, 0), (-0.1, 0), 12),  # backwards from it
        ((-3.4, -2.0, -0.2), (0.1, 0), 12),  # past a pillar 0.8 m off
        ((-3.2, -1.6, -0.4), (0.2, 0.05), 8),
        ((2.6, 0, 0), (0.1, 0), 12),  # into the box
    ],
)
def test_the_room_from_beside_is_far_more_like_the_moved_picture_than_like_the_one_that_was_drawn(
    start, motion, gain_db
):
    x, y, yaw = start
    picture, depth, camera_from_map = room(x, y, yaw)
    moved = np.array([math.cos(yaw) * motion[0] - math.sin(yaw) * motion[1], 0, 0])
    moved[1] = math.sin(yaw) * motion[0] + math.cos(yaw) * motion[1]
    truth, _, _ = room(x + moved[0], y + moved[1], yaw)
    warped = reproject(picture, decode_depth(*encode_depth(depth, FOV)), camera_from_map @ moved, FOV)
    assert psnr_db(warped, truth) > psnr_db(picture, truth) + gain_db


def test_what_has_not_moved_is_the_picture_itself():
    picture, depth, _ = room(2.0)
    inverse = decode_depth(*encode_depth(depth, FOV))
    np.testing.assert_array_equal(reproject(picture, inverse, np.zeros(3), FOV), picture)
    far = np.zeros_like(inverse)
    np.testing.assert_array_equal(reproject(picture, far, np.array([0.3, 0, 0]), FOV), picture)
