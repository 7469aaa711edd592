"""What nobody has seen: continued behind edges, under the robot, and the sky; fixed in the map."""

import math

import numpy as np
import pytest
from scipy.ndimage import binary_erosion

from instant_ic.geometry.poses import pose_matrix
from instant_ic.geometry.projections import equirect_directions
from instant_ic.vspace import VirtualSpace, VirtualSpaceConfig
from instant_ic.vspace.background import Background, level_planes
from instant_ic.vspace.background_kernels import in_front
from instant_ic.vspace.composition import ComposedView, filled_image
from instant_ic.vspace.config import GeometryConfig
from instant_ic.vspace.prior import ROBOT, ROOM, SKY, prepare, sky_region
from instant_ic.vspace.view import perspective_rays

H, W = 64, 128
THING = np.s_[26:38, 56:72]  # rows and columns round the middle of the picture


def keyframe(robot=None, body_below_deg=-90.0, sky=False, sky_share=0.05):
    """A sphere of 4 m, bluish, with a red thing at 2 m ahead; unknown above 20° where there is a sky."""
    rgb = np.zeros((H, W, 3), np.uint8)
    rgb[...] = 40, 90, 160
    rgb[::2, ::2] += 10
    depth = np.full((H, W), 4.0, np.float32)
    rgb[THING], depth[THING] = (200, 30, 30), 2.0
    if sky:
        rgb[:24], depth[:24] = (220, 230, 250), 0.0
    config = GeometryConfig(body_below_deg=body_below_deg, sky_share=sky_share)
    return prepare(rgb, depth, np.eye(4), 0.02, config, 2048, robot)


def space_of(prior, **geometry):
    config = VirtualSpaceConfig(device="cpu", source="warp", geometry=GeometryConfig(**geometry))
    space = VirtualSpace(config)
    depth = np.where(prior.content == SKY, 0, 1 / prior.inverse_depth)
    space.set_keyframe(prior.rgb, depth, prior.map_from_camera, 0.02)
    return space


def test_the_near_side_of_an_edge_by_hand():
    inverse = np.full((8, 16), 0.25, np.float32)
    inverse[2:6, 4:9] = 0.5
    depth_edge = np.zeros((8, 16), np.uint8)
    depth_edge[2:6, 3] = depth_edge[2:6, 8] = 1
    depth_edge[1, 3:9] = depth_edge[5, 3:9] = 1
    steps = np.zeros((8, 16), np.int32)
    level = np.zeros((8, 16), np.uint8)
    in_front(inverse, depth_edge, level, 9, steps)
    assert steps[2:6, 4:9].tolist() == [[1, 1, 1, 1, 1], [1, 2, 2, 2, 1], [1, 2, 2, 2, 1], [1, 1, 1, 1, 1]]
    assert np.count_nonzero(steps) == 20  # nothing on the far side
    steps[...] = 0
    in_front(inverse, depth_edge, level, 1, steps)
    assert steps.max() == 1
    steps[...], level[5] = 0, 1  # its last row is floor
    in_front(inverse, depth_edge, level, 9, steps)
    assert np.count_nonzero(steps) == 15


def test_behind_a_thing_its_background_goes_on():
    background = Background.of(keyframe())
    # The thing is gone from it, in depth and in colour.
    assert 1 / background.inverse_depth[THING] == pytest.approx(np.full((12, 16), 4.0), rel=1e-3)
    assert background.rgb[THING][..., 0].max() < 60
    assert np.array_equal(background.rgb[:20], keyframe().rgb[:20])
    assert len(background.sky_quads) == 0


def test_floor_and_ceiling_are_found_and_go_on_behind_a_thing():
    """A hall of 1.2 m below and 1.5 m above the camera, walls 4 m off all round, and a thing at 2 m on its floor."""
    elevation = np.pi / 2 - (np.arange(H) + 0.5) * (np.pi / H)
    rise = np.repeat(np.sin(elevation)[:, None], W, 1).astype(np.float32)
    flat = np.cos(elevation)[:, None]
    inverse = np.maximum(np.maximum(flat / 4, -rise / 1.2), rise / 1.5).astype(np.float32)
    floor, ceiling = level_planes(inverse, rise, np.ones((H, W), bool))
    assert floor == pytest.approx(np.maximum(-rise / 1.2, 0), rel=1e-5)
    assert ceiling == pytest.approx(np.maximum(rise / 1.5, 0), rel=1e-5)
    rough = inverse * np.random.default_rng(0).uniform(0.5, 2, inverse.shape).astype(np.float32)
    assert not np.any(level_planes(rough, rise, np.ones((H, W), bool)))
    rgb = np.full((H, W, 3), (40, 90, 160), np.uint8)
    rgb[inverse == -rise / np.float32(1.2)] = 20, 150, 20
    thing = np.s_[26:42, 59:69]  # down to 27 degrees below the horizon, where the floor is 2.6 m off
    rgb[thing] = 200, 30, 30
    seen = inverse.copy()
    seen[thing] = np.maximum(np.repeat(flat / 2, W, 1)[thing], inverse[thing])
    background = Background.of(prepare(rgb, 1 / seen, np.eye(4), 0.02, GeometryConfig(), 2048))
    assert background.inverse_depth[thing] == pytest.approx(inverse[thing], rel=0.07)  # a plane, not a cylinder
    assert background.rgb[40, 60:68, 1].min() > 140  # floor, green
    assert background.rgb[28, 60:68, 2].min() > 140  # wall, blue


def test_the_guess_lies_fixed_in_the_map():
    """Two places in the map that nobody has seen have one colour in pictures from different poses."""
    background = Background.of(keyframe())
    rendered = []
    for pose in (pose_matrix(y=0.6, yaw=-0.2), pose_matrix(x=0.2, y=0.9, yaw=-0.3)):
        rays = perspective_rays(pose, 96, 64, 1.2)
        picture = np.zeros((96 * 64, 3), np.float32), np.zeros(96 * 64, np.float32), np.zeros(96 * 64, np.float32)
        done = background.render_rays(rays, np.ones(96 * 64, bool), picture)
        ends = rays.origin + picture[1][:, None] * rays.directions
        azimuth = np.arctan2(ends[:, 1], ends[:, 0])
        inside = (done > 0) & (np.abs(azimuth) < 0.2) & (np.abs(ends[:, 2]) < 0.5)
        assert inside.sum() > 50
        assert np.linalg.norm(ends[inside], axis=1) == pytest.approx(np.full(inside.sum(), 4.0), rel=0.01)
        rendered.append(picture[0][inside].mean(axis=0))
    assert rendered[0] == pytest.approx(rendered[1], abs=0.01)


def hall(door=False):
    """A keyframe 1.2 m over the floor of a hall, walls 4 m ahead and 6 m aside; rows of 1.4°.

    With a box of 1 m height and width 2 m ahead, or a partition there with a doorway 1.2 m wide. Returns directions,
    depth and kinds: 0 wall, 1 floor, 2 ceiling (2.7 m), 3 what stands in front.
    """
    height, width = 128, 256
    directions = equirect_directions(width, height).astype(np.float64)
    x, y, z = np.moveaxis(directions, -1, 0)
    with np.errstate(divide="ignore"):
        ranges = np.stack([np.where(x > 0, 4 / x, 3 / -x), np.abs(6 / y), np.where(z < 0, 1.2 / -z, 1.5 / z)])
        near = np.where(x > 0, 2 / x, np.inf)
    depth, side = ranges.min(axis=0), ranges.argmin(axis=0)
    kind = np.where(side < 2, 0, np.where(z < 0, 1, 2))
    across, up = np.where(np.isfinite(near), near, 0) * y, np.where(np.isfinite(near), near, 0) * z
    stands = np.abs(across) > 0.6 if door else (np.abs(across) < 0.5) & (up < -0.2)
    front = (near < depth) & stands
    return directions, np.where(front, near, depth).astype(np.float32), np.where(front, 3, kind), depth, kind


COLOURS = np.array([(40, 90, 160), (20, 150, 20), (220, 220, 200), (200, 30, 30)], np.uint8)


def test_floor_and_wall_go_on_behind_a_box():
    """Behind the box lies what stands there without it: floor up to 4 m, then the wall, to 2 % and in their colours."""
    _, depth, shown, truth, kind = hall()
    background = Background.of(prepare(COLOURS[shown], depth, np.eye(4), 0.02, GeometryConfig(), 2048))
    inside = binary_erosion(shown == 3, iterations=2)
    assert inside.sum() > 200
    assert background.inverse_depth[inside] * truth[inside] == pytest.approx(np.ones(inside.sum()), abs=0.02)
    for number in (0, 1):
        away = binary_erosion(kind == number, iterations=2) & inside  # a pixel on the line has a share of both
        assert away.any()
        assert np.abs(background.rgb[away].astype(int) - COLOURS[number]).max() <= 2
        assert (background.opacity[away] == 255).all()
    quads = np.zeros(depth.shape, bool)
    quads[tuple(background.quads.T)] = True
    assert quads[inside].mean() > 0.95


def test_a_doorway_stays_open():
    """Beside a doorway the far room's floor and wall go on: nothing of the partition's colour, wall 4 m ahead."""
    directions, depth, shown, _, _ = hall(door=True)
    background = Background.of(prepare(COLOURS[shown], depth, np.eye(4), 0.02, GeometryConfig(), 2048))
    x, y, z = np.moveaxis(directions, -1, 0)
    beside = binary_erosion(shown == 3, iterations=2) & (x > 0) & (np.abs(y / x) < 0.5) & (np.abs(z + 0.1) < 0.3)
    assert beside.sum() > 100
    assert background.rgb[beside][:, 0].max() < 60  # nothing red
    wall = beside & (z > -0.15)
    assert 1 / background.inverse_depth[wall] == pytest.approx(4 / x[wall], rel=0.1)
    floor = beside & (z < -0.3)
    assert floor.any()
    assert 1 / background.inverse_depth[floor] == pytest.approx(1.2 / -z[floor], rel=0.02)
    assert np.abs(background.rgb[floor].astype(int) - COLOURS[1]).max() <= 2
    # A wall that leads on out of sight is a guess: part of it is continued from around in the image.
    assert background.opacity[wall].max() < 0.7 * 255 <= background.opacity[floor].min()
    space = VirtualSpace(VirtualSpaceConfig(device="cpu", source="warp"))
    space.set_keyframe(COLOURS[shown], depth, np.eye(4), 0.02)
    view = space.render(pose_matrix(x=1.8, pitch=0.4), 160, 90, math.pi / 2)  # in the doorway
    low = view.rgb[60:].reshape(-1, 3).astype(int)
    assert (np.abs(low - COLOURS[1]).max(axis=1) < 40).mean() > 0.99  # floor, from side to side


def test_guesses_are_mixed_in_by_hand():
    colour, depth = np.zeros((12, 3), np.float32), np.ones(12, np.float32)
    colour[[0, 5, 6, 11]], colour[1:5], colour[7:11] = 0.2, 1.0, 1.0
    seen = np.tile(np.array([1, 0, 0, 0, 0, 1], np.float32), 2)
    share = np.tile(np.array([0, 1, 0.5, 0.25, 0, 0], np.float32), 2)
    image = filled_image(ComposedView(colour, depth, seen, share), (2, 6), False)
    # From around it is 0.2 everywhere: 0.2 + share · 0.8.
    assert image[0, :, 0] == pytest.approx([0.2, 1.0, 0.6, 0.4, 0.2, 0.2])


def test_the_robot_is_not_shown_and_not_learnt():
    prior = keyframe(body_below_deg=-45.0)
    rows = np.arange(H)
    below = 90 - (rows + 0.5) * 180 / H < -45
    assert np.array_equal(prior.content == ROBOT, np.repeat(below[:, None], W, 1))
    assert np.array_equal(prior.usable == 0, prior.content == ROBOT)
    space = space_of(keyframe(), body_below_deg=-45.0)
    space.keyframe.rgb[below] = 255  # the robot's own colour, would it be shown
    down = space.render(pose_matrix(pitch=math.pi / 2), 64, 64, 1.2)
    assert down.confidence.max() == 0
    assert down.rgb[20:44, 20:44].max() < 200
    assert np.median(np.abs(down.depth_m[20:44, 20:44] - 4.0)) < 0.3
    assert space.render(pose_matrix(yaw=2.0), 64, 48, 1.0).confidence.min() == 1


def test_the_sky_is_endlessly_far_and_known():
    prior = keyframe(sky=True)
    assert (prior.content[:24] == SKY).all()
    assert (prior.content[24:] == ROOM).all()
    space = space_of(prior)
    for x in (0.0, 1.0):
        up = space.render(pose_matrix(x=x, pitch=-1.0), 64, 48, 0.8)
        assert up.confidence.min() == 1
        assert up.rgb.reshape(-1, 3).min(axis=0) == pytest.approx([220, 230, 250], abs=3)
        assert up.depth_m.min() > 1000
    # Where there is to be no sky, it is filled from around.
    assert (keyframe(sky=True, sky_share=1.0).content == ROOM).all()


def test_what_counts_as_sky():
    unknown = np.zeros((H, W), bool)
    unknown[:20] = True
    assert sky_region(unknown, 0.05)[:20].all()
    low = unknown[::-1]
    assert not sky_region(low, 0.05).any()  # under one's feet is none
    small = np.zeros((H, W), bool)
    small[2:8, 10:20] = True
    assert not sky_region(small, 0.05).any()
    over_the_seam = np.zeros((H, W), bool)
    over_the_seam[4:30, :14] = over_the_seam[4:30, -14:] = True
    assert np.array_equal(sky_region(over_the_seam, 0.05), over_the_seam)
    half = over_the_seam & (np.arange(W) < 64)
    assert not sky_region(half, 0.05).any()  # each half alone is too small
