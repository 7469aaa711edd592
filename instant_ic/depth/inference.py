"""Inference of a depth model on encoded images, with a time-out and a fallback to the CPU."""

from __future__ import annotations

import logging
import threading
from collections.abc import Callable
from concurrent.futures import Future, wait
from typing import TypeVar

import numpy as np
from numpy.typing import NDArray

from instant_ic.depth.manifest import InferenceError
from instant_ic.depth.model import DepthModel
from instant_ic.util.jpeg import JpegError
from instant_ic.util.limits import decode_rgb

Result = TypeVar("Result")
Floats = NDArray[np.float32]

_CANCELLATIONS = 20
_GIVE_UP_S = 10.0  # an inference that runs this long after its cancellation hangs in a driver
logger = logging.getLogger("instant_ic.depth")


class Inference:
    """A depth model that answers within a time-out.

    Args:
        name, provider, threads: as in ``DepthModel.find``.
        on_hang: called if an inference does not end after its cancellation, because only a new process helps then.
        timeout_s: time after which an inference is cancelled; may be changed at any time.

    Raises:
        ManifestError, FileNotFoundError: the model cannot be used.
    """

    def __init__(
        self, name: str, provider: str, threads: int, on_hang: Callable[[], None], timeout_s: float = 20.0
    ) -> None:
        self._name, self._threads, self._on_hang = name, threads, on_hang
        self.timeout_s = timeout_s
        self._load(provider)

    def _load(self, provider: str) -> None:
        """Load the model, and log its provider."""
        self.model = model = DepthModel.find(self._name, self._threads, provider)
        manifest = model.manifest
        kind = f"{manifest.output_kind}, {manifest.input_width}x{manifest.input_height}"
        logger.info("%s (%s) on %s", manifest.name, kind, model.provider)
        if provider not in ("auto", model.provider):
            why = "see onnxruntime's messages, or: pip install onnxruntime-gpu instead of onnxruntime"
            logger.warning("provider %s was requested, but the model runs on %s (%s)", provider, model.provider, why)

    def estimate(self, image: bytes | NDArray[np.uint8]) -> Floats:
        """Return ``DepthModel.estimate`` of an encoded panorama.

        Raises:
            InferenceError: the image cannot be decoded, or the inference failed or timed out.
            ValueError: the image is not a panorama, or the model's outputs do not match its manifest.
        """
        return self._run(image, lambda rgb: self.model.estimate(rgb))

    def complete(self, image: bytes | NDArray[np.uint8], prior: Floats) -> tuple[Floats, Floats]:
        """Return ``DepthModel.complete`` of an encoded panorama. Raises the same errors as :meth:`estimate`."""
        return self._run(image, lambda rgb: self.model.complete(rgb, prior))

    def _run(self, image: bytes | NDArray[np.uint8], work: Callable[[NDArray[np.uint8]], Result]) -> Result:
        manifest = self.model.manifest
        try:
            # Decode at twice the network's size, so that the rest of the reduction is area averaging.
            rgb = decode_rgb(image, 2 * manifest.input_width, 2 * manifest.input_height)
        except JpegError as error:
            raise InferenceError(f"the image {error}") from error
        try:
            return self._within_timeout(lambda: work(rgb))
        except InferenceError as error:
            if self.model.provider == "cpu":
                raise
            self._load("cpu")
            raise InferenceError(f"{error}; the CPU is used from now on") from error

    def _within_timeout(self, work: Callable[[], Result]) -> Result:
        model, future = self.model, Future[Result]()

        def run() -> None:
            try:
                future.set_result(work())
            except Exception as error:  # noqa: BLE001 - raised again in the caller's thread
                future.set_exception(error)

        threading.Thread(target=run, name="inference", daemon=True).start()
        timeout_s = self.timeout_s
        try:
            return future.result(timeout_s)
        except TimeoutError:
            pass
        for _ in range(_CANCELLATIONS):
            model.cancel()  # repeated, because onnxruntime ignores it before the first layer and between layers
            if wait([future], _GIVE_UP_S / _CANCELLATIONS).done:
                break
        else:
            logger.error("the inference on %s hangs; the node ends so that it is restarted", model.provider)
            self._on_hang()
        raise InferenceError(f"the inference took longer than {timeout_s:g} s on {model.provider} and was cancelled")
