"""Image strip and plots of ``experiments.illusion``."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

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
    """Save PSNR against distance for all sources, and the expected PSNR against the live one."""
    figure, axes = new_figure(1, 2, (12.0, 4.6))
    left, right = axes[0]
    each = report["each"]
    for source in SOURCES:
        label, colour = _COLUMNS[source], _COLOURS[source]
        known = [frame for frame in each if frame["distance_m"] is not None]
        left.plot(
            [frame["distance_m"] for frame in known],
            [frame["scores"][source]["psnr_db"] for frame in known],
            ".",
            color=colour,
            alpha=0.25,
            markersize=4,
        )
        rows = (report if source == LIVE else report[source])["by_distance"]
        left.plot([r["distance_m"] for r in rows], [r["psnr_mean_db"] for r in rows], color=colour, label=label)
    left.axvline(0.0, color="0.6", linewidth=0.8)
    left.set_xlabel("metres behind the obstacle's near face")
    left.set_ylabel("PSNR, dB")
    left.grid(alpha=0.3)
    left.legend(fontsize=8)
    alone = [frame for frame in each if frame["blend"] == 1] or each
    live = np.array([frame["scores"][LIVE]["psnr_db"] for frame in alone])
    expected = np.array([np.nan if f["expected_psnr_db"] is None else f["expected_psnr_db"] for f in alone])
    ends = _ends(live, expected)
    right.fill_between(ends, ends - 2, ends + 2, color="0.9", label="within 2 dB")
    right.plot(live, expected, ".", color="tab:red", alpha=0.5)
    right.set_xlabel("live PSNR, dB")
    right.set_ylabel("expected PSNR, dB")
    right.grid(alpha=0.3)
    right.legend(fontsize=8)
    name = Path(str(report["world"])).name
    figure.suptitle(f"{name}, {report['episodes']} episode(s), {report['frames']} frames", fontsize=10)
    save_figure(figure, path)


def _ends(*values: NDArray[np.float64]) -> NDArray[np.float64]:
    together = np.concatenate(values)
    return np.array([np.nanmin(together) - 1, np.nanmax(together) + 1])
