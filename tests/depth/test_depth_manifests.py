"""Models of others: the manifests of models/examples with ONNX files of exactly those inputs and outputs."""

import shutil
from pathlib import Path

import numpy as np
import onnx
import pytest
import tiny_onnx
import yaml
from onnx import helper
from tiny_onnx import CHANNELS, channel

from instant_ic.depth.manifest import ManifestError, load_manifest
from instant_ic.depth.model import DepthModel
from instant_ic.depth.providers import PROVIDERS
from instant_ic.util.paths import share_dir

EXAMPLES = sorted((share_dir("models") / "examples").glob("*.yaml"))


def squeeze(source: str, result: str, axis: int = 1) -> onnx.NodeProto:
    return helper.make_node("Squeeze", [source, f"axis{axis}"], [result])


def add_model(folder: Path, example: str) -> Path:
    """The example's manifest with a network beside it whose depth is the red channel as it comes in."""
    manifest = folder / f"{example}.yaml"
    shutil.copy(share_dir("models") / "examples" / f"{example}.yaml", manifest)
    path = folder / f"{example}.onnx"
    red = channel("image", 0, "depth4")
    match example:
        case "da2":  # (1, 3, 546, 1092) -> (1, 546, 1092)
            nodes = [*channel("images", 0, "four"), squeeze("four", "distance")]
            tiny_onnx.write(path, {"images": (1, 3, 546, 1092)}, {"distance": (1, 546, 1092)}, nodes, CHANNELS)
        case "panda":  # dynamic axes
            tiny_onnx.write(path, {"image": ("n", 3, "h", "w")}, {"depth4": ("n", 1, "h", "w")}, red, CHANNELS)
        case "hohonet":
            tiny_onnx.write(path, {"image": (1, 3, 512, 1024)}, {"depth4": (1, 1, 512, 1024)}, red, CHANNELS)
        case "slicenet_m3d":
            nodes = [*red, squeeze("depth4", "depth")]
            tiny_onnx.write(path, {"image": (1, 3, 512, 1024)}, {"depth": (1, 512, 1024)}, nodes, CHANNELS)
    return path


RED = (0.8 - 0.485) / 0.229  # byte 204 as ImageNet's normalisation leaves it


@pytest.mark.parametrize(
    ("example", "size", "expected"),
    [
        ("da2", (546, 1092), 0.8),
        ("panda", (504, 1008), RED),
        ("hohonet", (512, 1024), 0.8),
        ("slicenet_m3d", (512, 1024), 0.8),
    ],
)
def test_examples_work_unchanged(tmp_path: Path, example: str, size: tuple[int, int], expected: float) -> None:
    model = DepthModel.load(add_model(tmp_path, example), threads=1)
    picture = np.zeros((480, 960, 3), np.uint8)
    picture[..., 0] = 204
    depth = model.estimate(picture)
    assert depth.shape == size and depth.dtype == np.float32
    np.testing.assert_allclose(depth, expected, rtol=1e-5)


def test_every_example_is_held_by_a_test() -> None:
    held = {"da2", "panda", "hohonet", "slicenet_m3d"}
    assert {path.stem for path in EXAMPLES} == held
    for path in EXAMPLES:
        load_manifest(path)


def manifest_of(path: Path, **changes: object) -> Path:
    values = {"model": path.name, "name": "m", "licence": "x", "input_height": 64, "input_width": 128, **changes}
    path.with_suffix(".yaml").write_text(yaml.safe_dump(values))
    return path


def test_models_that_cannot_be_used_say_why(tmp_path: Path) -> None:
    path = tmp_path / "m.onnx"
    add = [helper.make_node("Add", ["image", "rays"], ["sum"])]
    both = {"image": (1, 3, 64, 128), "rays": (1, 3, 64, 128)}
    tiny_onnx.write(path, both, {"sum": (1, 3, 64, 128)}, add)
    with pytest.raises(ManifestError, match=r"takes 2 inputs \(image, rays\)"):
        DepthModel.load(manifest_of(path))
    mean = [helper.make_node("ReduceMean", ["image"], ["depth"], axes=[1, 2, 3], keepdims=0)]
    tiny_onnx.write(path, {"image": ("n", 3, "h", "w")}, {"depth": ("n",)}, mean)  # open: only the first run can tell
    model = DepthModel.load(manifest_of(path))
    with pytest.raises(ManifestError, match=r"output 'depth' is \[1\]; a panorama of"):
        model.estimate(np.zeros((64, 128, 3), np.uint8))
    shape = [helper.make_node("Shape", ["image"], ["depth"])]
    tiny_onnx.write(path, {"image": (1, 3, 64, 128)}, {"depth": (4,)}, shape, output_kind=onnx.TensorProto.INT64)
    with pytest.raises(ManifestError, match=r"output 'depth' is \[4\]"):
        DepthModel.load(manifest_of(path))


@pytest.mark.parametrize(
    ("available", "asked", "listed"),
    [
        (["tensorrt", "cuda"], "auto", ["tensorrt", "cuda", "cpu"]),
        (["tensorrt", "cuda"], "cuda", ["cuda", "cpu"]),
    ],
)
def test_onnxruntime_gets_the_providers_from_the_asked_one_on(tmp_path, monkeypatch, available, asked, listed) -> None:
    import onnxruntime

    got = []

    class Session(onnxruntime.InferenceSession):
        def __init__(self, path: str, options: object, providers: list) -> None:
            got.extend(each[0] if isinstance(each, tuple) else each for each in providers)
            super().__init__(path, options, providers=["CPUExecutionProvider"])

    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))
    full = [PROVIDERS[name] for name in available]
    monkeypatch.setattr(onnxruntime, "get_available_providers", lambda: [*full, "CPUExecutionProvider"])
    monkeypatch.setattr(onnxruntime, "InferenceSession", Session)
    monkeypatch.setattr(onnxruntime, "preload_dlls", lambda: None, raising=False)
    path = tmp_path / "m.onnx"
    tiny_onnx.write(path, {"image": (1, 3, 64, 128)}, {"d": (1, 1, 64, 128)}, channel("image", 0, "d"), CHANNELS)
    assert DepthModel.load(manifest_of(path), provider=asked).provider == "cpu"
    assert got == [PROVIDERS[name] for name in listed]
