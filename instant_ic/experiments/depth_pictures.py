"""Report images: image, prediction, ground truth and error; and the point cloud from the side and from above."""

from __future__ import annotations

import math
from collections.abc import Sequence
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

from instant_ic.depth.colour import depth_picture
from instant_ic.experiments.depth import Scored, nearest
from instant_ic.geometry.projections import equirect_directions

ROWS = 8
_SIZE = 256, 512
_TITLE, _GAP = 24, 8
_SIDE_ROWS = 380
_SLAB_M = 0.3
_WALLS_M = -0.9, 0.6
_WRONG = 0.5
"""Relative error at the end of the colour scale."""
_GREY = 150

Picture = NDArray[np.uint8]
Cloud = tuple[NDArray[np.float32], Picture]


class Sheets:
    """Pages of ``ROWS`` panoramas, or with ``side`` of point clouds: OUT.png, OUT-2.png; ``close`` writes the last."""

    def __init__(self, path: Path, side: bool = False) -> None:
        self.path = path
        self.written: list[Path] = []
        self._draw = side_row if side else depth_row
        self._rows: list[Picture] = []

    def add(self, scored: Scored) -> None:
        """Add a panorama; write the page when it is full.

        Raises:
            OSError: the page cannot be written.
        """
        self._rows.append(self._draw(scored))
        if len(self._rows) == ROWS:
            self.close()

    def close(self) -> None:
        """Write the unfinished page; raises as ``add`` does."""
        if not self._rows:
            return
        page = len(self.written) + 1
        path = self.path if page == 1 else self.path.with_stem(f"{self.path.stem}-{page}")
        width = max(row.shape[1] for row in self._rows)
        rows = [np.pad(row, ((0, 0), (0, width - row.shape[1]), (0, 0)), constant_values=255) for row in self._rows]
        _, content = cv2.imencode(".png", np.vstack(rows)[..., ::-1])
        path.write_bytes(content.tobytes())
        self.written.append(path)
        self._rows = []


def depth_row(scored: Scored) -> Picture:
    """Image and prediction, with ground truth and relative error if available, side by side; (h, w, 3) RGB."""
    depth = nearest(scored.depth_m, _SIZE)
    truth = None if scored.truth_m is None else nearest(scored.truth_m, _SIZE)
    reference = depth if truth is None else truth
    known = reference[reference > 0]
    near, far = np.percentile(known, (1, 99)) if len(known) else (1.0, 2.0)
    image = np.asarray(cv2.resize(scored.rgb, _SIZE[::-1], interpolation=cv2.INTER_AREA), np.uint8)
    panels = [
        _titled(image, scored.name),
        _titled(depth_picture(depth, near, far), f"prediction, {near:.1f} (red) to {far:.1f} m"),
    ]
    if truth is not None and scored.after is not None:
        after = scored.after
        relative = np.where((truth > 0) & (depth > 0), (depth - truth) / np.where(truth > 0, truth, 1), np.nan)
        title = f"error, -{_WRONG:.0%} (red) to {_WRONG:.0%} (blue): MRE {after.mre:.3f}, delta1 {after.delta1:.3f}"
        panels += [_titled(depth_picture(truth, near, far), "truth"), _titled(_errors(relative), title)]
    return _beside(panels)


def side_row(scored: Scored) -> Picture:
    """Point cloud in slices ahead and across, and the walls from above; ground truth in grey; (h, w, 3) RGB."""
    cloud = _cloud(scored.depth_m, scored.rgb)
    truth = None if scored.truth_m is None else _cloud(scored.truth_m, scored.rgb)
    slab = (-_SLAB_M, _SLAB_M)
    cuts = (
        (f"{scored.name}: slice ahead (right)", (0, 2, 1), (1, 1), slab),
        ("slice across (left is left)", (1, 2, 0), (-1, 1), slab),
        (f"from above, {_WALLS_M[0]:g} to {_WALLS_M[1]:g} m of the camera", (0, 1, 2), (1, 1), _WALLS_M),
    )
    return _beside([_slice(cloud, truth, title, axes, signs, between) for title, axes, signs, between in cuts])


def _slice(
    cloud: Cloud,
    truth: Cloud | None,
    title: str,
    axes: tuple[int, int, int],
    signs: tuple[int, int],
    between: tuple[float, float],
) -> Picture:
    """Plot points with ``axes[2]`` between two values, ``axes[0]`` to the right, ``axes[1]`` up, on a 1 m grid."""
    drawn = []
    for points, colours in [c for c in (truth, cloud) if c is not None]:
        kept = (points[:, axes[2]] >= between[0]) & (points[:, axes[2]] <= between[1])
        drawn.append((points[kept][:, axes[:2]] * signs, colours[kept]))
    every = np.vstack([points for points, _ in drawn] + [np.zeros((1, 2), np.float32)])
    low, high = np.percentile(every, 0.5, axis=0) - 0.3, np.percentile(every, 99.5, axis=0) + 0.3
    low, high = np.minimum(low, -0.5), np.maximum(high, 0.5)
    scale = min(_SIZE[1] / (high[0] - low[0]), _SIDE_ROWS / (high[1] - low[1]))
    low = (low + high - np.array([_SIZE[1], _SIDE_ROWS]) / scale) / 2  # centre the view
    high = low + np.array([_SIZE[1], _SIDE_ROWS]) / scale
    picture = np.full((_SIDE_ROWS, _SIZE[1], 3), 245, np.uint8)

    def column(x: NDArray[np.floating]) -> NDArray[np.intp]:
        return np.floor((x - low[0]) * scale).astype(np.intp)

    def row(y: NDArray[np.floating]) -> NDArray[np.intp]:
        return np.floor((high[1] - y) * scale).astype(np.intp)

    for lines, axis, size in ((column, 0, _SIZE[1]), (row, 1, _SIDE_ROWS)):
        at = lines(np.arange(math.ceil(low[axis]), math.floor(high[axis]) + 1.0))
        at = at[(at >= 0) & (at < size)]
        picture[(slice(None), at) if axis == 0 else at] = 215
    for number, (points, colours) in enumerate(drawn):
        is_truth = truth is not None and number == 0
        # A result point covers 2 x 2 pixels and a ground-truth point 1, which is therefore visible only where the
        # result is wrong.
        for down, right in ((0, 0),) if is_truth else ((0, 0), (0, 1), (1, 0), (1, 1)):
            rows, columns = row(points[:, 1]) + down, column(points[:, 0]) + right
            inside = (rows >= 0) & (rows < _SIDE_ROWS) & (columns >= 0) & (columns < _SIZE[1])
            picture[rows[inside], columns[inside]] = _GREY if is_truth else colours[inside]
    origin = np.zeros(1)
    centre = (int(column(origin)[0]), int(row(origin)[0]))
    cv2.drawMarker(picture, centre, (220, 30, 30), cv2.MARKER_CROSS, 9, 1)
    return _titled(picture, f"{title}; grid 1 m")


def _cloud(depth_m: NDArray[np.float32], rgb: Picture) -> Cloud:
    """Points (N, 3) of known depth in the camera's frame; colours (N, 3), darkened so that white walls show."""
    height, width = depth_m.shape
    colours = np.asarray(cv2.resize(rgb, (width, height), interpolation=cv2.INTER_AREA))
    known = depth_m > 0
    points = equirect_directions(width, height)[known] * depth_m[known, None]
    return points, np.asarray(0.75 * colours[known], np.uint8)


def _errors(relative: NDArray[np.floating]) -> Picture:
    """Colour code: too near red, too far blue, correct white, unknown grey."""
    level = np.clip(relative / _WRONG, -1, 1)
    fade = np.clip(255 * (1 - np.abs(np.nan_to_num(level))), 0, 255).astype(np.uint8)
    full = np.full_like(fade, 255)
    picture = np.where((level < 0)[..., None], np.dstack([full, fade, fade]), np.dstack([fade, fade, full]))
    picture[np.isnan(level)] = _GREY
    return np.asarray(picture, np.uint8)


def _titled(picture: Picture, title: str) -> Picture:
    strip = np.full((_TITLE, picture.shape[1], 3), 255, np.uint8)
    # OpenCV's font is ASCII only.
    text = title.encode("ascii", "replace").decode()
    cv2.putText(strip, text, (2, _TITLE - 8), cv2.FONT_HERSHEY_SIMPLEX, 0.42, (0, 0, 0), 1, cv2.LINE_AA)
    return np.vstack([strip, picture])


def _beside(panels: Sequence[Picture]) -> Picture:
    gap = np.full((panels[0].shape[0], _GAP, 3), 255, np.uint8)
    parts = [part for panel in panels for part in (panel, gap)]
    joined = np.hstack(parts)
    return np.vstack([joined, np.full((_GAP, joined.shape[1], 3), 255, np.uint8)])
