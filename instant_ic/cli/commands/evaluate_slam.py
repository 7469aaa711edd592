"""``ic evaluate slam``: SLAM on a laser log."""

from __future__ import annotations

import argparse
import json
import sys
import time
from pathlib import Path
from typing import TYPE_CHECKING, Any

from instant_ic.cli.errors import UserError

if TYPE_CHECKING:
    from instant_ic.experiments.slam import LogResult
    from instant_ic.slam.logs import LogEntry


def add_kind(kinds: Any) -> None:
    """Add ``slam`` to ``ic evaluate``."""
    parser = kinds.add_parser(
        "slam",
        help="run SLAM on a 2D laser log",
        description=(
            "Run the grid SLAM on a log as fast as possible. LOG is a CARMEN log (FLASER or ROBOTLASER1 lines, gzip or "
            "plain), a BreezySLAM exp*.dat, or a bag with LaserScan. Writes a folder with the final trajectory "
            "(trajectory.txt, one line 't x y yaw' per scan), the map (map.png) and the figures (figures.json), and "
            "prints the figures; with relations also the error against them."
        ),
        epilog="example: ic evaluate slam intel.log.gz --relations intel.relations --stamps intel.exact_stamps",
    )
    parser.add_argument("log", type=Path, metavar="LOG")
    parser.add_argument("--relations", type=Path, metavar="REL", help="reference relations: t1 t2 x y z roll pitch yaw")
    parser.add_argument("--stamps", type=Path, metavar="FILE", help="use only relations whose ends match these times")
    parser.add_argument(
        "--tolerance", type=float, default=0.006, metavar="S", help="tolerance of that match (default: %(default)g s)"
    )
    parser.add_argument(
        "--backend", choices=("graph", "rbpf"), default="graph", help="graph: grid SLAM; rbpf: particle filter"
    )
    parser.add_argument("--particles", type=int, default=30, metavar="N", help="of rbpf (default: %(default)d)")
    parser.add_argument("-o", "--output", type=Path, metavar="DIR", help="default: runs/slam_LOG_DATE_TIME")
    parser.add_argument("--json", type=Path, metavar="OUT", help="also write the figures here")
    parser.add_argument("--plot", type=Path, metavar="OUT.png", help="also write the map here")
    parser.add_argument("--trajectory", type=Path, metavar="FILE", help="also write the trajectory here")
    parser.add_argument("--strict", action="store_true", help="refuse a log with a line that cannot be read")
    parser.add_argument("--scan-topic", metavar="TOPIC", help="scan topic, for a bag with several")
    parser.add_argument("--params-file", type=Path, action="append", metavar="F", help="parameters of grid_slam")
    parser.add_argument(
        "-p", "--param", action="append", default=[], metavar="KEY:=VALUE", help="one parameter of grid_slam"
    )
    parser.add_argument("--no-odometry", action="store_true", help="ignore the log's odometry")
    parser.add_argument(
        "--perturb-odometry", type=int, metavar="SEED", help="degrade the odometry: 5 %% noise, 2 %% scale"
    )
    parser.add_argument(
        "--faults",
        nargs="?",
        const="all",
        metavar="NAME,...",
        help="put faults into the log instead (all, or the named ones): detection, recovery and false alarms by fault",
    )
    parser.add_argument(
        "--places", type=int, default=5, metavar="N", help="of --faults: places for each (default: %(default)d)"
    )
    parser.add_argument(
        "--seed", type=int, default=0, metavar="N", help="of --faults: chooses the places (default: %(default)d)"
    )
    parser.add_argument(
        "--noise-seeds", type=int, default=1, metavar="N",
        help="of --faults: runs of each fault over the whole log, the first without noise (default: %(default)d)",
    )  # fmt: skip
    parser.set_defaults(func=evaluate_slam)


def evaluate_slam(args: argparse.Namespace) -> int:
    """Run ``ic evaluate slam``; return the exit status."""
    from rich.console import Console
    from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeElapsedColumn

    from instant_ic.bag.replay import make_node
    from instant_ic.experiments.particle_slam import ParticleConfig
    from instant_ic.experiments.slam import (
        evaluate_log,
        perturb_odometry,
        read_relations,
        read_stamps,
        write_trajectory,
    )
    from instant_ic.experiments.slam_bag import is_bag, read_bag
    from instant_ic.experiments.slam_faults import FAULTS, evaluate_faults
    from instant_ic.slam.logs import BadLines, LogError, read_log

    if args.stamps and not args.relations:
        raise UserError("--stamps selects relations: give --relations too", 2)
    if not args.tolerance > 0:
        raise UserError(f"--tolerance must be > 0 (got {args.tolerance:g})", 2)
    if args.faults and args.backend != "graph":
        raise UserError("--faults needs --backend graph", 2)
    for name in ("places", "noise_seeds"):
        if getattr(args, name) < 1:
            raise UserError(f"--{name.replace('_', '-')} must be at least 1 (got {getattr(args, name)})", 2)
    if args.particles < 1:
        raise UserError(f"--particles must be at least 1 (got {args.particles})", 2)
    overrides = [f"grid_slam.{override}" for override in args.param]
    config = make_node("grid_slam", args.params_file or [], overrides).config
    particles = ParticleConfig(particles=args.particles) if args.backend == "rbpf" else None
    folder = args.output or Path(f"runs/slam_{_stem(args.log)}_{time.strftime('%Y%m%d_%H%M%S')}")
    for file in (args.json, args.plot, args.trajectory):
        if file is not None and not file.parent.is_dir():
            raise UserError(f"{file}: the folder {file.parent} does not exist", 2)
    console = Console(stderr=True)
    bad = None if args.strict else BadLines()
    try:
        relations = read_relations(args.relations) if args.relations else None
        if relations is not None and args.stamps:
            relations = relations.at_stamps(read_stamps(args.stamps), args.tolerance)
            if len(relations) == 0:
                raise LogError(f"no relation in {args.relations} has both ends at a time in {args.stamps}")
        columns = (
            TextColumn("{task.description}"),
            BarColumn(),
            MofNCompleteColumn(),
            TextColumn("scans"),
            TimeElapsedColumn(),
        )
        with Progress(*columns, console=console, disable=not console.is_terminal) as progress:
            task = progress.add_task(f"reading {args.log.name}", total=None)
            read = read_bag(args.log, args.scan_topic) if is_bag(args.log) else read_log(args.log, bad)
            entries: list[LogEntry] = list(read)
            progress.update(task, description=args.log.name, total=len(entries))
            if args.faults:
                faults = FAULTS if args.faults == "all" else tuple(args.faults.split(","))
                report = evaluate_faults(
                    entries, config, places=args.places, seed=args.seed, noise_seeds=args.noise_seeds,
                    relations=relations, faults=faults,
                    on_step=lambda name: progress.update(task, description=name),
                )  # fmt: skip
                return _write_faults(folder, {"log": args.log.name, "seed": args.seed, **report}, args.json)
            source = entries if args.perturb_odometry is None else perturb_odometry(entries, args.perturb_odometry)
            report, run = evaluate_log(
                source, relations, config, particles=particles, use_wheel_odom=not args.no_odometry,
                tolerance_s=args.tolerance, on_scan=lambda done: progress.update(task, completed=done),
            )  # fmt: skip
    except (LogError, OSError, ValueError) as error:
        raise UserError(f"evaluate slam: {error}") from None
    report = {"log": args.log.name, "backend": args.backend, **report, "output": str(folder)}
    if bad is not None:
        report["bad_lines"] = bad.count
        for line in bad.errors:
            console.print(f"left out: {line}", style="yellow", highlight=False, markup=False, soft_wrap=True)
        if bad.count > len(bad.errors):
            console.print(f"left out: {bad.count - len(bad.errors)} more lines", style="yellow", highlight=False)
    text = json.dumps(report, indent=2) + "\n"
    try:
        folder.mkdir(parents=True, exist_ok=True)
        for file in (folder / "trajectory.txt", args.trajectory):
            if file is not None:
                write_trajectory(file, run.trajectory)
        for file in (folder / "map.png", args.plot):
            if file is not None:
                _plot(file, run)
        for file in (folder / "figures.json", args.json):
            if file is not None:
                file.write_text(text)
    except OSError as error:
        raise UserError(f"evaluate slam: {error}") from None
    sys.stdout.write(text)
    return 0


def _write_faults(folder: Path, report: dict[str, object], json_file: Path | None) -> int:
    text = json.dumps({**report, "output": str(folder)}, indent=2) + "\n"
    try:
        folder.mkdir(parents=True, exist_ok=True)
        for file in (folder / "faults.json", json_file):
            if file is not None:
                file.write_text(text)
    except OSError as error:
        raise UserError(f"evaluate slam: {error}") from None
    sys.stdout.write(text)
    return 0


def _stem(log: Path) -> str:
    return log.resolve().name.removesuffix(".gz").rsplit(".", 1)[0]


def _plot(path: Path, run: LogResult) -> None:
    from instant_ic.experiments.pictures import save_map

    grid = run.slam.grid()
    save_map(
        path, grid.values, grid.resolution, (float(grid.origin[0]), float(grid.origin[1])),
        paths={"trajectory": run.trajectory[:, 1:]},
    )  # fmt: skip
