"""V.F, Fig. 11: many kinds of places, and what each loses to depth, unseen places, the pose and people who move."""

from __future__ import annotations

import statistics
from collections import Counter
from collections.abc import Sequence
from typing import Any

from instant_ic.experiments.compared import command_of, family, measure_views, near_mean, view_units
from instant_ic.experiments.lab import WORLD, Options, Result, Unit
from instant_ic.experiments.places import KINDS
from instant_ic.experiments.report import Answer, Figure, Part, Section, Table, Text
from instant_ic.vspace.config import ReadinessConfig

measure = measure_views
FIT_DB = ReadinessConfig().psnr_db
"""A view below this fails: the stack regards a virtual space as fit to show from here on."""
LOSSES = ("depth", "unseen", "pose", "motion")
NAMES = {
    WORLD: "corridor with side rooms",
    "random": "random interior",
    "long": "corridor or hall of 20 to 40 m",
    **KINDS,
}
_HARD = ("hall", "windows", "crossing")
"""The paper: these do not always work."""
_LEAST_DB = 0.3
"""A loss below this is no reason."""


def units(options: Options) -> list[Unit]:
    """All kinds of worlds, and the meshes; a recording instead."""
    sources = (options.method, "fill", "true-depth", "exact-fill", "slam-pose", "still", "panorama")
    worlds = (WORLD, "windows", "people") if options.quick else (WORLD, "long", *KINDS)
    return view_units("environments", options, sources, (*worlds, *options.meshes), reach_m=2.0, step_m=0.5)


def losses(one: Result, method: str) -> dict[str, float | None]:
    """What a place loses from 0.5 to 2 m, dB, by reason; None where it cannot be known.

    ``unseen``: what the truth gains where no keyframe has seen the place. ``depth``: what true depth gains beyond that.
    ``pose``: what the poses of SLAM lose. ``motion``: what a world gains in which nobody has moved.
    """
    mean = {
        name: near_mean([one], source)
        for name, source in (
            ("shown", method), ("fill", "fill"), ("exact", "exact-fill"), ("slam", "slam-pose"), ("still", "still"),
        )
    }  # fmt: skip

    def gain(better: str, worse: str) -> float | None:
        a, b = mean[better], mean[worse]
        return None if a is None or b is None else a - b

    return {
        "depth": gain("exact", "fill"),
        "unseen": gain("fill", "shown"),
        "pose": gain("shown", "slam"),
        "motion": gain("still", "shown"),
    }


def reason(lost: dict[str, float | None]) -> str:
    """The largest loss by its name; ``resolution`` where none counts."""
    found = {name: value for name, value in lost.items() if value is not None and value >= _LEAST_DB}
    return max(found, key=lambda name: found[name]) if found else "resolution"


def section(results: Sequence[Result], options: Options) -> Section:
    """PSNR of each kind of place from 0.5 to 2 m, its losses, where it fails and why, the worst kind first."""
    command = command_of(options, "environments")
    done = [one for one in results if one.data and near_mean([one], options.method) is not None]
    each: list[list[Any]] = []
    kinds: list[list[Any]] = []
    means: dict[str, list[float]] = {}
    for name in dict.fromkeys(map(family, done)):
        own = [one for one in done if family(one) == name]
        lost = [losses(one, options.method) for one in own]
        shown = [near_mean([one], options.method) or 0.0 for one in own]
        means[name] = shown
        failed = [reason(losts) for psnr, losts in zip(shown, lost, strict=True) if psnr < FIT_DB]
        reasons = Counter(failed or [reason(losts) for losts in lost])
        kinds.append(
            [
                NAMES.get(name, name),
                shown,
                [near_mean([one], options.method, "ssim") for one in own],
                f"{len(failed)} of {len(own)}",
                ", ".join(f"{why} ({count})" for why, count in reasons.most_common()),
                *([losts[key] for losts in lost] for key in LOSSES),
                [near_mean([one], "panorama") for one in own],
            ]
        )
        for one, psnr, losts in zip(own, shown, lost, strict=True):
            depth = [known["mean_relative_error"] for known in one.data["depth"].values()]
            slam = max(one.data.get("slam_error_m", {}).values(), default=None)
            place = one.unit.arguments.get("number", one.unit.arguments.get("start_seed"))
            label = one.unit.place if ":" in one.unit.place else f"{one.unit.place}, {place}"
            each.append(
                [label, psnr, *(losts[key] for key in LOSSES), depth[0] if depth else None, slam, reason(losts)]
            )
    kinds.sort(key=lambda line: statistics.fmean(line[1]))
    each.sort(key=lambda line: float(line[1]))
    lost_columns = [f"{name}, dB" for name in LOSSES]
    parts: list[Part] = [
        Text(
            f"Mean PSNR from 0.5 to 2 m, straight and on a curve. A place fails below {FIT_DB:g} dB, the value from "
            "which the stack regards a virtual space as fit to show. unseen: what the truth would gain where no "
            "keyframe has seen the place. depth: what true depth would gain beyond that. pose: what the poses of SLAM "
            "lose against true ones (the stack's SLAM with either method; the paper used GMapping; slipping tracks). "
            "motion: what a world would gain in which nobody walks on after the panorama; the robot drives "
            f"at 0.4 m/s. The reason is the largest loss; resolution where none reaches {_LEAST_DB:g} dB: what remains "
            "is sharpness and looks that depend on the direction of view."
        ),
        Table(
            "Kinds of places, the worst first",
            ("place", "PSNR, dB", "SSIM", "fails", "main reason (seeds)", *lost_columns, "panorama, dB"),
            kinds,
            command,
        ),
        Table(
            "Each place, the worst first",
            ("world", "PSNR, dB", *lost_columns, "depth error", "SLAM error, m", "main reason"),
            each,
            command,
        ),
    ]
    if options.bag is not None:
        parts.append(Text("A recording has no true depth, no true poses and no world without its people: unseen only."))
    for one in results:
        for path, address in one.data.get("images", {}).items():
            parts.append(Figure(f"Views, {one.unit.place}, {path}", address, command, wide=True))
    verdict: dict[str, bool | None] = {
        f"{NAMES.get(name, name)}: at least {FIT_DB:g} dB with each seed": min(shown) >= FIT_DB
        for name, shown in means.items()
    }
    return Section("Environments (V.F, Fig. 11)", parts, verdict, _answers(means))


def _answers(means: dict[str, list[float]]) -> dict[str, Answer]:
    """The paper's claim: the corridor is shown well, and one of the hard kinds is worse."""
    hard = {name: statistics.fmean(means[name]) for name in _HARD if name in means}
    if WORLD not in means or not hard:
        return {}
    corridor: Any = statistics.fmean(means[WORLD])
    held = min(means[WORLD]) >= FIT_DB and min(hard.values()) < corridor
    others = ", ".join(f"{NAMES[name]} {value:.1f}" for name, value in hard.items())
    return {"places": Answer(held, f"corridor {corridor:.1f} dB; {others}", len(means[WORLD]))}
