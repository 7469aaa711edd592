"""Notices a track that does not follow what drives it: a dead or reversed encoder, a stalled motor.

The controller regulates the speed by the encoders: without counts it powers the track up as far as it can, whatever the
command. The watch therefore judges the power, not the command. For each track and reading:

1. ``_load``: power that the load needs. A motor that stands draws the stall current for its power; one that turns draws
   less. The stall current for each share of power is learned from readings of healthy motion.
2. The rest of the power drives the track. At full power, it is at least as fast as the fastest command.
3. Motion that the counts lack of that speed adds up; counts in the power's direction take it back. Above a distance,
   the track is at fault.

Power that winds up slowly is found sooner by :mod:`instant_ic.base.wind_up`.
"""

import math
from collections import deque

import numpy as np
from numpy.typing import NDArray

from instant_ic.base.wind_up import LEAST_A, LEAST_POWER, LEAST_SHARE, WindUpWatch

SLOW_CYCLE_S = 0.06
"""Longest exchange with the controller in a cycle at which a runaway track is noticed in time."""
_MISSING_M, _MISSING_SIMULATED_M = 0.02, 0.04
"""Motion that the counts of a track at fault lack; a simulation may be late on a busy machine."""
_MOST_SIMULATED_S = 0.05
"""Longest time that counts between two readings of a simulation: it may have paused for the rest."""
_CHANGING_S = 0.25
"""Further motion may lack after a change of the command, by this time at the change: power first brakes a track."""
_LAG_S, _RECENT_S = 0.1, 0.3
"""Time from a command to its motion, and time for which a change of the command counts."""
_BLANKED_POWER = 0.2
"""Up to this power the controller may blank its currents, and report none."""
_MARGIN, _MARGIN_POWER = 1.3, 0.05
"""Factor on the load by its current, for resistance and battery, and power added to it."""
_MOST_LOAD = 0.5
"""A track that stands at more power is blocked, if its encoder is not dead."""
_SLOW_CYCLES = 5
"""Cycles whose median shows a slow line: a few late replies do not."""


class TrackWatch:
    """Compares the power on both tracks with their counts.

    Args:
        fastest_m_s: speed of a track at the fastest command.
        pulse_m: motion of a track for one pulse of its encoder, metres.
        simulated: whether the tracks are those of a simulation, which pauses on a busy machine.
    """

    def __init__(self, fastest_m_s: float, pulse_m: float, simulated: bool = False) -> None:
        self._fastest_m_s = fastest_m_s
        self._pulse_m = pulse_m
        self._simulated = simulated
        self._missing_limit_m = _MISSING_SIMULATED_M if simulated else _MISSING_M
        self._stall_a = np.zeros(2)  # for full power; largest seen
        self._cycles_s: deque[float] = deque([0.0] * _SLOW_CYCLES, _SLOW_CYCLES)
        self.reset()

    def reset(self) -> None:
        """Start again: the motors were switched off, or their counts were lost."""
        self._command = np.zeros(2)
        self._lagged = np.zeros(2)  # command after the lag
        self._change = np.zeros(2)  # of the command, recently
        self._braking = np.zeros(2)  # the part of it that slows or reverses the track
        self._missing_m = np.zeros(2)
        self._power = np.zeros(2)  # at the last reading
        self._current_a = np.zeros(2)
        self._wind_up = WindUpWatch(self._pulse_m)
        self._moved_once = np.zeros(2, bool)  # since the reset

    def exchanged(self, cycle_s: float) -> None:
        """Note that the commands and replies of a cycle took ``cycle_s`` seconds."""
        self._cycles_s.append(cycle_s)

    def commanded(self, speeds: NDArray[np.float64], dt_s: float) -> None:
        """Note that the tracks, left and right, were commanded ``speeds`` (2,), m/s, for the last ``dt_s`` seconds."""
        self._command = speeds
        lags, kept = self._lagged - speeds, math.exp(-dt_s / _RECENT_S)
        self._change = np.maximum(np.abs(lags), self._change * kept)
        self._braking = np.maximum(lags * np.sign(self._lagged), self._braking * kept)
        self._lagged = speeds + lags * math.exp(-dt_s / _LAG_S)

    def judge(
        self, moved: NDArray[np.float64], power: NDArray[np.float64], current_a: NDArray[np.float64], dt_s: float
    ) -> str:
        """Judge both tracks, left and right, by a reading.

        Args:
            moved: motion since the last reading by the counts, metres, (2,).
            power: power now, -1 to 1, (2,).
            current_a: currents now, amperes, (2,); the sign is not used.
            dt_s: time since the last reading, seconds.

        Returns:
            What is wrong, for the operator; empty if both tracks follow.
        """
        cycle_s = sorted(self._cycles_s)[_SLOW_CYCLES // 2]
        if cycle_s > SLOW_CYCLE_S and not self._simulated:
            return (
                f"the motor controller answers too slowly to watch the tracks (a cycle takes {cycle_s:.2f} s; "
                f"at most {SLOW_CYCLE_S} s): check roboclaw.baud, the USB cable and hub, the adapter's latency timer"
            )
        current_a = np.abs(current_a)
        still = not moved.any() and bool((power == self._power).all() and (current_a == self._current_a).all())
        if self._simulated:
            if still:
                return ""  # the simulation pauses: in any other case at least the noise of the currents changes
            dt_s = min(dt_s, _MOST_SIMULATED_S)
        self._learn(moved, power, current_a)
        # Between two readings the power is known to be the smaller one only.
        least = np.where(power * self._power > 0.0, np.minimum(np.abs(power), np.abs(self._power)), 0.0)
        load = self._load(np.maximum(current_a, self._current_a))
        due_m = np.maximum(0.0, least - load) * self._fastest_m_s * dt_s
        done_m = np.maximum(0.0, moved * np.sign(power))
        self._missing_m = np.maximum(0.0, self._missing_m + due_m - done_m / LEAST_SHARE)
        lacks = self._missing_m > self._missing_limit_m + _CHANGING_S * self._change
        lacks |= self._wind_up.judge(self._command, self._braking, moved, power, current_a, dt_s)
        self._power, self._current_a = power, current_a
        self._moved_once |= moved != 0.0
        for track in np.flatnonzero(lacks):
            return (
                f"the {('left', 'right')[track]} track does not follow its command of {self._command[track]:.2f} m/s "
                f"(power {abs(power[track]):.0%}): check its encoder, the encoder's cable and direction, and whether "
                "the track is blocked"
            )
        return ""

    def _load(self, current_a: NDArray[np.float64]) -> NDArray[np.float64]:
        """Return the power that the loads of the tracks need at most, (2,), by the currents, amperes, (2,)."""
        known = (current_a >= LEAST_A) & (self._stall_a > 0.0)
        share = current_a / np.maximum(self._stall_a, LEAST_A)
        return np.where(known, np.minimum(_MARGIN * share + _MARGIN_POWER, _MOST_LOAD), _BLANKED_POWER)

    def _learn(self, moved: NDArray[np.float64], power: NDArray[np.float64], current_a: NDArray[np.float64]) -> None:
        """Learn the stall currents from tracks that start or follow, and do not brake."""
        size = np.abs(power)
        faster = (self._command * power > 0.0) & (np.abs(self._command) >= np.abs(self._lagged) - 1e-3)
        follows = (moved * power > 0.0) | ~self._moved_once
        shown = faster & follows & (size >= LEAST_POWER) & (current_a >= LEAST_A)
        self._stall_a = np.maximum(self._stall_a, np.where(shown, current_a / np.maximum(size, LEAST_POWER), 0.0))
