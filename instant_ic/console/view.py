"""Where the operator looks, and which rendered view to ask for next."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Annotated

import numpy as np
from numpy.typing import NDArray

from instant_ic.geometry.poses import pose_matrix

from ..ranges import NotNegative, Positive, Range, check_ranges

MAX_FOV_RAD = math.radians(150)


@dataclass(frozen=True)
class ViewConfig:
    """Rendered views that the console asks for."""

    width: Annotated[int, Range(16, 4096)] = 320  # with height: number of pixels; the shape is the window's
    height: Annotated[int, Range(16, 4096)] = 180
    fov_margin: Annotated[float, Range(1, 2)] = 1.15  # asked field of view over the shown one, to be re-aimed
    virtual_rate_hz: Positive = 10.0  # while the virtual space is shown
    real_rate_hz: NotNegative = 1.0  # while the camera is shown, to keep the renderer warm; 0 = none
    response_timeout_s: Positive = 0.5  # a request without an answer counts as lost after this

    def __post_init__(self) -> None:
        check_ranges(self)


@dataclass(frozen=True)
class Look:
    """Look direction relative to the robot's heading, and the shown field of view.

    Yaw is counter-clockwise (left positive), pitch is up positive; radians.
    """

    yaw: float = 0.0
    pitch: float = 0.0
    hfov: float = math.radians(90)
    vfov: float = math.radians(58.7)

    def rotation(self) -> NDArray[np.float64]:
        """camera_from_look as a 4x4 pose: x along the line of sight, y left, z up."""
        # In x-forward, y-left axes a positive turn about y lowers the line of sight.
        return pose_matrix(0.0, 0.0, 0.0, 0.0, -self.pitch, self.yaw)


@dataclass(frozen=True)
class ViewShape:
    """Horizontal field of view (rad) and size (pixels) of a view to be asked for."""

    fov_rad: float
    width: int
    height: int


def view_shape(look: Look, config: ViewConfig) -> ViewShape:
    """Shape of the view that covers ``look`` with the margin, in the operator's aspect ratio.

    The number of pixels stays that of the configuration, whatever the window's shape, because it
    sets the renderer's time. Sizes are multiples of 8.
    """
    half_width = math.tan(min(look.hfov * config.fov_margin, MAX_FOV_RAD) / 2)
    half_height = math.tan(min(look.vfov * config.fov_margin, MAX_FOV_RAD) / 2)
    aspect = min(max(half_width / half_height, 0.5), 2.5)
    pixels = config.width * config.height
    width = max(16, 8 * round(math.sqrt(pixels * aspect) / 8))
    height = max(16, 8 * round(math.sqrt(pixels / aspect) / 8))
    # Where the aspect was clamped or rounded, the wider need decides.
    fov = 2 * math.atan(max(half_width, half_height * width / height))
    return ViewShape(fov, width, height)


class ViewScheduler:
    """One request outstanding; the next after the answer or the time-out, at the rate of the mode."""

    def __init__(self, config: ViewConfig) -> None:
        self.config = config
        self.lost = 0
        self._next_id = 1
        self._outstanding: int | None = None
        self._asked_s = -math.inf

    def due(self, now_s: float, *, virtual: bool) -> bool:
        """Whether a request should go out now."""
        if self._outstanding is not None:
            if now_s - self._asked_s < self.config.response_timeout_s:
                return False
            self.lost += 1
            self._outstanding = None
        rate = self.config.virtual_rate_hz if virtual else self.config.real_rate_hz
        return rate > 0 and now_s - self._asked_s >= 1.0 / rate - 0.001

    def asked(self, now_s: float) -> int:
        """Notes a request made now; returns its id."""
        self._outstanding = self._next_id
        self._next_id = self._next_id % (2**32 - 1) + 1  # uint32 in ViewRequest; 0 stays unused
        self._asked_s = now_s
        return self._outstanding

    def answered(self, request_id: int) -> bool:
        """Notes an answer; True when it is the one that was waited for."""
        if request_id != self._outstanding:
            return False
        self._outstanding = None
        return True
