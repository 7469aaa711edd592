"""The space in each projection: perspective and panorama."""

import math

import numpy as np
import pytest

from instant_ic.geometry.image_quality import psnr_db
from instant_ic.geometry.poses import pose_matrix
from instant_ic.vspace import FieldConfig, TrainConfig, View, VirtualSpace, VirtualSpaceConfig
from instant_ic.vspace.view import continue_unseen, equirect_rays
from tests import box_room

CONFIG = VirtualSpaceConfig(
    device="cpu", field=FieldConfig(log2_table=13), train=TrainConfig(ray_columns=64, ray_rows=32, iterations=80)
)
CAMERA = pose_matrix(x=0.4, y=0.1, z=0.05, yaw=-0.5)
ASIDE = pose_matrix(x=0.9, y=-0.4, yaw=0.8, pitch=0.1)


@pytest.fixture(scope="module")
def space():
    space = VirtualSpace(CONFIG)
    picture = box_room.panorama(CAMERA, 128)
    space.set_keyframe(picture.rgb, picture.depth_m, CAMERA, 0.02)
    space.train(iterations=80)
    return space


def test_a_panorama_from_aside_is_the_rooms(space):
    view, truth = space.render_equirect(ASIDE, 192), box_room.panorama(ASIDE, 96)
    assert (view.rgb.shape, view.depth_m.shape, view.projection) == ((96, 192, 3), (96, 192), "equirect")
    seen = view.confidence > 0
    assert seen.mean() > 0.9
    assert np.median(np.abs(view.depth_m / truth.depth_m - 1)[seen]) < 0.015
    assert psnr_db(view.rgb[seen], truth.rgb[seen]) > 22


def test_interpolation_between_traced_pixels_changes_a_panorama_little(space):
    coarse = space.render_equirect(ASIDE, 512)
    assert [equirect_rays(ASIDE, width).stride for width in (192, 512, 1024)] == [1, 2, 4]
    space.device.first_stride = 1
    full = space.render_equirect(ASIDE, 512)
    space.device.first_stride = 4
    both = (coarse.depth_m > 0) & (full.depth_m > 0)
    assert both.mean() > 0.95
    relative = np.abs(coarse.depth_m[both] / full.depth_m[both] - 1)
    assert np.median(relative) < 0.003
    assert np.quantile(relative, 0.95) < 0.03


def test_what_is_not_known_is_continued_across_the_seam():
    # A grey ring all round with an unknown patch across the seam; columns 62, 63 | 0, 1 of 64. Beside it 100 and 200.
    image = np.full((16, 64, 3), 100, np.float32)
    image[:, :32] = 200
    confidence = np.ones((16, 64), np.float32)
    confidence[:, [62, 63, 0, 1]] = 0
    filled = continue_unseen(image, np.ones((16, 64), np.float32), confidence, wraps=True)
    across = filled[8, [61, 62, 63, 0, 1, 2], 0]
    assert np.all(np.diff(across) >= 0)  # passes from one side to the other, with no jump back at the seam
    assert np.abs(np.diff(across)).max() < 60
    assert np.array_equal(filled[confidence > 0], image[confidence > 0])


def test_mean_confidence_by_hand():
    depth = np.array([[0, 1], [2, 0]], np.float32)
    confidence = np.array([[1, 1], [0.5, 0]], np.float32)
    view = View(np.zeros((2, 2, 3), np.uint8), depth, confidence)
    assert view.mean_confidence == 0.625
    # Four rows at elevations ±67.5° and ±22.5°: weights sin(22.5°) and sin(67.5°), of which only the second row counts.
    rows = np.zeros((4, 8), np.float32)
    rows[1] = 1
    panorama = View(np.zeros((4, 8, 3), np.uint8), rows, rows, "equirect")
    a, b = math.sin(math.pi / 8), math.sin(3 * math.pi / 8)
    assert panorama.mean_confidence == pytest.approx(b / (2 * a + 2 * b))


@pytest.mark.parametrize("x", [50.0, 1e7])
def test_a_view_from_far_off_is_known_to_be_unknown(space, x):
    # From outside of every surface there is nothing that the keyframe has seen from its front.
    view = space.render(pose_matrix(x=x, yaw=math.pi), 64, 36, 1.0)
    assert view.mean_confidence < 0.05
    panorama = space.render_equirect(pose_matrix(x=x), 64)
    assert panorama.mean_confidence < 0.05


@pytest.mark.parametrize(("width", "words"), [(8, "16 to 4096"), (4098, "16 to 4096"), (33, "even"), (40, None)])
def test_sizes_of_panoramas(space, width, words):
    if words is None:
        assert space.render_equirect(CAMERA, width).rgb.shape == (20, 40, 3)
        return
    with pytest.raises(ValueError, match=words):
        space.render_equirect(CAMERA, width)
