"""Notices a track that does not follow its command: a dead or reversed encoder, a stalled motor."""

import math

import numpy as np
from numpy.typing import NDArray

_LAG_S = 0.1
"""Usual time from a set point to the track's motion."""
_LEAST_SHARE = 0.25
"""Share of the commanded motion that a sound track does, whatever its load."""
_MISSING_M, _MISSING_S = 0.03, 0.15
"""Distance, and time at the commanded speed, that the counts of a track at fault lack."""
_RECENT_S = 0.3
"""The commanded speed of so long ago counts too: the motion may lack since before the robot slowed down."""
_DOUBT = 2.0
"""Factor on what may lack if no other track shows that the counts are up to date."""
_MOVING_M_S = 0.02
"""The other track shows it when commanded to be faster than this."""
_SILENCE_S = 0.1
"""If readings show that neither track has counted for longer, the counts were late: a track that counts again is sound.
Readings that are late themselves show nothing."""
_SIMULATED = 2.0
"""Factor on what may lack while neither track counts, in a simulation, which pauses on a busy machine."""


class TrackWatch:
    """Compares the commanded motion of both tracks with their counts.

    The controller regulates the speed by the encoders: without counts it speeds the track up as far as it can, whatever
    the command.

    Args:
        simulated: whether the tracks are those of a simulation.
    """

    def __init__(self, simulated: bool = False) -> None:
        self._silence = _DOUBT * (_SIMULATED if simulated else 1.0)
        self.reset()

    def reset(self) -> None:
        """Start again: the tracks were stopped, or their counts were lost."""
        self._speeds = np.zeros(2)  # after the lag
        self._recent = np.zeros(2)  # largest of the last time
        self._due_m = np.zeros(2)  # since the last counts
        self._missing_m = np.zeros(2)  # before that
        self._since_s = self._silent_s = 0.0  # since the last counts: now, and at the last reading without counts

    def commanded(self, speeds: NDArray[np.float64], dt_s: float) -> None:
        """Note that the tracks, left and right, were commanded ``speeds`` (2,), m/s, for the last ``dt_s`` seconds."""
        decay = math.exp(-dt_s / _LAG_S)
        # The integral of the lagged set point.
        self._due_m = self._due_m + speeds * dt_s + (self._speeds - speeds) * _LAG_S * (1.0 - decay)
        self._speeds = speeds + (self._speeds - speeds) * decay
        self._recent = np.maximum(np.abs(self._speeds), self._recent * math.exp(-dt_s / _RECENT_S))
        self._since_s += dt_s

    def counted(self, moved: NDArray[np.float64]) -> str:
        """Judge both tracks by their motion (2,), m, since the last call.

        Returns:
            What is wrong, for the operator; empty if both tracks follow.
        """
        doubt = np.full(2, self._silence)
        if moved.any():
            done = np.maximum(0.0, moved * np.sign(self._due_m))
            missing = np.maximum(0.0, self._missing_m + np.abs(self._due_m) - done / _LEAST_SHARE)
            self._missing_m = np.where((self._silent_s > _SILENCE_S) & (moved != 0.0), 0.0, missing)
            self._due_m, self._since_s, self._silent_s = np.zeros(2), 0.0, 0.0
            follows = (self._missing_m == 0.0) & (np.abs(self._speeds) > _MOVING_M_S)
            doubt = np.where(follows[::-1], 1.0, _DOUBT)
        else:
            self._silent_s = self._since_s
        missing = self._missing_m + np.abs(self._due_m)
        for track in np.flatnonzero(missing > doubt * (_MISSING_M + _MISSING_S * self._recent)):
            return (
                f"the {('left', 'right')[track]} track does not follow its command of {self._speeds[track]:.2f} m/s: "
                "check its encoder, the encoder's cable and direction, and whether the track is blocked"
            )
        return ""
