"""Several keyframes together: more is seen, in one exposure, without what has moved away."""

import dataclasses
import types

import numpy as np
import pytest

from instant_ic.geometry.image_quality import psnr_db
from instant_ic.geometry.poses import pose_matrix
from instant_ic.vspace import FieldConfig, ReadinessConfig, SpaceState, TrainConfig, VirtualSpace, VirtualSpaceConfig
from instant_ic.vspace.agreement import exposure_gain, exposure_gains, moved
from instant_ic.vspace.config import GeometryConfig
from instant_ic.vspace.keyframes import Keyframe, recent, spread
from instant_ic.vspace.prior import MOVED, prepare
from tests import box_room

CONFIG = VirtualSpaceConfig(
    device="cpu",
    keyframes=3,
    older=0,
    field=FieldConfig(log2_table=10, levels=4),
    train=TrainConfig(ray_columns=32, ray_rows=16, iterations=8),
    readiness=ReadinessConfig(psnr_db=5),
)
FIRST, SECOND = pose_matrix(x=-1.5, y=0.5), pose_matrix(x=2.8, y=0.9, yaw=0.5)
VIEW = pose_matrix(x=1.0, y=-1.0, yaw=0.9)  # towards the box, whose far side only the second has seen


def prior_of(pose, gain=1.0, depth=None, height=64):
    picture = box_room.panorama(pose, height)
    rgb = np.clip(picture.rgb * np.asarray(gain), 0, 255).astype(np.uint8)
    return prepare(rgb, picture.depth_m if depth is None else depth, pose, 0.02, GeometryConfig(), 2048)


def learn(space, *poses):
    for pose in poses:
        picture = box_room.panorama(pose, 96)
        space.set_keyframe(picture.rgb, picture.depth_m, pose, 0.02)
        space.train()
    return space


@pytest.mark.parametrize("keyframes", [1, 2, 3])
def test_the_newest_so_many_are_kept(keyframes):
    space = VirtualSpace(dataclasses.replace(CONFIG, keyframes=keyframes))
    poses = [pose_matrix(x=x) for x in (-1.0, -0.5, 0.0, 0.5)]
    learn(space, *poses)
    assert [prior.map_from_camera[0, 3] for prior in space.keyframes] == [0.5, 0.0, -0.5][:keyframes]
    assert len(space.scene.priors) == len(space.keyframes)  # one field learns from all of them
    # A new one is shown from the first moment, and what was fit to show stays so.
    picture = box_room.panorama(FIRST, 96)
    space.set_keyframe(picture.rgb, picture.depth_m, FIRST, 0.02)
    assert (space.status.state, space.status.refreshing) == (SpaceState.READY, True)
    assert [prior.map_from_camera[0, 3] for prior in space.keyframes] == [-1.5, 0.5, 0.0][:keyframes]
    space.train()
    assert not space.status.refreshing


def test_keyframes_of_another_size_replace_all():
    space = learn(VirtualSpace(CONFIG), FIRST, SECOND)
    picture = box_room.panorama(VIEW, 64)
    space.set_keyframe(picture.rgb, picture.depth_m, VIEW, 0.02)
    assert len(space.keyframes) == 1
    view = space.render(VIEW, 64, 48, 1.2)
    assert psnr_db(view.rgb, box_room.perspective(VIEW, 64, 48, 1.2).rgb) > 22
    learn(space, FIRST)
    assert len(space.keyframes) == 1


def test_exposure_is_fitted_where_both_have_seen():
    newest, older = prior_of(FIRST), prior_of(SECOND, gain=(0.8, 0.7, 0.6))
    assert exposure_gain(newest, older) == pytest.approx([1 / 0.8, 1 / 0.7, 1 / 0.6], rel=0.02)
    black = dataclasses.replace(older, rgb=older.rgb // 100)
    assert exposure_gain(newest, black) is None  # nothing to fit on
    assert exposure_gains([newest, black]).tolist() == [[1, 1, 1], [1, 1, 1]]


def test_a_gain_without_strong_evidence_is_1():
    """Ratios spread evenly by ±20 %: half of them lie within 0.2. Around 0.95 that interval holds 1, around 0.7 not."""
    newest = prior_of(FIRST)
    rng = np.random.default_rng(0)
    for factor, expected in ((0.95, 1.0), (0.7, 1 / 0.7)):
        spread_out = rng.uniform(0.8, 1.2, newest.rgb.shape[:2])[..., None] * factor
        rgb = np.clip(newest.rgb * spread_out, 0, 255).astype(np.uint8)
        fitted = exposure_gain(newest, dataclasses.replace(newest, rgb=rgb))
        assert fitted == pytest.approx([expected] * 3, rel=0.1 if factor < 0.9 else 0)
    assert exposure_gain(newest, prior_of(FIRST, gain=0.9)) == pytest.approx([1 / 0.9] * 3, rel=0.02)  # one factor
    assert exposure_gain(newest, prior_of(FIRST, gain=0.98)).tolist() == [1, 1, 1]  # rounding makes as much


def test_which_older_keyframes_are_chosen_and_kept():
    def at(x):
        return Keyframe(types.SimpleNamespace(map_from_camera=pose_matrix(x=x)), None, None)

    def places(keyframes):
        return [float(keyframe.prior.map_from_camera[0, 3]) for keyframe in keyframes]

    driven = [at(x) for x in (0.0, -0.6, -1.2, -1.8, -2.4, -3.0, -3.6)]
    # The farthest within 3 m, then the one in the middle of the others (1.2 m from one and 1.8 m from the other).
    assert places(spread(driven, 2)) == [-3.0, -1.2]
    assert places(spread(driven[:2], 2)) == [-0.6]
    assert places(spread([at(0), at(-0.1)], 2)) == []
    # Standing: taken again at one place, the newest of them stays.
    assert places(recent([at(0), at(0.01), at(-0.01), at(-1), at(-1.1)])) == [0, -1]
    assert len(recent([at(float(x)) for x in range(20)])) == 7


def test_older_keyframes_show_what_is_hidden_from_the_newest():
    """What lies behind the box, seen from the other side of it; bit for bit the same in either order."""
    truth = box_room.perspective(VIEW, 96, 64, 1.5).rgb
    other = pose_matrix(x=2.2, y=-0.5)
    views = []
    for older, poses in ((0, (SECOND, other)), (2, (SECOND, other)), (2, (other, SECOND))):
        space = VirtualSpace(VirtualSpaceConfig(device="cpu", source="warp", older=older))
        for pose in (*poses, pose_matrix(x=0.2, y=0.4)):
            picture = box_room.panorama(pose, 96)
            space.set_keyframe(picture.rgb, picture.depth_m, pose, 0.02)
        views.append(space.render(VIEW, 96, 64, 1.5))
    assert psnr_db(views[1].rgb, truth) > psnr_db(views[0].rgb, truth) + 0.3
    assert np.array_equal(views[0].confidence, views[1].confidence)  # the newest has not seen it
    assert np.array_equal(views[1].rgb, views[2].rgb)


def test_a_lamp_in_a_part_of_the_room_is_no_exposure():
    # A third of the older panorama is twice as bright: the median of all ratios would be drawn aside by it.
    newest, older = prior_of(FIRST), prior_of(pose_matrix(x=-1.0, y=0.3), gain=0.8)
    rgb = older.rgb.copy()
    rgb[:, 20:62] = np.clip(2.0 * rgb[:, 20:62].astype(float), 0, 255)
    fitted = exposure_gain(newest, dataclasses.replace(older, rgb=rgb))
    assert fitted == pytest.approx([1.25] * 3, rel=0.03)


def test_an_exposure_is_fitted_through_the_keyframes_between():
    # The oldest has nothing in common with the newest, whose depth is unknown; the middle one has.
    newest, middle, oldest = prior_of(FIRST), prior_of(SECOND, gain=0.8), prior_of(SECOND, gain=0.5)
    blind = dataclasses.replace(newest, known=np.zeros_like(newest.known))
    assert exposure_gains([blind, middle, oldest])[2] == pytest.approx([1.6] * 3, rel=0.03)  # 0.8 / 0.5


def sphere(radius_m, x, content=0):
    return prepare(
        np.random.default_rng(0).integers(0, 255, (32, 64, 3)).astype(np.uint8),
        np.full((32, 64), radius_m, np.float32), pose_matrix(x=x), 0.02, GeometryConfig(), 2048,
    )  # fmt: skip


def with_person(prior, depth_m=1.5):
    """The same with somebody in the middle of the picture, 16 × 16 pixels, in colours of their own."""
    inverse, rgb = prior.inverse_depth.copy(), prior.rgb.copy()
    inverse[8:24, 24:40] = 1 / depth_m
    rgb[8:24, 24:40] ^= 128
    return dataclasses.replace(prior, inverse_depth=inverse, rgb=rgb)


def test_what_has_moved_by_majority():
    empty, busy = sphere(4.0, 0.0), with_person(sphere(4.0, 0.0))
    inside = np.s_[9:23, 25:39]

    def gone(*priors):
        masks = moved(priors)
        return [bool(mask[inside].all()) for mask in masks], [int(mask.sum()) for mask in masks]

    # Two: the newer wins. It sees nobody, so the older's person is gone; it sees somebody, and the wall that the older
    # saw behind is hidden from it: nothing is gone.
    assert gone(empty, busy)[0] == [False, True]
    assert gone(busy, empty)[1] == [0, 0]
    # Three: who is seen by one only has moved, be it the newest; who is seen by two stands there.
    for order in range(3):
        three = [empty] * 3
        three[order] = busy
        assert gone(*three)[0] == [number == order for number in range(3)]
        assert gone(*three)[1][(order + 1) % 3] == 0
    assert gone(empty, busy, busy)[0] == [False, False, False]
    # What the others' pictures show in the newest's colours stands there, whatever their depths say.
    assert gone(dataclasses.replace(busy, rgb=empty.rgb), empty, empty)[1] == [0, 0, 0]
    # Errors of the depth within three sigmas are no movement, nor is what the others do not know.
    assert gone(empty, with_person(empty, 3.7), empty)[1] == [0, 0, 0]
    blind = dataclasses.replace(empty, known=np.zeros_like(empty.known))
    assert gone(blind, busy, blind)[1] == [0, 0, 0]


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
    space.set_keyframe(picture.rgb, depth, pose, 0.02)
    assert (space.keyframes[1].content == MOVED).sum() > 100
    assert not space.scene.priors[1].usable.all()  # nor does the field learn from it
