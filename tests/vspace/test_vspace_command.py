"""``ic vspace`` from panorama to view; bad inputs and their messages."""

import cv2
import numpy as np
import pytest

from instant_ic.cli.main import main
from instant_ic.geometry.poses import pose_matrix
from tests import box_room


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


def test_training_leaves_a_space(folder, capsys):
    assert [p.name for p in (folder / "space").iterdir()] == ["space.npz"]
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


def test_a_panorama(folder, tmp_path):
    assert run(folder, "render", "--projection", "equirect", "--size", "128x64", "-o", tmp_path / "e.png",
               "--depth", tmp_path / "d.png") == 0  # fmt: skip
    assert np.abs(read_rgb(tmp_path / "e.png").astype(float) - box_room.panorama(np.eye(4), 64).rgb).mean() < 15
    depth = cv2.imread(str(tmp_path / "d.png"), cv2.IMREAD_UNCHANGED)
    assert np.median(np.abs(depth / (1000 * box_room.panorama(np.eye(4), 64).depth_m) - 1)) < 0.03


def bad_inputs(folder):
    picture = box_room.panorama(np.eye(4), 32)
    files = {"wide.png": picture.rgb[:, :50], "good.png": picture.rgb}
    for name, rgb in files.items():
        write_rgb(folder / name, rgb)
    np.save(folder / "nan.npy", np.full((32, 64), np.nan))
    np.save(folder / "patchy.npy", np.where(np.arange(64) < 20, picture.depth_m, np.nan))
    np.save(folder / "fine.npy", picture.depth_m)


BAD = {
    "picture of another shape": (["wide.png", "--depth", "fine.npy"], "twice as wide"),
    "depth not finite": (["good.png", "--depth", "nan.npy"], "no known depth"),
    "depth hardly known": (["good.png", "--depth", "patchy.npy"], "known in 31%"),
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


@pytest.mark.parametrize(
    ("verb", "words", "status", "said"),
    [
        ("render", ["--pose", "1,2,3", "-o", "a.png"], 2, "x,y,z,yaw"),
        ("render", ["--size", "4x4", "-o", "a.png"], 2, "16 to 4096"),
        ("render", ["--size", "100x40", "--projection", "equirect", "-o", "a.png"], 2, "twice as wide"),
        ("render", ["--size", "32x32", "-o", "a.bin"], 2, "must end in .png"),
        ("render", ["--size", "32x32", "-o", "a.png", "--depth", "d.exr"], 2, "depth file must end in"),
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
