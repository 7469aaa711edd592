"""``ic evaluate teleop``: a simulated operator who sees only goals drives through corridors with obstacles."""

from __future__ import annotations

import argparse
import os
import sys
from typing import Any

from instant_ic.cli.arguments import verb
from instant_ic.cli.evaluations import (
    add_options,
    add_stack_options,
    check_outputs,
    counted,
    errors_for_the_user,
    print_figures,
    use_one_thread_for_matrices,
)


def add_kind(kinds: Any) -> None:
    parser = verb(
        kinds, "teleop", "simulate an operator in corridors with hidden obstacles: illusory control, stopping", run,
        "ic evaluate teleop --episodes 50 --seed 0 --json teleop.json --plot teleop.png",
        "A scripted operator who only sees goals drives a simulated robot through random corridors with boxes, "
        "posts and low obstacles. All nodes run in one process in simulated time, with their parameters and "
        "messages. Each course is driven with illusory control (ic), and with a robot that stops at obstacles until "
        "the operator looks and steers around them (stop). Reports contacts, obedience, switches, image jumps at "
        "switches, and lost time. The same seed gives the same drives.",
    )  # fmt: skip
    add_options(parser, 50, os.cpu_count() or 1, 7200.0, "the paths of the worst courses")
    worlds = "corridors (random), or a world of the simulator or a mesh file, where the operator drives straight on"
    add_stack_options(parser, worlds, "virtual_robot.vbot.ease_m_s:=0.05")
    add = parser.add_argument
    add("--methods", default="ic,stop", metavar="M,M", help="ic, stop (default: %(default)s)")
    text = "depth source of the virtual space (docs/depth.md; default: %(default)s)"
    add("--depth", choices=("completed", "fused", "lidar"), default="completed", help=text)


def run(args: argparse.Namespace) -> int:
    use_one_thread_for_matrices()
    check_outputs(args)
    with errors_for_the_user():
        return _evaluate(args)


def _evaluate(args: argparse.Namespace) -> int:
    from instant_ic.experiments import teleop
    from instant_ic.experiments.results import save_json

    methods = tuple(name.strip() for name in args.methods.split(",") if name.strip())
    settings = teleop.TeleopSettings(
        args.episodes, args.seed, args.world, methods, args.depth, overrides=tuple(args.param)
    )
    with counted("driving", settings.episodes * len(methods)) as advance:

        def show_progress(drive: teleop.TeleopDrive) -> None:
            how = "completed" if drive.completed else f"not completed: {drive.reason or 'given up'}"
            advance("driving", f"episode {drive.index}, {drive.method}: {drive.contacts} contacts, {how}")

        drives = teleop.evaluate(settings, args.jobs, show_progress, args.timeout)
    figures = teleop.report(drives, settings)
    if args.json:
        save_json(args.json, figures)
    if args.plot:
        from instant_ic.experiments.teleop_plot import save_plot

        save_plot(args.plot, drives, settings)
    for row in figures.pop("each"):
        if row["contacts"] or not row["completed"]:
            print(
                f"episode {row['index']}, {row['method']}: {row['contacts']} contacts, completed: {row['completed']}",
                file=sys.stderr,
            )
    print_figures(figures)
    return 0
