#!/usr/bin/env python3
"""Comparison of depth models on held-out panoramas; prints JSON, and a table on stderr.

    python benchmarks/depth_models.py models/slicenet_small.onnx mine.onnx --mesh house.glb

The worlds are not used for training: random ones, the corridor of the experiments, interiors of all kinds that the
training uses (with other seeds), and a mesh file if given. Ground truth over 16 m is ignored. Each model is scored as
estimated and after the best factor per image (the median of truth over estimate). A model is better than the first if
its MRE after scaling, averaged over the kinds, is lower and on no kind over 5 % higher.
"""

from __future__ import annotations

import argparse
import json
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np

from instant_ic.depth.metrics import depth_metrics, mean_metrics
from instant_ic.depth.model import DepthModel
from instant_ic.experiments.depth_worlds import CAMERA_HEIGHT_M, FIRST_SEED, KINDS, held_out
from instant_ic.geometry.poses import pose_matrix
from instant_ic.sim.render import EquirectRenderer
from instant_ic.training.interiors import interior_world

MAX_RANGE_M = 16.0
WORST = 1.05

Panorama = tuple[np.ndarray, np.ndarray]


def interiors(count: int) -> Iterator[Panorama]:
    """One panorama in each of ``count`` interiors of all kinds."""
    seed, made = FIRST_SEED, 0
    while made < count:
        world = interior_world(seed)
        try:
            ((x, y, yaw),) = world.sample_free_poses(np.random.default_rng([5, seed]), 1)
        except ValueError:  # no free position
            pass
        else:
            frame = EquirectRenderer(world).render(pose_matrix(x, y, CAMERA_HEIGHT_M, yaw=yaw), 512, 256)
            yield frame.rgb, frame.depth_m
            made += 1
        seed += 1


def score(model: DepthModel, panoramas: list[Panorama]) -> dict[str, Any]:
    """Mean metrics as estimated and after the best factor."""
    raw, scaled = [], []
    for rgb, truth in panoramas:
        depth, valid = model.estimate(rgb), (truth > 0) & (truth <= MAX_RANGE_M)
        factor = np.median(truth[valid] / np.maximum(depth[valid], 1e-3))
        raw.append(depth_metrics(depth, truth, valid))
        scaled.append(depth_metrics(np.clip(depth * factor, 0.1, MAX_RANGE_M), truth, valid))
    return {"as_estimated": mean_metrics(raw).as_dict(), "scaled": mean_metrics(scaled).as_dict()}


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("models", type=Path, nargs="+", help="ONNX files; the others are compared with the first")
    parser.add_argument("--mesh", type=Path, help="mesh file for the kind mesh; without one it is left out")
    parser.add_argument("--count", type=int, default=24, help="panoramas of each kind (default: %(default)s)")
    parser.add_argument("--threads", type=int, default=1, help="of the models (default: %(default)s)")
    args = parser.parse_args()
    sets = {
        kind: [(rgb, truth) for _, rgb, truth, _ in held_out(kind, args.count, args.mesh if kind == "mesh" else None)]
        for kind in KINDS
        if kind != "mesh" or args.mesh
    }
    sets["interiors"] = list(interiors(args.count))
    result: dict[str, Any] = {"count": args.count, "models": {}}
    first: dict[str, float] | None = None
    for path in args.models:
        model = DepthModel.load(path, threads=args.threads)
        scores = {kind: score(model, panoramas) for kind, panoramas in sets.items()}
        mre = {kind: values["scaled"]["mre"] for kind, values in scores.items()}
        entry: dict[str, Any] = {"sha256": model.manifest.sha256, "kinds": scores}
        if first is None:
            first = mre
        else:
            worst = max(mre[kind] / first[kind] for kind in mre)
            lower = sum(mre.values()) < sum(first.values())
            entry["better_than_first"] = bool(lower and worst <= WORST)
        result["models"][str(path)] = entry
        for kind, values in scores.items():
            a, b = values["as_estimated"], values["scaled"]
            told = f"{path.name:28} {kind:10} MRE {a['mre']:.3f} δ1 {a['delta1']:.3f}"
            told += f" scale {a['scale_error_median']:.3f} | scaled MRE {b['mre']:.3f} δ1 {b['delta1']:.3f}"
            print(told, file=sys.stderr, flush=True)
    print(json.dumps(result, indent=1))


if __name__ == "__main__":
    main()
