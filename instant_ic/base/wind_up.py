"""Notices a track without counts whose power winds up slowly: a dead or reversed encoder at a creeping command.

A track that stands draws more current with more power: the stall current grows in proportion. One that turns draws the
current of its load, whatever the power. So, for each track:

1. It is silent when it lacks more counts than stick and slip at one command explain.
2. Power and current, smoothed, are compared with those of the last count. While both rise together the track stands,
   and the comparison begins again from there.
3. The silent track turns when its power has risen more than its current explains.

Neither the load nor the stall current has to be known, only that the current is shown.
"""

import math

import numpy as np
from numpy.typing import NDArray

LEAST_SHARE = 0.25
"""Share of its speed that a healthy track counts at least."""
LEAST_A, LEAST_POWER = 0.2, 0.03
"""Smaller currents and powers show nothing."""
_SILENT_M, _SILENT_PULSES, _SILENT_S = 0.002, 2.0, 0.3
"""Commanded motion, pulses, and time at the command, without counts after which a track is silent."""
_STEADY = 0.25
"""Braking, as a share of the command, up to which it is steady: a track that brakes draws current too."""
_SMOOTH_S = 0.1
"""Time constant of the smoothed power and current."""
_NOISE_S, _MOST_NOISE_A = 1.0, 0.5
"""Time constant, and largest change between two readings, of the noise of a current."""
_MORE_POWER, _MARGIN = 0.01, 2.0
"""Unexplained power of a track that turns, and factor on what the current and its noise explain."""


class WindUpWatch:
    """Compares the rise of power and current on both tracks while they do not count.

    Args:
        pulse_m: motion of a track for one pulse of its encoder, metres.
    """

    def __init__(self, pulse_m: float) -> None:
        self._silent_m = max(_SILENT_M, _SILENT_PULSES * pulse_m)
        self._lacks_m = np.zeros(2)
        self._smooth = np.zeros((2, 2))  # power in the direction of the command, and current in amperes
        self._start = np.zeros((2, 2))  # the same when the track last counted, or drew the current of one that stands
        self._current_a = np.zeros(2)  # at the last reading
        self._noise_a = np.zeros(2)

    def judge(
        self,
        command: NDArray[np.float64],
        braking: NDArray[np.float64],
        moved: NDArray[np.float64],
        power: NDArray[np.float64],
        current_a: NDArray[np.float64],
        dt_s: float,
    ) -> NDArray[np.bool_]:
        """Return for each track whether it turns without counts, (2,).

        Args:
            command: commanded speeds, m/s, (2,).
            braking: how much the command has recently slowed or reversed each track, m/s, (2,).
            moved: motion since the last reading by the counts, metres, (2,).
            power: power now, -1 to 1, (2,).
            current_a: sizes of the currents now, amperes, (2,).
            dt_s: time since the last reading, seconds.
        """
        speed, way = np.abs(command), np.sign(command)
        silent_m = np.maximum(self._silent_m, _SILENT_S * speed)
        done_m = moved * way / np.where(moved * way > 0.0, LEAST_SHARE, 1.0)
        lacks_m = np.clip(self._lacks_m + speed * dt_s - done_m, 0.0, silent_m)
        self._lacks_m = np.where(braking < _STEADY * speed, lacks_m, 0.0)
        jump_a = np.minimum(np.abs(current_a - self._current_a), _MOST_NOISE_A)
        self._current_a = current_a
        self._noise_a += (jump_a - self._noise_a) * -math.expm1(-dt_s / _NOISE_S)
        self._smooth += (np.array([power * way, current_a]) - self._smooth) * -math.expm1(-dt_s / _SMOOTH_S)
        self._smooth, self._start = np.where(power * way > 0.0, (self._smooth, self._start), 0.0)
        (least, least_a), (most, most_a) = self._start, self._smooth
        # A track that stands draws at least as much current for its power as one that turns.
        power_per_a = np.maximum(least, LEAST_POWER) / np.maximum(least_a, LEAST_A)
        explained = (most_a - least_a) * power_per_a
        unsure = _MORE_POWER + _MARGIN * self._noise_a * power_per_a
        stands = (explained > unsure) & (_MARGIN * explained > most - least)
        counts = self._lacks_m < 0.5 * self._silent_m
        self._start = np.where(counts | stands | (least_a < LEAST_A), self._smooth, self._start)
        turns = most - least - _MARGIN * np.maximum(0.0, explained) > unsure
        return (self._lacks_m >= silent_m) & turns & (np.minimum(least_a, current_a) >= LEAST_A)
