"""The paper's experiments (section V): units of work in parallel, each kept as a file, so that a run resumes.

An experiment is a module with ``units(options)``, ``measure(arguments)`` and ``section(results, options)``; ``measure``
takes and returns JSON values. ``report`` writes the sections as one page.
"""

from __future__ import annotations

import functools
import importlib
import importlib.metadata
import json
import os
import platform
import time
import traceback
from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import joblib

from instant_ic.experiments.processes import LostError, run_all
from instant_ic.experiments.results import finite, save_json
from instant_ic.experiments.worlds import GENERATED
from instant_ic.util.paths import share_dir

EXPERIMENTS = ("reconstruction", "training-time", "ablation", "teleoperation", "operators", "environments")
"""Names of the experiments; each is a module of this package."""
WORLD = "corridor"
"""Default world."""
UNIT_TIMEOUT_S = 1800.0


@dataclass(frozen=True)
class Options:
    """Choice of what to measure.

    Attributes:
        seeds: number of seeds, 0 first.
        worlds: names of ``worlds.named_world``. A generated world without a seed gets each seed; a mesh file gets
            its own start, then random free ones. Empty: the experiment's own worlds.
        method: virtual space that is compared, ``ours`` or ``paper``.
        bag: recording to use instead of worlds; None: none.
        quick: small images, two seeds and short training, to check that everything works.
        meshes: mesh files that are environments beside the simulator's own.
    """

    seeds: int = 5
    worlds: tuple[str, ...] = ()
    method: str = "ours"
    bag: Path | None = None
    quick: bool = False
    meshes: tuple[str, ...] = ()

    def cases(self, worlds: Sequence[str] = (WORLD,)) -> list[tuple[str, int]]:
        """Return the world of each unit and the seed of its start; 0 is the world's own start."""
        seeds = range(2 if self.quick else self.seeds)
        found = []
        for world in self.worlds or worlds:
            if world in GENERATED:
                found += [(f"{world}:{seed}", 0) for seed in seeds]
            elif kind_of(world) in GENERATED:
                found.append((world, 0))
            else:
                found += [(world, seed) for seed in seeds]
        return list(dict.fromkeys(found))


def kind_of(world: str) -> str:
    """Return the name of a generated world without its seed, or the unchanged name of a mesh file."""
    name = world.partition(":")[0]
    return name if name in GENERATED else world


@dataclass(frozen=True)
class Unit:
    """One unit of work.

    Attributes:
        experiment: name of its experiment.
        arguments: JSON values on which the result depends, besides the program.
    """

    experiment: str
    arguments: dict[str, Any]

    @property
    def place(self) -> str:
        """World or recording."""
        return str(self.arguments.get("world") or self.arguments.get("bag", ""))

    @property
    def key(self) -> str:
        """File name of the result; it changes with arguments, program, versions of libraries and input files."""
        given = json.dumps(self.arguments, sort_keys=True)
        return f"{self.experiment}-{joblib.hash((given, program_hash(), _files_of(self.place)))}"


@functools.cache
def program_hash() -> str:
    """Return a hash of sources, nodes, parameters, models and versions of libraries."""
    package = Path(__file__).resolve().parents[1]
    shared = [path for name in ("nodes", "config", "models") for path in share_dir(name).iterdir() if path.is_file()]
    paths = sorted([*package.rglob("*.py"), *shared])
    return str(joblib.hash((machine(), [(path.name, path.read_bytes()) for path in paths])))


def _files_of(place: str) -> list[tuple[str, int, int]]:
    """Return names, sizes and times of an input's files; none for a generated world."""
    path = Path(place)
    if not place or not path.exists():
        return []
    files = sorted(path.rglob("*")) if path.is_dir() else [path]
    return [(file.name, file.stat().st_size, file.stat().st_mtime_ns) for file in files]


@dataclass(frozen=True)
class Result:
    """Values that ``measure`` returned for a unit, and the time it took. A failed unit has an ``error`` and no data."""

    unit: Unit
    data: dict[str, Any]
    wall_s: float
    cpu_s: float
    error: str = ""


def module(experiment: str) -> Any:
    """Return the module of an experiment."""
    return importlib.import_module(f"instant_ic.experiments.{experiment.replace('-', '_')}")


def kept(units: Sequence[Unit], folder: Path) -> list[Result]:
    """Return the results of an earlier run; damaged ones are left out."""
    found = []
    for unit in units:
        try:
            one = json.loads((folder / f"{unit.key}.json").read_text(encoding="utf-8"))
            found.append(Result(unit, dict(one["data"]), float(one["wall_s"]), float(one["cpu_s"])))
        except (OSError, ValueError, KeyError, TypeError):
            continue
    return found


def run(
    units: Sequence[Unit],
    folder: Path,
    jobs: int = 1,
    on_result: Callable[[Result], None] = lambda result: None,
    timeout_s: float = 86400.0,
    unit_timeout_s: float | None = UNIT_TIMEOUT_S,
) -> list[Result]:
    """Measure all units that have no result in the folder; return the results in the order of the units.

    The first seeds of all experiments come first. The result of a unit is an error if it fails, its process dies, it
    takes longer than ``unit_timeout_s``, or it is not measured within ``timeout_s``. Errors are not kept, so that the
    next run tries the unit again.
    """
    folder.mkdir(parents=True, exist_ok=True)
    found = {result.unit.key: result for result in kept(units, folder)}
    waiting = [unit for unit in units if unit.key not in found]
    waiting.sort(key=lambda unit: int(unit.arguments.get("seed", 0)))

    tasks = [(unit, folder) for unit in waiting]
    try:
        for result in run_all(measure, tasks, jobs, _nothing, timeout_s, unit_timeout_s):
            if isinstance(result, LostError):
                result = Result(waiting[result.number], {}, unit_timeout_s or 0.0, 0.0, str(result))
            found[result.unit.key] = result
            on_result(result)
    except TimeoutError:
        missing = f"not measured: the time limit of {timeout_s:.0f} s has passed"
        found = {unit.key: Result(unit, {}, 0.0, 0.0, missing) for unit in units} | found
    return [found[unit.key] for unit in units]


def machine() -> dict[str, str]:
    """Return CPU, operating system, and versions of the software on which the figures depend."""
    info = Path("/proc/cpuinfo")
    lines = info.read_text().splitlines() if info.is_file() else []
    names = [line.partition(":")[2].strip() for line in lines if line.startswith("model name")]
    packages = ("instant-ic", "numpy", "numba", "onnxruntime", "opencv-contrib-python-headless", "scikit-image")
    return {
        "cpu": f"{names[0] if names else platform.machine()}, {os.cpu_count()} cores",
        "system": f"{platform.system()} {platform.machine()}",
        "python": platform.python_version(),
        **{name: importlib.metadata.version(name) for name in packages},
    }


def measure(unit: Unit, folder: Path) -> Result:
    """Measure a unit and keep its result in the folder; an error becomes a result that is not kept."""
    began, cpu = time.monotonic(), time.process_time()
    try:
        data, error = finite(module(unit.experiment).measure(unit.arguments)), ""
    except (ValueError, RuntimeError) as failed:
        data, error = {}, str(failed)
    except Exception as failed:  # noqa: BLE001 - one unit must not end a run of hours
        traceback.print_exc()
        data, error = {}, f"{type(failed).__name__}: {failed}"
    result = Result(unit, data, round(time.monotonic() - began, 2), round(time.process_time() - cpu, 2), error)
    if not error:
        save_json(folder / f"{unit.key}.json", asdict(result))
    return result


def _nothing() -> None:
    """Prepare nothing: each unit compiles or loads the kernels that it needs."""
