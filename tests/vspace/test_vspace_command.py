"""``ic vspace`` from panorama to picture, surfaces and video; bad inputs and what is said of them."""

import cv2
import numpy as np
import pytest
import trimesh

from instant_ic.adapters.vspace import layers_message
from instant_ic.bag import BagWriter
from instant_ic.cli.main import main
from instant_ic.experiments import box_room
from instant_ic.geometry.image_quality import psnr_db
from instant_ic.geometry.ply import write_ply
from instant_ic.geometry.poses import pose_matrix
from instant_ic.msg import Empty, serialize, type_name
from instant_ic.vspace import VirtualSpace, VirtualSpaceConfig
from instant_ic.vspace.export import flight, surface
from instant_ic.vspace.layers import encode
from instant_ic.vspace.space import NotReadyError


def write_rgb(path, rgb):
    cv2.imwrite(str(path), rgb[..., ::-1])
    return path


def read_rgb(path):
    return cv2.imread(str(path))[..., ::-1]


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    """A trained space, with the panorama and its depth beside it."""
    folder = tmp_path_factory.mktemp("v")
    picture = box_room.panorama(np.eye(4), 96)
    write_rgb(folder / "room.png", picture.rgb)
    cv2.imwrite(str(folder / "depth.png"), np.rint(1000 * picture.depth_m).astype(np.uint16))
    words = ["vspace", "train", str(folder / "room.png"), "--depth", str(folder / "depth.png")]
    assert main([*words, "--iterations", "25", "--device", "cpu", "-o", str(folder / "space")]) == 0
    return folder


def run(folder, verb, *words):
    return main(["vspace", verb, str(folder / "space"), *map(str, words)])


def test_the_newest_layers_of_a_bag_are_rendered(tmp_path, capsys):
    space, picture = VirtualSpace(VirtualSpaceConfig(source="warp", device="cpu")), box_room.panorama(np.eye(4), 96)
    space.set_keyframe(picture.rgb, picture.depth_m, np.eye(4), 0.02)
    image = cv2.imencode(".png", picture.rgb[..., ::-1])[1].tobytes()
    message = layers_message(encode(space.shown.newest, 3, image, 1), 5)
    view = ["--size", "96x64", "--pose", "0.4,0,0,20", "-o", str(tmp_path / "a.png")]
    with BagWriter(tmp_path / "bag") as writer:
        writer.write("/vspace/layers", type_name(message), serialize(message), 5)
    assert main(["vspace", "render", str(tmp_path / "bag"), *view]) == 0
    expected = space.render(pose_matrix(0.4, yaw=np.radians(20)), 96, 64, np.pi / 2).rgb
    assert psnr_db(read_rgb(tmp_path / "a.png"), expected) > 45
    with BagWriter(tmp_path / "other") as writer:
        writer.write("/vspace/status", "std_msgs/msg/Empty", serialize(Empty()), 5)
    assert main(["vspace", "render", str(tmp_path / "other"), *view]) == 1
    assert "holds no /vspace/layers" in capsys.readouterr().err


def test_training_leaves_a_space_and_a_picture_of_it(folder, capsys):
    assert sorted(p.name for p in (folder / "space").iterdir()) == ["preview.png", "space.npz"]
    ahead = box_room.perspective(pose_matrix(x=0.5), 640, 360, np.pi / 2).rgb
    assert np.abs(read_rgb(folder / "space" / "preview.png").astype(float) - ahead).mean() < 25
    assert run(folder, "info") == 0
    words = capsys.readouterr().out
    assert "25 iterations" in words
    assert "panorama 192 x 96" in words


def test_a_pose_is_relative_to_the_camera_with_yaw_in_degrees(folder, tmp_path, capsys):
    # Behind and to the right of the camera, looking to the left: also a pose that begins with a minus.
    assert run(folder, "render", "--pose", "-0.4,-0.3,0.1,90", "--size", "96x64", "-o", tmp_path / "a.png",
               "--depth", tmp_path / "a.npy", "--confidence", tmp_path / "c.png") == 0  # fmt: skip
    truth = box_room.perspective(pose_matrix(-0.4, -0.3, 0.1, yaw=np.pi / 2), 96, 64, np.pi / 2)
    other = box_room.perspective(pose_matrix(-0.4, 0.3, 0.1, yaw=-np.pi / 2), 96, 64, np.pi / 2)
    rgb = read_rgb(tmp_path / "a.png").astype(float)
    assert np.abs(rgb - truth.rgb).mean() < 20
    assert np.abs(rgb - other.rgb).mean() > 40
    seen = cv2.imread(str(tmp_path / "c.png"), cv2.IMREAD_UNCHANGED) > 0
    assert seen.mean() > 0.9
    depth = np.load(tmp_path / "a.npy")
    assert np.median(np.abs(depth / truth.depth_m - 1)[seen]) < 0.03
    assert "of the image is known" in capsys.readouterr().out


def test_panorama_and_cube(folder, tmp_path):
    assert run(folder, "render", "--projection", "equirect", "--size", "128x64", "-o", tmp_path / "e.png",
               "--depth", tmp_path / "d.png") == 0  # fmt: skip
    assert np.abs(read_rgb(tmp_path / "e.png").astype(float) - box_room.panorama(np.eye(4), 64).rgb).mean() < 15
    depth = cv2.imread(str(tmp_path / "d.png"), cv2.IMREAD_UNCHANGED)
    assert np.median(np.abs(depth / (1000 * box_room.panorama(np.eye(4), 64).depth_m) - 1)) < 0.03
    assert run(folder, "render", "--projection", "cube", "--size", "32x32", "-o", tmp_path / "c.png") == 0
    row = read_rgb(tmp_path / "c.png").astype(float)
    assert row.shape == (32, 192, 3)
    back = box_room.perspective(pose_matrix(yaw=np.pi), 32, 32, np.pi / 2).rgb
    assert np.abs(row[:, 64:96] - back).mean() < 25


def test_surfaces_as_another_program_reads_them(folder, tmp_path):
    assert run(folder, "export", "--mesh", tmp_path / "m.ply", "--width", "256") == 0
    mesh = trimesh.load(tmp_path / "m.ply", process=False)
    room = np.array([box_room.ROOM_LOW, box_room.ROOM_HIGH])
    assert np.abs(mesh.bounds - room).max() < 0.3
    # Closed but for edges and poles, and turned to the camera: the signed volume is that of the room, seen from inside.
    assert -mesh.volume == pytest.approx(np.prod(room[1] - room[0]), rel=0.15)
    assert run(folder, "export", "--points", tmp_path / "p.ply", "--width", "256") == 0
    cloud = trimesh.load(tmp_path / "p.ply")
    assert np.array_equal(cloud.vertices, mesh.vertices)
    assert np.array_equal(cloud.colors[:, :3], mesh.visual.vertex_colors[:, :3])
    # The point straight ahead has the colour and place of the wall there.
    ahead = np.argmin(
        np.linalg.norm(cloud.vertices / np.linalg.norm(cloud.vertices, axis=1)[:, None] - [1, 0, 0], axis=1)
    )
    truth = box_room.perspective(np.eye(4), 3, 3, 0.02)
    assert np.linalg.norm(cloud.vertices[ahead]) == pytest.approx(truth.depth_m[1, 1], rel=0.03)


def test_a_mesh_is_torn_at_edges(folder):
    found = surface(VirtualSpace.load(folder / "space"), 192)
    edges = found.points[found.triangles] - np.roll(found.points[found.triangles], 1, axis=1)
    far = np.linalg.norm(edges, axis=2).max(axis=1)
    # Across the box's edge to the wall behind it lie 1.5 m and more; along the walls a pixel's few centimetres.
    assert np.quantile(far, 0.999) < 0.6
    with pytest.raises(NotReadyError):
        surface(VirtualSpace(VirtualSpace.load(folder / "space").config))


def test_video(folder, tmp_path):
    assert run(folder, "video", "--path", "-0.5,0,0,-20", "0.5,0,0,20", "--seconds", "0.6", "--fps", "10", "--size",
               "96x64", "-o", tmp_path / "f.mp4") == 0  # fmt: skip
    video = cv2.VideoCapture(str(tmp_path / "f.mp4"))
    frames = [video.read()[1][..., ::-1].astype(float) for _ in range(int(video.get(cv2.CAP_PROP_FRAME_COUNT)))]
    assert len(frames) == 6
    for frame, x, yaw in ((frames[0], -0.5, -20), (frames[-1], 0.5, 20)):
        truth = box_room.perspective(pose_matrix(x, yaw=np.radians(yaw)), 96, 64, np.pi / 2).rgb
        assert np.abs(frame - truth).mean() < 25


def test_a_flight_passes_its_waypoints_and_turns_once_round():
    poses = flight([(0, 0, 0, 0), (1, 0, 0, 0), (1, 0, 0, 2 * np.pi)], 101)
    # 1 m counts 1, a turn of 2π counts π: the second waypoint comes after 1 / (1 + π) of the way, picture 24.
    places = np.array([p[:3, 3] for p in poses])
    assert places[24] == pytest.approx([1, 0, 0], abs=0.01)
    assert np.all(np.diff(places[:, 0]) >= -1e-9)
    headings = np.unwrap([np.arctan2(p[1, 0], p[0, 0]) for p in poses])
    assert headings[-1] == pytest.approx(2 * np.pi)
    for bad in ([(0, 0, 0, 0)], [(0, 0, 0, 0), (np.nan, 0, 0, 0)], [(0, 0, 0), (1, 0, 0)]):
        with pytest.raises(ValueError, match="two waypoints"):
            flight(bad, 5)


def bad_inputs(folder):
    picture = box_room.panorama(np.eye(4), 32)
    files = {"wide.png": picture.rgb[:, :50], "black.png": np.zeros((32, 64, 3), np.uint8), "good.png": picture.rgb}
    for name, rgb in files.items():
        write_rgb(folder / name, rgb)
    np.save(folder / "nan.npy", np.full((32, 64), np.nan))
    np.save(folder / "patchy.npy", np.where(np.arange(64) < 20, picture.depth_m, np.nan))
    np.save(folder / "square.npy", np.ones((32, 32)))
    np.save(folder / "fine.npy", picture.depth_m)


BAD = {
    "picture of another shape": (["wide.png", "--depth", "fine.npy"], "twice as wide"),
    "black picture": (["black.png", "--depth", "fine.npy"], "one colour"),
    "no picture": (["none.png"], "No such file"),
    "depth not finite": (["good.png", "--depth", "nan.npy"], "no known depth"),
    "depth hardly known": (["good.png", "--depth", "patchy.npy"], "known in 31%"),
    "depth of a cube's face": (["good.png", "--depth", "square.npy"], "depth must be"),
    "no depth file": (["good.png", "--depth", "none.npy"], "No such file"),
    "no model": (["good.png", "--model", "none.onnx"], "none"),
    "no gpu": (["good.png", "--depth", "fine.npy", "--device", "cuda"], "CUDA"),
}


@pytest.mark.parametrize("name", BAD)
def test_bad_inputs_are_named(name, tmp_path, capsys, monkeypatch):
    words, said = BAD[name]
    if name == "no gpu":
        torch = pytest.importorskip("torch")
        if torch.cuda.is_available():
            pytest.skip("this machine has a GPU")
    bad_inputs(tmp_path)
    monkeypatch.chdir(tmp_path)
    assert main(["vspace", "train", *words, "--iterations", "2", "-o", "out"]) == 1
    error = capsys.readouterr().err
    assert said in error
    assert words[0].split(".")[0] in error or words[-1].split(".")[0] in error or name == "no gpu"
    assert not (tmp_path / "out" / "space.npz").exists()


def test_a_patch_without_depth_is_filled_and_said(tmp_path, capsys):
    picture = box_room.panorama(np.eye(4), 32)
    picture.depth_m[:, :16] = np.nan
    write_rgb(tmp_path / "p.png", picture.rgb)
    np.savez(tmp_path / "d.npz", depth=picture.depth_m)
    words = [
        str(tmp_path / "p.png"),
        "--depth",
        str(tmp_path / "d.npz"),
        "--iterations",
        "2",
        "-o",
        str(tmp_path / "s"),
    ]
    assert main(["vspace", "train", *words]) == 0
    assert "known in 75%" in capsys.readouterr().out


@pytest.mark.parametrize(
    ("verb", "words", "status", "said"),
    [
        ("render", ["--pose", "1,2,3", "-o", "a.png"], 2, "x,y,z,yaw"),
        ("render", ["--pose", "1,2,3,nan", "-o", "a.png"], 2, "x,y,z,yaw"),
        ("render", ["--size", "4x4", "-o", "a.png"], 2, "16 to 4096"),
        ("render", ["--size", "100x40", "--projection", "equirect", "-o", "a.png"], 2, "twice as wide"),
        ("render", ["--size", "100x40", "--projection", "cube", "-o", "a.png"], 2, "square"),
        ("render", ["--fov", "180", "-o", "a.png"], 2, "1..170"),
        ("render", ["--size", "32x32", "-o", "a.bin"], 2, "must end in .png"),
        ("render", ["--size", "32x32", "-o", "none/a.png"], 1, "No such file"),
        ("render", ["--size", "32x32", "-o", "a.png", "--depth", "d.exr"], 2, "depth file must end in"),
        ("export", ["--mesh", "none/a.ply", "--width", "64"], 1, "No such file"),
        ("export", ["--mesh", "a.ply", "--width", "7"], 2, "16 to 4096"),
        ("video", ["-o", "a.avi"], 2, ".mp4"),
        ("video", ["-o", "none/a.mp4", "--size", "32x32"], 1, "cannot be written"),
        ("video", ["--path", "0,0,0,0", "-o", "a.mp4"], 2, "two waypoints"),
    ],
)
def test_what_cannot_be_done_is_said(folder, verb, words, status, said, capsys, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    try:
        result = run(folder, verb, *words)
    except SystemExit as end:  # argparse
        result = end.code
    assert result == status
    assert said in capsys.readouterr().err


def test_a_view_from_far_off_is_drawn_with_a_warning(folder, tmp_path, capsys):
    assert run(folder, "render", "--pose", "90,0,0,180", "--size", "64x32", "-o", tmp_path / "a.png") == 0
    said = capsys.readouterr()
    assert "has seen little" in said.err
    assert "0% of the image is known" in said.out


def test_a_folder_without_a_space(tmp_path, capsys):
    assert main(["vspace", "info", str(tmp_path)]) == 1
    assert "ic vspace train" in capsys.readouterr().err


def test_ply_without_faces_by_hand(tmp_path):
    write_ply(tmp_path / "a.ply", np.array([[1, 2, 3]], np.float32), np.array([[255, 0, 7]], np.uint8))
    head, body = (tmp_path / "a.ply").read_bytes().split(b"end_header\n")
    assert b"element vertex 1\n" in head
    assert body == np.array([1, 2, 3], "<f4").tobytes() + bytes([255, 0, 7])
