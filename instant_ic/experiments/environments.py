"""V.F, Fig. 11: many kinds of places, and what is lost to depth, to unseen places and to the rest."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from instant_ic.experiments.compared import command_of, family, measure_views, rows, view_units
from instant_ic.experiments.lab import Options, Result, Unit
from instant_ic.experiments.report import Figure, Part, Section, Table, Text

measure = measure_views
_WORLDS = ("corridor", "random", "long")


def units(options: Options) -> list[Unit]:
    """The simulator's kinds of worlds; give meshes with ``--world``."""
    sources = (options.method, "true-depth", "exact-fill", "panorama")
    return view_units("environments", options, sources, _WORLDS)


def section(results: Sequence[Result], options: Options) -> Section:
    """PSNR of each world from 0.5 to 2 m, split into its losses, the worst first."""
    command = command_of(options, "environments")
    lines = []
    for one in results:
        found = {}
        for source in (options.method, "true-depth", "exact-fill", "panorama"):
            near = [
                row["psnr_db"]
                for path in ("straight", "curve")
                for row in rows([one], family(one), path)
                if row["source"] == source and 0.5 <= row["distance_m"] <= 2.0
            ]
            found[source] = float(np.mean(near)) if near else None
        ours, depth, fill = (found[source] for source in (options.method, "true-depth", "exact-fill"))
        if ours is None or depth is None or fill is None:
            continue
        error = one.data["depth"].get("straight", {}).get("mean_relative_error")
        world = one.unit.arguments["world"]
        lines.append([world, ours, depth - ours, fill - depth, found["panorama"], error])
    lines.sort(key=lambda line: float(line[1] or 0.0))
    parts: list[Part] = [
        Text(
            "Mean PSNR from 0.5 to 2 m. Lost to depth: what true depth would gain. Lost to unseen places: what "
            "the exact fill would gain beyond that. The rest is lost to resolution and to looks that depend on the "
            "direction of view. People walking are not part of this experiment."
        ),
        Table(
            "Environments, the worst first",
            (
                "world",
                f"{options.method}, dB",
                "depth, dB",
                "unseen, dB",
                "panorama, dB",
                "depth error",
            ),
            lines,
            command,
        ),
    ]
    for one in results:
        for path, address in one.data.get("images", {}).items():
            world = one.unit.arguments["world"]
            parts.append(Figure(f"Views, {world}, {path}", address, command))
    return Section("Environments (V.F, Fig. 11)", parts)
