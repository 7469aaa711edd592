"""Runs a launch file in the foreground: what ``ic launch`` and ``make run`` do."""

from __future__ import annotations

import sys
from collections.abc import Sequence
from pathlib import Path

from instant_ic.bus import registry
from instant_ic.launch.description import LaunchDescription
from instant_ic.launch.health import HealthMonitor
from instant_ic.launch.process import ManagedProcess
from instant_ic.launch.rundir import StackLock
from instant_ic.launch.screen import Screen
from instant_ic.launch.supervisor import Supervisor


def run_stack(description: LaunchDescription, run_dir: Path, live: bool | None = None) -> int:
    """Starts everything, shows how it is, stops it.

    Args:
        description: what to start.
        run_dir: run directory; made if missing.
        live: table of the nodes below the lines; default where standard output is a terminal.

    Returns:
        Exit status, see :meth:`Supervisor.run`.

    Raises:
        RegistryError: the run directory cannot be used.
        StackRunningError: another stack has it.
    """
    registry.prepare(run_dir)
    with StackLock(run_dir, description.file.name):
        registry.sweep(run_dir)
        names = [node.name for node in description.nodes]
        with Screen(names, sys.stdout.isatty() if live is None else live) as screen:
            screen.event(f"{len(names)} nodes of {description.file}, run directory {run_dir}")
            output = _WithHealth(screen, description, run_dir)
            try:
                return Supervisor(description.nodes, run_dir, output).run()
            finally:
                output.close()


class _WithHealth:
    """A screen whose eyes on the bus open after the processes have been started, so that they need not wait."""

    def __init__(self, screen: Screen, description: LaunchDescription, run_dir: Path) -> None:
        self._screen, self._description, self._run_dir = screen, description, run_dir
        self.node_line, self.event = screen.node_line, screen.event

    def refresh(self, processes: Sequence[ManagedProcess]) -> None:
        if self._screen.health is None:
            self._screen.health = HealthMonitor(self._description.nodes, self._run_dir)
        self._screen.refresh(processes)

    def stopping(self) -> None:
        self._screen.ending = True

    def close(self) -> None:
        if self._screen.health is not None:
            self._screen.health.close()
