"""V.C, Figs. 6 and 8: contributions of depth, scaling and fill, beside the paper's own choices."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from instant_ic.experiments.compared import (
    command_of,
    curves_and_tables,
    family,
    measure_views,
    near_mean,
    of_the_paper,
    series,
    view_units,
)
from instant_ic.experiments.lab import WORLD, Options, Result, Unit
from instant_ic.experiments.report import Answer, Part, Section, Table, Text
from instant_ic.experiments.vspace_sources import SOURCES

measure = measure_views
_OURS = ("ours", "no-scale", "no-depth", "depth-warp", "panorama", "true-depth", "exact-fill", "slam-pose")
_PAPER = ("paper", "paper-no-scale", "no-depth", "ours", "depth-warp", "panorama", "true-depth", "slam-pose")


def units(options: Options) -> list[Unit]:
    """Return units along a straight path, as in the paper."""
    sources = _PAPER if options.method == "paper" else (*_OURS, "paper", "paper-no-scale")
    return view_units("ablation", options, sources, (WORLD,) if options.quick else (WORLD, "random"), ("straight",))


def section(results: Sequence[Result], options: Options) -> Section:
    """Return curves, tables, and each source's mean over all distances."""
    command = command_of(options, "ablation")
    parts: list[Part] = [
        Table("Sources", ("source", "what it is"), [[name, SOURCES[name]] for name in (*_OURS, *_PAPER[:2])]),
        Text(
            "no-depth is the paper's Ours (-depth), paper-no-scale its Ours (-scale), paper its Ours. All sources but "
            "slam-pose are seen from true poses. The poses of slam-pose come from the stack's SLAM on slipping "
            "tracks, with --method paper too; the paper used GMapping."
        ),
    ]
    for name in dict.fromkeys(family(one) for one in results if one.data):
        means = {key: _means(results, name, key) for key in ("psnr_db", "ssim")}
        lines = [[source, means["psnr_db"][source], means["ssim"][source]] for source in means["psnr_db"]]
        title = f"{name}: mean over all distances above 0"
        parts.append(Table(title, ("source", "PSNR, dB", "SSIM"), lines, command))
    paper, scaled = of_the_paper(results), "no-scale" if options.method == "ours" else "paper-no-scale"
    answers = {
        "depth": _answer(paper, options.method, "no-depth"),
        "scaling": _answer(paper, options.method, scaled),
    }
    if scaled == "no-scale" and answers["scaling"].held is not None:
        own = _answer(paper, "paper", "paper-no-scale")
        answers["scaling"] = replace(answers["scaling"], figures=f"{answers['scaling'].figures}; {own.figures}")
    parts += curves_and_tables(results, command)
    return Section("Ablation study (V.C, Figs. 6, 8)", parts, answers)


def _answer(results: Sequence[Result], better: str, worse: str) -> Answer:
    """Answer whether a source is better than another in mean PSNR and SSIM from 0.5 to 2 m."""
    pairs = [(near_mean(results, better, key), near_mean(results, worse, key)) for key in ("psnr_db", "ssim")]
    gains = [ours - theirs for ours, theirs in pairs if ours is not None and theirs is not None]
    if len(gains) < 2:
        return Answer(None, "")
    return Answer(min(gains) > 0, f"{better} against {worse}: {gains[0]:+.1f} dB, {gains[1]:+.3f} SSIM", len(results))


def _means(results: Sequence[Result], name: str, key: str) -> dict[str, list[float]]:
    """Return the means of each source over the distances above 0; one mean per seed."""
    found: dict[str, list[float]] = {}
    for one in results:
        path = "recorded" if "bag" in one.unit.arguments else "straight"
        for source, values in series([one], name, path, key).items():
            away = [float(np.mean(value)) for at, value in values.items() if at > 0]
            if away:
                found.setdefault(source, []).append(float(np.mean(away)))
    return found
