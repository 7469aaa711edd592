"""Plot of ``experiments.teleop``."""

from __future__ import annotations

import io
import math
from collections.abc import Sequence
from itertools import pairwise
from pathlib import Path
from typing import Any, TypeAlias

import numpy as np
from numpy.typing import NDArray

from instant_ic.control.states import Mode
from instant_ic.experiments.plots import save_figure
from instant_ic.experiments.teleop import TeleopSettings
from instant_ic.experiments.teleop_figures import TRACK_S, TeleopDrive
from instant_ic.experiments.teleop_stack import METHODS
from instant_ic.experiments.teleop_worlds import Course, floor_plan

FloatArray: TypeAlias = NDArray[np.float64]

# Okabe and Ito's palette, distinguishable for colour-blind readers.
_COLOURS = {"ic": "#0072B2", "stop": "#E69F00"}
_MODE_COLOURS = {
    Mode.REAL: "#BBBBBB", Mode.ENTERING: "#F0E442", Mode.VIRTUAL: "#56B4E9", Mode.RETURNING: "#CC79A7",
    Mode.STOPPED: "#D55E00",
}  # fmt: skip
_MARGIN_M = 1.4


def save_plot(path: Path | io.BytesIO, drives: Sequence[TeleopDrive], settings: TeleopSettings, most: int = 4) -> None:
    """Save maps of the worst courses; below each map the arbiter's modes over time, one bar per method."""
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    indices = sorted({d.index for d in drives}, key=lambda index: _quality([d for d in drives if d.index == index]))
    courses = [(settings.course(index), [d for d in drives if d.index == index]) for index in indices[:most]]
    heights = [height for course, own in courses for height in (_map_height(course, own), 0.75)]
    figure = Figure(figsize=(8.0, 1.1 * sum(heights) + 0.6 * len(courses) + 1.0), dpi=110, layout="constrained")
    FigureCanvasAgg(figure)
    grid = figure.add_gridspec(len(heights), 1, height_ratios=heights)
    for number, (course, own) in enumerate(courses):
        _plot_course(figure.add_subplot(grid[2 * number]), course, own)
        plot_modes(figure.add_subplot(grid[2 * number + 1]), own)
    names = [name for name in METHODS if any(d.method == name for d in drives)]
    figure.legend(handles=_legend(names), loc="outside lower center", ncols=6, fontsize=8, frameon=False)
    save_figure(figure, path)


def _quality(drives: Sequence[TeleopDrive]) -> tuple[float, ...]:
    """Return a sort key: courses not completed first, then contacts, flicker, disobedience of the first method."""
    contacts, flicker = (sum(getattr(d, name) for d in drives) for name in ("contacts", "flicker"))
    obedience = drives[0].obedience
    missing = sum(not d.completed for d in drives)
    return -missing, -contacts, -flicker, 0.0 if math.isnan(obedience) else obedience


def _tracks(drives: Sequence[TeleopDrive]) -> FloatArray:
    """Return all positions (N, 2) of the robots of these drives."""
    return np.concatenate(
        [np.array(t).reshape(-1, 3)[:, :2] for d in drives for n, t in d.tracks.items() if n != "modes"]
    )


def _extent(course: Course, drives: Sequence[TeleopDrive]) -> tuple[FloatArray, FloatArray]:
    """Return the lowest and the highest corner (2,) of the map of these drives."""
    things = [(one.x, one.y) for one in course.obstacles]
    places = np.concatenate([_tracks(drives), course.goals, np.array(things).reshape(-1, 2), [course.world.spawn[:2]]])
    return places.min(axis=0) - _MARGIN_M, places.max(axis=0) + _MARGIN_M


def _map_height(course: Course, drives: Sequence[TeleopDrive]) -> float:
    low, high = _extent(course, drives)
    return float(np.clip(5.8 * (high[1] - low[1]) / (high[0] - low[0]), 1.2, 4.0))


def _plot_course(axis: Any, course: Course, drives: Sequence[TeleopDrive]) -> None:
    plan = floor_plan(course.world)
    rows, columns = plan.cells.shape
    x, y = plan.origin
    extent = (x, x + columns * plan.cell_m, y, y + rows * plan.cell_m)
    axis.imshow(np.where(plan.cells, 0.55, 1.0), origin="lower", extent=extent, cmap="gray", vmin=0, vmax=1)
    for drive in drives:
        colour = _COLOURS[drive.method]
        for name, style in (("robot", "-"), ("vbot", "--")):
            track = np.array(drive.tracks.get(name, [])).reshape(-1, 3)
            steps = np.linalg.norm(np.diff(track[:, :2], axis=0), axis=1)
            parts = np.split(track, np.flatnonzero(steps > 0.5) + 1)  # split between two visits to the virtual space
            for part in parts:
                axis.plot(part[:, 0], part[:, 1], style, color=colour, lw=1.2)
        for switch in drive.switches:
            at = _where(drive, switch.time_s)
            mark = ">" if switch.to_virtual else "<"
            axis.plot(*at, mark, color=colour, ms=7, mec="black", mew=0.6)
    axis.plot(*course.world.spawn[:2], "ko", ms=4)
    axis.plot(course.goals[:, 0], course.goals[:, 1], "k*", ms=9)
    (x0, y0), (x1, y1) = _extent(course, drives)
    axis.set(xlim=(x0, x1), ylim=(y0, y1), aspect="equal")
    words = [f"{d.method} {d.seconds:.0f} s{'' if d.completed else ' NOT COMPLETED'}" for d in drives]
    axis.set_title(f"course {drives[0].index}: " + ", ".join(words), fontsize=8)
    axis.tick_params(labelsize=6)


def _where(drive: TeleopDrive, time_s: float) -> FloatArray:
    """Return the position (2,) of the r-bot at a time."""
    track, modes = drive.tracks["robot"], drive.tracks["modes"]
    return np.array(track[min(max(0, round((time_s - modes[0][0]) / TRACK_S)), len(track) - 1)])[:2]


def plot_modes(axis: Any, drives: Sequence[TeleopDrive]) -> None:
    """Plot the arbiter's mode over time, one bar per method."""
    for k, drive in enumerate(drives):
        modes = drive.tracks["modes"]
        for (begins, mode), (ends, _) in pairwise(modes):
            axis.barh(k, ends - begins, left=begins - modes[0][0], height=0.8, color=_MODE_COLOURS[Mode(int(mode))])
    axis.set_yticks(range(len(drives)), [d.method for d in drives], fontsize=7)
    axis.invert_yaxis()
    axis.set_xlabel("s", fontsize=7, labelpad=0)
    axis.tick_params(labelsize=6)


def _legend(names: Sequence[str]) -> list[Any]:
    from matplotlib.lines import Line2D
    from matplotlib.patches import Patch

    def dot(marker: str, label: str, **look: Any) -> Line2D:
        return Line2D([], [], color="black", marker=marker, ls="none", ms=6, label=label, **look)

    return [
        *(Patch(color=_COLOURS[name], label=name) for name in names),
        Line2D([], [], color="black", label="r-bot"),
        Line2D([], [], color="black", ls="--", label="v-bot"),
        dot(">", "into the virtual space", mfc="none"),
        dot("<", "back", mfc="none"),
        *(Patch(color=colour, label=mode.name) for mode, colour in _MODE_COLOURS.items()),
    ]
