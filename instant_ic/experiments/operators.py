"""V.E with simulated operators of several manners: obedience, time, path, image at the switch; no claim on people."""

from __future__ import annotations

import tempfile
from collections.abc import Sequence
from dataclasses import asdict
from functools import reduce
from pathlib import Path
from typing import Any

from instant_ic.experiments.compared import command_of
from instant_ic.experiments.illusion_truth import without
from instant_ic.experiments.lab import Options, Result, Unit
from instant_ic.experiments.report import Part, Section, Table, Text
from instant_ic.experiments.scan import QUALITIES, scan_world
from instant_ic.experiments.teleop import run_episode
from instant_ic.experiments.teleop_operator import MANNERS
from instant_ic.experiments.teleop_settings import TeleopSettings
from instant_ic.experiments.teleop_worlds import RANDOM_CORRIDORS

METHODS = ("ic", "mesh", "stop", "shared")
"""``mesh``: illusory control with the mesh of a ``tripod`` scan without the obstacles."""


def units(options: Options) -> list[Unit]:
    """Each manner by illusory control and by stopping; the plain operator by all methods."""
    pairs = [("plain", method) for method in METHODS]
    pairs += [(manner, method) for manner in MANNERS if manner != "plain" for method in ("ic", "stop")]
    worlds = options.worlds or (RANDOM_CORRIDORS,)
    return [
        Unit("operators", {"world": world, "seed": seed, "manner": manner, "method": method})
        for world in worlds
        for seed in range(1 if options.quick else options.seeds)
        for manner, method in (pairs[:1] if options.quick else pairs)
    ]


def measure(arguments: dict[str, Any]) -> dict[str, Any]:
    """Drive one course by one method."""
    method, seed = arguments["method"], arguments["seed"]
    shown = "ic" if method == "mesh" else method
    settings = TeleopSettings(1, seed, arguments["world"], (shown,), manner=arguments["manner"])
    with tempfile.TemporaryDirectory() as folder:
        if method == "mesh":
            course, file = settings.course(0), Path(folder) / "scan.glb"
            free = reduce(without, course.obstacles, course.world)
            scan_world(free, course.world.spawn, QUALITIES["tripod"], seed, file)
            x, y, yaw = course.world.spawn
            if (x, y, yaw) != (0.0, 0.0, 0.0):
                raise ValueError(f"world {arguments['world']!r}: mesh needs a start at the origin")
            words = ("nerf.space.source:=mesh", f"nerf.space.mesh:={file}")
            settings = TeleopSettings(1, seed, arguments["world"], (shown,), overrides=words, manner=settings.manner)
        (drive,) = run_episode(settings, 0)
    return {"drive": {key: value for key, value in asdict(drive).items() if key != "tracks"}}


def section(results: Sequence[Result], options: Options) -> Section:
    """A table of all manners and methods."""
    lines: list[list[Any]] = []
    done = [one for one in results if one.data]
    for manner in MANNERS:
        for method in METHODS:
            own = [
                one.data["drive"]
                for one in done
                if (one.unit.arguments["manner"], one.unit.arguments["method"]) == (manner, method)
            ]
            if own:
                psnr = [s["psnr_db"] for drive in own for s in drive["switches"] if s["psnr_db"] is not None]
                lines.append(
                    [
                        f"{manner}, {method}",
                        f"{sum(drive['completed'] for drive in own)} of {len(own)}",
                        sum(drive["contacts"] for drive in own),
                        [drive["obedience"] for drive in own],
                        [drive["seconds"] for drive in own if drive["completed"]],
                        [drive["driven_m"] / drive["way_m"] for drive in own if drive["completed"] and drive["way_m"]],
                        psnr,
                    ]
                )
    columns = ("manner, method", "completed", "contacts", "obedience", "time, s", "path ratio", "PSNR at switches, dB")
    manners = ", ".join(f"{name}: {manner}" for name, manner in MANNERS.items())
    parts: list[Part] = [
        Text(f"Simulated operators; nothing is claimed about people. {manners}."),
        Table("Drives", columns, lines, command_of(options, "operators")),
    ]
    return Section("Operators (V.E, simulated)", parts)
