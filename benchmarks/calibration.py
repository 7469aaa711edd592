"""``ic calibrate camera-lidar`` on simulated drives with a camera that is displaced from its configured mount.

    python benchmarks/calibration.py --worlds corridor random:900004 --seeds 3 --json calibration.json

The simulator records each drive in this process (an arc, 16 images) with the camera displaced by 5 cm and 3 degrees in
random directions. The result is compared with the true pose.
"""

from __future__ import annotations

import argparse
import json
import tempfile
import time
from pathlib import Path

import numpy as np

from instant_ic.calibration.bag import read_recording
from instant_ic.calibration.mount import AXES, calibrate
from instant_ic.experiments.calibration_sim import BASE_FROM_CAMERA, perturbed, record


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--worlds", nargs="+", default=["corridor", "random:900002", "random:900004"])
    parser.add_argument("--seeds", type=int, default=3, help="directions of the perturbation, a world")
    parser.add_argument("--pictures", type=int, default=16)
    parser.add_argument("--distance", type=float, default=0.05, help="metres (%(default)s)")
    parser.add_argument("--angle", type=float, default=3.0, help="degrees (%(default)s)")
    parser.add_argument("--still", action="store_true", help="the robot stands")
    parser.add_argument("--json", type=Path)
    args = parser.parse_args()
    rows = []
    print(f"{'world':16} {'seed':>4} {'error':>7} {'angle':>6} {'z':>7} {'CPU':>6}  not constrained")
    for world in args.worlds:
        for seed in range(args.seeds):
            with tempfile.TemporaryDirectory() as folder:
                bag = Path(folder) / "bag"
                camera = perturbed(BASE_FROM_CAMERA, args.distance, args.angle, seed)
                twist = (0.0, 0.0) if args.still else (0.2, 0.5)
                truth = record(bag, camera, world, args.pictures, twist=twist)
                recording = read_recording(bag)
            begin = time.process_time()
            result = calibrate(recording.frames, recording.camera_from_lidar)
            cpu_s = time.process_time() - begin
            change = result.camera_from_lidar @ np.linalg.inv(truth)
            angle_deg = float(np.degrees(np.arccos(np.clip((np.trace(change[:3, :3]) - 1) / 2, -1, 1))))
            loose = [axis for axis, known in zip(AXES, result.constrained, strict=True) if not known]
            row = {
                "world": Path(world).name,
                "seed": seed,
                "error_m": round(float(np.linalg.norm(change[:3, 3])), 4),
                "error_xyz_m": change[:3, 3].round(4).tolist(),
                "error_deg": round(angle_deg, 3),
                "not_constrained": loose,
                "places": recording.places,
                "cpu_s": round(cpu_s, 2),
            }
            rows.append(row)
            print(f"{row['world']:16} {seed:4d} {row['error_m'] * 100:5.2f}cm {angle_deg:5.2f}d "
                  f"{change[2, 3] * 100:+5.2f}cm {cpu_s:5.1f}s  {', '.join(loose)}", flush=True)  # fmt: skip
    if args.json:
        args.json.write_text(json.dumps({"rows": rows}, indent=2) + "\n")


if __name__ == "__main__":
    main()
