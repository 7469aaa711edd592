"""Choice of the images whose depth is computed, and of the time."""

from __future__ import annotations

from dataclasses import dataclass

KEEP_NS = 4_000_000_000
"""Largest time between kept images or revolutions and the newest image or open request, in nanoseconds."""
MAX_CLOUD_AGE_S = 0.3
"""Longest time between an image and the middle of its revolution. An image is held for this time, by the stamps."""
_REPEAT_NS = 2_000_000_000


@dataclass(frozen=True)
class HeldImage:
    """An image, taken at ``stamp_ns`` by the camera with the frame ``frame``."""

    frame: str
    stamp_ns: int


class RevolutionTrigger:
    """Choice of images at a limited rate. Each image is held until the revolution around it is complete."""

    def __init__(self) -> None:
        self._held: HeldImage | None = None

    def image(self, image: HeldImage, last_ns: int | None, max_rate_hz: float) -> HeldImage | None:
        """Hold a new image if it is due; return the held image if its revolution did not arrive.

        Args:
            image: the new image.
            last_ns: stamp of the newest depth; None before the first.
            max_rate_hz: highest rate by the images' stamps, with 1 % tolerance.
        """
        late = None
        if self._held is not None and abs(image.stamp_ns - self._held.stamp_ns) > MAX_CLOUD_AGE_S * 1e9:
            late, self._held = self._held, None
            last_ns = late.stamp_ns
        if self._held is None and (last_ns is None or not 0 <= image.stamp_ns - last_ns < 0.99e9 / max_rate_hz):
            self._held = image
        return late

    def revolution(self, middle_ns: int) -> HeldImage | None:
        """Return the held image if a revolution with this middle is the first after the image.

        The next revolution could not be nearer to the image.
        """
        if self._held is None or middle_ns < self._held.stamp_ns:
            return None
        image, self._held = self._held, None
        return image


class DepthRequests:
    """Requests for the network's depth of an image: one at a time, repeated until there is an answer.

    Attributes:
        since_ns: stamp of the first unanswered request's image; None if all requests were answered.
    """

    def __init__(self) -> None:
        self.since_ns: int | None = None
        self._newest_ns = 0

    def due(self, stamp_ns: int) -> bool:
        """Return whether to request the depth of this image; False while an answer is pending."""
        if self.since_ns is not None and 0 <= stamp_ns - self._newest_ns < _REPEAT_NS:
            return False
        if self.since_ns is None or stamp_ns < self.since_ns:
            self.since_ns = stamp_ns
        self._newest_ns = stamp_ns
        return True

    def answered(self) -> None:
        """Record that depth has arrived. Any depth counts, because a slow network may answer after a repetition."""
        self.since_ns = None
