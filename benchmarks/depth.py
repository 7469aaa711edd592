#!/usr/bin/env python3
"""Depth sources on held-out worlds, with and without LiDAR outliers; prints JSON, and a table on stderr.

    python benchmarks/depth.py --mesh house.glb --json depth.json

The worlds are not used for training: random ones, the corridor of the experiments, and a mesh file if given. The LiDAR
is a VLP-16 0.6 m above the floor with 2 cm noise; its rays are cast in the world (also behind surfaces the camera
sees). The camera is level, 1.2 m above the floor. Scores count pixels; ``by_solid_angle`` weights them by solid angle.
"""

from __future__ import annotations

import platform
import sys
import time
from pathlib import Path
from typing import Any

import numpy as np
from reporting import parser_of, report

from instant_ic.depth.model import DEFAULT_COMPLETION, DEFAULT_MODEL, DepthModel
from instant_ic.experiments.depth import DepthSettings, Evaluator, LidarSettings
from instant_ic.experiments.depth_lidar import Errors, measure_world
from instant_ic.experiments.depth_pictures import Sheets
from instant_ic.experiments.depth_worlds import KINDS, LIDAR_HEIGHT_M, Scene, scenes
from instant_ic.util.paths import shipped_file

SOURCES = ("as estimated", "network", "lidar", "fused", "completed")
TARGET_MRE, TARGET_DELTA1, TARGET_SCALE_MEDIAN, TARGET_SCALE_P95 = 0.08, 0.93, 0.03, 0.10


class Remembered:
    """A model that estimates each image once and records the cost."""

    def __init__(self, model: DepthModel) -> None:
        self.manifest, self.provider = model.manifest, model.provider
        self._model = model
        self._last: tuple[int, np.ndarray] | None = None
        self.cpu_s: list[float] = []
        self.wall_s: list[float] = []

    def complete(self, rgb: np.ndarray, prior: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        cpu, wall = time.process_time(), time.perf_counter()
        found = self._model.complete(rgb, prior)
        self.cpu_s.append(time.process_time() - cpu)
        self.wall_s.append(time.perf_counter() - wall)
        return found

    def estimate(self, rgb: np.ndarray) -> np.ndarray:
        if self._last is None or self._last[0] != id(rgb):
            cpu, wall = time.process_time(), time.perf_counter()
            self._last = (id(rgb), self._model.estimate(rgb))
            self.cpu_s.append(time.process_time() - cpu)
            self.wall_s.append(time.perf_counter() - wall)
        return self._last[1].copy()


def evaluators(model: Remembered, share: float, method: str, completion: Remembered) -> dict[str, Evaluator]:
    """One evaluator per source; the unscaled source uses no LiDAR and therefore has no outliers."""
    lidar = LidarSettings(outliers=share, height_m=LIDAR_HEIGHT_M)
    made = {
        source: Evaluator(
            DepthSettings(source, lidar, method=method if source != "lidar" else ""), model,
            completion if source == "completed" else None,
        )
        for source in SOURCES[1:]
    }  # fmt: skip
    return made if share else {SOURCES[0]: Evaluator(DepthSettings("network"), model), **made}


def summary(rows: list[dict[str, Any]]) -> dict[str, Any]:
    def mean(key: str, part: str = "after") -> float:
        return round(float(np.mean([row[part][key] for row in rows])), 4)

    scale = [row["scale_error_median"] for row in rows]
    inside = {
        name: [row[name] for row in rows if row[name] is not None]
        for name in ("within_one_sigma", "within_two_sigma", "within_three_sigma")
    }
    keys = ("mre", "mae_m", "rmse_m", "delta1", "delta2", "delta3")
    return {
        "panoramas": len(rows),
        **{key: mean(key) for key in keys},
        "by_solid_angle": {key: mean(key, "after_by_solid_angle") for key in keys},
        "worst_mre": round(max(row["mre"] for row in rows), 4),
        "scale_error_median": round(float(np.median(scale)), 4),
        "scale_error_p95": round(float(np.quantile(scale, 0.95)), 4),
        **{name: round(float(np.mean(values)), 3) if values else None for name, values in inside.items()},
        "fits_ok": sum(bool(row["fit"]["ok"]) for row in rows) if rows[0]["fit"] else None,
        "cpu_source_s": round(float(np.median([row["cpu_source_s"] for row in rows])), 4),
    }


def score(scene: Scene, number: int, made: dict[str, Evaluator], share: float, sheets: list[Sheets]) -> Any:
    """Rows of one panorama by source."""
    points = measure_world(
        scene.renderer, scene.map_from_camera, LIDAR_HEIGHT_M, scene.camera_height_m,
        Errors(outliers=share, seed=number),
    )  # fmt: skip
    for name, evaluator in made.items():
        scored = evaluator.score(scene.name, scene.rgb, scene.depth_m, points if evaluator.settings.lidar else None)
        for sheet in sheets if name == "completed" and share else []:
            sheet.add(scored)
        yield name, scored.as_dict()


def table(results: dict[str, Any]) -> str:
    head = (
        "| Worlds | Outliers | Source | MRE | δ1 | MRE, δ1 by solid angle | Worst MRE | Scale error, 95 % | Within σ |"
    )
    lines = [head, "|" + "---|" * head.count(" | ") + "---|"]
    for kind, shares in results.items():
        for share, sources in shares.items():
            for source, row in sources.items():
                area, inside = row["by_solid_angle"], row["within_one_sigma"]
                lines.append(
                    f"| {kind} | {share} | {source} | {row['mre']:.3f} | {row['delta1']:.3f} | {area['mre']:.3f}, "
                    f"{area['delta1']:.3f} | {row['worst_mre']:.3f} | {row['scale_error_median']:.3f}, "
                    f"{row['scale_error_p95']:.3f} | {'' if inside is None else format(inside, '.2f')} |"
                )
    return "\n".join(lines)


def targets(results: dict[str, Any]) -> dict[str, dict[str, bool]]:
    """Targets met by the default source, for each set with 5 % outliers."""
    met = {}
    for kind, shares in results.items():
        sources = shares["5 %"]
        default = sources["completed"]
        met[kind] = {
            "mre": default["mre"] <= TARGET_MRE,
            "delta1": default["delta1"] >= TARGET_DELTA1,
            "better_than_either": all(
                default["mre"] < sources[s]["mre"] and default["delta1"] > sources[s]["delta1"]
                for s in ("network", "lidar", "fused")
            ),
            "scale_median": default["scale_error_median"] <= TARGET_SCALE_MEDIAN,
            "scale_p95": default["scale_error_p95"] <= TARGET_SCALE_P95,
        }
    return met


def main() -> int:
    parser = parser_of(__doc__)
    parser.add_argument("--count", type=int, default=40, help="panoramas of each kind (default: %(default)s)")
    parser.add_argument("--kinds", default=",".join(KINDS), help="of worlds (default: %(default)s)")
    parser.add_argument("--mesh", type=Path, help="mesh file for the kind mesh; without one it is left out")
    parser.add_argument("--model", type=Path, help="ONNX file (default: the shipped one)")
    parser.add_argument("--completion", type=Path, help="ONNX file of ic depth train (default: the shipped one)")
    parser.add_argument("--method", default="", help="of scaling (default: the scaler's)")
    parser.add_argument("--threads", type=int, default=2, help="of the model (default: %(default)s)")
    parser.add_argument(
        "--sheets", type=Path, metavar="DIR", help="sheets of images of the default source, 5 %% outliers"
    )
    args = parser.parse_args()
    if args.sheets:
        args.sheets.mkdir(parents=True, exist_ok=True)
    model = Remembered(DepthModel.load(args.model or shipped_file("models", DEFAULT_MODEL), threads=args.threads))
    found = args.completion or shipped_file("models", DEFAULT_COMPLETION)
    completion = Remembered(DepthModel.load(found, threads=args.threads))
    results: dict[str, Any] = {}
    for kind in args.kinds.split(","):
        if kind == "mesh" and args.mesh is None:
            print("mesh: not measured, no --mesh given", file=sys.stderr)
            continue
        rows: dict[str, dict[str, list[dict[str, Any]]]] = {}
        sheets = [Sheets(args.sheets / f"{kind}{end}.png", bool(end)) for end in ("", "-side")] if args.sheets else []
        made = {share: evaluators(model, share, args.method, completion) for share in (0.0, 0.05)}
        for number, scene in enumerate(scenes(kind, args.count, args.mesh if kind == "mesh" else None)):
            for share, each in made.items():
                for name, row in score(scene, number, each, share, sheets):
                    rows.setdefault(f"{share:.0%}".replace("%", " %"), {}).setdefault(name, []).append(row)
            print(f"{kind}: {scene.name}", file=sys.stderr, flush=True)
        for sheet in sheets:
            sheet.close()
        results[kind] = {share: {name: summary(each) for name, each in of.items()} for share, of in rows.items()}
    figures = {
        "model": model.manifest.name, "sha256": model.manifest.sha256, "provider": model.provider,
        "machine": platform.processor() or platform.machine(), "threads": args.threads,
        "model_cpu_s": round(float(np.median(model.cpu_s)), 4),
        "model_wall_s": round(float(np.median(model.wall_s)), 4),
        "completion": {
            "model": completion.manifest.name, "sha256": completion.manifest.sha256,
            "model_cpu_s": round(float(np.median(completion.cpu_s)), 4),
        },
        "targets_met": targets(results), "results": results,
    }  # fmt: skip
    report(figures, args.json)
    print(table(results), file=sys.stderr)
    return 0


if __name__ == "__main__":
    sys.exit(main())
