"""Measures the effect of ``depth.tidy`` on a network's depth without LiDAR and prints JSON.

    python benchmarks/depth_tidy.py [--count 20] [--mesh small_house.glb]

Held-out panoramas as in ``benchmarks/depth.py``. Reported are MRE and δ1 of the depth as estimated and tidied, each
after the best factor per image, so that shape is compared; and the scale error, as estimated and by the camera's
height.
"""

from __future__ import annotations

import argparse
import json
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from instant_ic import paths
from instant_ic.depth.metrics import depth_metrics
from instant_ic.depth.model import DEFAULT_MODEL, DepthModel
from instant_ic.depth.tidy import tidy
from instant_ic.experiments.depth_worlds import CAMERA_HEIGHT_M, held_out


def shape_and_scale(depth: NDArray[np.floating], truth: NDArray[np.floating]) -> tuple[float, float, float]:
    """MRE and δ1 after the best factor, and the scale error before it."""
    valid = truth > 0
    factor = float(np.median(truth[valid] / depth[valid]))
    found = depth_metrics(depth * factor, truth, valid)
    return found.mre, found.delta1, abs(1 / factor - 1)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--count", type=int, default=20, help="panoramas of each kind (default 20)")
    parser.add_argument("--mesh", type=Path, help="also places in a mesh file")
    arguments = parser.parse_args()
    model = DepthModel.load(paths.shipped_file("models", DEFAULT_MODEL), threads=1)
    result: dict[str, Any] = {"model": model.manifest.sha256, "panoramas of each kind": arguments.count}
    for kind in ("random", "corridor", *(["mesh"] if arguments.mesh else [])):
        found: dict[str, list[tuple[float, float, float]]] = {"as estimated": [], "tidied": [], "camera height": []}
        for _, rgb, truth, _ in held_out(kind, arguments.count, arguments.mesh if kind == "mesh" else None):
            raw = model.estimate(rgb)
            found["as estimated"].append(shape_and_scale(raw, truth))
            for name, height in (("tidied", None), ("camera height", CAMERA_HEIGHT_M)):
                depth = tidy(raw, height).depth_m
                step = depth.shape[0] // truth.shape[0]
                found[name].append(shape_and_scale(depth[step // 2 :: step, step // 2 :: step], truth))
        result[kind] = {
            name: {
                "mre": round(float(np.mean([row[0] for row in rows])), 4),
                "delta1": round(float(np.mean([row[1] for row in rows])), 4),
                "scale_error_median": round(float(np.median([row[2] for row in rows])), 4),
                "scale_error_q95": round(float(np.quantile([row[2] for row in rows], 0.95)), 4),
            }
            for name, rows in found.items()
        }
    print(json.dumps(result, indent=2))


if __name__ == "__main__":
    main()
