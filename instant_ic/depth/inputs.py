"""Images and LiDAR revolutions of the last seconds: which of them belong together."""

from __future__ import annotations

from collections import deque
from dataclasses import dataclass
from typing import Any

from instant_ic.lidar.deskew import TimedPoints

KEEP_NS = 4_000_000_000
"""Images and revolutions that differ more from the newest depth are discarded."""
MAX_CLOUD_AGE_S = 0.3
"""Largest difference between an image and the middle of its revolution; so long, by the stamps, an image is held."""
_MAX_IMAGES = 150
_MAX_REVOLUTIONS = 40
_REPEAT_NS = 2_000_000_000


class RecentInputs:
    """Images by their stamp, and revolutions."""

    def __init__(self) -> None:
        self.images: dict[int, Any] = {}
        self.revolutions: deque[TimedPoints] = deque(maxlen=_MAX_REVOLUTIONS)

    def add_image(self, stamp_ns: int, image: Any) -> None:
        """Keep an image; the oldest one goes when there are too many."""
        self.images[stamp_ns] = image
        if len(self.images) > _MAX_IMAGES:
            del self.images[next(iter(self.images))]

    def nearest_revolution(self, stamp_ns: int) -> TimedPoints | None:
        """Return the revolution whose middle is nearest in time; None if none is within ``MAX_CLOUD_AGE_S``."""

        def gap_ns(revolution: TimedPoints) -> int:
            return abs(revolution.middle_ns - stamp_ns)

        found = min((one for one in self.revolutions if len(one.time_s)), key=gap_ns, default=None)
        return found if found is not None and gap_ns(found) / 1e9 <= MAX_CLOUD_AGE_S else None

    def discard(self, stamp_ns: int) -> None:
        """Discard what lies more than ``KEEP_NS`` from a time, also ahead of it: the clock may have gone back."""
        for old in [other for other in self.images if abs(other - stamp_ns) > KEEP_NS]:
            del self.images[old]
        while self.revolutions and abs(self.revolutions[0].stamp_ns - stamp_ns) > KEEP_NS:
            self.revolutions.popleft()


@dataclass(frozen=True)
class HeldImage:
    """An image of the camera frame ``frame``, taken at ``stamp_ns``."""

    frame: str
    stamp_ns: int


class RevolutionTrigger:
    """Chooses images at a limited rate and holds each one until the revolution around it is complete."""

    def __init__(self) -> None:
        self._held: HeldImage | None = None

    def image(self, image: HeldImage, last_ns: int | None, max_rate_hz: float) -> HeldImage | None:
        """Take a new image; returns a held one for which no revolution arrived.

        Args:
            image: the new one.
            last_ns: stamp of the newest depth; None before the first.
            max_rate_hz: rate by the images' stamps, with 1 % tolerance.
        """
        late = None
        if self._held is not None and abs(image.stamp_ns - self._held.stamp_ns) > MAX_CLOUD_AGE_S * 1e9:
            late, self._held = self._held, None
            last_ns = late.stamp_ns
        if self._held is None and (last_ns is None or not 0 <= image.stamp_ns - last_ns < 0.99e9 / max_rate_hz):
            self._held = image
        return late

    def revolution(self, middle_ns: int) -> HeldImage | None:
        """Return the held image if a revolution with this middle completes it.

        A later revolution would be nearer only if the image was taken in the second half of its period.
        """
        if self._held is None or middle_ns < self._held.stamp_ns:
            return None
        image, self._held = self._held, None
        return image

    def clear(self) -> None:
        """Drop the held image."""
        self._held = None


class DepthRequests:
    """Requests for the network's depth of an image: one at a time, repeated until there is an answer.

    Attributes:
        since_ns: stamp of the first image that was requested without an answer; None when there is none.
    """

    def __init__(self) -> None:
        self.since_ns: int | None = None
        self._newest_ns = 0

    def due(self, stamp_ns: int) -> bool:
        """Return whether to request the depth of this image, or to wait for the answer to an earlier request."""
        if self.since_ns is not None and 0 <= stamp_ns - self._newest_ns < _REPEAT_NS:
            return False
        if self.since_ns is None or stamp_ns < self.since_ns:
            self.since_ns = stamp_ns
        self._newest_ns = stamp_ns
        return True

    def answered(self) -> None:
        """Note that depth has arrived; any depth is the answer, because a slow network answers after the repetition."""
        self.since_ns = None
