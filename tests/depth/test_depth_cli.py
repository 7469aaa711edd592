"""``ic depth`` as a person calls it."""

import argparse
from pathlib import Path

import cv2
import numpy as np
import pytest
import tiny_onnx

from instant_ic.cli.commands import depth
from instant_ic.cli.errors import UserError
from instant_ic.depth.manifest import ModelManifest, save_manifest


def ic(*words: str) -> int:
    parser = argparse.ArgumentParser(prog="ic")
    depth.add_parser(parser.add_subparsers(required=True))
    args = parser.parse_args(["depth", *words])
    return int(args.func(args))


@pytest.fixture
def tiny(tmp_path: Path) -> Path:
    """A metric model whose depth is ten times the red channel."""
    path = tmp_path / "tiny.onnx"
    nodes = tiny_onnx.channel("image", 0, "depth")
    tiny_onnx.write(path, {"image": (1, 3, 64, 128)}, {"depth": (1, 1, 64, 128)}, nodes, tiny_onnx.CHANNELS)
    save_manifest(ModelManifest("tiny.onnx", "tiny", "MIT", 64, 128), path.with_suffix(".yaml"))
    return path


def test_estimate(tiny: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    picture = np.zeros((128, 256, 3), np.uint8)
    picture[..., 2] = 102  # red, as OpenCV orders it: 0.4 m
    cv2.imwrite(str(tmp_path / "pano.png"), picture)
    out, npy = tmp_path / "depth.png", tmp_path / "depth.npy"
    words = ("estimate", str(tmp_path / "pano.png"), "--model", str(tiny), "-o", str(out), "--npy", str(npy))
    assert ic(*words, "--provider", "cpu") == 0
    assert cv2.imread(str(out)).shape == (64, 128, 3)
    np.testing.assert_allclose(np.load(npy), 0.4, rtol=1e-5)
    assert "tiny on cpu" in capsys.readouterr().out
    assert ic(*words, "--provider", "cuda") == 0
    assert "runs on cpu: cuda does not work here" in capsys.readouterr().err


@pytest.mark.parametrize(
    ("words", "message"),
    [
        (("estimate", "absent.jpg"), "absent.jpg: not a readable image"),
        (("estimate", "{pano}", "--model", "absent.onnx"), "absent.yaml: no manifest"),
        (("estimate", "{pano}", "--model", "{tiny}", "-o", "/proc/nowhere/x.png"), "/proc/nowhere"),
        (("estimate", "{square}", "--model", "{tiny}"), "square.png: a panorama is twice as wide as high"),
    ],
)
def test_faults_are_told(tiny: Path, tmp_path: Path, words: tuple[str, ...], message: str) -> None:
    pano = tmp_path / "pano.png"
    cv2.imwrite(str(pano), np.zeros((64, 128, 3), np.uint8))
    square = tmp_path / "square.png"
    cv2.imwrite(str(square), np.zeros((64, 64, 3), np.uint8))
    with pytest.raises((UserError, ValueError, OSError), match=message):
        ic(*(word.format(pano=pano, tiny=tiny, square=square) for word in words))
