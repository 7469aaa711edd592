"""``ic study report``: scores and measures by condition, tests with effect sizes and intervals, plots."""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from instant_ic.experiments import report
from instant_ic.experiments.lab import machine
from instant_ic.experiments.plots import figure_svg, new_figure, series_colour
from instant_ic.experiments.report import Figure, Part, Section, Table, Text
from instant_ic.experiments.study import stats
from instant_ic.experiments.study.plan import CONDITIONS, Questionnaire, Study
from instant_ic.experiments.study.record import DONE, WITHDRAWN, Record
from instant_ic.util.private import make_folder

MEASURES = {
    "time_s": "time, s",
    "driven_m": "driven, m",
    "obedience": "obedience, share of the commanded time",
    "longest_stall_s": "longest stall under a command, s",
    "contacts": "contacts",
}
"""Measures of a drive's bag that are compared."""


def rows(study: Study, records: Sequence[Record]) -> list[dict[str, Any]]:
    """One row a finished drive: participant, drive, condition, measures, answers and scores."""
    found = []
    for record in records:
        for number, condition in enumerate(study.participants[record.code], 1):
            drive = record.steps.get(f"drive{number}")
            if drive is None:
                continue
            row: dict[str, Any] = {"participant": record.code, "drive": number, "condition": condition, **drive}
            for one in study.questionnaires:
                answers = record.steps.get(f"{one.id}.{number}", {}).get("answers")
                if one.when != "drive" or answers is None:
                    continue
                row |= {f"{one.id}.{key}": value for key, value in answers.items()}
                if one.score != "none":
                    row[one.id] = stats.score(one, answers)
                for item in one.items:
                    truth, given = row.get(item.truth), answers.get(item.id)
                    if item.truth and truth and given is not None:
                        row[f"{one.id}.{item.id}.error"] = abs(given - truth) / truth
            found.append(row)
    return found


def measured(study: Study) -> dict[str, str]:
    """Compared values and their labels: scores, single items of the scored scales, estimates, the drive."""
    found = {one.id: f"{one.title} ({one.id})" for one in study.questionnaires if one.score != "none"}
    for one in study.questionnaires:
        for item in one.items:
            if item.truth:
                found[f"{one.id}.{item.id}.error"] = f"error of the estimate {item.id}, share of the truth"
    return found | MEASURES


def values_of(drives: Sequence[dict[str, Any]], key: str, conditions: Sequence[str]) -> tuple[list[str], stats.Floats]:
    """Participants with a value in every condition, and the values (n, k); several drives of one are averaged."""
    table: dict[str, dict[str, list[float]]] = {}
    for row in drives:
        if isinstance(value := row.get(key), int | float):
            table.setdefault(row["participant"], {}).setdefault(row["condition"], []).append(float(value))
    whole = sorted(code for code, by in table.items() if all(name in by for name in conditions))
    values = [[float(np.mean(table[code][name])) for name in conditions] for code in whole]
    return whole, np.array(values, np.float64).reshape(len(whole), len(conditions))


def build(study: Study, out: Path, command: str) -> dict[str, Any]:
    """Write ``report.html`` and ``report.json``; return what the JSON has of the participants."""
    records = [Record(study, code) for code in study.participants]
    finished = [one for one in records if one.state == DONE]
    done = [one for one in finished if not one.simulated] or finished
    drives = rows(study, done)
    order = [name for name in CONDITIONS if any(name in one for one in study.participants.values())]
    counts = {
        "planned": len(records),
        "finished": len(finished),
        "withdrawn, data kept": sum(one.state == WITHDRAWN for one in records),
        "under way": sum(bool(one.steps) and one.state not in (DONE, WITHDRAWN) for one in records),
        "simulated": sum(one.simulated for one in finished),
    }
    sections = {
        "participants": Section("Participants", _people(study, done, drives, counts, order)),
        "measures": Section("Scores and measures", _measures(study, drives, order)),
        "pairs": Section("Pairs of conditions", _pairs(study, drives, order)),
        "choices": Section("Questions after all drives (V.E)", _choices(study, done, order)),
    }
    make_folder(out, exist_ok=True)
    conditions = {"study": study.folder.name, "command": command, **machine()}
    extra = {"participants": counts, "drives": drives}
    report.write(out, sections, [], conditions, "Instant IC: user study", extra)
    for name in ("report.html", "report.json"):  # they hold the answers of each participant
        (out / name).chmod(0o600)
    return counts


def _people(
    study: Study, done: Sequence[Record], drives: Sequence[dict[str, Any]], counts: dict[str, int], order: Sequence[str]
) -> list[Part]:
    parts: list[Part] = [Text("; ".join(f"{name}: {count}" for name, count in counts.items()) + ".")]
    if counts["simulated"]:
        what = (
            "They are left out of all figures"
            if counts["simulated"] < counts["finished"]
            else ("Nothing can be concluded from them about people")
        )
        parts.append(
            Text(f"{counts['simulated']} of {counts['finished']} participants are programs that answer at random. "
                 f"{what}.")
        )  # fmt: skip
    comparisons = max(math.comb(len(order), 2), 1)
    least = stats.least_participants(comparisons)
    if len(done) < least:
        parts.append(
            Text(f"Too few participants: with {len(done)}, no pair of conditions can differ significantly. At least "
                 f"{least} are needed for that after Holm's correction (pairs: {comparisons}), even if all agree. "
                 "The figures below describe these participants and no others.")
        )  # fmt: skip
    places = Counter((row["condition"], row["drive"]) for row in drives)
    numbers = range(1, len(study.worlds) + 1)
    uneven = len({places[name, n] for name in order for n in numbers}) > 1
    if uneven:
        parts.append(
            Text("The order is not balanced yet: practice and fatigue can look like an effect of a condition.")
        )
    table = [[name, *(places[name, n] for n in numbers)] for name in order]
    parts.append(Table("Participants by condition and place in the order", ("condition", *map(str, numbers)), table))
    ends = Counter((row["condition"], row["end"]) for row in drives)
    reasons = sorted({reason for _, reason in ends})
    parts.append(
        Table(
            "How the drives ended",
            ("condition", *reasons),
            [[name, *(ends[name, r] for r in reasons)] for name in order],
        )
    )
    if ends.total() > sum(ends[name, "arrived"] for name in order):
        parts.append(
            Text("Time and distance are of all drives. A drive that was ended before the goal is short in both: "
                 "compare them only where the conditions ended alike.")
        )  # fmt: skip
    parts += [part for one in study.questionnaires if one.when == "before" for part in _counts(one, done)]
    slow = sum(row["slowest_pace"] is not None and row["slowest_pace"] < 0.95 for row in drives)
    if slow:
        parts.append(Text(f"{slow} of {len(drives)} drives ran in slow motion: the machine was too slow or busy."))
    return parts


def _counts(found: Questionnaire, done: Sequence[Record]) -> list[Table]:
    """How many gave which answer, without codes; free text is left out: it can name a person."""
    answers = [record.steps.get(found.id, {}).get("answers", {}) for record in done]
    tables = []
    for item in (one for one in found.items if one.kind != "text"):
        given = Counter(one.get(item.id) for one in answers)
        values = dict.fromkeys([*item.options, *sorted({*given} - {None}, key=str), *([None] if None in given else [])])
        lines = [["no answer" if value is None else value, given[value]] for value in values]
        tables.append(Table(item.text, ("answer", "participants"), lines))
    return tables


def _measures(study: Study, drives: Sequence[dict[str, Any]], order: Sequence[str]) -> list[Part]:
    lines: list[list[Any]] = []
    tests: list[list[Any]] = []
    plots: list[str] = []
    for key, label in measured(study).items():
        _, values = values_of(drives, key, order)
        if not len(values):
            continue
        cells = []
        for column in values.T:
            mean, low, high = stats.mean_interval(column)
            cells.append(f"{mean:.2f} [{low:.2f}, {high:.2f}]" if math.isfinite(low) else f"{mean:.2f}")
        lines.append([label, str(len(values)), *cells])
        test = stats.friedman(values, study.seed)
        if test is not None:
            tests.append(
                [label, str(test.n), f"{test.chi2:.2f}", str(test.df), _p(test.p), _p(test.p_exact),
                 f"{test.w:.2f} [{test.w_low:.2f}, {test.w_high:.2f}]"]
            )  # fmt: skip
        if np.ptp(values):
            plots.append(_plot(label, order, values))
    columns = ("Friedman", "n", "χ²", "df", "p", "p by permutation", "Kendall's W [95 %]")
    return [
        Table("Mean [95 % interval]; participants with all conditions", ("value", "n", *order), lines),
        *([Table("Differences between the conditions", columns, tests)] if tests else []),
        Figure("Each line is a participant; the mean has its 95 % interval", "".join(plots)),
    ]


def _pairs(study: Study, drives: Sequence[dict[str, Any]], order: Sequence[str]) -> list[Part]:
    parts: list[Part] = [
        Text("Wilcoxon's signed-rank test; p corrected by Holm over the pairs of one value. The effect size r is the "
             "matched-pairs rank-biserial correlation: 1 if the first is larger for every participant, -1 if smaller.")
    ]  # fmt: skip
    for key, label in measured(study).items():
        _, values = values_of(drives, key, order)
        found = stats.pairs(dict(zip(order, values.T, strict=True)), study.seed)
        lines = [
            [f"{one.first} - {one.second}", str(one.n), f"{one.shift:.2f} [{one.low:.2f}, {one.high:.2f}]",
             f"{one.r:.2f}", _p(one.p), _p(one.p_holm)]
            for one in found
        ]  # fmt: skip
        if lines:
            parts.append(Table(label, ("pair", "n", "difference [95 %]", "r", "p", "p (Holm)"), lines))
    return parts if len(parts) > 1 else [Text("No participant has finished every condition, or only one.")]


def _choices(study: Study, done: Sequence[Record], order: Sequence[str]) -> list[Part]:
    parts: list[Part] = []
    for one in (q for q in study.questionnaires if q.when == "after"):
        answers = [(record, record.steps[one.id]["answers"]) for record in done if one.id in record.steps]
        for item in one.items:
            given = [(record.code, a[item.id]) for record, a in answers if a.get(item.id) is not None]
            if item.kind == "drive" and given:
                votes = Counter(
                    study.participants[code][int(drive) - 1] if drive else "no difference" for code, drive in given
                )
                lines = []
                for name in (*order, "no difference"):
                    low, high = stats.share_interval(votes[name], len(given))
                    lines.append([name, str(votes[name]), f"{votes[name] / len(given):.2f} [{low:.2f}, {high:.2f}]"])
                parts.append(Table(item.text, ("condition", "votes", "share [95 %]"), lines))
            elif item.kind == "text" and given:
                parts.append(Table(item.text, ("participant", "answer"), [[code, text] for code, text in given]))
    return parts or [Text("No answers yet.")]


def _plot(label: str, order: Sequence[str], values: stats.Floats) -> str:
    figure, axes = new_figure(1, 1, (4.2, 3.2))
    axis, at = axes[0, 0], np.arange(len(order))
    for row in values:
        axis.plot(at, row, color="#8A8A8A", alpha=0.5, linewidth=0.8, marker=".", markersize=4)
    for place, column in enumerate(values.T):
        mean, low, high = stats.mean_interval(column)
        error = [[mean - low], [high - mean]] if math.isfinite(low) else None
        axis.errorbar(place, mean, error, color=series_colour(place), marker="o", markersize=7, capsize=5, linewidth=2)
    axis.set_xticks(at, order)
    axis.set_xlim(-0.4, len(order) - 0.6)
    axis.set_ylabel(label, fontsize=8)
    return figure_svg(figure, axis)


def _p(value: float) -> str:
    return "< 0.001" if value < 0.001 else f"{value:.3f}"
