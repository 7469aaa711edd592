"""``ic experiment``: the paper's experiments (section V), as one report."""

from __future__ import annotations

import argparse
import math
import os
import shlex
import sys
import time
from pathlib import Path
from typing import Any

from instant_ic.cli.arguments import positive, positive_int, size
from instant_ic.cli.errors import UserError
from instant_ic.cli.evaluations import counted, errors_for_the_user, use_one_thread_for_matrices

_NAMES = ("reconstruction", "training-time", "ablation", "teleoperation", "operators", "environments", "all")


def add_parser(subparsers: Any) -> None:
    """Add ``experiment`` to the ``ic`` command."""
    parser = subparsers.add_parser(
        "experiment",
        help="repeat the paper's experiments and write a report",
        description=(
            "Repeat the experiments of the paper's section V in simulated worlds. Writes report.html, which needs no "
            "other file, and report.json to the output folder. Results of finished units are kept there: the same "
            "command resumes an interrupted run."
        ),
        epilog="example: ic experiment all --quick -o runs/experiments",
    )
    add = parser.add_argument
    add("name", choices=_NAMES, metavar="NAME", help=", ".join(_NAMES))
    add("-o", "--out", type=Path, required=True, metavar="REPORT", help="output folder")
    add("--seeds", type=positive_int, default=5, metavar="N", help="number of seeds (default: %(default)s)")
    add(
        "--world",
        action="append",
        default=[],
        metavar="W",
        help="corridor, random, long, a world with its seed (random:7), or a mesh file (.glb, ...); repeatable",
    )
    add("--method", choices=("ours", "paper"), default="ours", help="virtual space (default: %(default)s)")
    add(
        "--bag",
        type=Path,
        help="recording with /keyframe, for reconstruction and ablation: later panoramas are the truth",
    )
    add("--quick", action="store_true", help="two seeds, small images, short training: does everything work?")
    add("--size", type=_size, metavar="WxH", help="size of the views (default: 320x180)")
    text = "units in parallel (default: %(default)s)"
    add("--jobs", type=positive_int, default=os.cpu_count() or 1, metavar="N", help=text)
    add("--timeout", type=_limit, default=86400.0, metavar="S", help="time limit (default: %(default)g s)")
    parser.set_defaults(func=run)


def run(args: argparse.Namespace) -> int:
    """Run ``ic experiment``; return the exit status."""
    use_one_thread_for_matrices()
    with errors_for_the_user():
        return _experiment(args)


def _experiment(args: argparse.Namespace) -> int:
    from instant_ic.experiments import lab, report

    began = time.monotonic()
    names = list(lab.EXPERIMENTS) if args.name == "all" else [args.name]
    options = lab.Options(args.seeds, tuple(args.world), args.method, args.bag, args.quick, args.size)
    if args.bag is not None and not {*names} <= {"reconstruction", "ablation"}:
        raise UserError("--bag works with reconstruction and ablation only: the others need a world", 2)
    if args.bag is not None and args.world:
        raise UserError("--bag needs no world: leave out --world", 2)
    if args.bag is not None and args.method == "paper" and "reconstruction" in names:
        raise UserError("--bag works with --method paper in ablation only", 2)
    modules = {name: lab.module(name) for name in names}
    units = [unit for module in modules.values() for unit in module.units(options)]
    with counted("measuring", len(units)) as advance:

        def show_progress(result: lab.Result) -> None:
            how = f"failed: {result.error}" if result.error else f"{result.wall_s:.0f} s"
            advance(result.unit.experiment, f"{result.unit.experiment}, {result.unit.place}: {how}")

        results = lab.run(units, args.out / "units", args.jobs, show_progress, args.timeout)
    sections = {
        name: module.section([one for one in results if one.unit.experiment == name], options)
        for name, module in modules.items()
    }
    conditions = {
        "command": shlex.join(["ic", *sys.argv[1:]]),
        "date": time.strftime("%Y-%m-%d %H:%M UTC", time.gmtime()),
        "wall time of this run": f"{time.monotonic() - began:.0f} s",
        **lab.machine(),
    }
    report.write(args.out, sections, results, conditions)
    print(args.out / "report.html")
    failed = dict.fromkeys(f"{one.unit.experiment} {one.unit.place}: {one.error}" for one in results if one.error)
    for line in failed:
        print(f"ic: {line}", file=sys.stderr)
    return 1 if failed else 0


def _size(text: str) -> tuple[int, int]:
    width, height = size(text)
    if min(width, height) < 16:
        raise argparse.ArgumentTypeError(f"each side must be at least 16 pixels (got {text!r})")
    return width, height


def _limit(text: str) -> float:
    value = positive(text)
    if value == math.inf:
        raise argparse.ArgumentTypeError("must be finite")
    return value
