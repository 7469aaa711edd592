"""The panorama warped by its depth, against exact pictures of a box room and values worked out by hand."""

import math

import numpy as np
import pytest

from instant_ic.geometry.image_quality import psnr_db
from instant_ic.geometry.poses import pose_matrix
from instant_ic.geometry.projections import equirect_pixels
from instant_ic.vspace import (
    FieldConfig,
    SpaceState,
    TrainConfig,
    VirtualSpace,
    VirtualSpaceConfig,
    fill_kernels,
    warp_kernels,
)
from instant_ic.vspace.config import GeometryConfig
from instant_ic.vspace.prior import prepare
from instant_ic.vspace.view import perspective_rays
from instant_ic.vspace.warp import PanoramaWarp, Pyramid
from tests import box_room

FOV = math.pi / 2


def warp_of(rgb, depth_m, map_from_camera):
    return PanoramaWarp(prepare(rgb, depth_m, map_from_camera, 0.0, GeometryConfig(), 4096))


@pytest.fixture(scope="module")
def room():
    camera = pose_matrix(0.3, -0.2, 0.1, 0.4)
    return camera, box_room.panorama(camera, 128)


@pytest.fixture(scope="module")
def warp(room):
    camera, picture = room
    return warp_of(picture.rgb, picture.depth_m, camera)


def test_from_the_panoramas_own_place_nothing_is_missing(room, warp):
    camera, _ = room
    for yaw in (0.0, 2.0, math.pi):
        pose = camera @ pose_matrix(yaw=yaw)
        view, truth = warp.render(pose, 96, 54, FOV), box_room.perspective(pose, 96, 54, FOV)
        assert view.confidence.min() == 1
        assert psnr_db(view.rgb, truth.rgb) > 27
        assert np.median(np.abs(view.depth_m / truth.depth_m - 1)) < 1e-3


def test_from_aside_it_is_the_rooms_picture(room, warp):
    camera, _ = room
    pose = camera @ pose_matrix(0.6, 0.4, 0.0, -0.3)
    view, truth = warp.render(pose, 96, 54, FOV), box_room.perspective(pose, 96, 54, FOV)
    turned = pose.copy()
    turned[:3, 3] = camera[:3, 3]
    assert psnr_db(view.rgb, truth.rgb) > 24 > psnr_db(warp.render(turned, 96, 54, FOV).rgb, truth.rgb) + 4
    seen = view.confidence == 1
    assert seen.mean() > 0.9
    assert np.median(np.abs(view.depth_m[seen] / truth.depth_m[seen] - 1)) < 5e-3


def test_behind_the_box_is_unknown_and_continued(warp):
    # The box stands at (1.6..2.2, 0.4..1.1); from here one looks past it at the wall that it hid.
    pose = pose_matrix(0.3, 1.5, 0.1, -0.1)
    view = warp.render(pose, 96, 54, FOV)
    hidden = view.confidence == 0
    assert 0.02 < hidden.mean() < 0.4
    assert view.rgb[hidden].max() > 30  # continued, not black


def test_a_sphere_by_hand():
    """All at 2 m, seen from 1 m ahead: 1 m in front, 3 m behind, √3 m to the side."""
    rgb = np.zeros((64, 128, 3), np.uint8)
    rgb[:, :64] = 200
    warp = warp_of(rgb, np.full((64, 128), 2.0), np.eye(4))
    for yaw, metres in ((0.0, 1.0), (math.pi, 3.0), (math.pi / 2, math.sqrt(3))):
        view = warp.render(pose_matrix(1.0, yaw=yaw), 33, 33, FOV)
        assert view.depth_m[16, 16] == pytest.approx(metres, rel=2e-3)
        assert view.confidence.min() == 1
    ahead = warp.render(pose_matrix(1.0), 33, 33, FOV)
    assert ahead.rgb[16, 4, 0] == 200  # columns run clockwise: left of the centre lies ahead's left
    assert ahead.rgb[16, 28, 0] == 0


def test_from_outside_backs_are_unknown():
    rgb = np.zeros((64, 128, 3), np.uint8)
    rgb[::2] = 200
    warp = warp_of(rgb, np.full((64, 128), 2.0), np.eye(4))
    view = warp.render(pose_matrix(-5.0), 64, 64, 0.5)
    assert view.confidence.max() == 0
    assert (view.depth_m > 0).mean() > 0.9
    assert view.rgb.max() > 50  # not black: the backs' colours


def test_a_wall_that_passes_through_the_views_plane_is_drawn_up_to_the_edge():
    """A view 4 cm off a wall: triangles with a corner behind the view are drawn, not dropped."""
    camera = pose_matrix()
    picture = box_room.panorama(camera, 64)
    warp = warp_of(picture.rgb, picture.depth_m, camera)
    view = warp.render(pose_matrix(0.0, 1.96, 0.0), 64, 36, 2.0)
    assert (view.confidence[:, :8] == 1).mean() > 0.95


def test_fine_stripes_become_grey_in_a_small_picture():
    """Stripes of one panorama pixel under view pixels of many: their mean, 100, and no moiré."""
    rgb = np.zeros((512, 1024, 3), np.uint8)
    rgb[:, ::2] = 200
    warp = warp_of(rgb, np.full((32, 64), 3.0), np.eye(4))
    view = warp.render(np.eye(4), 32, 18, FOV)
    assert abs(view.rgb.astype(int) - 100).max() <= 2


def test_a_pyramid_halves_by_area():
    rgb = np.arange(16 * 32 * 3, dtype=np.uint32).reshape(16, 32, 3).astype(np.uint8)
    pyramid = Pyramid.of(rgb)
    assert pyramid.sizes.tolist() == [[16, 32], [8, 16]]
    assert pyramid.start.tolist() == [0, 16 * 32]
    first = rgb[:2, :2].reshape(4, 3).astype(float).mean(axis=0)
    assert pyramid.texels[16 * 32] == pytest.approx(first, abs=0.51)


def test_unknown_depth_is_filled_and_said(room):
    camera, picture = room
    depth = picture.depth_m.copy()
    depth[:, 120:136] = 0  # ahead
    view = warp_of(picture.rgb, depth, camera).render(camera, 96, 54, FOV)
    assert np.all(view.confidence[:, 46:50] == 0.5)
    assert np.all(view.confidence[:, :30] == 1)


SMALL = VirtualSpaceConfig(
    device="cpu", field=FieldConfig(log2_table=10), train=TrainConfig(ray_columns=32, ray_rows=16, iterations=50)
)


def test_a_space_shows_the_warp_from_the_first_moment(room, warp):
    camera, picture = room
    pose = camera @ pose_matrix(0.5, 0.2)
    space = VirtualSpace(SMALL)
    space.set_keyframe(picture.rgb, picture.depth_m, camera, 0.02)
    first, truth = space.render(pose, 96, 54, FOV), box_room.perspective(pose, 96, 54, FOV)
    seen = first.confidence > 0
    assert np.array_equal(first.rgb[seen], warp.render(pose, 96, 54, FOV).rgb[seen])
    assert psnr_db(first.rgb, truth.rgb) > 24
    assert space.status.state == SpaceState.TRAINING
    space.train(iterations=1)
    assert np.array_equal(space.render(pose, 96, 54, FOV).rgb, first.rgb)  # no jump while the field is worse


def test_the_warp_as_the_source_is_ready_at_once_and_trains_nothing(room):
    camera, picture = room
    space = VirtualSpace(VirtualSpaceConfig(device="cpu", source="warp"))
    space.set_keyframe(picture.rgb, picture.depth_m, camera, 0.02)
    before = space.parameters().table
    space.train(iterations=10)
    assert space.status.iterations == 0
    assert np.array_equal(space.parameters().table, before)
    status = space.status
    assert (status.state, status.converged, status.iterations) == (SpaceState.READY, True, 0)
    other = camera @ pose_matrix(0.3)
    moved = box_room.panorama(other, 128)
    space.set_keyframe(moved.rgb, moved.depth_m, other, 0.02)  # the next one takes over at once
    assert np.array_equal(space.keyframe.map_from_camera, other)
    assert not space.status.refreshing
    with pytest.raises(ValueError, match="source"):
        VirtualSpaceConfig(source="mesh")


def test_a_views_pose_follows_from_its_rays(warp):
    from instant_ic.vspace.warp import pinhole

    pose = pose_matrix(1.0, 2.0, 0.3, 0.1, -0.2, 0.7)
    found, half = pinhole(perspective_rays(pose, 96, 54, 1.2))
    assert found == pytest.approx(pose, abs=1e-5)
    assert half == pytest.approx(math.tan(0.6), rel=1e-5)


def filled_by_numpy(channels: np.ndarray, w: np.ndarray) -> np.ndarray:
    """``fill_kernels.fill`` in numpy: (H, W, C), and weights (H, W) that are 0 in the holes."""
    valid = w > 0
    total = channels * w[..., None]
    levels = [(total, w)]
    while min(levels[-1][1].shape) > 1:
        total, w = levels[-1]
        levels.append((halved(total), halved(w)))
    # Sums and weights go down together, so that where two sides meet the heavier counts more.
    total, w = levels[-1]
    for finer_total, finer_w in reversed(levels[:-1]):
        known = finer_w > 0
        total = np.float32(0.25) * doubled(total, known.shape)
        w = np.float32(0.25) * doubled(w, known.shape)
        total[known], w[known] = finer_total[known], finer_w[known]
    coarse = (total / np.maximum(w, np.float32(1e-30))[..., None]).astype(np.float32)
    coarse[valid] = channels[valid]
    return coarse


def halved(values: np.ndarray) -> np.ndarray:
    height, width = values.shape[:2]
    if height % 2 or width % 2:
        pad = ((0, height % 2), (0, width % 2), *([(0, 0)] * (values.ndim - 2)))
        values = np.pad(values, pad)
    return values[::2, ::2] + values[1::2, ::2] + values[::2, 1::2] + values[1::2, 1::2]


def doubled(values: np.ndarray, shape: tuple[int, ...]) -> np.ndarray:
    """Bilinear enlargement (weights 3/4 and 1/4), so that fills have no blocks."""
    for axis in (0, 1):
        before = np.concatenate([values.take([0], axis), values.take(range(values.shape[axis] - 1), axis)], axis)
        after = np.concatenate([values.take(range(1, values.shape[axis]), axis), values.take([-1], axis)], axis)
        pair = np.stack([0.75 * values + 0.25 * before, 0.75 * values + 0.25 * after], axis + 1)
        merged = (*values.shape[:axis], 2 * values.shape[axis], *values.shape[axis + 1 :])
        values = pair.reshape(merged)
    return np.ascontiguousarray(values[: shape[0], : shape[1]], np.float32)


@pytest.mark.parametrize(("height", "width"), [(1, 1), (9, 14), (54, 96)])
def test_holes_are_filled_as_by_numpy(height, width):
    rng = np.random.default_rng(height)
    values, valid = rng.random((height, width, 3)).astype(np.float32), rng.random((height, width)) > 0.4
    valid[height // 4 : height // 2, width // 3 :] = False
    weight = np.where(valid, rng.random((height, width)) + 0.1, 0).astype(np.float32)
    assert fill_kernels.fill(values, weight) == pytest.approx(filled_by_numpy(values, weight), abs=1e-6)
    nothing = np.zeros((height, width), np.float32)
    assert np.all(fill_kernels.fill(values, nothing) == 0)


def test_angle_is_atan2():
    places = np.empty((4000, 2), np.float32)
    around = np.linspace(-np.pi, np.pi, 4000, dtype=np.float32)[:, None]
    directions = np.concatenate([np.cos(around), np.sin(around), np.sin(7 * around)], axis=1)
    warp_kernels.panorama_places(
        np.eye(4, dtype=np.float32), np.zeros(3, np.float32), directions, np.ones(4000, np.float32), 1024, 2048, places
    )
    u, v = equirect_pixels(directions, 2048, 1024)
    # 1e-6 rad are 3e-4 pixels; the seam is the same place on either side.
    assert np.abs((places[:, 0] - u + 1024) % 2048 - 1024).max() < 2e-3
    assert np.abs(places[:, 1] - v).max() < 2e-3
