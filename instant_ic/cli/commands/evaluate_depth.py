"""``ic evaluate depth``: comparison of the estimated depth of panoramas with the true depth, by depth source."""

from __future__ import annotations

import argparse
import sys
from pathlib import Path
from typing import TYPE_CHECKING, Any

from instant_ic.cli.arguments import check_files, verb
from instant_ic.cli.errors import UserError
from instant_ic.cli.evaluations import errors_for_the_user, print_figures
from instant_ic.cli.progress import progress

if TYPE_CHECKING:
    from instant_ic.experiments.depth import Evaluator

_SHOWN = 12
"""Number of panoramas in the plot."""
_THREADS = 2
"""Number of CPU threads of the models."""


def add_kind(kinds: Any) -> None:
    add = verb(
        kinds, "depth", "compare estimated depth of panoramas with the true depth", evaluate_depth,
        "ic evaluate depth rgb/*.jpg --depth depth/*.png --lidar --outliers 0.05 --json out.json --plot out.png",
        "Estimate the depth of level 360° panoramas as the robot does and compare it with the true depth: MRE, "
        "MAE, RMSE, δ1 to δ3, scale error and time, for each image and on average, before and after scaling. "
        "Prints JSON. Without --depth there is no comparison: use --plot to see the estimate.",
    ).add_argument  # fmt: skip
    add("images", type=Path, nargs="+", metavar="IMAGES", help="panoramas (2:1)")
    text = "true radial depth in the order of the images, same stems; 16-bit PNG in millimetres, .npy or "
    text += ".npz (key depth) in metres; 0 = unknown"
    add("--depth", type=Path, nargs="+", default=[], metavar="GT", help=text)
    add("--model", type=Path, metavar="M", help="ONNX file with its manifest (default: the shipped one)")
    text = "ONNX file of ic depth train, for source completed (default: the shipped one)"
    add("--completion", type=Path, metavar="M", help=text)
    text = "depth source (default: completed with --lidar, else network)"
    add("--source", choices=("network", "lidar", "fused", "completed"), help=text)
    text = "scale the depth by a simulated VLP-16 that measures the true depth"
    add("--lidar", action="store_true", help=text)
    metres, default = {"type": float, "metavar": "M"}, "(default: %(default)g m)"
    add("--lidar-height", **metres, default=0.6, help=f"height of the LiDAR above the floor {default}")
    add("--camera-height", **metres, default=1.2, help=f"height of the camera above the floor {default}")
    add("--noise", **metres, default=0.02, help=f"noise of a LiDAR range {default}")
    text = "share of LiDAR outliers, 0 to 1 (default: %(default)g)"
    add("--outliers", type=float, default=0.0, metavar="SHARE", help=text)
    add("--seed", type=int, default=0, help="seed of noise and outliers (default: %(default)s)")
    add("--png-unit", **metres, default=1e-3, help="metres per unit of a depth PNG (default: %(default)g)")
    add("--json", type=Path, metavar="OUT", help="also write the figures here")
    text = "write the first images, estimates, true depths and errors here"
    add("--plot", type=Path, metavar="OUT.png", help=text)


def evaluate_depth(args: argparse.Namespace) -> int:
    """Score each panorama; print and write the figures."""
    from instant_ic.depth.files import DepthFileError, load_depth, load_rgb
    from instant_ic.depth.manifest import InferenceError
    from instant_ic.experiments.depth import DepthEvaluationError, Scored, pair, report
    from instant_ic.experiments.plots import save_depth_sheet

    check_files(args.json)
    check_files(args.plot, suffix=".png")
    if not args.png_unit > 0:
        raise UserError(f"--png-unit must be > 0 (got {args.png_unit:g})", 2)
    if args.lidar and not args.depth:
        raise UserError("--lidar needs the true depth: give --depth too", 2)
    with errors_for_the_user():
        evaluator = _evaluator(args)
        pairs = pair(args.images, args.depth)
    rows: list[dict[str, Any]] = []
    shown: list[Scored] = []
    errors: list[dict[str, str]] = []
    with progress("depth") as advance:
        for done, (image, truth) in enumerate(pairs, 1):
            try:
                truth_m = load_depth(truth, args.png_unit) if truth is not None else None
                scored = evaluator.score(image.name, load_rgb(image), truth_m)
                rows.append(scored.as_dict() | {"image": str(image), "truth": str(truth) if truth else None})
                if args.plot and len(shown) < _SHOWN:
                    shown.append(scored)
            except (DepthFileError, DepthEvaluationError, InferenceError) as error:
                errors.append({"name": image.name, "error": str(error)})
            advance(done / len(pairs))
    if shown:
        save_depth_sheet(args.plot, shown)
    unfit = [row["name"] for row in rows if row["fit"] and not row["fit"]["ok"]]
    if unfit:
        print(f"ic evaluate depth: {len(unfit)} scale fits are not reliable: {unfit[0]} ...", file=sys.stderr)
    for entry in errors:
        print(f"ic evaluate depth: {entry['error']}", file=sys.stderr)
    print_figures(report(rows, evaluator.settings, evaluator.model) | {"errors": errors, "unfit": unfit}, args.json)
    return 1 if errors else 0


def _evaluator(args: argparse.Namespace) -> Evaluator:
    from instant_ic.depth.model import DEFAULT_COMPLETION, DEFAULT_MODEL, DepthModel
    from instant_ic.experiments.depth import DepthSettings, Evaluator, LidarSettings
    from instant_ic.util.paths import shipped_file

    lidar = LidarSettings(args.noise, args.outliers, args.seed, args.lidar_height) if args.lidar else None
    source = args.source or ("completed" if lidar else "network")
    settings = DepthSettings(source, lidar, args.camera_height)
    model = completion = None
    if source != "lidar":
        model = DepthModel.load(args.model or shipped_file("models", DEFAULT_MODEL), threads=_THREADS)
    if source == "completed":
        completion = DepthModel.load(args.completion or shipped_file("models", DEFAULT_COMPLETION), threads=_THREADS)
    return Evaluator(settings, model, completion)
