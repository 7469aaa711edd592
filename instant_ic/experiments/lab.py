"""Runs the paper's experiments (section V): units of work in parallel, each kept as a file, so that a run resumes.

An experiment is a module with ``units(options)``, ``measure(arguments)`` and ``section(results, options)``; ``measure``
takes and returns what JSON has. ``report`` writes the sections as one page.
"""

from __future__ import annotations

import functools
import hashlib
import importlib
import importlib.metadata
import json
import os
import platform
import time
import traceback
from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any

from instant_ic.experiments.places import KINDS
from instant_ic.experiments.processes import LostError, run_all
from instant_ic.experiments.results import finite, save_json
from instant_ic.util.paths import share_dir

EXPERIMENTS = ("reconstruction", "training-time", "ablation", "teleoperation", "operators", "environments")
"""Each is a module of this package."""
WORLD = "corridor"
"""Default world."""
UNIT_TIMEOUT_S = 1800.0
GENERATED = ("corridor", "corridor-free", "random", "long", *KINDS)
"""Worlds that have seeds."""


@dataclass(frozen=True)
class Options:
    """What to measure.

    Attributes:
        seeds: number of seeds, 0 first.
        worlds: names of ``sim.worlds.make_world``. A world of the simulator without a seed gets each seed; a mesh file
            gets its own start, then random free ones. Empty: the experiment's own.
        method: ``ours`` or ``paper``: the virtual space that is compared.
        bag: recording to use instead of worlds; None: none.
        meshes: mesh files that are environments beside the simulator's own.
        quick: small images, two seeds and short training, to see whether everything works.
        size: width and height of the views; None: 320 × 180, quick 96 × 54.
    """

    seeds: int = 5
    worlds: tuple[str, ...] = ()
    method: str = "ours"
    bag: Path | None = None
    quick: bool = False
    size: tuple[int, int] | None = None
    meshes: tuple[str, ...] = ()

    @property
    def view_size(self) -> tuple[int, int]:
        return self.size or ((96, 54) if self.quick else (320, 180))

    def cases(self, worlds: Sequence[str] = (WORLD,)) -> list[tuple[str, int]]:
        """World of each unit, and the seed of its start; 0: the world's own start."""
        numbers = range(2 if self.quick else self.seeds)
        found = []
        for world in self.worlds or worlds:
            if world in GENERATED:
                found += [(f"{world}:{seed}", 0) for seed in numbers]
            elif kind_of(world) in GENERATED:
                found.append((world, 0))
            else:
                found += [(world, seed) for seed in numbers]
        return list(dict.fromkeys(found))


def kind_of(world: str) -> str:
    """A world of the simulator without its seed; a mesh file as it is."""
    name = world.partition(":")[0]
    return name if name in GENERATED else world


@dataclass(frozen=True)
class Unit:
    """One unit of work.

    Attributes:
        arguments: all that the result depends on beside the program, as JSON has it.
        cost_s: expected CPU seconds, for the progress.
    """

    experiment: str
    arguments: dict[str, Any]
    cost_s: float = field(default=30.0, compare=False)

    @property
    def place(self) -> str:
        """World or recording, for people."""
        return str(self.arguments.get("world") or self.arguments.get("bag", ""))

    @property
    def key(self) -> str:
        """File name of the result: the same unit of the same program, versions and input files has the same."""
        text = json.dumps([self.experiment, self.arguments, program_hash(), _state_of(self.place)], sort_keys=True)
        return f"{self.experiment}-{hashlib.sha256(text.encode()).hexdigest()[:16]}"


@functools.cache
def program_hash() -> str:
    """Hash of what a result depends on: sources of package and nodes, parameters, models, versions of libraries."""
    package = Path(__file__).resolve().parents[1]
    sources = [path for path in package.rglob("*.py") if path.relative_to(package).parts[0] not in ("cli", "training")]
    shared = [path for name in ("nodes", "config", "models") for path in share_dir(name).iterdir() if path.is_file()]
    found = hashlib.sha256(json.dumps(machine(), sort_keys=True).encode())
    for path in (*sorted(sources), *sorted(shared)):
        found.update(path.name.encode() + hashlib.sha256(path.read_bytes()).digest())
    return found.hexdigest()


def _state_of(place: str) -> list[Any]:
    """Names, sizes and times of an input's files; empty for a world of the simulator."""
    path = Path(place)
    if not place or not path.exists():
        return []
    files = sorted(path.rglob("*")) if path.is_dir() else [path]
    return [[file.name, (state := file.stat()).st_size, state.st_mtime_ns] for file in files]


@dataclass(frozen=True)
class Result:
    """What ``measure`` returned for a unit and the time it took; empty ``data`` and an ``error`` where it failed."""

    unit: Unit
    data: dict[str, Any]
    wall_s: float
    cpu_s: float
    error: str = ""


def module(experiment: str) -> Any:
    """Module of an experiment, by its name."""
    return importlib.import_module(f"instant_ic.experiments.{experiment.replace('-', '_')}")


def kept(units: Sequence[Unit], folder: Path) -> list[Result]:
    """Results of an earlier run."""
    return [result for unit in units if (result := _load(unit, folder)) is not None]


def run(
    units: Sequence[Unit],
    folder: Path,
    jobs: int = 1,
    on_result: Callable[[Result], None] = lambda result: None,
    timeout_s: float = 86400.0,
    unit_timeout_s: float = UNIT_TIMEOUT_S,
) -> list[Result]:
    """Measure all units that have no result in the folder yet; results in the order of the units.

    The first seeds of all experiments come first. A unit that fails has a result with its error, which is not kept: the
    next run tries again. So has one whose process died, that took longer than ``unit_timeout_s`` and was ended, or that
    was not measured within ``timeout_s``.
    """
    folder.mkdir(parents=True, exist_ok=True)
    found = {result.unit.key: result for result in kept(units, folder)}
    waiting = [unit for unit in units if unit.key not in found]
    waiting.sort(key=lambda unit: int(unit.arguments.get("seed", 0)))

    def take(result: Result) -> None:
        found[result.unit.key] = result
        on_result(result)

    def lost(number: int, error: LostError) -> Result:
        return Result(waiting[number], {}, unit_timeout_s, 0.0, str(error))

    try:
        run_all(_measure, [(one, folder) for one in waiting], jobs, _prepare, take, timeout_s, unit_timeout_s, lost)
    except TimeoutError:
        missing = f"not measured: the time limit of {timeout_s:.0f} s was over"
        found = {unit.key: Result(unit, {}, 0.0, 0.0, missing) for unit in units} | found
    return [found[unit.key] for unit in units]


def machine() -> dict[str, str]:
    """CPU, operating system, and versions of what the figures depend on."""
    model = platform.processor() or platform.machine()
    info = Path("/proc/cpuinfo")
    if info.is_file():
        names = [line.partition(":")[2].strip() for line in info.read_text().splitlines() if "model name" in line]
        model = names[0] if names else model
    packages = ("instant-ic", "numpy", "numba", "onnxruntime", "opencv-contrib-python-headless", "scikit-image")
    return {
        "cpu": f"{model}, {os.cpu_count()} cores",
        "system": f"{platform.system()} {platform.machine()}",
        "python": platform.python_version(),
        **{name: importlib.metadata.version(name) for name in packages},
    }


def _measure(unit: Unit, folder: Path) -> Result:
    began, cpu = time.monotonic(), time.process_time()
    try:
        data = finite(module(unit.experiment).measure(unit.arguments))
    except Exception as error:  # noqa: BLE001 - one unit must not end a run of hours
        text = str(error)
        if not isinstance(error, ValueError | RuntimeError):  # a fault of the program, or of the system
            traceback.print_exc()
            text = f"{type(error).__name__}: {error}"
        return Result(unit, {}, time.monotonic() - began, time.process_time() - cpu, text)
    result = Result(unit, data, round(time.monotonic() - began, 2), round(time.process_time() - cpu, 2))
    save_json(folder / f"{unit.key}.json", asdict(result))
    return result


def _load(unit: Unit, folder: Path) -> Result | None:
    try:
        kept = json.loads((folder / f"{unit.key}.json").read_text(encoding="utf-8"))
        return Result(unit, dict(kept["data"]), float(kept["wall_s"]), float(kept["cpu_s"]))
    except (OSError, ValueError, KeyError, TypeError):  # none, or damaged: it is measured again
        return None


def _prepare() -> None:
    """Nothing is shared: each unit compiles or loads the kernels that it needs."""
