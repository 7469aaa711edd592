"""Estimates the depth of requested camera panoramas at a limited rate (paper, section IV.B)."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from instant_ic.bus import ERROR, LATCHED, OK, SENSOR, WARN, Node, NodeError, main
from instant_ic.config.ranges import Positive, PositiveInt, check_ranges
from instant_ic.depth.inference import Inference
from instant_ic.depth.manifest import InferenceError, ManifestError
from instant_ic.depth.model import DEFAULT_MODEL
from instant_ic.depth.providers import CHOICES
from instant_ic.msg import CompressedImage, DepthModelInfo, Header, Image, header, image_message, stamp_ns


@dataclass(frozen=True)
class DepthEstimatorConfig:
    """Parameters.

    Attributes:
        model: ONNX file or its manifest; a bare name is searched for in ``models/``.
        provider: execution provider; ``auto`` takes the first of TensorRT, CUDA and CPU that works.
        threads: number of CPU threads per inference.
        max_rate_hz: highest rate of estimates per second, which leaves CPU time to other nodes. Without any request, as
            in the replay of an older bag, images are estimated at this rate.
        max_age_s: age of an image at the end of its estimation above which the node warns, in seconds.
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
        config = self.config
        try:
            self.inference = Inference(config.model, config.provider, config.threads, self.stop, config.timeout_s)
        except (ManifestError, FileNotFoundError) as error:
            raise NodeError(str(error)) from error
        self.newest: Any = None  # newest image
        self.last_ns: int | None = None
        self.wanted_ns = -math.inf  # images from this stamp on are wanted; -inf before any request, inf without one
        self.failures = 0
        self.depth = self.publisher("/depth/raw", Image, qos=SENSOR)
        self.info = self.publisher("/depth/model", DepthModelInfo, qos=LATCHED)
        self.publish_model()
        self.worker = self.background(self.estimate, self.on_result)
        self.subscribe("/camera/image/compressed", CompressedImage, self.on_image, qos=SENSOR)
        self.subscribe("/depth/request", Header, self.on_request, qos=LATCHED)

    def reconfigure(self, config: DepthEstimatorConfig) -> None:
        super().reconfigure(config)
        self.inference.timeout_s = config.timeout_s

    def publish_model(self) -> None:
        """Publish the kind of values on ``/depth/raw``, for the node that scales them."""
        manifest = self.inference.model.manifest
        self.published_provider = provider = self.inference.model.provider
        info = DepthModelInfo(
            header=header("", self.clock.now_ns()), name=manifest.name, licence=manifest.licence,
            output_kind=manifest.output_kind, provider=provider,
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
        # Use the images' stamps, so that a replay picks the same images. 5 % is tolerance for the camera's jitter.
        stamp = stamp_ns(self.newest)
        early = self.last_ns is not None and 0 <= stamp - self.last_ns < 0.95e9 / self.config.max_rate_hz
        if early or stamp < self.wanted_ns:
            return
        self.last_ns = stamp
        if self.wanted_ns > -math.inf:
            self.wanted_ns = math.inf
        self.worker.submit(self.newest)

    def estimate(self, message: Any) -> tuple[Any, NDArray[np.float32] | None, str]:
        """Estimate the depth on the worker's thread. Return header, depth, and an error text if there is no depth."""
        try:
            return message.header, self.inference.estimate(message.data), ""
        except (InferenceError, ValueError) as error:
            return message.header, None, str(error)

    def on_result(self, result: tuple[Any, NDArray[np.float32] | None, str]) -> None:
        header, depth, reason = result
        provider = self.inference.model.provider
        if provider != self.published_provider:
            self.publish_model()
        if depth is None:
            self.failures += 1
            self.diagnose("depth", ERROR, reason, provider=provider, failures=self.failures)
            return
        stamp = stamp_ns(header)
        self.depth.publish(image_message(depth, "32FC1", header.frame_id, stamp))
        age_s = (self.clock.now_ns() - stamp) / 1e9
        level = WARN if age_s > self.config.max_age_s else OK
        self.diagnose(
            "depth", level, f"depth is {age_s:.2f} s old when it is published", age_s=round(age_s, 3),
            provider=provider, skipped=self.worker.skipped, failures=self.failures,
        )  # fmt: skip


if __name__ == "__main__":
    main(DepthEstimatorNode)
