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
        help="the r-bot behind a v-bot through random rooms, in simulation",
        description=(
            "Random rooms with walls, boxes, low and hanging things, people in a fifth of them. A v-bot is driven "
            "through them to a goal, the r-bot follows: costmap, planner, follower and collision monitor as on the "
            "robot, with slip, late commands, sensor noise and a pose that wanders. Tells contacts, goals reached, the "
            "length of the way against the shortest one, and what each part takes of the processor. The same seed "
            "gives the same drives."
        ),
        epilog="example: ic evaluate follow --episodes 50 --seed 0 --json follow.json --plot follow.png",
    )
    parser.add_argument("--episodes", type=int, default=50, metavar="N", help="drives (default: %(default)s)")
    parser.add_argument("--seed", type=int, default=0, help="of the rooms and all noise (default: %(default)s)")
    parser.add_argument(
        "--jobs", type=int, default=os.cpu_count() or 1, metavar="N", help="drives at a time (default: all cores)"
    )
    parser.add_argument("--json", type=Path, metavar="OUT", help="write all figures here")
    parser.add_argument("--plot", type=Path, metavar="OUT.png", help="write a sheet of drives here, the worst first")
    parser.add_argument("--timeout", type=float, default=3600.0, metavar="S", help="in all (default: %(default)g s)")
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
            console.print(f"ic evaluate follow: {path.parent} is no folder", style="red", markup=False)
            return 1
    columns = (TextColumn("{task.description}"), BarColumn(), MofNCompleteColumn(), TimeElapsedColumn())
    try:
        with Progress(*columns, TimeRemainingColumn(), console=console) as progress:
            task = progress.add_task("starting", total=args.episodes)
            contacts = 0

            def tell(episode: follow.Episode) -> None:
                nonlocal contacts
                contacts += episode.contacts + episode.people_contacts
                progress.update(task, advance=1, description=f"driving, {contacts} contacts")
                if not console.is_terminal:
                    console.print(f"episode {episode.index}: {'reached' if episode.reached else episode.reason}")

            episodes = follow.evaluate(args.episodes, args.seed, args.jobs, tell, args.timeout)
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
