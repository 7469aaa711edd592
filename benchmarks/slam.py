"""Grid SLAM: CPU milliseconds a scan and the relation error on the Intel log, as JSON.

python benchmarks/slam.py [FOLDER]        # the folder with intel.log.gz; default ../shared/data/slam2d
"""

from __future__ import annotations

import json
import math
import sys
import time
from pathlib import Path

import numpy as np

from instant_ic.evaluation.slam import evaluate_log, read_relations, read_stamps
from instant_ic.geometry.poses import compose2
from instant_ic.slam import GridSlam, Scan
from instant_ic.slam.backend import warm_up
from instant_ic.slam.logs import read_log


def box_drive(scans: int = 600, beams: int = 720) -> dict[str, float]:
    """CPU time with VLP-16-like scans: a drive in circles in a 10 m × 8 m room."""
    warm_up()
    slam = GridSlam()
    rng = np.random.default_rng(0)
    pose = np.array([0.0, -2.5, 0.0])
    angles = -math.pi + 2 * math.pi / beams * np.arange(beams)
    cpu_ms = []
    for index in range(scans):
        pose = compose2(pose, np.array([0.05, 0.0, 0.02]))
        direction = angles + pose[2]
        cos, sin = np.cos(direction), np.sin(direction)
        with np.errstate(divide="ignore"):
            wall = np.minimum(
                np.where(cos > 0, 5.0 - pose[0], -5.0 - pose[0]) / cos,
                np.where(sin > 0, 4.0 - pose[1], -4.0 - pose[1]) / sin,
            )
        ranges = wall + 0.015 * rng.standard_normal(beams)
        scan = Scan(ranges, -math.pi, 2 * math.pi / beams, 0.3, 30.0, (index + 1) * 100_000_000)
        begin = time.process_time()
        slam.process(scan, pose)
        cpu_ms.append(1e3 * (time.process_time() - begin))
    return {"cpu_ms_per_scan_mean": float(np.mean(cpu_ms)), "cpu_ms_per_scan_p99": float(np.percentile(cpu_ms, 99))}


def main() -> None:
    """Print one JSON object."""
    default = Path(__file__).resolve().parents[2] / "shared" / "data" / "slam2d"
    folder = Path(sys.argv[1]) if len(sys.argv) > 1 else default
    report: dict[str, object] = {"box_720_beams": box_drive()}
    if (folder / "intel.log.gz").is_file():
        stamps = read_stamps(folder / "intel.exact_stamps")
        relations = read_relations(folder / "intel.relations").at_stamps(stamps, 0.006)
        report["intel"], _ = evaluate_log(read_log(folder / "intel.log.gz"), relations)
    else:
        report["intel"] = f"left out: {folder / 'intel.log.gz'} is missing"
    print(json.dumps(report, indent=2))


if __name__ == "__main__":
    main()
