"""Shared parts of the experiments on views: units, rows by source and distance, curves, tables and image strips."""

from __future__ import annotations

import shlex
from collections.abc import Iterator, Sequence
from dataclasses import asdict
from pathlib import Path
from typing import Any

import numpy as np

from instant_ic.experiments.lab import WORLD, Options, Result, Unit, kind_of
from instant_ic.experiments.plots import Series, curves_svg, image_strip, jpeg
from instant_ic.experiments.recorded import count_keyframes
from instant_ic.experiments.report import Figure, Part, Table, image_address
from instant_ic.experiments.vspace import compare, compare_recorded
from instant_ic.experiments.vspace_sources import PATHS, RECORDED, VspaceSettings

TABLE_M = (0.5, 1.0, 1.5, 2.0, 2.5, 3.0)
"""Distances of the tables."""
UNSHOWN = ("fill", "slam-pose")
"""Sources left out of the strips: they look like others."""
LABELS = {"psnr_db": "PSNR, dB", "ssim": "SSIM"}
_TILE_PX = 240


def view_units(
    experiment: str,
    options: Options,
    sources: Sequence[str],
    worlds: Sequence[str],
    paths: Sequence[str] = PATHS,
    keep_images: bool = True,
    **settings: Any,
) -> list[Unit]:
    """Return a unit for each world and seed, or for some keyframes of a recording.

    Args:
        experiment: name of the experiment.
        options: choice of what to measure.
        sources: sources of views.
        worlds: worlds if the options name none.
        paths: paths of ``PATHS``.
        keep_images: keep images of the first world of each kind.
        settings: further values of ``VspaceSettings``.
    """
    common: dict[str, Any] = {
        "method": options.method,
        "sources": list(sources),
        "paths": list(paths),
        "size": [96, 54] if options.quick else [320, 180],
        "panorama_width": 512 if options.quick else 2048,
        "seconds": 0.5 if options.quick else 8.0,
        "step_m": 0.5 if options.quick else 0.25,
        "reach_m": 2.0 if options.quick else 4.0,
        **settings,
    }
    if options.bag is not None:
        common |= {"bag": str(options.bag), "paths": ["straight"], "seed": 0}
        common["sources"] = [name for name in sources if name in RECORDED]
        count = count_keyframes(options.bag) - 1
        chosen = sorted({round(at) for at in np.linspace(0, count - 1, min(options.seeds, count))})
        return [
            Unit(experiment, {**common, "number": number, "images": keep_images and number == chosen[0]})
            for number in chosen
        ]
    cases = options.cases(worlds)
    shown = {kind_of(world): (world, seed) for world, seed in reversed(cases)}  # the first of each kind
    units = []
    for world, seed in cases:
        images = keep_images and shown[kind_of(world)] == (world, seed)
        own = {"world": world, "seed": _seed_of(world, seed), "start_seed": seed, **common, "images": images}
        units.append(Unit(experiment, own))
    return units


def _seed_of(world: str, start_seed: int) -> int:
    """Return the seed in a world's name, or the seed of its start."""
    own = world.partition(":")[2]
    return int(own) if own.isdigit() else start_seed


def measure_views(arguments: dict[str, Any]) -> dict[str, Any]:
    """Compare the sources in one world; return the rows, and an image strip for each path if images are kept."""
    given: dict[str, Any] = {
        key: tuple(value) if isinstance(value, list) else value
        for key, value in arguments.items()
        if key not in ("world", "images", "bag", "number")
    }
    settings = VspaceSettings(**given)
    if "bag" in arguments:
        comparison = compare_recorded(Path(arguments["bag"]), settings, arguments["number"])
    else:
        comparison = compare(arguments["world"], settings)
    images = {}
    for path, strip in comparison.strips.items() if arguments["images"] else ():
        first = next(iter(strip.values()))
        columns = [name for name in ("truth", *settings.sources) if name in first and name not in UNSHOWN]
        rows = [(f"{at:g} m", [strip[at][name] for name in columns]) for at in sorted(strip)]
        images[path] = image_address(jpeg(image_strip(columns, rows, _TILE_PX)))
    return {
        "depth": comparison.depth,
        "slam_error_m": comparison.slam_error_m,
        "rows": [asdict(row) for row in comparison.rows],
        "images": images,
    }


def family(result: Result) -> str:
    """Return the world without its seed, or the recording; results of one family are averaged."""
    given = result.unit.arguments
    return str(given["bag"]) if "bag" in given else kind_of(given["world"])


def rows(results: Sequence[Result], of_family: str, path: str) -> Iterator[dict[str, Any]]:
    """Yield all rows of a family of worlds along a path."""
    for result in results:
        if family(result) == of_family:
            yield from (row for row in result.data.get("rows", ()) if row["path"] == path)


def series(results: Sequence[Result], of_family: str, path: str, key: str) -> Series:
    """Return values over the seeds, by source and distance."""
    found: Series = {}
    for row in rows(results, of_family, path):
        found.setdefault(row["source"], {}).setdefault(row["distance_m"], []).append(row[key])
    return found


def curves_and_tables(results: Sequence[Result], command: str) -> list[Part]:
    """Return curves, tables of PSNR and SSIM for each path, and image strips of each family of worlds."""
    parts: list[Part] = []
    for name in dict.fromkeys(family(one) for one in results if one.data):
        paths = [path for path in (*PATHS, "recorded") if any(True for _ in rows(results, name, path))]
        panels = [
            (f"{path}: distance from the panorama, m", label, series(results, name, path, key))
            for path in paths
            for key, label in LABELS.items()
        ]
        parts.append(Figure(f"{name}: PSNR and SSIM by distance", curves_svg(panels), command))
        for path in paths:
            for key, label in LABELS.items():
                parts.append(_table(f"{name}, {path}: {label}", series(results, name, path, key), command))
        for one in results:
            if family(one) == name:
                for path, address in one.data.get("images", {}).items():
                    title = f"{one.unit.arguments.get('world', name)}, {path}"
                    parts.append(Figure(f"Views, {title}", address, command, wide=True))
    return parts


def of_the_paper(results: Sequence[Result]) -> list[Result]:
    """Return the results in corridors, the paper's kind of place, or all results if there are none."""
    done = [one for one in results if one.data]
    return [one for one in done if family(one) == WORLD] or done


def near_mean(results: Sequence[Result], source: str, key: str = "psnr_db") -> float | None:
    """Return the mean of a source over all paths from 0.5 to 2 m, or None if it has no views there."""
    found = [
        row[key]
        for one in results
        for row in one.data.get("rows", ())
        if row["source"] == source and 0.5 <= row["distance_m"] <= 2.0
    ]
    return float(np.mean(found)) if found else None


def command_of(options: Options, experiment: str) -> str:
    """Return the command that measures a section again."""
    quick = " --quick" if options.quick else f" --seeds {options.seeds}"
    method = "" if options.method == "ours" else f" --method {options.method}"
    where = "".join(f" --world {shlex.quote(world)}" for world in options.worlds)
    if options.bag is not None:
        where = f" --bag {shlex.quote(str(options.bag))}"
    if experiment == "environments":
        where += "".join(f" --meshes {shlex.quote(mesh)}" for mesh in options.meshes)
    return f"ic experiment {experiment}{where}{quick}{method} -o REPORT"


def _table(caption: str, found: Series, command: str) -> Table:
    distances = [at for at in TABLE_M if any(at in values for values in found.values())]
    lines = [[source, *(values.get(at, []) for at in distances)] for source, values in found.items()]
    return Table(caption, ["source", *(f"{at:g} m" for at in distances)], lines, command)
