"""V.E with simulated operators of several manners: obedience, time, path, image at the switch; no claim on people."""

from __future__ import annotations

import tempfile
from collections.abc import Sequence
from dataclasses import asdict, replace
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
COST_S = {"ic": 22.0, "mesh": 20.0, "stop": 9.0, "shared": 9.0}
"""CPU seconds of a drive."""


def units(options: Options) -> list[Unit]:
    """Each manner by each method; quick: the plain operator only.

    Raises:
        ValueError: a recording was given.
    """
    if options.bag is not None:
        raise ValueError("operators: --bag: a recorded robot does not react to another operator. Leave out --bag")
    return [
        Unit("operators", {"world": world, "seed": seed, "manner": manner, "method": method}, COST_S[method])
        for world in options.worlds or (RANDOM_CORRIDORS,)
        for seed in range(1 if options.quick else options.seeds)
        for manner in (("plain",) if options.quick else MANNERS)
        for method in METHODS
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
            start = course.world.spawn  # where the map begins
            scan_world(free, start, QUALITIES["tripod"], seed, file, start)
            settings = replace(settings, overrides=("nerf.space.source:=mesh", f"nerf.space.mesh:={file}"))
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
                into, back = (
                    [s["psnr_db"] for drive in own for s in drive["switches"] if s["to_virtual"] is way]
                    for way in (True, False)
                )
                lines.append(
                    [
                        f"{manner}, {method}",
                        f"{sum(drive['completed'] for drive in own)} of {len(own)}",
                        sum(drive["contacts"] for drive in own),
                        [drive["obedience"] for drive in own],
                        [drive["seconds"] for drive in own if drive["completed"]],
                        [drive["driven_m"] / drive["way_m"] for drive in own if drive["completed"] and drive["way_m"]],
                        into,
                        back,
                    ]
                )
    columns = (
        "manner, method", "completed", "contacts", "obedience", "time, s", "path ratio",
        "PSNR into, dB", "PSNR back, dB",
    )  # fmt: skip
    manners = [[name, *vars(manner).values()] for name, manner in MANNERS.items()]
    parts: list[Part] = [
        Text("Simulated operators; nothing is claimed about people."),
        Table("Operators", ("manner", "speed, share", "delay, s", "noise, share", "looks around after, s"), manners),
        Text(
            "mesh is conventional IC with a tripod scan made without the obstacles. PSNR: the two images on either "
            "side of a switch into the virtual space and back. Poses are those of the stack's own SLAM."
        ),
        Table("Drives", columns, lines, command_of(options, "operators")),
    ]
    return Section("Operators (V.E, simulated)", parts)
