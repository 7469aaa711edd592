"""Run a launch file in the foreground; used by ``ic launch`` and ``make run``."""

from __future__ import annotations

import os
import sys
import time
from collections.abc import Sequence
from contextlib import ExitStack
from pathlib import Path

from instant_ic.bus import registry
from instant_ic.bus.heartbeat import EVERY_NODES
from instant_ic.launch.description import LaunchDescription
from instant_ic.launch.health import HealthMonitor, TopicFault
from instant_ic.launch.outlet import Outlet
from instant_ic.launch.pacing import Pacing
from instant_ic.launch.process import ManagedProcess, State
from instant_ic.launch.rundir import stack_lock
from instant_ic.launch.screen import Row, Screen, View
from instant_ic.launch.supervisor import Supervisor
from instant_ic.launch.topics import nominal_rate
from instant_ic.util.estop_state import RunMark
from instant_ic.util.pace import PaceFiles, describe, remove_files

_VIEW_PERIOD_S = 0.5
_WAITING_LINES = 2000  # how many lines a terminal may lag behind


def run_stack(
    description: LaunchDescription,
    run_dir: Path,
    live: bool | None = None,
    pace: float | None = None,
    verbose: bool = False,
) -> int:
    """Start everything, show its state, and stop it at the end.

    Args:
        run_dir: run directory; created if missing, with those of the groups inside.
        live: show a table of the nodes below the lines; default: only if standard output is a terminal.
        pace: of the stack's time. Default: what the machine can do, if the devices are simulated; else the machine's.
        verbose: show every line of the nodes' output; default: warnings and errors after the start, each once.

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
        output = _Output(description, run_dir, sys.stdout.isatty() if live is None else live, verbose)
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
            status = Supervisor(
                description.nodes,
                run_dir,
                output,
                make_health=output.make_health,
                announcements=description.announcements,
                shutdown=description.shutdown,
            ).run()
        finally:
            for folder in folders:
                registry.sweep(folder)
            output.close(status)
        return status


class _Output:
    """The screen, on a thread of its own so that a blocked terminal does not hold up the stack."""

    def __init__(self, description: LaunchDescription, run_dir: Path, live: bool, verbose: bool) -> None:
        self._description, self._run_dir = description, run_dir
        self._screen = Screen([node.label for node in description.nodes], live, verbose=verbose)
        self._outlet = Outlet("screen", _WAITING_LINES)
        self._outlet.put(self._screen.start, always=True)
        self._health: HealthMonitor | None = None
        self.pacing: Pacing | None = None
        self._ending = False
        self._left_out = 0  # lines not shown on the terminal
        self._next_view_s = 0.0
        self._reached = 0

    def make_health(self) -> HealthMonitor:
        """Create the health monitor, once the processes have been started, so that they need not wait for it."""
        self._health = HealthMonitor(self._description.nodes, self._run_dir)
        return self._health

    def node_line(self, node: str, text: str) -> None:
        if self._left_out and self._outlet.put(self._screen.event, f"{self._left_out} lines dropped: see the logs"):
            self._left_out = 0
        if not self._outlet.put(self._screen.node_line, node, text):
            self._left_out += 1

    def event(self, text: str, bad: bool = False) -> None:
        self._outlet.put(self._screen.event, text, bad, always=True)

    def refresh(self, processes: Sequence[ManagedProcess]) -> None:
        """Adapt the pace, and update the view twice a second and at each step of the start."""
        if self.pacing is not None and self._health is not None and not self._ending:
            self.pacing.step(self._health)
        reached = self._health.reached if self._health is not None and not self._ending else self._reached
        if time.monotonic() >= self._next_view_s or reached > self._reached:
            self._reached = reached
            self._next_view_s = time.monotonic() + _VIEW_PERIOD_S
            self._outlet.put(self._screen.refresh, self._view(processes))

    def stopping(self) -> None:
        self._ending = True
        self._next_view_s = 0.0

    def _view(self, processes: Sequence[ManagedProcess]) -> View:
        health = self._health
        if health is None:
            return View(tuple(_row(process, None, []) for process in processes), looked=False, ending=self._ending)
        faults = health.topic_faults()
        # Only a terminal gets the token: others may read the file or pipe that standard output goes to.
        addresses = health.addresses(with_token=sys.stdout.isatty())
        if not self._ending:
            down = {p.spec.label: p.state.value for p in processes if p.state in (State.FAILED, State.WAITING)}
            health.publish(down, faults)
        # Nothing waits for an optional node that has ended: a recorder whose disk is full.
        gone = {p.spec.label for p in processes if p.state in (State.FAILED, State.ENDED) and not p.spec.respawn}
        return View(
            rows=tuple(_row(process, health, faults) for process in processes),
            missing=tuple(label for label in health.nodes_missing() if label not in gone),
            waiting=tuple(health.waiting_for()),
            addresses=dict(addresses),
            faults=tuple(f"{fault.topic} of {fault.label}: {fault.words}" for fault in faults),
            ending=self._ending,
            pace=self.pacing.text if self.pacing is not None else "",
        )

    def close(self, status: int) -> None:
        """Show the remaining lines and remove the table; on a blocked terminal the process exits with ``status``."""
        self._outlet.put(self._screen.stop, always=True)
        if not self._outlet.close(timeout_s=3.0):
            # The blocked thread holds standard output, and the interpreter would wait for it forever. The nodes have
            # ended and the logs are written.
            os._exit(status)
        if self._outlet.broken is not None:  # ic launch ... | head: the rest of the buffer has no destination
            os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())


def _row(process: ManagedProcess, monitor: HealthMonitor | None, faults: Sequence[TopicFault]) -> Row:
    label, starts = process.spec.label, process.limit.retries
    if process.state is not State.RUNNING:
        return Row(label, process.state.value, starts=starts, text=process.reason)
    if process.ending:
        return Row(label, "stopping", starts=starts, text=process.reason)
    if not process.spec.heartbeat:
        return Row(label, "running", starts=starts)
    health = monitor.nodes.get(label) if monitor is not None else None
    if health is None or health.seen_s < process.started_s:
        return Row(label, "starting", starts=starts)
    own = {fault.topic: fault for fault in faults if fault.label == label}
    state = "silent" if health.silent else health.state
    if state == "running" and own:
        state = "slow"
    text = health.message or ", ".join(f"{f.topic.lstrip('/')} {f.words}" for f in own.values() if f.stopped)
    sends = tuple(
        (topic, flow.rate_hz, topic not in own)
        for topic, flow in health.outputs.items()
        if flow.rate_hz > 0 and not topic.endswith(EVERY_NODES)
    )
    # Faulty topics first, then those with a nominal rate: the least important ones may not fit into the line.
    order = sorted(sends, key=lambda send: (send[2], nominal_rate(send[0], process.spec.namespace) is None))
    return Row(label, state, health.cpu_percent, health.rss_mb, starts, text, tuple(order))
