"""Estimates the depth of the camera's panoramas (paper, section IV.B) that are requested, at a limited rate."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from instant_ic.bus import ERROR, LATCHED, OK, SENSOR, WARN, Node, NodeError, main
from instant_ic.config.ranges import Positive, PositiveInt, check_ranges
from instant_ic.depth.manifest import InferenceError, ManifestError
from instant_ic.depth.model import DEFAULT_MODEL, DepthModel
from instant_ic.depth.providers import CHOICES
from instant_ic.jpeg import JpegError
from instant_ic.limits import decode_rgb
from instant_ic.msg import CompressedImage, DepthModelInfo, Header, Image, header, image_message, stamp_ns

_WATCH_S = 0.5
_GIVE_UP_S = 10.0  # an inference still running this long after its cancellation hangs in a driver


@dataclass(frozen=True)
class DepthEstimatorConfig:
    """Parameters.

    Attributes:
        model: ONNX file or its manifest; a bare name is searched for in ``models/``.
        provider: execution provider; ``auto`` takes the first of TensorRT, CUDA and CPU that works.
        threads: CPU threads per inference.
        max_rate_hz: highest rate of estimates, per second; leaves CPU time to other nodes. Without any request, as in
            the replay of an older bag, this is the rate.
        max_age_s: age of an image at the end of its estimation, in seconds, above which the node warns.
        timeout_s: seconds after which an inference is cancelled and reported.
    """

    model: str = DEFAULT_MODEL
    provider: str = "auto"
    threads: PositiveInt = 1
    max_rate_hz: Positive = 2.0
    max_age_s: Positive = 1.5
    timeout_s: Positive = 20.0

    def __post_init__(self) -> None:
        if not self.model:
            raise ValueError("model must name a file")
        if self.provider not in CHOICES:
            raise ValueError(f"provider must be one of {', '.join(CHOICES)} (got {self.provider!r})")
        check_ranges(self)


class DepthEstimatorNode(Node[DepthEstimatorConfig]):
    """``/camera/image/compressed``, ``/depth/request`` → ``/depth/raw``, ``/depth/model``."""

    name = "depth_estimator"
    live_parameters = ("max_rate_hz", "max_age_s", "timeout_s")

    def setup(self) -> None:
        self.load(self.config.provider)
        self.newest: Any = None  # image
        self.last_ns: int | None = None
        self.wanted_ns = -math.inf  # images from this stamp on: all before the first request, then none without one
        self.began_ns = 0  # start of the running inference on the steady clock; 0 while none runs
        self.failures = 0
        self.depth = self.publisher("/depth/raw", Image, qos=SENSOR)
        self.info = self.publisher("/depth/model", DepthModelInfo, qos=LATCHED)
        self.publish_model()
        self.worker = self.background(self.estimate, self.on_result)
        self.subscribe("/camera/image/compressed", CompressedImage, self.on_image, qos=SENSOR)
        self.subscribe("/depth/request", Header, self.on_request, qos=LATCHED)
        self.timer(_WATCH_S, self.watch)

    def load(self, provider: str) -> None:
        """Load the model; report its provider and why a faster one is not used."""
        try:
            self.model = DepthModel.find(self.config.model, self.config.threads, provider)
        except (ManifestError, FileNotFoundError) as error:
            raise NodeError(str(error)) from error
        manifest = self.model.manifest
        why = f" ({'; '.join(self.model.notes)})" if self.model.notes else ""
        self.log.info(
            "%s (%s, %dx%d) on %s%s", manifest.name, manifest.output_kind, manifest.input_width, manifest.input_height,
            self.model.provider, why,
        )  # fmt: skip
        if provider not in ("auto", self.model.provider):
            self.log.warning("provider %s was requested, the model runs on %s%s", provider, self.model.provider, why)

    def publish_model(self) -> None:
        """Publish which kind of values ``/depth/raw`` carries, for the node that scales them."""
        manifest = self.model.manifest
        self.published_provider = self.model.provider
        info = DepthModelInfo(
            header=header("", self.clock.now_ns()), name=manifest.name, licence=manifest.licence,
            output_kind=manifest.output_kind, provider=self.model.provider,
        )  # fmt: skip
        self.info.publish(info)

    def on_image(self, message: Any) -> None:
        self.newest = message
        self.serve()

    def on_request(self, request: Any) -> None:
        stamp = stamp_ns(request)
        begun = self.last_ns is not None and 0 <= self.last_ns - stamp < 1e9 / self.config.max_rate_hz
        self.wanted_ns = math.inf if begun else stamp
        if self.newest is not None:
            self.serve()

    def serve(self) -> None:
        """Estimate the newest image if it is wanted, or wait for the next one."""
        # By the images' stamps, so that a replay picks the same ones; 5 % tolerance for the camera's jitter.
        stamp = stamp_ns(self.newest)
        early = self.last_ns is not None and 0 <= stamp - self.last_ns < 0.95e9 / self.config.max_rate_hz
        if early or stamp < self.wanted_ns:
            return
        self.last_ns = stamp
        if self.wanted_ns > -math.inf:
            self.wanted_ns = math.inf
        self.worker.submit(self.newest)

    def estimate(self, message: Any) -> tuple[Any, NDArray[np.float32] | None, str]:
        """Run on the worker's thread; return header, depth, and an error text if there is no depth."""
        manifest = self.model.manifest
        self.began_ns = self.clock.steady_ns()
        try:
            # Twice the network's input, so that the remaining reduction is by area averaging.
            rgb = decode_rgb(message.data, 2 * manifest.input_width, 2 * manifest.input_height)
            return message.header, self.model.estimate(rgb), ""
        except JpegError as error:
            return message.header, None, f"the image {error}"
        except ValueError as error:  # not a panorama, or (ManifestError) outputs that show only in a run
            return message.header, None, str(error)
        except InferenceError as error:
            if self.model.provider == "cpu":
                return message.header, None, str(error)
            self.load("cpu")
            return message.header, None, f"{error}; going on with the CPU"
        finally:
            self.began_ns = 0

    def watch(self) -> None:
        """Cancel an inference that takes too long; if it does not end, end the process for a restart."""
        if not (began_ns := self.began_ns):
            return
        took_s = (self.clock.steady_ns() - began_ns) / 1e9
        if took_s <= self.config.timeout_s:
            return
        self.diagnose(
            "depth", ERROR, f"the inference has run for {took_s:.1f} s on {self.model.provider}; it is cancelled"
        )
        self.model.cancel()
        if took_s > self.config.timeout_s + _GIVE_UP_S:
            self.log.error("the inference on %s hangs: the node ends for a restart", self.model.provider)
            self.stop()

    def on_result(self, result: tuple[Any, NDArray[np.float32] | None, str]) -> None:
        header, depth, reason = result
        if self.model.provider != self.published_provider:
            self.publish_model()
        if depth is None:
            self.failures += 1
            self.diagnose("depth", ERROR, reason, provider=self.model.provider, failures=self.failures)
            return
        stamp = stamp_ns(header)
        self.depth.publish(image_message(depth, "32FC1", header.frame_id, stamp))
        age_s = (self.clock.now_ns() - stamp) / 1e9
        level = WARN if age_s > self.config.max_age_s else OK
        self.diagnose(
            "depth", level, f"depth is {age_s:.2f} s old when it is published", age_s=round(age_s, 3),
            provider=self.model.provider, skipped=self.worker.skipped, failures=self.failures,
        )  # fmt: skip


if __name__ == "__main__":
    main(DepthEstimatorNode)
