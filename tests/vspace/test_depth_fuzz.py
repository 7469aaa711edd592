"""Any depth image is refused with a reason or goes through the whole chain, from the keyframe to views and layers."""

import dataclasses
import math

import numpy as np
import pytest
from hypothesis import example, given, settings
from hypothesis import strategies as st

from instant_ic.geometry.poses import pose_matrix
from instant_ic.vspace import (
    FieldConfig,
    KeyframeError,
    TrainConfig,
    ViewContentConfig,
    VirtualSpace,
    VirtualSpaceConfig,
)
from instant_ic.vspace.config import GeometryConfig
from instant_ic.vspace.layers import decode_layer, encode
from instant_ic.vspace.nerf import occupancy
from instant_ic.vspace.nerf.occupancy import build_occupancy, surface_points
from instant_ic.vspace.prior import SKY, prepare
from tests import box_room

RGB = box_room.panorama(np.eye(4), 16).rgb
VALUES = (0.0, 1e-30, 0.05, 0.2, 1.0, 3.0, 29.99, 30.0, 1e4, 1e30, 1e300, math.nan, math.inf, -math.inf, -1.0)
CONFIG = VirtualSpaceConfig(
    device="cpu",
    keyframes=2,  # a third one is kept, and field and warp are compared by it
    field=FieldConfig(levels=2, log2_table=10, hidden=8),
    train=TrainConfig(ray_columns=8, ray_rows=8),
    geometry=GeometryConfig(cell_m=0.2),
)


@pytest.fixture(autouse=True, scope="module")
def _small_grids():
    """Grids of 200 000 cells: thousands of images are tried."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(occupancy, "MAX_CELLS", 200_000)
        yield


@st.composite
def depth_images(draw):
    """A room, or one value; with rectangles, rows, columns and pixels of other values; of several sizes and types."""
    height = draw(st.sampled_from([16, 16, 32, 17, 48]))
    base = draw(st.sampled_from(["room", "room", "room", 29.0, 3.0, draw(st.sampled_from(VALUES))]))
    if base == "room":
        depth = box_room.panorama(np.eye(4), height).depth_m.astype(np.float64)
    else:
        depth = np.full((height, 2 * height), base)
    for _ in range(draw(st.integers(0, 4))):
        top, left = draw(st.integers(0, height - 1)), draw(st.integers(0, 2 * height - 1))
        rows, columns = (draw(st.sampled_from([1, 2, 5, 2 * height])) for _ in range(2))
        depth[top : top + rows, left : left + columns] = draw(st.sampled_from(VALUES))
    with np.errstate(over="ignore"):
        return depth.astype(draw(st.sampled_from([np.float32, np.float64])))


def ragged_sky(height):
    """A plain 29 m away under a sky whose rim goes up and down: next to 30 m no edge cuts the two apart."""
    depth = np.full((height, 2 * height), 29.0, np.float32)
    depth[: height // 2] = depth[: height // 2 + 1, ::2] = 0
    return depth


def room_but(value, rows=slice(None), columns=slice(None)):
    """A room's depth, 32 × 64, with a value in a rectangle."""
    depth = box_room.panorama(np.eye(4), 32).depth_m.copy()
    depth[rows, columns] = value
    return depth


NAMED = {
    "all unknown": room_but(0.0),
    "all NaN": room_but(math.nan),
    "sky": room_but(0.0, slice(0, 14)),
    "one pixel known": np.where(np.arange(32 * 64).reshape(32, 64) == 700, np.float32(2.0), np.float32(0.0)),
    "one pixel far": room_but(1e4, 20, 30),
}


@pytest.mark.parametrize("name", NAMED)
def test_named_depth_images_among_good_ones(name):
    chain([room_but(3.0, 20, 30), NAMED[name], room_but(2.0, 9, 9)], 0.02, 0.3)


@settings(max_examples=15, deadline=None, derandomize=True)
@given(
    depths=st.lists(depth_images(), min_size=1, max_size=3),
    sigma=st.sampled_from([0.0, 0.02, 0.4, 5.0]),
    step_m=st.sampled_from([0.0, 0.3, 500.0]),
    robot=st.sampled_from([None, 0, 10, 16]),
)
@example(depths=[ragged_sky(32)], sigma=0.02, step_m=0.0, robot=None)
def test_any_depth_is_refused_or_shown(depths, sigma, step_m, robot):
    """``robot``: the first of 16 rows that show it."""
    chain(depths, sigma, step_m, None if robot is None else np.arange(16)[:, None].repeat(32, 1) >= robot)


def chain(depths, sigma, step_m, robot=None):
    """Keyframes of these depths, ``step_m`` apart, from their preparation to views and layers."""
    space = VirtualSpace(CONFIG, robot=robot)
    for number, depth in enumerate(depths):
        try:
            prepared = space.prepare(RGB, depth, pose_matrix(number * step_m, 0.1, 0, yaw=number), sigma)
        except KeyframeError as error:
            assert "depth" in str(error)
            continue
        space.learn(prepared)
        space.show(prepared, dissolve=True)
        space.train(iterations=1)
    if space.keyframe is None:
        return
    pose = space.keyframe.map_from_camera @ pose_matrix(0.4, 0.1, 0.0, yaw=0.2)
    views = [space.render(pose, 24, 16, 1.5), space.render_equirect(pose, 32)]
    space.config = dataclasses.replace(CONFIG, view=ViewContentConfig(field_alone=True))
    for view in (*views, space.render(pose, 24, 16, 1.5)):
        assert view.rgb.shape[2] == 3
        assert np.isfinite(view.depth_m).all() and view.depth_m.min() >= 0
        assert view.confidence.min() >= 0 and view.confidence.max() <= 1
        assert not math.isnan(view.expected_psnr_db)
    for layer in encode(space.shown.newest, 1, None, 1).layers:
        assert np.isfinite(decode_layer(layer).inverse_depth).all()


def test_quads_have_no_corner_in_the_sky():
    """Of pixels 29 m away no point lies elsewhere, and none higher than the highest of them."""
    depth = ragged_sky(32)
    prior = prepare(box_room.panorama(np.eye(4), 32).rgb, depth, np.eye(4), 0.02, GeometryConfig(), 64)
    assert ((prior.content == SKY) == (depth == 0)).all()
    points = surface_points(prior, 0.2)
    assert len(points) > 50_000  # the quads are divided
    assert points[:, 2].max() <= 29 * math.sin(math.radians(90 - 16.5 * 180 / 32)) + 1e-3
    build_occupancy([prior], GeometryConfig())


@pytest.mark.parametrize("height", [16, 513, 1025])
def test_depth_of_any_height_is_thinned_to_twice_as_wide_as_high(height):
    depth = np.full((height, 2 * height), 3.0, np.float32)
    prior = prepare(RGB, depth, np.eye(4), np.full(depth.shape, 0.02, np.float32), GeometryConfig(), 32)
    rows, columns = prior.inverse_depth.shape
    assert columns == 2 * rows and rows < 1024
    assert prior.sigma.shape == prior.content.shape == (rows, columns)
