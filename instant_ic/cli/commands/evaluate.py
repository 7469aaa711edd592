"""``ic evaluate``: run the stack or a part of it on recordings and measure the results.

Each ``evaluate_*`` module of this package adds a kind through its ``add_kind(kinds)``.
"""

from __future__ import annotations

import argparse
import importlib
import pkgutil
import sys
from pathlib import Path
from typing import Any

from instant_ic.cli import commands
from instant_ic.cli.arguments import group, verb
from instant_ic.cli.evaluations import print_figures
from instant_ic.util.safe_text import direct


def add_parser(subparsers: Any) -> None:
    kinds = group(
        subparsers, "evaluate", "measure parts of the stack on recordings or in simulation",
        "Run the stack or a part of it on recordings or in simulation, and measure the results.",
    )  # fmt: skip
    add = verb(
        kinds, "recordings", "run a LiDAR capture and a panorama photo through every node", evaluate_recordings,
        "ic evaluate recordings --pcap drive.pcap --panorama room.jpg -o runs/recordings",
        "Send a VLP-16 capture as UDP packets and a 360° photo through the Theta's Web API to the whole stack. "
        "Write a bag, the trained view beside the same crop of the photo, the depth and the map as PNG, "
        "and summary.json to the output folder. Photo and capture are taken to be from different places, so the depth "
        "is in the model's own metres. With --same-place the LiDAR scales it, as on the robot.",
    ).add_argument  # fmt: skip
    add("--pcap", type=Path, required=True, help="capture of VLP-16 data packets")
    add("--panorama", type=Path, required=True, help="equirectangular photo (JPEG, 2:1)")
    add("-o", "--out", type=Path, required=True, help="output folder")
    text = "photo and capture are from the same place: scale the depth by the LiDAR"
    add("--same-place", action="store_true", help=text)
    add("--timeout", type=float, default=240.0, metavar="S", help="time limit (default: %(default)g s)")
    add("--json", type=Path, metavar="OUT", help="also write the summary here")
    for info in sorted(pkgutil.iter_modules(commands.__path__), key=lambda info: info.name):
        if info.name.startswith("evaluate_"):
            importlib.import_module(f"{commands.__name__}.{info.name}").add_kind(kinds)


def evaluate_recordings(args: argparse.Namespace) -> int:
    from rich.console import Console

    from instant_ic.experiments.recordings import evaluate_recordings as run

    console = Console(file=direct(sys.stderr), soft_wrap=True)  # log lines are not broken at 80 columns
    with console.status("starting") as status:

        def show_progress(text: str) -> None:
            status.update(text)
            if not console.is_terminal:
                console.print(text)

        summary = run(args.pcap, args.panorama, args.out, args.timeout, show_progress, args.same_place)
    print_figures(summary, args.json)
    console.print(f"images and bag in {args.out}/: view.png, depth.png, map.png, bag/")
    return 0
