"""V.E with a simulated operator: obedience, time, path and the image at a switch; nothing about people."""

from __future__ import annotations

import tempfile
from collections.abc import Sequence
from dataclasses import asdict, replace
from pathlib import Path
from typing import Any

from instant_ic.experiments.compared import command_of
from instant_ic.experiments.lab import Options, Result, Unit
from instant_ic.experiments.report import Part, Section, Table, Text
from instant_ic.experiments.scan import ScanQuality, scan_world
from instant_ic.experiments.teleop import TeleopSettings, run_episode
from instant_ic.experiments.teleop_worlds import RANDOM_CORRIDORS

METHODS = ("ic", "mesh", "stop")
"""``mesh``: illusory control with the mesh of a ``tripod`` scan without the obstacles."""


def units(options: Options) -> list[Unit]:
    """Return a drive by each method for each seed.

    Raises:
        ValueError: a recording was given.
    """
    if options.bag is not None:
        raise ValueError("operators: a recorded robot does not react to another operator. Leave out --bag")
    return [
        Unit("operators", {"world": world, "seed": seed, "method": method})
        for world in options.worlds or (RANDOM_CORRIDORS,)
        for seed in range(1 if options.quick else options.seeds)
        for method in METHODS
    ]


def measure(arguments: dict[str, Any]) -> dict[str, Any]:
    """Drive one course by one method."""
    method, seed = arguments["method"], arguments["seed"]
    settings = TeleopSettings(1, seed, arguments["world"], ("ic" if method == "mesh" else method,))
    with tempfile.TemporaryDirectory() as folder:
        if method == "mesh":
            course, file = settings.course(0), Path(folder) / "scan.glb"
            start = course.world.spawn  # where the map begins
            scan_world(course.free_world, start, ScanQuality(), seed, file, start)
            settings = replace(settings, overrides=("nerf.space.source:=mesh", f"nerf.space.mesh:={file}"))
        (drive,) = run_episode(settings, 0)
    return {"drive": {key: value for key, value in asdict(drive).items() if key != "tracks"}}


def section(results: Sequence[Result], options: Options) -> Section:
    """Return a table of all methods."""
    lines: list[list[Any]] = []
    for method in METHODS:
        own = [one.data["drive"] for one in results if one.data and one.unit.arguments["method"] == method]
        if own:
            done = [drive for drive in own if drive["completed"]]
            into, back = (
                [s["psnr_db"] for drive in own for s in drive["switches"] if s["to_virtual"] is way]
                for way in (True, False)
            )
            lines.append(
                [
                    method,
                    f"{len(done)} of {len(own)}",
                    sum(drive["contacts"] for drive in own),
                    [drive["obedience"] for drive in own],
                    [drive["seconds"] for drive in done],
                    [drive["driven_m"] / drive["way_m"] for drive in done if drive["way_m"]],
                    into,
                    back,
                ]
            )
    columns = (
        "method", "completed", "contacts", "obedience", "time, s", "path ratio", "PSNR into, dB", "PSNR back, dB",
    )  # fmt: skip
    parts: list[Part] = [
        Text(
            "The operator is simulated; nothing is claimed about people. mesh is conventional IC with a tripod scan "
            "made without the obstacles. PSNR compares the images before and after each switch into the virtual space "
            "and back. Poses are those of the stack's own SLAM."
        ),
        Table("Drives", columns, lines, command_of(options, "operators")),
    ]
    return Section("Operators (V.E, simulated)", parts)
