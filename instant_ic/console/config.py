"""Parameters of the console."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Annotated, Any

from instant_ic.config.ranges import Checked, Positive, PositiveInt, Range
from instant_ic.config.robot import CAMERA_MOUNT, MotionLimits, Mount, Rectangle
from instant_ic.console.access import AccessConfig
from instant_ic.console.drive import DriveConfig
from instant_ic.console.view import ViewConfig


@dataclass(frozen=True)
class ConsoleServerConfig(Checked):
    """Address, limits and access of the server.

    Attributes:
        host: listen address; an address other than loopback, such as 0.0.0.0, opens the page to the network.
        port: port of the page; 0: any free port, which the log states.
        allowed_hosts: host names by which browsers may reach the page, besides localhost and IP addresses.
        max_clients: largest number of pages; two places are reserved for pages that may drive.
        max_connections: largest number of connections; at the limit, the address with the most idle connections loses
            its oldest.
        max_connections_per_address: largest number of connections of one address (IPv6: one /64).
        max_messages_per_s: largest rate of messages from the driver's page, with bursts of twice this number; 0.4 of it
            for other pages. The WebSocket of a page above it is closed.
        background_picture_hz: rate of images that are not shown, such as the camera's while in the virtual space.
        access: sign-in and TLS.
        drive: speed limits and time-outs.
    """

    host: str = "127.0.0.1"
    port: Annotated[int, Range(0, 65535)] = 8080
    allowed_hosts: tuple[str, ...] = ()
    max_clients: PositiveInt = 16
    max_connections: PositiveInt = 128
    max_connections_per_address: PositiveInt = 32
    max_messages_per_s: Positive = 300.0
    background_picture_hz: Positive = 2.0
    access: AccessConfig = field(default_factory=AccessConfig)
    drive: DriveConfig = field(default_factory=DriveConfig)


@dataclass(frozen=True)
class ConsoleConfig(Checked):
    """Parameters of the node ``console``.

    Attributes:
        map_rate_hz: highest rate at which a changed map or costmap is sent to the page.
        dissolve_ms: duration of the dissolve between camera image and rendered view; 0: cut.
        ease_ms: time in which the remaining offset between the two robots' poses is eased out of the image; 0: at once.
        colour_release_s: time in which the new image at a switch returns from the old image's colours to its own; 0: no
            colour matching.
        recorder: node behind the page's record, snapshot and bookmark buttons.
    """

    server: ConsoleServerConfig = field(default_factory=ConsoleServerConfig)
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
        """Return the values that the page receives in ``hello``."""
        return {
            "dissolve_ms": self.dissolve_ms,
            "ease_ms": self.ease_ms,
            "colour_release_s": self.colour_release_s,
            "max_accel": [self.limits.max_linear_accel_m_s2, self.limits.max_angular_accel_rad_s2],
            "footprint": [self.footprint.length_m, self.footprint.width_m],
            "camera": [0.0, 0.0, self.camera_mount.xyz[2]],
        }
