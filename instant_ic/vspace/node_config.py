"""Parameters of the node ``nerf``."""

from __future__ import annotations

import dataclasses
from dataclasses import dataclass
from typing import Annotated

from instant_ic.config.ranges import Percent, Positive, PositiveInt, Range, check_ranges
from instant_ic.vspace.config import VirtualSpaceConfig


@dataclass(frozen=True)
class NerfConfig:
    """Parameters.

    Attributes:
        render_fps: target frame rate of requested views; training gets the remaining time.
        train_ms_per_frame: longest uninterrupted training in ms, and so the longest wait of a requested view. While no
            view is requested, training has all the time.
        max_view_pixels: largest view that may be requested; larger requests are refused.
        jpeg_quality: JPEG quality of views, 1 to 100.
        robot_mask: image, twice as wide as high, white where the panorama shows the robot itself or its stand (see also
            ``space.geometry.body_below_deg``); empty: no mask.
        space: the virtual space itself.
    """

    render_fps: Annotated[float, Range(0.5, 120)] = 10.0
    train_ms_per_frame: Positive = 50.0
    max_view_pixels: PositiveInt = 1280 * 720
    jpeg_quality: Percent = 85
    robot_mask: str = ""
    space: VirtualSpaceConfig = dataclasses.field(default_factory=VirtualSpaceConfig)

    def __post_init__(self) -> None:
        check_ranges(self)
