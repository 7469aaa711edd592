"""The base on a serial line in simulated time: nothing here depends on the machine's speed.

Time moves in steps of a millisecond while the driver sleeps, waits for a reply or for its next step. The tracks are
those of the simulated robot, with the motors' response and friction.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Callable
from typing import Any

import numpy as np

from instant_ic.base.config import RoboclawConfig
from instant_ic.base.controller import BaseController, BaseState, ControllerConfig
from instant_ic.base.roboclaw import Roboclaw
from instant_ic.bus.clock import ManualClock
from instant_ic.bus.lockstep import LockstepBus
from instant_ic.msg import Bool, twist_stamped
from instant_ic.sim.contact import OccupancyMask
from instant_ic.sim.roboclaw_emulator import RoboclawEmulator
from instant_ic.sim.robot import RobotConfig, TrackedRobot
from instant_ic.sim.simulation import drive
from nodes.crawler_base import CrawlerBaseConfig, CrawlerBaseNode

TICK_S = 0.001
RATE_HZ = 30.0


class Line:
    """A serial port with the emulated controller and the robot at its end.

    Attributes:
        forward: what becomes of bytes on their way to the controller.
        back: what becomes of replies.
        late_s: seconds until the next reply arrives; replies arrive in order.
        opened: how often the port was opened.
        moved_s: when the tracks moved last, seconds.
        written: every frame and when it was written, seconds.
        motors: motors of the robot.
    """

    def __init__(self, config: RoboclawConfig, ideal_motors: bool = False) -> None:
        self.config = config
        self.emulator = RoboclawEmulator(ideal_motors=ideal_motors)
        free = OccupancyMask(np.zeros((1000, 1000), bool), np.array([-5.0, -5.0]), 0.01)
        still = RobotConfig(slip=0.0, turn_slip=0.0, encoder_noise_pulses=0.0)
        self.robot = TrackedRobot(still, free, (0.0, 0.0, 0.0))
        self.ideal_motors = ideal_motors
        self.ticks = 0
        self.moved_s = 0.0
        self.forward: Callable[[bytes], bytes] = bytes
        self.back: Callable[[bytes], bytes] = bytes
        self.late_s: Callable[[], float] = float
        self.opened = 0
        self.closed = True
        self.written: list[tuple[float, bytes]] = []
        self.motors = self.robot.motors
        self._received = bytearray()
        self._coming: list[tuple[float, bytes]] = []  # replies on their way, and when they arrive

    @property
    def time_s(self) -> float:
        return self.ticks * TICK_S

    @property
    def speed(self) -> float:
        """Of the faster track, m/s."""
        speeds = self.emulator.speed_pps / 4000.0 if self.ideal_motors else self.robot.tracks
        return float(np.abs(speeds).max())

    @property
    def travelled_m(self) -> float:
        """Of the faster track since the start."""
        return float(np.abs(self.motors.travelled).max())

    def advance(self, seconds: float) -> None:
        for _ in range(max(1, round(seconds / TICK_S))):
            self.emulator.advance(TICK_S)
            if not self.ideal_motors:
                drive(self.robot, self.emulator, TICK_S)
            self.ticks += 1
            if self.speed > 0.0:
                self.moved_s = self.time_s

    def brown_out(self) -> None:
        """The controller restarts: motors off, counts and settings gone."""
        self.emulator.restart()
        self.robot.motors.counted = np.zeros(2)

    # -- the port

    def open(self, config: RoboclawConfig) -> Line:
        self.opened += 1
        self.closed = False
        self.reset_input_buffer()
        return self

    def write(self, data: bytes, /) -> int:
        assert not self.closed
        self.written.append((self.time_s, bytes(data)))
        reply = self.back(self.emulator.feed(self.forward(bytes(data))))
        before_s = self._coming[-1][0] if self._coming else 0.0
        self._coming.append((max(before_s, self.time_s + self.late_s()), reply))
        self._arrive()
        return len(data)

    def _arrive(self) -> None:
        while self._coming and self._coming[0][0] <= self.time_s:
            self._received += self._coming.pop(0)[1]

    def read(self, size: int = 1, /) -> bytes:
        assert not self.closed
        for _ in range(round(self.config.reply_timeout_s / TICK_S)):
            if len(self._received) >= size:
                break
            self.advance(TICK_S)
            self._arrive()
        taken = bytes(self._received[:size])
        del self._received[:size]
        return taken

    def reset_input_buffer(self) -> None:
        self._arrive()
        self._received.clear()

    def close(self) -> None:
        self.closed = True


class Base:
    """A controller that is stepped as `ControllerThread` does it, and commands that come 20 times a second."""

    def __init__(self, config: ControllerConfig | None = None, ideal_motors: bool = False) -> None:
        self.config = config or ControllerConfig(roboclaw=RoboclawConfig(port="memory"))
        self.line = Line(self.config.roboclaw, ideal_motors)
        self.set_by_ns = 0
        """By how much the machine's clock was set."""
        self.controller = BaseController(self.config, self.now_ns, self.steady_ns, self.line.open)
        self.controller.roboclaw = Roboclaw(self.config.roboclaw, self.line.open, self.line.advance)
        self.states: list[BaseState] = []
        self._due_s = self._command_due_s = 0.0

    def steady_ns(self) -> int:
        return 10**12 + round(self.line.time_s * 1e9)

    def now_ns(self) -> int:
        return 10**18 + self.steady_ns() + self.set_by_ns

    def step(self) -> BaseState:
        self.states.append(self.controller.step())
        return self.states[-1]

    def run(self, seconds: float, v: float | None = None, w: float = 0.0, hard: bool = False) -> None:
        """Goes on for a while; without ``v`` no commands come."""
        end_s = self.line.time_s + seconds
        while self.line.time_s < end_s:
            if v is not None and self.line.time_s >= self._command_due_s:
                self._command_due_s = self.line.time_s + 0.05
                self.controller.command(v, w, self.steady_ns(), hard)
            if self.line.time_s >= self._due_s:
                self._due_s = max(self._due_s + 1.0 / RATE_HZ, self.line.time_s)
                self.step()
            self.line.advance(TICK_S)

    def until_standing(self, v: float | None = None, hard: bool = False, limit_s: float = 5.0) -> tuple[float, float]:
        """Runs until the tracks stand, and for a second longer; seconds and metres that it took."""
        start_s, start_m = self.line.time_s, self.line.travelled_m
        while self.line.time_s < start_s + limit_s:
            self.run(TICK_S, v, hard=hard)
            if self.line.time_s > self.line.moved_s + 1.0:
                return self.line.moved_s - start_s, self.line.travelled_m - start_m
        raise AssertionError(f"still moving at {self.line.speed:.2f} m/s after {limit_s} s")


class SetClock(ManualClock):
    """A machine's clock that was set by ``set_by_ns`` nanoseconds; the steady clock goes on."""

    set_by_ns = 0

    def now_ns(self) -> int:
        return self._now_ns + self.set_by_ns

    def steady_ns(self) -> int:
        return self._now_ns


class NodeBench:
    """The node on a lockstep bus, its controller and the robot."""

    def __init__(self, **changes: Any) -> None:
        roboclaw = RoboclawConfig(port="memory")
        self.line = Line(roboclaw)

        self.bus = LockstepBus(start_ns=10**18)
        self.clock = self.bus.clock = SetClock(10**18)
        self.node = self.bus.add(
            CrawlerBaseNode,
            dataclasses.replace(CrawlerBaseConfig(roboclaw=roboclaw), **changes),
            open_port=self.line.open,
        )

    def run(self, seconds: float, v: float | None = None, publisher: str = "arbiter") -> None:
        """Goes on in steps of a millisecond; with ``v`` a command comes each 50 ms."""
        for step in range(round(seconds / TICK_S)):
            if v is not None and step % 50 == 0:
                self.command(v, publisher)
            self.line.advance(TICK_S)
            self.clock.set(self.clock.steady_ns() + round(TICK_S * 1e9))
            while self.node.spin_once():
                pass

    def command(self, v: float, publisher: str = "arbiter", ahead_s: float = 0.0, frame_id: str = "base_link") -> None:
        stamp = self.clock.now_ns() + round(ahead_s * 1e9)
        self.bus.publish("/cmd_vel", twist_stamped(v, 0.0, stamp, frame_id), publisher=publisher)

    def estop(self, pressed: bool, publisher: str = "console", topic: str = "/operator/estop") -> None:
        self.bus.publish(topic, Bool(data=pressed), latched=True, publisher=publisher)

    def stopping(self, v: float | None = None) -> tuple[float, float]:
        """Goes on until the tracks have stood for half a second; seconds and metres that it took."""
        start_s, start_m = self.line.time_s, self.line.travelled_m
        for _ in range(100):
            self.run(0.05, v)
            if self.line.time_s > self.line.moved_s + 0.5:
                return max(0.0, self.line.moved_s - start_s), self.line.travelled_m - start_m
        raise AssertionError(f"still moving at {self.line.speed:.2f} m/s")

    def diagnosis(self, name: str) -> tuple[int, str]:
        level, text, _ = self.node.diagnoses()[name]
        return level, text
