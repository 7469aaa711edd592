"""Cost of one step of depth_scaler per source, compared with one estimate of the shipped network; prints JSON.

    python benchmarks/depth_node.py

CPU time, the median over several panoramas of a generated world. A step moves the points of a revolution to the image's
stamp, scales, fuses, and encodes the uncertainty. ``of_an_estimate`` is the share of the network's CPU time in the same
run; it does not depend on the machine's speed or load.
"""

from __future__ import annotations

import json
import platform
import time

import numpy as np

from instant_ic.depth.deskew import points_at
from instant_ic.depth.keyframes import encode_sigma
from instant_ic.depth.model import DEFAULT_MODEL, DepthModel
from instant_ic.depth.sources import SOURCES, DepthSource, SourceConfig
from instant_ic.experiments.depth_lidar import Errors, measure_world
from instant_ic.experiments.depth_worlds import LIDAR_HEIGHT_M, scenes
from instant_ic.geometry.poses import pose_matrix
from instant_ic.paths import shipped_file

UP = np.array([0.0, 0.0, 1.0])


def main() -> None:
    model = DepthModel.load(shipped_file("models", DEFAULT_MODEL), threads=1)
    taken: dict[str, list[float]] = {}

    def timed(name: str, begin: float) -> None:
        taken.setdefault(name, []).append(time.process_time() - begin)

    for number, scene in enumerate(scenes("corridor", 6)):
        points = measure_world(
            scene.renderer, scene.map_from_camera, LIDAR_HEIGHT_M, scene.camera_height_m, Errors(outliers=0.05)
        )
        begin = time.process_time()
        raw = model.estimate(scene.rgb)
        timed("estimate", begin)
        stamps = np.linspace(0, 0.1, len(points))
        for name in SOURCES:
            source = DepthSource(SourceConfig(source=name))
            if number == 0:
                source.estimate(raw, points, UP, scene.camera_height_m)  # warm-up: tables are built once
            begin = time.process_time()
            moved = points_at(points, stamps, 0, lambda ns: pose_matrix(x=1e-9 * ns * 0.01))
            result = source.estimate(raw, moved, UP, scene.camera_height_m)
            encode_sigma(result.sigma)
            timed(name, begin)
    middle = {name: float(np.median(seconds[1:])) for name, seconds in taken.items()}
    report = {
        "machine": platform.processor() or platform.machine(),
        "points": len(points),
        "estimate_ms": round(1e3 * middle["estimate"], 1),
        "step_ms": {name: round(1e3 * middle[name], 1) for name in SOURCES},
        "of_an_estimate": {name: round(middle[name] / middle["estimate"], 3) for name in SOURCES},
    }
    print(json.dumps(report, indent=1))


if __name__ == "__main__":
    main()
