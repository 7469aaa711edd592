"""Parameters of the VLP-16: decoding and the flat scan."""

import math
from dataclasses import dataclass
from typing import Annotated

from instant_ic.config.ranges import NotNegative, Positive, Range, Share, check_ranges


@dataclass(frozen=True)
class DecoderConfig:
    """From packets to revolutions.

    Attributes:
        cut_angle_deg: a revolution ends where the sensor passes this azimuth (clockwise from ahead), degrees.
        min_range: nearer returns are left out as too close, metres.
        max_range: farther returns are left out, metres.
    """

    cut_angle_deg: Annotated[float, Range(0, below=360)] = 180.0
    min_range: NotNegative = 0.4
    max_range: Annotated[float, Range(above=0, high=131.07)] = 130.0

    def __post_init__(self) -> None:
        """Check the values."""
        check_ranges(self)
        if not self.min_range < self.max_range:
            raise ValueError(f"min_range must be below max_range (got {self.min_range}, {self.max_range})")


@dataclass(frozen=True)
class FlatScanConfig:
    """From a revolution to one range a direction.

    Attributes:
        min_height: points lower than this above the ground (z of base_link) are no obstacles, metres.
        max_height: points higher than this are passed under, metres.
        beams: directions over 360 degrees.
        range_min: what the scan says of its nearest range, metres.
        range_max: farther points are left out of the scan, metres.
        min_coverage: a revolution that looked into a smaller share of the circle gives no scan, 0-1.
    """

    min_height: float = 0.10
    max_height: float = 1.30
    beams: Annotated[int, Range(4, 7200)] = 720
    range_min: NotNegative = 0.4
    range_max: Positive = 100.0
    min_coverage: Share = 0.75

    def __post_init__(self) -> None:
        """Check the values."""
        check_ranges(self)
        if not (math.isfinite(self.min_height) and self.min_height < self.max_height):
            raise ValueError(f"min_height must be below max_height (got {self.min_height}, {self.max_height})")
        if not self.range_min < self.range_max:
            raise ValueError(f"range_min must be below range_max (got {self.range_min}, {self.range_max})")
