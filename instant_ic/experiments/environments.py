"""V.F, Fig. 11: many kinds of places, and what each loses by unseen surfaces, wrong depth and wrong poses."""

from __future__ import annotations

import statistics
from collections import Counter
from collections.abc import Sequence
from typing import Any

from instant_ic.experiments.compared import command_of, family, measure_views, near_mean, view_units
from instant_ic.experiments.lab import WORLD, Options, Result, Unit
from instant_ic.experiments.report import Answer, Figure, Part, Section, Table, Text
from instant_ic.experiments.worlds import KINDS
from instant_ic.vspace.config import ReadinessConfig

measure = measure_views
FIT_DB = ReadinessConfig().psnr_db
"""Least PSNR at which the stack regards a virtual space as fit to show; a place with less fails."""
LOSSES = ("depth", "unseen", "pose")
NAMES = {
    WORLD: "corridor with side rooms",
    "random": "random interior",
    "long": "corridor or hall of 20 to 40 m",
    **KINDS,
}
_HARD = ("hall", "windows", "crossing")
"""Places that do not always work in the paper."""
_LEAST_DB = 0.3
"""Smallest loss in dB that counts as a reason."""


def units(options: Options) -> list[Unit]:
    """Return units of all kinds of worlds and the meshes, or of a recording."""
    sources = (options.method, "fill", "true-depth", "exact-fill", "slam-pose", "panorama")
    worlds = (WORLD, "windows") if options.quick else (WORLD, "long", *KINDS)
    return view_units("environments", options, sources, (*worlds, *options.meshes), reach_m=2.0, step_m=0.5)


def losses(one: Result, method: str) -> dict[str, float | None]:
    """Return the losses of a place from 0.5 to 2 m in dB, by reason; None for a loss that cannot be measured.

    ``unseen``: gain if the truth replaces pixels that the keyframe has not seen. ``depth``: further gain by true depth.
    ``pose``: loss by SLAM's poses.
    """
    pairs = {"depth": ("exact-fill", "fill"), "unseen": ("fill", method), "pose": (method, "slam-pose")}
    found: dict[str, float | None] = {}
    for name, sources in pairs.items():
        better, worse = (near_mean([one], source) for source in sources)
        found[name] = None if better is None or worse is None else better - worse
    return found


def reason(lost: dict[str, float | None]) -> str:
    """Return the name of the largest loss, or ``resolution`` if none counts."""
    found = {name: value for name, value in lost.items() if value is not None and value >= _LEAST_DB}
    return max(found, key=lambda name: found[name]) if found else "resolution"


def section(results: Sequence[Result], options: Options) -> Section:
    """Return PSNR of each kind of place from 0.5 to 2 m, its losses, and where and why it fails; the worst first."""
    command = command_of(options, "environments")
    done = [one for one in results if one.data and near_mean([one], options.method) is not None]
    kinds, means = [], {}
    for name in dict.fromkeys(map(family, done)):
        own = [one for one in done if family(one) == name]
        means[name] = [near_mean([one], options.method) or 0.0 for one in own]
        kinds.append(_kind_row(name, own, means[name], options.method))
    kinds.sort(key=lambda line: statistics.fmean(line[1]))
    each = sorted((_place_row(one, options.method) for one in done), key=lambda line: float(line[1]))
    lost_columns = [f"{name}, dB" for name in LOSSES]
    kind_columns = ("place", "PSNR, dB", "SSIM", "fails", "main reason (seeds)", *lost_columns, "panorama, dB")
    place_columns = ("world", "PSNR, dB", *lost_columns, "depth error", "SLAM error, m", "main reason")
    parts: list[Part] = [
        Text(
            f"Mean PSNR from 0.5 to 2 m, straight and on a curve. A place fails below {FIT_DB:g} dB, the least at "
            "which the stack regards a virtual space as fit to show. unseen: gain if the truth replaces pixels that "
            "the keyframe has not seen. depth: further gain by true depth. pose: loss by the poses of the stack's SLAM "
            f"on slipping tracks. The reason is the largest loss, or resolution if none reaches {_LEAST_DB:g} dB: "
            "sharpness, and colours that depend on the direction of view."
        ),
        Table("Kinds of places, the worst first", kind_columns, kinds, command),
        Table("Each place, the worst first", place_columns, each, command),
    ]
    if options.bag is not None:
        parts.append(Text("A recording has no true depth and no true poses: unseen only."))
    for one in results:
        for path, address in one.data.get("images", {}).items():
            parts.append(Figure(f"Views, {one.unit.place}, {path}", address, command, wide=True))
    return Section("Environments (V.F, Fig. 11)", parts, _answers(means))


def _kind_row(name: str, own: Sequence[Result], shown: Sequence[float], method: str) -> list[Any]:
    lost = [losses(one, method) for one in own]
    failed = [reason(losts) for psnr, losts in zip(shown, lost, strict=True) if psnr < FIT_DB]
    reasons = Counter(failed or map(reason, lost))
    return [
        NAMES.get(name, name),
        shown,
        [near_mean([one], method, "ssim") for one in own],
        f"{len(failed)} of {len(own)}",
        ", ".join(f"{why} ({count})" for why, count in reasons.most_common()),
        *([losts[key] for losts in lost] for key in LOSSES),
        [near_mean([one], "panorama") for one in own],
    ]


def _place_row(one: Result, method: str) -> list[Any]:
    lost = losses(one, method)
    place = one.unit.arguments.get("number", one.unit.arguments.get("start_seed"))
    label = one.unit.place if ":" in one.unit.place else f"{one.unit.place}, {place}"
    slam = max(one.data.get("slam_error_m", {}).values(), default=None)
    depth = one.data["depth"].get("mean_relative_error")
    return [label, near_mean([one], method), *(lost[key] for key in LOSSES), depth, slam, reason(lost)]


def _answers(means: dict[str, list[float]]) -> dict[str, Answer]:
    """Answer the paper's claim: the corridor is shown well, and one of the hard kinds is worse."""
    hard = {name: statistics.fmean(means[name]) for name in _HARD if name in means}
    if WORLD not in means or not hard:
        return {}
    corridor: Any = statistics.fmean(means[WORLD])
    held = min(means[WORLD]) >= FIT_DB and min(hard.values()) < corridor
    others = ", ".join(f"{NAMES[name]} {value:.1f}" for name, value in hard.items())
    return {"places": Answer(held, f"corridor {corridor:.1f} dB; {others}", len(means[WORLD]))}
