"""Depth and pictures from files: each format, each way a file can be wrong."""

import cv2
import numpy as np
import pytest

from instant_ic.depth.files import DepthFileError, load_depth, load_rgb

DEPTH = np.linspace(0.5, 9.5, 8 * 16, dtype=np.float32).reshape(8, 16)
DEPTH[2, 3] = 0


def written(tmp_path, kind):
    path = tmp_path / f"depth.{kind.split('-')[0]}"
    if kind == "png":
        cv2.imwrite(str(path), np.rint(DEPTH * 1000).astype(np.uint16))
    elif kind == "npy":
        np.save(path, DEPTH.astype(np.float64)[..., None])  # a trailing axis of one is dropped
    else:
        np.savez_compressed(path, depth=DEPTH, other=np.zeros(3))
    return path


@pytest.mark.parametrize(("kind", "error_m"), [("png", 0.00051), ("npy", 0), ("npz", 0)])
def test_depth_is_read_in_metres(tmp_path, kind, error_m):
    depth = load_depth(written(tmp_path, kind))
    assert depth.dtype == np.float32
    assert depth.shape == (8, 16)
    assert depth[2, 3] == 0
    assert np.abs(depth - DEPTH).max() <= error_m


def test_what_is_no_distance_is_unknown(tmp_path):
    depth = DEPTH.copy()
    depth[0, :5] = [np.nan, np.inf, -np.inf, -1, 1e10]
    np.save(tmp_path / "depth.npy", depth)
    loaded = load_depth(tmp_path / "depth.npy")
    assert not loaded[0, :5].any()
    assert np.array_equal(loaded[1:], DEPTH[1:])


def _bad(tmp_path, name):
    path = tmp_path / name
    if name == "colour.png":
        cv2.imwrite(str(path), np.zeros((8, 16, 3), np.uint16))
    elif name == "nan.npy":
        np.save(path, np.full((8, 16), np.nan))
    elif name == "objects.npy":
        np.save(path, np.array([{}], object), allow_pickle=True)
    elif name == "key.npz":
        np.savez(path, range=DEPTH)
    elif name != "missing.npy":
        path.write_bytes(b"this is no depth")
    return path


BAD = {
    "missing.npy": "No such file",
    "depth.pfm": "depth files must be",
    "colour.png": "got 3 of 16",
    "junk.npy": "not a readable numpy",
    "nan.npy": "no known depth",
    "objects.npy": "not a readable numpy",
    "key.npz": "has: range",
}


@pytest.mark.parametrize("name", BAD)
def test_a_bad_file_is_named_with_its_fault(tmp_path, name):
    path = _bad(tmp_path, name)
    with pytest.raises(DepthFileError, match=BAD[name]) as caught:
        load_depth(path)
    assert str(path) in str(caught.value)


def test_pictures_come_as_rgb_or_with_the_fault(tmp_path):
    picture = np.zeros((4, 8, 3), np.uint8)
    picture[..., 0] = 200  # red
    cv2.imwrite(str(tmp_path / "red.png"), picture[..., ::-1])
    assert np.array_equal(load_rgb(tmp_path / "red.png"), picture)
    (tmp_path / "junk.jpg").write_bytes(b"\xff\xd8 no")
    for name, words in (("junk.jpg", "not a readable image"), ("none.jpg", "No such file")):
        with pytest.raises(DepthFileError, match=words):
            load_rgb(tmp_path / name)
