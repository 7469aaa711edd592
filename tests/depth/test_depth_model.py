"""Manifest and ONNX inference; the shipped model."""

import hashlib
import json
import tempfile
from dataclasses import fields, replace
from pathlib import Path

import cv2
import numpy as np
import pytest
import tiny_onnx
import yaml
from hypothesis import given, settings
from hypothesis import strategies as st

from instant_ic.depth.colour import coloured_depth
from instant_ic.depth.manifest import (
    ManifestError,
    ModelManifest,
    load_manifest,
    manifest_path,
    save_manifest,
)
from instant_ic.depth.model import DEFAULT_MODEL, DepthModel
from instant_ic.util.paths import shipped_file


@pytest.fixture(scope="module")
def plain(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A network whose depth is the red channel as it comes in."""
    path = tmp_path_factory.mktemp("model") / "tiny.onnx"
    nodes = tiny_onnx.channel("image", 0, "depth")
    tiny_onnx.write(path, {"image": (1, 3, 64, 128)}, {"depth": (1, 1, 64, 128)}, nodes, tiny_onnx.CHANNELS)
    save_manifest(ModelManifest("tiny.onnx", "tiny", "Apache-2.0", 64, 128), manifest_path(path))
    return path


def panorama(height: int, seed: int = 0) -> np.ndarray:
    return np.random.default_rng(seed).integers(1, 256, (height, 2 * height, 3), np.uint8)


def test_same_picture_same_bits() -> None:
    picture, path = panorama(64), shipped_file("models", DEFAULT_MODEL)
    first, second = DepthModel.load(path, threads=2), DepthModel.load(path, threads=2)
    results = [m.estimate(picture).tobytes() for m in (first, first, second)]
    assert results[0] == results[1] == results[2]


def test_large_pictures_are_averaged(plain: Path) -> None:
    small = panorama(64)
    large = small.repeat(4, axis=0).repeat(4, axis=1)
    model = DepthModel.load(plain)
    np.testing.assert_array_equal(model.prepare(large), model.prepare(small))
    checkered = np.zeros((128, 256, 3), np.uint8)
    checkered[::2, ::2] = checkered[1::2, 1::2] = 200  # every 2 x 2 block averages to 100
    np.testing.assert_allclose(model.prepare(checkered), 100 / 255, rtol=1e-6)


def load_with(plain: Path, tmp_path: Path, **changes: object) -> DepthModel:
    manifest = replace(load_manifest(manifest_path(plain)), **changes)
    (tmp_path / "tiny.onnx").write_bytes(plain.read_bytes())
    save_manifest(manifest, tmp_path / "tiny.yaml")
    return DepthModel.load(tmp_path / "tiny.onnx")


def test_normalisation(plain: Path, tmp_path: Path) -> None:
    model = load_with(plain, tmp_path, mean=(0.5, 0.0, 0.0), std=(1.0, 2.0, 4.0))
    picture = np.zeros((64, 128, 3), np.uint8)
    picture[..., 0] = 255
    prepared = model.prepare(picture)[0, :, 0, 0]
    np.testing.assert_allclose(prepared, [0.5, 0.0, 0.0])
    picture[..., 2] = 255
    np.testing.assert_allclose(model.prepare(picture)[0, :, 0, 0], [0.5, 0.0, 0.25])


def test_exposure_is_brought_to_the_trainings(plain: Path, tmp_path: Path) -> None:
    model = load_with(plain, tmp_path, brightness=120.0, mean=(0.0, 0.0, 0.0), std=(1.0, 1.0, 1.0))
    picture = np.full((64, 128, 3), 40, np.uint8)
    picture[32:] = 80  # mean 60: everything is doubled
    prepared = model.prepare(picture)[0, 0, :, 0] * 255
    np.testing.assert_allclose(prepared[[0, -1]], [80, 160], atol=0.5)
    np.testing.assert_allclose(model.prepare(np.full_like(picture, 10)) * 255, 25, atol=0.5)  # 2.5 times at most
    np.testing.assert_allclose(model.prepare(np.full_like(picture, 240)) * 255, 120, atol=0.5)


def write_manifest(folder: Path, **changes: object) -> Path:
    values = {"model": "m.onnx", "name": "m", "licence": "x", "input_height": 64, "input_width": 128, **changes}
    path = folder / "m.yaml"
    path.write_text(yaml.safe_dump({k: v for k, v in values.items() if v is not None}))
    return path


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"colour": "rgb"}, "unknown parameter"),
        ({"input_height": None}, "missing key input_height"),
        ({"input_width": 64}, "input_width must be twice input_height"),
        ({"max_range_m": 0.05}, "max_range_m must be above min_range_m"),
        ({"prior_input": "prior"}, "prior_input must be given together with sigma_output"),
        ({"sha256": "abc"}, "sha256 must be 64 digits"),
    ],
)
def test_bad_manifest_says_what_is_wrong(tmp_path: Path, changes: dict[str, object], message: str) -> None:
    path = write_manifest(tmp_path, **changes)
    with pytest.raises(ManifestError, match=message) as caught:
        load_manifest(path)
    assert str(path) in str(caught.value)


def test_the_line_of_a_fault(tmp_path: Path) -> None:
    path = tmp_path / "m.yaml"
    head = "model: m.onnx\nname: m\nlicence: x\ninput_height: 64\ninput_width: 128\n"
    for line, words in (("min_range_m: far", "min_range_m"), ("colour: rgb", "unknown")):
        path.write_text(head + line)
        with pytest.raises(ManifestError, match=rf"m\.yaml:6: .*{words}"):
            load_manifest(path)


@settings(max_examples=25, deadline=None)
@given(st.text(max_size=60) | st.dictionaries(st.sampled_from([f.name for f in fields(ModelManifest)]), st.one_of(
    st.none(), st.booleans(), st.integers(), st.floats(), st.text(max_size=5), st.lists(st.integers(), max_size=3)
)).map(yaml.safe_dump))  # fmt: skip
def test_any_text_is_a_manifest_or_a_manifest_error(text: str) -> None:
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "m.yaml"
        path.write_text(text, encoding="utf-8", newline="")
        try:
            load_manifest(path)
        except ManifestError as error:
            assert str(path) in str(error)


def test_missing_and_unreadable_manifests(tmp_path: Path) -> None:
    with pytest.raises(ManifestError, match="no manifest"):
        DepthModel.load(tmp_path / "absent.onnx")
    (tmp_path / "m.yaml").write_text("a: [")
    with pytest.raises(ManifestError, match="not YAML"):
        load_manifest(tmp_path / "m.yaml")
    (tmp_path / "m.yaml").write_text("- a")
    with pytest.raises(ManifestError, match="keys and values"):
        load_manifest(tmp_path / "m.yaml")


def test_model_that_does_not_fit_its_manifest(plain: Path, tmp_path: Path) -> None:
    with pytest.raises(ManifestError, match="the manifest says"):
        load_with(plain, tmp_path, input_height=128, input_width=256)
    with pytest.raises(ManifestError, match="SHA-256"):
        load_with(plain, tmp_path, sha256="0" * 64)
    path = write_manifest(tmp_path)
    with pytest.raises(ManifestError, match="does not exist"):
        DepthModel.load(path)
    (tmp_path / "m.onnx").write_bytes(b"not a model")
    with pytest.raises(ManifestError, match="onnxruntime cannot load"):
        DepthModel.load(path)


def test_coloured_depth_marks_unknown_black() -> None:
    depth = np.array([[1.0, 2.0, 4.0, 0.0]], np.float32)
    coloured = coloured_depth(depth, near=1.0, far=4.0)
    assert coloured[0, 3].tolist() == [0, 0, 0]
    expected = cv2.applyColorMap(np.array([[255, 127, 0]], np.uint8), cv2.COLORMAP_TURBO)[..., ::-1]
    np.testing.assert_array_equal(coloured[0, :3], expected[0])
    assert not coloured_depth(np.zeros((2, 2))).any()


def test_shipped_model_is_what_its_manifest_and_record_say() -> None:
    path = shipped_file("models", DEFAULT_MODEL)
    manifest = load_manifest(manifest_path(path))
    assert path.stat().st_size < 20e6
    assert manifest.sha256 == hashlib.sha256(path.read_bytes()).hexdigest()
    record = json.loads(path.with_suffix(".json").read_text())
    assert record["network"]["height"] == manifest.input_height
    assert record["export"]["difference"] < 1e-5


def test_shipped_model_knows_a_generated_room() -> None:
    """Quality on a world that it was not trained on; a constant guess has a relative error of about 0.5."""
    from instant_ic.depth.metrics import depth_metrics
    from instant_ic.geometry.poses import pose_matrix
    from instant_ic.sim.render import EquirectRenderer
    from instant_ic.sim.worlds import random_world

    path = shipped_file("models", DEFAULT_MODEL)
    manifest = load_manifest(manifest_path(path))
    world = random_world(5)
    x, y, yaw = world.spawn
    frame = EquirectRenderer(world).render(pose_matrix(x, y, 1.2, yaw=yaw), manifest.input_width, manifest.input_height)
    got = depth_metrics(DepthModel.load(path, threads=1).estimate(frame.rgb), frame.depth_m)
    assert got.mre < 0.2
    assert got.delta1 > 0.7
