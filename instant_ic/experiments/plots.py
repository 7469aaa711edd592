"""Figures and images of reports, with matplotlib and OpenCV."""

from __future__ import annotations

import io
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any, TypeAlias

import cv2
import numpy as np
from numpy.typing import NDArray

from instant_ic.depth.colour import coloured_depth
from instant_ic.geometry.projections import perspective_directions, sample_equirect
from instant_ic.slam.occupancy import OccupancyGrid

if TYPE_CHECKING:
    from instant_ic.experiments.depth import Scored

Image: TypeAlias = NDArray[np.uint8]


def perspective_crop(
    panorama: NDArray[np.uint8], camera_from_view: NDArray[np.float64], width: int, height: int, hfov_rad: float
) -> NDArray[np.uint8]:
    """Crop a pinhole view from the centre of a panorama (H, W, 3).

    ``camera_from_view`` is the rotation (3, 3) of the view, which looks along its own x.
    """
    directions = perspective_directions(width, height, hfov_rad) @ camera_from_view.T.astype(np.float32)
    return np.clip(np.rint(sample_equirect(panorama, directions)), 0, 255).astype(np.uint8)


def save_depth_sheet(path: Path, rows: Sequence[Scored]) -> None:
    """Save a row for each panorama: image and depth, with true depth and relative error if there is ground truth."""
    columns = 4 if any(row.truth_m is not None for row in rows) else 2
    figure, axes = new_figure(len(rows), columns, (4.5 * columns, 2.6 * len(rows)))
    for row, line in zip(rows, axes, strict=True):
        reference = row.depth_m if row.truth_m is None else row.truth_m
        known = reference[reference > 0]
        near, far = np.percentile(known, (1, 99)) if len(known) else (1.0, 2.0)
        line[0].imshow(row.rgb)
        line[0].set_title(row.name, fontsize=9)
        line[1].imshow(coloured_depth(row.depth_m, near, far))
        line[1].set_title(f"depth, {near:.1f} (red) to {far:.1f} m", fontsize=9)
        if row.truth_m is not None and row.after is not None:
            line[2].imshow(coloured_depth(row.truth_m, near, far))
            line[2].set_title("truth", fontsize=9)
            size = row.depth_m.shape[1], row.depth_m.shape[0]
            truth = cv2.resize(row.truth_m, size, interpolation=cv2.INTER_NEAREST)
            with np.errstate(divide="ignore", invalid="ignore"):
                error = np.where((truth > 0) & (row.depth_m > 0), row.depth_m / truth - 1, np.nan)
            line[3].imshow(error, cmap="RdBu", vmin=-0.5, vmax=0.5)
            line[3].set_title(f"error, -50 % (red) to 50 %: MRE {row.after.mre:.3f}", fontsize=9)
        for axis in line:
            axis.set_axis_off()
    save_figure(figure, path)


def save_map(
    path: Path | io.BytesIO,
    grid: OccupancyGrid,
    robot: tuple[float, float, float] | None = None,
    paths: dict[str, NDArray[np.float64]] | None = None,
) -> None:
    """Save a map with the robot's pose (x, y, yaw) and named paths (N, ≥2)."""
    figure, axes = new_figure(1, 1, (7.0, 7.0))
    axis = axes[0, 0]
    # Three tones show the sign of the evidence, slightly shaded by its strength. A standing robot provides only weak
    # evidence, which a linear scale would show as grey on grey.
    values, resolution_m = grid.values, grid.resolution
    shade = np.where(values < 50, 1.0 - 0.15 * values / 50.0, 0.35 * (100 - values) / 50.0)
    shade = np.where(values < 0, 0.7, shade)
    height, width = values.shape
    x0, y0 = grid.origin
    extent = (x0, x0 + width * resolution_m, y0, y0 + height * resolution_m)
    axis.imshow(shade, cmap="gray", vmin=0, vmax=1, origin="lower", extent=extent, interpolation="nearest")
    for name, points in (paths or {}).items():
        axis.plot(points[:, 0], points[:, 1], linewidth=1.2, label=name)
    if robot is not None:
        x, y, yaw = robot
        axis.plot(x, y, "o", color="tab:red", markersize=5, label="r-bot")
        axis.arrow(x, y, 0.5 * np.cos(yaw), 0.5 * np.sin(yaw), color="tab:red", width=0.03)
    seen = np.argwhere(values >= 0)
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
    """Create a figure of ``size`` inches and its axes (rows, columns); no display is needed."""
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    figure = Figure(figsize=size, dpi=110, layout="constrained")
    FigureCanvasAgg(figure)
    return figure, figure.subplots(rows, columns, squeeze=False)


def save_figure(figure: Any, path: Path | io.BytesIO) -> None:
    """Write a figure as PNG, creating its folder if needed."""
    if isinstance(path, Path):
        path.parent.mkdir(parents=True, exist_ok=True)
    figure.savefig(path)


Series: TypeAlias = dict[str, dict[float, list[float]]]
"""Name → x → values, of which mean and standard deviation are plotted."""
_INK = "#010203"
"""Replaced by the page's text colour."""


def curves_svg(panels: Sequence[tuple[str, str, Series]]) -> str:
    """Plot lines as SVG text, one plot for each panel, that follow the page's light or dark colours.

    Args:
        panels: label of x, label of y, and the curves; the same name has the same colour in all panels.
    """
    names = list(dict.fromkeys(name for _, _, series in panels for name in series))
    colours = {name: f"C{number % 10}" for number, name in enumerate(names)}
    return "".join(_curves_svg(*panel, colours) for panel in panels)


def _curves_svg(x_label: str, y_label: str, series: Series, colours: dict[str, str]) -> str:
    figure, axes = new_figure(1, 1, (4.8, 3.7))
    axis = axes[0, 0]
    for name, points in series.items():
        at = sorted(points)
        mean, wide = (np.array([of(points[x]) for x in at]) for of in (np.mean, np.std))
        axis.plot(at, mean, color=colours[name], linewidth=1.6, marker="o", markersize=2.5, label=name)
        axis.fill_between(at, mean - wide, mean + wide, color=colours[name], alpha=0.15, linewidth=0)
    axis.set_xlabel(x_label, color=_INK)
    axis.set_ylabel(y_label)
    figure.legend(loc="outside lower center", ncols=4, fontsize=7, frameon=False, labelcolor=_INK)
    return figure_svg(figure, axis)


def figure_svg(figure: Any, axis: Any) -> str:
    """Write a figure with one pair of axes as SVG text that follows the page's light or dark colours."""
    import matplotlib

    axis.yaxis.label.set_color(_INK)
    axis.tick_params(colors=_INK)
    axis.grid(alpha=0.25)
    for spine in axis.spines.values():
        spine.set_color(_INK)
    out = io.StringIO()
    with matplotlib.rc_context({"svg.fonttype": "none", "svg.hashsalt": "instant-ic"}):
        figure.savefig(out, format="svg", transparent=True, metadata={"Date": None})
    text = out.getvalue()
    return text[text.index("<svg") :].replace(_INK, "currentColor")


def image_strip(columns: Sequence[str], rows: Sequence[tuple[str, Sequence[NDArray[np.uint8]]]], tile: int) -> Image:
    """Join images to one RGB image, with the columns' names above and a label beside each row.

    ``tile`` is the width of an image in pixels.
    """
    label_px, head_px = 64, 24
    height, width = rows[0][1][0].shape[:2]
    size = (tile, max(round(tile * height / width), 1))

    def write(image: Image, text: str, at: tuple[int, int]) -> None:
        cv2.putText(image, text, at, cv2.FONT_HERSHEY_SIMPLEX, 0.45, (0, 0, 0), 1, cv2.LINE_AA)

    head = np.full((head_px, label_px + len(columns) * tile, 3), 255, np.uint8)
    for number, title in enumerate(columns):
        write(head, title, (label_px + number * tile + 8, 17))
    lines = [head]
    for text, images in rows:
        label = np.full((size[1], label_px, 3), 255, np.uint8)
        write(label, text, (4, size[1] // 2))
        lines.append(np.hstack([label, *(cv2.resize(one, size, interpolation=cv2.INTER_AREA) for one in images)]))
    return np.vstack(lines)


def jpeg(image: NDArray[np.uint8], quality: int = 88) -> bytes:
    """Encode an RGB image."""
    return bytes(cv2.imencode(".jpg", image[..., ::-1], [cv2.IMWRITE_JPEG_QUALITY, quality])[1])
