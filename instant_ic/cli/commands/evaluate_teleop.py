"""``ic evaluate teleop``: an operator who looks at goals only, through corridors with obstacles."""

from __future__ import annotations

import argparse
import json
import os
import sys
from pathlib import Path
from typing import Any


def add_kind(kinds: Any) -> None:
    """Adds ``teleop`` to ``ic evaluate``."""
    parser = kinds.add_parser(
        "teleop",
        help="an operator drives through corridors with hidden obstacles: illusory control, stopping, shared control",
        description=(
            "A scripted operator who looks at goals only drives a simulated robot through random corridors with boxes, "
            "posts and low things in the way. The whole stack runs in one process in simulated time: the nodes, their "
            "parameters and messages. Each course is driven by illusory control (ic), by a robot that stops at "
            "obstacles until the operator looks and steers round (stop), and by shared control that goes round by "
            "itself (shared). Tells contacts, obedience, switches and how far the picture jumps at them, time lost. "
            "The same seed gives the same drives."
        ),
        epilog="example: ic evaluate teleop --episodes 50 --seed 0 --json teleop.json --plot teleop.png",
    )
    parser.add_argument("--episodes", type=int, default=50, metavar="N", help="courses (default: %(default)s)")
    parser.add_argument("--seed", type=int, default=0, help="of the courses and all noise (default: %(default)s)")
    parser.add_argument(
        "--world",
        default="corridors",
        metavar="W",
        help="corridors (random ones); or one of the simulator's: corridor, random:SEED, a mesh file; there the "
        "operator drives straight on (default: %(default)s)",
    )
    parser.add_argument(
        "--methods", default="ic,stop,shared", metavar="M,M", help="ic, stop, shared (default: %(default)s)"
    )
    parser.add_argument(
        "--operator",
        choices=("scripted", "recorded"),
        default="scripted",
        help="recorded repeats the commands of --log, whatever they lead to (default: %(default)s)",
    )
    parser.add_argument(
        "--log", type=Path, metavar="FILE", help="bag with /operator/cmd_vel, or CSV: time_s,linear_m_s,angular_rad_s"
    )
    parser.add_argument(
        "--depth",
        choices=("fused", "lidar"),
        default="fused",
        help="what the virtual space's depth is made of: network and LiDAR, or the LiDAR alone (default: %(default)s)",
    )
    parser.add_argument(
        "-p",
        "--param",
        action="append",
        default=[],
        metavar="NODE.KEY:=VALUE",
        help="another parameter than the shipped one, as virtual_robot.vbot.ease_m_s:=0.05; may be repeated",
    )
    parser.add_argument(
        "--jobs", type=int, default=os.cpu_count() or 1, metavar="N", help="courses at a time (default: all cores)"
    )
    parser.add_argument("--json", type=Path, metavar="OUT", help="write all figures here")
    parser.add_argument("--plot", type=Path, metavar="OUT.png", help="write paths and bars by method here")
    parser.add_argument(
        "--video", type=Path, metavar="OUT.mp4", help="write the first course by the first method here, as a split view"
    )
    parser.add_argument("--timeout", type=float, default=7200.0, metavar="S", help="in all (default: %(default)g s)")
    parser.set_defaults(func=run)


def run(args: argparse.Namespace) -> int:
    """Runs ``ic evaluate teleop``; returns the exit status."""
    # Small matrices: threads of the linear algebra would only fight for the cores. Read when numpy is loaded.
    for name in ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS"):
        os.environ.setdefault(name, "1")
    from rich.console import Console

    console = Console(stderr=True)
    wrong = _wrong_usage(args)
    if wrong:
        console.print(f"ic evaluate teleop: {wrong}", style="red", markup=False)
        return 1
    try:
        return _evaluate(args, console)
    except (ValueError, RuntimeError, TimeoutError) as error:
        console.print(f"ic evaluate teleop: {error}", style="red", markup=False)
        return 1


def _wrong_usage(args: argparse.Namespace) -> str:
    """What is wrong with the words given; "" where nothing is."""
    for path in (args.json, args.plot, args.video):
        if path is not None and not path.parent.is_dir():
            return f"{path.parent} is no folder"
    if args.video is not None and args.video.suffix.lower() != ".mp4":
        return f"{args.video}: the video is an .mp4"
    if args.operator == "recorded" and args.log is None:
        return "--operator recorded needs --log: a bag, or a CSV file"
    if args.operator == "scripted" and args.log is not None:
        return "--log is for --operator recorded"
    return ""


def _evaluate(args: argparse.Namespace, console: Any) -> int:
    from rich.progress import (
        BarColumn,
        MofNCompleteColumn,
        Progress,
        TextColumn,
        TimeElapsedColumn,
        TimeRemainingColumn,
    )

    from ...evaluation import teleop

    methods = tuple(name.strip() for name in args.methods.split(",") if name.strip())
    settings = teleop.Settings(
        args.episodes, args.seed, args.world, methods, args.depth, args.log, overrides=tuple(args.param)
    )
    columns = (TextColumn("{task.description}"), BarColumn(), MofNCompleteColumn(), TimeElapsedColumn())
    contacts = 0
    with Progress(*columns, TimeRemainingColumn(), console=console) as progress:
        task = progress.add_task("starting", total=settings.episodes)
        so_far: list[teleop.Drive] = []

        def tell(drives: list[teleop.Drive]) -> None:
            nonlocal contacts
            so_far.extend(drives)
            if args.json:  # a run that is cut short leaves what it has
                args.json.write_text(json.dumps(teleop.report(so_far, settings), indent=2) + "\n")
            contacts += sum(drive.contacts for drive in drives)
            progress.update(task, advance=1, description=f"driving, {contacts} contacts")
            if not console.is_terminal:
                words = ", ".join(
                    f"{d.method} {'completed' if d.completed else d.reason or 'given up'}" for d in drives
                )
                console.print(f"episode {drives[0].index}: {words}", markup=False)

        drives = teleop.evaluate(settings, args.jobs, tell, args.timeout)
    figures = teleop.report(drives, settings)
    if args.json:
        args.json.write_text(json.dumps(figures, indent=2) + "\n")
    if args.plot or args.video:
        from ...evaluation.teleop_plot import Video, save_plot

        if args.plot:
            save_plot(args.plot, drives, figures, settings)
        if args.video:
            with Video(args.video) as video, console.status("drawing the video"):
                teleop.run_episode(settings, 0, video.on_step, methods[:1])
    each = figures.pop("each")
    sys.stdout.write(json.dumps(figures, indent=2) + "\n")
    for row in each:
        if row["contacts"] or not row["completed"]:
            console.print(
                f"episode {row['index']}, {row['method']}: {row['contacts']} contacts, "
                f"{'completed' if row['completed'] else 'not completed: ' + (row['reason'] or 'given up')}",
                markup=False,
            )
    return 0
