"""Reasons with their text for the operator."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import NamedTuple

from instant_ic.control.states import Reason, Source


class Notice(NamedTuple):
    """A reason and its text for the operator: what has happened, then what to do, in whole sentences."""

    reason: Reason
    text: str


class Stale(NamedTuple):
    """A source that is older than its time-out."""

    source: Source
    age_s: float


def stale_notice(stale: Sequence[Stale]) -> Notice:
    """Return a notice for stale sources, at least one: the code of the first, the text of all."""
    texts = [
        source.text or (f"No {source.name} yet." if math.isinf(age_s) else f"No {source.name} for {age_s:.1f} s.")
        for source, age_s in stale
    ]
    return Notice(stale[0].source.reason, " ".join([*texts, "The robot has stopped."]))
