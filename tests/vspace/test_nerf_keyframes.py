"""Several keyframes together: more is seen, in one exposure, without what has moved away."""

import dataclasses
import math
import types

import numpy as np
import pytest

from instant_ic.experiments import box_room
from instant_ic.geometry.image_quality import psnr_db
from instant_ic.geometry.poses import pose_matrix
from instant_ic.geometry.projections import equirect_pixels
from instant_ic.vspace import FieldConfig, ReadinessConfig, State, TrainConfig, VirtualSpace, VirtualSpaceConfig
from instant_ic.vspace import compose as composing
from instant_ic.vspace.compose import Layer, compose, exposure_gain, exposure_gains, moved
from instant_ic.vspace.config import GeometryConfig
from instant_ic.vspace.nerf.field import Rays
from instant_ic.vspace.prior import MOVED, ROOM, prepare
from instant_ic.vspace.store import Keyframe, recent, spread
from instant_ic.vspace.view import perspective_rays

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
    assert [prior.map_from_camera[0, 3] for prior in space.keyframes] == [0.5, 0.0, -0.5][:keyframes]
    assert len(space._scene.priors) == len(space.keyframes)  # one field learns from all of them
    # A new one is shown from the first moment, and what was fit to show stays so.
    picture = box_room.panorama(FIRST, 96)
    space.set_keyframe(picture.rgb, picture.depth_m, FIRST, 0.02)
    assert (space.status.state, space.status.refreshing) == (State.READY, True)
    assert [prior.map_from_camera[0, 3] for prior in space.keyframes] == [-1.5, 0.5, 0.0][:keyframes]
    space.train()
    assert not space.status.refreshing


def test_nothing_large_is_allocated_for_a_keyframe_after_the_first():
    space = VirtualSpace(dataclasses.replace(CONFIG, keyframes=2))
    seen = set()
    for number in range(9):
        learn(space, pose_matrix(x=-1.0 + 0.2 * number))
        space.render(VIEW, 32, 32, 1.0)
        seen.add(space.keyframe.rgb.__array_interface__["data"][0])
        # What is shown is what was taken, although others have lain in its place before.
        assert np.array_equal(space.keyframe.rgb, box_room.panorama(space.keyframe.map_from_camera, 96).rgb)
    assert len(seen) <= 4  # two shown, one that is left, one that is made ready
    assert len(space._store._arrays) == 4


def test_keyframes_of_another_size_replace_all():
    space = learn(VirtualSpace(CONFIG), FIRST, SECOND)
    picture = box_room.panorama(VIEW, 64)
    space.set_keyframe(picture.rgb, picture.depth_m, VIEW, 0.02)
    assert len(space.keyframes) == 1
    view = space.render(VIEW, 64, 48, 1.2)
    assert psnr_db(view.rgb, box_room.perspective(VIEW, 64, 48, 1.2).rgb) > 22
    learn(space, FIRST)
    assert len(space.keyframes) == 1


def test_a_saved_space_has_all_its_keyframes(tmp_path):
    space = learn(VirtualSpace(CONFIG), SECOND, FIRST)
    space.save(tmp_path)
    loaded = VirtualSpace.load(tmp_path)
    before, after = space.render(VIEW, 64, 48, 1.5), loaded.render(VIEW, 64, 48, 1.5)
    assert np.array_equal(before.rgb, after.rgb)
    assert np.array_equal(before.depth_m, after.depth_m)
    assert len(loaded.keyframes) == 2


def test_exposure_is_fitted_where_both_have_seen():
    newest, older = prior_of(FIRST), prior_of(SECOND, gain=(0.8, 0.7, 0.6))
    assert exposure_gain(newest, older) == pytest.approx([1 / 0.8, 1 / 0.7, 1 / 0.6], rel=0.02)
    black = dataclasses.replace(older, rgb=older.rgb // 100)
    assert exposure_gain(newest, black) is None  # nothing to fit on
    assert exposure_gains([newest, black]).tolist() == [[1, 1, 1], [1, 1, 1]]
    # A picture of both has the newest's exposure throughout: as if the other had been taken with it.
    uneven = learn(VirtualSpace(CONFIG), SECOND, FIRST, gains=(0.6, 1.0)).render(VIEW, 96, 64, 1.5)
    even = learn(VirtualSpace(CONFIG), SECOND, FIRST).render(VIEW, 96, 64, 1.5)
    assert psnr_db(uneven.rgb, even.rgb) > 28


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


def test_the_order_of_keyframes_does_not_matter():
    space = VirtualSpaceConfig(device="cpu", source="warp", keyframes=3, older=0)
    views = []
    for poses in ((FIRST, SECOND, pose_matrix()), (pose_matrix(), FIRST, SECOND), (SECOND, pose_matrix(), FIRST)):
        made = VirtualSpace(space)
        for pose in poses:
            picture = box_room.panorama(pose, 96)
            made.set_keyframe(picture.rgb, picture.depth_m, pose, 0.02)
        view = made.render(VIEW, 96, 64, 1.5)
        views.append(view)
    for view in views[1:]:
        assert np.array_equal(view.rgb, views[0].rgb)
        assert np.array_equal(view.confidence, views[0].confidence)


def test_which_older_keyframes_are_chosen_and_kept():
    def at(x):
        return Keyframe(0, types.SimpleNamespace(map_from_camera=pose_matrix(x=x)), None, None)

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


def test_a_keyframe_leaves_out_what_has_moved_and_takes_it_in_again():
    prior, mask = sphere(4.0, 0.0), np.zeros((32, 64), bool)
    mask[4, 5] = True
    left = prior.without(mask)
    assert (left.content[4, 5], left.usable[4, 5], (left.content != ROOM).sum()) == (MOVED, 0, 1)
    assert left.without(~mask & False).usable.all()
    assert prior.without(mask & False) is prior


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
    assert pixels_on_the_box() < 5
    assert (space.keyframes[1].content == MOVED).sum() > 100
    assert not space._scene.priors[1].usable.all()  # nor does the field learn from it


def layer(prior, depth, confidence, colour, gain=1.0):
    depth, confidence = np.array(depth, np.float32), np.array(confidence, np.float32)
    colours = np.repeat(np.array(colour, np.float32)[:, None], 3, 1)
    return Layer(prior, np.full(3, gain, np.float32), colours, depth, confidence)


def test_composing_by_hand():
    # Both keyframes stand where the view does; three pixels straight ahead, far beyond what either has looked through.
    near, rays = prior_of(np.eye(4)), perspective_rays(np.eye(4), 16, 16, 0.01)
    rays = Rays(rays.origin, np.tile(np.array([[1.0, 0, 0]], np.float32), (5, 1)), rays.axial, rays.shape)
    newest = layer(near, [5, 9, 0, 5, 0], [1, 1, 0, 0.5, 0], [0.2, 0.2, 0.2, 0.2, 0.1])
    older = layer(near, [5.1, 6, 7, 9, 0], [1, 1, 1, 1, 0], [0.3, 0.3, 0.3, 0.3, 0.9], gain=2.0)
    colour, depth, confidence = compose([newest, older], rays)
    # One surface: half of each, as both stand at the view's place. Then the nearer; the only one; the one that is known
    # rather than filled; nobody's: as the newest has it.
    assert colour[:, 0] == pytest.approx([0.5 * 0.2 + 0.5 * 0.6, 0.6, 0.6, 0.6, 0.1], abs=0.01)
    assert depth == pytest.approx([5.05, 6, 7, 9, 0], abs=0.01)
    assert confidence.tolist() == [1, 1, 1, 1, 0]


def test_an_older_keyframe_shows_its_edges_only_where_it_sees_more_than_the_newest():
    # A surface 5 m ahead, which the newest only guesses; all of the older one's depth is edges.
    rays = perspective_rays(np.eye(4), 16, 16, 0.01)
    rays = Rays(rays.origin, np.array([[1.0, 0, 0]], np.float32), rays.axial, rays.shape)

    def confidence(x, y):
        newest = prior_of(np.eye(4))
        older = dataclasses.replace(
            newest, map_from_camera=pose_matrix(x=x, y=y), depth_edge=np.ones_like(newest.depth_edge)
        )
        layers = [layer(newest, [5], [0], [0.2]), layer(older, [5], [1], [0.9])]
        return float(compose(layers, rays)[2][0])

    assert confidence(-0.3, 0.5) == confidence(0.3, 0.5) == 0  # 5.32 m and 4.73 m off, 5 and 6 degrees beside
    assert confidence(0.8, 0.5) == 1  # 4.23 m off: nearer than 4.5 m
    assert confidence(2.0, 4.0) == 1  # 5 m off, 53 degrees beside


def test_what_a_newer_keyframe_has_looked_through_is_left_out_of_an_older_one():
    newest, rays = prior_of(np.eye(4)), perspective_rays(np.eye(4), 16, 16, 0.01)
    rays = Rays(rays.origin, np.array([[1.0, 0, 0]], np.float32), rays.axial, rays.shape)
    height, width = newest.inverse_depth.shape
    wall = 1 / newest.inverse_depth[height // 2, width // 2]
    layers = [layer(newest, [wall], [1], [0.2]), layer(prior_of(pose_matrix(x=-0.3)), [0.5 * wall], [1], [0.9])]
    colour, depth, confidence = compose(layers, rays)
    assert (colour[0, 0], depth[0], confidence[0]) == (pytest.approx(0.2), pytest.approx(wall), 1)
    # The other way round nobody newer has looked there: the nearer surface counts.
    colour, depth, _ = compose([layer(newest, [0.5 * wall], [1], [0.9]), layer(newest, [wall], [1], [0.2])], rays)
    assert (colour[0, 0], depth[0]) == (pytest.approx(0.9), pytest.approx(0.5 * wall))


def test_the_keyframe_that_is_nearer_to_a_surface_has_more_say():
    rays = perspective_rays(np.eye(4), 16, 16, 0.01)
    rays = Rays(rays.origin, np.array([[1.0, 0, 0]], np.float32), rays.axial, rays.shape)
    layers = [layer(prior_of(pose_matrix(x=x)), [8], [1], [value]) for x, value in ((-2.5, 0.0), (2.0, 1.0))]
    # Surface at 8 m, seen from 10.5 and from 6: penalties 0.05 + 10.5/8 − 1 = 0.3625 and 0.05, to the power of −6.
    colour, _, _ = compose(layers, rays)
    assert colour[0, 0] == pytest.approx(1 / (1 + (0.05 / 0.3625) ** 6), abs=1e-3)


@pytest.mark.parametrize("keyframes", [1, 3])
def test_a_refresh_costs_no_picture_more_than_a_decibel(keyframes):
    """A drive with a keyframe every 0.6 m: each picture against what the older keyframes would show."""
    config = dataclasses.replace(CONFIG, source="warp", keyframes=keyframes)
    space, without = VirtualSpace(config), VirtualSpace(config)
    worst, taken = math.inf, []
    for number in range(16):
        x = -2.0 + 0.2 * number
        if number % 3 == 0:
            pose = pose_matrix(x=x, y=-0.3)
            picture = box_room.panorama(pose, 96)
            if taken:
                without.set_keyframe(*taken[-1])
            taken.append((picture.rgb, picture.depth_m, pose, 0.02))
            space.show(space.prepare(*taken[-1]), dissolve=True)
        view = pose_matrix(x=x + 0.7, y=-0.3, yaw=0.3 * math.sin(x))
        truth = box_room.perspective(view, 64, 36, 1.5).rgb
        shown = psnr_db(space.render(view, 64, 36, 1.5).rgb, truth)
        if len(taken) > 1:
            worst = min(worst, shown - psnr_db(without.render(view, 64, 36, 1.5).rgb, truth))
    assert worst > -1.0


def composed_plainly(layers, rays):
    """The rules of ``compose`` in plain numpy."""
    depth, confidence = (np.stack([getattr(one, key) for one in layers]) for key in ("depth", "confidence"))

    def angle(prior, points, directions):
        seen = points - prior.map_from_camera[:3, 3]
        cosine = np.einsum("ij,ij->i", seen, directions) / np.linalg.norm(seen, axis=1)
        return np.arccos(np.clip(cosine, -1, 1))

    rank = confidence.copy()
    for number, one in enumerate(layers):
        at = np.flatnonzero(confidence[number])
        points = rays.origin + depth[number, at, None] * rays.directions[at]
        local = (points - one.prior.map_from_camera[:3, 3]) @ one.prior.map_from_camera[:3, :3]
        height, width = one.prior.depth_edge.shape
        u, v = equirect_pixels(local, width, height)
        row, column = np.clip(np.floor(v), 0, height - 1).astype(int), np.floor(u).astype(int) % width
        own, first = (points - prior.map_from_camera[:3, 3] for prior in (one.prior, layers[0].prior))
        near, far = np.linalg.norm(own, axis=1), np.linalg.norm(first, axis=1)
        between = np.arccos(np.clip(np.einsum("ij,ij->i", own, first) / (near * far), -1, 1))
        anew = (near < composing.NEARER * far) | (between > composing.OTHER_SIDE_RAD)
        lax = anew | (number == 0)
        edge = np.where(lax, one.prior.depth_edge[row, column], one.prior.beside_edge[row, column]) > 0
        edge &= angle(one.prior, points, rays.directions[at]) > 0.02
        rank[number, at] -= np.where(edge, np.where(lax, composing.EDGE, rank[number, at]), 0)
        for newer, other in enumerate(layers[:number]):
            room = 1 + composing.disagreement(other.prior, one.prior)
            local = (points - other.prior.map_from_camera[:3, 3]) @ other.prior.map_from_camera[:3, :3]
            u, v = equirect_pixels(local, width, height)
            row, column = np.clip(np.floor(v), 0, height - 1).astype(int), np.floor(u).astype(int) % width
            rows, columns = np.stack([row, np.minimum(row + 1, height - 1)]), np.stack([column, (column + 1) % width])
            corners = rows[:, None], columns[None]
            ratios = other.prior.inverse_depth[corners] * np.linalg.norm(local, axis=1)
            sure = (other.prior.known[corners] == 1).all(axis=(0, 1)) & (ratios.min(axis=(0, 1)) <= room)
            t = depth[number, at]
            drawn = (confidence[newer, at] > 0) & (np.abs(depth[newer, at] - t) <= composing.SAME_PLACE * t)
            through = ratios.max(axis=(0, 1)) * room < 1
            rank[number, at] = np.where(sure & (through | ~(drawn | anew)), 0, rank[number, at])
    met = rank.max(axis=0) > 0
    candidate = (rank > 0) & (rank == rank.max(axis=0))
    nearest = np.where(candidate, depth, np.inf).min(axis=0)
    candidate &= depth <= nearest * (1 + composing.SAME_PLACE)
    penalty = np.full(depth.shape, np.inf)
    points = rays.origin + nearest[met, None] * rays.directions[met]
    for number, one in enumerate(layers):
        away = np.linalg.norm(points - one.prior.map_from_camera[:3, 3], axis=1)
        aside = angle(one.prior, points, rays.directions[met])
        penalty[number, met] = composing.LEAST_PENALTY + aside + np.maximum(0, away / nearest[met] - 1)
    penalty[~candidate] = np.inf
    surface = np.take_along_axis(depth, penalty.argmin(axis=0)[None], axis=0)[0]
    candidate &= np.abs(depth - surface) <= surface * composing.SAME_SURFACE
    weight = np.where(candidate, penalty, np.inf) ** -composing.SHARPNESS
    weight[0, ~met] = 1
    weight /= weight.sum(axis=0)
    colour = sum(w[:, None] * one.gain * one.colour for w, one in zip(weight, layers, strict=True))
    return colour, (weight * depth).sum(axis=0), np.where(candidate, confidence, 0).max(axis=0)


def test_the_kernel_composes_as_plain_numpy_does():
    from instant_ic.vspace import PanoramaWarp

    rays = perspective_rays(VIEW, 48, 32, 1.5)
    layers = []
    for pose, gain in ((FIRST, 1.0), (SECOND, 0.8), (pose_matrix(x=0.4, y=-0.5), 1.2)):
        prior = prior_of(pose)
        layers.append(Layer(prior, np.full(3, gain, np.float32), *PanoramaWarp(prior).draw(rays)))
    for fast, plain in zip(compose(layers, rays), composed_plainly(layers, rays), strict=True):
        off = np.abs(fast - plain).reshape(len(rays.axial), -1).max(axis=1)
        assert np.count_nonzero(off > 2e-3) <= 3  # a pixel on the border of two rules may fall to either side
