"""Check that a real base runs in real time."""

from __future__ import annotations

from pathlib import Path

from instant_ic.util.pace import Pace, PaceError


def refuse_pace(pace: Pace, port: str, run_dir: Path | None) -> None:
    """Refuse to run a real base on scaled time, because it would stop late.

    Raises:
        PaceError: the stack's time is scaled, and the port is not the simulator's port in the run directory.
    """
    if pace.real or (run_dir is not None and Path(port).is_relative_to(run_dir)):
        return
    raise PaceError(
        f"the stack runs at pace {pace.factor:g}, for simulated devices only, and {port} is not the simulator's (in "
        f"{run_dir}): start with --pace 1"
    )
