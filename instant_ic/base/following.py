"""Detection of a track that does not follow its power: a dead or reversed encoder, or a stalled motor.

The controller regulates the speed by the encoders. Without counts, it raises the power to the limit at any command. The
watch therefore compares the counts with the power, not with the command. For each track and reading:

1. ``_load``: estimate the power that the load takes from the current. A standing motor draws the stall current of its
   power, a turning motor draws less. ``_learn`` learns the stall current at full power from healthy motion.
2. The remaining power drives the track. At full power, the track is at least as fast as the fastest command.
3. Add up the motion that this speed implies, less the motion counted in the power's direction. Above a distance, the
   track is at fault.

:mod:`instant_ic.base.wind_up` finds power that rises slowly sooner.
"""

import math
from collections import deque

import numpy as np
from numpy.typing import NDArray

from instant_ic.base.wind_up import LEAST_A, LEAST_POWER, LEAST_SHARE, WindUpWatch

SLOW_CYCLE_S = 0.06
"""Longest exchange with the controller per cycle at which a runaway track is still noticed in time, in seconds."""
_MISSING_M, _MISSING_SIMULATED_M = 0.02, 0.04
"""Missing motion at which a track is at fault, in metres; more in simulation, which may be late on a busy machine."""
_MOST_SIMULATED_S = 0.05
"""Longest time between two readings that counts in simulation, in seconds: it may have paused for the rest."""
_CHANGING_S = 0.25
"""Missing motion allowed after a change of the command, as time at the change's speed: power first brakes a track."""
_LAG_S, _RECENT_S = 0.1, 0.3
"""Time constants from a command to its motion, and for forgetting a change of the command, in seconds."""
_BLANKED_POWER = 0.2
"""Power up to which the controller may report no current."""
_MARGIN, _MARGIN_POWER = 1.3, 0.05
"""Factor and addition to the load estimated from the current, for variations of resistance and battery voltage."""
_MOST_LOAD = 0.5
"""Largest power that a load may take. A track that stands at more power is blocked, or its encoder is dead."""
_SLOW_CYCLES = 5
"""Number of cycles whose median duration counts, so that single late replies do not."""


class TrackWatch:
    """Compares the power of both tracks with their counts.

    Args:
        fastest_m_s: speed of a track at the fastest command.
        pulse_m: track distance per encoder pulse, metres.
        simulated: true for a simulated base, which may pause on a busy machine.
    """

    def __init__(self, fastest_m_s: float, pulse_m: float, simulated: bool = False) -> None:
        self._fastest_m_s = fastest_m_s
        self._pulse_m = pulse_m
        self._simulated = simulated
        self._missing_limit_m = _MISSING_SIMULATED_M if simulated else _MISSING_M
        self._stall_a = np.zeros(2)  # stall current at full power: largest seen
        self._cycles_s: deque[float] = deque([0.0] * _SLOW_CYCLES, _SLOW_CYCLES)
        self.reset()

    def reset(self) -> None:
        """Start again, after the motors were switched off or their counts were lost."""
        self._command = np.zeros(2)
        self._lagged = np.zeros(2)  # command after the lag
        self._change = np.zeros(2)  # recent change of the command, m/s
        self._braking = np.zeros(2)  # part of the change that slows or reverses the track, m/s
        self._missing_m = np.zeros(2)
        self._power = np.zeros(2)  # at the last reading
        self._current_a = np.zeros(2)
        self._wind_up = WindUpWatch(self._pulse_m)
        self._moved_once = np.zeros(2, bool)  # since the reset

    def exchanged(self, cycle_s: float) -> None:
        """Record the duration of a cycle's commands and replies, in seconds."""
        self._cycles_s.append(cycle_s)

    def commanded(self, speeds: NDArray[np.float64], dt_s: float) -> None:
        """Record the commanded speeds of the last ``dt_s`` seconds, left and right, m/s, (2,)."""
        self._command = speeds
        lags, kept = self._lagged - speeds, math.exp(-dt_s / _RECENT_S)
        self._change = np.maximum(np.abs(lags), self._change * kept)
        self._braking = np.maximum(lags * np.sign(self._lagged), self._braking * kept)
        self._lagged = speeds + lags * math.exp(-dt_s / _LAG_S)

    def judge(
        self, moved: NDArray[np.float64], power: NDArray[np.float64], current_a: NDArray[np.float64], dt_s: float
    ) -> str:
        """Judge both tracks, left and right, by one reading.

        Args:
            moved: counted motion since the last reading, metres, (2,).
            power: power now, -1 to 1, (2,).
            current_a: currents now, amperes, (2,); their sign is ignored.
            dt_s: time since the last reading, seconds.

        Returns:
            Fault text for the operator; empty if both tracks follow.
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
                return ""  # the simulation is paused; otherwise at least the currents' noise would change
            dt_s = min(dt_s, _MOST_SIMULATED_S)
        self._learn(moved, power, current_a)
        # Between two readings, only the smaller of the two powers is certain.
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
        """Return the largest power that the tracks' loads may take, (2,), from the currents in amperes, (2,)."""
        known = (current_a >= LEAST_A) & (self._stall_a > 0.0)
        share = current_a / np.maximum(self._stall_a, LEAST_A)
        return np.where(known, np.minimum(_MARGIN * share + _MARGIN_POWER, _MOST_LOAD), _BLANKED_POWER)

    def _learn(self, moved: NDArray[np.float64], power: NDArray[np.float64], current_a: NDArray[np.float64]) -> None:
        """Learn the stall currents from tracks that start or follow and do not brake."""
        size = np.abs(power)
        faster = (self._command * power > 0.0) & (np.abs(self._command) >= np.abs(self._lagged) - 1e-3)
        follows = (moved * power > 0.0) | ~self._moved_once
        shown = faster & follows & (size >= LEAST_POWER) & (current_a >= LEAST_A)
        self._stall_a = np.maximum(self._stall_a, np.where(shown, current_a / np.maximum(size, LEAST_POWER), 0.0))
