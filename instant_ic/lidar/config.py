"""Parameters of the VLP-16: decoding and the flat scan."""

import math
from dataclasses import dataclass
from typing import Annotated

from instant_ic.config.ranges import NotNegative, Positive, Range, Share, check_ranges


@dataclass(frozen=True)
class DecoderConfig:
    """Parameters of decoding packets into revolutions.

    Attributes:
        cut_angle_deg: azimuth at which a revolution ends, clockwise from ahead, degrees.
        min_range: smallest range of a return, metres; nearer ones are dropped as too close.
        max_range: largest range of a return, metres; farther ones are dropped.
    """

    cut_angle_deg: Annotated[float, Range(0, below=360)] = 180.0
    min_range: NotNegative = 0.4
    max_range: Annotated[float, Range(above=0, high=131.07)] = 130.0

    def __post_init__(self) -> None:
        check_ranges(self)
        if not self.min_range < self.max_range:
            raise ValueError(f"min_range must be below max_range (got {self.min_range}, {self.max_range})")


@dataclass(frozen=True)
class FlatScanConfig:
    """Parameters of the flat scan: one range per direction from a revolution.

    Attributes:
        min_height: lower points are not obstacles, metres above the ground (z of base_link).
        max_height: the robot passes under higher points, metres above the ground.
        beams: number of directions over 360 degrees.
        range_min: smallest range of the scan, metres; nearer points count as too close (-inf).
        range_max: farther points are left out of the scan, metres.
        min_coverage: smallest measured share of the circle for a scan, 0-1.
    """

    min_height: float = 0.10
    max_height: float = 1.30
    beams: Annotated[int, Range(4, 7200)] = 720
    range_min: NotNegative = 0.4
    range_max: Positive = 100.0
    min_coverage: Share = 0.75

    def __post_init__(self) -> None:
        check_ranges(self)
        if not (math.isfinite(self.min_height) and self.min_height < self.max_height):
            raise ValueError(f"min_height must be below max_height (got {self.min_height}, {self.max_height})")
        if not self.range_min < self.range_max:
            raise ValueError(f"range_min must be below range_max (got {self.range_min}, {self.range_max})")
