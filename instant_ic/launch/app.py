"""Runs a launch file in the foreground: what ``ic launch`` and ``make run`` do."""

from __future__ import annotations

import os
import sys
import time
from collections.abc import Sequence
from contextlib import ExitStack
from pathlib import Path

from instant_ic.bus import registry
from instant_ic.estop_state import RunMark
from instant_ic.launch.description import LaunchDescription
from instant_ic.launch.health import EVERY_NODES, HealthMonitor, TopicFault
from instant_ic.launch.outlet import Outlet
from instant_ic.launch.process import ManagedProcess, State
from instant_ic.launch.rundir import StackLock
from instant_ic.launch.screen import Row, Screen, View
from instant_ic.launch.supervisor import Supervisor
from instant_ic.launch.topics import nominal_rate
from instant_ic.pace import Pace
from instant_ic.pace import write as write_pace

_VIEW_PERIOD_S = 0.5
_WAITING_LINES = 2000  # lines that a terminal may be behind


def run_stack(description: LaunchDescription, run_dir: Path, live: bool | None = None, pace: Pace | None = None) -> int:
    """Starts everything, shows how it is, stops it.

    Args:
        description: what to start.
        run_dir: run directory; made if missing, with those of the groups in it.
        live: table of the nodes below the lines; default where standard output is a terminal.
        pace: of the stack's time; default the machine's.

    Returns:
        Exit status, see :meth:`Supervisor.run`.

    Raises:
        RegistryError: a run directory cannot be used.
        StackRunningError: another stack has one.
        EstopStateError: how this run ends could not be kept for the next start.
    """
    with ExitStack() as locks:
        for folder in description.run_dirs(run_dir):
            registry.prepare(folder)
            locks.enter_context(StackLock(folder, description.file.name))
            registry.sweep(folder)
            write_pace(folder, pace or Pace())
            locks.enter_context(RunMark(folder))
        output = _Output(description, run_dir, sys.stdout.isatty() if live is None else live)
        status = 1
        try:
            count = f"{len(description.nodes)} node{'' if len(description.nodes) == 1 else 's'}"
            output.event(f"{count} of {description.file}, run directory {run_dir}")
            if pace is not None and not pace.real:
                output.event(f"time goes at {pace.factor:g} of the machine's: for simulated devices only")
            status = Supervisor(
                description.nodes,
                run_dir,
                output,
                make_health=output.make_health,
                announcements=description.announcements,
                shutdown=description.shutdown,
            ).run()
        finally:
            output.close(status)
        return status


class _Output:
    """The screen, on a thread of its own so that a terminal that takes nothing does not hold up the stack."""

    def __init__(self, description: LaunchDescription, run_dir: Path, live: bool) -> None:
        self._description, self._run_dir = description, run_dir
        self._screen = Screen([node.label for node in description.nodes], live)
        self._outlet = Outlet("screen", _WAITING_LINES)
        self._outlet.put(self._screen.start, always=True)
        self._health: HealthMonitor | None = None
        self._ending = False
        self._left_out = 0  # lines for the terminal
        self._next_view_s = 0.0
        self._address: str | None = None

    def make_health(self) -> HealthMonitor:
        """Eyes on the bus; they open after the processes have been started, so that they need not wait."""
        self._health = HealthMonitor(self._description.nodes, self._run_dir)
        return self._health

    def node_line(self, node: str, text: str) -> None:
        """A line that a node has written."""
        if self._left_out and self._outlet.put(self._screen.event, f"{self._left_out} lines left out: see the logs"):
            self._left_out = 0
        if not self._outlet.put(self._screen.node_line, node, text):
            self._left_out += 1

    def event(self, text: str, bad: bool = False) -> None:
        """Something that the supervisor has done or seen."""
        self._outlet.put(self._screen.event, text, bad, always=True)

    def refresh(self, processes: Sequence[ManagedProcess]) -> None:
        """Looks twice a second."""
        if time.monotonic() >= self._next_view_s:
            self._next_view_s = time.monotonic() + _VIEW_PERIOD_S
            self._outlet.put(self._screen.refresh, self._view(processes))

    def stopping(self) -> None:
        """The end begins."""
        self._ending = True
        self._next_view_s = 0.0

    def _view(self, processes: Sequence[ManagedProcess]) -> View:
        health = self._health
        if health is None:
            return View(tuple(_row(process, None, []) for process in processes), looked=False, ending=self._ending)
        faults = health.topic_faults()
        # The token goes to a terminal only: what standard output is redirected to may be read by others.
        self._address = self._address or health.console_address(with_token=sys.stdout.isatty())
        if not self._ending:
            down = {p.spec.label: p.state.value for p in processes if p.state in (State.FAILED, State.WAITING)}
            health.publish(down, faults)
        return View(
            rows=tuple(_row(process, health, faults) for process in processes),
            missing=tuple(health.nodes_missing()),
            waiting=tuple(health.waiting_for()),
            address=self._address,
            faults=tuple(f"{fault.topic} of {fault.label}: {fault.words}" for fault in faults),
            ending=self._ending,
        )

    def close(self, status: int) -> None:
        """Shows the rest and takes the table away; where a terminal takes nothing, the process ends with ``status``."""
        self._outlet.put(self._screen.stop, always=True)
        if not self._outlet.close(timeout_s=3.0):
            # Its thread holds standard output, and the interpreter would wait for it for ever. The nodes have ended,
            # the logs are written.
            os._exit(status)
        if self._outlet.broken is not None:  # ic launch ... | head: what is still in the buffer can go nowhere
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
        (topic, rate_hz, topic not in own)
        for topic, rate_hz in health.rates_hz.items()
        if rate_hz > 0 and topic.rpartition("/")[2] not in EVERY_NODES
    )
    # Wrong ones first, then those with a known rate: what does not fit into the line matters least.
    order = sorted(sends, key=lambda send: (send[2], nominal_rate(send[0], process.spec.namespace) is None))
    return Row(label, state, health.cpu_percent, health.rss_mb, starts, text, tuple(order))
