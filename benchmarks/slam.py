"""Grid SLAM: accuracy and CPU time on the Intel log, in generated buildings and on the simulated crawler, as JSON.

python benchmarks/slam.py [--data FOLDER] [--only NAME ...]
python benchmarks/slam.py --only faults --log NAME [--first N] [--faults NAME ...] [--places N]

Parts: ``box`` (720 beams in a room), ``long`` (the same for a long time, to see whether the cost per scan grows),
``intel``, ``intel_seeds`` (five seeds of degraded odometry), ``worlds``, ``sim``,
``faults`` (faults put into one log, which may be a generated one; only if named).
All use the default parameters. ``--data`` is the folder with intel.log.gz; default ../shared/data/slam2d.
"""

from __future__ import annotations

import math
import time
from pathlib import Path

import numpy as np
from reporting import note, parser_for, report

from instant_ic.experiments.slam import (
    Relations,
    evaluate_log,
    perturb_odometry,
    read_relations,
    read_stamps,
    trajectory_errors,
)
from instant_ic.experiments.slam_faults import FAULTS, evaluate_faults
from instant_ic.experiments.slam_logs import LogEntry, read_log
from instant_ic.experiments.slam_worlds import LASERS, cells, drive, ring
from instant_ic.geometry.poses import compose2
from instant_ic.slam import GridSlam, Scan
from instant_ic.slam.start import warm_up

KEPT = (
    "translation_mean_m", "translation_median_m", "translation_max_m", "rotation_mean_deg", "relations",
    "online_translation_mean_m", "scans", "cpu_ms_per_scan_mean", "cpu_ms_per_scan_p99", "scan_thread_ms_mean",
    "background_ms_per_scan_mean", "peak_rss_mb", "keyframes", "loops", "loops_refused", "updates",
)  # fmt: skip


def room_drive(scans: int) -> list[dict[str, object]]:
    """Circles in a 10 m × 8 m room, VLP-16-like scans: CPU milliseconds for each thousand scans."""
    warm_up()
    slam = GridSlam()
    rng, beams = np.random.default_rng(0), 720
    pose = np.array([0.0, -2.5, 0.0])
    angles = -math.pi + 2 * math.pi / beams * np.arange(beams)
    scan_ms, all_ms = [], []
    parts: list[dict[str, object]] = []
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


def intel(entries: list[LogEntry], relations: Relations, seed: int | None = None) -> dict[str, object]:
    """The Intel log; ``seed`` degrades its odometry."""
    source = entries if seed is None else perturb_odometry(entries, seed)
    report, _ = evaluate_log(source, relations)
    return {key: report[key] for key in KEPT if key in report}


def worlds() -> dict[str, object]:
    """Generated buildings: maximum and mean error of the online and of the final poses."""
    out: dict[str, object] = {}
    for name, made, laser, seed in (
        ("ring of corridors, 210 m, twice and back, SICK 180°", ring(0), "sick180", 0),
        ("ring of corridors, SICK 361 beams", ring(1), "sick361", 1),
        ("rooms that look alike, VLP-16", cells(), "vlp16", 0),
        ("ring of corridors, SICK 8 m", ring(4), "sick8m", 4),
    ):
        journey = drive(made[0], made[1], LASERS[laser], seed)
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


def simulated() -> list[dict[str, object]]:
    """Five round trips of the simulated crawler, 20 % slip."""
    from instant_ic.experiments.slam_sim import evaluate_round_trip, round_trip
    from instant_ic.sim.worlds import make_world

    world = make_world("corridor")
    reports = [evaluate_round_trip(round_trip(world, 0.2, seed))[0] for seed in range(5)]
    return [
        {key: value for key, value in report.items() if "error" in key or key == "driven_m" or key in KEPT}
        for report in reports
    ]


def named_log(name: str, data: Path) -> tuple[list[LogEntry], Relations | None]:
    """Return a log and its relations, None if there are none.

    A real log in ``data``, the simulated crawler, or a drive through a generated building.
    """
    from instant_ic.experiments.slam_sim import round_trip
    from instant_ic.sim.worlds import make_world

    kind, _, seed = name.partition(":")
    if kind == "crawler":
        trip = round_trip(make_world("corridor"), 0.2, int(seed or 0))
        return trip.entries, None
    if kind == "ring":
        made = ring(int(seed or 0))
        journey = drive(made[0], made[1], LASERS["sick180"], int(seed or 0))
        return journey.entries, None
    relations = None
    if name.startswith("intel"):
        stamps = read_stamps(data / "intel.exact_stamps")
        relations = read_relations(data / "intel.relations").at_stamps(stamps)
    return list(read_log(data / name)), relations


def main() -> None:
    parts = ("box", "long", "intel", "intel_seeds", "worlds", "sim")
    parser = parser_for(__doc__)
    default = Path(__file__).resolve().parents[2] / "shared" / "data" / "slam2d"
    parser.add_argument("--data", type=Path, default=default)
    parser.add_argument("--only", nargs="+", choices=(*parts, "faults"), default=parts)
    parser.add_argument("--log", metavar="NAME", help="of faults: a file in --data, crawler:SEED, ring:SEED")
    parser.add_argument("--first", type=int, metavar="N", help="of faults: only the first N scans")
    parser.add_argument("--faults", nargs="+", choices=FAULTS, default=FAULTS, metavar="NAME")
    parser.add_argument("--places", type=int, default=6, metavar="N")
    parser.add_argument("--seed", type=int, default=0, metavar="N")
    args = parser.parse_args()
    result: dict[str, object] = {}
    if "faults" in args.only:
        if args.log is None:
            parser.error("--only faults needs --log")
        log, _ = named_log(args.log, args.data)
        result[args.log] = evaluate_faults(
            log[: args.first], places=args.places, seed=args.seed, faults=args.faults, on_step=note
        )
    if "box" in args.only:
        result["box"] = room_drive(600)[-1]
    if "long" in args.only:
        result["long"] = room_drive(12000)
    if any(name.startswith("intel") for name in args.only):
        if (args.data / "intel.log.gz").is_file():
            entries, relations = named_log("intel.log.gz", args.data)
            assert relations is not None
            if "intel" in args.only:
                result["intel"] = intel(entries, relations)
            if "intel_seeds" in args.only:
                result["intel_seeds"] = [intel(entries, relations, seed) for seed in range(1, 6)]
        else:
            result["intel"] = f"left out: {args.data / 'intel.log.gz'} is missing"
    if "worlds" in args.only:
        result["worlds"] = worlds()
    if "sim" in args.only:
        result["sim"] = simulated()
    report(result, args.json)


if __name__ == "__main__":
    main()
