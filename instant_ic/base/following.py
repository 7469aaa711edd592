"""Notices a track that does not follow its command: a dead or reversed encoder, a stalled motor."""

import math

import numpy as np
from numpy.typing import NDArray

_LAG_S = 0.1
"""Usual time from a set point to the track's motion."""
_LEAST_SHARE = 0.25
"""Share of the commanded motion that a sound track does, whatever its load."""
_MISSING_M, _MISSING_S = 0.03, 0.15
"""Distance, and time at the commanded speed, that the counts of a track at fault lack; of a sound one at most half."""
_DOUBT = 2.0
"""Factor on both if no other track shows that the counts are up to date: a late simulation looks alike."""
_MOVING_M_S = 0.02
"""The other track shows it when commanded to be faster than this."""


class TrackWatch:
    """Compares the commanded motion of both tracks with their counts.

    The controller regulates the speed by the encoders: without counts it speeds the track up as far as it can, whatever
    the command.
    """

    def __init__(self) -> None:
        self.reset()

    def reset(self) -> None:
        """Start again: the tracks were stopped, or their counts were lost."""
        self._speeds = np.zeros(2)
        self._missing_m = np.zeros(2)

    def update(self, speeds: NDArray[np.float64], moved: NDArray[np.float64], dt_s: float) -> str:
        """Judge both tracks.

        Args:
            speeds: commanded during the last ``dt_s``, left and right, m/s, (2,).
            moved: measured during the last ``dt_s``, m, (2,).
            dt_s: seconds.

        Returns:
            What is wrong, for the operator; empty if both tracks follow.
        """
        decay = math.exp(-dt_s / _LAG_S)
        # The integral of the lagged set point over the step.
        due = speeds * dt_s + (self._speeds - speeds) * _LAG_S * (1.0 - decay)
        self._speeds = speeds + (self._speeds - speeds) * decay
        done = np.maximum(0.0, moved * np.sign(due))
        self._missing_m = np.maximum(0.0, self._missing_m + np.abs(due) - done / _LEAST_SHARE)
        follows = (self._missing_m == 0.0) & (np.abs(self._speeds) > _MOVING_M_S)
        allowed_m = (_MISSING_M + _MISSING_S * np.abs(self._speeds)) * np.where(follows[::-1], 1.0, _DOUBT)
        for track in np.flatnonzero(self._missing_m > allowed_m):
            return (
                f"the {('left', 'right')[track]} track does not follow its command of {speeds[track]:.2f} m/s: check "
                "its encoder, the encoder's cable and direction, and whether the track is blocked"
            )
        return ""
