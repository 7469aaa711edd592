"""Settings of ``ic evaluate teleop``."""

from __future__ import annotations

import functools
from dataclasses import dataclass
from pathlib import Path

from instant_ic.experiments.teleop_stack import METHODS, StackConfig
from instant_ic.experiments.teleop_worlds import RANDOM_CORRIDORS, Course, make_course


@dataclass(frozen=True)
class TeleopSettings:
    """TeleopSettings of one evaluation.

    Attributes:
        episodes, seed: which drives; the same seed gives the same drives.
        world: ``corridors`` (random ones), or a world of the simulator.
        methods: of ``METHODS``.
        depth: as ``StackConfig``.
        log: a recorded operator's commands: a bag or a CSV file; None: the scripted operator.
        pictures: whether to render and compare the images on either side of a switch.
        overrides: parameters ``node.key:=value`` on top of the shipped ones.
        manner: of the scripted operator, of ``teleop_operator.MANNERS``.
    """

    episodes: int = 50
    seed: int = 0
    world: str = RANDOM_CORRIDORS
    methods: tuple[str, ...] = METHODS
    depth: str = "completed"
    log: Path | None = None
    pictures: bool = True
    overrides: tuple[str, ...] = ()
    manner: str = "plain"

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
        return _course(self.world, self.seed, index, self.log is not None)


_course = functools.lru_cache(maxsize=2)(make_course)
"""Cached: all methods drive the same course."""
