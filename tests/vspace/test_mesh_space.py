"""A scanned mesh as the virtual space: colours and depths by hand, against the world it was made of, and bad files."""

import math

import numpy as np
import pytest

from instant_ic.geometry.mesh_file import MeshError, load_mesh
from instant_ic.geometry.poses import pose_matrix
from instant_ic.geometry.projections import equirect_directions
from instant_ic.vspace import SpaceState, VirtualSpaceConfig
from instant_ic.vspace.mesh_space import MeshSpace, make_space
from tests import box_room

trimesh = pytest.importorskip("trimesh")

WALL = np.array([[2.0, 1, 1], [2, -1, 1], [2, -1, -1], [2, 1, -1]])  # 2 m ahead, from its top left clockwise
QUAD = np.array([[0, 1, 2], [0, 2, 3]])


def wall_file(folder, name="wall.ply", colours=None, vertices=WALL):
    mesh = trimesh.Trimesh(vertices, QUAD, vertex_colors=colours, process=False)
    mesh.export(folder / name)
    return folder / name


def textured_file(folder, picture, name="wall.obj", vertices=WALL):
    from PIL import Image

    uv = np.array([[0.0, 1], [1, 1], [1, 0], [0, 0]])  # v upwards
    image, materials = Image.fromarray(picture), trimesh.visual.material
    material = (
        materials.PBRMaterial(baseColorTexture=image) if name.endswith("glb") else materials.SimpleMaterial(image)
    )
    visual = trimesh.visual.TextureVisuals(uv=uv, material=material)
    mesh = trimesh.Trimesh(vertices, QUAD, visual=visual, process=False)
    mesh.export(folder / name)
    return folder / name


def space_of(path, **changes):
    return make_space(VirtualSpaceConfig(source="mesh", mesh=str(path), **changes))


def test_vertex_colours_by_hand(tmp_path):
    # Left edge black, right edge (200, 100, 0): in the middle of the wall half of that.
    colours = np.array([[0, 0, 0, 255], [200, 100, 0, 255], [200, 100, 0, 255], [0, 0, 0, 255]], np.uint8)
    space = space_of(wall_file(tmp_path, colours=colours))
    view = space.render(np.eye(4), 65, 33, math.pi / 2)
    assert view.depth_m[16, 32] == pytest.approx(2.0, abs=1e-4)
    assert view.rgb[16, 32] == pytest.approx([100, 50, 0], abs=1)
    # 90° over 65 pixels: the focal length is 32.5 pixels, the wall's edges at ± 1 m are 16.25 pixels from the middle.
    # Column 40 looks 8 · 2 / 32.5 m to the right: (1 + 0.492) / 2 of the way.
    assert view.rgb[16, 40] == pytest.approx([200 * 0.746, 100 * 0.746, 0], abs=1.5)
    seen = view.confidence[16] > 0
    assert np.flatnonzero(seen)[[0, -1]].tolist() == [16, 48]
    # Nothing is met beside it: unknown, without depth.
    assert not view.depth_m[16, :16].any()
    assert view.unseen_share == pytest.approx(32 / 65)  # 33 of 65 columns, all rows


@pytest.mark.parametrize("name", ["wall.obj", "wall.glb"])
def test_a_texture_by_hand(tmp_path, name):
    # Upper left red, upper right green, lower left blue, lower right white.
    picture = np.zeros((64, 64, 3), np.uint8)
    picture[:32, :32, 0] = picture[:32, 32:, 1] = picture[32:, :32, 2] = 250
    picture[32:, 32:] = 250
    # glTF has y up and looks along z: there (x, y, z) is our (z, x, y).
    vertices = WALL[:, [0, 2, 1]] * [1, 1, -1] if name.endswith("glb") else WALL
    space = space_of(textured_file(tmp_path, picture, name, vertices))
    view = space.render(np.eye(4), 64, 64, math.radians(50))
    assert view.rgb[16, 16] == pytest.approx([250, 0, 0], abs=2)
    assert view.rgb[16, 48] == pytest.approx([0, 250, 0], abs=2)
    assert view.rgb[48, 16] == pytest.approx([0, 0, 250], abs=2)
    assert view.rgb[48, 48] == pytest.approx([250, 250, 250], abs=2)


def test_a_materials_colour_is_light(tmp_path):
    # A factor of 0.5 in light is an sRGB value of 188.
    material = trimesh.visual.material.PBRMaterial(baseColorFactor=[0.5, 1.0, 0.0, 1.0])
    visual = trimesh.visual.TextureVisuals(uv=np.zeros((4, 2)), material=material)
    path = tmp_path / "plain.glb"
    trimesh.Trimesh(WALL[:, [0, 2, 1]] * [1, 1, -1], QUAD, visual=visual, process=False).export(path)
    assert space_of(path).render(np.eye(4), 33, 33, 0.5).rgb[16, 16] == pytest.approx([188, 255, 0], abs=1)


def test_a_fine_texture_far_away_is_averaged(tmp_path):
    # A chequerboard of 1 texel, 128 texels over 2 m; a picture's pixel is 0.2 m wide: grey, not noise.
    board = np.indices((128, 128)).sum(axis=0) % 2 * np.uint8(200)
    space = space_of(textured_file(tmp_path, np.repeat(board[..., None], 3, axis=2).astype(np.uint8)))
    view = space.render(np.eye(4), 20, 20, math.pi / 2)
    assert view.rgb[9, 9] == pytest.approx([100, 100, 100], abs=5)


def test_the_pose_places_the_mesh_in_the_map(tmp_path):
    # Turned by 90° and moved: the wall that was 2 m ahead along x now stands along y, 2 + 0.5 m away.
    space = space_of(wall_file(tmp_path), mesh_pose=(0.1, 0.5, 0.2, 90.0))
    view = space.render(pose_matrix(0.1, 0.0, 0.2, yaw=math.pi / 2), 33, 17, 0.5)
    assert view.depth_m[8, 16] == pytest.approx(2.5, abs=1e-3)
    assert not space.render(np.eye(4), 33, 17, 0.5).depth_m.any()


@pytest.fixture(scope="module")
def room(tmp_path_factory):
    """The box room as a mesh of vertex colours, a vertex a pixel of its panorama, and the panorama."""
    camera = pose_matrix(0.2, -0.1, 0.0, yaw=0.3)
    picture = box_room.panorama(camera, 64)
    height, width = picture.depth_m.shape
    points = picture.depth_m[..., None] * equirect_directions(width, height)
    points = points @ camera[:3, :3].T + camera[:3, 3]
    index = np.arange(height * width).reshape(height, width)
    a, b = index[:-1], np.roll(index, -1, axis=1)[:-1]
    c, d = index[1:], np.roll(index, -1, axis=1)[1:]
    faces = np.concatenate([np.stack(t, axis=-1).reshape(-1, 3) for t in ((a, c, b), (b, c, d))])
    colours = np.concatenate([picture.rgb.reshape(-1, 3), np.full((height * width, 1), 255, np.uint8)], axis=1)
    path = tmp_path_factory.mktemp("mesh") / "room.ply"
    trimesh.Trimesh(points.reshape(-1, 3), faces, vertex_colors=colours, process=False).export(path)
    return path, picture, camera


def test_a_scanned_room_looks_like_its_panorama(room):
    path, picture, camera = room
    space = space_of(path)
    assert isinstance(space, MeshSpace)
    assert space.status.state == SpaceState.READY
    before = space.render_equirect(camera, 128)
    assert math.isnan(before.expected_psnr_db)
    dim = np.rint(picture.rgb * [0.5, 0.7, 0.6]).astype(np.uint8)  # the light has changed since the scan
    space.set_keyframe(dim, picture.depth_m, camera, 0.05)
    after = space.render_equirect(camera, 128)
    inside = np.s_[8:-8]
    ratio = np.median(after.rgb[inside] / np.maximum(before.rgb[inside], 1), axis=(0, 1))
    assert ratio == pytest.approx([0.5, 0.7, 0.6], abs=0.03)
    assert np.median(np.abs(after.depth_m[inside] / picture.depth_m[inside] - 1)) < 0.01
    status = space.status
    assert status.psnr_db > 25
    assert not status.warning
    # Where all is seen, a view is worth what the mesh was at the keyframe; out of the house, nothing.
    assert space.render(camera, 64, 36, 1.5).expected_psnr_db == pytest.approx(status.psnr_db, abs=1.0)
    assert space.render(pose_matrix(50.0), 64, 36, 1.5).expected_psnr_db < status.psnr_db - 8
    # Training does nothing and says so.
    space.train(budget_ms=5)
    assert space.status.iterations == 0
    space.train()
    assert space.status.converged


def test_a_mesh_that_lies_elsewhere_is_told(room):
    path, picture, camera = room
    space = space_of(path)
    space.set_keyframe(picture.rgb, 1.6 * picture.depth_m, camera, 0.05)
    assert "only 0% of the mesh" in space.status.warning
    assert "mesh_pose" in space.status.warning
    space.set_keyframe(picture.rgb, picture.depth_m, camera @ pose_matrix(40.0), 0.05)
    assert "only 0% of the mesh" in space.status.warning
    space.set_keyframe(picture.rgb, np.full_like(picture.depth_m, np.nan), camera, 0.05)
    assert not space.status.warning  # nothing is known of it
    space.set_keyframe(picture.rgb, picture.depth_m, camera @ pose_matrix(0.4, 0.5, yaw=1.0), 0.05)
    assert "check space.mesh_pose" in space.status.warning
    space.set_keyframe(picture.rgb, picture.depth_m, camera, 0.05)
    assert not space.status.warning


def damaged(folder, name, content):
    path = folder / name
    path.write_bytes(content)
    return path


@pytest.mark.parametrize(
    ("make", "words"),
    [
        (lambda d: d / "none.glb", "no such file"),
        (lambda d: damaged(d, "a.glb", b"glTF\x02\x00\x00\x00 not really"), "damaged"),
        (lambda d: damaged(d, "a.ply", b"ply\nformat ascii 1.0\nelement vertex 3\n"), "damaged|no triangles"),
        (lambda d: damaged(d, "a.stl", b"solid"), "is not read. Use one of .glb"),
        (lambda d: damaged(d, "b.obj", b"v 0 0 0\nv 1 0 0\nv 2 0 0\nf 1 2 3\n"), "no triangles with an area"),
    ],
)
def test_files_that_are_no_good_say_why(tmp_path, make, words):
    path = make(tmp_path)
    with pytest.raises(MeshError, match=words) as error:
        load_mesh(path)
    assert path.name in str(error.value)


def test_a_mesh_too_large_is_refused(tmp_path, monkeypatch):
    path = wall_file(tmp_path)
    with pytest.raises(MeshError, match=r"2 triangles, the limit is 1"):
        load_mesh(path, max_triangles=1)
    monkeypatch.setattr("instant_ic.geometry.mesh_file.MAX_FILE_BYTES", 10)
    with pytest.raises(MeshError, match="GiB"):
        load_mesh(path)
