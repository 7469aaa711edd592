"""``ic depth`` as a person calls it."""

import argparse
import json
from pathlib import Path

import cv2
import numpy as np
import pytest

from instant_ic.cli.commands import depth
from instant_ic.depth.manifest import load_manifest


def ic(*words: str) -> int:
    parser = argparse.ArgumentParser(prog="ic")
    depth.add_parser(parser.add_subparsers(required=True))
    args = parser.parse_args(["depth", *words])
    return int(args.func(args))


def test_train_export_estimate(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    cache, weights = str(tmp_path / "rooms"), str(tmp_path / "small.pt")
    words = ("train", "--cache", cache, "--worlds", "2", "--poses", "1", "--batch-size", "1", "--workers", "0",
             "--checkpoint", weights)  # fmt: skip
    assert ic(*words, "--epochs", "1", "--export", str(tmp_path / "first.onnx")) == 0
    assert (tmp_path / "rooms" / "complete").exists()
    record = json.loads((tmp_path / "first.json").read_text())
    assert record["steps"] == 1 and record["data"]["first_world"] == 100_000
    assert load_manifest(tmp_path / "first.yaml").input_height == 256

    assert ic(*words, "--epochs", "2", "--resume") == 0  # the cache is not rendered again
    assert "rendered" not in capsys.readouterr().out.split("step")[-1]
    assert ic("export", weights, "--output", str(tmp_path / "second.onnx"), "--half", "--max-range", "12") == 0
    assert load_manifest(tmp_path / "second.yaml").max_range_m == 12.0
    assert json.loads((tmp_path / "second.json").read_text())["steps"] == 2

    picture = np.random.default_rng(0).integers(0, 256, (512, 1024, 3), np.uint8)
    cv2.imwrite(str(tmp_path / "pano.png"), picture)
    out, npy = tmp_path / "depth.png", tmp_path / "depth.npy"
    model = str(tmp_path / "second.onnx")
    assert ic("estimate", str(tmp_path / "pano.png"), "--model", model, "--output", str(out), "--npy", str(npy)) == 0
    assert cv2.imread(str(out)).shape == (256, 512, 3)
    assert np.load(npy).shape == (256, 512) and np.load(npy).max() <= 12.0
    assert "on cpu" in capsys.readouterr().out


def test_faults_are_told_and_end_with_1(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert ic("estimate", str(tmp_path / "absent.jpg")) == 1
    assert "absent.jpg: not a readable picture" in capsys.readouterr().err
    cv2.imwrite(str(tmp_path / "pano.png"), np.zeros((64, 128, 3), np.uint8))
    assert ic("estimate", str(tmp_path / "pano.png"), "--model", str(tmp_path / "absent.onnx")) == 1
    assert "no manifest" in capsys.readouterr().err
    assert ic("export", str(tmp_path / "absent.pt"), "--output", str(tmp_path / "x.onnx")) == 1
    assert "absent.pt: no such file" in capsys.readouterr().err
