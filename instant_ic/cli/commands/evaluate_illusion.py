"""``ic evaluate illusion``: compare what the operator sees inside and behind an obstacle with the truth."""

from __future__ import annotations

import argparse
import json
import os
import sys
from pathlib import Path
from typing import Any


def add_kind(kinds: Any) -> None:
    """Add ``illusion`` to ``ic evaluate``."""
    parser = kinds.add_parser(
        "illusion",
        help="compare the operator's view inside and behind obstacles with the truth",
        description=(
            "The drive of ic evaluate teleop with illusory control. Every frame in which the page shows the virtual "
            "space is composed as on the page and compared with the simulator's image from the same pose: with the "
            "obstacle before its near face, without it from there on. The same frames are also composed with true "
            "depth, and with true depth and exact fill of unseen places. Reports PSNR, SSIM, unseen share, floor shown "
            "as fog, and the error of the expected PSNR. The same seed gives the same figures."
        ),
        epilog="example: ic evaluate illusion --episodes 4 --json illusion.json --strip strip.png --plot plot.png",
    )
    parser.add_argument(
        "--episodes", type=int, default=20, metavar="N", help="number of courses (default: %(default)s)"
    )
    parser.add_argument("--seed", type=int, default=0, help="seed of the courses and all noise (default: %(default)s)")
    parser.add_argument(
        "--world",
        default="corridors",
        metavar="W",
        help="as ic evaluate teleop: corridors (random), corridor, random:SEED, or a mesh file (default: %(default)s)",
    )
    parser.add_argument(
        "-p",
        "--param",
        action="append",
        default=[],
        metavar="NODE.KEY:=VALUE",
        help="override a parameter, for example nerf.space.keyframes:=1; repeatable",
    )
    parser.add_argument("--jobs", type=int, default=1, metavar="N", help="episodes in parallel (default: %(default)s)")
    parser.add_argument("--json", type=Path, metavar="OUT", help="write all figures and each frame's here")
    parser.add_argument("--strip", type=Path, metavar="OUT.png", help="write rows of frames by distance here")
    parser.add_argument("--plot", type=Path, metavar="OUT.png", help="plot PSNR by distance, and expected PSNR, here")
    parser.add_argument(
        "--timeout", type=float, default=7200.0, metavar="S", help="time limit (default: %(default)g s)"
    )
    parser.set_defaults(func=run)


def run(args: argparse.Namespace) -> int:
    """Run ``ic evaluate illusion``; return the exit status."""
    # The matrices are small: threads of the linear algebra would only compete for cores. Read when numpy loads.
    for name in ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS"):
        os.environ.setdefault(name, "1")
    from rich.console import Console

    console = Console(stderr=True)
    wrong = _wrong_usage(args)
    if wrong:
        console.print(f"ic evaluate illusion: {wrong}", style="red", markup=False)
        return 1
    try:
        return _evaluate(args, console)
    except (ValueError, RuntimeError, TimeoutError) as error:
        console.print(f"ic evaluate illusion: {error}", style="red", markup=False)
        return 1
    except KeyboardInterrupt:
        console.print("ic evaluate illusion: interrupted; nothing was written", style="red", markup=False)
        return 130


def _wrong_usage(args: argparse.Namespace) -> str:
    """Text of the error in the arguments; empty where there is none."""
    for path in (args.json, args.strip, args.plot):
        if path is not None and not path.parent.is_dir():
            return f"the folder {path.parent} does not exist"
    for path in (args.strip, args.plot):
        if path is not None and path.suffix.lower() != ".png":
            return f"{path}: the name must end in .png"
    if args.timeout <= 0:
        return f"--timeout must be > 0 (got {args.timeout:g})"
    return ""


def _evaluate(args: argparse.Namespace, console: Any) -> int:
    from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeElapsedColumn

    from instant_ic.experiments import illusion, illusion_plot

    settings = illusion.TeleopSettings(
        args.episodes, args.seed, args.world, ("ic",), pictures=False, overrides=tuple(args.param)
    )
    columns = (TextColumn("{task.description}"), BarColumn(), MofNCompleteColumn(), TimeElapsedColumn())
    with Progress(*columns, console=console) as progress:
        task = progress.add_task("filming", total=settings.episodes)

        def show_progress(film: illusion.Film) -> None:
            progress.update(task, advance=1)
            if not console.is_terminal:
                console.print(f"episode {film.index}: {len(film.frames)} frames", markup=False)

        films = illusion.evaluate(settings, args.jobs, show_progress, args.timeout)
    figures = illusion.report(films, settings)
    if args.json:
        illusion.save(args.json, figures)
    if args.plot:
        illusion_plot.save_plot(args.plot, figures)
    figures.pop("each")
    sys.stdout.write(json.dumps(figures, indent=2) + "\n")
    if args.strip:  # last: without an obstacle there is none
        illusion_plot.save_strip(args.strip, films)
    return 0
