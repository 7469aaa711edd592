"""Contradictions between wheel odometry and LiDAR, which the SLAM reports to the arbiter."""

from __future__ import annotations

from enum import IntEnum


class Contradiction(IntEnum):
    """Way in which the robot's motion differs from its tracks' (values of PoseIntegrity.contradiction)."""

    NONE = 0
    SLIPPING = 1
    """The tracks turn, but the robot moves less than half as far, or the LiDAR repeats its data."""
    PUSHED = 2
    """The robot moves while its tracks stand, or it slides sideways."""
    OTHER_WAY = 3
    """The robot moves opposite to its tracks."""
    FARTHER = 4
    """The robot moves at least half as far again as its tracks."""

    @classmethod
    def _missing_(cls, value: object) -> Contradiction:
        """Return slipping, which stops the robot, for a damaged report or one of another version."""
        return cls.SLIPPING

    @property
    def text(self) -> str:
        """Message to the operator: what happened and what to do. Empty without a contradiction."""
        return _TEXTS[self]


_TEXTS = {
    Contradiction.NONE: "",
    Contradiction.SLIPPING: "The tracks turn, the robot does not. Free it, or check that the LiDAR's data is live.",
    Contradiction.PUSHED: "The robot moves, its tracks do not. Check what moves it, and check the encoders.",
    Contradiction.OTHER_WAY: "The robot moves opposite to its tracks. Check whether motors are inverted or swapped.",
    Contradiction.FARTHER: "The robot moves farther than its tracks. Check pulses_per_metre and the encoders.",
}
