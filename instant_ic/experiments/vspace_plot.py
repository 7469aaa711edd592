"""Plots and image strips of ``experiments.vspace``."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from instant_ic.experiments.pictures import new_figure, save_figure
from instant_ic.experiments.vspace import Report

_TILE = 320
"""Width of a strip's images, pixels."""
_LABELS = {"psnr_db": "PSNR, dB", "ssim": "SSIM"}


def save_plot(path: Path, report: Report) -> None:
    """Save PSNR and SSIM by distance, one row per path, and by training time if measured."""
    panels = [*report.settings.paths, *(["time"] if report.training else [])]
    drawn, axes = new_figure(len(panels), 2, (10.0, 3.4 * len(panels)))
    for panel, pair in zip(panels, axes, strict=True):
        for axis, (key, label) in zip(pair, _LABELS.items(), strict=True):
            if panel == "time":
                for source, distance in sorted({(row.source, row.distance_m) for row in report.training}):
                    rows = [row for row in report.training if (row.source, row.distance_m) == (source, distance)]
                    times, reached = [row.seconds for row in rows], [getattr(row, key) for row in rows]
                    axis.plot(times, reached, marker="o", markersize=3, label=f"{source}, {distance:g} m")
                axis.legend(fontsize=7)
                axis.set_xlabel("training, CPU s")
            else:
                for source, values in report.table(key).get(panel, {}).items():
                    width = 2.0 if source == "ours" else 1.1
                    axis.plot(list(values), list(values.values()), linewidth=width, label=source)
                axis.set_xlabel(f"{panel}: distance from the last panorama, m")
            axis.set_ylabel(label)
            axis.grid(alpha=0.3)
        if panel != "time":
            pair[0].legend(fontsize=7, ncols=2)
    drawn.suptitle(f"{Path(report.world).name}, {report.settings.keyframes} keyframe(s)", fontsize=10)
    save_figure(drawn, path)


def save_strip(path: Path, report: Report) -> None:
    """Save an image strip: one row per path and distance, ground truth first, then the sources.

    Raises:
        ValueError: there is no image, or the file cannot be written.
    """
    import cv2

    names = ["truth", *report.settings.sources]
    lines = []
    for route, strip in report.strips.items():
        for distance in sorted(strip):
            tiles = []
            for name in names:
                tile = cv2.resize(strip[distance][name], (_TILE, _tile_height(report)), interpolation=cv2.INTER_AREA)
                tile = cv2.copyMakeBorder(tile, 18, 2, 2, 2, cv2.BORDER_CONSTANT, value=(255, 255, 255))
                words = f"{name}, {route} {distance:g} m"
                cv2.putText(tile, words, (4, 13), cv2.FONT_HERSHEY_SIMPLEX, 0.4, (0, 0, 0), 1, cv2.LINE_AA)
                tiles.append(tile)
            lines.append(np.hstack(tiles))
    if not lines:
        raise ValueError("the paths end before the first image of the strip")
    if not cv2.imwrite(str(path), np.vstack(lines)[..., ::-1]):
        raise ValueError(f"{path}: cannot be written as an image")


def _tile_height(report: Report) -> int:
    width, height = report.settings.size
    return max(round(_TILE * height / width), 1)
