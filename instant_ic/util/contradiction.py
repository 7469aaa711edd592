"""Contradictions between wheel odometry and LiDAR, as the SLAM reports them and the arbiter acts on them."""

from __future__ import annotations

from enum import IntEnum


class Contradiction(IntEnum):
    """Values of PoseIntegrity.contradiction: how the robot's motion differs from that of its tracks."""

    NONE = 0
    SLIPPING = 1
    """The tracks turn, and the robot moves less than half as far, or not at all; or the LiDAR repeats itself."""
    PUSHED = 2
    """The robot moves, and its tracks stand; or it slides sideways."""
    OTHER_WAY = 3
    """The robot moves opposite to its tracks."""
    FARTHER = 4
    """The robot moves at least half as far again as its tracks."""

    @classmethod
    def _missing_(cls, value: object) -> Contradiction:
        """Take a report of another version, or a damaged one, as slipping, which stops the robot."""
        return cls.SLIPPING

    @property
    def text(self) -> str:
        """Message to the operator: cause and remedy; empty without a contradiction."""
        return _TEXTS[self]


_TEXTS = {
    Contradiction.NONE: "",
    Contradiction.SLIPPING: "The tracks turn, the robot does not. Free it, or check that the LiDAR's data is live.",
    Contradiction.PUSHED: "The robot moves, its tracks do not. Look who moves it, and check the encoders.",
    Contradiction.OTHER_WAY: "The robot moves the other way than its tracks. Check the motors: inverted or swapped.",
    Contradiction.FARTHER: "The robot moves farther than its tracks. Check pulses_per_metre and the encoders.",
}
