#!/usr/bin/env python3
"""Stopping time of the robot after a process, a device or a link is lost; prints JSON.

    python benchmarks/stopping.py --json stopping.json
    python benchmarks/stopping.py --only arbiter --only "LiDAR packets" --repeat 5

A simulated stack of real processes (without depth and virtual space, which do not move the robot in REAL) drives at
0.38 m/s. Then one thing is lost: a process is frozen (SIGSTOP) or killed (SIGKILL), a device or link is cut, the page
disconnects, or the emergency stop is pressed. Measured from that moment, by the simulator's true motion:

    detect_s    to the first sign of the stop: /cmd_vel, the speed commanded to the motor controller, or the true speed
                falls by a tenth
    stand_s     to a true speed that stays below 0.01 m/s, and below a third of the speed before the loss
    distance_m  from the position at the loss to the stopping position
    after_m     motion in the second after it has stopped: zero, unless the lost part is back before the arbiter goes to
                STOPPED (``timeouts.stop_after_s``), like a camera driver that starts fast, because the key is still
                held
    again_s     to that motion

For a process that is thawed after 2 s, ``after_m`` is the motion from the stand until 3 s after the end of the freeze:
zero, although the key is held all the time.

All times are seconds of the stack, which runs at the pace of the machine (``--pace``, 1.0 on one that is fast enough).
"""

from __future__ import annotations

import asyncio
import contextlib
import math
import os
import random
import select
import signal
import socket
import statistics
import struct
import sys
import tempfile
import threading
import time
import tty
from collections import deque
from collections.abc import AsyncIterator, Awaitable, Callable, Iterator, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, NamedTuple

import aiohttp
import numpy as np
from drive import pump
from impaired_link import ImpairedLink
from reporting import note, parser_for, report

from instant_ic.base.config import SkidSteerConfig
from instant_ic.base.protocol import ESTOP_BITS, Command, encode_reply, read_request, write_frame
from instant_ic.bus import LATCHED, registry
from instant_ic.console.client import ConsoleClient
from instant_ic.control.states import Reason
from instant_ic.experiments.stack import Stack, StackError, free_port
from instant_ic.launch.pacing import machine_pace
from instant_ic.msg import ControlState, message_type, pose2_from_message, stamp_ns, twist_values
from instant_ic.sim.capture_replay import with_noise
from instant_ic.sim.roboclaw_emulator import MAX_SPEED_PPS, RoboclawEmulator
from instant_ic.util import pace
from instant_ic.util.closing import Closing
from instant_ic.util.paths import share_dir

SPEED_M_S = 0.38
HALF_WIDTH_M = 0.5 * SkidSteerConfig().effective_width
STANDS_M_S = 0.01
STANDS_S = 0.3
"""Seconds below the limit that count as standing."""
LONGEST_S = 4.0
AFTER_S = 1.0
RUNAWAY = 0.95
"""Share of the top speed for a runaway motor; at full speed, the jump from a slow speed is already a speed error."""
_TRIES = 5
_REVOLUTION = 76
"""Packets of a revolution of the LiDAR."""
PROCESSES = ("arbiter", "crawler_base", "console", "grid_slam", "vlp16_driver", "theta_camera")
CONTROL = ("arbiter", "crawler_base", "console", "navigator", "virtual_robot")
"""Control nodes that are frozen; the last two are not needed in REAL."""
LET_GO_S = 0.4
"""Seconds without a key before each drive: after a freeze, the console and the arbiter wait for its release."""
FROZEN_S, AFTER_THAW_S = 2.0, 3.0
"""Seconds of a freeze under the held key, and seconds watched after its end."""
LAUNCH = """launch:
- node:
    exec: simulator
    param:
    - from: $(config sim.yaml)
    - {{name: world, value: corridor-free}}
    - {{name: camera.port, value: {camera}}}
    - {{name: lidar.data_port, value: {lidar}}}
    - {{name: lidar.position_port, value: {position}}}
    required: true
- include:
    file: {folder}/robot.yaml
    arg:
    - {{name: camera_url, value: "http://127.0.0.1:{camera_link}"}}
    - {{name: lidar_host, value: 127.0.0.1}}
    - {{name: lidar_port, value: {lidar_link}}}
    - {{name: lidar_position_port, value: {position}}}
    - {{name: serial_port, value: $(run-dir)/dev/relay}}
- include:
    file: {folder}/station.yaml
    arg:
    - {{name: depth, value: false}}
    - {{name: vspace, value: false}}
    - {{name: recorder, value: false}}
    - {{name: console_port, value: {console}}}
    - {{name: simulated, value: true}}
- node:
    exec: console
    name: second_console
    param: [{{name: server.port, value: {second_console}}}, {{name: server.access.simulated, value: true}}]
"""


class Truth(NamedTuple):
    """The robot's true motion at one moment of the stack's time; the speed is that of its faster track."""

    at_ns: int
    x: float
    y: float
    yaw: float
    speed: float


class PacketRelay(Closing):
    """Forwards UDP packets between two ports of this machine, unless it is cut, or repeats the last revolution."""

    def __init__(self, source: int, target: int) -> None:
        self.cut = False
        self.repeats = ""
        """"copies": the last revolution is sent again, with new stamps; "noise": with noise of 2 mm too."""
        self._recent: deque[bytes] = deque(maxlen=_REVOLUTION)
        self._rng = np.random.default_rng(0)
        self._target = ("127.0.0.1", target)
        self._socket = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
        self._socket.bind(("127.0.0.1", source))
        self._socket.settimeout(0.2)
        self._ends = threading.Event()
        self._thread = threading.Thread(target=self._run, name="packets", daemon=True)
        self._thread.start()

    def _run(self) -> None:
        while not self._ends.is_set():
            try:
                data = self._socket.recv(2048)
                if not self.cut:
                    self._socket.sendto(self._repeated(data), self._target)
            except (TimeoutError, ConnectionRefusedError):  # no sender, or the driver is not running
                continue

    def _repeated(self, data: bytes) -> bytes:
        """Return the packet, or one of the last revolution with its stamp."""
        if not self.repeats:
            self._recent.append(data)
            return data
        old = self._recent[0]
        self._recent.rotate(-1)
        if self.repeats == "noise":
            old = with_noise(old, self._rng)
        return old[:1200] + data[1200:1204] + old[1204:]

    def close(self) -> None:
        self._ends.set()
        self._thread.join(2.0)
        self._socket.close()


class SerialRelay(Closing):
    """Serial line between the base driver and the simulated controller that can lose replies or be disconnected."""

    def __init__(self, link: Path, controller: Path) -> None:
        self.mute = False
        """Drops the controller's replies."""
        self.dead = False
        """Freezes the left motor's count, and drives that motor as fast as it can."""
        self.pressed = False
        """Reports a pressed stop button, which does not latch in the controller."""
        self._request, self._count = b"", bytes(4)
        self.speeds: list[tuple[int, float]] = []
        """Each request that changes the commanded speed: machine time in ns, encoder counts per second."""
        self._listener = RoboclawEmulator()
        self._link, self._controller = link, controller
        self._lock = threading.Lock()
        self._master = self._slave = self._far = -1
        self._ends = threading.Event()
        self.plug()
        self._thread = threading.Thread(target=self._run, name="serial", daemon=True)
        self._thread.start()

    def plug(self) -> None:
        """Create the line under the driver's device name."""
        with self._lock:
            self._master, self._slave = os.openpty()
            tty.setraw(self._slave)
            self._link.unlink(missing_ok=True)
            self._link.symlink_to(os.ttyname(self._slave))

    def pull(self) -> None:
        """Remove the driver's end, as when the cable is disconnected."""
        with self._lock:
            self._link.unlink(missing_ok=True)
            os.close(self._master)
            os.close(self._slave)
            self._master = self._slave = -1

    def close(self) -> None:
        self._ends.set()
        self._thread.join(2.0)
        for descriptor in (self._master, self._slave, self._far):
            if descriptor >= 0:
                os.close(descriptor)

    def _run(self) -> None:
        while not self._ends.is_set():
            if self._far < 0:
                with contextlib.suppress(FileNotFoundError):  # the simulator is still starting
                    self._far = os.open(self._controller, os.O_RDWR | os.O_NOCTTY)
                    tty.setraw(self._far)
            # At the end of the stack, and while the cable is disconnected, there is no receiver.
            with self._lock, contextlib.suppress(OSError):
                self._pass_on()
            if self._master < 0 or self._far < 0:
                time.sleep(0.01)

    def _pass_on(self) -> None:
        ends = [end for end in (self._master, self._far) if end >= 0]
        ready, _, _ = select.select(ends, [], [], 0.005)
        if self._master in ready:
            data = os.read(self._master, 4096)
            self._listen(data)
            self._request = data
            if self._far >= 0:
                os.write(self._far, self._run_away(data) if self.dead else data)
        if self._far in ready:
            data = os.read(self._far, 4096)
            if self._request == read_request(self._listener.address, Command.READ_ENCODERS) and len(data) == 10:
                data = self._with_count(data)
            if self._request == read_request(self._listener.address, Command.READ_STATUS) and len(data) == 6:
                status = int.from_bytes(data[:4], "big") | self.pressed * ESTOP_BITS[4]
                data = encode_reply(self._listener.address, Command.READ_STATUS, status.to_bytes(4, "big"))
            if self._master >= 0 and not self.mute:
                os.write(self._master, data)

    def _with_count(self, reply: bytes) -> bytes:
        """Return the reply with both counts, of which the left one is frozen since its encoder died."""
        if not self.dead:
            self._count = reply[:4]
        return encode_reply(self._listener.address, Command.READ_ENCODERS, self._count + reply[4:8])

    def _run_away(self, data: bytes) -> bytes:
        """Return a command to drive with the left motor at full speed in its direction, without a ramp."""
        if len(data) != 16 or data[1] != Command.SPEED_ACCELERATION_BOTH:
            return data
        _, left, right = struct.unpack(">Iii", data[2:-2])
        full = round(math.copysign(RUNAWAY * MAX_SPEED_PPS, left)) if left else 0
        return write_frame(data[0], data[1], struct.pack(">Iii", 0, full, right))

    def _listen(self, data: bytes) -> None:
        self._listener.feed(data)
        speed = float(np.abs(self._listener.target_speed_pps).mean())
        if not self.speeds or speed != self.speeds[-1][1]:
            self.speeds.append((time.time_ns(), speed))


@dataclass
class Rig:
    """A running stack, the relays between its parts, and the recorded data."""

    stack: Stack
    run_dir: Path
    page_link: ImpairedLink
    camera_link: ImpairedLink
    packets: PacketRelay
    serial: SerialRelay
    pace: pace.Pace
    second_port: int
    truth: list[Truth] = field(default_factory=list)
    commands: list[tuple[int, float]] = field(default_factory=list)
    state: Any = None

    def watch(self) -> None:
        """Record the true motion, the commands and the arbiter's state."""
        observer = self.stack.observer
        observer.subscribe("/ground_truth/odom", message_type("Odometry"), self._on_truth)
        observer.subscribe("/cmd_vel", message_type("TwistStamped"), self._on_command)
        observer.subscribe("/ic/state", ControlState, self._on_state, LATCHED)

    def _on_truth(self, message: Any) -> None:
        x, y, yaw = pose2_from_message(message)
        linear, turn = message.twist.twist.linear, abs(message.twist.twist.angular.z)
        self.truth.append(Truth(stamp_ns(message), x, y, yaw, math.hypot(linear.x, linear.y) + HALF_WIDTH_M * turn))

    def _on_command(self, message: Any) -> None:
        v, w = twist_values(message)
        self.commands.append((stamp_ns(message), abs(v) + HALF_WIDTH_M * abs(w)))

    def _on_state(self, message: Any) -> None:
        self.state = message

    def ready(self) -> bool:
        """Return whether the arbiter allows driving now."""
        if self.state is None or not self.truth:
            return False
        fresh = self.pace.now_ns() - stamp_ns(self.state) < 0.3e9
        held = Reason(self.state.reason_code).holds
        return fresh and self.state.mode == ControlState.REAL and not held and self.truth[-1].speed < STANDS_M_S

    def pid(self, node: str) -> int:
        """Return the process id of a running node.

        Raises:
            StackError: it is not running.
        """
        for info in registry.list_nodes(self.run_dir):
            if info.name == node:
                return info.pid
        raise StackError(f"node {node} does not run")


Act = Callable[[Rig, ConsoleClient], Awaitable[None] | None]


class Fault(NamedTuple):
    """A fault: functions that cause it, end it, and prepare the drive, given the rig and the operator's page.

    Most end by themselves: the launcher restarts a killed process, and each drive has its own page.

    Attributes:
        name: row of the table.
        breaks, mends: cause and end it.
        prepares: prepares the drive.
        speed, turn: motion before it, m/s and rad/s.
        frozen_s: seconds of the stack until ``mends`` ends it under the held key; 0: after the drive.
    """

    name: str
    breaks: Act
    mends: Act = lambda rig, page: None
    prepares: Act = lambda rig, page: None
    speed: float = SPEED_M_S
    turn: float = 0.0
    frozen_s: float = 0.0


async def act(does: Act, rig: Rig, page: ConsoleClient) -> None:
    """Cause or end a fault."""
    if (pending := does(rig, page)) is not None:
        await pending


def freeze(name: str, nodes: Sequence[str], frozen_s: float = 0.0) -> Fault:
    """Return the fault of processes that are frozen."""
    frozen: list[int] = []

    def breaks(rig: Rig, page: ConsoleClient) -> None:
        frozen[:] = [rig.pid(node) for node in nodes]
        for pid in frozen:
            os.kill(pid, signal.SIGSTOP)

    def mends(rig: Rig, page: ConsoleClient) -> None:
        while frozen:
            with contextlib.suppress(ProcessLookupError):  # on a slow machine the launcher may kill it as hung
                os.kill(frozen.pop(), signal.SIGCONT)

    return Fault(name, breaks, mends, frozen_s=frozen_s)


def kill(node: str) -> Fault:
    """Return the fault of a process that is killed."""
    return Fault(f"{node} killed", lambda rig, page: os.kill(rig.pid(node), signal.SIGKILL))


def second_console_fault() -> Fault:
    """Return the fault that freezes the driver's console while an idle operator waits at another one."""
    frozen, pages = freeze("console frozen", ["console"]), list[ConsoleClient]()

    async def open_page(rig: Rig, page: ConsoleClient) -> None:
        await page.wait_for(lambda c: rig.state is not None and rig.state.holder.startswith("console/"), 90.0)
        pages.append(ConsoleClient(f"http://127.0.0.1:{rig.second_port}/"))
        await pages[-1].connect(5.0)
        await pages[-1].send({"type": "lease", "take": False})

    async def mend(rig: Rig, page: ConsoleClient) -> None:
        await act(frozen.mends, rig, page)
        while pages:
            await pages.pop().close()

    return Fault("second console idle, the driver's frozen", frozen.breaks, mend, open_page)


def relay_fault(name: str, relay: str, attribute: str, broken: Any, whole: Any) -> Fault:
    """Return the fault that sets a relay's ``attribute`` to ``broken``, and to ``whole`` when it ends."""

    def put(value: Any) -> Act:
        return lambda rig, page: setattr(getattr(rig, relay), attribute, value)

    return Fault(name, put(broken), put(whole))


async def release_estop(rig: Rig, page: ConsoleClient) -> None:
    await page.stop()
    await page.release_estop()


def kill_encoder(rig: Rig, page: ConsoleClient) -> None:
    rig.serial.dead = True


async def mend_encoder(rig: Rig, page: ConsoleClient) -> None:
    rig.serial.dead = False
    await release_estop(rig, page)


async def press_shortly(rig: Rig, page: ConsoleClient) -> None:
    rig.serial.pressed = True
    await asyncio.sleep(rig.pace.wait_s(0.06))
    rig.serial.pressed = False


FAULTS = [
    *(fault for node in PROCESSES for fault in (freeze(f"{node} frozen", [node]), kill(node))),
    second_console_fault(),
    *(freeze(f"{node} thawed after {FROZEN_S:g} s", [node], FROZEN_S) for node in CONTROL[:3]),
    freeze(f"all thawed after {FROZEN_S:g} s", CONTROL, FROZEN_S),
    Fault("emergency stop pressed", lambda rig, page: page.estop(), release_estop),
    *(
        Fault(f"encoder of a track dead at {speed:g} m/s", kill_encoder, mend_encoder, speed=speed)
        for speed in (0.01, 0.02, 0.05, 0.1, SPEED_M_S)
    ),
    Fault("encoder of a track dead while turning", kill_encoder, mend_encoder, speed=0.0, turn=0.4),
    Fault("robot's stop button pressed for 0.06 s", press_shortly, release_estop),
    Fault("key let go (no loss; soft ramp)", lambda rig, page: page.stop()),
    Fault("page closed", lambda rig, page: page.close()),
    Fault("page silent", lambda rig, page: page.silence()),
    Fault("page link cut", lambda rig, page: rig.page_link.cut(), lambda rig, page: rig.page_link.mend()),
    Fault("camera link cut", lambda rig, page: rig.camera_link.cut(), lambda rig, page: rig.camera_link.mend()),
    relay_fault("LiDAR packets cease", "packets", "cut", True, False),
    relay_fault("LiDAR repeats a revolution", "packets", "repeats", "copies", ""),
    relay_fault("contradiction (tracks turn, LiDAR sees no motion)", "packets", "repeats", "noise", ""),
    relay_fault("serial replies lost", "serial", "mute", True, False),
    Fault("serial cable pulled", lambda rig, page: rig.serial.pull(), lambda rig, page: rig.serial.plug()),
]


@contextlib.contextmanager
def running_rig(factor: float, log: Path | None) -> Iterator[Rig]:
    """Start a stack with relays at everything that can be cut."""
    ports = {"camera": 0, "console": 0, "second_console": 0}
    while len(set(ports.values())) < len(ports):  # a port that was free may be given again
        ports = {name: free_port() for name in ports}
    ports |= {name: free_port(socket.SOCK_DGRAM) for name in ("lidar", "lidar_link", "position")}
    with contextlib.ExitStack() as ends:
        run_dir = Path(ends.enter_context(tempfile.TemporaryDirectory(prefix="ic-", ignore_cleanup_errors=True)))
        (run_dir / "dev").mkdir(mode=0o700)
        launch = run_dir / "stopping.yaml"
        page_link = ends.enter_context(ImpairedLink(("127.0.0.1", ports["console"])))
        camera_link = ends.enter_context(ImpairedLink(("127.0.0.1", ports["camera"])))
        packets = ends.enter_context(PacketRelay(ports["lidar"], ports["lidar_link"]))
        serial = ends.enter_context(SerialRelay(run_dir / "dev" / "relay", run_dir / "dev" / "roboclaw"))
        launch.write_text(LAUNCH.format(**ports, camera_link=camera_link.port, folder=share_dir("launch")))
        stack = ends.enter_context(Stack(str(launch), run_dir, {}, log, pace=factor))
        stack.wait_for(lambda: registry.list_nodes(run_dir), 600, "first node")  # it may compile the kernels
        made = Rig(stack, run_dir, page_link, camera_link, packets, serial, pace.read(run_dir), ports["second_console"])
        pace.use(made.pace)
        made.watch()
        yield made


@contextlib.asynccontextmanager
async def driver(rig: Rig) -> AsyncIterator[ConsoleClient]:
    """Open a page that drives; try again while the console restarts."""
    page = ConsoleClient(f"http://127.0.0.1:{rig.page_link.port}/")
    for left in reversed(range(40)):
        try:
            await page.connect(5.0)
            break
        except (OSError, TimeoutError, aiohttp.ClientError) as error:
            if not left:
                raise StackError(f"the console does not answer: {error!r}\n{rig.stack.log_tail()}") from error
            await asyncio.sleep(0.5)
    try:
        await page.acquire(take=True, timeout_s=10.0)
        yield page
    finally:
        # Errors while closing a cut connection are ignored: the next drive opens its own.
        with contextlib.suppress(OSError, TimeoutError, aiohttp.ClientError, asyncio.CancelledError):
            await asyncio.wait_for(page.close(), 5.0)


async def at_speed(rig: Rig, until: Any, page: ConsoleClient, fault: Fault, wait_s: float) -> float:
    """Drive on the corridor's centre line, or turn, until the speed has been steady for ``wait_s``; return it, m/s."""
    wanted = fault.speed + HALF_WIDTH_M * fault.turn
    reached, kept = (0.97, 0.9) if wanted == SPEED_M_S else (0.85, 0.7)  # slip shows more when slow or turning
    for _ in range(_TRIES):
        await until(rig.ready, 90, "robot that can be driven")
        await asyncio.sleep(rig.pace.wait_s(LET_GO_S))
        sign = 1.0 if rig.truth[-1].x < 5.0 else -1.0

        def fast(sign: float = sign) -> bool:
            truth = rig.truth[-1]
            # Back to the centre line, as far as the drive allows.
            steer = max(-0.3, min(0.3, -truth.yaw - sign * 0.5 * truth.y)) if wanted == SPEED_M_S else fault.turn
            page.drive(sign * fault.speed, steer)
            return truth.speed > reached * wanted

        try:
            await until(fast, 5, "full speed")
            page.drive(sign * fault.speed, fault.turn)
            began_ns = rig.pace.now_ns()
            await asyncio.sleep(rig.pace.wait_s(wait_s))
        except StackError:  # a sensor was late on a busy machine: release and drive again, as an operator does
            await page.stop()
            continue
        steady = [truth.speed for truth in rig.truth if truth.at_ns > began_ns]
        sent = [speed for at_ns, speed in rig.commands if at_ns > began_ns]
        if steady and sent and min(*steady, *sent) > kept * wanted:
            return statistics.median(steady)
        await page.stop()
    raise StackError(f"no steady speed in {_TRIES} drives:\n{rig.stack.log_tail()}")


async def one(rig: Rig, until: Any, fault: Fault, rng: random.Random) -> dict[str, Any]:
    async with driver(rig) as page:
        await act(fault.prepares, rig, page)
        cruise = await at_speed(rig, until, page, fault, 0.7 + rng.uniform(0.0, 0.1))  # not in phase with any timer
        lost_ns = rig.pace.now_ns()
        await act(fault.breaks, rig, page)
        try:
            if fault.frozen_s:
                await asyncio.sleep(rig.pace.wait_s(fault.frozen_s))
                await act(fault.mends, rig, page)
                await asyncio.sleep(rig.pace.wait_s(AFTER_THAW_S))

            def over() -> bool:
                stand_ns = stands_ns(rig.truth, lost_ns, cruise)
                stood = stand_ns is not None and rig.truth[-1].at_ns - stand_ns > AFTER_S * 1e9
                return stood or rig.pace.now_ns() - lost_ns > LONGEST_S * 1e9

            await until(over, LONGEST_S + 10, "stand")
            figures = measured(rig, lost_ns, cruise)
            if not page.closed:
                with contextlib.suppress(ConnectionError, OSError):
                    await page.stop()
        finally:
            await act(fault.mends, rig, page)
    return figures


def stands_ns(truth: Sequence[Truth], lost_ns: int, cruise: float) -> int | None:
    """Return when the robot, driven at ``cruise`` m/s, began to stand for ``STANDS_S``; None if it never did."""
    began: int | None = None
    limit = min(STANDS_M_S, cruise / 3)
    for row in truth:
        if row.at_ns < lost_ns:
            continue
        if row.speed >= limit:
            began = None
        elif began is None:
            began = row.at_ns
        elif row.at_ns - began >= STANDS_S * 1e9:
            return began
    return None


def measured(rig: Rig, lost_ns: int, cruise: float) -> dict[str, Any]:
    """Return the figures of one drive."""
    rows = [row for row in rig.truth if row.at_ns >= lost_ns]
    signs = signs_of_the_stop(rig, rows, lost_ns, cruise)
    found: dict[str, Any] = dict.fromkeys(("detect_s", "stand_s", "distance_m", "after_m", "again_s"))
    found["cruise_m_s"] = round(cruise, 3)
    if signs:
        found["detect_s"] = round((min(signs) - lost_ns) / 1e9, 3)
    stand_ns = stands_ns(rows, lost_ns, cruise)
    if stand_ns is None:
        return found
    start = max((row for row in rig.truth if row.at_ns <= lost_ns), key=lambda row: row.at_ns)
    gap_s = (lost_ns - start.at_ns) / 1e9  # driving time between this sample and the loss
    end = next(row for row in rows if row.at_ns == stand_ns)
    later = [row for row in rows if row.at_ns > stand_ns]
    found["stand_s"] = round((stand_ns - lost_ns) / 1e9, 3)
    found["distance_m"] = round(math.dist(start[1:3], end[1:3]) - gap_s * cruise, 3)
    found["after_m"] = round(max((math.dist(end[1:3], row[1:3]) for row in later), default=0.0), 3)
    again_ns = next((row.at_ns for row in later if row.speed >= STANDS_M_S), None)
    if again_ns is not None:
        found["again_s"] = round((again_ns - lost_ns) / 1e9, 3)
    return found


def signs_of_the_stop(rig: Rig, rows: Sequence[Truth], lost_ns: int, cruise: float) -> list[int]:
    """Return the times at which a commanded or true speed is a tenth below that before the loss."""
    signs = [at for at, speed in rig.commands if at >= lost_ns and speed < 0.9 * cruise]
    if cruise > 5 * STANDS_M_S:  # a slower true speed fluctuates by a tenth by itself
        signs += [row.at_ns for row in rows if row.speed < 0.9 * cruise]
    requests = [(rig.pace.stamp_ns(at), speed) for at, speed in rig.serial.speeds]
    driven = max((request for request in requests if request[0] <= lost_ns), default=(0, 0.0))[1]
    return signs + [at for at, speed in requests if at > lost_ns and speed < 0.9 * driven]


async def drives(rig: Rig, faults: Sequence[Fault], repeat: int) -> dict[str, list[dict[str, Any]]]:
    """Run all faults in turn, repeatedly."""
    rng = random.Random(1)
    found: dict[str, list[dict[str, Any]]] = {fault.name: [] for fault in faults}
    async with pump(rig.stack) as until:
        for turn in range(repeat):
            for fault in faults:
                try:
                    figures = await one(rig, until, fault, rng)
                except StackError as error:
                    rig.stack.check_alive(fault.name)
                    note(f"{turn + 1}/{repeat} {fault.name}: not measured: {error}")
                    continue
                found[fault.name].append(figures)
                note(f"{turn + 1}/{repeat} {fault.name}: {figures}")
                del rig.truth[:-1], rig.commands[:], rig.serial.speeds[:-1]
    return found


def worst(drives: Sequence[dict[str, Any]]) -> dict[str, Any]:
    """Return median and worst of some drives; the worst is None if the robot did not stop in one of them."""
    result: dict[str, Any] = {"n": len(drives)}
    for key in ("detect_s", "stand_s", "distance_m", "after_m"):
        values = [drive[key] for drive in drives]
        known = [value for value in values if value is not None]
        result[key] = {
            "median": round(statistics.median(known), 3) if known else None,
            "worst": max(known) if known and len(known) == len(values) else None,
        }
    return result


def main() -> int:
    parser = parser_for(__doc__)
    parser.add_argument("--only", action="append", default=[], help="faults whose name begins so; may be repeated")
    parser.add_argument("--repeat", type=int, default=2, help="drives for each fault (default 2)")
    parser.add_argument("--pace", type=float, default=0.0, help="fixed pace (default: what the machine can do)")
    parser.add_argument("--log", type=Path, default=None, help="file for the stack's output")
    args = parser.parse_args()
    faults = [fault for fault in FAULTS if not args.only or fault.name.startswith(tuple(args.only))]
    if not faults or args.repeat < 1:
        parser.error(f"--only must begin one of: {', '.join(fault.name for fault in FAULTS)}; --repeat is 1 or more")
    factor = args.pace or round(machine_pace(), 2)
    result: dict[str, Any] = {
        "cores": os.cpu_count(),
        "load_average": round(os.getloadavg()[0], 1),
        "pace": factor,
        "speed_m_s": SPEED_M_S,
    }
    with running_rig(factor, args.log) as rig:
        found = asyncio.run(drives(rig, faults, args.repeat))
    result["faults"] = {name: worst(rows) for name, rows in found.items()}
    result["drives"] = found
    report(result, args.json)
    return 0 if all(len(rows) == args.repeat for rows in found.values()) else 1


if __name__ == "__main__":
    sys.exit(main())
