"""Interface between the page's server and the rest of the station."""

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

    def on_record(self, on: bool) -> None:
        """Start or stop a recording."""

    def on_snapshot(self) -> None:
        """Save the last minute."""

    def on_bookmark(self) -> None:
        """Set a bookmark at the present moment."""

    def on_watched(self, watched: bool) -> None:
        """Note that the first page has come (True) or the last one has gone (False)."""

    def on_renders(self) -> None:
        """Note that a page can render the virtual space by itself; called once for each page."""

    def on_drawn(self) -> None:
        """Note that ``ConsoleServer.drawn_ms`` has changed."""
