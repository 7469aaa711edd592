"""``ic evaluate depth``: estimated depth of panoramas against the true depth, for each depth source."""

from __future__ import annotations

import argparse
import sys
from pathlib import Path
from typing import Any

from instant_ic.cli.arguments import check_files, verb
from instant_ic.cli.errors import UserError
from instant_ic.cli.evaluations import print_figures


def add_kind(kinds: Any) -> None:
    add = verb(
        kinds, "depth", "compare estimated depth of panoramas with the true depth", evaluate_depth,
        "ic evaluate depth rgb/ --depth depth/ --lidar --outliers 0.05 --json out.json --plot out.png",
        "Estimate the depth of level 360° panoramas as the robot does and compare it with the true depth: MRE, "
        "MAE, RMSE, δ1 to δ3, scale error and time, for each image and on average, before and after scaling. "
        "Prints JSON. Without --depth there is no comparison: use --plot and --side to see the estimate.",
    ).add_argument  # fmt: skip
    add("images", type=Path, nargs="+", metavar="IMAGES", help="panoramas (2:1): files or folders")
    text = "true radial depth: files or a folder, same stems as the images; 16-bit PNG in millimetres, .npy, .npz "
    text += "(key depth) or .exr in metres; 0 = unknown"
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
    text = "scaling: median_ratio, max_ratio, ransac, sector (default: the scaler's)"
    add("--method", default="", metavar="RULE", help=text)
    add("--png-unit", **metres, default=1e-3, help="metres per unit of a depth PNG (default: %(default)g)")
    add("--threads", type=int, default=2, help="CPU threads of the model (default: %(default)s)")
    add("--json", type=Path, metavar="OUT", help="also write the figures here")
    add("--plot", type=Path, metavar="OUT.png", help="write images, estimates, true depth and errors here")
    text = "write the point clouds here, from the side and from above"
    add("--side", type=Path, metavar="OUT.png", help=text)


def evaluate_depth(args: argparse.Namespace) -> int:
    from instant_ic.cli.progress import progress
    from instant_ic.depth.files import DepthFileError, load_depth, load_picture
    from instant_ic.depth.manifest import InferenceError, ManifestError
    from instant_ic.depth.model import DEFAULT_COMPLETION, DEFAULT_MODEL, DepthModel
    from instant_ic.experiments.depth import DepthEvaluationError, DepthSettings, Evaluator, LidarSettings, report
    from instant_ic.experiments.depth_files import PairError, find_pictures, pair, unit_warning
    from instant_ic.experiments.depth_pictures import Sheets
    from instant_ic.util.paths import shipped_file

    check_files(args.json)
    check_files(args.plot, args.side, suffix=".png")
    if not args.png_unit > 0:
        raise UserError(f"--png-unit must be > 0 (got {args.png_unit:g})", 2)
    if args.lidar and not args.depth:
        raise UserError("--lidar needs the true depth: give --depth too", 2)
    if args.source not in (None, "network") and not args.lidar:
        raise UserError(f"--source {args.source} needs LiDAR points: give --depth and --lidar too", 2)
    try:
        lidar = LidarSettings(args.noise, args.outliers, args.seed, args.lidar_height) if args.lidar else None
        source = args.source or ("completed" if lidar else "network")
        settings = DepthSettings(source, lidar, args.camera_height, args.method)
        model = completion = None
        if source != "lidar":
            model = DepthModel.load(args.model or shipped_file("models", DEFAULT_MODEL), threads=args.threads)
        if source == "completed":
            found = args.completion or shipped_file("models", DEFAULT_COMPLETION)
            completion = DepthModel.load(found, threads=args.threads)
        evaluator = Evaluator(settings, model, completion)
        pictures = find_pictures(args.images)
        pairs = pair(pictures, args.depth) if args.depth else [(picture, None) for picture in pictures]
    except (DepthEvaluationError, ManifestError, PairError, FileNotFoundError, ValueError) as error:
        raise UserError(f"evaluate depth: {error}") from None

    sheets = [Sheets(file, side) for file, side in ((args.plot, False), (args.side, True)) if file is not None]
    rows: list[dict[str, Any]] = []
    errors: list[dict[str, str]] = []
    warnings: list[str] = []
    with progress("depth") as advance:
        for done, (image, truth) in enumerate(pairs):
            advance(done / len(pairs))
            try:
                if args.depth and truth is None:
                    raise PairError(f"{image}: no depth file has this stem")
                truth_m = load_depth(truth, args.png_unit) if truth is not None else None
                warning = unit_warning(truth_m) if truth_m is not None else ""
                if warning:
                    warnings.append(f"{truth}: {warning}")
                scored = evaluator.score(image.name, load_picture(image), truth_m)
            except (PairError, DepthFileError, DepthEvaluationError, InferenceError) as error:
                errors.append({"name": image.name, "error": str(error)})
                continue
            rows.append(scored.as_dict() | {"image": str(image), "truth": str(truth) if truth else None})
            for sheet in sheets:
                sheet.add(scored)
        advance(1.0)
    for sheet in sheets:
        sheet.close()
    figures = report(rows, settings, evaluator.model)
    if unfit := [row["name"] for row in rows if row["fit"] and not row["fit"]["ok"]]:
        warnings.append(
            f"{len(unfit)} of {len(rows)} scale fits are not reliable, and neither is their depth: {unfit[0]} ..."
        )
    figures |= {"errors": errors, "warnings": warnings, "pictures": [str(p) for sheet in sheets for p in sheet.written]}
    print_figures(figures, args.json)
    for line in warnings:
        print(f"ic evaluate depth: warning: {line}", file=sys.stderr)
    for entry in errors:
        print(f"ic evaluate depth: {entry['error']}", file=sys.stderr)
    return 1 if errors else 0
