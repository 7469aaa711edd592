"""The uncertainty of a keyframe's depth, pixel by pixel."""

import numpy as np
import pytest

from instant_ic.vspace import KeyframeError
from instant_ic.vspace.config import GeometryConfig
from instant_ic.vspace.prior import edge_quads, prepare
from tests import box_room

CAMERA = np.eye(4)
PICTURE = box_room.panorama(CAMERA, 64)


def prior(sigma, depth=PICTURE.depth_m):
    return prepare(PICTURE.rgb, depth, CAMERA, sigma, GeometryConfig(), 2048)


def test_one_number_and_a_picture_of_it_are_the_same() -> None:
    one, each = prior(0.1), prior(np.full(PICTURE.depth_m.shape, 0.1, np.float32))
    assert each.relative_sigma == pytest.approx(one.relative_sigma) and each.band == pytest.approx(one.band)
    assert (each.known == 1).all() and (each.inverse_depth == one.inverse_depth).all()


def test_the_median_of_what_is_known_counts_and_guesses_are_not_known() -> None:
    sigma = np.full(PICTURE.depth_m.shape, 0.02, np.float32)
    depth = PICTURE.depth_m.copy()
    sigma[:4], sigma[4:8], depth[4:8] = 0.7, np.inf, 0
    found = prior(sigma, depth)
    assert found.relative_sigma == pytest.approx(0.02) and found.band == pytest.approx(0.05)
    assert (found.known[:8] == 0).all() and (found.known[8:] == 1).all()
    # A guess is kept as it is, what is unknown is filled from around.
    np.testing.assert_allclose(1 / found.inverse_depth[:4], depth[:4], rtol=1e-5)
    assert (found.inverse_depth[4:8] > 0).all()


@pytest.mark.parametrize(
    ("sigma", "words"),
    [
        (np.full((8, 16), 0.1), "a number or as large as depth"),
        (np.full(PICTURE.depth_m.shape, np.inf), "must have finite values"),
        (np.full(PICTURE.depth_m.shape, -0.1), "none of them negative"),
        (float("nan"), "relative_sigma must be finite"),
    ],
)
def test_a_sigma_that_is_none_is_refused(sigma, words) -> None:
    with pytest.raises(KeyframeError, match=words):
        prior(sigma)


def test_a_slope_with_noise_is_no_edge_and_a_step_is():
    """One row of a wall that leans away: 4 % a pixel, its steps 0, 8, 0, 8 % by noise; and a step of 8 %."""
    slope = np.ones((4, 32), np.float32)
    slope[:, 8:24] = 1.04 ** -np.repeat(np.arange(0, 16, 2), 2)
    slope[:, 24:] = slope[:, 23:24]
    assert not edge_quads(slope, 0.05)[:, 9:22].any()
    step = np.ones((4, 32), np.float32)
    step[:, 16:] = 1 / 1.08
    assert np.array_equal(np.flatnonzero(edge_quads(step, 0.05)[1]), [15, 31])
    # A large difference is an edge however much leans away around it.
    slope[:, 16:24] /= 1.4
    assert edge_quads(slope, 0.05)[1, 15]


def a_thing(top_sigma: float, seen_rows: int) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Image, depth and sigma (128, 256): a dark thing at 1 m below row 80 before a bright wall at 4 m.

    Its top is assumed in rows 76 to 79; the image shows it only in the last ``seen_rows`` of them.
    """
    rgb = np.full((128, 256, 3), 200, np.uint8)
    rgb[80 - seen_rows :] = 50
    depth, sigma = np.full((128, 256), 4.0, np.float32), np.full((128, 256), 0.012, np.float32)
    depth[76:] = 1.0
    sigma[76:80] = top_sigma
    return rgb, depth, sigma


@pytest.mark.parametrize(("seen", "first"), [(0, 80), (1, 79), (2, 78), (4, 76)])
def test_an_assumed_top_ends_where_the_image_does(seen: int, first: int) -> None:
    """The wall's inverse depth goes on down to the first row of the thing's colour."""
    rgb, depth, sigma = a_thing(0.07, seen)
    found = prepare(rgb, depth, CAMERA, sigma, GeometryConfig(), 2048)
    np.testing.assert_allclose(found.inverse_depth[:first], 0.25)
    np.testing.assert_allclose(found.inverse_depth[first:], 1.0)
    assert (found.sigma[76:first] == np.float32(0.012)).all()
    assert np.flatnonzero(found.depth_edge[:, 64]).tolist() == [first - 1]


def test_a_measured_top_stays_and_so_does_one_of_the_walls_colour() -> None:
    rgb, depth, sigma = a_thing(0.02, 1)
    assert (prepare(rgb, depth, CAMERA, sigma, GeometryConfig(), 2048).inverse_depth[76:] == 1).all()
    rgb, depth, sigma = a_thing(0.07, 1)
    rgb[79:] = 190  # 17 grey levels from the wall's, over all three channels
    assert (prepare(rgb, depth, CAMERA, sigma, GeometryConfig(), 2048).inverse_depth[76:] == 1).all()
    # Where nothing is sure, nothing is cut.
    rgb, depth, sigma = a_thing(0.07, 1)
    assert (prepare(rgb, depth, CAMERA, np.full_like(sigma, 0.3), GeometryConfig(), 2048).inverse_depth[76:] == 1).all()
