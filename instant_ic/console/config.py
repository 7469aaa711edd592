"""Parameters of the console."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Annotated, Any

from instant_ic.config.ranges import Checked, Positive, Range
from instant_ic.config.robot import CAMERA_MOUNT, MotionLimits, Mount, Rectangle
from instant_ic.console.server import ServerConfig
from instant_ic.console.view import ViewConfig


@dataclass(frozen=True)
class ConsoleConfig(Checked):
    """Parameters.

    Attributes:
        map_rate_hz: highest rate at which a changed map or costmap is sent to the page.
        dissolve_ms: duration of the dissolve between camera and rendered view; 0 = cut.
        ease_ms: time in which the remaining offset between the two robots' poses is eased out of the image; 0 = at
            once.
        colour_release_s: the new image at a switch takes the colours of the old one and returns to its own in this
            time; 0 = no colour matching.
        recorder: node behind the page's record, snapshot and bookmark buttons.
    """

    server: ServerConfig = field(default_factory=ServerConfig)
    view: ViewConfig = field(default_factory=ViewConfig)
    map_rate_hz: Positive = 2.0
    dissolve_ms: Annotated[float, Range(0, 5000)] = 250.0
    ease_ms: Annotated[float, Range(0, 5000)] = 400.0
    colour_release_s: Annotated[float, Range(0, 60)] = 6.0
    footprint: Rectangle = field(default_factory=Rectangle)
    limits: MotionLimits = field(default_factory=MotionLimits)
    camera_mount: Mount = CAMERA_MOUNT
    recorder: str = "operator_recorder"

    def page(self) -> dict[str, Any]:
        """Return the values that the page gets in ``hello``."""
        return {
            "dissolve_ms": self.dissolve_ms,
            "ease_ms": self.ease_ms,
            "colour_release_s": self.colour_release_s,
            "max_accel": [self.limits.max_linear_accel_m_s2, self.limits.max_angular_accel_rad_s2],
            "footprint": [self.footprint.length_m, self.footprint.width_m],
            "camera": [0.0, 0.0, self.camera_mount.xyz[2]],
        }
