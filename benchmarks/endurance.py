#!/usr/bin/env python3
"""The whole simulated stack for an hour, while processes, links and the disk fail at random; prints JSON.

    nice python benchmarks/endurance.py --minutes 60 --seed 1 --json endurance.json
    python benchmarks/endurance.py --minutes 5 --light --only frozen

An operator drives through the obstacle of the corridor and back, repeatedly. Every few seconds one thing fails: a
process is frozen (SIGSTOP) or killed (SIGKILL), a link is cut, a recording's disk fills up, the recorder is killed, or
the emergency stop is pressed and processes are killed while it is latched. A stack that ended (simulator or launcher
killed, a required node given up) is restarted. Exit status 1 if one of these was found (``found``):

    moved       a true speed above 0.02 m/s later than ``--stand`` seconds after the loss of something the robot needs,
                0.25 s after the emergency stop, or after the operator released the controls during the loss
    orphan      a process of the stack that is still there after its end
    leak        memory or file descriptors of a process that grow steadily
    lost        messages that the recorder had acknowledged 5 s before its end and that its bag does not hold
    not back    the stack ended by itself, or could not be driven again within 90 s of a fault

Seconds of motion are those of the stack, which runs at the pace of the machine. The same seed gives the same faults.
"""

from __future__ import annotations

import argparse
import asyncio
import contextlib
import os
import random
import shutil
import signal
import subprocess
import sys
import tempfile
import time
from collections import Counter, defaultdict
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import aiohttp
import numpy as np
import psutil
from reporting import note, parser_of, report
from rosbags.highlevel import AnyReader
from stopping import LAUNCH, LINKS, Rig, driver, rig

from instant_ic.bag.errors import BagError
from instant_ic.bag.recover import recover
from instant_ic.bus import registry
from instant_ic.bus.control import ControlError, NodeControl
from instant_ic.console.client import ConsoleClient
from instant_ic.experiments.drive import pump
from instant_ic.experiments.stack import StackError, processes_of
from instant_ic.launch.nodes import NODE_MAIN
from instant_ic.launch.pacing import machine_pace
from instant_ic.launch.process import dies_with_us
from instant_ic.msg import ControlState, stamp_ns
from instant_ic.util.paths import node_file

MOVES_M_S = 0.02
ESTOP_STANDS_S = 0.25
SPEED_M_S = 0.38
BACK_S = 90.0
FLUSHED_S = 5.0
"""The recorder writes its buffers every second; a busy machine may take longer."""
DISK_MB = 192
LARGE_TOPICS = "[/lidar/points, /lidar/packets, /camera/*, /depth/*, /keyframe, /vspace/*, /map]"
WARM_S, JUDGED_S = 120.0, 300.0
"""A process's memory is evaluated from 120 s after its start, and only if that leaves 300 s."""
LEAK_MB, LEAK_FDS = 24.0, 4.0
"""Growth over the time judged."""

NEEDED = ("arbiter", "crawler_base", "console", "grid_slam", "vlp16_driver")
OTHERS = ("theta_camera", "virtual_robot", "navigator", "depth_estimator", "depth_scaler", "nerf")
FAULTS = (
    *(f"{node} {how}" for node in (*NEEDED, *OTHERS, "simulator") for how in ("frozen", "killed")),
    *LINKS,
    "launcher killed",
    "recorder killed",
    "disk full",
    *(
        f"emergency stop, then {nodes} killed"
        for nodes in ("arbiter", "console", "crawler_base", "arbiter and console")
    ),
)
RARE = ("simulator killed", "launcher killed")
"""These end the stack; its start takes longer than many faults."""


@dataclass
class Figures:
    """Counts of faults and findings."""

    faults: Counter[str] = field(default_factory=Counter)
    moving: Counter[str] = field(default_factory=Counter)
    """Faults while the robot was moving."""
    stacks: int = 0
    ends: Counter[str] = field(default_factory=Counter)
    bags: Counter[str] = field(default_factory=Counter)
    driven_m: float = 0.0
    found: list[dict[str, Any]] = field(default_factory=list)

    def report(self, kind: str, fault: str, **details: Any) -> None:
        """Record and print a violation."""
        self.found.append({"kind": kind, "fault": fault, **details})
        note(f"FOUND {self.found[-1]}")


def descriptors(pid: int) -> int:
    """Open descriptors of a process without the bus's shared buffers, whose number grows up to a fixed bound."""
    count = 0
    with contextlib.suppress(OSError):  # it has just ended
        for link in Path(f"/proc/{pid}/fd").iterdir():
            with contextlib.suppress(OSError):
                count += not str(link.readlink()).startswith("/memfd:")
    return count


class Levels:
    """Memory and descriptors of each process over time."""

    def __init__(self) -> None:
        self._rows: dict[tuple[str, int], list[tuple[float, float, int]]] = defaultdict(list)
        self._next_s = 0.0

    def look(self, run_dir: Path) -> None:
        """Sample every 5 s."""
        if time.monotonic() < self._next_s:
            return
        self._next_s = time.monotonic() + 5.0
        names = {info.pid: info.name for info in registry.list_nodes(run_dir)}
        for process in processes_of(run_dir):
            with contextlib.suppress(psutil.NoSuchProcess, psutil.AccessDenied):
                name = names.get(process.pid, "launcher" if process.ppid() == os.getpid() else "")
                if name:
                    row = (time.monotonic(), process.memory_info().rss / 1e6, descriptors(process.pid))
                    self._rows[name, process.pid].append(row)

    def judge(self) -> dict[str, dict[str, Any]]:
        """Growth in each process's longest life: ``rss_mb``, ``fds``, ``seconds``, ``leak``.

        Memory grows by the fitted line, and leaks if it does so in both halves: a step, as at the first loop closure,
        is no leak. Descriptors come and go with every process that connects: theirs is the difference of the lowest
        counts in the first and last third.
        """
        result: dict[str, dict[str, Any]] = {}
        for (name, _), rows in self._rows.items():
            late = np.array([row for row in rows if row[0] > rows[0][0] + WARM_S])
            span = float(late[-1, 0] - late[0, 0]) if len(late) > 10 else 0.0
            if span < JUDGED_S or span < result.get(name, {}).get("seconds", 0.0):
                continue
            parts = (late, late[: len(late) // 2], late[len(late) // 2 :])
            rss, *halves = (float(np.polyfit(part[:, 0], part[:, 1], 1)[0]) * span for part in parts)
            third = len(late) // 3
            fds = float(late[-third:, 2].min() - late[:third, 2].min())
            result[name] = {
                "seconds": round(span),
                "rss_mb": round(rss, 1),
                "of_mb": round(float(late[0, 1]), 0),
                "fds": round(fds, 1),
                "leak": min(rss, *halves) > max(LEAK_MB, 0.1 * float(late[0, 1])) or fds > LEAK_FDS,
            }
        return result


class Recording:
    """The benchmark's own recorder on a small disk, where each bag is checked and deleted."""

    def __init__(self, rig: Rig, disk: Path, figures: Figures) -> None:
        self._rig, self._disk, self._figures = rig, disk, figures
        self._number = 0
        self._acknowledged: list[tuple[float, int]] = []
        self._process: subprocess.Popen[bytes] | None = None
        self._next_s = 0.0

    @property
    def _bag(self) -> Path:
        return self._disk / f"bag{self._number}"

    def begin(self) -> None:
        """Start a recorder with a new bag."""
        self._number += 1
        self._acknowledged = []
        words = {"path": self._bag, "exclude": LARGE_TOPICS, "min_free_mb": 8}
        node = (str(NODE_MAIN), str(node_file("bag_recorder")))  # as a launch file starts it: no signal is lost
        command = [*dies_with_us(), sys.executable, *node, "--name", "soak_recorder"]
        command += ["--run-dir", str(self._rig.run_dir), *(w for k, v in words.items() for w in ("-p", f"{k}:={v}"))]
        environment = {**os.environ, "INSTANT_IC_RUN_DIR": str(self._rig.run_dir)}
        self._process = subprocess.Popen(
            command, env=environment, stdin=subprocess.DEVNULL, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL
        )

    @property
    def pid(self) -> int:
        assert self._process is not None
        return self._process.pid

    def look(self) -> None:
        """Query once per second how many messages it has written; restart it if it has exited."""
        if self._process is None or time.monotonic() < self._next_s:
            return
        self._next_s = time.monotonic() + 1.0
        if self._process.poll() is not None:
            self.end("the recorder ended by itself")
            self._figures.report("not back", "recorder", status=self._process.returncode)
            self.begin()
            return
        with contextlib.suppress(ControlError):  # it is starting, frozen or busy
            status = NodeControl(self._rig.run_dir, "soak_recorder", timeout_s=0.5).call("status")
            self._acknowledged.append((time.monotonic(), int(status["messages"])))
            if status["bytes"] > DISK_MB * 0.4e6:
                self.end("")
                self.begin()

    def end(self, fault: str, killed: bool = False) -> None:
        """Stop the recorder, compare the bag with the acknowledged messages, and delete it."""
        assert self._process is not None
        ended_s = time.monotonic()
        self._process.send_signal(signal.SIGKILL if killed else signal.SIGINT)
        try:
            status = self._process.wait(60)
        except subprocess.TimeoutExpired:
            self._process.kill()
            status = self._process.wait(10)
            self._figures.report("not back", fault, what="the recorder did not end within 60 s of SIGINT")
        known = [count for at_s, count in self._acknowledged if not killed or at_s < ended_s - FLUSHED_S]
        wanted = known[-1] if known else 0
        bag, whole = self._bag, self._disk.parent / "recovered"
        try:
            if killed or status:
                shutil.rmtree(whole, ignore_errors=True)
                held = recover(bag, whole).count
            else:
                with AnyReader([bag]) as reader:
                    held = reader.message_count
        except (BagError, OSError) as error:
            held = 0
            if wanted:
                self._figures.report("lost", fault, acknowledged=wanted, error=str(error))
        else:
            if held < wanted:
                self._figures.report("lost", fault, acknowledged=wanted, held=held)
        self._figures.bags["recovered" if killed or status else "whole"] += 1
        self._figures.bags["messages acknowledged"] += wanted
        self._figures.bags["messages held"] += held
        shutil.rmtree(whole, ignore_errors=True)
        shutil.rmtree(bag, ignore_errors=True)

    async def fill_disk(self, seconds: float) -> None:
        """Fill the disk for `seconds`, then free it again."""
        filler = self._disk / "filler"
        with contextlib.suppress(OSError), filler.open("wb") as out:
            while True:
                out.write(bytes(1 << 20))
                out.flush()
        await asyncio.sleep(seconds)
        filler.unlink()


class Soak:
    """Runs one stack after another until the time is up."""

    def __init__(self, args: argparse.Namespace, factor: float) -> None:
        self.args, self.factor = args, factor
        self.rng = random.Random(args.seed)
        self.figures, self.levels = Figures(), Levels()
        self.end_s = time.monotonic() + 60.0 * args.minutes
        self.began_s = time.monotonic()
        self.faults = [f for f in FAULTS if not args.only or any(word in f for word in args.only)]
        if args.light:
            self.faults = [f for f in self.faults if not f.startswith(("depth", "nerf"))]
        self.disk: Path | None = None
        self.ending = ""
        """The fault that is expected to end the current stack."""

    def run(self, folder: Path) -> None:
        """Run all drives; ``folder`` is for bags and logs."""
        text = LAUNCH.replace("corridor-free", "corridor")
        if not self.args.light:
            text = text.replace("{{name: depth, value: false}}", "{{name: depth, value: true}}")
            text = text.replace("{{name: vspace, value: false}}", "{{name: vspace, value: true}}")
        with small_disk(folder / "disk") as self.disk:
            if self.disk is None:
                self.faults = [f for f in self.faults if f != "disk full"]
                (folder / "disk").mkdir(exist_ok=True)
            while time.monotonic() < self.end_s:
                self._stack(folder, text)

    def _stack(self, folder: Path, text: str) -> None:
        self.figures.stacks += 1
        self.ending = ""
        log = folder / f"stack{self.figures.stacks}.log"
        try:
            with rig(self.factor, log, text) as made:
                self.recording = Recording(made, folder / "disk", self.figures)
                try:
                    self.recording.begin()
                    asyncio.run(self._drive(made))
                    how = "time is up"
                except StackError as error:
                    how = self.ending or "by itself"
                    if not self.ending:
                        self.figures.report("not back", "", error=str(error)[-1500:], log=str(log))
                finally:
                    self.recording.end("end of the stack")
                status = self._stop(made)
                note(f"stack {self.figures.stacks} ended: {how}, status {status}")
                self.figures.ends[how] += 1
                self._orphans(made.run_dir, how)
        except StackError as error:
            self.figures.report("not back", "start or end of a stack", error=str(error)[-1500:], log=str(log))

    def _stop(self, made: Rig) -> int:
        process = made.stack.process
        assert process is not None
        if self.ending:  # it exits on its own
            try:
                return process.wait(30.0)
            except subprocess.TimeoutExpired:
                self.figures.report("not back", self.ending, what="the stack did not end within 30 s")
        return made.stack.stop(30.0)

    def _orphans(self, run_dir: Path, why: str) -> None:
        deadline = time.monotonic() + 10.0
        while (left := processes_of(run_dir)) and time.monotonic() < deadline:
            time.sleep(0.1)
        for process in left:
            with contextlib.suppress(psutil.NoSuchProcess):
                self.figures.report("orphan", why, command=" ".join(process.cmdline()))
                process.kill()

    # -- one drive after another -------------------------------------------------------------------

    async def _drive(self, made: Rig) -> None:
        async with pump(made.stack) as until:
            beside = asyncio.create_task(self._look(made))
            try:
                await until(made.ready, 240, "stack that can be driven")
                while time.monotonic() < self.end_s:
                    await self._one(made, until)
            finally:
                beside.cancel()
                with contextlib.suppress(asyncio.CancelledError):
                    await beside

    async def _look(self, made: Rig) -> None:
        while True:
            await asyncio.sleep(0.5)
            self.levels.look(made.run_dir)
            self.recording.look()

    async def _one(self, made: Rig, until: Any) -> None:
        """Drive for a while, cause one fault, and check that the robot can be driven again."""
        fault = self.rng.choice(self.faults)
        if fault in RARE and self.rng.random() < 0.8 and len(self.faults) > len(RARE):
            fault = self.rng.choice([f for f in self.faults if f not in RARE])
        before_s, lets_go, holds_s = self.rng.uniform(2, 6), self.rng.random() < 0.5, self.rng.uniform(1.5, 4.0)
        await until(lambda: made.state is not None and bool(made.truth), BACK_S, "state of the stack")
        async with driver(made) as page:
            await self._onward(made, page, until, before_s)
            moving = made.truth[-1].speed > 0.1
            self.figures.faults[fault] += 1
            self.figures.moving[fault] += moving
            left = (self.end_s - time.monotonic()) / 60.0
            note(f"{left:5.1f} min left, {sum(self.figures.faults.values())} faults: {fault}, mode {made.state.mode}")
            del made.truth[:-1]
            with contextlib.suppress(ConnectionError, OSError, TimeoutError, aiohttp.ClientError):
                if fault.startswith("emergency stop"):
                    await self._estop(made, page, until, fault)
                else:
                    await self._lose(made, page, until, fault, lets_go, holds_s)
        if self.ending:
            await until(lambda: False, 0.0, "end")
        await self._again(made, fault)

    async def _onward(self, made: Rig, page: ConsoleClient, until: Any, seconds: float) -> None:
        """Drive back and forth through the obstacle for `seconds`, and on until the robot moves; 30 s at most."""
        began_ns = made.pace.now_ns()
        place = made.truth[-1]

        def over() -> bool:
            nonlocal place
            truth, lasted_s = made.truth[-1], (made.pace.now_ns() - began_ns) / 1e9
            self.figures.driven_m += float(np.hypot(truth.x - place.x, truth.y - place.y))
            place = truth
            forward = 1.0 if truth.x < 1.0 else -1.0 if truth.x > 6.0 else self._forward
            self._forward = forward
            if made.state.mode == ControlState.STOPPED:
                page.drive(0.0, 0.0)
            else:
                page.drive(forward * SPEED_M_S, float(np.clip(-truth.yaw - forward * 0.5 * truth.y, -0.3, 0.3)))
            return lasted_s > 30.0 or (lasted_s > seconds and truth.speed > 0.1)

        await until(over, 60, "drive")

    _forward = 1.0

    async def _lose(
        self, made: Rig, page: ConsoleClient, until: Any, fault: str, lets_go: bool, holds_s: float
    ) -> None:
        modes = {int(made.state.mode)}
        lost_ns = made.pace.now_ns()
        name, _, how = fault.partition(" ")
        if fault == "recorder killed":
            self.recording.end(fault, killed=True)
            self.recording.begin()
            return
        if fault == "disk full":
            await self.recording.fill_disk(holds_s)
            return
        if fault == "launcher killed":
            self.ending = fault
            assert made.stack.process is not None
            made.stack.process.kill()
            return
        if fault in LINKS:
            breaks, mends = LINKS[fault]
            breaks(made)
        else:
            pid = made.pid(name)
            os.kill(pid, signal.SIGSTOP if how == "frozen" else signal.SIGKILL)
            if fault == "simulator killed":
                self.ending = fault
                return
        if lets_go:
            with contextlib.suppress(ConnectionError, OSError):
                await page.stop()
        try:
            if how == "killed":
                await until(lambda: alive(made, name, other_than=pid), BACK_S, f"new start of {name}")
            else:
                await asyncio.sleep(made.pace.wait_s(holds_s))
        finally:
            back_ns = made.pace.now_ns()
            if fault in LINKS:
                mends(made)
            elif how == "frozen":
                with contextlib.suppress(ProcessLookupError):  # the launcher has killed it
                    os.kill(pid, signal.SIGCONT)
        modes.add(int(made.state.mode))
        only_real = not modes & {ControlState.ENTERING, ControlState.VIRTUAL, ControlState.RETURNING}
        needed = name in NEEDED or (fault in LINKS and fault != "camera link cut")
        if "camera" in fault:
            needed = only_real
        if needed:
            if lets_go and only_real:
                await asyncio.sleep(made.pace.wait_s(1.0))  # no old command may move the robot once the fault is over
                back_ns = made.pace.now_ns()
            self._stood(made, fault, lost_ns + round(self.args.stand * 1e9), back_ns)

    async def _estop(self, made: Rig, page: ConsoleClient, until: Any, fault: str) -> None:
        await page.estop()
        pressed_ns = made.pace.now_ns()
        await asyncio.sleep(made.pace.wait_s(0.5))
        names = fault.removeprefix("emergency stop, then ").removesuffix(" killed").split(" and ")
        pids = {name: made.pid(name) for name in names}
        for pid in pids.values():
            os.kill(pid, signal.SIGKILL)
        for name, pid in pids.items():
            await until(lambda name=name, pid=pid: alive(made, name, other_than=pid), BACK_S, f"new start of {name}")
        async with driver(made) as other:  # an operator who drives on without a release
            other.drive(SPEED_M_S, 0.0)
            await asyncio.sleep(made.pace.wait_s(2.0))
            await other.stop()
        self._stood(made, fault, pressed_ns + round(ESTOP_STANDS_S * 1e9), made.pace.now_ns())

    async def _again(self, made: Rig, fault: str) -> None:
        """Let an operator at the page release what is latched, until the robot can be driven again."""
        deadline = time.monotonic() + made.pace.wait_s(BACK_S)
        while not (fresh(made) and made.state.mode != ControlState.STOPPED):
            if time.monotonic() > deadline:
                raise StackError(f"not drivable after {fault}: {made.state.reason}\n{made.stack.log_tail()}")
            with contextlib.suppress(ConnectionError, OSError, TimeoutError, aiohttp.ClientError):
                async with driver(made) as page:  # an absent operator ends the virtual drive, and must return
                    await page.stop()
                    if made.state.estop:
                        await page.release_estop()
                    await asyncio.sleep(made.pace.wait_s(2.0))

    def _stood(self, made: Rig, fault: str, from_ns: int, until_ns: int) -> None:
        rows = [row for row in made.truth if from_ns < row.at_ns < until_ns]
        fast = [row for row in rows if row.speed > MOVES_M_S]
        if fast:
            self.figures.report(
                "moved",
                fault,
                mode=int(made.state.mode),
                most_m_s=round(max(row.speed for row in fast), 3),
                last_s=round((fast[-1].at_ns - from_ns) / 1e9, 2),
                samples=f"{len(fast)} of {len(rows)}",
            )


def fresh(made: Rig) -> bool:
    return bool(made.pace.now_ns() - stamp_ns(made.state) < 1e9)


def alive(made: Rig, name: str, other_than: int) -> bool:
    """Whether a node runs in a new process."""
    return any(info.name == name and info.pid != other_than for info in registry.list_nodes(made.run_dir))


@contextlib.contextmanager
def small_disk(at: Path) -> Iterator[Path | None]:
    """A disk of ``DISK_MB`` that can be filled; None if this user may not mount one."""
    at.mkdir()
    words = ["mount", "-t", "tmpfs", "-o", f"size={DISK_MB}m", "tmpfs", str(at)]
    if subprocess.run(words, capture_output=True).returncode:
        at.rmdir()
        note("no small disk can be mounted here: the disk is not filled")
        yield None
        return
    try:
        yield at
    finally:
        subprocess.run(["umount", "-l", str(at)], capture_output=True, check=True)


def main(words: Sequence[str] | None = None) -> int:
    parser = parser_of(__doc__)
    parser.add_argument("--minutes", type=float, default=60.0, help="of the machine (default: %(default)g)")
    parser.add_argument("--seed", type=int, default=1, help="of the faults and their moments")
    parser.add_argument(
        "--pace", type=float, default=0.0, help="of the stack's time (default: what the machine can do)"
    )
    parser.add_argument(
        "--stand", type=float, default=0.55, metavar="S", help="time to stand after a loss (default: %(default)g)"
    )
    parser.add_argument("--only", action="append", default=[], help="faults with this word in their name; repeatable")
    parser.add_argument("--light", action="store_true", help="without depth and virtual space")
    args = parser.parse_args(words)
    factor = args.pace or round(machine_pace(), 2)
    soak = Soak(args, factor)
    if not soak.faults:
        parser.error(f"--only must be part of one of: {', '.join(FAULTS)}")
    folder = Path(tempfile.mkdtemp(prefix="ic-soak-"))
    note(f"logs and bags in {folder}, pace {factor:g}")
    signal.signal(signal.SIGTERM, signal.default_int_handler)
    with contextlib.suppress(KeyboardInterrupt):  # after Ctrl-C, the findings so far are still printed
        soak.run(folder)
    figures, levels = soak.figures, soak.levels.judge()
    for name, level in levels.items():
        if level["leak"]:
            figures.report("leak", "", process=name, **level)
    result = {
        "minutes": round((time.monotonic() - soak.began_s) / 60.0, 1),
        "seed": args.seed,
        "pace": factor,
        "cores": os.cpu_count(),
        "load_average": round(os.getloadavg()[0], 1),
        "stacks": figures.stacks,
        "ends": dict(figures.ends),
        "faults": {name: {"times": n, "moving": figures.moving[name]} for name, n in sorted(figures.faults.items())},
        "faults_in_all": sum(figures.faults.values()),
        "driven_m": round(figures.driven_m, 1),
        "bags": dict(figures.bags),
        "growth": levels,
        "found": figures.found,
    }  # fmt: skip
    report(result, args.json)
    if not figures.found:
        shutil.rmtree(folder, ignore_errors=True)
    return 1 if figures.found else 0


if __name__ == "__main__":
    sys.exit(main())
