"""V.B, Fig. 5: image quality by training time, of the shown view, of the field alone and of the paper's field."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import asdict
from pathlib import Path
from typing import Any

import numpy as np

from instant_ic.experiments.compared import LABELS, command_of, family, view_units
from instant_ic.experiments.lab import WORLD, Options, Result, Unit
from instant_ic.experiments.plots import Series, curves_svg
from instant_ic.experiments.report import Answer, Figure, Part, Section, Table, Text
from instant_ic.experiments.vspace import converge, converge_recorded
from instant_ic.experiments.vspace_sources import VspaceSettings
from instant_ic.vspace import VirtualSpaceConfig
from instant_ic.vspace.devices import make_device

_TIMES_S, _QUICK_S = (0.25, 0.5, 1.0, 2.0, 4.0, 8.0), (0.2, 0.5)
CLAIM_S = 4.0
"""Time within which the paper's view has converged."""
_SETTLED_DB = 0.5
"""Largest gain of a converged view after ``CLAIM_S``, dB."""


def units(options: Options) -> list[Unit]:
    """Return units with all times in each world, or from some keyframes of a recording."""
    made = view_units("training-time", options, ("ours",), (WORLD,), ("straight",), False)
    times = list(_QUICK_S if options.quick else _TIMES_S)
    keys = ("world", "bag", "number", "seed", "start_seed", "size", "panorama_width")
    return [
        Unit(one.experiment, {**{k: one.arguments[k] for k in keys if k in one.arguments}, "times_s": times})
        for one in made
    ]


def measure(arguments: dict[str, Any]) -> dict[str, Any]:
    """Train in one world, or on one recorded keyframe."""
    settings = VspaceSettings(
        ("straight",),
        ("ours",),
        size=tuple(arguments["size"]),
        panorama_width=arguments["panorama_width"],
        seed=arguments["seed"],
        start_seed=arguments.get("start_seed", 0),
    )
    if "bag" in arguments:
        rows = converge_recorded(Path(arguments["bag"]), settings, arguments["number"], arguments["times_s"])
    else:
        rows = converge(arguments["world"], settings, arguments["times_s"])
    return {"rows": [asdict(row) for row in rows], "gpu": make_device(VirtualSpaceConfig())[0].on_gpu}


def section(results: Sequence[Result], options: Options) -> Section:
    """Return curves and tables at the panorama and 1 m ahead."""
    command = command_of(options, "training-time")
    parts: list[Part] = [
        Text(
            "Seconds are CPU seconds of one process, or of the GPU's host where there is one. ours is what the "
            "operator sees: the panorama warped by its depth from the start, and the field wherever it is better."
        )
    ]
    gpu = any(one.data.get("gpu") for one in results)
    figures = [] if gpu else ["no GPU here"]
    held: bool | None = None
    for name in dict.fromkeys(family(one) for one in results if one.data):
        panels = []
        for at in (0.0, 1.0):
            for key, label in LABELS.items():
                found = _by_time(results, name, at, key)
                panels.append((f"training, s ({at:g} m ahead)", label, found))
                times = sorted({x for values in found.values() for x in values})
                lines = [[source, *(values.get(x, []) for x in times)] for source, values in found.items()]
                columns = ("source", *(f"{x:g} s" for x in times))
                parts.append(Table(f"{name}, {at:g} m ahead: {label}", columns, lines, command))
        parts.insert(1, Figure(f"{name}: by training time", curves_svg(panels), command))
        for source, values in _by_time(results, name, 0.0, "psnr_db").items():
            last = max(values)
            if last <= CLAIM_S or CLAIM_S not in values:
                continue
            gained = float(np.mean(values[last]) - np.mean(values[CLAIM_S]))
            figures.append(f"{source} gains {gained:.1f} dB from {CLAIM_S:g} to {last:g} s")
            if source == "paper" and gpu:
                held = gained <= _SETTLED_DB
    done = sum(bool(one.data) for one in results)
    answers = {"training": Answer(held, ", ".join(figures), done)} if done else {}
    return Section("Training time (V.B, Fig. 5)", parts, answers)


def _by_time(results: Sequence[Result], name: str, distance_m: float, key: str) -> Series:
    """Return the values of a family of worlds at a distance, by source and training time."""
    found: Series = {}
    for one in results:
        for row in one.data.get("rows", ()):
            if family(one) == name and row["distance_m"] == distance_m:
                found.setdefault(row["source"], {}).setdefault(row["seconds"], []).append(row[key])
    return found
