"""Requests for views of the virtual space: look direction of the operator, shape of the view, and time of requests."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from typing import Annotated

from instant_ic.config.ranges import Checked, Positive, Range
from instant_ic.geometry.poses import Matrix, pose_matrix

MAX_FOV_RAD = math.radians(150)
FOV_MARGIN = 1.15
"""Ratio of requested to shown field of view, as a margin for re-aiming; a larger ratio gives coarser pixels."""
RESPONSE_TIMEOUT_S = 0.5
"""Time after which an unanswered request counts as lost, in seconds."""
PROBE = (64, 36)
"""Size in pixels of a view that is not shown, but keeps the expected PSNR in VspaceStatus up to date."""
PROBE_HZ = 1.0
"""Requests per second while no view is shown."""
_MOST_PENDING = 8


@dataclass(frozen=True)
class ViewConfig(Checked):
    """Requests for rendered views.

    Attributes:
        width: width * height is the number of pixels of a rendered view; its shape follows the driver's window.
        height: see width.
        virtual_rate_hz: requests per second while rendered views are shown, one at a time.
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

    def rotation(self) -> Matrix:
        """Return camera_from_look (4, 4): x along the line of sight, y left, z up."""
        # With x forward and y left, a positive rotation about y lowers the line of sight.
        return pose_matrix(0.0, 0.0, 0.0, 0.0, -self.pitch, self.yaw)


def view_shape(look: Look, config: ViewConfig) -> tuple[float, int, int]:
    """Return field of view (rad), width and height of a view that covers ``look`` with the margin.

    The number of pixels is that of the configuration for any window shape, because it determines the render time.
    Width and height are multiples of 8.
    """
    half_width = math.tan(min(look.hfov * FOV_MARGIN, MAX_FOV_RAD) / 2)
    half_height = math.tan(min(look.vfov * FOV_MARGIN, MAX_FOV_RAD) / 2)
    aspect = min(max(half_width / half_height, 0.5), 2.5)
    pixels = config.width * config.height
    width = max(16, 8 * round(math.sqrt(pixels * aspect) / 8))
    height = max(16, 8 * round(math.sqrt(pixels / aspect) / 8))
    # If the aspect ratio was clamped or rounded, the larger field of view counts.
    fov = 2 * math.atan(max(half_width, half_height * width / height))
    return fov, width, height


class ViewSchedule:
    """Schedule of requests for views. One request is outstanding at a time; the next follows its answer or time-out.

    Views are shown while a page needs them. Otherwise small views are requested for the expected PSNR.

    Attributes:
        config: rate and size; may be replaced at any time.
        look: the driver's look direction.
    """

    def __init__(self, config: ViewConfig) -> None:
        self.config = config
        self.look = Look()
        self._newest, self._outstanding, self._asked_ns = 0, False, -math.inf
        self._sent_ns: dict[int, int | None] = {}  # recent requests: id → send time (steady ns); None: not shown

    def is_due(self, shown: bool, now_ns: int) -> bool:
        """Return whether to request a view now (steady clock), which is ``shown`` or serves only the expected PSNR."""
        since_s = (now_ns - self._asked_ns) / 1e9
        if self._outstanding and since_s < RESPONSE_TIMEOUT_S:
            return False
        return since_s >= 1.0 / (self.config.virtual_rate_hz if shown else PROBE_HZ) - 0.001

    def next(self, needed: bool, now_ns: int) -> tuple[int, tuple[float, int, int]]:
        """Return id and shape of the next request. ``needed`` is true if a page shows rendered views."""
        self._newest = self._newest % (2**32 - 1) + 1  # uint32 in ViewRequest; 0 stays unused
        self._outstanding, self._asked_ns = True, now_ns
        self._sent_ns[self._newest] = now_ns if needed else None
        while len(self._sent_ns) > _MOST_PENDING:
            del self._sent_ns[next(iter(self._sent_ns))]
        size = self.config if needed else replace(self.config, width=PROBE[0], height=PROBE[1])
        return self._newest, view_shape(self.look, size)

    def answered(self, request_id: int, now_ns: int) -> float | None:
        """Record an answer; return its delay in seconds, or None for a view that is not shown.

        Answers after the time-out count too, because the delay of a slow renderer matters most.
        """
        if request_id == self._newest:
            self._outstanding = False
        sent_ns = self._sent_ns.get(request_id, now_ns)
        return None if sent_ns is None else (now_ns - sent_ns) / 1e9
