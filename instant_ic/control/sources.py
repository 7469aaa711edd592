"""Sources that a mode needs: their freshness, and the speed that their rates allow."""

from __future__ import annotations

import math
from dataclasses import dataclass

from instant_ic.control.arbiter_config import ArbiterConfig
from instant_ic.control.freshness import IMAGES
from instant_ic.control.reasons import Stale
from instant_ic.control.snapshot import ArbiterInputs
from instant_ic.control.states import SOURCES, Mode, Source

STEP_AFTER_S = 0.001
"""Delay of a step after the time-out that it checks, so that the source is surely stale; time-outs are shortened by it.
"""
_CATCH_UP = 0.8
"""Speed limit of the v-bot as a share of the r-bot's."""


@dataclass(frozen=True)
class SourceMonitor:
    """Time-outs of the sources under one configuration."""

    config: ArbiterConfig

    def stale(
        self, inputs: ArbiterInputs, mode: Mode, in_mode_s: float, shown_s: float = math.inf
    ) -> tuple[Stale, ...]:
        """Return the stale sources that ``mode`` needs, with their ages.

        ``in_mode_s`` is the time since the last change of mode, ``shown_s`` the time for which the v-bot is shown.
        """
        found = []
        for source in _required(mode):
            if source.optional and source.key not in inputs.ages:
                continue
            age_s = _age_s(source, inputs, in_mode_s, shown_s)
            # Written so that an age of NaN is stale.
            fresh = age_s <= self._allowed_s(source, inputs)
            if not fresh or (source.key == "command" and inputs.operator_gone):
                found.append(Stale(source, age_s))
        return tuple(found)

    def is_lost(self, stale: Stale, inputs: ArbiterInputs) -> bool:
        """Return whether a stale source is older than ``TimeoutConfig.lost_s``: the robot must go to STOPPED."""
        source, age_s = stale
        return age_s > self.config.timeouts.lost_s(source.key, _usual_s(source, inputs))

    def command_is_fresh(self, inputs: ArbiterInputs) -> bool:
        """Return whether the operator's command is young enough and its client still connected."""
        return inputs.age("command") <= self._command_s and not inputs.operator_gone

    def stale_in_s(self, inputs: ArbiterInputs, mode: Mode, in_mode_s: float, shown_s: float = math.inf) -> float:
        """Return seconds until the first fresh source becomes stale; inf for none."""
        left = [
            self._allowed_s(source, inputs) - _age_s(source, inputs, in_mode_s, shown_s) for source in _required(mode)
        ]
        left.append(self._command_s - inputs.age("command"))
        # A source with 0 s left is not stale yet, but becomes so right after this step.
        return min((one for one in left if one >= 0.0), default=math.inf)

    def speed_limit_m_s(self, inputs: ArbiterInputs, mode: Mode) -> float:
        """Return the speed at which the robot drives at most ``image_travel_m`` before a missing image stops it.

        Rare images therefore slow the robot, instead of stopping it at each late one.
        """
        images = [source for source in _required(mode) if source.key in IMAGES]
        longest_s = max((self._allowed_s(source, inputs) for source in images), default=0.0)
        most = self.config.limits.max_linear_m_s
        return min(most, self.config.timeouts.image_travel_m / longest_s) if longest_s > 0 else most

    def slowed(self, inputs: ArbiterInputs, mode: Mode, speed_m_s: float) -> str:
        """Return the text for the operator if rare images do not allow ``speed_m_s``; else empty."""
        limit = self.speed_limit_m_s(inputs, mode)
        if speed_m_s <= limit:
            return ""
        rare = max(
            (source for source in _required(mode) if source.key in IMAGES),
            key=lambda source: self._allowed_s(source, inputs),
        )
        usual_s = inputs.usual.get(rare.key, math.inf)
        every = f"one {rare.name} in {usual_s:.1f} s" if math.isfinite(usual_s) else f"the first {rare.name}s arrive"
        return f" Slowed to {limit:.2f} m/s: {every}."

    def vbot_limit_m_s(self, inputs: ArbiterInputs, mode: Mode) -> float:
        """Return the speed limit of the v-bot; below the r-bot's if rare images limit that, so that it catches up."""
        limit = self.speed_limit_m_s(inputs, mode)
        return limit if limit >= self.config.limits.max_linear_m_s else _CATCH_UP * limit

    def _allowed_s(self, source: Source, inputs: ArbiterInputs) -> float:
        return self.config.timeouts.allowed_s(source.key, _usual_s(source, inputs)) - STEP_AFTER_S

    @property
    def _command_s(self) -> float:
        """Largest age in seconds at which the operator's command counts."""
        return self.config.timeouts.command - STEP_AFTER_S


def images_too_rare(inputs: ArbiterInputs, config: ArbiterConfig) -> bool:
    """Return whether camera images are too rare to drive by, or their rate is not known yet."""
    return inputs.usual.get("camera", 0.0) > config.timeouts.slowest_image_s


def _required(mode: Mode) -> list[Source]:
    return [source for source in SOURCES if mode in source.modes]


def _usual_s(source: Source, inputs: ArbiterInputs) -> float | None:
    return inputs.usual.get(source.key) if source.steady else None


def _age_s(source: Source, inputs: ArbiterInputs, in_mode_s: float, shown_s: float) -> float:
    # A source that was not needed before the change may have been silent, so its age counts from the change.
    since_s = {"nav": in_mode_s, "view": shown_s, "vbot": shown_s}.get(source.key, math.inf)
    return min(inputs.age(source.key), since_s)
