"""The control nodes and the console in simulated time, with images at any rate, delay, jitter and loss.

Real are the arbiter, the v-bot, the navigator and the console, on a lockstep bus. Simulated are the base, the LiDAR, a
camera, a renderer and an operator. Everything comes from a queue of events, so nothing depends on the machine.
"""

from __future__ import annotations

import dataclasses
import heapq
import itertools
from collections.abc import Callable
from typing import Any

import numpy as np
from control_world import ready_vspace, rectangle
from stack_world import START_NS, StackWorld

from instant_ic.bus.lockstep import LockstepBus, Record
from instant_ic.console.backend import PageServer
from instant_ic.console.config import ConsoleConfig, ConsoleServerConfig
from instant_ic.control.states import Mode
from instant_ic.msg import ControlState, RenderedView, compressed_image_message, deserialize, header, twist_values
from nodes.console import ConsoleNode

FORWARD, NOTHING = (0.4, 0.0), (0.0, 0.0)


@dataclasses.dataclass(frozen=True)
class Rates:
    """What comes how often and how late.

    Attributes:
        camera_hz: images per second.
        camera_delay_s: from the exposure to the console.
        view_hz: views per second that the renderer makes at most.
        view_delay_s: from a request to its view.
        jitter: share of a period by which images come late at random; of a delay likewise.
        lost: share of images that never come.
        scan_jitter_s: s by which scans and poses come late, at most.
        stall_s: s for which everything stands still every few seconds, as on a busy machine; it then comes at once.
    """

    camera_hz: float = 10.0
    camera_delay_s: float = 0.2
    view_hz: float = 10.0
    view_delay_s: float = 0.05
    jitter: float = 0.0
    lost: float = 0.0
    scan_jitter_s: float = 0.0
    stall_s: float = 0.0
    seed: int = 0


class RateWorld(StackWorld):
    """A corridor with boxes, a robot that drives in it, and what the operator sees of it; silent: camera, view, tf."""

    def __init__(self, boxes: list[tuple[float, float, float, float]], rates: Rates, length_m: float = 20.0) -> None:
        self.rates = rates
        self.one_image_of = 1  # 5: only each fifth image comes
        self.exposed = 0
        self.rng = np.random.default_rng([17, rates.seed])
        self.states: list[ControlState] = []
        self.changes: list[tuple[float, str, str]] = []
        """Each change of mode: when, to which, why."""
        self.speeds: list[tuple[float, float]] = []
        """Of the r-bot: when, m/s."""
        self.command = self.base_command = NOTHING
        self._events: list[tuple[int, int, Callable[[], None]]] = []
        self._orders = itertools.count()
        self._rendering = False
        self._request: Any = None
        self._last: dict[str, int] = {}
        obstacles = np.concatenate([np.zeros((0, 2, 2)), *(rectangle(*box) for box in boxes)])
        super().__init__(LockstepBus(START_NS, keep=False, on_record=self._on_record), obstacles, length_m)
        self.console = self.bus.add(ConsoleNode, ConsoleConfig(server=ConsoleServerConfig(port=0)), page=PageServer())
        self._every(0.05, self._move)
        self._every(0.05, self._operate)
        self._every(0.1, self._scan, 0.003)
        self._every(0.5, lambda: self.bus.publish("/vspace/status", ready_vspace(self.now), latched=True))
        self._every(1.0 / rates.camera_hz, self._expose, 0.007)

    def close(self) -> None:
        self.bus.close()

    # -- time

    @property
    def time_s(self) -> float:
        return (self.now - START_NS) / 1e9

    def _at(self, when_ns: int, do: Callable[[], None]) -> None:
        heapq.heappush(self._events, (when_ns, next(self._orders), do))

    def _every(self, period_s: float, do: Callable[[], None], first_s: float = 0.0) -> None:
        count = itertools.count(1)
        begin_ns = self.now + round(first_s * 1e9)

        def again() -> None:
            do()
            self._at(begin_ns + round(next(count) * period_s * 1e9), again)

        self._at(begin_ns, again)

    def run(self, seconds: float, until: Callable[[], bool] | None = None) -> bool:
        """Goes on for so long, or until a condition holds; whether it does."""
        end_ns = self.now + round(seconds * 1e9)
        while self._events and self._events[0][0] <= end_ns:
            when_ns, _, do = heapq.heappop(self._events)
            self.bus.advance_to(when_ns)
            do()
            if until is not None and until():
                return True
        self.bus.advance_to(end_ns)
        return False

    def drive(self, command: tuple[float, float], seconds: float, until: Callable[[], bool] | None = None) -> bool:
        """As :meth:`run`, with the operator's keys held so."""
        self.command = command
        return self.run(seconds, until)

    # -- what the stack says

    def _on_record(self, record: Record) -> None:
        if record.topic == "/ic/state":
            state = deserialize(record.payload, record.type_name)
            before = self.states[-1].mode if self.states else None
            self.states.append(state)
            if state.mode != before:
                self.changes.append((round(self.time_s, 3), Mode(state.mode).name, state.reason))
        elif record.topic == "/cmd_vel":
            self.base_command = twist_values(deserialize(record.payload, record.type_name))
        elif record.topic == "/view/request":
            self._request = deserialize(record.payload, record.type_name)
            self._at(self.now, self._render)

    @property
    def modes(self) -> list[str]:
        return [mode for _, mode, _ in self.changes]

    @property
    def state(self) -> ControlState:
        return self.states[-1]

    # -- the world

    def _operate(self) -> None:
        self.console.on_drive(*self.command)
        self.bus.advance_to(self.now)

    def _late(self, what: str, delay_s: float, do: Callable[[], None]) -> None:
        """Has something come later, but not before what came before it."""
        when = max(self.now + round(delay_s * 1e9), self._last.get(what, 0))
        if self.rates.stall_s:
            # Every 2.7 s the machine does nothing else for a while.
            phase = ((when - START_NS) / 1e9 + 0.37 * (len(what) % 5)) % 2.7
            if phase < self.rates.stall_s:
                when += round((self.rates.stall_s - phase) * 1e9)
        self._last[what] = when
        self._at(when, do)

    def _move(self) -> None:
        self.drive_base(self.base_command)
        frames, odometry = self.transforms(), self.odometry()

        def send() -> None:
            if "tf" not in self.silent:
                self.bus.publish("/tf", frames)
            self.bus.publish("/wheel/odom", odometry)

        self._late("odometry", self.rates.scan_jitter_s * 0.3 * self.rng.random(), send)
        self.speeds.append((self.time_s, self.base.v))

    def _scan(self) -> None:
        scan, pose = self.scan(), self.pose()

        def send() -> None:
            self.bus.publish("/scan", scan)
            self.bus.publish("/pose", pose)

        self._late("scan", 0.01 + self.rates.scan_jitter_s * self.rng.random(), send)

    def _expose(self) -> None:
        rates, now = self.rates, self.now
        self.exposed += 1
        if self.rng.random() < rates.lost or self.exposed % self.one_image_of:
            return
        delay_s = rates.camera_delay_s * (1 + rates.jitter * self.rng.random())
        delay_s += rates.jitter * self.rng.random() / rates.camera_hz
        message = compressed_image_message(b"", "camera", now)

        def send() -> None:
            if "camera" not in self.silent:
                self.bus.publish("/camera/image/compressed", message)

        self._late("camera", delay_s, send)

    def _render(self) -> None:
        if self._rendering or self._request is None:
            return
        rates, (request, self._request) = self.rates, (self._request, None)
        self._rendering = True
        takes_s = rates.view_delay_s * (1 + rates.jitter * self.rng.random())
        free_s = max(takes_s, 1.0 / rates.view_hz * (1 + rates.jitter * self.rng.random()))
        lost = self.rng.random() < rates.lost
        view = RenderedView(
            header=header("map", self.now),
            request_id=request.id,
            keyframe_id=1,
            pose=request.pose,
            fov_rad=request.fov_rad,
            width=request.width,
            height=request.height,
            confidence=1.0,
            render_ms=1000 * takes_s,
            image=compressed_image_message(b"", "map", self.now),
        )

        def send() -> None:
            if not lost and "view" not in self.silent:
                self.bus.publish("/vspace/view", view)

        def free() -> None:
            self._rendering = False
            self._render()

        self._late("view", takes_s, send)
        self._at(self.now + round(free_s * 1e9), free)
