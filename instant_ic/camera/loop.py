"""Thread that connects to a camera, reads it, and reconnects with growing waits."""

import threading
import time
from collections.abc import Callable

from instant_ic.camera.source import Camera, CameraError, Frame
from instant_ic.util.reconnect import Backoff


class CameraLoop(threading.Thread):
    """Thread that reads a camera until `end`."""

    def __init__(
        self,
        camera: Camera,
        on_frame: Callable[[Frame], None],
        on_event: Callable[[bool, str], None],
        backoff: Backoff | None = None,
    ) -> None:
        """Create the thread without starting it.

        Args:
            camera: used by this thread only.
            on_frame: called on this thread with each image.
            on_event: called on this thread when the connection opens (True) or ends (False), with a text.
            backoff: waits between attempts.
        """
        super().__init__(name="camera", daemon=True)
        self._camera = camera
        self._on_frame = on_frame
        self._on_event = on_event
        self._backoff = backoff or Backoff(0.25, 2.0)
        self._end = threading.Event()

    def run(self) -> None:
        try:
            while not self._end.is_set():
                try:
                    self._on_event(True, self._camera.connect())
                    while not self._end.is_set():
                        frame = self._camera.read()
                        # Only an image proves that the connection works.
                        self._backoff.succeed()
                        self._on_frame(frame)
                except Exception as error:  # noqa: BLE001 - nothing else reports an exception of this thread
                    if self._end.is_set():
                        break
                    wait_s = self._backoff.fail(time.monotonic())
                    text = str(error) if isinstance(error, CameraError) else f"unexpected {error!r}"
                    self._on_event(False, f"{text.rstrip('.')}. Reconnecting in {wait_s:g} s")
                    self._end.wait(wait_s)
        finally:
            self._camera.close()

    def end(self, timeout_s: float = 3.0) -> bool:
        """Stop reading; return False if the thread does not end in time."""
        self._end.set()
        self._camera.cancelled.set()
        if self.is_alive():
            self.join(timeout_s)
        return not self.is_alive()
