"""Plots and strips of pictures of ``evaluation.vspace``."""

from __future__ import annotations

from pathlib import Path

from .pictures import new_figure, save_figure
from .vspace import Report

_LABELS = {"psnr_db": "PSNR, dB", "ssim": "SSIM"}


def save_plot(path: Path, report: Report) -> None:
    """PSNR and SSIM against distance, a row a path, and against training time where it was measured."""
    panels = [*report.settings.paths, *(["time"] if report.training else [])]
    drawn, axes = new_figure(len(panels), 2, (10.0, 3.4 * len(panels)))
    for panel, pair in zip(panels, axes, strict=True):
        for axis, (key, label) in zip(pair, _LABELS.items(), strict=True):
            if panel == "time":
                for distance in sorted({row.distance_m for row in report.training}):
                    rows = [row for row in report.training if row.distance_m == distance]
                    times, reached = [row.seconds for row in rows], [getattr(row, key) for row in rows]
                    axis.plot(times, reached, marker="o", markersize=3, label=f"ours, {distance:g} m")
                axis.set_xlabel("training, CPU s")
            else:
                for source, values in report.table(key).get(panel, {}).items():
                    width = 2.0 if source == "ours" else 1.1
                    axis.plot(list(values), list(values.values()), linewidth=width, label=source)
                axis.set_xlabel(f"{panel}: distance from the last panorama, m")
            axis.set_ylabel(label)
            axis.grid(alpha=0.3)
        pair[0].legend(fontsize=7, ncols=2)
    drawn.suptitle(f"{Path(report.world).name}, {report.settings.keyframes} keyframe(s)", fontsize=10)
    save_figure(drawn, path)


def save_strip(path: Path, report: Report) -> None:
    """Pictures: a row each distance and path, the truth first, then the sources."""
    rows = [(name, distance) for name, strip in report.strips.items() for distance in sorted(strip)]
    if not rows:
        raise ValueError("the paths end before the first picture of the strip")
    names = ["truth", *report.settings.sources]
    width, height = report.settings.size
    drawn, axes = new_figure(len(rows), len(names), (2.1 * len(names), (2.1 * height / width + 0.25) * len(rows)))
    for (name, distance), line in zip(rows, axes, strict=True):
        for source, axis in zip(names, line, strict=True):
            axis.imshow(report.strips[name][distance][source])
            axis.set_title(f"{source}, {name} {distance:g} m", fontsize=7)
            axis.set_axis_off()
    save_figure(drawn, path)
