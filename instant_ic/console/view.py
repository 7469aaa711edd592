"""The operator's look direction, and the shape of the views rendered for it."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Annotated

import numpy as np
from numpy.typing import NDArray

from instant_ic.config.ranges import Checked, Positive, Range
from instant_ic.geometry.poses import pose_matrix

MAX_FOV_RAD = math.radians(150)
FOV_MARGIN = 1.15
"""Requested over shown field of view: room to re-aim; a larger one gives coarser pixels."""
RESPONSE_TIMEOUT_S = 0.5
"""Time after which an unanswered request counts as lost, in seconds."""
PROBE = (64, 36)
"""Pixels of a view that is not shown: it keeps the expected PSNR in VspaceStatus up to date."""
PROBE_HZ = 1.0
"""Requests a second while no view is shown."""


@dataclass(frozen=True)
class ViewConfig(Checked):
    """Requests for rendered views.

    Attributes:
        width: width * height is the number of pixels of a rendered view; its shape follows the driver's window.
        height: see width.
        virtual_rate_hz: requests a second while rendered views are shown (one outstanding at a time).
    """

    width: Annotated[int, Range(16, 4096)] = 320
    height: Annotated[int, Range(16, 4096)] = 180
    virtual_rate_hz: Positive = 10.0


@dataclass(frozen=True)
class Look:
    """Look direction relative to the robot's heading, and the shown field of view, in radians.

    Yaw is positive to the left (counter-clockwise), pitch is positive upwards.
    """

    yaw: float = 0.0
    pitch: float = 0.0
    hfov: float = math.radians(90)
    vfov: float = math.radians(58.7)

    def rotation(self) -> NDArray[np.float64]:
        """Return camera_from_look (4, 4): x along the line of sight, y left, z up."""
        # In x-forward, y-left axes a positive turn about y lowers the line of sight.
        return pose_matrix(0.0, 0.0, 0.0, 0.0, -self.pitch, self.yaw)


@dataclass(frozen=True)
class ViewShape:
    """Horizontal field of view (rad) and size (pixels) of a requested view."""

    fov_rad: float
    width: int
    height: int


def view_shape(look: Look, config: ViewConfig) -> ViewShape:
    """Return the shape of a view that covers ``look`` with the margin, in the window's aspect ratio.

    The number of pixels follows the configuration for any window shape, because it determines the render time.
    Width and height are multiples of 8.
    """
    half_width = math.tan(min(look.hfov * FOV_MARGIN, MAX_FOV_RAD) / 2)
    half_height = math.tan(min(look.vfov * FOV_MARGIN, MAX_FOV_RAD) / 2)
    aspect = min(max(half_width / half_height, 0.5), 2.5)
    pixels = config.width * config.height
    width = max(16, 8 * round(math.sqrt(pixels * aspect) / 8))
    height = max(16, 8 * round(math.sqrt(pixels / aspect) / 8))
    # If the aspect ratio was clamped or rounded, the larger field of view wins.
    fov = 2 * math.atan(max(half_width, half_height * width / height))
    return ViewShape(fov, width, height)
