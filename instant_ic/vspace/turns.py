"""Who has the device next: pictures or training."""

from __future__ import annotations

LEAST_SHARE = 0.25
"""Training's time against a picture's where pictures alone take longer than the rate allows: it must not starve."""


class Turns:
    """Pictures and training by turns on one device, so that a rate of pictures is held.

    Args:
        render_fps: pictures a second that are held where they are asked for; training gets the time that is left.
        train_ms_per_frame: of training at a stretch, at most: a picture that is asked for waits no longer.
    """

    def __init__(self, render_fps: float, train_ms_per_frame: float) -> None:
        self.render_fps = render_fps
        self.train_ms_per_frame = train_ms_per_frame
        self._drew_last = False
        self._render_ms = 0.0

    def draws_next(self, asked: bool, trains: bool) -> bool:
        """Whether a picture is next, if one is ``asked`` for: not before training had its turn, if it ``trains``."""
        return asked and not (trains and self._drew_last)

    def drew(self, render_ms: float) -> None:
        """A picture has been drawn and took so long."""
        self._drew_last, self._render_ms = True, render_ms

    def budget_ms(self) -> float:
        """Training's next turn, which begins now: what a picture leaves of its time, no more than is allowed.

        Where nobody asks for pictures one turn follows the other.
        """
        left = 1e3 / self.render_fps - self._render_ms if self._drew_last else self.train_ms_per_frame
        self._drew_last = False
        return min(self.train_ms_per_frame, max(left, LEAST_SHARE * self._render_ms))
