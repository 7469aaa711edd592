"""``ic evaluate slam-sim``: SLAM on the simulated crawler."""

from __future__ import annotations

import argparse
import json
import sys
from pathlib import Path
from typing import Any

from instant_ic.cli.errors import UserError


def add_kind(kinds: Any) -> None:
    """Add ``slam-sim`` to ``ic evaluate``."""
    parser = kinds.add_parser(
        "slam-sim",
        help="run SLAM on round trips of the simulated crawler with slipping tracks",
        description=(
            "Drive the simulated crawler along a corridor and back, on tracks with random slip; run SLAM on its scans "
            "and encoders, and compare with the true poses. Prints the figures of each seed as JSON."
        ),
        epilog="example: ic evaluate slam-sim --slip 0.2 --seeds 5",
    )
    parser.add_argument("--world", default="corridor", help="world of the simulator (default: %(default)s)")
    parser.add_argument(
        "--slip", type=float, default=0.2, help="slip as a share of the distance, 1 σ (default: %(default)g)"
    )
    parser.add_argument("--seeds", type=int, default=5, metavar="N", help="number of drives (default: %(default)d)")
    parser.add_argument(
        "--rounds", type=int, default=2, help="round trips per drive, about 39 m each (default: %(default)d)"
    )
    parser.add_argument("--backend", choices=("graph", "rbpf"), default="graph", help="SLAM method")
    parser.add_argument("--no-odometry", action="store_true", help="ignore the encoders")
    parser.add_argument("--json", type=Path, metavar="OUT", help="also write the figures here")
    parser.add_argument(
        "--plot", type=Path, metavar="OUT.png", help="write an image of the last drive's map and paths here"
    )
    parser.set_defaults(func=evaluate_slam_sim)


def evaluate_slam_sim(args: argparse.Namespace) -> int:
    """Run ``ic evaluate slam-sim``; return the exit status."""
    from rich.console import Console
    from rich.progress import Progress

    from instant_ic.experiments.particle_slam import ParticleConfig
    from instant_ic.experiments.pictures import save_map
    from instant_ic.experiments.slam_sim import evaluate_round_trip, round_trip
    from instant_ic.sim.worlds import make_world

    if args.seeds < 1 or args.rounds < 1:
        raise UserError("--seeds and --rounds must be at least 1", 2)
    console = Console(stderr=True)
    reports: list[dict[str, object]] = []
    with Progress(console=console, disable=not console.is_terminal) as progress:
        task = progress.add_task("round trips", total=args.seeds)
        try:
            world = make_world(args.world)
            for seed in range(args.seeds):
                trip = round_trip(world, args.slip, seed, args.rounds)
                particles = ParticleConfig() if args.backend == "rbpf" else None
                report, run = evaluate_round_trip(trip, particles=particles, use_wheel_odom=not args.no_odometry)
                reports.append({"seed": seed, **report})
                progress.advance(task)
        except ValueError as error:
            raise UserError(f"evaluate slam-sim: {error}") from None
    worst = {key: max(float(report[key]) for report in reports) for key in _WORST}  # type: ignore[arg-type]
    text = json.dumps({"world": args.world, "slip": args.slip, "worst": worst, "drives": reports}, indent=2)
    if args.json:
        args.json.write_text(text + "\n")
    sys.stdout.write(text + "\n")
    if args.plot:
        grid = run.slam.grid()
        paths = {"estimate": run.trajectory[:, 1:], "truth": trip.truth}
        save_map(args.plot, grid.values, grid.resolution, (float(grid.origin[0]), float(grid.origin[1])), paths=paths)
    return 0


_WORST = ("end_error_m", "end_error_deg", "max_error_m", "max_error_deg", "cpu_ms_per_scan_mean", "cpu_ms_per_scan_p99")
