"""Interfaces between the page's server and the rest of the station."""

from __future__ import annotations

from typing import Any

from instant_ic.console.layers import PageLayers
from instant_ic.console.protocol import FrameKind
from instant_ic.console.view import Look


class ConsoleBackend:
    """Handler of the operators' actions; by default they have no effect.

    Every method is called on the server's thread and must return at once.
    """

    def on_drive(self, linear: float, angular: float) -> None:
        """Publish a command, m/s and rad/s: at 20 Hz while driving, zeros while the driver is present and idle."""

    def on_operator(self, there: bool) -> None:
        """Note that a driver is present, or lost: his page is silent, hidden or closed, or he gave the lease back."""

    def on_released(self, client: str) -> None:
        """Give the robot's lease back in the name of a client that drove (``DriveService.client``)."""

    def on_estop(self, stop: bool) -> None:
        """Publish an emergency stop set by any client (True) or released by the driver (False)."""

    def on_look(self, look: Look) -> None:
        """Take the new look direction and field of view of the driver."""

    def on_recorder(self, command: str, on: bool) -> None:
        """Start or stop a recording (``record``, ``on``), save the last minute (``snapshot``) or set a ``bookmark``."""

    def on_watched(self, watched: bool) -> None:
        """Note that the first page has come (True) or the last one has gone (False)."""

    def on_drawn(self) -> None:
        """Note that ``ConsoleServer.drawn_ms`` has changed."""


class PageServer:
    """Receiver of everything that is sent to pages. This one has a page that shows nothing."""

    @property
    def plain_http(self) -> bool:
        """True if token, cookie and commands go over the network unencrypted."""
        return False

    def now_ms(self) -> float:
        """Return the server's time in milliseconds."""
        return 0.0

    def needs_views(self) -> bool:
        """Return whether a page does not render the virtual space by itself."""
        return True

    def drawn_ms(self) -> float | None:
        """Return the time of the newest state that the driver's page has rendered by itself, or None."""
        return None

    def show(self, *kinds: FrameKind) -> None:
        """Set which of PANORAMA and VIEW the page shows or soon will; the other is sent at a low rate."""

    def follow_robot(self, holder: str | None, estop: bool = False) -> None:
        """Take over who has the robot's lease (empty: nobody) and its emergency stop; None: no robot reports."""

    def publish(self, kind: str, message: dict[str, Any]) -> None:
        """Send a text message of type ``kind`` to every page; it replaces a pending one of this kind."""

    def send_frame(self, kind: FrameKind, header: dict[str, Any], payload: bytes) -> None:
        """Send an image or map (JPEG or PNG) to every page; it replaces a pending one of this kind."""

    def send_layers(self, layers: PageLayers) -> None:
        """Send a version of the virtual space, which is checked already, to every page; it replaces a pending one."""
