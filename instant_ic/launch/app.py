"""Run a launch file in the foreground; used by ``ic launch`` and ``make run``."""

from __future__ import annotations

import functools
import os
import sys
import threading
from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor
from contextlib import ExitStack
from pathlib import Path

from instant_ic.bus import registry
from instant_ic.launch.description import LaunchDescription
from instant_ic.launch.health import HealthMonitor, TopicFault
from instant_ic.launch.node_table import NodeRow, heartbeat_row
from instant_ic.launch.pacing import Pacing
from instant_ic.launch.process import ManagedProcess, ProcessState
from instant_ic.launch.rundir import stack_lock
from instant_ic.launch.screen import StackScreen, StackView
from instant_ic.launch.supervisor import Supervisor
from instant_ic.util.estop_state import RunMark
from instant_ic.util.pace import PaceFiles, describe, remove_files

_WAITING_LINES = 2000  # largest number of lines that a terminal may lag behind
_LAST_LINES_S = 2.0  # longest wait for a blocked terminal at the end


def run_stack(
    description: LaunchDescription,
    run_dir: Path,
    live: bool | None = None,
    pace: float | None = None,
    verbose: bool = False,
) -> int:
    """Start a launch file's nodes, show their state, and stop them at the end.

    Args:
        description: contents of the launch file.
        run_dir: run directory; created if missing, with the groups' run directories inside.
        live: show a table of the nodes below the lines; by default only if standard output is a terminal.
        pace: the stack's seconds per second of the machine; by default chosen by the load if the devices are simulated,
            else 1.
        verbose: show every line of the nodes' output; by default each warning and error after the start once.

    Returns:
        Exit status, see :meth:`Supervisor.run`.

    Raises:
        RegistryError: a run directory cannot be used.
        StackRunningError: another stack uses one of them.
        EstopStateError: the mark of a running stack cannot be written.
        PaceError: the pace is out of range.
    """
    folders = description.run_dirs(run_dir)
    with ExitStack() as locks:
        for folder in folders:
            registry.prepare(folder)
            locks.enter_context(stack_lock(folder, description.file.name))
            registry.sweep(folder)
            locks.enter_context(RunMark(folder))
        output = StackOutput(
            [node.label for node in description.nodes], sys.stdout.isatty() if live is None else live, verbose
        )
        status = 1
        try:
            count = f"{len(description.nodes)} node{'' if len(description.nodes) == 1 else 's'}"
            output.event(f"{count} of {description.file}, run directory {run_dir}")
            remove_files(folders)
            if pace is None and description.simulated:
                output.pacing = Pacing(folders, output.event)
            elif pace is not None and pace != 1.0:
                PaceFiles(folders, pace)
                output.event(f"{describe(pace, adapts=False)}, for simulated devices only")
            # The health monitor is made after the processes are started, so that they need not wait for it.
            make_health = functools.partial(HealthMonitor, description.nodes, run_dir)
            status = Supervisor(description.nodes, run_dir, output, make_health=make_health).run()
        finally:
            for folder in folders:
                registry.sweep(folder)
            try:
                locks.close()  # before a blocked terminal ends the process: this run has ended cleanly
            finally:
                output.close(status)
        return status


class StackOutput:
    """The launcher's screen, on a thread of its own.

    A terminal that is stopped with Ctrl-S, or a dead ssh connection, must not block the threads that read the nodes'
    pipes, or the nodes would block at their next line.
    """

    def __init__(self, labels: Sequence[str], live: bool, verbose: bool) -> None:
        self.pacing: Pacing | None = None
        self._screen = StackScreen(labels, live, verbose=verbose)
        self._printer = ThreadPoolExecutor(1, "screen")
        self._room = threading.BoundedSemaphore(_WAITING_LINES)
        self._view = self._printer.submit(self._screen.start)

    def node_line(self, node: str, text: str) -> None:
        """Show a line of a node, unless the terminal lags too far behind; the line is in the log anyway."""
        if self._room.acquire(blocking=False):
            self._printer.submit(self._screen.node_line, node, text).add_done_callback(lambda _: self._room.release())

    def event(self, text: str, bad: bool = False) -> None:
        """Show an event of the launcher."""
        self._printer.submit(self._screen.event, text, bad)

    def refresh(self, processes: Sequence[ManagedProcess], health: HealthMonitor | None, ending: bool) -> None:
        """Adapt the pace and show the present state, unless the previous state still waits for the terminal."""
        if self.pacing is not None and health is not None and not ending:
            self.pacing.step(health)
        view = stack_view(processes, health, ending, self.pacing.text if self.pacing is not None else "")
        if self._view.done():
            error = self._view.exception()
            if error is not None and not isinstance(error, OSError):
                self.event(f"the state cannot be shown: {error!r}", bad=True)
            self._view = self._printer.submit(self._screen.refresh, view)

    def close(self, status: int) -> None:
        """Show the remaining lines and remove the table; on a blocked terminal the process exits with ``status``."""
        try:
            self._printer.submit(self._screen.stop).result(_LAST_LINES_S)
        except TimeoutError:
            # The blocked thread holds standard output, and the interpreter would wait for it forever. By now the nodes
            # have ended and the logs are written.
            os._exit(status)
        except OSError:  # as in ic launch ... | head: the reader is gone
            os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        self._printer.shutdown()


def stack_view(
    processes: Sequence[ManagedProcess], health: HealthMonitor | None, ending: bool = False, pace: str = ""
) -> StackView:
    """Return the present state for the screen; also publish it for other tools."""
    if health is None:
        rows = tuple(node_row(process, None, []) for process in processes)
        return StackView(rows, looked=False, ending=ending)
    faults = health.topic_faults()
    if not ending:
        down = (ProcessState.FAILED, ProcessState.WAITING)
        health.publish({p.spec.label: p.state.value for p in processes if p.state in down}, faults)
    # The start does not wait for an optional node that has ended, such as a recorder whose disk is full.
    over = (ProcessState.FAILED, ProcessState.ENDED)
    gone = {p.spec.label for p in processes if p.state in over and not p.spec.respawn}
    return StackView(
        rows=tuple(node_row(process, health, faults) for process in processes),
        missing=tuple(label for label in health.nodes_missing() if label not in gone),
        waiting=tuple(health.waiting_for()),
        # Only a terminal gets the token, because other users may read a file or pipe.
        addresses=dict(health.addresses(with_token=sys.stdout.isatty())),
        faults=tuple(f"{fault.topic} of {fault.label}: {fault.text}" for fault in faults),
        ending=ending,
        pace=pace,
    )


def node_row(process: ManagedProcess, monitor: HealthMonitor | None, faults: Sequence[TopicFault]) -> NodeRow:
    """Return a node's row in the table, from its process, its heartbeat and the faults of its topics."""
    label, restarts = process.spec.label, process.limit.retries
    if process.state is not ProcessState.RUNNING:
        return NodeRow(label, process.state.value, process.reason, restarts=restarts)
    if process.ending:
        return NodeRow(label, "stopping", process.reason, restarts=restarts)
    health = monitor.nodes.get(label) if monitor is not None else None
    if health is None or health.seen_s < process.started_s:
        return NodeRow(label, "starting", restarts=restarts)
    row = heartbeat_row(label, health, restarts)
    own = [fault for fault in faults if fault.label == label]
    if row.state == "running" and own:
        row.state = "slow"
    row.message = row.message or ", ".join(f"{f.topic.lstrip('/')} {f.text}" for f in own if f.stopped)
    return row
