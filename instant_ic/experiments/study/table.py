"""The table of a study: drives and votes by condition, without tests of significance."""

from __future__ import annotations

import statistics
from collections import Counter
from collections.abc import Sequence
from typing import Any

from instant_ic.experiments.study.plan import CONDITIONS, QUESTIONS, Participant

MEASURES = ("contacts", "obedience", "time_s", "driven_m")


def rows(participants: Sequence[Participant]) -> list[dict[str, Any]]:
    """Return one row a condition: drives, arrivals, mean of each measure, and votes by question.

    Only participants who have answered the questions count. The last row has the votes for no difference.
    """
    done = [one for one in participants if one.answers]
    drives = [(name, drive) for one in done for name, drive in zip(one.order, one.drives, strict=True)]
    votes = {
        question: Counter(
            one.order[one.answers[question] - 1] if one.answers[question] else "no difference" for one in done
        )
        for question in QUESTIONS
    }
    found: list[dict[str, Any]] = []
    for condition in (*CONDITIONS, "no difference"):
        own = [drive for name, drive in drives if name == condition]
        row: dict[str, Any] = {"condition": condition, "drives": len(own)}
        row["arrived"] = sum(drive["end"] == "arrived" for drive in own)
        for measure in MEASURES:
            known = [drive[measure] for drive in own if drive.get(measure) is not None]
            row[measure] = round(statistics.fmean(known), 3) if known else None
        found.append(row | {question: count[condition] for question, count in votes.items()})
    return found
