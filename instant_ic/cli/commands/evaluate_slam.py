"""``ic evaluate slam``: SLAM on a laser log."""

from __future__ import annotations

import argparse
import sys
import time
from pathlib import Path
from typing import TYPE_CHECKING, Any

from instant_ic.cli.arguments import check_files, positive, positive_int, verb
from instant_ic.cli.errors import UserError
from instant_ic.cli.evaluations import errors_for_the_user, print_figures
from instant_ic.cli.progress import progress
from instant_ic.util.safe_text import direct

if TYPE_CHECKING:
    from instant_ic.experiments.slam import LogResult, Relations
    from instant_ic.experiments.slam_logs import LogEntry


def add_kind(kinds: Any) -> None:
    add = verb(
        kinds, "slam", "run SLAM on a 2D laser log", evaluate_slam,
        "ic evaluate slam intel.log.gz --relations intel.relations --stamps intel.exact_stamps",
        "Run the grid SLAM on a log as fast as possible. LOG is a CARMEN log (FLASER or ROBOTLASER1 lines, gzip or "
        "plain), a BreezySLAM exp*.dat, or a bag with LaserScan. Writes a folder with the final trajectory "
        "(trajectory.txt, one line 't x y yaw' per scan), the map (map.png) and the figures (figures.json), and "
        "prints the figures; with relations also the error against them.",
    ).add_argument  # fmt: skip
    count: dict[str, Any] = {"type": positive_int, "metavar": "N"}
    add("log", type=Path, metavar="LOG")
    add("--relations", type=Path, metavar="REL", help="reference relations: t1 t2 x y z roll pitch yaw")
    add("--stamps", type=Path, metavar="FILE", help="use only relations whose ends match these times")
    add(
        "--tolerance",
        type=positive,
        default=0.006,
        metavar="S",
        help="tolerance of that match (default: %(default)g s)",
    )
    add("-o", "--output", type=Path, metavar="DIR", help="default: runs/slam_LOG_DATE_TIME")
    add("--json", type=Path, metavar="OUT", help="also write the figures here")
    add("--plot", type=Path, metavar="OUT.png", help="also write the map here")
    add("--strict", action="store_true", help="refuse a log with a line that cannot be read")
    add("--scan-topic", metavar="TOPIC", help="scan topic, for a bag with several")
    add("--params-file", type=Path, action="append", metavar="F", help="parameters of grid_slam")
    text = "one parameter of grid_slam"
    add("-p", "--param", action="append", default=[], metavar="KEY:=VALUE", help=text)
    add("--no-odometry", action="store_true", help="ignore the log's odometry")
    text = "degrade the odometry: 5 %% noise, 2 %% scale"
    add("--perturb-odometry", type=int, metavar="SEED", help=text)
    text = "put faults into the log instead (all, or the named ones): detection, recovery and false alarms by fault"
    add("--faults", nargs="?", const="all", metavar="NAME,...", help=text)
    add("--places", **count, default=5, help="of --faults: places for each (default: %(default)d)")
    add("--seed", type=int, default=0, metavar="N", help="of --faults: chooses the places (default: %(default)d)")
    text = "of --faults: runs of each fault over the whole log, the first without noise (default: %(default)d)"
    add("--noise-seeds", **count, default=1, help=text)


def evaluate_slam(args: argparse.Namespace) -> int:
    from instant_ic.bag.replay import make_node
    from instant_ic.experiments.slam import evaluate_log, perturb_odometry, write_trajectory
    from instant_ic.experiments.slam_bag import is_bag, read_bag
    from instant_ic.experiments.slam_logs import BadLines, read_log

    if args.stamps and not args.relations:
        raise UserError("--stamps selects relations: give --relations too", 2)
    overrides = [f"grid_slam.{override}" for override in args.param]
    config = make_node("grid_slam", args.params_file or [], overrides).config
    stem = args.log.resolve().name.removesuffix(".gz").rsplit(".", 1)[0]
    folder = args.output or Path(f"runs/slam_{stem}_{time.strftime('%Y%m%d_%H%M%S')}")
    check_files(args.json, args.plot)
    bad = None if args.strict else BadLines()
    with errors_for_the_user():
        relations = _relations(args)
        entries: list[LogEntry] = list(
            read_bag(args.log, args.scan_topic) if is_bag(args.log) else read_log(args.log, bad)
        )
        folder.mkdir(parents=True, exist_ok=True)
        if args.faults:
            return _evaluate_faults(args, entries, relations, config, folder)
        source = entries if args.perturb_odometry is None else perturb_odometry(entries, args.perturb_odometry)
        with progress(args.log.name) as advance:
            report, run = evaluate_log(
                source, relations, config, use_wheel_odom=not args.no_odometry,
                tolerance_s=args.tolerance, on_scan=lambda done: advance(done / len(entries)),
            )  # fmt: skip
    report = {"log": args.log.name, **report, "output": str(folder)}
    if bad is not None:
        report["bad_lines"] = bad.count
        for line in bad.errors:
            print(f"left out: {line}", file=sys.stderr)
        if bad.count > len(bad.errors):
            print(f"left out: {bad.count - len(bad.errors)} more lines", file=sys.stderr)
    write_trajectory(folder / "trajectory.txt", run.trajectory)
    for file in (folder / "map.png", args.plot):
        if file is not None:
            _plot(file, run)
    print_figures(report, folder / "figures.json", args.json)
    return 0


def _relations(args: argparse.Namespace) -> Relations | None:
    """Read the relations, limited to those at the stamps; None if none were given."""
    from instant_ic.experiments.slam import read_relations, read_stamps
    from instant_ic.experiments.slam_logs import LogError

    relations = read_relations(args.relations) if args.relations else None
    if relations is not None and args.stamps:
        relations = relations.at_stamps(read_stamps(args.stamps), args.tolerance)
        if len(relations) == 0:
            raise LogError(f"no relation in {args.relations} has both ends at a time in {args.stamps}")
    return relations


def _evaluate_faults(
    args: argparse.Namespace, entries: list[LogEntry], relations: Relations | None, config: Any, folder: Path
) -> int:
    """Run ``--faults`` and print its figures."""
    from rich.console import Console

    from instant_ic.experiments.slam_faults import FAULTS, evaluate_faults

    faults = FAULTS if args.faults == "all" else tuple(args.faults.split(","))
    with Console(file=direct(sys.stderr)).status("") as status:
        report = evaluate_faults(
            entries, config, places=args.places, seed=args.seed, noise_seeds=args.noise_seeds,
            relations=relations, faults=faults, on_step=status.update,
        )  # fmt: skip
    report = {"log": args.log.name, "seed": args.seed, **report, "output": str(folder)}
    print_figures(report, folder / "faults.json", args.json)
    return 0


def _plot(path: Path, run: LogResult) -> None:
    from instant_ic.experiments.plots import save_map

    grid = run.slam.grid()
    save_map(
        path, grid.values, grid.resolution, (float(grid.origin[0]), float(grid.origin[1])),
        paths={"trajectory": run.trajectory[:, 1:]},
    )  # fmt: skip
