"""``ic evaluate follow``: contacts and progress of an r-bot that follows a v-bot through random rooms."""

from __future__ import annotations

import argparse
import os
import sys
from typing import Any

from instant_ic.cli.arguments import verb
from instant_ic.cli.evaluations import add_options, check_outputs, counted, errors_for_the_user, print_figures


def add_kind(kinds: Any) -> None:
    parser = verb(
        kinds, "follow", "simulate the r-bot following a v-bot through random rooms", run,
        "ic evaluate follow --episodes 50 --seed 0 --json follow.json --plot follow.png",
        "Drive a v-bot to a goal through random rooms with walls, boxes, low and hanging obstacles. "
        "The r-bot follows with the robot's own costmap, planner, follower and collision monitor, "
        "under slip, command delay, sensor noise and pose drift. Reports contacts, goals reached, path length "
        "relative to the shortest path, and CPU time of each part. The same seed gives the same drives.",
    )  # fmt: skip
    add_options(parser, 50, os.cpu_count() or 1, 3600.0, "the drives, the worst first,")


def run(args: argparse.Namespace) -> int:
    from instant_ic.experiments import follow
    from instant_ic.experiments.results import save_json

    check_outputs(args)
    contacts = 0
    with errors_for_the_user(), counted("starting", args.episodes) as advance:

        def show_progress(episode: follow.Episode) -> None:
            nonlocal contacts
            contacts += episode.contacts
            how = "reached" if episode.reached else episode.reason
            advance(f"driving, {contacts} contacts", f"episode {episode.index}: {how}")

        episodes = follow.evaluate(args.episodes, args.seed, args.jobs, show_progress, args.timeout)
    figures = follow.report(episodes, args.seed)
    if args.json:
        save_json(args.json, figures)
    if args.plot:
        follow.plot(episodes, args.seed, args.plot)
    each = figures.pop("each")
    print_figures(figures)
    for row in each:
        if row["contacts"] or (row["reachable"] and not row["reached"]):
            how = "reached" if row["reached"] else f"not reached: {row['reason']}"
            print(f"episode {row['index']}: {row['contacts']} contacts, {how}", file=sys.stderr)
    return 0
