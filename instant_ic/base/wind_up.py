"""Detection of a track whose power rises slowly without counts: a dead or reversed encoder at a slow command.

The current of a standing track grows in proportion to its power. The current of a turning track depends on its load
only. For each track:

1. The track is silent when it lacks more counts than stick-slip at one command explains.
2. Compare the smoothed power and current with those at the last count. While both rise together, the track stands, and
   the comparison starts again from the present values.
3. A silent track turns when its power has risen by more than its current explains.

The method needs a current reading, but neither the load nor the stall current.
"""

import math

import numpy as np
from numpy.typing import NDArray

LEAST_SHARE = 0.25
"""Smallest share of its speed that a healthy track counts."""
LEAST_A, LEAST_POWER = 0.2, 0.03
"""Smallest current, in amperes, and smallest power that are used."""
_SILENT_M, _SILENT_PULSES, _SILENT_S = 0.002, 2.0, 0.3
"""Commanded motion in metres, in pulses, and as time at the command in seconds after which a track without counts is
silent; the largest applies."""
_STEADY = 0.25
"""Largest braking, as a share of the command, at which a track is judged, because braking draws current too."""
_SMOOTH_S = 0.1
"""Time constant of the smoothed power and current."""
_NOISE_S, _MOST_NOISE_A = 1.0, 0.5
"""Time constant in seconds of the current's noise, and largest change between two readings that counts as noise."""
_MORE_POWER, _MARGIN = 0.01, 2.0
"""Smallest unexplained power of a turning track, and factor on the power that current and noise explain."""


class WindUpWatch:
    """Compares the rise of power and current of both tracks while they do not count.

    Args:
        pulse_m: track distance per encoder pulse, metres.
    """

    def __init__(self, pulse_m: float) -> None:
        self._silent_m = max(_SILENT_M, _SILENT_PULSES * pulse_m)
        self._lacks_m = np.zeros(2)
        self._smooth = np.zeros((2, 2))  # row 0: power in the command's direction; row 1: current, A
        self._start = np.zeros((2, 2))  # _smooth when the track last counted or was last seen standing
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
        """Return for each track, (2,), whether it turns without counts.

        Args:
            command: commanded speeds, m/s, (2,).
            braking: recent change of the command that slows or reverses the track, m/s, (2,).
            moved: counted motion since the last reading, metres, (2,).
            power: power now, -1 to 1, (2,).
            current_a: absolute currents now, amperes, (2,).
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
        # For the same power, a standing track draws at least as much current as a turning one.
        power_per_a = np.maximum(least, LEAST_POWER) / np.maximum(least_a, LEAST_A)
        explained = (most_a - least_a) * power_per_a
        unsure = _MORE_POWER + _MARGIN * self._noise_a * power_per_a
        stands = (explained > unsure) & (_MARGIN * explained > most - least)
        counts = self._lacks_m < 0.5 * self._silent_m
        self._start = np.where(counts | stands | (least_a < LEAST_A), self._smooth, self._start)
        turns = most - least - _MARGIN * np.maximum(0.0, explained) > unsure
        return (self._lacks_m >= silent_m) & turns & (np.minimum(least_a, current_a) >= LEAST_A)
