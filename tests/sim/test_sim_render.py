"""Pictures: geometry by hand, filtering, edges, light."""

import math
from pathlib import Path

import numpy as np
import pytest
import trimesh
from sim_oracles import box_range

from instant_ic.geometry.colour import linear_to_srgb, srgb_to_linear
from instant_ic.geometry.image_quality import psnr_db
from instant_ic.geometry.poses import pose_matrix
from instant_ic.geometry.projections import equirect_directions, perspective_directions
from instant_ic.sim.building import Building, Finish, Zone
from instant_ic.sim.render import EquirectRenderer
from instant_ic.sim.textures import make_texture, pyramid
from instant_ic.sim.world import Material, World, WorldBuilder
from instant_ic.sim.worlds import load_world, make_world


def test_panorama_depth_is_the_distance_to_the_walls(box_room: World) -> None:
    map_from_camera = pose_matrix(0.7, -0.4, 1.2, 0.05, -0.1, 0.6)
    frame = EquirectRenderer(box_room).render(map_from_camera, 256, 128)
    directions = equirect_directions(256, 128).astype(float) @ map_from_camera[:3, :3].T
    expected = box_range(map_from_camera[:3, 3], directions)
    assert np.abs(frame.depth_m - expected).max() < 1e-4


def test_perspective_depth_is_radial(box_room: World) -> None:
    map_from_camera = pose_matrix(0.0, 0.0, 1.5, 0.0, 0.0, 2.0)
    frame = EquirectRenderer(box_room).render_perspective(map_from_camera, 160, 90, math.radians(80))
    directions = perspective_directions(160, 90, math.radians(80)).astype(float)
    directions /= np.linalg.norm(directions, axis=-1, keepdims=True)
    expected = box_range(map_from_camera[:3, 3], directions @ map_from_camera[:3, :3].T)
    assert np.abs(frame.depth_m - expected).max() < 1e-4
    assert frame.rgb.shape == (90, 160, 3)


@pytest.mark.parametrize("size", [(101, 50), (8, 4)])
def test_sizes_that_the_coarse_grid_does_not_divide(box_room: World, size: tuple[int, int]) -> None:
    frame = EquirectRenderer(box_room).render(pose_matrix(z=1.2), *size)
    expected = box_range((0, 0, 1.2), equirect_directions(*size))
    assert np.abs(frame.depth_m - expected).max() < 1e-4


def test_coarse_casting_gives_what_casting_every_pixel_gives(corridor: World) -> None:
    pose = pose_matrix(0.5, 0.3, 1.2, 0, 0, 0.2)
    renderer = EquirectRenderer(corridor)
    frame = renderer.render(pose, 512, 256)
    directions = equirect_directions(512, 256).reshape(-1, 3) @ pose[:3, :3].T.astype(np.float32)
    range_m, _ = renderer.cast(np.broadcast_to(pose[:3, 3], directions.shape), directions)
    wrong = np.abs(frame.depth_m.ravel() - range_m) > 0.01 * range_m
    # Only what is thinner than four pixels and nowhere on the coarse grid may be missed.
    assert wrong.mean() < 0.003


def test_cast_gives_infinity_where_nothing_is(tmp_path: Path) -> None:
    mesh = trimesh.creation.box(extents=(1, 1, 1))
    mesh.apply_translation((0, 0, 0.5))
    path = tmp_path / "cube.obj"
    mesh.export(path)
    renderer = EquirectRenderer(load_world(path))
    range_m, face = renderer.cast(np.asarray([[3.0, 0, 0.5], [3.0, 0, 0.5]]), np.asarray([[-1.0, 0, 0], [1.0, 0, 0]]))
    assert range_m[0] == pytest.approx(2.5, abs=1e-5)
    assert np.isinf(range_m[1]) and face[1] == -1 and face[0] >= 0
    depth = renderer.render(pose_matrix(3.0, 0, 0.5, 0, 0, math.pi), 64, 32).depth_m
    assert depth[16, 32] == pytest.approx(2.5, rel=0.01) and depth[16, 0] == 0


def test_glb_nodes_are_placed_and_y_up_becomes_z_up(tmp_path: Path) -> None:
    scene = trimesh.Scene()
    # In glTF's axes: 2 m up (y) and 3 m along -z, which is +y of ours.
    scene.add_geometry(
        trimesh.creation.box(extents=(1, 1, 1)), transform=trimesh.transformations.translation_matrix((0, 2, -3))
    )
    path = tmp_path / "node.glb"
    scene.export(path)
    corners = load_world(path).vertices
    assert corners.min(axis=0) == pytest.approx([-0.5, 2.5, 1.5])
    assert corners.max(axis=0) == pytest.approx([0.5, 3.5, 2.5])


def test_textures_of_files_repeat(tmp_path: Path) -> None:
    from PIL import Image

    # Left half red, right half blue, four times along a wall of 4 m at x = 2.
    image = np.zeros((64, 64, 3), np.uint8)
    image[:, :32] = (255, 0, 0)
    image[:, 32:] = (0, 0, 255)
    vertices = [(2, 2, 0), (2, -2, 0), (2, -2, 4), (2, 2, 4)]
    mesh = trimesh.Trimesh(vertices, [[0, 1, 2], [0, 2, 3]], process=False)
    mesh.visual = trimesh.visual.TextureVisuals(
        uv=np.asarray([(0, 0), (4, 0), (4, 1), (0, 1)], float),
        material=trimesh.visual.material.PBRMaterial(baseColorTexture=Image.fromarray(image)),
    )
    path = tmp_path / "wall.obj"
    mesh.export(path)
    frame = EquirectRenderer(load_world(path)).render_perspective(pose_matrix(0, 0, 2), 80, 40, math.pi / 2)
    # At 2 m a picture of 90° is 4 m wide: columns 0-9 red, 10-19 blue, and so on.
    for stripe in range(8):
        r, _, b = frame.rgb[20, stripe * 10 + 5].astype(int)
        assert (r > 100 and b < 40) if stripe % 2 == 0 else (b > 100 and r < 40), stripe


def test_far_fine_texture_is_averaged_not_aliased() -> None:
    # A floor of 1 m² checks of 8 x 8 far away: point sampling would give a spread of tens of grey levels.
    building = Building()
    hall = Finish(floor=Material("floor_tiles", 0.5), skirting=None)
    building.add(Zone(-40.0, -3.0, 40.0, 3.0, 3.0, hall))
    world = building.world("hall", (0, 0, 0), light_cell_m=2.0, rays=4)
    world.light[:] = 0.8
    frame = EquirectRenderer(world).render_perspective(pose_matrix(z=1.2), 400, 200, math.radians(60))
    # 20 m and more ahead: rows just under the horizon, in the middle columns.
    far = frame.depth_m[:, 195:205].mean(axis=1)
    rows = np.flatnonzero((far > 20) & (far < 35) & (np.arange(200) > 100))
    assert len(rows) > 3
    assert frame.rgb[rows, 195:205].astype(float).std(axis=(0, 1)).max() < 6


def test_edges_and_textures_come_close_to_a_supersampled_picture(corridor: World) -> None:
    renderer, pose = EquirectRenderer(corridor), pose_matrix(z=1.2)
    plain = renderer.render(pose, 512, 256).rgb
    fine = renderer.render(pose, 512, 256, supersample=4).rgb
    # 35.7 dB without the sides of posters and skirting boards, which are narrower than a pixel.
    assert psnr_db(plain, fine) > 36.4


def test_triangles_smaller_than_a_pixel_have_smooth_silhouettes(tmp_path: Path) -> None:
    ball = trimesh.creation.icosphere(subdivisions=4, radius=0.3)
    ball.apply_translation((1.2, 0, 0.5))
    path = tmp_path / "ball.obj"
    ball.export(path)
    renderer, pose = EquirectRenderer(load_world(path)), pose_matrix(z=0.5)
    plain = renderer.render(pose, 256, 128).rgb
    fine = renderer.render(pose, 256, 128, supersample=4).rgb
    assert psnr_db(plain, fine) > 45


def test_light_is_darker_under_things_and_lamps_are_white() -> None:
    building = Building()
    zone = building.add(Zone(-3.0, -3.0, 3.0, 3.0, 2.7))
    building.lamps(zone)
    building.builder.box((0.0, 0.0), (1.5, 1.5, 0.05), 0.4)
    world = building.world("table", (2.0, 2.0, 0.0), light_cell_m=0.15, rays=24)
    renderer = EquirectRenderer(world)
    side = renderer.render_perspective(pose_matrix(-2.6, 0, 0.2), 200, 200, math.radians(70)).rgb
    side = srgb_to_linear(side / 255.0)
    floor = side[150:].mean()
    # Rows a little under the horizon in the middle see the floor under the slab.
    under = side[112:118, 80:120].mean()
    assert under < 0.8 * floor
    up = renderer.render_perspective(pose_matrix(-1.0, -1.0, 1.0, 0, -math.pi / 2, 0), 200, 200, math.radians(90)).rgb
    assert (up > 250).all(axis=-1).mean() > 0.01


def test_pyramid_keeps_the_mean_and_srgb_turns_back() -> None:
    levels = pyramid(make_texture("lino"))
    means = np.asarray([level.mean() for level in levels])
    assert levels[-1].shape[:2] == (1, 1)
    assert means == pytest.approx(means[0], rel=1e-4)
    values = np.linspace(0, 1, 50)
    assert srgb_to_linear(linear_to_srgb(values)) == pytest.approx(values, abs=1e-4)
    # IEC 61966-2-1: sRGB 0.5 is linear 0.2140.
    assert srgb_to_linear(np.asarray([0.5]))[0] == pytest.approx(0.2140, abs=1e-4)


def test_mistakes_are_told() -> None:
    with pytest.raises(ValueError, match="no procedural texture 'tartan'"):
        make_texture("tartan")
    with pytest.raises(ValueError, match=r"neither corridor.*nor a mesh file"):
        make_world("nowhere.glb")
    with pytest.raises(ValueError, match="seed must be an integer"):
        make_world("random:x")
    builder = WorldBuilder()
    builder.panel(np.zeros(3), np.asarray([1.0, 0, 0]), np.asarray([0, 1.0, 0]), Material("paint"))
    world = builder.build("one", 0.5, (0, 0, 0))
    with pytest.raises(ValueError, match="hfov_rad"):
        EquirectRenderer(world).render_perspective(np.eye(4), 10, 10, 4.0)
    with pytest.raises(ValueError, match="supersample"):
        EquirectRenderer(world).render(np.eye(4), 10, 10, 0)
