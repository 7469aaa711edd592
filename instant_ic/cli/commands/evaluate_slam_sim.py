"""``ic evaluate slam-sim``: SLAM on the simulated crawler."""

from __future__ import annotations

import argparse
from pathlib import Path
from typing import Any

from instant_ic.cli.arguments import positive_int, verb
from instant_ic.cli.evaluations import errors_for_the_user, print_figures
from instant_ic.cli.progress import progress


def add_kind(kinds: Any) -> None:
    add = verb(
        kinds, "slam-sim", "run SLAM on round trips of the simulated crawler with slipping tracks", evaluate_slam_sim,
        "ic evaluate slam-sim --slip 0.2 --seeds 5",
        "Drive the simulated crawler along a corridor and back, on tracks with random slip; run SLAM on its scans "
        "and encoders, and compare with the true poses. Prints the figures of each seed as JSON.",
    ).add_argument  # fmt: skip
    add("--world", default="corridor", help="world of the simulator (default: %(default)s)")
    add("--slip", type=float, default=0.2, help="slip as a share of the distance, 1 σ (default: %(default)g)")
    add("--seeds", type=positive_int, default=5, metavar="N", help="number of drives (default: %(default)d)")
    text = "round trips per drive, about 39 m each (default: %(default)d)"
    add("--rounds", type=positive_int, default=2, help=text)
    add("--no-odometry", action="store_true", help="ignore the encoders")
    add("--json", type=Path, metavar="OUT", help="also write the figures here")
    text = "write an image of the last drive's map and paths here"
    add("--plot", type=Path, metavar="OUT.png", help=text)


def evaluate_slam_sim(args: argparse.Namespace) -> int:
    from instant_ic.experiments.plots import save_map
    from instant_ic.experiments.slam_sim import evaluate_round_trip, round_trip
    from instant_ic.sim.worlds import make_world

    reports: list[dict[str, object]] = []
    with errors_for_the_user(), progress("round trips") as advance:
        world = make_world(args.world)
        for seed in range(args.seeds):
            trip = round_trip(world, args.slip, seed, args.rounds)
            report, run = evaluate_round_trip(trip, use_wheel_odom=not args.no_odometry)
            reports.append({"seed": seed, **report})
            advance((seed + 1) / args.seeds)
    worst = {key: max(float(report[key]) for report in reports) for key in _WORST}  # type: ignore[arg-type]
    print_figures({"world": args.world, "slip": args.slip, "worst": worst, "drives": reports}, args.json)
    if args.plot:
        grid = run.slam.grid()
        paths = {"estimate": run.trajectory[:, 1:], "truth": trip.truth}
        save_map(args.plot, grid.values, grid.resolution, (float(grid.origin[0]), float(grid.origin[1])), paths=paths)
    return 0


_WORST = ("end_error_m", "end_error_deg", "max_error_m", "max_error_deg", "cpu_ms_per_scan_mean", "cpu_ms_per_scan_p99")
