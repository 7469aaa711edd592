"""``ic experiment``: the paper's experiments (section V), as one report."""

from __future__ import annotations

import argparse
import math
import os
import shlex
import sys
import time
from collections import Counter
from pathlib import Path
from typing import TYPE_CHECKING, Any

from instant_ic.cli.arguments import positive, positive_int, verb
from instant_ic.cli.errors import UserError
from instant_ic.cli.evaluations import errors_for_the_user, use_one_thread_for_matrices
from instant_ic.cli.progress import progress

if TYPE_CHECKING:
    from instant_ic.experiments import lab

_NAMES = ("reconstruction", "training-time", "ablation", "teleoperation", "operators", "environments", "all")
_MESHES = (".glb", ".gltf", ".obj", ".ply")


def add_parser(subparsers: Any) -> None:
    add = verb(
        subparsers, "experiment", "repeat the paper's experiments and write a report", run,
        "ic experiment all --quick -o runs/experiments",
        "Repeat the experiments of the paper's section V in simulated worlds. Writes report.html, which needs no "
        "other file, and report.json to the output folder. Results of finished units are kept there: the same "
        "command resumes an interrupted run.",
    ).add_argument  # fmt: skip
    add("name", choices=_NAMES, metavar="NAME", help=", ".join(_NAMES))
    add("-o", "--out", type=Path, required=True, metavar="REPORT", help="output folder")
    add("--seeds", type=positive_int, default=5, metavar="N", help="number of seeds (default: %(default)s)")
    text = "corridor, random, long, hall, furnished, crossing, windows, one of them with its seed (random:7), "
    add("--world", action="append", default=[], metavar="W", help=text + "or a mesh file (.glb, ...); repeatable")
    add("--method", choices=("ours", "paper"), default="ours", help="virtual space (default: %(default)s)")
    text = "recording to use instead of worlds (not for operators): later panoramas are the truth"
    add("--bag", type=Path, help=text)
    add("--meshes", type=Path, metavar="DIR", help="environments: also the meshes of this folder")
    add("--quick", action="store_true", help="two seeds, small images and short training, to check that all works")
    text = "units in parallel (default: %(default)s)"
    add("--jobs", type=positive_int, default=os.cpu_count() or 1, metavar="N", help=text)
    add("--timeout", type=_limit, default=86400.0, metavar="S", help="limit for all units (default: %(default)g s)")
    text = "limit for one unit, which is then ended (default: %(default)g s)"
    add("--unit-timeout", type=_limit, default=1800.0, metavar="S", help=text)


def run(args: argparse.Namespace) -> int:
    use_one_thread_for_matrices()
    with errors_for_the_user():
        return _experiment(args)


def _experiment(args: argparse.Namespace) -> int:
    from instant_ic.experiments import lab, report

    began, folder = time.monotonic(), args.out / "units"
    names = list(lab.EXPERIMENTS) if args.name == "all" else [args.name]
    if args.bag is not None and args.name == "all":
        names.remove("operators")
    options = _options(args)
    modules = {name: lab.module(name) for name in names}
    units = [unit for module in modules.values() for unit in module.units(options)]
    found = lab.kept(units, folder)
    conditions = {
        "command": shlex.join(["ic", *sys.argv[1:]]),
        "date": time.strftime("%Y-%m-%d %H:%M UTC", time.gmtime()),
        "measured now": f"{len(units) - len(found)} of {len(units)} units, {args.jobs} in parallel",
        **({"left out": "operators: a recorded robot does not react to another operator"} if args.bag else {}),
        **lab.machine(),
    }
    print(conditions["measured now"], file=sys.stderr, flush=True)

    def write(results: list[lab.Result]) -> None:
        sections = {
            name: module.section([one for one in results if one.unit.experiment == name], options)
            for name, module in modules.items()
        }
        conditions["wall time of this run"] = f"{time.monotonic() - began:.0f} s"
        report.write(args.out, sections, results, conditions)

    folder.mkdir(parents=True, exist_ok=True)
    write(found)  # the results so far, before hours of work
    with progress("measuring") as show:
        done = 0

        def show_progress(result: lab.Result) -> None:
            nonlocal done
            done += 1
            how = f"failed: {result.error}" if result.error else f"{result.wall_s:.0f} s"
            share = done / (len(units) - len(found))
            if sys.stderr.isatty():
                show(share, result.unit.experiment)
            else:
                line = f"{result.unit.experiment}, {result.unit.place}: {how}; {share:.0%}"
                print(line, file=sys.stderr, flush=True)

        results = lab.run(units, folder, args.jobs, show_progress, args.timeout, args.unit_timeout)
    write(results)
    print(args.out / "report.html")
    failed = Counter(f"{one.unit.experiment} {one.unit.place}: {one.error}" for one in results if one.error)
    for line, count in failed.items():
        print(f"ic: {line}{f' ({count} units)' if count > 1 else ''}", file=sys.stderr)
    return 1 if failed else 0


def _options(args: argparse.Namespace) -> lab.Options:
    from instant_ic.experiments import lab

    if args.bag is not None and (args.world or args.meshes):
        raise UserError("--bag needs no world: leave out --world and --meshes", 2)
    if args.bag is not None and args.method == "paper":
        raise UserError("--bag: --method paper needs unscaled depth, which a recording lacks. Leave out --method", 2)
    meshes = []
    if args.meshes is not None:
        meshes = sorted(str(path) for path in args.meshes.glob("*") if path.suffix.lower() in _MESHES)
        if not meshes:
            raise UserError(f"--meshes: {args.meshes} has no mesh ({', '.join(_MESHES)})", 2)
    return lab.Options(args.seeds, tuple(args.world), args.method, args.bag, args.quick, tuple(meshes))


def _limit(text: str) -> float:
    value = positive(text)
    if value == math.inf:
        raise argparse.ArgumentTypeError("must be finite")
    return value
