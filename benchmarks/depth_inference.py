"""Time per panorama: decoding, preparation, network; for the shipped model and other SliceNets.

    python benchmarks/depth_inference.py --json inference.json                       # the shipped model
    python benchmarks/depth_inference.py --networks resnet18:256 resnet50:512        # random weights: time only
    python benchmarks/depth_inference.py --networks small --unfolded                 # as exported by torch itself

CPU seconds are reported beside wall seconds, because they show the network's cost on a machine with other load.
"""

from __future__ import annotations

import argparse
import json
import tempfile
import time
import warnings
from collections.abc import Callable
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import torch

from instant_ic.depth.manifest import ModelManifest, load_manifest, manifest_path, save_manifest
from instant_ic.depth.model import DEFAULT_MODEL, DepthModel
from instant_ic.limits import decode_rgb
from instant_ic.paths import shipped_file
from instant_ic.training.export import OPSET, export_onnx
from instant_ic.training.slicenet import SMALL, SliceNet, SliceNetConfig


def seconds(function: Callable[[], Any], runs: int) -> dict[str, float]:
    """Median wall and CPU seconds, and the fastest run, after one warm-up run."""
    function()
    wall, cpu = [], []
    for _ in range(runs):
        before, before_cpu = time.perf_counter(), time.process_time()
        function()
        wall.append(time.perf_counter() - before)
        cpu.append(time.process_time() - before_cpu)
    return {"median": float(np.median(wall)), "fastest": min(wall), "cpu": float(np.median(cpu))}


def camera_jpeg(height: int) -> bytes:
    """A panorama with as much detail as a photo."""
    coarse = np.random.default_rng(0).integers(0, 256, (height // 8, height // 4, 3), np.uint8)
    return cv2.imencode(".jpg", cv2.resize(coarse, (2 * height, height)), [cv2.IMWRITE_JPEG_QUALITY, 90])[1].tobytes()


def measure(model: DepthModel, data: bytes, runs: int) -> dict[str, Any]:
    """Time of each step of the node, and of all steps."""
    size = (2 * model.manifest.input_width, 2 * model.manifest.input_height)
    rgb = decode_rgb(data, *size)
    return {
        "decode": seconds(lambda: decode_rgb(data, *size), runs),
        "prepare": seconds(lambda: model.prepare(rgb), runs),
        "estimate": seconds(lambda: model.estimate(rgb), runs),
        "panorama": seconds(lambda: model.estimate(decode_rgb(data, *size)), runs),
        "provider": model.provider,
    }


def random_model(network: str, folder: Path, unfolded: bool) -> Path:
    """A SliceNet with random weights: ``small`` or ``BACKBONE:HEIGHT``."""
    torch.manual_seed(0)
    backbone, _, height = network.partition(":")
    lstm = 512 if backbone == "resnet50" else 256
    config = SMALL if network == "small" else SliceNetConfig(backbone, height=int(height), lstm_hidden=lstm)
    model = SliceNet(config).eval()
    path = folder / f"{network.replace(':', '_')}.onnx"
    if unfolded:
        picture = torch.rand(1, 3, config.height, config.width)
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            torch.onnx.export(model, (picture,), str(path), dynamo=False, opset_version=OPSET, input_names=["image"])
    else:
        export_onnx(model, path)
    save_manifest(ModelManifest(path.name, network, "none", config.height, config.width), manifest_path(path))
    return path


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--model", type=Path, help="ONNX file (default: the shipped one)")
    parser.add_argument("--networks", nargs="+", metavar="NAME", help="small, resnet18:256, resnet50:512, ...")
    parser.add_argument("--unfolded", action="store_true", help="the networks without the folded decoder")
    parser.add_argument("--threads", type=int, nargs="+", default=[1, 2], metavar="N", help="(1 2)")
    parser.add_argument("--provider", default="auto", help="auto, tensorrt, cuda, cpu")
    parser.add_argument("--height", type=int, default=960, help="of the camera's picture (%(default)s)")
    parser.add_argument("--runs", type=int, default=15, help="timed (%(default)s)")
    parser.add_argument("--json", type=Path, help="write the figures here as well")
    args = parser.parse_args()
    data = camera_jpeg(args.height)
    found: list[dict[str, Any]] = []
    with tempfile.TemporaryDirectory() as folder:
        if args.networks:
            paths = [random_model(network, Path(folder), args.unfolded) for network in args.networks]
        else:
            paths = [args.model or shipped_file("models", DEFAULT_MODEL)]
        for path in paths:
            manifest = load_manifest(manifest_path(path))
            for threads in args.threads:
                begin = time.perf_counter()
                model = DepthModel.load(path, threads, args.provider)
                load_s = time.perf_counter() - begin
                found.append({
                    "model": manifest.name, "input": [manifest.input_width, manifest.input_height], "threads": threads,
                    "megabytes": round(path.stat().st_size / 1e6, 1), "load": load_s, **measure(model, data, args.runs),
                })  # fmt: skip
    text = json.dumps({"camera": [2 * args.height, args.height], "models": found}, indent=1)
    print(text)
    if args.json:
        args.json.write_text(text + "\n", encoding="utf-8")


if __name__ == "__main__":
    main()
