"""Runs the paper's experiments (section V): units of work in parallel, each kept as a file, so that a run resumes.

An experiment is a module with ``units(options)``, ``measure(arguments)`` and ``section(results, options)``; ``measure``
takes and returns what JSON has. ``report`` writes the sections as one page.
"""

from __future__ import annotations

import hashlib
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

from instant_ic.experiments.processes import run_all
from instant_ic.experiments.results import finite, save_json

EXPERIMENTS = {
    "reconstruction": "reconstruction",
    "training-time": "training_time",
    "ablation": "ablation",
    "teleoperation": "teleoperation",
    "operators": "operators",
    "environments": "environments",
}
"""Name of each experiment → its module in this package."""
WORLD = "corridor"
"""Default world."""
GENERATED = ("corridor", "corridor-free", "random", "long")
"""Worlds that have seeds."""


@dataclass(frozen=True)
class Options:
    """What to measure.

    Attributes:
        seeds: number of seeds, 0 first.
        worlds: names of ``sim.worlds.make_world``. A world of the simulator without a seed gets each seed; a mesh file
            gets its own start, then random free ones. Empty: the experiment's own.
        method: ``ours`` or ``paper``: the virtual space that is compared.
        bag: recording to use instead of worlds, for experiments that compare views; None: none.
        quick: small images, two seeds and short training, to see whether everything works.
        size: width and height of the views; None: 320 × 180, quick 96 × 54.
    """

    seeds: int = 5
    worlds: tuple[str, ...] = ()
    method: str = "ours"
    bag: Path | None = None
    quick: bool = False
    size: tuple[int, int] | None = None

    def __post_init__(self) -> None:
        if self.seeds < 1:
            raise ValueError(f"seeds must be at least 1 (got {self.seeds})")
        if self.method not in ("ours", "paper"):
            raise ValueError(f"method must be ours or paper (got {self.method!r})")

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
    """One unit of work: an experiment and all that its result depends on, as JSON has it."""

    experiment: str
    arguments: dict[str, Any]

    @property
    def place(self) -> str:
        """World or recording, for people."""
        return str(self.arguments.get("world") or self.arguments.get("bag", ""))

    @property
    def key(self) -> str:
        """File name of the result: the same unit of the same version has the same."""
        text = json.dumps([self.experiment, self.arguments, importlib.metadata.version("instant-ic")], sort_keys=True)
        return f"{self.experiment}-{hashlib.sha256(text.encode()).hexdigest()[:16]}"


@dataclass(frozen=True)
class Result:
    """What a unit measured.

    Attributes:
        unit: of the measurement.
        data: as ``measure`` returned it; empty where it failed.
        wall_s, cpu_s: time it took.
        error: why it failed; empty where it did not.
    """

    unit: Unit
    data: dict[str, Any]
    wall_s: float
    cpu_s: float
    error: str = ""


def module(experiment: str) -> Any:
    """Module of an experiment, by its name."""
    return importlib.import_module(f"instant_ic.experiments.{EXPERIMENTS[experiment]}")


def run(
    units: Sequence[Unit],
    folder: Path,
    jobs: int = 1,
    on_result: Callable[[Result], None] = lambda result: None,
    timeout_s: float = 86400.0,
) -> list[Result]:
    """Measure all units that have no result in the folder yet; results in the order of the units.

    A unit that fails has a result with its error, which is not kept: the next run tries again.

    Raises:
        TimeoutError: the units took longer than ``timeout_s``; finished ones are kept.
        RuntimeError: a process died.
    """
    folder.mkdir(parents=True, exist_ok=True)
    found = {unit.key: _load(unit, folder) for unit in units}
    for result in found.values():
        if result is not None:
            on_result(result)
    tasks = [(unit, folder) for unit in units if found[unit.key] is None]
    for result in run_all(_measure, tasks, jobs, _prepare, on_result, timeout_s):
        found[result.unit.key] = result
    return [result for unit in units if (result := found[unit.key]) is not None]


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
        "system": platform.platform(terse=True),
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
