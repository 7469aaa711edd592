"""Comparison images for reports: input next to result."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from instant_ic.geometry.projections import perspective_directions, sample_equirect


def perspective_crop(
    panorama: NDArray[np.uint8], camera_from_view: NDArray[np.float64], width: int, height: int, hfov_rad: float
) -> NDArray[np.uint8]:
    """Pinhole view from the panorama's centre.

    Args:
        panorama: (H, W, 3).
        camera_from_view: rotation (3, 3) of the view, which looks along its own x.
        width, height: of the crop.
        hfov_rad: horizontal field of view.
    """
    directions = perspective_directions(width, height, hfov_rad) @ camera_from_view.T.astype(np.float32)
    return np.clip(np.rint(sample_equirect(panorama, directions)), 0, 255).astype(np.uint8)


def correlation(a: NDArray[np.uint8], b: NDArray[np.uint8]) -> float:
    """Pearson correlation of two images' values, −1..1; 0 if one of them is uniform."""
    x, y = (picture.astype(np.float64).ravel() - float(picture.mean()) for picture in (a, b))
    norm = float(np.sqrt((x @ x) * (y @ y)))
    return float(x @ y) / norm if norm > 0 else 0.0


def save_view_strip(path: Path, rows: Sequence[tuple[str, NDArray[np.uint8], NDArray[np.uint8]]]) -> None:
    """Save rows of (label, rendered view, crop of the photo), side by side."""
    figure, axes = new_figure(len(rows), 2, (10.0, 2.95 * len(rows)))
    for (label, view, crop), (left, right) in zip(rows, axes, strict=True):
        for axis, picture, title in ((left, view, f"virtual space, {label}"), (right, crop, "photo")):
            axis.imshow(picture)
            axis.set_title(title, fontsize=9)
            axis.set_axis_off()
    save_figure(figure, path)


def save_depth(path: Path, panorama: NDArray[np.uint8], depth_m: NDArray[np.float32], title: str) -> None:
    """Save the panorama above its depth in colours with a scale in metres; unknown depth is grey."""
    import matplotlib

    figure, axes = new_figure(2, 1, (9.0, 9.4))
    axes[0, 0].imshow(panorama)
    axes[0, 0].set_axis_off()
    known = np.ma.masked_less_equal(depth_m, 0)
    colours = matplotlib.colormaps["turbo_r"].with_extremes(bad="0.6")
    top = float(np.percentile(known.compressed(), 99.5)) if known.count() else 1.0
    drawn = axes[1, 0].imshow(known, cmap=colours, vmin=0, vmax=top)
    axes[1, 0].set_axis_off()
    axes[1, 0].set_title(title, fontsize=9)
    figure.colorbar(drawn, ax=axes[1, 0], orientation="horizontal", label="m", fraction=0.05, pad=0.03)
    save_figure(figure, path)


def save_map(
    path: Path,
    grid: NDArray[np.int8],
    resolution_m: float,
    origin_xy: tuple[float, float],
    robot: tuple[float, float, float] | None = None,
    paths: dict[str, NDArray[np.float64]] | None = None,
) -> None:
    """Save an occupancy grid (−1 unknown, 0..100) with the robot's pose (x, y, yaw) and named paths (N, ≥2)."""
    figure, axes = new_figure(1, 1, (7.0, 7.0))
    axis = axes[0, 0]
    # Three tones by the sign of the evidence, shaded slightly by its strength: a standing robot provides weak evidence
    # everywhere, which a linear scale would show as grey on grey.
    shade = np.where(grid < 50, 1.0 - 0.15 * grid / 50.0, 0.35 * (100 - grid) / 50.0)
    shade = np.where(grid < 0, 0.7, shade)
    height, width = grid.shape
    x0, y0 = origin_xy
    extent = (x0, x0 + width * resolution_m, y0, y0 + height * resolution_m)
    axis.imshow(shade, cmap="gray", vmin=0, vmax=1, origin="lower", extent=extent, interpolation="nearest")
    for name, points in (paths or {}).items():
        axis.plot(points[:, 0], points[:, 1], linewidth=1.2, label=name)
    if robot is not None:
        x, y, yaw = robot
        axis.plot(x, y, "o", color="tab:red", markersize=5, label="r-bot")
        axis.arrow(x, y, 0.5 * np.cos(yaw), 0.5 * np.sin(yaw), color="tab:red", width=0.03)
    seen = np.argwhere(grid >= 0)
    if len(seen):
        (r0, c0), (r1, c1) = seen.min(axis=0), seen.max(axis=0)
        axis.set_xlim(x0 + (c0 - 10) * resolution_m, x0 + (c1 + 10) * resolution_m)
        axis.set_ylim(y0 + (r0 - 10) * resolution_m, y0 + (r1 + 10) * resolution_m)
    axis.set_xlabel("x, m")
    axis.set_ylabel("y, m")
    if robot is not None or paths:
        axis.legend(fontsize=8)
    save_figure(figure, path)


def new_figure(rows: int, columns: int, size: tuple[float, float]) -> tuple[Any, NDArray[Any]]:
    """A figure of ``size`` inches and its axes (rows, columns); needs no display."""
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    figure = Figure(figsize=size, dpi=110, layout="constrained")
    FigureCanvasAgg(figure)
    return figure, figure.subplots(rows, columns, squeeze=False)


def save_figure(figure: Any, path: Path) -> None:
    """Write a figure, creating its folder if needed."""
    path.parent.mkdir(parents=True, exist_ok=True)
    figure.savefig(path)
