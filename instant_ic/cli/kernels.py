"""Compilation of all numba kernels before the first start, which would otherwise take a minute longer."""

from __future__ import annotations

import fcntl
import hashlib
import os
import platform
import signal
import subprocess
import sys
import time
from collections.abc import Callable
from importlib import import_module
from importlib.metadata import version
from pathlib import Path

from instant_ic.launch.process import dies_with_us
from instant_ic.util import paths

PARTS = {
    "control": ("warmup",),
    "vspace": ("warm_up",),
    "slam": ("start", "loop_search"),
    "sim": ("simulation",),
    "mapping": ("local_model",),
    "lidar": ("flatscan",),
}
"""Packages with kernels, in order of falling compilation time, and the modules whose ``warm_up()`` runs every kernel.

Each package is compiled in a process of its own."""

_PACKAGE = Path(__file__).resolve().parents[1]


def are_compiled() -> bool:
    """Return whether :func:`compile_all` has finished for these sources, this numba and this CPU."""
    try:
        # The key comes first, because it imports modules and Python can lose a Ctrl-C during an import.
        return source_key() == (cache_folder() / "kernels.txt").read_text()
    except OSError:
        return False


def compile_all(report: Callable[[float], None]) -> list[str]:
    """Compile the kernels that numba's cache lacks, with one process per core.

    A second caller waits for the first one and then has nothing to do.

    Args:
        report: function called with the completed share, 0 to 1.

    Returns:
        A text for each part that cannot be compiled. The nodes that need such a part try again at their start.
    """
    with (cache_folder() / "kernels.lock").open("w") as file:
        fcntl.flock(file, fcntl.LOCK_EX)
        if are_compiled():
            return []
        key = source_key()
        problems = _compile_parts(report)
        if not problems:
            (cache_folder() / "kernels.txt").write_text(key)
        return problems


def _compile_parts(report: Callable[[float], None]) -> list[str]:
    waiting, running, problems = list(PARTS), dict[str, subprocess.Popen[str]](), list[str]()
    while waiting or running:
        while waiting and len(running) < len(os.sched_getaffinity(0)):
            command = (*dies_with_us(), sys.executable, "-m", "instant_ic.cli.kernels", part := waiting.pop(0))
            running[part] = subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True)
        time.sleep(0.1)
        for part, process in list(running.items()):
            if process.poll() is not None:
                lines = process.communicate()[0].strip().splitlines() or [""]
                del running[part]
                if process.returncode != 0:
                    problems.append(f"the kernels of {part} cannot be compiled: {lines[-1]}")
        report(1.0 - (len(waiting) + len(running)) / len(PARTS))
    return problems


def cache_folder() -> Path:
    """Return the folder of the lock and of kernels.txt; numba chooses the folder of its cache by the same rule."""
    beside = _PACKAGE / "__pycache__"
    if given := os.environ.get("NUMBA_CACHE_DIR"):
        folder = Path(given)
    else:
        folder = beside if os.access(beside if beside.exists() else _PACKAGE, os.W_OK) else paths.cache_dir()
    folder.mkdir(parents=True, exist_ok=True)
    return folder


def source_key(package: Path = _PACKAGE) -> str:
    """Return a text that changes when numba must compile again: after a change of source, numba, Python or CPU."""
    digest = hashlib.sha256(f"{package} {version('numba')} {sys.version} {platform.machine()}".encode())
    for file in sorted(package.rglob("*.py")):
        if b"numba" in (source := file.read_bytes()):
            digest.update(f"{file} {file.stat().st_mtime_ns}".encode() + source)
    for line in Path("/proc/cpuinfo").read_text().splitlines():
        if not line:
            break  # one core is enough, the others are alike
        if line.startswith(("model name", "flags")):
            digest.update(line.encode())
    return digest.hexdigest()


def main() -> None:
    """Compile one part, in a process of its own: ``python -m instant_ic.cli.kernels PART``."""
    signal.signal(signal.SIGINT, signal.SIG_DFL)  # Ctrl-C ends the process even inside the compiler
    part = sys.argv[1]
    for module in PARTS[part]:
        import_module(f"instant_ic.{part}.{module}").warm_up()


if __name__ == "__main__":
    main()
