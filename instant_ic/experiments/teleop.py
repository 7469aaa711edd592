"""``ic evaluate teleop``: an operator drives through corridors with obstacles that the operator does not look at.

The whole stack runs in simulated time (``teleop_stack``) with three methods: illusory control, a robot that stops at
obstacles, and shared control that drives around them by itself. ``teleop_figures`` computes the figures.
"""

from __future__ import annotations

import contextlib
import logging
import time
from collections.abc import Callable, Iterator, Sequence
from dataclasses import replace
from typing import TYPE_CHECKING, TypeAlias

import numpy as np
from numpy.typing import NDArray

from instant_ic.control.states import Mode
from instant_ic.control.warmup import warm_up
from instant_ic.experiments import teleop_figures as figures
from instant_ic.experiments.processes import run_all
from instant_ic.experiments.teleop_figures import Drive, Switch
from instant_ic.experiments.teleop_operator import MANNERS, RecordedOperator, ScriptedOperator, Sight, read_commands
from instant_ic.experiments.teleop_results import in_order
from instant_ic.experiments.teleop_settings import TeleopSettings
from instant_ic.experiments.teleop_stack import (
    CAMERA_HEIGHT_M,
    NODES,
    VSPACE_NODES,
    Shown,
    SimulatedStack,
    StackConfig,
)
from instant_ic.experiments.teleop_worlds import Course, floor_plan
from instant_ic.geometry.image_quality import psnr_db
from instant_ic.geometry.poses import pose_matrix

if TYPE_CHECKING:
    from instant_ic.sim.world import World

FloatArray: TypeAlias = NDArray[np.float64]

AT_GOAL_M = 0.35
READY_S = 10.0
"""Longest time until the stack is ready for the first command."""


class _Episode:
    """One running episode."""

    def __init__(
        self,
        settings: TeleopSettings,
        course: Course,
        index: int,
        method: str,
        filmed: bool = False,
        make_stack: Callable[[World, StackConfig], SimulatedStack] = SimulatedStack,
    ) -> None:
        seed, words = 1000 * settings.seed + index, settings.overrides
        config = StackConfig(method, settings.depth, seed, whole_views=filmed, overrides=words)
        self.settings, self.course = settings, course
        self.drive = Drive(index, method, way_m=course.way_m)
        self.operator: ScriptedOperator | RecordedOperator
        if settings.log is None:
            self.operator = ScriptedOperator(course.goals, floor_plan(course.world), MANNERS[settings.manner], seed)
            self.limit_s = READY_S + (20.0 + 4.0 * course.way_m + 20.0 * len(course.obstacles))
        else:
            self.operator = RecordedOperator(read_commands(settings.log))
            self.limit_s = READY_S + (self.operator.log[-1, 0] + 20.0)
        self.stack = make_stack(course.world, config)
        self.began_s: float | None = None
        self.ended_s: float | None = None
        self.contacts = 0

    def run(self, on_step: Callable[[SimulatedStack], None] | None = None) -> Drive:
        """Drive until the goal is reached, the operator gives up, or the time limit is over.

        Raises:
            RuntimeError: the stack did not become ready.
        """
        drive, stack, began = self.drive, self.stack, time.process_time()
        with stack:
            while stack.time_s < self.limit_s and not self._over():
                stack.step(self._operate)
                if on_step is not None:
                    on_step(stack)
                if self.began_s is None and stack.time_s > READY_S:
                    reason = stack.state.reason if stack.state is not None else "the arbiter says nothing"
                    raise RuntimeError(f"the simulated robot was not ready within {READY_S:g} s: {reason}")
            drive.cpu_s = time.process_time() - began
            end_s = self.ended_s or stack.time_s
            drive.seconds = end_s - (self.began_s or 0.0)
            drive.contacts = stack.simulation.robot.contacts
            drive.completed = self.ended_s is not None
            drive.gave_up = self.operator.gave_up
            drive.detours = self.operator.detours
            drive.reason = "" if drive.completed else str(stack.state.reason)
            centres = np.array([(one.x, one.y) for one in self.course.obstacles]).reshape(-1, 2)
            figures.judge(drive, stack.log, centres)
            drive.switches = [self._with_pictures(switch) for switch in drive.switches]
        return drive

    def _operate(self) -> tuple[float, float]:
        stack = self.stack
        state = stack.state
        if state is None or (self.began_s is None and int(state.mode) != Mode.REAL):
            return 0.0, 0.0
        if self.began_s is None:
            self.began_s = stack.time_s
        twist = stack.simulation.robot.twist
        sight = Sight(
            stack.time_s,
            stack.shown_pose,
            stack.page.virtual,
            int(state.mode) == Mode.STOPPED,
            (float(twist[0]), float(twist[2])),
            stack.robot,
        )
        command = self.operator.command(sight)
        if self.ended_s is None and self._there():
            self.ended_s = stack.time_s
        return command

    def _there(self) -> bool:
        """Whether the operator is done, and the r-bot is at the goal and is the robot shown."""
        if not self.operator.done or self.stack.page.virtual:
            return False
        if isinstance(self.operator, RecordedOperator):
            return True
        return float(np.linalg.norm(self.stack.robot[:2] - self.course.goals[-1])) < AT_GOAL_M

    def _over(self) -> bool:
        return self.operator.gave_up or (self.ended_s is not None and self.stack.time_s > self.ended_s + 0.5)

    # -- images at a switch

    def _with_pictures(self, switch: Switch) -> Switch:
        found = figures.pictures_at(self.stack.log.pictures, switch.time_s, switch.to_virtual)
        if found is None or not self.settings.pictures:
            return switch
        return replace(switch, psnr_db=self._psnr_db(*found))

    def _psnr_db(self, before: Shown, after: Shown) -> float:
        view, photo = (before, after) if before.virtual else (after, before)
        rgb = decode(view.jpeg)
        return psnr_db(rgb, photograph(self.stack, photo, rgb.shape[1], rgb.shape[0], view.fov_rad))


def photograph(stack: SimulatedStack, shown: Shown, width: int, height: int, fov_rad: float) -> NDArray[np.uint8]:
    """The camera's image as the page shows it: taken from its own position, rotated to the heading."""
    pose = pose_matrix(shown.pose[0], shown.pose[1], CAMERA_HEIGHT_M, 0.0, 0.0, shown.heading)
    return stack.simulation.renderer.render_perspective(pose, width, height, fov_rad).rgb


def decode(jpeg: bytes) -> NDArray[np.uint8]:
    """Decode a JPEG to (H, W, 3) RGB.

    Raises:
        ValueError: not a JPEG.
    """
    import cv2

    picture = cv2.imdecode(np.frombuffer(jpeg, np.uint8), cv2.IMREAD_COLOR) if jpeg else None
    if picture is None:
        raise ValueError(f"a rendered view of {len(jpeg)} bytes cannot be decoded")
    return np.asarray(picture[..., ::-1])


def run_episode(
    settings: TeleopSettings,
    index: int,
    on_step: Callable[[SimulatedStack], None] | None = None,
    methods: tuple[str, ...] = (),
    make_stack: Callable[[World, StackConfig], SimulatedStack] = SimulatedStack,
) -> list[Drive]:
    """Drive one course by each method in turn; the same settings and index give the same result, except for times."""
    course, filmed = settings.course(index), on_step is not None
    with _quiet():
        return [
            _Episode(settings, course, index, name, filmed, make_stack).run(on_step)
            for name in methods or settings.methods
        ]


@contextlib.contextmanager
def _quiet() -> Iterator[None]:
    """Limit the nodes' loggers to errors: their warnings during start-up are expected."""
    loggers = [logging.getLogger(name) for name in (*NODES, *VSPACE_NODES)]
    levels = [logger.level for logger in loggers]
    try:
        for logger in loggers:
            logger.setLevel(logging.ERROR)
        yield
    finally:
        for logger, level in zip(loggers, levels, strict=True):
            logger.setLevel(level)


def evaluate(
    settings: TeleopSettings,
    jobs: int = 1,
    on_drive: Callable[[Drive], None] | None = None,
    timeout_s: float = 7200.0,
    done: Sequence[Drive] = (),
) -> list[Drive]:
    """Drive all courses by all methods, ``jobs`` drives in parallel; with more than one job, each in its own process.

    The drives in ``done`` are not repeated; ``timeout_s`` is for all drives.

    Raises:
        ValueError: nothing to do, no such world, no such log.
        TimeoutError: the drives took longer than ``timeout_s``.
        RuntimeError: a process died, or a stack did not become ready.
    """
    if settings.log is not None:
        read_commands(settings.log)  # fail before anything is started
    known = {(drive.index, drive.method) for drive in done}
    tasks = [(settings, i, name) for i in range(settings.episodes) for name in settings.methods]
    tasks = [task for task in tasks if task[1:] not in known]
    # The kernels are compiled first, so that no episode includes that time.
    return in_order([*done, *run_all(_drive, tasks, jobs, warm_up, on_drive, timeout_s)])


def _drive(settings: TeleopSettings, index: int, method: str) -> Drive:
    return run_episode(settings, index, methods=(method,))[0]
