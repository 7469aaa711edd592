"""Image strip and plots of ``experiments.illusion``."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import cv2

from instant_ic.experiments.illusion import Film
from instant_ic.experiments.illusion_stack import LIVE, SOURCES, TRUE_DEPTH, TRUE_FILL
from instant_ic.experiments.plots import image_strip, new_figure, save_figure

_TILE = 400
_COLUMNS = {LIVE: "shown", "truth": "true", TRUE_DEPTH: "with true depth", TRUE_FILL: "with true depth and fill"}
_COLOURS = {LIVE: "tab:red", TRUE_DEPTH: "tab:blue", TRUE_FILL: "tab:green"}


def save_strip(path: Path, films: Sequence[Film]) -> None:
    """Save rows of frames by distance behind the obstacle's near face, of the episode that has most of them.

    Raises:
        ValueError: no frame has a distance: no obstacle was passed.
    """
    film = max(films, key=lambda film: len(film.stills))
    if not film.stills:
        raise ValueError(f"{path}: there is no strip because no obstacle was passed")
    rows = [(f"{at:+.1f} m", [film.stills[at][name] for name in _COLUMNS]) for at in sorted(film.stills)]
    strip = image_strip(list(_COLUMNS.values()), rows, _TILE)
    if not cv2.imwrite(str(path), strip[..., ::-1]):
        raise ValueError(f"{path}: the strip cannot be written")


def save_plot(path: Path, report: dict[str, Any]) -> None:
    """Save PSNR against distance for all sources: each frame, and the means."""
    figure, axes = new_figure(1, 1, (7.0, 4.6))
    axis = axes[0, 0]
    known = [frame for frame in report["each"] if frame["distance_m"] is not None]
    for source in SOURCES:
        colour = _COLOURS[source]
        psnr_db = [frame["scores"][source]["psnr_db"] for frame in known]
        axis.plot([frame["distance_m"] for frame in known], psnr_db, ".", color=colour, alpha=0.25, markersize=4)
        rows = (report if source == LIVE else report[source])["by_distance"]
        means_db = [row["psnr_mean_db"] for row in rows]
        axis.plot([row["distance_m"] for row in rows], means_db, color=colour, label=_COLUMNS[source])
    axis.axvline(0.0, color="0.6", linewidth=0.8)
    axis.set(xlabel="metres behind the obstacle's near face", ylabel="PSNR, dB")
    axis.grid(alpha=0.3)
    axis.legend(fontsize=8)
    name = Path(str(report["world"])).name
    figure.suptitle(f"{name}, {report['episodes']} episode(s), {report['frames']} frames", fontsize=10)
    save_figure(figure, path)
