"""Results file of ``ic evaluate teleop``, from which an interrupted evaluation resumes."""

from __future__ import annotations

import json
import math
from collections.abc import Sequence
from dataclasses import asdict
from pathlib import Path
from typing import Any

from instant_ic.experiments import teleop_figures as figures
from instant_ic.experiments.results import finite, save_text
from instant_ic.experiments.teleop_figures import Drive, Switch
from instant_ic.experiments.teleop_settings import TeleopSettings
from instant_ic.experiments.teleop_stack import METHODS


def report(drives: Sequence[Drive], settings: TeleopSettings) -> dict[str, Any]:
    """Figures by method, the targets, and each drive without its tracks, ready for JSON."""
    by_method = {name: [d for d in drives if d.method == name] for name in settings.methods}
    stop = by_method.get("stop")
    methods = {name: figures.summary(of, stop if name != "stop" else None) for name, of in by_method.items() if of}
    rows = [{key: value for key, value in asdict(drive).items() if key != "tracks"} for drive in drives]
    return {
        **_conditions(settings),
        "drives": len(drives),
        "drives_planned": settings.episodes * len(settings.methods),
        "methods": finite(methods),
        "targets": figures.targets(methods["ic"]) if "ic" in methods else {},
        "each": finite(rows),
    }


def save(path: Path, drives: Sequence[Drive], settings: TeleopSettings) -> None:
    """Write the report with the tracks atomically: an interrupted program leaves a readable file."""
    text = json.dumps(report(drives, settings), indent=2)
    # Tracks are long: one line each.
    rows = (f"    {json.dumps([d.index, d.method, d.tracks], separators=(',', ':'))}" for d in drives)
    save_text(path, text.removesuffix("\n}") + ',\n  "tracks": [\n' + ",\n".join(rows) + "\n  ]\n}\n")


def load(path: Path, settings: TeleopSettings) -> list[Drive]:
    """Drives of an earlier run with the same settings, limited to those that these settings request.

    Raises:
        ValueError: the file is not readable, is not such a report, or has other settings; names the differences.
    """
    try:
        saved = json.loads(path.read_text())
        rows, tracks = saved["each"], {(index, method): one for index, method, one in saved["tracks"]}
        found = {key: saved[key] for key in _conditions(settings)}
        drives = [
            Drive(
                **_with_nan({key: value for key, value in row.items() if key != "switches"}),
                switches=[Switch(**_with_nan(one)) for one in row["switches"]],
                tracks=tracks[row["index"], row["method"]],
            )
            for row in rows
        ]
    except (OSError, UnicodeDecodeError, json.JSONDecodeError, KeyError, TypeError, ValueError) as error:
        words = f"{type(error).__name__}: {error}"
        raise ValueError(f"{path}: not a report of ic evaluate teleop that can be resumed ({words})") from error
    for key, wanted in _conditions(settings).items():
        if found[key] != wanted:
            raise ValueError(f"{path}: was driven with {key} {found[key]}, not {wanted}; give another --json")
    return [d for d in drives if d.index < settings.episodes and d.method in settings.methods]


def in_order(drives: Sequence[Drive]) -> list[Drive]:
    """Sort by course, then method."""
    return sorted(drives, key=lambda drive: (drive.index, METHODS.index(drive.method)))


def _conditions(settings: TeleopSettings) -> dict[str, Any]:
    """TeleopSettings that must match for drives to be combined in one report."""
    return {
        "seed": settings.seed,
        "world": settings.world,
        "operator": "scripted" if settings.log is None else "recorded",
        "log": None if settings.log is None else str(settings.log),
        "depth": settings.depth,
        "parameters": list(settings.overrides),
    }


def _with_nan(row: dict[str, Any]) -> dict[str, Any]:
    """Convert null, JSON's value for unknown, back to NaN."""
    return {key: math.nan if value is None and key != "psnr_db" else value for key, value in row.items()}
