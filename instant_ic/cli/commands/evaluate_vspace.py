"""``ic evaluate vspace``: image quality of the virtual space away from the panorama, against simpler methods."""

from __future__ import annotations

import argparse
import json
import math
from pathlib import Path
from typing import Any

from instant_ic.cli.arguments import check_files, numbers, size, verb
from instant_ic.cli.errors import UserError
from instant_ic.cli.evaluations import errors_for_the_user, print_figures
from instant_ic.cli.progress import progress


def add_kind(kinds: Any) -> None:
    add = verb(
        kinds, "vspace", "image quality of the virtual space by distance and training time", run,
        "ic evaluate vspace --world corridor --path straight --sources ours,panorama,depth-warp "
        "--json vspace.json --plot vspace.png",
        "Take a panorama in a simulated world, prepare each source, and compare its views with the world's own at "
        "several distances from the panorama: PSNR and SSIM. Sources: ours (the shipped depth model, scaled by a "
        "simulated LiDAR, and the virtual space), field (its field only, without the warp), true-depth (ours with "
        "the true depth: the upper bound), no-depth (colours only), no-scale (the model's unscaled depth), "
        "panorama (rotated only, no depth), depth-warp, point-warp and true-warp (the panorama warped by depth), "
        "mesh (the world scanned at another time).",
    ).add_argument  # fmt: skip
    add("--world", required=True, metavar="W", help="corridor, random:SEED, or a mesh file (.glb, ...)")
    add("--path", default="straight,curve", help="straight, curve, or both (default: %(default)s)")
    add("--sources", default="ours,no-depth,no-scale,panorama,depth-warp,mesh", help="default: %(default)s")
    add("--start", type=numbers("X,Y,YAW"), metavar="X,Y,YAW", help="position of the last panorama, metres and degrees")
    add("--seconds", type=float, default=8.0, metavar="S", help="training time, CPU seconds (default: 8)")
    add("--times", metavar="S,S,...", help="training times at which ours and field are measured")
    add("--size", type=size, default=(640, 360), metavar="WxH", help="size of the images (default: 640x360)")
    add("--fov", type=float, default=90.0, metavar="DEG", help="horizontal field of view (default: 90)")
    add("--keyframes", type=int, default=1, metavar="K", help="number of panoramas, 1 m apart (default: 1)")
    add("--step", type=float, default=0.25, metavar="M", help="step between distances (default: 0.25)")
    add("--reach", type=float, default=4.0, metavar="M", help="longest distance (default: 4)")
    add("--seed", type=int, default=0)
    add("--json", type=Path, metavar="OUT", help="write all figures here")
    add("--plot", type=Path, metavar="OUT.png", help="write the curves here")
    add("--strip", type=Path, metavar="OUT.png", help="write images at 0.5, 1, 2 and 3 m here")


def run(args: argparse.Namespace) -> int:
    from rich.console import Console
    from rich.table import Table

    from instant_ic.experiments import vspace
    from instant_ic.experiments.vspace_plot import save_plot, save_strip

    check_files(args.json, args.plot, args.strip)
    console = Console(stderr=True)
    try:
        settings = vspace.VspaceSettings(
            paths=_words(args.path),
            sources=_words(args.sources),
            seconds=args.seconds,
            times=tuple(_numbers(args.times, "--times")) if args.times else (),
            size=args.size,
            fov_deg=args.fov,
            keyframes=args.keyframes,
            step_m=args.step,
            reach_m=args.reach,
            seed=args.seed,
        )
        x, y, yaw_deg = args.start or (0.0, 0.0, 0.0)
        start = (x, y, math.radians(yaw_deg)) if args.start else None
        with progress("evaluating") as advance:
            report = vspace.evaluate(args.world, settings, start, lambda _, done, total: advance(done / max(total, 1)))
    except ValueError as error:
        raise UserError(f"ic evaluate vspace: {error}", 2) from error
    figures = report.figures()
    if args.json:
        args.json.write_text(json.dumps(figures, indent=2) + "\n")
    with errors_for_the_user():
        if args.plot:
            save_plot(args.plot, report)
        if args.strip:
            save_strip(args.strip, report)
    for key, label in (("psnr_db", "PSNR, dB"), ("ssim", "SSIM")):
        for path, sources in report.table(key).items():
            distances = sorted({distance for values in sources.values() for distance in values if distance % 0.5 == 0})
            table = Table("m", *(f"{distance:g}" for distance in distances), title=f"{label}, {path}")
            for source, values in sources.items():
                table.add_row(source, *(f"{values[d]:.3g}" if d in values else "" for d in distances))
            console.print(table)
    print_figures({key: figures[key] for key in ("world", "depth", "mean", "verdict")})
    return 0


def _words(text: str) -> tuple[str, ...]:
    return tuple(dict.fromkeys(word.strip() for word in text.split(",") if word.strip()))


def _numbers(text: str, option: str) -> list[float]:
    try:
        return [float(word) for word in text.split(",")]
    except ValueError as error:
        raise ValueError(f"{option} must be numbers separated by commas (got {text!r})") from error
