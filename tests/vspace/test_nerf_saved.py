"""A space saved and loaded again: the same bits, and a clear word for every file that is none."""

import math

import numpy as np
import pytest

from instant_ic.geometry.poses import pose_matrix
from instant_ic.vspace import (
    FieldConfig,
    SpaceFileError,
    TrainConfig,
    VirtualSpace,
    VirtualSpaceConfig,
)
from tests import box_room

CONFIG = VirtualSpaceConfig(
    device="cpu",
    field=FieldConfig(log2_table=10, levels=4),
    train=TrainConfig(ray_columns=32, ray_rows=16, iterations=40),
)
CAMERA = pose_matrix(x=0.4, y=0.1, z=0.05, yaw=-0.5)
ASIDE = pose_matrix(x=0.9, y=-0.4, yaw=0.8)


def keyframe(space, pose):
    picture = box_room.panorama(pose, 48)
    space.set_keyframe(picture.rgb, picture.depth_m, pose, 0.02)


@pytest.fixture(scope="module")
def space():
    space = VirtualSpace(CONFIG)
    keyframe(space, CAMERA)
    space.train(iterations=15)
    return space


def same(first, second):
    a, b = (s.render(ASIDE, 64, 36, 1.5) for s in (first, second))
    return all(np.array_equal(getattr(a, key), getattr(b, key)) for key in ("rgb", "depth_m", "confidence"))


@pytest.mark.parametrize("name", ["folder", "one.npz"])
def test_a_loaded_space_draws_the_same_bits(space, tmp_path, name):
    file = space.save(tmp_path / "deep" / name)
    assert file == tmp_path / "deep" / ("folder/space.npz" if name == "folder" else name)
    loaded = VirtualSpace.load(tmp_path / "deep" / name)
    assert same(space, loaded)
    assert loaded.config == CONFIG
    before, after = space.status, loaded.status
    assert after.psnr_db == before.psnr_db
    assert (after.iterations, after.train_seconds) == (before.iterations, before.train_seconds)
    assert after.state == before.state
    assert [p.name for p in file.parent.iterdir()] == [file.name]  # nothing half written is left


def test_a_loaded_space_trains_on(space, tmp_path):
    space.save(tmp_path)
    first, second = (VirtualSpace.load(tmp_path) for _ in range(2))
    first.train()
    stats = first.status
    assert (stats.iterations, stats.converged) == (40, True)
    assert stats.psnr_db > space.status.psnr_db
    second.train()
    assert same(first, second)


def test_a_young_space_and_another_device(tmp_path):
    space = VirtualSpace(CONFIG)
    keyframe(space, CAMERA)
    space.save(tmp_path)
    loaded = VirtualSpace.load(tmp_path, device="auto")
    assert loaded.config.device == "auto"
    assert math.isnan(loaded.status.psnr_db)
    ours, theirs = (s.render(CAMERA, 32, 18, 1.5).depth_m for s in (space, loaded))
    assert np.median(np.abs(ours / np.maximum(theirs, 1e-3) - 1)) < 0.01


def damaged(name, good, path):
    content = bytearray(good.read_bytes())
    if name == "cut":
        path.write_bytes(content[: len(content) // 2])
    elif name == "bit":
        content[len(content) // 2] ^= 1
        path.write_bytes(content)
    elif name == "foreign":
        np.savez(path, depth=np.ones((4, 8)))
    elif name != "missing":
        with np.load(good) as loaded:
            arrays = {key: loaded[key] for key in loaded.files}
        if name == "newer":
            arrays["format"] = np.asarray("instant_ic virtual space, version 7")
        elif name == "key":
            del arrays[".config.field.levels"]
        elif name == "value":
            arrays[".config.field.levels"] = np.asarray(99)
        elif name == "no keyframe":
            arrays = {key: value for key, value in arrays.items() if not key.startswith(".priors.")}
        np.savez(path, **arrays)


WRONG = {
    "no keyframe": "no keyframe",
    "missing": "no such file",
    "cut": "damaged",
    "bit": "damaged",
    "foreign": "not a saved virtual space",
    "newer": "version 7; this program reads instant_ic virtual space, version 6",
    "key": "levels",
    "value": "levels",
}


@pytest.mark.parametrize("name", WRONG)
def test_a_file_that_is_none_is_named_with_its_fault(space, tmp_path, name):
    good, path = space.save(tmp_path / "good.npz"), tmp_path / "bad.npz"
    damaged(name, good, path)
    with pytest.raises(SpaceFileError, match=WRONG[name]) as caught:
        VirtualSpace.load(path)
    assert str(path) in str(caught.value)
