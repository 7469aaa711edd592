"""``ic evaluate teleop``: a simulated operator, who only sees goals, drives corridors with obstacles."""

from __future__ import annotations

import argparse
import os
import sys
from pathlib import Path
from typing import Any

from instant_ic.cli.arguments import verb
from instant_ic.cli.errors import UserError
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
        kinds, "teleop",
        "simulate an operator in corridors with hidden obstacles: illusory control, stopping, shared control", run,
        "ic evaluate teleop --episodes 50 --seed 0 --json teleop.json --plot teleop.png",
        "A scripted operator who only sees goals drives a simulated robot through random corridors with boxes, "
        "posts and low obstacles. All nodes run in one process in simulated time, with their parameters and "
        "messages. Each course is driven with illusory control (ic), with a robot that stops at obstacles until "
        "the operator looks and steers around them (stop), and with shared control that avoids them by itself "
        "(shared). Reports contacts, obedience, switches, image jumps at switches, and lost time. "
        "The same seed gives the same drives.",
    )  # fmt: skip
    add_options(parser, 50, os.cpu_count() or 1, 7200.0, "paths, and bars by method,")
    worlds = (
        "corridors (random), or a world of the simulator: corridor, where the operator drives straight on, "
        "random:SEED or a mesh file, where the operator drives to random visible places"
    )
    add_stack_options(parser, worlds, "virtual_robot.vbot.ease_m_s:=0.05")
    add = parser.add_argument
    add("--methods", default="ic,stop,shared", metavar="M,M", help="ic, stop, shared (default: %(default)s)")
    text = "recorded replays the commands of --log regardless of their effect (default: %(default)s)"
    add("--operator", choices=("scripted", "recorded"), default="scripted", help=text)
    text = "bag with /operator/cmd_vel, or CSV: time_s,linear_m_s,angular_rad_s"
    add("--log", type=Path, metavar="FILE", help=text)
    text = "depth source of the virtual space (docs/depth.md; default: %(default)s)"
    add("--depth", choices=("completed", "fused", "lidar"), default="completed", help=text)
    add("--resume", action="store_true", help="keep the drives in --json and run only the missing ones")
    text = "write a split-view video of the first course and method here"
    add("--video", type=Path, metavar="OUT.mp4", help=text)


def run(args: argparse.Namespace) -> int:
    use_one_thread_for_matrices()
    check_outputs(args, video=".mp4")
    if args.operator == "recorded" and args.log is None:
        raise UserError("--operator recorded needs --log: a bag or a CSV file")
    if args.operator == "scripted" and args.log is not None:
        raise UserError("--log needs --operator recorded")
    if args.resume and args.json is None:
        raise UserError("--resume needs --json: the file written by the earlier run")
    with errors_for_the_user():
        return _evaluate(args)


def _evaluate(args: argparse.Namespace) -> int:
    from instant_ic.experiments import teleop, teleop_results

    methods = tuple(name.strip() for name in args.methods.split(",") if name.strip())
    settings = teleop.TeleopSettings(
        args.episodes, args.seed, args.world, methods, args.depth, args.log, overrides=tuple(args.param)
    )
    drives: list[teleop.Drive] = []
    if args.resume and args.json.exists():
        drives = teleop_results.load(args.json, settings)
    status = _drive_all(args, settings, drives)
    if not drives:
        return status
    drives = teleop_results.in_order(drives)
    figures = teleop_results.report(drives, settings)
    if args.plot:
        from instant_ic.experiments.teleop_plot import save_plot

        save_plot(args.plot, drives, figures, settings)
    if args.video and not status:
        from instant_ic.experiments.teleop_plot import Video

        with Video(args.video) as video:
            teleop.run_episode(settings, 0, video.on_step, methods[:1])
    each = figures.pop("each")
    print_figures(figures)
    for row in each:
        if row["contacts"] or not row["completed"]:
            how = _how(row["completed"], row["reason"])
            print(f"episode {row['index']}, {row['method']}: {row['contacts']} contacts, {how}", file=sys.stderr)
    return status


def _how(completed: bool, reason: str) -> str:
    return "completed" if completed else f"not completed: {reason or 'given up'}"


def _drive_all(args: argparse.Namespace, settings: Any, drives: list[Any]) -> int:
    """Run the missing drives; return the exit status. Finished drives are kept however the run ends."""
    from instant_ic.experiments import teleop, teleop_results

    planned = settings.episodes * len(settings.methods)
    status, why = 0, ""
    with counted("driving", planned - len(drives)) as advance:

        def show_progress(drive: teleop.Drive) -> None:
            drives.append(drive)
            if args.json:
                teleop_results.save(args.json, teleop_results.in_order(drives), settings)
            contacts = sum(drive.contacts for drive in drives)
            how = _how(drive.completed, drive.reason)
            advance(f"driving, {contacts} contacts", f"episode {drive.index}, {drive.method}: {how}")

        try:
            teleop.evaluate(settings, args.jobs, show_progress, args.timeout, tuple(drives))
        except (ValueError, RuntimeError, TimeoutError) as error:
            if not drives:
                raise
            status, why = 1, str(error)
        except KeyboardInterrupt:
            status, why = 130, "interrupted"
    if status:
        kept = f"; they are saved in {args.json}, continue with --resume" if args.json and drives else ""
        print(f"ic: {why}; {len(drives)} of {planned} drives are done{kept}", file=sys.stderr)
    return status
