"""Check that a camera's images show the present: they must neither repeat nor have a single colour."""

from __future__ import annotations

import numpy as np

from instant_ic.camera.source import Frame
from instant_ic.util.repeats import RepeatWatch

_EMPTY_BYTES = 0.05
"""Bytes per pixel below which an image may be empty; images of a place have several times as much."""
_EMPTY_SPREAD = 2.0
"""Largest standard deviation of each colour, 0 to 255, of an empty image, after reduction to an eighth of its size."""


class LiveImages:
    """Liveness of a device's images, taken one after the other.

    Attributes:
        fault: fault of the newest image and the remedy, as text; empty while the images are live.
        withheld: number of images that were not live.
    """

    def __init__(self) -> None:
        self.fault = ""
        self.withheld = 0
        self._repeats = RepeatWatch()

    def is_live(self, frame: Frame) -> bool:
        """Return whether an image may be shown; if not, set ``fault``."""
        if not self._repeats.is_new(frame.jpeg):
            self.fault = "the camera repeats the same image: restart the camera, or the program that feeds its device"
        elif _empty(frame):
            self.fault = "the camera's image is of one colour: uncover the lens, or restart the camera"
        else:
            self.fault = ""
            return True
        self.withheld += 1
        return False


def _empty(frame: Frame) -> bool:
    if len(frame.jpeg) > _EMPTY_BYTES * frame.width * frame.height:
        return False
    import cv2

    image = cv2.imdecode(np.frombuffer(frame.jpeg, np.uint8), cv2.IMREAD_REDUCED_COLOR_8)
    return image is None or float(image.reshape(-1, 3).std(axis=0).max()) < _EMPTY_SPREAD
