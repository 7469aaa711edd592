"""Nominal rates of topics (``config/topics.yaml``), and checks against them: alive, right rate."""

from __future__ import annotations

import functools
import math
from dataclasses import dataclass

from instant_ic.config.yaml_text import read_yaml
from instant_ic.util import paths

ALIVE_PERIODS = 10.0
"""A topic whose newest message is older than this many periods has stopped."""

FREQ_OK_SHARE = 0.9
"""Share of the nominal rate above which a rate is right."""


@dataclass(frozen=True)
class TopicRate:
    """Expected rate of a topic.

    Attributes:
        rate_hz: nominal rate, messages per second.
        when: condition under which it is published, as text; empty if it always is.
    """

    rate_hz: float
    when: str = ""

    def alive(self, age_s: float) -> bool:
        """Return whether the newest message is recent enough; its age is inf before the first."""
        return age_s * self.rate_hz < ALIVE_PERIODS

    def freq_ok(self, rate_hz: float) -> bool:
        """Return whether a measured rate is close enough to the nominal one."""
        return rate_hz > FREQ_OK_SHARE * self.rate_hz

    def fault(self, rate_hz: float, age_s: float) -> str:
        """Return a description of the fault, with the numbers; empty if there is none.

        Args:
            rate_hz: measured rate.
            age_s: age of the newest message; inf before the first.
        """
        if not self.alive(age_s):
            if self.when:  # a pause is normal
                return ""
            return "no message yet" if math.isinf(age_s) else f"stopped {age_s:.1f} s ago"
        if not self.freq_ok(rate_hz):
            return f"{rate_hz:.1f} of {self.rate_hz:g} Hz"
        return ""


@functools.cache
def topic_rates() -> dict[str, TopicRate]:
    """Return the shipped table, ``config/topics.yaml``; it is read once."""
    table = read_yaml(paths.shipped_file("config", "topics.yaml").read_text())
    return {topic: TopicRate(**entry) for topic, entry in table.items()}


def expected_rate(topic: str) -> TopicRate | None:
    """Return the expected rate of a topic, whose first part may be a namespace; None if the table does not have it."""
    rates = topic_rates()
    return rates.get(topic) or rates.get(f"/{topic.lstrip('/').partition('/')[2]}")
