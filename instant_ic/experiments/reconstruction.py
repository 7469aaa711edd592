"""V.A, Figs. 3, 4 and 7: the virtual space of one panorama against conventional IC of a perfect and a real scan."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np

from instant_ic.experiments.compared import (
    command_of,
    curves_and_tables,
    family,
    measure_views,
    of_the_paper,
    series,
    view_units,
)
from instant_ic.experiments.lab import WORLD, Options, Result, Unit
from instant_ic.experiments.report import Answer, Part, Section, Table, Text, spread
from instant_ic.experiments.vspace_sources import PATHS

measure = measure_views
_SCANS = ("mesh", "tripod")
_CLAIM_M = {"straight": 2.0, "curve": 1.0}
"""Distances of the paper's claim: SSIM is above for about 2 m straight, and for 1 to 2 m on the curve."""
_PAPERS_SCAN = "tripod"
"""The paper's scanner is a FARO Focus3D on a tripod."""


def units(options: Options) -> list[Unit]:
    """Return units with all sources in each world."""
    worlds = (WORLD,) if options.quick else (WORLD, "random")
    return view_units("reconstruction", options, (options.method, *_SCANS), worlds)


def section(results: Sequence[Result], options: Options) -> Section:
    """Return curves, tables, and the distance up to which ours is better than each scan."""
    command = command_of(options, "reconstruction")
    parts: list[Part] = [
        Text(
            "One panorama at the start. Conventional IC shows a mesh that was scanned before: by stations with range "
            "noise, registration errors and another exposure and white balance, meshed in a grid. Its colours are "
            "fitted to the panorama by one factor per channel. mesh is a perfect scan, the upper bound. In the paper, "
            "with a tripod scanner, instant IC has the higher SSIM for about 2 m straight and for 1 to 2 m on the "
            "curve. Views are rendered at true poses."
        ),
    ]
    for name in dict.fromkeys(family(one) for one in results if one.data):
        lines = []
        for scan in _SCANS:
            line: list[Any] = [scan]
            for path in PATHS:
                line += [_above(results, name, path, key, options.method, scan) for key in ("ssim", "psnr_db")]
            if any(line[1:]):
                lines.append(line)
        columns = ("scan", *(f"{path}, {key}" for path in PATHS for key in ("SSIM", "PSNR")))
        title = f"{name}: metres from the panorama up to which {options.method} is above"
        if lines:
            parts.append(Table(title, columns, lines, command))
    paper = of_the_paper(results)
    answers = {}
    for path, claim in _CLAIM_M.items():
        reach = [each for name in dict.fromkeys(map(family, paper)) for each in _above(
            paper, name, path, "ssim", options.method, _PAPERS_SCAN)]  # fmt: skip
        figures = f"{options.method} is above the {_PAPERS_SCAN} scan up to {spread(reach, 1)} m"
        answers[path] = Answer(bool(np.mean(reach) >= claim), figures, len(reach)) if reach else Answer(None, "")
    parts += curves_and_tables(results, command)
    return Section("Reconstruction accuracy (V.A, Figs. 3, 4, 7)", parts, answers)


def _above(results: Sequence[Result], name: str, path: str, key: str, ours: str, scan: str) -> list[float]:
    """Return the distance up to which ours is better than a scan without a break, one for each seed."""
    found = []
    for one in results:
        values = series([one], name, path, key)
        if ours in values and scan in values:
            reach = 0.0
            for at in sorted(at for at in values[ours] if at > 0):
                if values[ours][at][0] <= values[scan].get(at, [np.inf])[0]:
                    break
                reach = at
            found.append(reach)
    return found
