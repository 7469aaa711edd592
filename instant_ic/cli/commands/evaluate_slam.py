"""``ic evaluate slam`` and ``slam-sim``: SLAM on a laser log, and on the simulated crawler."""

from __future__ import annotations

import argparse
import sys
import time
from pathlib import Path
from typing import TYPE_CHECKING, Any

from instant_ic.cli.arguments import check_files, positive_int, verb
from instant_ic.cli.errors import UserError
from instant_ic.cli.evaluations import errors_for_the_user, print_figures
from instant_ic.cli.progress import progress

if TYPE_CHECKING:
    from instant_ic.experiments.slam import Relations

_WORST = ("end_error_m", "end_error_deg", "max_error_m", "max_error_deg", "cpu_ms_per_scan_mean", "cpu_ms_per_scan_p99")


def add_kind(kinds: Any) -> None:
    """Add both kinds to ``ic evaluate``."""
    _add_slam(kinds)
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
    add("--json", type=Path, metavar="OUT", help="also write the figures here")


def _add_slam(kinds: Any) -> None:
    add = verb(
        kinds, "slam", "run SLAM on a 2D laser log", evaluate_slam,
        "ic evaluate slam intel.log.gz --relations intel.relations --stamps intel.exact_stamps",
        "Run the grid SLAM on a log as fast as possible. LOG is a CARMEN log (FLASER or ROBOTLASER1 lines, gzip or "
        "plain), a BreezySLAM exp*.dat, or a bag with LaserScan. Lines that cannot be read are left out and counted. "
        "Writes a folder with the final trajectory (trajectory.txt, one line 't x y yaw' per scan), the map (map.png) "
        "and the figures (figures.json), and prints the figures; with relations also the error against them.",
    ).add_argument  # fmt: skip
    add("log", type=Path, metavar="LOG")
    add("--relations", type=Path, metavar="REL", help="reference relations: t1 t2 x y z roll pitch yaw")
    add("--stamps", type=Path, metavar="FILE", help="use only relations whose ends match these times")
    add("-o", "--output", type=Path, metavar="DIR", help="default: runs/slam_LOG_DATE_TIME")
    add("--json", type=Path, metavar="OUT", help="also write the figures here")
    add("--scan-topic", metavar="TOPIC", help="scan topic, for a bag with several")
    add("--params-file", type=Path, action="append", metavar="F", help="parameters of grid_slam")
    text = "one parameter of grid_slam"
    add("-p", "--param", action="append", default=[], metavar="KEY:=VALUE", help=text)
    add("--no-odometry", action="store_true", help="ignore the log's odometry")


def evaluate_slam(args: argparse.Namespace) -> int:
    """Run the SLAM on a log; print and write the figures."""
    from instant_ic.bag.replay import make_node
    from instant_ic.experiments.plots import save_map
    from instant_ic.experiments.slam import evaluate_log
    from instant_ic.experiments.slam_logs import is_bag, read_bag, read_log

    if args.stamps and not args.relations:
        raise UserError("--stamps selects relations: give --relations too", 2)
    overrides = [f"grid_slam.{override}" for override in args.param]
    config = make_node("grid_slam", args.params_file or [], overrides).config
    stem = args.log.resolve().name.removesuffix(".gz").rsplit(".", 1)[0]
    folder = args.output or Path(f"runs/slam_{stem}_{time.strftime('%Y%m%d_%H%M%S')}")
    check_files(args.json)
    bad: list[str] = []
    with errors_for_the_user(), progress(args.log.name) as advance:
        relations = _relations(args)
        entries = list(read_bag(args.log, args.scan_topic) if is_bag(args.log) else read_log(args.log, bad))
        folder.mkdir(parents=True, exist_ok=True)
        report, run = evaluate_log(
            entries, relations, config, use_wheel_odom=not args.no_odometry,
            on_scan=lambda done: advance(done / len(entries)),
        )  # fmt: skip
    for line in bad[:5]:
        print(f"left out: {line}", file=sys.stderr)
    import numpy as np

    np.savetxt(folder / "trajectory.txt", run.trajectory, fmt=("%.6f", "%.5f", "%.5f", "%.6f"))
    save_map(folder / "map.png", run.slam.grid(), paths={"trajectory": run.trajectory[:, 1:]})
    report = {"log": args.log.name, **report, "bad_lines": len(bad), "output": str(folder)}
    print_figures(report, folder / "figures.json", args.json)
    return 0


def _relations(args: argparse.Namespace) -> Relations | None:
    """Read the relations, limited to those at the stamps; return None if none were given."""
    from instant_ic.experiments.slam import read_relations, read_stamps
    from instant_ic.experiments.slam_logs import LogError

    relations = read_relations(args.relations) if args.relations else None
    if relations is not None and args.stamps:
        relations = relations.at_stamps(read_stamps(args.stamps))
        if len(relations) == 0:
            raise LogError(f"no relation in {args.relations} has both ends at a time in {args.stamps}")
    return relations


def evaluate_slam_sim(args: argparse.Namespace) -> int:
    """Run the SLAM on simulated round trips; print the figures."""
    from instant_ic.experiments.slam_sim import evaluate_round_trip, round_trip
    from instant_ic.sim.worlds import make_world

    check_files(args.json)
    reports: list[dict[str, Any]] = []
    with errors_for_the_user(), progress("round trips") as advance:
        world = make_world(args.world)
        for seed in range(args.seeds):
            report, _ = evaluate_round_trip(round_trip(world, args.slip, seed, args.rounds))
            reports.append({"seed": seed, **report})
            advance((seed + 1) / args.seeds)
    worst = {key: max(float(report[key]) for report in reports) for key in _WORST}
    print_figures({"world": args.world, "slip": args.slip, "worst": worst, "drives": reports}, args.json)
    return 0
