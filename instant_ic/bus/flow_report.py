"""Diagnoses of a node's topics: messages that were lost, refused, overwritten or sent without shared memory.

The counts of a topic only grow. A recent rise is a warning, except during start-up.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from typing import Any
from weakref import WeakKeyDictionary

from instant_ic.bus.transport import PublisherStats, Stats
from instant_ic.util.diagnosis import Diagnosis, Level, RecentCount

RECENT_S = 10.0
START_UP_S = 15.0
"""Time after a node's start during which losses are not reported, because nodes load networks and compile kernels."""


class FlowReport:
    """Judges the counts of a node's topics; the caller supplies the steady time.

    Args:
        started_ns: steady time of the node's start.
    """

    def __init__(self, started_ns: int) -> None:
        self._warns_from_ns = started_ns + int(START_UP_S * 1e9)
        self._recent: WeakKeyDictionary[Stats, dict[str, RecentCount]] = WeakKeyDictionary()

    def input(self, topic: str, stats: Stats, values: Mapping[str, Any], now_ns: int) -> Iterator[Diagnosis]:
        """Report the messages that a subscription did not get. Yield nothing if it got all.

        Args:
            topic: name of the topic.
            stats: counts of the subscription.
            values: further values of the diagnosis.
            now_ns: steady time now.
        """
        lost_by = dict(stats.lost_by)
        lost = {node: self._rise(stats, f"lost from {node}", count, now_ns) for node, count in sorted(lost_by.items())}
        refused = self._rise(stats, "refused", stats.rejected, now_ns)
        overwritten = self._rise(stats, "overwritten", stats.overwritten, now_ns)
        texts = []
        if any(lost.values()):
            of = ", ".join(f"{count} of {node}" for node, count in lost.items() if count)
            texts.append(f"messages lost ({of}): this node or the machine is too slow, see ic top")
        if refused:
            texts.append(f"{refused} messages refused: {stats.rejected_why}")
        if overwritten:
            texts.append(f"{overwritten} messages overwritten in use: this node holds them for too long")
        level = Level.ERROR if refused or overwritten else Level.WARN
        totals = {f"lost from {node}": count for node, count in sorted(lost_by.items())}
        totals |= {"refused": stats.rejected, "overwritten": stats.overwritten}
        if any(totals.values()):
            yield _diagnosis(f"input {topic}", level, texts, {"lost": stats.lost, **totals, **values})

    def output(self, topic: str, stats: PublisherStats, now_ns: int) -> Iterator[Diagnosis]:
        """Report large messages that were sent without shared memory. Yield nothing if there were none."""
        count = self._rise(stats, "not_shared", stats.not_shared, now_ns)
        texts = [f"{count} large messages without shared memory: {stats.not_shared_why}"] if count else []
        if stats.not_shared:
            values = {"not_shared": stats.not_shared, "sent": stats.count}
            yield _diagnosis(f"output {topic}", Level.WARN, texts, values)

    def _rise(self, stats: Stats, name: str, total: int, now_ns: int) -> int:
        """Return the growth of a total in the last ``RECENT_S``; 0 during start-up."""
        recent = self._recent.setdefault(stats, {}).setdefault(name, RecentCount(RECENT_S))
        if now_ns < self._warns_from_ns:
            recent.total = total
        return recent.rise(total, now_ns)


def _diagnosis(name: str, level: Level, texts: list[str], values: Mapping[str, Any]) -> Diagnosis:
    if not texts:
        return Diagnosis(name, Level.OK, f"nothing lost in the last {RECENT_S:g} s", values)
    return Diagnosis(name, level, f"in the last {RECENT_S:g} s {'; '.join(texts)}", values)
