"""Compilation of all numba kernels before the first start, which would wait a minute for them."""

from __future__ import annotations

import fcntl
import hashlib
import os
import platform
import signal
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable
from importlib import import_module
from importlib.metadata import version
from pathlib import Path
from typing import Any

from instant_ic.launch.process import dies_with_us
from instant_ic.util import paths

PARTS = {
    "control": ("warmup",),
    "vspace": ("warm_up",),
    "slam": ("grid_slam", "loop_search"),
    "sim": ("simulation",),
    "mapping": ("local_model",),
    "lidar": ("flatscan",),
}
"""Packages with kernels, the longest compilation first, and the modules whose ``warm_up()`` runs every kernel.

Each package is compiled in a process of its own."""

_PACKAGE = Path(__file__).resolve().parents[1]


def are_compiled() -> bool:
    """Whether :func:`compile_all` has finished for these sources, this numba and this CPU."""
    try:
        # The key first: it imports, and Python can lose a Ctrl-C during an import. The caller reports its start later.
        return _key() == (_folder() / "kernels.txt").read_text()
    except OSError:
        return False


def compile_all(report: Callable[[float], None]) -> list[str]:
    """Compile the kernels that numba's cache lacks, with a process per core.

    A second caller waits for the first and then has nothing to do.

    Args:
        report: called with the completed share, 0 to 1.

    Returns:
        A text for each part that cannot be compiled. The nodes that need it try again at their start.
    """
    with (_folder() / "kernels.lock").open("w") as file:
        fcntl.flock(file, fcntl.LOCK_EX)
        if are_compiled():
            return []
        key = _key()
        problems = _compile_parts(report)
        if not problems:
            (_folder() / "kernels.txt").write_text(key)
        return problems


def _compile_parts(report: Callable[[float], None]) -> list[str]:
    waiting, running = list(PARTS), list[_Compiler]()
    shares = dict.fromkeys(PARTS, 0.0)
    problems = []
    while waiting or running:
        while waiting and len(running) < len(os.sched_getaffinity(0)):
            running.append(_Compiler(waiting.pop(0)))
        time.sleep(0.1)
        for compiler in list(running):
            status = compiler.process.poll()
            shares[compiler.part] = compiler.share() if status is None else 1.0
            if status is not None:
                running.remove(compiler)
                if status != 0:
                    problems.append(f"the kernels of {compiler.part} cannot be compiled: {compiler.last_line()}")
        report(sum(shares.values()) / len(shares))
    return problems


class _Compiler:
    """A process that compiles one part. Its output is a line for each kernel, with the share completed."""

    def __init__(self, part: str) -> None:
        self.part = part
        self._output = tempfile.TemporaryFile("w+")  # noqa: SIM115 - as long as the process
        self.process = subprocess.Popen(
            (*dies_with_us(), sys.executable, "-m", "instant_ic.cli.kernels", part),
            stdout=self._output,
            stderr=subprocess.STDOUT,
        )

    def last_line(self) -> str:
        self._output.seek(0)
        return (self._output.read().strip().splitlines() or [""])[-1]

    def share(self) -> float:
        try:
            return float(self.last_line())
        except ValueError:  # no kernel yet, half a line, or a warning
            return 0.0


def _folder() -> Path:
    """Folder of the lock and the note; numba chooses the folder of its cache by the same rule."""
    beside = _PACKAGE / "__pycache__"
    if given := os.environ.get("NUMBA_CACHE_DIR"):
        folder = Path(given)
    else:
        folder = beside if os.access(beside if beside.exists() else _PACKAGE, os.W_OK) else paths.cache_dir()
    folder.mkdir(parents=True, exist_ok=True)
    return folder


def _key() -> str:
    """Text that changes with whatever makes numba compile again: a kernel's source file, numba, Python, the CPU."""
    digest = hashlib.sha256(f"{_PACKAGE} {version('numba')} {sys.version} {platform.machine()}".encode())
    for file in sorted(_PACKAGE.rglob("*.py")):
        if b"numba" in (source := file.read_bytes()):
            digest.update(f"{file} {file.stat().st_mtime_ns}".encode() + source)
    for line in Path("/proc/cpuinfo").read_text().splitlines():
        if not line:
            break  # the other cores are alike
        if line.startswith(("model name", "flags")):
            digest.update(line.encode())
    return digest.hexdigest()


def main() -> None:
    """Entry point of a compiling process: ``python -m instant_ic.cli.kernels PART``."""
    signal.signal(signal.SIGINT, signal.SIG_DFL)  # Ctrl-C ends it, even inside the compiler
    from numba.core import event
    from numba.core.dispatcher import Dispatcher

    finished = 0

    class Counter(event.Listener):
        def on_start(self, event: Any) -> None:
            pass

        def on_end(self, event: Any) -> None:
            nonlocal finished
            finished += 1
            modules = [module for name, module in sys.modules.items() if name.startswith("instant_ic.")]
            kernels = {
                id(value) for module in modules for value in vars(module).values() if isinstance(value, Dispatcher)
            }
            print(min(1.0, finished / len(kernels)), flush=True)

    with event.install_listener("numba:compile", Counter()):
        part = sys.argv[1]
        for module in PARTS[part]:
            import_module(f"instant_ic.{part}.{module}").warm_up()


if __name__ == "__main__":
    main()
