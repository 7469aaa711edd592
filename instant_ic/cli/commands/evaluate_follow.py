"""``ic evaluate follow``: how well and how safely the r-bot follows a v-bot through random rooms."""

from __future__ import annotations

import argparse
import json
import os
import sys
from pathlib import Path
from typing import Any


def add_kind(kinds: Any) -> None:
    """Add ``follow`` to ``ic evaluate``."""
    parser = kinds.add_parser(
        "follow",
        help="simulate the r-bot following a v-bot through random rooms",
        description=(
            "Drive a v-bot to a goal through random rooms with walls, boxes, low and hanging obstacles, and people in "
            "a fifth of them. The r-bot follows with the robot's own costmap, planner, follower and collision monitor, "
            "under slip, command delay, sensor noise and pose drift. Reports contacts, goals reached, path length "
            "relative to the shortest path, and CPU time of each part. The same seed gives the same drives."
        ),
        epilog="example: ic evaluate follow --episodes 50 --seed 0 --json follow.json --plot follow.png",
    )
    parser.add_argument("--episodes", type=int, default=50, metavar="N", help="number of drives (default: %(default)s)")
    parser.add_argument("--seed", type=int, default=0, help="seed of the rooms and all noise (default: %(default)s)")
    parser.add_argument(
        "--jobs", type=int, default=os.cpu_count() or 1, metavar="N", help="drives in parallel (default: all cores)"
    )
    parser.add_argument("--json", type=Path, metavar="OUT", help="write all figures here")
    parser.add_argument("--plot", type=Path, metavar="OUT.png", help="plot the drives here, the worst first")
    parser.add_argument(
        "--timeout", type=float, default=3600.0, metavar="S", help="time limit (default: %(default)g s)"
    )
    parser.set_defaults(func=run)


def run(args: argparse.Namespace) -> int:
    """Run ``ic evaluate follow``; return the exit status."""
    from rich.console import Console
    from rich.progress import (
        BarColumn,
        MofNCompleteColumn,
        Progress,
        TextColumn,
        TimeElapsedColumn,
        TimeRemainingColumn,
    )

    from instant_ic.experiments import follow

    console = Console(stderr=True)
    for path in (args.json, args.plot):
        if path is not None and not path.parent.is_dir():
            console.print(f"ic evaluate follow: the folder {path.parent} does not exist", style="red", markup=False)
            return 1
    columns = (TextColumn("{task.description}"), BarColumn(), MofNCompleteColumn(), TimeElapsedColumn())
    try:
        with Progress(*columns, TimeRemainingColumn(), console=console) as progress:
            task = progress.add_task("starting", total=args.episodes)
            contacts = 0

            def show_progress(episode: follow.Episode) -> None:
                nonlocal contacts
                contacts += episode.contacts + episode.people_contacts
                progress.update(task, advance=1, description=f"driving, {contacts} contacts")
                if not console.is_terminal:
                    console.print(f"episode {episode.index}: {'reached' if episode.reached else episode.reason}")

            episodes = follow.evaluate(args.episodes, args.seed, args.jobs, show_progress, args.timeout)
    except (ValueError, RuntimeError, TimeoutError) as error:
        console.print(f"ic evaluate follow: {error}", style="red", markup=False)
        return 1
    figures = follow.report(episodes, args.seed)
    if args.json:
        args.json.write_text(json.dumps(figures, indent=2) + "\n")
    if args.plot:
        follow.plot(episodes, args.seed, args.plot)
    each = figures.pop("each")
    sys.stdout.write(json.dumps(figures, indent=2) + "\n")
    for row in each:
        if row["contacts"] or row["people_contacts"] or (row["reachable"] and not row["reached"]):
            console.print(
                f"episode {row['index']}: {row['contacts'] + row['people_contacts']} contacts, "
                f"{'reached' if row['reached'] else 'not reached: ' + row['reason']}",
                markup=False,
            )
    return 0
