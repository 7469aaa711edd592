"""Watching a drive of a running stack, from the bus and from asyncio code."""

from __future__ import annotations

import asyncio
import contextlib
import time
from collections.abc import AsyncIterator, Callable
from typing import Any

import numpy as np
from numpy.typing import NDArray

from instant_ic.bus import LATCHED
from instant_ic.experiments.stack import Stack, StackError
from instant_ic.msg import Bool, ControlState, Odometry, VspaceStatus, pose2_from_message


class DriveRecorder:
    """Records a drive from the bus.

    Attributes:
        modes: the first mode (ControlState.REAL, ...) and every later one, with its reason in ``reasons`` and the time
            of the change on the machine's steady clock in ``mode_times_s``.
        truth: ground-truth poses of the r-bot, (x, y, yaw) in the world.
        vbot: poses of the v-bot in the map while it was active.
        vbot_pose: newest pose of the v-bot; None before the first.
        contact: True once the r-bot has touched something.
        ready_seconds: seconds from the arrival of each keyframe until the virtual space was ready to be shown.
        vspace: newest status of the virtual space; None before the first.
    """

    def __init__(self, stack: Stack) -> None:
        self.modes: list[int] = []
        self.mode_times_s: list[float] = []
        self.reasons: list[str] = []
        self.truth: list[NDArray[np.float64]] = []
        self.vbot: list[NDArray[np.float64]] = []
        self.vbot_pose: NDArray[np.float64] | None = None
        self.contact = False
        self.ready_seconds: list[float] = []
        self.vspace: Any = None
        self._ready_keyframe = -1
        observer = stack.observer
        observer.subscribe("/ic/state", ControlState, self._on_state, LATCHED)
        observer.subscribe("/ground_truth/odom", Odometry, lambda m: self.truth.append(pose2_from_message(m)))
        observer.subscribe("/ground_truth/contact", Bool, self._on_contact, LATCHED)
        observer.subscribe("/vbot/odom", Odometry, self._on_vbot)
        observer.subscribe("/vspace/status", VspaceStatus, self._on_vspace, LATCHED)

    @property
    def mode(self) -> int | None:
        """The current mode; None before the first message."""
        return self.modes[-1] if self.modes else None

    def _on_state(self, message: Any) -> None:
        if message.mode != self.mode:
            self.modes.append(message.mode)
            self.mode_times_s.append(time.monotonic())
            self.reasons.append(message.reason)

    def _on_contact(self, message: Any) -> None:
        self.contact |= bool(message.data)

    def _on_vbot(self, message: Any) -> None:
        self.vbot_pose = pose2_from_message(message)
        if self.mode == ControlState.VIRTUAL:
            self.vbot.append(self.vbot_pose)

    def _on_vspace(self, message: Any) -> None:
        self.vspace = message
        if message.state == message.READY and message.keyframe_id != self._ready_keyframe:
            self._ready_keyframe = message.keyframe_id
            self.ready_seconds.append(float(message.ready_seconds))

    @property
    def ready(self) -> bool:
        """True when the virtual space is ready to be shown."""
        return self.vspace is not None and self.vspace.state == self.vspace.READY


@contextlib.asynccontextmanager
async def pump(stack: Stack) -> AsyncIterator[Callable[[Callable[[], Any], float, str], Any]]:
    """Run the observer's callbacks beside asyncio code; yield ``await until(condition, timeout_s, what)``.

    Timeouts are seconds of the stack's time.
    """
    failure: list[BaseException] = []

    async def run() -> None:
        try:
            while True:
                stack.observer.spin_once()
                stack.check_alive("the drive")
                await asyncio.sleep(0.01)
        except Exception as error:
            failure.append(error)
            raise

    task = asyncio.create_task(run())

    async def until(condition: Callable[[], Any], timeout_s: float, what: str) -> Any:
        deadline = asyncio.get_running_loop().time() + timeout_s / stack.pace
        while not (value := condition()):
            if failure:
                raise failure[0]
            if asyncio.get_running_loop().time() > deadline:
                raise StackError(f"no {what} within {timeout_s:g} s:\n{stack.log_tail()}")
            await asyncio.sleep(0.02)
        return value

    try:
        yield until
    finally:
        task.cancel()
        with contextlib.suppress(asyncio.CancelledError, StackError):
            await task
