"""``ic evaluate illusion``: the operator's views inside and behind an obstacle, compared with the truth.

The drive is that of ``ic evaluate teleop`` with illusory control. ``illusion_stack`` compares the frames of the page.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass, field
from typing import Any

import numpy as np
from numpy.typing import NDArray

from instant_ic.control.warmup import warm_up
from instant_ic.experiments.illusion_stack import (
    FOV_RAD,
    FRAME_S,
    HEIGHT,
    LIVE,
    SOURCES,
    WIDTH,
    FilmedStack,
    IllusionFrame,
    StackConfig,
)
from instant_ic.experiments.processes import run_all
from instant_ic.experiments.results import finite
from instant_ic.experiments.teleop import TeleopSettings, run_episode

STEP_M = 0.5
"""Width of a row of ``by_distance``."""
WITHIN_DB = 2.0
"""Error allowed in the expected PSNR."""
Still = dict[str, NDArray[np.uint8]]
"""Images of one frame: ``truth`` and each source."""


@dataclass
class Film:
    """The frames of one episode in the order of time, and whether the drive reached its goal.

    ``stills`` are of the frame nearest to each multiple of ``STEP_M``, by that distance in metres.
    """

    index: int
    completed: bool = False
    frames: list[IllusionFrame] = field(default_factory=list)
    stills: dict[float, Still] = field(default_factory=dict)
    _off_m: dict[float, float] = field(default_factory=dict)  # how far each still is from its distance

    def take(self, frame: IllusionFrame, images: Still, truth: NDArray[np.uint8]) -> None:
        """Add a frame, its images by source, and the true image."""
        self.frames.append(frame)
        if frame.distance_m is None:
            return
        row = _row(frame.distance_m)
        off = abs(frame.distance_m - row)
        if off < self._off_m.get(row, math.inf):
            self._off_m[row], self.stills[row] = off, {"truth": truth, **images}


def film_episode(settings: TeleopSettings, index: int) -> Film:
    """Drive one course and compare the frames; the same settings and index give the same result.

    Raises:
        ValueError: no such world, or no possible drive in it.
        RuntimeError: the stack did not become ready.
    """
    film, course = Film(index), settings.course(index)

    def make_stack(world: Any, config: StackConfig) -> FilmedStack:
        return FilmedStack(world, config, course, index, film.take)

    (drive,) = run_episode(settings, index, methods=("ic",), make_stack=make_stack)
    film.completed = drive.completed
    return film


def evaluate(
    settings: TeleopSettings, jobs: int = 1, on_film: Callable[[Film], None] | None = None, timeout_s: float = 7200.0
) -> list[Film]:
    """Film all episodes, ``jobs`` in parallel; with more than one job, each in its own process.

    Raises:
        ValueError: nothing to do, no such world.
        TimeoutError: the episodes took longer than ``timeout_s``.
        RuntimeError: a process died, or a stack did not become ready.
    """
    tasks = [(settings, index) for index in range(settings.episodes)]
    films = run_all(film_episode, tasks, jobs, warm_up, on_film, timeout_s)
    return sorted(films, key=lambda film: film.index)


def report(films: Sequence[Film], settings: TeleopSettings) -> dict[str, Any]:
    """Return the figures of all frames by source, readiness, and each frame; ready for JSON.

    Raises:
        ValueError: the virtual space was never shown.
    """
    frames = [frame for film in films for frame in film.frames]
    if not frames:
        raise ValueError(f"world {settings.world!r}: the virtual space was not shown in {len(films)} episode(s)")
    result = {
        "world": settings.world,
        "episodes": len(films),
        "seed": settings.seed,
        "overrides": list(settings.overrides),
        "screen": [WIDTH, HEIGHT, round(math.degrees(FOV_RAD), 1)],
        "seconds_between_frames": FRAME_S,
        "completed": sum(film.completed for film in films),
        **figures(frames, LIVE),
        "by_distance": by_distance(frames, LIVE),
        "frames_without_obstacle": sum(frame.distance_m is None for frame in frames),
    }
    for source in SOURCES[1:]:
        result[source] = {**figures(frames, source), "by_distance": by_distance(frames, source)}
    result["readiness"] = readiness(frames)
    result["each"] = [asdict(frame) for frame in frames]
    rounded: dict[str, Any] = finite(result, 4)
    return rounded


def figures(frames: Sequence[IllusionFrame], source: str) -> dict[str, Any]:
    """Return the mean figures of frames for a source; NaN where there is nothing to average."""
    scores = [frame.scores[source] for frame in frames]
    psnr = np.array([one.psnr_db for one in scores])
    floor = sum(one.floor for one in scores)
    return {
        "frames": len(frames),
        "psnr_mean_db": float(psnr.mean()),
        "psnr_p05_db": float(np.percentile(psnr, 5)),
        "ssim_mean": float(np.mean([one.ssim for one in scores])),
        "unseen_share_mean": float(np.mean([frame.unseen_share[source] for frame in frames])),
        "floor_fog_share": sum(one.fog for one in scores) / floor if floor else math.nan,
    }


def by_distance(frames: Sequence[IllusionFrame], source: str) -> list[dict[str, Any]]:
    """Return ``figures`` by distance behind the near face, in rows of ``STEP_M`` around their distance."""
    rows: dict[float, list[IllusionFrame]] = {}
    for frame in frames:
        if frame.distance_m is not None:
            rows.setdefault(_row(frame.distance_m), []).append(frame)
    return [{"distance_m": row, **figures(rows[row], source)} for row in sorted(rows)]


def readiness(frames: Sequence[IllusionFrame]) -> dict[str, Any]:
    """Return the error in dB of the expected PSNR over the live frames that show the view alone."""
    error = np.array([frame.expected_psnr_db - frame.scores[LIVE].psnr_db for frame in frames if frame.blend == 1])
    if not error.size:
        return {}
    return {
        "mean_error_db": float(error.mean()),
        "rms_error_db": float(np.sqrt(np.mean(error**2))),
        "p95_abs_error_db": float(np.percentile(np.abs(error), 95)),
        "share_within_2_db": float(np.mean(np.abs(error) <= WITHIN_DB)),
    }


def _row(distance_m: float) -> float:
    return STEP_M * round(distance_m / STEP_M) + 0.0  # no −0
