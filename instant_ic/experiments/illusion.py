"""``ic evaluate illusion``: the operator's views inside and behind an obstacle, compared with the truth.

The drive is that of ``ic evaluate teleop`` with illusory control. ``illusion_stack`` compares the frames of the page.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from instant_ic.control.warmup import warm_up
from instant_ic.experiments.illusion_stack import (
    FOV_RAD,
    FRAME_S,
    HEIGHT,
    LIVE,
    TRUE_DEPTH,
    WIDTH,
    FilmedStack,
    IllusionFrame,
    StackConfig,
)
from instant_ic.experiments.plots import image_strip
from instant_ic.experiments.processes import run_all
from instant_ic.experiments.results import finite
from instant_ic.experiments.teleop import TeleopSettings, run_episode

STEP_M = 0.5
"""Width of a row of ``by_distance``."""
_TILE_PX = 400
_COLUMNS = {LIVE: "shown", "truth": "true", TRUE_DEPTH: "with true depth"}
Still = dict[str, NDArray[np.uint8]]
"""Images of one frame: ``truth`` and each source."""


@dataclass
class Film:
    """The frames of one episode in the order of time, and whether the drive reached its goal.

    ``stills`` maps each multiple of ``STEP_M``, in metres, to the images of the frame nearest to it.
    """

    index: int
    completed: bool = False
    frames: list[IllusionFrame] = field(default_factory=list)
    stills: dict[float, Still] = field(default_factory=dict)
    _off_m: dict[float, float] = field(default_factory=dict)  # difference of each still's distance from its multiple

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
    settings: TeleopSettings,
    jobs: int = 1,
    on_film: Callable[[Film], None] = lambda film: None,
    timeout_s: float = 7200.0,
) -> list[Film]:
    """Film all episodes, ``jobs`` in parallel; with more than one job, each in its own process.

    Raises:
        ValueError: there is nothing to do, or the world does not exist.
        TimeoutError: the episodes took longer than ``timeout_s``.
        RuntimeError: a process died, or a stack did not become ready.
    """
    tasks = [(settings, index) for index in range(settings.episodes)]
    films: list[Film] = []
    for film in run_all(film_episode, tasks, jobs, warm_up, timeout_s):
        films.append(film)
        on_film(film)
    return sorted(films, key=lambda film: film.index)


def report(films: Sequence[Film], settings: TeleopSettings) -> dict[str, Any]:
    """Return the figures of all frames by source, and each frame; ready for JSON.

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
    result[TRUE_DEPTH] = {**figures(frames, TRUE_DEPTH), "by_distance": by_distance(frames, TRUE_DEPTH)}
    result["each"] = [asdict(frame) for frame in frames]
    rounded: dict[str, Any] = finite(result, 4)
    return rounded


def figures(frames: Sequence[IllusionFrame], source: str) -> dict[str, Any]:
    """Return the mean figures of frames for a source."""
    scores = [frame.scores[source] for frame in frames]
    psnr = np.array([one.psnr_db for one in scores])
    return {
        "frames": len(frames),
        "psnr_mean_db": float(psnr.mean()),
        "psnr_p05_db": float(np.percentile(psnr, 5)),
        "ssim_mean": float(np.mean([one.ssim for one in scores])),
        "unseen_share_mean": float(np.mean([frame.unseen_share[source] for frame in frames])),
    }


def by_distance(frames: Sequence[IllusionFrame], source: str) -> list[dict[str, Any]]:
    """Return ``figures`` by distance behind the near face; each row covers ``STEP_M`` around its distance."""
    rows: dict[float, list[IllusionFrame]] = {}
    for frame in frames:
        if frame.distance_m is not None:
            rows.setdefault(_row(frame.distance_m), []).append(frame)
    return [{"distance_m": row, **figures(rows[row], source)} for row in sorted(rows)]


def _row(distance_m: float) -> float:
    return STEP_M * round(distance_m / STEP_M) + 0.0  # no −0


def save_strip(path: Path, films: Sequence[Film]) -> None:
    """Save the episode with the most stills as rows of images by distance behind the obstacle's near face.

    Raises:
        ValueError: no frame has a distance: no obstacle was passed.
    """
    film = max(films, key=lambda film: len(film.stills))
    if not film.stills:
        raise ValueError(f"{path}: there is no strip because no obstacle was passed")
    rows = [(f"{at:+.1f} m", [film.stills[at][name] for name in _COLUMNS]) for at in sorted(film.stills)]
    strip = image_strip(list(_COLUMNS.values()), rows, _TILE_PX)
    if not cv2.imwrite(str(path), strip[..., ::-1]):
        raise ValueError(f"{path}: the strip cannot be written")
