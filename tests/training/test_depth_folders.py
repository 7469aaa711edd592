"""Folders laid out as Matterport3D, Stanford 2D-3D-S, Structured3D and others publish them."""

from pathlib import Path

import cv2
import numpy as np
import OpenEXR
import pytest

from instant_ic.training.dataset import DatasetError
from instant_ic.training.folders import LAYOUTS, open_folder

SIZE = (8, 16)


def picture(path: Path, value: int, shape: tuple[int, ...] = (16, 32, 3)) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    assert cv2.imwrite(str(path), np.full(shape, value, np.uint8))


def png(path: Path, metres: float, unit: float, missing: int) -> None:
    """Depth at a higher resolution than the picture, its upper half without a reading."""
    values = np.full((32, 64), round(metres * unit), np.uint16)
    values[:16] = missing
    path.parent.mkdir(parents=True, exist_ok=True)
    assert cv2.imwrite(str(path), values)


def exr(path: Path, metres: float) -> None:
    values = np.full((16, 32), metres, np.float32)
    values[:8] = np.inf
    header = {"compression": OpenEXR.ZIP_COMPRESSION, "type": OpenEXR.scanlineimage}
    with OpenEXR.File(header, {"Y": values}) as file:
        file.write(str(path))


def matterport(root: Path) -> None:
    for scan, metres in (("17DRP5sb8fy", 2.5), ("zsNo4HB9uLZ", 4.0)):
        picture(root / scan / "pano_skybox_color" / "00ebbf3782c64d74aaf7dd39cd561175.jpg", 100)
        picture(root / scan / "pano_color" / "00ebbf3782c64d74aaf7dd39cd561175.jpg", 10)  # worse seams: not taken
        png(root / scan / "pano_depth" / "00ebbf3782c64d74aaf7dd39cd561175.png", metres, 4000, 0)


def stanford(root: Path) -> None:
    for area, metres in (("area_1", 2.5), ("area_5a", 4.0)):
        name = "camera_0a3f_office_1_frame_equirectangular_domain"
        picture(root / area / "pano" / "rgb" / f"{name}_rgb.png", 100, (16, 32, 4))
        png(root / area / "pano" / "depth" / f"{name}_depth.png", metres, 512, 65535)


def structured(root: Path) -> None:
    for scene, metres in (("scene_00000", 2.5), ("scene_03010", 4.0), ("scene_03300", 6.0)):
        room = root / scene / "2D_rendering" / "485142" / "panorama" / "full"
        picture(room / "rgb_rawlight.png", 100)
        png(room / "depth.png", metres, 1000, 0)


def plain(root: Path) -> None:
    picture(root / "rgb" / "house" / "a.jpg", 100)
    png(root / "depth" / "house" / "a.png", 2.5, 1000, 0)
    picture(root / "rgb" / "mill" / "b.png", 100)
    (root / "depth" / "mill").mkdir(parents=True)
    depth = np.full((16, 32), 4.0, np.float32)
    depth[:8] = np.nan
    np.savez(root / "depth" / "mill" / "b.npz", depth=depth)


MAKERS = {"m3d": matterport, "s2d3d": stanford, "s3d": structured, "plain": plain}


@pytest.mark.parametrize("kind", LAYOUTS)
def test_each_layout_gives_metres_and_its_own_split(kind: str, tmp_path: Path) -> None:
    MAKERS[kind](tmp_path)
    data = open_folder(f"{kind}:{tmp_path}", SIZE)
    assert len(data) == 2  # Structured3D's third scene is of its test part
    for sample, metres in ((data[0], 2.5), (data[1], 4.0)):
        assert sample.rgb.shape == (8, 16, 3) and abs(int(sample.rgb.mean()) - 100) <= 1
        np.testing.assert_array_equal(sample.depth_m[:4], 0.0)
        np.testing.assert_allclose(sample.depth_m[4:], metres, rtol=1e-3)
    training, held_out = data.split()
    assert training.tolist() == [0] and held_out.tolist() == [1]
    assert data.info == {"kind": kind, "folder": tmp_path.name, "count": 2, "scenes": 2}


def test_rendered_matterport_as_exr(tmp_path: Path) -> None:
    for scan, metres in (("b24264da8ac8", 2.5), ("7b285021f311", 4.0)):
        for number in (6, 77):
            picture(tmp_path / "Matterport3D" / f"{number}_{scan}_color_0_Left_Down_0.0.png", 100)
            exr(tmp_path / "Matterport3D" / f"{number}_{scan}_depth_0_Left_Down_0.0.exr", metres)
    data = open_folder(f"m3d:{tmp_path}", SIZE)
    assert {pair.scene for pair in data.pairs} == {"b24264da8ac8", "7b285021f311"} and len(data) == 4
    for index in range(4):
        metres = 2.5 if "b24264da8ac8" in data.pairs[index].rgb.name else 4.0
        np.testing.assert_array_equal(data[index].depth_m[:4], 0.0)
        np.testing.assert_array_equal(data[index].depth_m[4:], np.float32(metres))


def test_wrong_names_and_folders_are_told(tmp_path: Path) -> None:
    stanford(tmp_path / "s")
    for name, words in (
        ("kitti:x", "LAYOUT one of rendered, m3d, s2d3d, s3d, plain"),
        ("m3d", "LAYOUT:FOLDER"),
        (f"m3d:{tmp_path / 'absent'}", "no such folder"),
        (f"m3d:{tmp_path / 's'}", "SCAN/pano_skybox_color.*it looks like s2d3d"),
        (f"s3d:{tmp_path}", "no panorama with depth in layout s3d"),
    ):
        with pytest.raises(DatasetError, match=words):
            open_folder(name, SIZE)


def test_pictures_without_depth_are_told_and_left_out(tmp_path: Path) -> None:
    plain(tmp_path)
    picture(tmp_path / "rgb" / "mill" / "c.jpg", 1)
    with pytest.warns(UserWarning, match=r"1 images have no depth and are skipped; the first is .*c\.jpg"):
        data = open_folder(f"plain:{tmp_path}", SIZE)
    assert len(data) == 2
    for path in (tmp_path / "depth").rglob("*.*"):
        path.unlink()
    with pytest.raises(DatasetError, match=r"3 images, the first without depth/house/a\.png"):
        open_folder(f"plain:{tmp_path}", SIZE)


def test_damaged_files_are_told_and_passed_over_until_there_are_many(tmp_path: Path) -> None:
    for index in range(120):
        picture(tmp_path / "rgb" / f"{index:03}.png", index, (4, 8, 3))
        np.save((tmp_path / "depth").mkdir(exist_ok=True) or tmp_path / "depth" / f"{index:03}.npy", np.ones((4, 8)))
    data = open_folder(f"plain:{tmp_path}", SIZE)
    (tmp_path / "rgb" / "007.png").write_bytes(b"not a picture")
    with pytest.warns(UserWarning, match=r"skipped: .*007\.png"):
        assert data[7].rgb.max() == 8
    assert data[7].rgb.max() == 8 and list(data.unreadable) == [7]
    picture(tmp_path / "rgb" / "008.png", 8, (4, 6, 3))
    with pytest.raises(DatasetError, match=r"008\.png: 6 x 4 is not an equirect panorama.*2 of 120"):
        data[8]


def test_depth_of_eight_bits_is_no_depth(tmp_path: Path) -> None:
    stanford(tmp_path)
    depth = next(tmp_path.rglob("area_1/**/*_depth.png"))
    picture(depth, 9)
    with pytest.raises(DatasetError, match=r"one channel of 16 bits \(got"):
        open_folder(f"s2d3d:{tmp_path}", SIZE)[0]


def test_a_folder_of_nothing_but_test_scenes_is_refused(tmp_path: Path) -> None:
    stanford(tmp_path)
    for path in tmp_path.rglob("area_1/**/*.png"):
        path.unlink()
    with pytest.raises(DatasetError, match="add scenes for training"):
        open_folder(f"s2d3d:{tmp_path}", SIZE).split()
