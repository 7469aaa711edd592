"""Interfaces between the page's server and the rest of the station."""

from __future__ import annotations

from typing import Any

from instant_ic.console.layers import PageLayers
from instant_ic.console.protocol import FrameKind
from instant_ic.console.view import Look


class ConsoleBackend:
    """Handler of the operators' actions; by default the actions have no effect.

    Every method is called on the server's thread and must return at once.
    """

    def on_drive(self, linear: float, angular: float) -> None:
        """Publish a command in m/s and rad/s; called at 20 Hz while driving, and with zeros for an idle driver."""

    def on_operator(self, there: bool) -> None:
        """Record whether a driver is present. A silent, hidden or closed page, or a returned lease, means absent."""

    def on_released(self, client: str) -> None:
        """Give the robot's lease back for a client that drove (``DriveService.client``)."""

    def on_estop(self, stop: bool) -> None:
        """Publish an emergency stop set by any client (True) or released by the driver (False)."""

    def on_look(self, look: Look) -> None:
        """Use a new look direction and field of view of the driver."""

    def on_recorder(self, command: str, on: bool) -> None:
        """Start or stop a recording (``record``, ``on``), save the last minute (``snapshot``) or set a ``bookmark``."""

    def on_watched(self, watched: bool) -> None:
        """Record that the first page has connected (True) or the last page has gone (False)."""

    def on_drawn(self) -> None:
        """Handle a change of ``ConsoleServer.drawn_ms``."""


class PageServer:
    """Receiver of everything that is sent to pages. This base class shows nothing."""

    @property
    def plain_http(self) -> bool:
        """True if token, cookie and commands are sent over the network without encryption."""
        return False

    def now_ms(self) -> float:
        """Return the server's time in milliseconds."""
        return 0.0

    def needs_views(self) -> bool:
        """Return whether there is a page that does not render the virtual space by itself."""
        return True

    def drawn_ms(self) -> float | None:
        """Return the time of the newest state that the driver's page has rendered by itself, or None."""
        return None

    def show(self, *kinds: FrameKind) -> None:
        """Set which of PANORAMA and VIEW the page shows or soon will show. The other is sent at a low rate."""

    def follow_robot(self, holder: str | None, estop: bool = False) -> None:
        """Follow the robot's lease holder (empty: nobody; None: no robot reports) and its emergency stop."""

    def publish(self, kind: str, message: dict[str, Any]) -> None:
        """Send a text message of type ``kind`` to every page. It replaces a pending message of the same kind."""

    def send_frame(self, kind: FrameKind, header: dict[str, Any], payload: bytes) -> None:
        """Send an image or map (JPEG or PNG) to every page. It replaces a pending frame of the same kind."""

    def send_layers(self, layers: PageLayers) -> None:
        """Send a checked version of the virtual space to every page. It replaces a pending version."""
