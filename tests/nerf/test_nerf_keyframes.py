"""Several keyframes together: more is seen, in one exposure, without what has moved away."""

import dataclasses
import math

import numpy as np
import pytest

from instant_ic.geometry.poses import pose_matrix
from instant_ic.nerf import (
    FieldConfig,
    ReadinessConfig,
    State,
    TrainConfig,
    VirtualSpace,
    VirtualSpaceConfig,
    box_room,
)
from instant_ic.nerf.compose import Layer, compose, exposure_gain, looked_through
from instant_ic.nerf.config import GeometryConfig
from instant_ic.nerf.prior import prepare
from instant_ic.nerf.view import perspective_rays

CONFIG = VirtualSpaceConfig(
    device="cpu",
    keyframes=3,
    field=FieldConfig(log2_table=10, levels=4),
    train=TrainConfig(ray_columns=32, ray_rows=16, iterations=8),
    readiness=ReadinessConfig(psnr_db=5),
)
FIRST, SECOND = pose_matrix(x=-1.5, y=0.5), pose_matrix(x=2.8, y=0.9, yaw=0.5)
VIEW = pose_matrix(x=1.0, y=-1.0, yaw=0.9)  # towards the box, whose far side only the second has seen


def psnr_db(a, b):
    return 10 * math.log10(255**2 / np.mean((a.astype(float) - b) ** 2))


def prior_of(pose, gain=1.0, depth=None, height=64):
    picture = box_room.panorama(pose, height)
    rgb = np.clip(picture.rgb * np.asarray(gain), 0, 255).astype(np.uint8)
    return prepare(rgb, picture.depth_m if depth is None else depth, pose, 0.02, GeometryConfig(), 2048)


def learn(space, *poses, gains=(1.0, 1.0, 1.0, 1.0)):
    for pose, gain in zip(poses, gains, strict=False):
        picture = box_room.panorama(pose, 96)
        rgb = np.clip(picture.rgb * np.asarray(gain), 0, 255).astype(np.uint8)
        space.set_keyframe(rgb, picture.depth_m, pose, 0.02)
        space.train()
    return space


def test_two_keyframes_show_what_one_has_not_seen():
    truth = box_room.perspective(VIEW, 96, 64, 1.5).rgb
    one = learn(VirtualSpace(dataclasses.replace(CONFIG, keyframes=1)), SECOND, FIRST).render(VIEW, 96, 64, 1.5)
    both = learn(VirtualSpace(CONFIG), SECOND, FIRST).render(VIEW, 96, 64, 1.5)
    assert (both.confidence > 0).mean() > (one.confidence > 0).mean() + 0.02
    assert psnr_db(both.rgb, truth) > psnr_db(one.rgb, truth) + 1
    assert both.confidence.max() <= 1


@pytest.mark.parametrize("keyframes", [1, 2, 3])
def test_the_newest_so_many_are_kept(keyframes):
    space = VirtualSpace(dataclasses.replace(CONFIG, keyframes=keyframes))
    poses = [pose_matrix(x=x) for x in (-1.0, -0.5, 0.0, 0.5)]
    learn(space, *poses)
    shown = [one.scene.prior.map_from_camera[0, 3] for one in space._shown]
    assert shown == [0.5, 0.0, -0.5][:keyframes]
    # A keyframe that is not fit yet is not among them, and replaces none that is.
    picture = box_room.panorama(FIRST, 96)
    space.set_keyframe(picture.rgb, picture.depth_m, FIRST, 0.02)
    status = space.status
    assert (status.state, status.refreshing) == (State.READY, True)
    shown = [one.scene.prior.map_from_camera[0, 3] for one in space._shown]
    assert shown == [0.5, 0.0, -0.5][:keyframes]
    assert space.render(VIEW, 32, 32, 1.0).confidence.mean() > 0.5


def test_a_saved_space_has_all_its_keyframes(tmp_path):
    space = learn(VirtualSpace(CONFIG), SECOND, FIRST)
    space.save(tmp_path)
    loaded = VirtualSpace.load(tmp_path)
    before, after = space.render(VIEW, 64, 48, 1.5), loaded.render(VIEW, 64, 48, 1.5)
    assert np.array_equal(before.rgb, after.rgb)
    assert np.array_equal(before.depth_m, after.depth_m)
    assert len(loaded._shown) == 2


def test_exposure_is_fitted_where_both_have_seen():
    newest, older = prior_of(FIRST), prior_of(SECOND, gain=(0.8, 0.7, 0.6))
    assert exposure_gain(newest, older) == pytest.approx([1 / 0.8, 1 / 0.7, 1 / 0.6], rel=0.02)
    black = dataclasses.replace(older, rgb=older.rgb // 100)
    assert exposure_gain(newest, black).tolist() == [1, 1, 1]  # nothing to fit on
    # A picture of both has the newest's exposure throughout: as if the other had been taken with it.
    uneven = learn(VirtualSpace(CONFIG), SECOND, FIRST, gains=(0.6, 1.0)).render(VIEW, 96, 64, 1.5)
    even = learn(VirtualSpace(CONFIG), SECOND, FIRST).render(VIEW, 96, 64, 1.5)
    assert psnr_db(uneven.rgb, even.rgb) > 28


def test_what_the_newest_has_looked_through_by_hand():
    # The newest stands in a sphere of 4 m. Points at 2 m in its free space are gone, on it and behind it they are not.
    sphere = prepare(
        np.random.default_rng(0).integers(0, 255, (32, 64, 3)).astype(np.uint8),
        np.full((32, 64), 4.0, np.float32), pose_matrix(x=1.0), 0.02, GeometryConfig(), 2048,
    )  # fmt: skip
    points = np.array([[3, 0, 0], [5, 0, 0], [7, 0, 0], [1, -3.6, 0], [-2.9, 0, 0]], np.float32)
    # Distances from (1, 0, 0): 2, 4, 6, 3.6 (within 15 % of 4: may be an error of the depth), 3.9 across the seam.
    assert looked_through(sphere, points, sphere).tolist() == [True, False, False, False, False]
    unknown = dataclasses.replace(sphere, known=np.zeros_like(sphere.known))
    assert not looked_through(unknown, points, sphere).any()


def test_a_thing_that_has_moved_away_is_left_out():
    # The older keyframe has the box; the newest sees the room without it (walls only).
    pose, other = pose_matrix(x=0.2, y=-1.0), pose_matrix(x=-0.5, y=-1.0)
    directions = box_room.equirect_directions(192, 96).astype(np.float64)
    ways = np.where(np.abs(directions) < 1e-12, 1e-12, directions)
    walls = np.where(ways > 0, (box_room.ROOM_HIGH - pose[:3, 3]) / ways, (box_room.ROOM_LOW - pose[:3, 3]) / ways)
    depth = walls.min(axis=-1).astype(np.float32)
    picture = box_room.panorama(pose, 96)
    space = VirtualSpace(CONFIG)
    learn(space, other)
    view = pose_matrix(x=0.0, y=-1.0, yaw=0.6)
    rays = perspective_rays(view, 96, 64, 1.2)

    def pixels_on_the_box():
        drawn = space.render(view, 96, 64, 1.2)
        ends = rays.origin + drawn.depth_m.reshape(-1, 1) * rays.directions
        near = np.all((ends > box_room.BOX_LOW - 0.02) & (ends < box_room.BOX_HIGH + 0.02), axis=1)
        # At its foot the floor behind it is hardly farther than the box: that may be an error of the depth.
        return np.count_nonzero(near & (ends[:, 2] > -0.7) & (drawn.confidence.reshape(-1) > 0))

    assert pixels_on_the_box() > 100
    space.set_keyframe(picture.rgb, depth, pose, 0.02)
    space.train()
    assert pixels_on_the_box() < 5


def layer(prior, depth, confidence, colour, gain=1.0):
    depth, confidence = np.array(depth, np.float32), np.array(confidence, np.float32)
    colours = np.repeat(np.array(colour, np.float32)[:, None], 3, 1)
    return Layer(prior, np.full(3, gain, np.float32), colours, depth, confidence)


def test_composing_by_hand():
    # Both keyframes stand where the view does; three pixels straight ahead, far beyond what either has looked through.
    near, rays = prior_of(np.eye(4)), perspective_rays(np.eye(4), 16, 16, 0.01)
    rays = dataclasses.replace(rays, directions=np.tile(np.array([[1.0, 0, 0]], np.float32), (5, 1)))
    newest = layer(near, [5, 9, 0, 5, 0], [1, 1, 0, 0.5, 0], [0.2, 0.2, 0.2, 0.2, 0.1])
    older = layer(near, [5.1, 6, 7, 9, 0], [1, 1, 1, 1, 0], [0.3, 0.3, 0.3, 0.3, 0.9], gain=2.0)
    colour, depth, confidence = compose([newest, older], rays)
    # One surface: half of each, as both stand at the view's place. Then the nearer; the only one; the one that is known
    # rather than filled; nobody's: as the newest has it.
    assert colour[:, 0] == pytest.approx([0.5 * 0.2 + 0.5 * 0.6, 0.6, 0.6, 0.6, 0.1], abs=0.01)
    assert depth == pytest.approx([5.05, 6, 7, 9, 0], abs=0.01)
    assert confidence.tolist() == [1, 1, 1, 1, 0]


def test_the_keyframe_that_is_nearer_to_a_surface_has_more_say():
    rays = perspective_rays(np.eye(4), 16, 16, 0.01)
    rays = dataclasses.replace(rays, directions=np.array([[1.0, 0, 0]], np.float32))
    layers = [layer(prior_of(pose_matrix(x=x)), [8], [1], [value]) for x, value in ((-2.5, 0.0), (2.0, 1.0))]
    # Surface at 8 m, seen from 10.5 and from 6: penalties 0.05 + 10.5/8 − 1 = 0.3625 and 0.05, to the power of −6.
    colour, _, _ = compose(layers, rays)
    assert colour[0, 0] == pytest.approx(1 / (1 + (0.05 / 0.3625) ** 6), abs=1e-3)
