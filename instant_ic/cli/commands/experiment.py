"""``ic experiment``: the paper's experiments (section V), as one report."""

from __future__ import annotations

import argparse
import os
import shlex
import sys
import time
from pathlib import Path
from typing import Any

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
    add("--seeds", type=int, default=5, metavar="N", help="number of seeds (default: %(default)s)")
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
    add("--size", metavar="WxH", help="size of the views (default: 320x180)")
    add("--jobs", type=int, default=os.cpu_count() or 1, metavar="N", help="units in parallel (default: %(default)s)")
    add("--timeout", type=float, default=86400.0, metavar="S", help="time limit (default: %(default)g s)")
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
    size = _size(args.size) if args.size else None
    options = lab.Options(args.seeds, tuple(args.world), args.method, args.bag, args.quick, size)
    if args.bag is not None and not {*names} <= {"reconstruction", "ablation"}:
        raise UserError("--bag works with reconstruction and ablation only: the others need a world", 2)
    modules = {name: lab.module(name) for name in names}
    units = [unit for module in modules.values() for unit in module.units(options)]
    with counted("measuring", len(units)) as advance:

        def show_progress(result: lab.Result) -> None:
            world = result.unit.arguments.get("world", "")
            how = f"failed: {result.error}" if result.error else f"{result.wall_s:.0f} s"
            advance(result.unit.experiment, f"{result.unit.experiment}, {world}: {how}")

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
    failed = [one for one in results if one.error]
    for one in failed:
        print(f"ic: {one.unit.experiment} {one.unit.arguments.get('world', '')}: {one.error}", file=sys.stderr)
    return 1 if failed else 0


def _size(text: str) -> tuple[int, int]:
    width, _, height = text.partition("x")
    if not (width.isdigit() and height.isdigit() and min(int(width), int(height)) >= 16):
        raise UserError(f"--size must be WIDTHxHEIGHT in pixels, each at least 16 (got {text!r})", 2)
    return int(width), int(height)
