"""Plot and video of ``evaluation.teleop``."""

from __future__ import annotations

import math
from collections.abc import Sequence
from pathlib import Path
from types import TracebackType
from typing import Any, Self, TypeAlias

import numpy as np
from numpy.typing import NDArray

from ..control.arbiter import Mode
from ..control.footprint import Footprint
from ..sim.contact import OccupancyMask
from .pictures import new_figure, save_figure
from .teleop import Settings, decode, photograph
from .teleop_figures import Drive
from .teleop_stack import METHODS, SimulatedStack
from .teleop_worlds import Course, floor_plan, make_course

FloatArray: TypeAlias = NDArray[np.float64]

_COLOURS = {"ic": "tab:blue", "stop": "tab:orange", "shared": "tab:green"}
_BARS = (
    ("completed_fraction", "completed"),
    ("obedience", "obedience"),
    ("contacts", "contacts"),
    ("detours", "detours by hand"),
    ("seconds_mean", "seconds a drive"),
    ("longest_stall_s", "longest stall, s"),
)
_PICTURE, _MAP = (640, 360), 360
FPS = 10


def save_plot(path: Path, drives: Sequence[Drive], report: dict[str, Any], settings: Settings, most: int = 6) -> None:
    """Paths of some episodes, the least completed first, and bars by method."""
    indices = sorted({d.index for d in drives}, key=lambda i: (min(d.completed for d in drives if d.index == i), i))
    shown = indices[:most]
    rows = math.ceil(len(shown) / 2) + math.ceil(len(_BARS) / 2)
    figure, axes = new_figure(rows, 2, (11.0, 2.4 * rows))
    flat = list(axes.ravel())
    for index, axis in zip(shown, flat, strict=False):
        _draw_episode(axis, make_course(settings.world, settings.seed, index), [d for d in drives if d.index == index])
    for axis in flat[len(shown) : 2 * math.ceil(len(shown) / 2)]:
        axis.set_axis_off()
    for (key, label), axis in zip(_BARS, flat[2 * math.ceil(len(shown) / 2) :], strict=False):
        names = [name for name in METHODS if name in report["methods"]]
        values = [report["methods"][name][key] for name in names]
        axis.bar(names, [v or 0.0 for v in values], color=[_COLOURS[name] for name in names])
        axis.set_ylim(0, 1.2 * max([v or 0.0 for v in values]) or 1.0)
        for k, value in enumerate(values):
            words = "none" if value is None else f"{value:.3g}"
            axis.annotate(words, (k, value or 0.0), ha="center", va="bottom", fontsize=8)
        axis.set_title(label, fontsize=9)
    figure.suptitle(f"{settings.world}, seed {settings.seed}: dashed is the v-bot, grey what the robot may run into")
    save_figure(figure, path)


def _draw_episode(axis: Any, course: Course, drives: Sequence[Drive]) -> None:
    plan = floor_plan(course.world)
    rows, columns = plan.cells.shape
    x, y = plan.origin
    extent = (x, x + columns * plan.cell_m, y, y + rows * plan.cell_m)
    axis.imshow(np.where(plan.cells, 0.6, 1.0), origin="lower", extent=extent, cmap="gray", vmin=0, vmax=1)
    for drive in drives:
        for name, style in (("robot", "-"), ("vbot", "--")):
            track = np.array(drive.tracks.get(name, [])).reshape(-1, 3)
            axis.plot(track[:, 0], track[:, 1], style, color=_COLOURS[drive.method], lw=1.0, label=drive.method)
        for switch in drive.switches:
            at = np.array(drive.tracks["robot"])[min(int(switch.time_s / 0.2), len(drive.tracks["robot"]) - 1)]
            axis.plot(at[0], at[1], ">" if switch.to_virtual else "<", color=_COLOURS[drive.method], ms=5)
    axis.plot(course.goals[:, 0], course.goals[:, 1], "k*", ms=7)
    words = [f"{d.method} {'completed' if d.completed else 'not completed'} {d.seconds:.0f} s" for d in drives]
    axis.set_title(f"{drives[0].index}: " + ", ".join(words), fontsize=7)
    axis.tick_params(labelsize=6)


class Video:
    """Split view of one drive, picture by picture of simulated time: what the operator sees, and the map.

    Raises:
        ValueError: the file cannot be written.
    """

    def __init__(self, path: Path) -> None:
        import cv2

        self.path = path
        size = (_PICTURE[0] + _MAP, _PICTURE[1])
        self._writer = cv2.VideoWriter(str(path), cv2.VideoWriter.fourcc(*"mp4v"), FPS, size)
        if not self._writer.isOpened():
            raise ValueError(f"{path}: the video cannot be written")
        self._map: _Map | None = None
        self._next_s = 0.0
        self.pictures = 0

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        """Ends the file."""
        self._writer.release()

    def on_step(self, stack: SimulatedStack) -> None:
        """Adds a picture where one is due; give it to ``teleop.run_episode``."""
        if stack.time_s < self._next_s or not stack.log.pictures or not stack.log.time_s:
            return
        self._next_s = stack.time_s + 1.0 / FPS - 1e-6
        if self._map is None:
            self._map = _Map(floor_plan(stack.simulation.world, 0.05))
        self._writer.write(np.hstack([self._picture(stack), self._map.draw(stack)]))
        self.pictures += 1

    def _picture(self, stack: SimulatedStack) -> NDArray[np.uint8]:
        import cv2

        shown = stack.log.pictures[-1]
        if shown.virtual:
            rgb = decode(shown.jpeg)
        else:
            rgb = photograph(stack, shown, *_PICTURE, math.pi / 2)
        frame = np.ascontiguousarray(cv2.resize(rgb, _PICTURE)[..., ::-1])
        mode = Mode(stack.log.mode[-1]).name
        for words, top in (
            (f"{'virtual space' if shown.virtual else 'camera'}  ({mode})", 0),
            (stack.log.reason[-1], 334),
        ):
            frame[top : top + 26] //= 2
            at = (10, top + 18)
            cv2.putText(frame, words[:80], at, cv2.FONT_HERSHEY_SIMPLEX, 0.5, (255, 255, 255), 1, cv2.LINE_AA)
        return frame


class _Map:
    """The floor plan scaled into a square, and the robots on it (BGR)."""

    def __init__(self, plan: OccupancyMask) -> None:
        rows, columns = np.nonzero(plan.cells)
        points = plan.centre(np.column_stack([rows, columns]))
        low, high = points.min(axis=0) - 0.3, points.max(axis=0) + 0.3
        self.scale = _MAP / float((high - low).max())
        self.middle = 0.5 * (low + high)
        self.base = np.full((_MAP, _MAP, 3), 255, np.uint8)
        at = self.pixels(points)
        self.base[at[:, 1].clip(0, _MAP - 1), at[:, 0].clip(0, _MAP - 1)] = 140

    def pixels(self, points: FloatArray) -> NDArray[np.int32]:
        """(N, 2) column, row of places (N, 2)."""
        offset = (np.asarray(points) - self.middle) * self.scale * [1, -1] + _MAP / 2
        return np.asarray(np.rint(offset), np.int32)

    def draw(self, stack: SimulatedStack) -> NDArray[np.uint8]:
        import cv2

        frame = self.base.copy()
        log = stack.log
        cv2.polylines(frame, [self.pixels(np.array(log.robot)[:, :2])], False, (60, 60, 200), 1, cv2.LINE_AA)
        robots = [(log.robot[-1], (60, 60, 200))]
        if log.virtual[-1]:
            robots.append((log.vbot[-1], (200, 120, 0)))
        for pose, colour in robots:
            c, s = math.cos(pose[2]), math.sin(pose[2])
            corners = Footprint().corners() @ np.array([[c, s], [-s, c]]) + pose[:2]
            cv2.polylines(frame, [self.pixels(corners)], True, colour, 2, cv2.LINE_AA)
            nose = np.stack([pose[:2], pose[:2] + 0.4 * np.array([c, s])])
            cv2.polylines(frame, [self.pixels(nose)], False, colour, 1, cv2.LINE_AA)
        cv2.putText(frame, f"{stack.time_s:.1f} s", (8, 18), cv2.FONT_HERSHEY_SIMPLEX, 0.45, (0, 0, 0), 1, cv2.LINE_AA)
        return frame


__all__ = ["FPS", "Video", "save_plot"]
