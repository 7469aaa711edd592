#!/usr/bin/env python3
"""Grid SLAM: accuracy and CPU time on the Intel log and in generated buildings; prints JSON.

    python benchmarks/slam.py [--data FOLDER] [--only NAME ...]
    python benchmarks/slam.py --only faults --log NAME [--first N] [--faults NAME ...] [--places N]

Parts: ``long`` (720 beams in a room for a long time, to see whether the cost per scan grows), ``intel`` and ``worlds``.
``faults`` (put into one log) runs only if named. All use the default parameters. ``ic evaluate slam-sim`` measures the
simulated crawler.
"""

from __future__ import annotations

import math
import time
from pathlib import Path

import numpy as np
from reporting import note, parser_for, report
from slam_faults import FAULTS, evaluate_faults
from slam_worlds import LASERS, cells, drive, ring

from instant_ic.experiments.slam import (
    evaluate_log,
    read_relations,
    read_stamps,
    trajectory_errors,
)
from instant_ic.experiments.slam_logs import LogEntry, is_bag, read_bag, read_log
from instant_ic.experiments.slam_sim import round_trip
from instant_ic.geometry.poses import compose2
from instant_ic.sim.worlds import make_world
from instant_ic.slam import GridSlam, Scan
from instant_ic.slam.scan import FloatArray
from instant_ic.slam.start import warm_up

KEPT = (
    "translation_mean_m", "translation_median_m", "translation_max_m", "rotation_mean_deg", "relations",
    "online_translation_mean_m", "scans", "cpu_ms_per_scan_mean", "cpu_ms_per_scan_p99", "scan_thread_ms_mean",
    "background_ms_per_scan_mean", "peak_rss_mb", "keyframes", "loops", "loops_refused", "updates",
)  # fmt: skip
"""Figures of the result."""
BEAMS = 720


def room_drive(scans: int) -> list[dict[str, object]]:
    """Drive circles in a room of 10 m x 8 m with 720 beams; return CPU milliseconds of each thousand scans."""
    warm_up()
    slam, rng = GridSlam(), np.random.default_rng(0)
    pose, step = np.array([0.0, -2.5, 0.0]), np.array([0.05, 0.0, 0.02])
    scan_ms, all_ms = [], []
    parts: list[dict[str, object]] = []
    for index in range(scans):
        pose = compose2(pose, step)
        ranges = ranges_to_walls(pose) + 0.015 * rng.standard_normal(BEAMS)
        scan = Scan(ranges, -math.pi, 2 * math.pi / BEAMS, 0.3, 30.0, (index + 1) * 100_000_000)
        begin = time.thread_time()
        slam.process(scan, pose)
        scanned = time.thread_time()
        job = slam.background_job()
        if job is not None:
            slam.take_over(job())
        scan_ms.append(1e3 * (scanned - begin))
        all_ms.append(1e3 * (time.thread_time() - begin))
        if len(scan_ms) == 1000 or index == scans - 1:
            parts.append(
                {
                    "scans": index + 1,
                    "cpu_ms_per_scan_mean": float(np.mean(all_ms)),
                    "scan_thread_ms_p99": float(np.percentile(scan_ms, 99)),
                    "keyframes": slam.figures()["keyframes"],
                }
            )
            scan_ms, all_ms = [], []
    return parts


def ranges_to_walls(pose: FloatArray) -> FloatArray:
    """Return the ranges of a turn of beams from a pose to the walls of the room, in metres."""
    direction = pose[2] - math.pi + 2 * math.pi / BEAMS * np.arange(BEAMS)
    cos, sin = np.cos(direction), np.sin(direction)
    with np.errstate(divide="ignore"):
        along_x = np.where(cos > 0, 5.0 - pose[0], -5.0 - pose[0]) / cos
        along_y = np.where(sin > 0, 4.0 - pose[1], -4.0 - pose[1]) / sin
    return np.minimum(along_x, along_y)


def worlds() -> dict[str, object]:
    """Drive through generated buildings; return the errors of the online and of the final poses."""
    out: dict[str, object] = {}
    for name, made, laser, seed in (
        ("ring of corridors, 210 m, twice and back, SICK 180°", ring(0), "sick180", 0),
        ("rooms that look alike, VLP-16", cells(), "vlp16", 0),
    ):
        journey = drive(*made, LASERS[laser], seed)
        report, run = evaluate_log(journey.entries)
        online, _ = trajectory_errors(run.online[:, 1:], journey.truth)
        final, _ = trajectory_errors(run.trajectory[:, 1:], journey.truth)
        wheels, _ = trajectory_errors(np.array([entry.odom_pose for entry in journey.entries]), journey.truth)
        out[name] = {
            "online_mean_m": float(online.mean()),
            "online_max_m": float(online.max()),
            "final_mean_m": float(final.mean()),
            "final_max_m": float(final.max()),
            "wheels_max_m": float(wheels.max()),
            **{key: report[key] for key in KEPT if key in report},
        }
    return out


def named_log(name: str, data: Path) -> list[LogEntry]:
    """Return a real log in ``data``, one of the simulated crawler, or one of a drive through a generated building."""
    kind, _, seed = name.partition(":")
    if kind == "crawler":
        return round_trip(make_world("corridor"), 0.2, int(seed or 0)).entries
    if kind == "ring":
        return drive(*ring(int(seed or 0)), LASERS["sick180"], int(seed or 0)).entries
    path = data / name
    return list(read_bag(path) if is_bag(path) else read_log(path))


def main() -> None:
    parts = ("long", "intel", "worlds")
    parser = parser_for(__doc__)
    default = Path(__file__).resolve().parents[2] / "shared" / "data" / "slam2d"
    parser.add_argument("--data", type=Path, default=default, help="folder of the logs (default ../shared/data/slam2d)")
    parser.add_argument("--only", nargs="+", choices=(*parts, "faults"), default=parts)
    parser.add_argument(
        "--log",
        metavar="NAME",
        help="of faults: a log or bag (its path, or its name in --data), crawler:SEED, ring:SEED",
    )
    parser.add_argument("--first", type=int, metavar="N", help="of faults: only the first N scans")
    parser.add_argument("--faults", nargs="+", choices=FAULTS, default=FAULTS, metavar="NAME")
    parser.add_argument("--places", type=int, default=6, metavar="N")
    parser.add_argument("--seed", type=int, default=0, metavar="N")
    args = parser.parse_args()
    result: dict[str, object] = {}
    if "faults" in args.only:
        if args.log is None:
            parser.error("--only faults needs --log")
        log = named_log(args.log, args.data)[: args.first]
        result[args.log] = evaluate_faults(log, places=args.places, seed=args.seed, faults=args.faults, on_step=note)
    if "long" in args.only:
        result["long"] = room_drive(12000)
    if "intel" in args.only:
        stamps = read_stamps(args.data / "intel.exact_stamps")
        relations = read_relations(args.data / "intel.relations").at_stamps(stamps)
        found, _ = evaluate_log(named_log("intel.log.gz", args.data), relations)
        result["intel"] = {key: found[key] for key in KEPT if key in found}
    if "worlds" in args.only:
        result["worlds"] = worlds()
    report(result, args.json)


if __name__ == "__main__":
    main()
