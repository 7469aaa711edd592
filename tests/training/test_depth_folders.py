"""Folders of panoramas with depth for a training."""

from pathlib import Path

import cv2
import numpy as np
import pytest

from instant_ic.training.dataset import DatasetError
from instant_ic.training.folders import open_folder

SIZE = (8, 16)


def image(path: Path, value: int, shape: tuple[int, ...] = (16, 32, 3)) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    assert cv2.imwrite(str(path), np.full(shape, value, np.uint8))


def plain(root: Path) -> None:
    """Write two scenes: depth as PNG of a higher resolution and as NPZ, the upper halves without a reading."""
    image(root / "rgb" / "house" / "a.jpg", 100)
    millimetres = np.full((32, 64), 2500, np.uint16)
    millimetres[:16] = 0
    (root / "depth" / "house").mkdir(parents=True)
    assert cv2.imwrite(str(root / "depth" / "house" / "a.png"), millimetres)
    image(root / "rgb" / "mill" / "b.png", 100)
    metres = np.full((16, 32), 4.0, np.float32)
    metres[:8] = np.nan
    (root / "depth" / "mill").mkdir()
    np.savez(root / "depth" / "mill" / "b.npz", depth=metres)


def test_plain_folder_gives_metres_and_holds_the_last_scene_out(tmp_path: Path) -> None:
    plain(tmp_path)
    data = open_folder(f"plain:{tmp_path}", SIZE)
    assert len(data) == 2
    for sample, metres in ((data[0], 2.5), (data[1], 4.0)):
        assert sample.rgb.shape == (8, 16, 3) and abs(int(sample.rgb.mean()) - 100) <= 1
        np.testing.assert_array_equal(sample.depth_m[:4], 0.0)
        np.testing.assert_allclose(sample.depth_m[4:], metres, rtol=1e-3)
    training, held_out = data.split()
    assert training.tolist() == [0] and held_out.tolist() == [1]
    assert data.info == {"kind": "plain", "folder": tmp_path.name, "count": 2, "scenes": 2}


def test_wrong_names_and_folders_are_reported(tmp_path: Path) -> None:
    for name, words in (
        ("kitti:x", "LAYOUT rendered or plain"),
        ("plain", "LAYOUT:FOLDER"),
        (f"plain:{tmp_path / 'absent'}", "no such folder"),
        (f"plain:{tmp_path}", "no panorama with depth: expected rgb/"),
    ):
        with pytest.raises(DatasetError, match=words):
            open_folder(name, SIZE)


def test_images_without_depth_are_reported_and_skipped(tmp_path: Path) -> None:
    plain(tmp_path)
    image(tmp_path / "rgb" / "mill" / "c.jpg", 1)
    with pytest.warns(UserWarning, match=r"1 images have no depth; the first is .*c\.jpg"):
        data = open_folder(f"plain:{tmp_path}", SIZE)
    assert len(data) == 2


def test_damaged_files_are_skipped_until_there_are_many(tmp_path: Path) -> None:
    (tmp_path / "depth").mkdir()
    for index in range(120):
        image(tmp_path / "rgb" / f"{index:03}.png", index, (4, 8, 3))
        np.save(tmp_path / "depth" / f"{index:03}.npy", np.ones((4, 8)))
    data = open_folder(f"plain:{tmp_path}", SIZE)
    (tmp_path / "rgb" / "007.png").write_bytes(b"not an image")
    with pytest.warns(UserWarning, match=r"skipped: .*007\.png"):
        assert data[7].rgb.max() == 8
    assert data[7].rgb.max() == 8 and list(data.unreadable) == [7]
    image(tmp_path / "rgb" / "008.png", 8, (4, 6, 3))
    with pytest.raises(DatasetError, match=r"008\.png: 6 x 4 is not an equirect panorama.*2 of 120"):
        data[8]


def test_a_single_scene_cannot_be_split(tmp_path: Path) -> None:
    plain(tmp_path)
    (tmp_path / "rgb" / "mill" / "b.png").unlink()
    with pytest.raises(DatasetError, match="add scenes for training"):
        open_folder(f"plain:{tmp_path}", SIZE).split()
