"""``ic evaluate teleop``: an operator drives through corridors with obstacles that the operator does not look at.

The whole stack runs in simulated time (``teleop_stack``) with two methods: illusory control, and a robot that stops at
obstacles. ``teleop_figures`` computes the figures.
"""

from __future__ import annotations

import contextlib
import functools
import logging
from collections.abc import Callable, Iterator, Sequence
from dataclasses import asdict, dataclass, replace
from typing import TYPE_CHECKING, Any, TypeAlias

import numpy as np
from numpy.typing import NDArray

from instant_ic.control.states import Mode
from instant_ic.control.warmup import warm_up
from instant_ic.experiments import teleop_figures as figures
from instant_ic.experiments.processes import run_all
from instant_ic.experiments.results import finite
from instant_ic.experiments.teleop_figures import Shown, Switch, TeleopDrive
from instant_ic.experiments.teleop_operator import ScriptedOperator, Sight
from instant_ic.experiments.teleop_stack import (
    CAMERA_HEIGHT_M,
    METHODS,
    SimulatedStack,
    StackConfig,
)
from instant_ic.experiments.teleop_worlds import RANDOM_CORRIDORS, Course, floor_plan, make_course
from instant_ic.geometry.image_quality import psnr_db
from instant_ic.geometry.poses import pose_matrix
from instant_ic.util.limits import decode_rgb

if TYPE_CHECKING:
    from instant_ic.sim.world import World

FloatArray: TypeAlias = NDArray[np.float64]

AT_GOAL_M = 0.35
READY_S = 10.0
"""Longest time until the stack is ready for the first command."""

_course = functools.lru_cache(maxsize=2)(make_course)
"""Cached: all methods drive the same course."""


@dataclass(frozen=True)
class TeleopSettings:
    """Settings of one evaluation.

    Attributes:
        episodes, seed: number of courses, and their seed; the same seed gives the same drives.
        world: ``corridors`` (random ones), or a world of the simulator.
        methods: some of ``METHODS``.
        depth: depth source, see ``StackConfig``.
        pictures: render and compare the images on either side of a switch.
        overrides: parameters ``node.key:=value`` on top of the shipped ones.
    """

    episodes: int = 50
    seed: int = 0
    world: str = RANDOM_CORRIDORS
    methods: tuple[str, ...] = METHODS
    depth: str = "completed"
    pictures: bool = True
    overrides: tuple[str, ...] = ()

    def __post_init__(self) -> None:
        if self.episodes < 1:
            raise ValueError(f"episodes must be at least 1 (got {self.episodes})")
        if not self.methods:
            raise ValueError(f"methods must be some of {', '.join(METHODS)} (got none)")
        for method in self.methods:
            StackConfig(method, overrides=self.overrides)  # raises ValueError on a wrong one

    def course(self, index: int) -> Course:
        """Return course ``index``.

        Raises:
            ValueError: no such world, or no possible drive in it.
        """
        return _course(self.world, self.seed, index)


class _Episode:
    """One running episode."""

    def __init__(
        self,
        settings: TeleopSettings,
        course: Course,
        index: int,
        method: str,
        make_stack: Callable[[World, StackConfig], SimulatedStack] = SimulatedStack,
    ) -> None:
        seed, overrides = 1000 * settings.seed + index, settings.overrides
        config = StackConfig(method, settings.depth, seed, overrides=overrides)
        self.settings, self.course = settings, course
        self.drive = TeleopDrive(index, method, way_m=course.way_m)
        self.operator = ScriptedOperator(course.goals, floor_plan(course.world))
        self.limit_s = READY_S + (20.0 + 4.0 * course.way_m + 20.0 * len(course.obstacles))
        self.stack = make_stack(course.world, config)
        self.began_s: float | None = None
        self.ended_s: float | None = None

    def run(self, on_step: Callable[[SimulatedStack], None] | None = None) -> TeleopDrive:
        """Drive until the goal is reached, the operator gives up, or the time limit is over.

        Raises:
            RuntimeError: the stack did not become ready.
        """
        drive, stack = self.drive, self.stack
        with stack:
            while stack.time_s < self.limit_s and not self._over():
                stack.step(self._operate)
                if on_step is not None:
                    on_step(stack)
                if self.began_s is None and stack.time_s > READY_S:
                    reason = stack.state.reason if stack.state is not None else "the arbiter says nothing"
                    raise RuntimeError(f"the simulated robot was not ready within {READY_S:g} s: {reason}")
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
        """Return whether the operator is done, and the r-bot is at the goal and is the robot shown."""
        if not self.operator.done or self.stack.page.virtual:
            return False
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
        rgb = decode_rgb(view.jpeg)
        return psnr_db(rgb, photograph(self.stack, photo, rgb.shape[1], rgb.shape[0], view.fov_rad))


def photograph(stack: SimulatedStack, shown: Shown, width: int, height: int, fov_rad: float) -> NDArray[np.uint8]:
    """Render the camera's image as the page shows it: taken from its own position, rotated to the heading."""
    pose = pose_matrix(shown.pose[0], shown.pose[1], CAMERA_HEIGHT_M, 0.0, 0.0, shown.heading)
    return stack.simulation.renderer.render_perspective(pose, width, height, fov_rad).rgb


def run_episode(
    settings: TeleopSettings,
    index: int,
    on_step: Callable[[SimulatedStack], None] | None = None,
    methods: tuple[str, ...] = (),
    make_stack: Callable[[World, StackConfig], SimulatedStack] = SimulatedStack,
    course: Course | None = None,
) -> list[TeleopDrive]:
    """Drive one course by each method in turn; the same settings and index give the same result.

    Args:
        settings: methods, depth and parameters.
        index: number of the course.
        on_step: called with the stack after each step.
        methods: methods to drive by; those of the settings if empty.
        make_stack: returns the stack of a world.
        course: course to drive; that of the settings and the index if None.
    """
    course = course or settings.course(index)
    with _quiet():
        return [
            _Episode(settings, course, index, name, make_stack).run(on_step) for name in methods or settings.methods
        ]


@contextlib.contextmanager
def _quiet() -> Iterator[None]:
    """Hide warnings: those of the nodes during start-up are expected."""
    logging.disable(logging.WARNING)
    try:
        yield
    finally:
        logging.disable(logging.NOTSET)


def evaluate(
    settings: TeleopSettings,
    jobs: int = 1,
    on_drive: Callable[[TeleopDrive], None] = lambda drive: None,
    timeout_s: float = 7200.0,
) -> list[TeleopDrive]:
    """Drive all courses by all methods, ``jobs`` drives in parallel; with more than one job, each in its own process.

    Args:
        settings: courses and methods.
        jobs: number of processes.
        on_drive: called with each drive as it ends.
        timeout_s: time limit for all drives.

    Returns:
        Drives by course, then method.

    Raises:
        ValueError: no such world.
        TimeoutError: the drives took longer than ``timeout_s``.
        RuntimeError: a process died, or a stack did not become ready.
    """
    tasks = [(settings, i, name) for i in range(settings.episodes) for name in settings.methods]
    # The kernels are compiled first, so that no episode includes that time.
    drives: list[TeleopDrive] = []
    for drive in run_all(_drive, tasks, jobs, warm_up, timeout_s):
        drives.append(drive)
        on_drive(drive)
    return sorted(drives, key=lambda drive: (drive.index, METHODS.index(drive.method)))


def _drive(settings: TeleopSettings, index: int, method: str) -> TeleopDrive:
    return run_episode(settings, index, methods=(method,))[0]


def report(drives: Sequence[TeleopDrive], settings: TeleopSettings) -> dict[str, Any]:
    """Return the figures by method, the targets, and each drive without its tracks, ready for JSON."""
    by_method = {name: [d for d in drives if d.method == name] for name in settings.methods}
    methods = {name: figures.summary(own) for name, own in by_method.items() if own}
    rows = [{key: value for key, value in asdict(drive).items() if key != "tracks"} for drive in drives]
    return {
        "seed": settings.seed,
        "world": settings.world,
        "depth": settings.depth,
        "parameters": list(settings.overrides),
        "drives": len(drives),
        "methods": finite(methods),
        "targets": figures.targets(methods["ic"]) if "ic" in methods else {},
        "each": finite(rows),
    }
