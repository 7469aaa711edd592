"""The emergency stop over killed processes and a killed launcher, with real ones."""

from __future__ import annotations

import asyncio
import contextlib
import os
import shutil
import signal
import tempfile
import time
from collections.abc import Callable, Iterator
from pathlib import Path

import aiohttp
import pytest

from instant_ic.bus import LATCHED, registry
from instant_ic.console.client import ConsoleClient
from instant_ic.experiments.stack import Stack, free_port, processes_of
from instant_ic.msg import ControlState, stamp_ns

pytestmark = [pytest.mark.system, pytest.mark.timeout(600)]
WAIT_S = 120.0
LAUNCH = """launch:
- node: {{exec: arbiter, param: [{{from: $(config control.yaml)}}], respawn: true}}
- node:
    exec: console
    param:
    - from: $(config console.yaml)
    - {{name: server.port, value: {port}}}
    - {{name: server.access.simulated, value: true}}
    respawn: true
"""


@pytest.fixture
def run_dir() -> Iterator[Path]:
    folder = Path(tempfile.mkdtemp(prefix="ic-"))
    yield folder
    shutil.rmtree(folder, ignore_errors=True)


def operate(port: int, does: Callable[[ConsoleClient], object]) -> None:
    """Has a page that drives do something; the console may just be starting."""

    async def once() -> None:
        async with ConsoleClient(f"http://127.0.0.1:{port}/") as page:
            await page.acquire(take=True, timeout_s=30.0)
            await does(page)  # type: ignore[misc]
            await asyncio.sleep(0.3)

    deadline = time.monotonic() + WAIT_S
    while True:
        try:
            return asyncio.run(once())
        except (OSError, TimeoutError, aiohttp.ClientError):
            if time.monotonic() > deadline:
                raise
            time.sleep(0.3)


def pids(run_dir: Path) -> dict[str, int]:
    return {node.name: node.pid for node in registry.list_nodes(run_dir)}


def newest_state(stack: Stack, arbiter: int, what: str) -> ControlState:
    """The first state of this arbiter that was published after the call."""
    states = stack.collect("/ic/state", ControlState, LATCHED)
    since_ns = time.time_ns()
    stack.wait_for(lambda: states and stamp_ns(states[-1]) > since_ns and pids(stack.run_dir).get("arbiter") == arbiter,
                   WAIT_S, what)  # fmt: skip
    return states[-1]


def test_a_pressed_stop_outlives_its_processes_and_a_killed_launcher(run_dir: Path) -> None:
    port = free_port()
    launch = run_dir / "estop.yaml"
    launch.write_text(LAUNCH.format(port=port))
    with contextlib.ExitStack() as ends:
        stack = Stack(str(launch), run_dir, {})
        ends.callback(stack.__exit__, None, None, None)
        stack.__enter__()
        states = stack.collect("/ic/state", ControlState, LATCHED)
        stack.wait_for(lambda: states and {"arbiter", "console"} <= set(pids(run_dir)), WAIT_S, "both nodes")
        assert not states[-1].estop
        operate(port, ConsoleClient.estop)
        stack.wait_for(lambda: states[-1].estop, WAIT_S, "emergency stop")
        for killed in (("arbiter",), ("console",), ("arbiter", "console")):
            before = pids(run_dir)
            for name in killed:
                os.kill(before[name], signal.SIGKILL)

            def again(before: dict[str, int] = before, killed: tuple[str, ...] = killed) -> bool:
                now = pids(run_dir)
                return all(now.get(name, before[name]) != before[name] for name in killed)

            stack.wait_for(again, WAIT_S, f"{killed} again")
            assert newest_state(stack, pids(run_dir)["arbiter"], "state").estop, killed
        assert stack.process is not None
        stack.process.kill()
        stack.process.wait(30)
        deadline = time.monotonic() + WAIT_S
        while processes_of(run_dir):
            assert time.monotonic() < deadline, "nodes outlive their launcher"
            time.sleep(0.1)
    with Stack(str(launch), run_dir, {}) as stack:
        states = stack.collect("/ic/state", ControlState, LATCHED)
        stack.wait_for(lambda: states, WAIT_S, "state after the launcher was killed")
        assert states[-1].estop
        assert states[-1].reason == (
            "The last run did not end cleanly while the emergency stop was pressed. "
            "Release the emergency stop to continue."
        )
        operate(port, ConsoleClient.release_estop)
        stack.wait_for(lambda: not states[-1].estop, WAIT_S, "release")
        assert stack.stop(60) == 0
    assert not (run_dir / "estop.json").exists() and not (run_dir / "run.json").exists()
