"""The floor plans: what the experiments rely on, and that random interiors are closed and free where they say."""

import math

import numpy as np
import pytest

from instant_ic.geometry.poses import pose_matrix
from instant_ic.sim.contact import occupied_mask
from instant_ic.sim.render import EquirectRenderer
from instant_ic.sim.world import World
from instant_ic.sim.worlds import corridor_world, long_world, make_world, random_world


def ranges(world: World, origin: tuple[float, float, float], *directions: tuple[float, float, float]) -> np.ndarray:
    range_m, _ = world.caster.cast(np.asarray(origin), np.asarray(directions))
    return range_m


def test_corridor_has_the_measures_it_should(corridor: World) -> None:
    assert corridor.spawn == (0.0, 0.0, 0.0)
    # Over the obstacle, under the door frames' heads: 12 m to the end wall, whose poster stands out by 12 mm.
    assert ranges(corridor, (0, 0, 1.5), (1, 0, 0))[0] == pytest.approx(11.988, abs=1e-3)
    assert ranges(corridor, (0.4, 0, 1.0), (0, 1, 0), (0, -1, 0)) == pytest.approx([1.2, 1.2], abs=1e-3)
    assert ranges(corridor, (0.6, 0, 1.0), (0, 0, 1), (0, 0, -1)) == pytest.approx([1.7, 1.0], abs=1e-3)
    assert ranges(corridor, (10.8, 0, 1.0), (0, 1, 0))[0] == pytest.approx(10.18, abs=0.01)  # the window's pane


def test_obstacle_stands_four_metres_ahead_and_can_be_passed_on_both_sides(corridor: World) -> None:
    assert ranges(corridor, (0, 0, 0.4), (1, 0, 0))[0] == pytest.approx(4.0, abs=1e-4)
    assert ranges(corridor, (4.25, 0, 2.0), (0, 0, -1))[0] == pytest.approx(1.2, abs=1e-4)
    assert ranges(corridor, (4.25, 0.6, 0.4), (0, -1, 0), (0, 1, 0)) == pytest.approx([0.35, 0.6], abs=1e-3)
    free = corridor_world(obstacle=False, light_cell_m=0.5)
    assert ranges(free, (0, 0, 0.4), (1, 0, 0))[0] > 11


def test_obstacle_is_hard_to_see(corridor: World) -> None:
    frame = EquirectRenderer(corridor).render_perspective(pose_matrix(z=1.2), 640, 360, math.radians(60))
    # Focal length 554: at 4 m the front (0..0.8 m, 1.2..0.4 m under the camera) fills rows 235-346, columns 285-355.
    box = frame.rgb[240:335, 290:350].reshape(-1, 3).astype(float)
    assert np.abs(frame.depth_m[240:335, 290:350] - 4.1).max() < 0.2
    assert box.std(axis=0).max() < 8
    wall = frame.rgb[100:160, 20:60].reshape(-1, 3).astype(float)
    assert np.abs(box.mean(axis=0) - wall.mean(axis=0)).max() < 30


def test_every_room_of_the_corridor_can_be_driven_into(corridor: World) -> None:
    mask = corridor.occupied(0.03, 0.9, 0.05)
    reached = mask.centre(mask.reachable((0.0, 0.0), 0.30))
    for name, x, y in (("office", 1.0, -3.0), ("store", 7.0, -3.0), ("library", 3.0, 2.5), ("lounge", 14.0, 5.2),
                       ("kitchen", 8.5, 8.0), ("end", 10.8, 9.0)):  # fmt: skip
        assert np.hypot(reached[:, 0] - x, reached[:, 1] - y).min() < 0.3, name


@pytest.mark.parametrize("seed", range(3))
def test_random_interiors_are_closed_and_their_free_poses_are_free(seed: int) -> None:
    world = random_world(seed, light_cell_m=0.6, rays=4)
    poses = world.sample_free_poses(np.random.default_rng(seed), 12, clearance_m=0.35)
    assert poses.shape == (12, 3)
    angles = np.linspace(-math.pi, math.pi, 180, endpoint=False)
    around = np.column_stack([np.cos(angles), np.sin(angles), np.zeros(180)])
    for x, y, _ in poses:
        for z in (0.3, 1.2):
            nearest = ranges(world, (x, y, z), *map(tuple, around)).min()
            # The mask's cells are 5 cm.
            assert nearest > 0.35 - 0.08
    depth = EquirectRenderer(world).render(pose_matrix(poses[0, 0], poses[0, 1], 1.2), 256, 128).depth_m
    assert depth.min() > 0.05


def test_random_interiors_follow_their_seed() -> None:
    one, same, other = (random_world(seed, 0.6, 4) for seed in (7, 7, 8))
    assert np.array_equal(one.vertices, same.vertices) and np.array_equal(one.light, same.light)
    assert one.vertices.shape != other.vertices.shape or not np.array_equal(one.vertices, other.vertices)
    assert make_world("random:7").name == "random:7"


@pytest.mark.parametrize(("seed", "width_m"), [(2, (1.8, 3.2)), (3, (8.0, 15.0))])
def test_long_worlds_have_a_far_end_and_open_doors(seed: int, width_m: tuple[float, float]) -> None:
    world = long_world(seed, light_cell_m=1.0, rays=2)
    x0, y0, x1, y1, _ = world.zones[0]
    assert 20 <= x1 - x0 <= 40 and width_m[0] <= y1 - y0 <= width_m[1]
    assert len(world.zones) > 2  # side rooms with their doorways
    angles = np.linspace(-math.pi, math.pi, 720, endpoint=False)
    x, y, _ = world.sample_free_poses(np.random.default_rng(0), 1)[0]
    reach = ranges(world, (x, y, 2.0), *map(tuple, np.column_stack([np.cos(angles), np.sin(angles), 0 * angles])))
    assert np.isfinite(reach).all() and reach.max() > 2
    assert make_world(f"long:{seed}").name == f"long:{seed}"


def test_no_place_is_told(box_room: World) -> None:
    with pytest.raises(ValueError, match=r"no place with 2\.5 m"):
        box_room.sample_free_poses(np.random.default_rng(0), 1, clearance_m=2.5)


def test_mask_marks_what_stands_in_the_band_only() -> None:
    # A table top 0.7-0.8 m high as one triangle pair at z = 0.75, and a floor.
    vertices = np.asarray(
        [[0, 0, 0.75], [1, 0, 0.75], [1, 0.5, 0.75], [0, 0.5, 0.75], [-2, -2, 0], [2, -2, 0], [2, 2, 0], [-2, 2, 0]],
        float,
    )
    faces = np.asarray([[0, 1, 2], [0, 2, 3], [4, 5, 6], [4, 6, 7]])
    mask = occupied_mask(vertices, faces, 0.03, 0.9, 0.02)
    # 1 m x 0.5 m of cells of 2 cm, give or take the cells on the border.
    assert 50 * 25 <= mask.cells.sum() <= 52 * 27
    assert mask.at(np.asarray([[0.5, 0.25], [0.99, 0.49], [-0.1, 0.2], [50.0, 0.0]])).tolist() == [
        True,
        True,
        False,
        False,
    ]
    assert not occupied_mask(vertices, faces, 0.03, 0.7, 0.02).cells.any()
    # A wall that crosses the band is a line of cells, however steep its triangles.
    wall = np.asarray([[0, 0, -5.0], [3, 0, -5.0], [0, 0, 5.0]], float)
    line = occupied_mask(wall, np.asarray([[0, 1, 2]]), 0.03, 0.9, 0.02)
    # At z = 0.03 the triangle is 3 * (5 - 0.03) / 10 = 1.491 m long.
    assert line.at(np.column_stack([np.linspace(0.01, 1.48, 100), np.zeros(100)])).all()
    assert line.cells.sum() <= 2 * 76
