"""Nominal rates of topics (``config/topics.yaml``), and checks of measured rates and ages against them."""

from __future__ import annotations

import functools
import math
from dataclasses import dataclass

from instant_ic.config.yaml_text import read_yaml
from instant_ic.util import paths

ALIVE_PERIODS = 10.0
"""Age of the newest message, in nominal periods, above which a topic counts as stopped."""

PAUSE_S = 3.0
"""Age in seconds above which a topic with a condition counts as paused; a rate is reported after as long."""

FREQ_OK_SHARE = 0.9
"""Share of the nominal rate above which a measured rate is right."""


@dataclass(frozen=True)
class TopicRate:
    """Expected rate of a topic.

    Attributes:
        rate_hz: nominal rate, messages per second.
        when: condition under which the topic is published, as text; empty if it always is.
    """

    rate_hz: float
    when: str = ""

    def alive(self, age_s: float) -> bool:
        """Return whether the newest message is recent enough. Its age is inf before the first message."""
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
        if self.when and (age_s > PAUSE_S or not self.alive(age_s)):  # a pause is normal
            return ""
        if not self.alive(age_s):
            return "no message yet" if math.isinf(age_s) else f"stopped {age_s:.1f} s ago"
        if not self.freq_ok(rate_hz):
            return f"{rate_hz:.1f} of {self.rate_hz:g} Hz"
        return ""


@functools.cache
def topic_rates() -> dict[str, TopicRate]:
    """Return the shipped table ``config/topics.yaml``, which is read once."""
    table = read_yaml(paths.shipped_file("config", "topics.yaml").read_text())
    return {topic: TopicRate(**entry) for topic, entry in table.items()}


def expected_rate(topic: str) -> TopicRate | None:
    """Return the expected rate of a topic, with or without a namespace; None if it is not in the table."""
    rates = topic_rates()
    return rates.get(topic) or rates.get(f"/{topic.lstrip('/').partition('/')[2]}")
