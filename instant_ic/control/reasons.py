"""Reasons with their text for the operator."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import NamedTuple

from instant_ic.control.states import Reason, Source


class Notice(NamedTuple):
    """A reason and its text for the operator, with the numbers of the moment."""

    reason: Reason
    text: str

    def prefixed(self, prefix: str) -> Notice:
        """Return the same reason with text before it."""
        return Notice(self.reason, prefix + self.text)


class Stale(NamedTuple):
    """A source that is older than its time-out."""

    source: Source
    age_s: float


def stale_notice(stale: Sequence[Stale]) -> Notice:
    """Return a notice for stale sources, at least one: the code of the first, the text of all."""
    texts = [
        source.text or (f"no {source.name} yet" if math.isinf(age_s) else f"no {source.name} for {age_s:.1f} s")
        for source, age_s in stale
    ]
    return Notice(stale[0].source.reason, ", ".join(texts))
