"""``ic evaluate teleop``: a simulated operator, who only sees goals, drives corridors with obstacles."""

from __future__ import annotations

import argparse
import contextlib
import json
import os
import signal
import sys
import threading
from collections.abc import Iterator
from pathlib import Path
from typing import Any


def add_kind(kinds: Any) -> None:
    """Add ``teleop`` to ``ic evaluate``."""
    parser = kinds.add_parser(
        "teleop",
        help="simulate an operator in corridors with hidden obstacles: illusory control, stopping, shared control",
        description=(
            "A scripted operator who only sees goals drives a simulated robot through random corridors with boxes, "
            "posts and low obstacles. All nodes run in one process in simulated time, with their parameters and "
            "messages. Each course is driven with illusory control (ic), with a robot that stops at obstacles until "
            "the operator looks and steers around them (stop), and with shared control that avoids them by itself "
            "(shared). Reports contacts, obedience, switches, image jumps at switches, and lost time. "
            "The same seed gives the same drives."
        ),
        epilog="example: ic evaluate teleop --episodes 50 --seed 0 --json teleop.json --plot teleop.png",
    )
    parser.add_argument(
        "--episodes", type=int, default=50, metavar="N", help="number of courses (default: %(default)s)"
    )
    parser.add_argument("--seed", type=int, default=0, help="seed of the courses and all noise (default: %(default)s)")
    parser.add_argument(
        "--world",
        default="corridors",
        metavar="W",
        help="corridors (random), or a world of the simulator: corridor, where the operator drives straight on, "
        "random:SEED or a mesh file, where the operator drives to random visible places (default: %(default)s)",
    )
    parser.add_argument(
        "--methods", default="ic,stop,shared", metavar="M,M", help="ic, stop, shared (default: %(default)s)"
    )
    parser.add_argument(
        "--operator",
        choices=("scripted", "recorded"),
        default="scripted",
        help="recorded replays the commands of --log regardless of their effect (default: %(default)s)",
    )
    parser.add_argument(
        "--log", type=Path, metavar="FILE", help="bag with /operator/cmd_vel, or CSV: time_s,linear_m_s,angular_rad_s"
    )
    parser.add_argument(
        "--depth",
        choices=("fused", "lidar"),
        default="fused",
        help="depth source of the virtual space: network and LiDAR, or LiDAR only (default: %(default)s)",
    )
    parser.add_argument(
        "-p",
        "--param",
        action="append",
        default=[],
        metavar="NODE.KEY:=VALUE",
        help="override a parameter, for example virtual_robot.vbot.ease_m_s:=0.05; repeatable",
    )
    parser.add_argument(
        "--jobs", type=int, default=os.cpu_count() or 1, metavar="N", help="drives in parallel (default: all cores)"
    )
    parser.add_argument("--json", type=Path, metavar="OUT", help="write all figures here, updated after each drive")
    parser.add_argument("--resume", action="store_true", help="keep the drives in --json and run only the missing ones")
    parser.add_argument("--plot", type=Path, metavar="OUT.png", help="plot paths, and bars by method, here")
    parser.add_argument(
        "--video", type=Path, metavar="OUT.mp4", help="write a split-view video of the first course and method here"
    )
    parser.add_argument(
        "--timeout", type=float, default=7200.0, metavar="S", help="time limit (default: %(default)g s)"
    )
    parser.set_defaults(func=run)


def run(args: argparse.Namespace) -> int:
    """Run ``ic evaluate teleop``; return the exit status."""
    # The matrices are small: threads of the linear algebra would only compete for cores. Read when numpy loads.
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
    """Text of the error in the arguments; empty where there is none."""
    for path in (args.json, args.plot, args.video):
        if path is not None and not path.parent.is_dir():
            return f"the folder {path.parent} does not exist"
    if args.video is not None and args.video.suffix.lower() != ".mp4":
        return f"{args.video}: the name must end in .mp4"
    if args.operator == "recorded" and args.log is None:
        return "--operator recorded needs --log: a bag or a CSV file"
    if args.operator == "scripted" and args.log is not None:
        return "--log needs --operator recorded"
    if args.resume and args.json is None:
        return "--resume needs --json: the file written by the earlier run"
    return ""


def _evaluate(args: argparse.Namespace, console: Any) -> int:
    from instant_ic.experiments import teleop, teleop_results

    methods = tuple(name.strip() for name in args.methods.split(",") if name.strip())
    settings = teleop.TeleopSettings(
        args.episodes, args.seed, args.world, methods, args.depth, args.log, overrides=tuple(args.param)
    )
    drives: list[teleop.Drive] = []
    if args.resume and args.json.exists():
        drives = teleop_results.load(args.json, settings)
    status = _drive_all(args, console, settings, drives)
    if not drives:
        return status
    drives = teleop_results.in_order(drives)
    figures = teleop_results.report(drives, settings)
    if args.plot:
        from instant_ic.experiments.teleop_plot import save_plot

        save_plot(args.plot, drives, figures, settings)
    if args.video and not status:
        from instant_ic.experiments.teleop_plot import Video

        with Video(args.video) as video, console.status("rendering the video"):
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
    return status


def _drive_all(args: argparse.Namespace, console: Any, settings: Any, drives: list[Any]) -> int:
    """Run the missing drives; return the exit status. Finished drives are kept however the run ends."""
    from rich.progress import (
        BarColumn,
        MofNCompleteColumn,
        Progress,
        TextColumn,
        TimeElapsedColumn,
        TimeRemainingColumn,
    )

    from instant_ic.experiments import teleop, teleop_results

    planned, known = settings.episodes * len(settings.methods), len(drives)
    columns = (TextColumn("{task.description}"), BarColumn(), MofNCompleteColumn(), TimeElapsedColumn())
    status, words = 0, ""
    # A drive takes minutes on a slow core: estimate the remaining time from all drives, not from the last 30 s.
    day_s = 86400.0
    with Progress(*columns, TimeRemainingColumn(), console=console, speed_estimate_period=day_s) as progress:
        task = progress.add_task("driving", total=planned - known)

        def show_progress(drive: teleop.Drive) -> None:
            drives.append(drive)
            if args.json:
                teleop_results.save(args.json, teleop_results.in_order(drives), settings)
            contacts = sum(drive.contacts for drive in drives)
            progress.update(task, advance=1, description=f"driving, {contacts} contacts")
            if not console.is_terminal:
                how = "completed" if drive.completed else f"not completed: {drive.reason or 'given up'}"
                console.print(f"episode {drive.index}, {drive.method}: {how}", markup=False)

        try:
            with _stopped_by_sigterm():
                teleop.evaluate(settings, args.jobs, show_progress, args.timeout, tuple(drives))
        except (ValueError, RuntimeError, TimeoutError) as error:
            if not drives:
                raise
            status, words = 1, str(error)
        except KeyboardInterrupt:
            status, words = 130, "interrupted"
    if status:
        kept = f"; they are saved in {args.json}, continue with --resume" if args.json and drives else ""
        words = f"ic evaluate teleop: {words}; {len(drives)} of {planned} drives are done{kept}"
        console.print(words, style="red", markup=False)
    return status


@contextlib.contextmanager
def _stopped_by_sigterm() -> Iterator[None]:
    """Make SIGTERM end the drives as Ctrl-C does."""

    def stop(number: int, frame: Any) -> None:
        raise KeyboardInterrupt

    if threading.current_thread() is not threading.main_thread():
        yield
        return
    before = signal.signal(signal.SIGTERM, stop)
    try:
        yield
    finally:
        signal.signal(signal.SIGTERM, before)
