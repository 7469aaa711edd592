"""Scaling rules on generated worlds that are not used for training the depth model.

    python benchmarks/depth_scaling.py --worlds 24 --mesh small_house.glb --json scaling.json
    python benchmarks/depth_scaling.py --worlds 24 --glass 0.3

Each panorama is estimated, scaled under each rule by a simulated VLP-16 revolution from 0.6 m, and compared with the
rendered ground truth. Some of the points are outliers at random ranges. The scale error is the deviation from 1 of the
median ratio of scaled depth to ground truth over the whole image.
"""

from __future__ import annotations

import argparse
import json
import time
from pathlib import Path

import numpy as np

from instant_ic.depth.metrics import depth_metrics
from instant_ic.depth.model import DEFAULT_MODEL, DepthModel
from instant_ic.depth.scaler import DepthScaler, ScalerConfig
from instant_ic.geometry.poses import inverse, pose_matrix, transform_points
from instant_ic.paths import shipped_file
from instant_ic.sim.render import EquirectRenderer
from instant_ic.sim.worlds import make_world

RULES = {
    "as estimated": ScalerConfig(method="as_estimated"),
    "max_ratio, lidar": ScalerConfig(method="max_ratio", maxima="lidar"),
    "max_ratio, image": ScalerConfig(method="max_ratio", maxima="image"),
    "median_ratio": ScalerConfig(method="median_ratio"),
    "ransac": ScalerConfig(method="ransac"),
    "sector": ScalerConfig(method="sector"),
}
MESH_PLACES = ((3.2, -2.2), (-4.6, -0.2), (-5.5, -3.4), (6.3, -2.4), (1.5, 2.2))
"""Free positions in small_house.glb."""


def lidar_points(renderer: EquirectRenderer, map_from_lidar: np.ndarray) -> np.ndarray:
    """(N, 3) points of one revolution in the map: 16 rings, 0.4 degrees, 2 cm noise, 100 m range."""
    elevation, azimuth = np.meshgrid(np.radians(np.arange(-15, 16, 2.0)), np.radians(np.arange(0, 360, 0.4)))
    local = np.stack(
        [np.cos(elevation) * np.cos(azimuth), np.cos(elevation) * np.sin(azimuth), np.sin(elevation)], axis=-1
    ).reshape(-1, 3)
    rays = (local @ map_from_lidar[:3, :3].T).astype(np.float32)
    origins = np.broadcast_to(map_from_lidar[:3, 3].astype(np.float32), rays.shape)
    ranges, _ = renderer.cast(np.ascontiguousarray(origins), np.ascontiguousarray(rays))
    hit = np.isfinite(ranges) & (ranges < 100)
    noise = np.random.default_rng(0).normal(0, 0.02, int(hit.sum()))
    return map_from_lidar[:3, 3] + rays[hit] * (ranges[hit] + noise)[:, None]


def spoilt(points: np.ndarray, outliers: float, glass: float, seed: int) -> np.ndarray:
    """Points (N, 3) around the camera with a share at random ranges, and a share of the circle behind glass.

    Through the pane the LiDAR measures 1.5 to 4 times the range, and half of the rays do not return.
    """
    rng = np.random.default_rng(seed)
    points = points.copy()
    azimuth = np.arctan2(points[:, 1], points[:, 0]) - rng.uniform(-np.pi, np.pi)
    pane = np.abs((azimuth + np.pi) % (2 * np.pi) - np.pi) < glass * np.pi
    points[pane] *= rng.uniform(1.5, 4)
    points = points[~pane | (rng.random(len(points)) < 0.5)]
    wrong = rng.random(len(points)) < outliers
    points[wrong] *= (rng.uniform(0.3, 30, int(wrong.sum())) / np.linalg.norm(points[wrong], axis=1))[:, None]
    return points


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--worlds", type=int, default=24, help="random worlds (seeds from 900000, never trained on)")
    parser.add_argument("--poses", type=int, default=2, help="panoramas in each; ten in the corridor and the mesh")
    parser.add_argument("--mesh", type=Path, help="small_house.glb")
    parser.add_argument("--outliers", type=float, default=0.05, help="share of the points (%(default)s)")
    parser.add_argument("--glass", type=float, default=0.0, help="share of the circle (%(default)s)")
    parser.add_argument("--model", type=Path, help="ONNX file (default: the shipped one)")
    parser.add_argument("--json", type=Path)
    args = parser.parse_args()
    model = DepthModel.load(args.model or shipped_file("models", DEFAULT_MODEL), threads=1)
    size = (model.manifest.input_width, model.manifest.input_height)
    estimate_s: list[float] = []
    worlds = [f"random:{900000 + seed}" for seed in range(args.worlds)] + ["corridor"]
    rows: dict[tuple[str, str], list[tuple[float, float, float, float, float]]] = {}
    for name in worlds + ([str(args.mesh)] if args.mesh else []):
        world = make_world(name)
        renderer = EquirectRenderer(world)
        random = name.startswith("random")
        kind = "random" if random else Path(name).stem
        if args.mesh and name == str(args.mesh):
            poses = [(x, y, yaw) for x, y in MESH_PLACES for yaw in (0.3, 2.4)]
        else:
            poses = world.sample_free_poses(np.random.default_rng(5), args.poses if random else 10)
        for number, (x, y, yaw) in enumerate(poses):
            map_from_camera = pose_matrix(x, y, 1.2, yaw=yaw)
            frame = renderer.render(map_from_camera, *size)
            points = lidar_points(renderer, pose_matrix(x, y, 0.6, yaw=yaw))
            points = spoilt(transform_points(inverse(map_from_camera), points), args.outliers, args.glass, number)
            begin = time.process_time()
            depth = model.estimate(frame.rgb)
            estimate_s.append(time.process_time() - begin)
            truth = np.where(frame.depth_m <= model.manifest.max_range_m, frame.depth_m, 0)
            known = truth > 0
            for rule, config in RULES.items():
                begin = time.process_time()
                fit = DepthScaler(config).fit(depth, points)
                cpu_s = time.process_time() - begin
                got = depth_metrics(fit.depth_m, truth)
                error = abs(float(np.median(fit.depth_m[known] / truth[known])) - 1)
                for group in (kind, "all"):
                    rows.setdefault((group, rule), []).append((error, got.mre, got.delta1, float(fit.ok), cpu_s))
    print(f"one estimate: {np.median(estimate_s):.3f} s CPU on one thread")
    table = []
    head = f"{'world':12} {'rule':18} {'count':>5} {'scale error':>11} {'95 %':>6}"
    print(f"{head} {'MRE':>6} {'delta1':>6} {'fit':>5} {'CPU ms':>6}")
    for (group, rule), values in rows.items():
        error, mre, delta1, fits, cpu = np.array(values).T
        row = {
            "world": group,
            "rule": rule,
            "count": len(values),
            "scale_error_median": round(float(np.median(error)), 4),
            "scale_error_p95": round(float(np.quantile(error, 0.95)), 4),
            "mre": round(float(mre.mean()), 4),
            "delta1": round(float(delta1.mean()), 4),
            "fit": round(float(fits.mean()), 3),
            "cpu_ms": round(1e3 * float(np.median(cpu)), 1),
        }
        table.append(row)
        print(f"{group:12} {rule:18} {len(values):5d} {row['scale_error_median']:11.4f} {row['scale_error_p95']:6.3f} "
              f"{row['mre']:6.3f} {row['delta1']:6.3f} {row['fit']:5.2f} {row['cpu_ms']:6.1f}")  # fmt: skip
    if args.json:
        summary = {
            "outliers": args.outliers,
            "glass": args.glass,
            "estimate_s": float(np.median(estimate_s)),
            "rows": table,
        }
        args.json.write_text(json.dumps(summary, indent=2) + "\n")


if __name__ == "__main__":
    main()
