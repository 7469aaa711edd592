"""Estimates the depth of the camera's panoramas (paper, section IV.B): newest picture only, at a limited rate."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from instant_ic.bus import ERROR, OK, SENSOR, WARN, Node, NodeError, main
from instant_ic.depth.manifest import ManifestError
from instant_ic.depth.model import DEFAULT_MODEL, DepthModel
from instant_ic.msg import CompressedImage, Image, image_message, stamp_ns
from instant_ic.paths import shipped_file
from instant_ic.ranges import Positive, PositiveInt, check_ranges


@dataclass(frozen=True)
class DepthEstimatorConfig:
    """Parameters.

    Attributes:
        model: ONNX file or its manifest; a bare name is looked for in ``models/``.
        threads: CPU threads of one inference.
        max_rate_hz: pictures a second at most; leaves the CPU to others.
        max_age_s: an older picture at the end of its estimation is warned about.
    """

    model: str = DEFAULT_MODEL
    threads: PositiveInt = 1
    max_rate_hz: Positive = 2.0
    max_age_s: Positive = 1.5

    def __post_init__(self) -> None:
        if not self.model:
            raise ValueError("model must name a file")
        check_ranges(self)


class DepthEstimatorNode(Node[DepthEstimatorConfig]):
    """``/camera/image/compressed`` → ``/depth/raw``."""

    name = "depth_estimator"
    live_parameters = ("max_rate_hz", "max_age_s")

    def setup(self) -> None:
        try:
            bare = Path(self.config.model).name == self.config.model
            path = shipped_file("models", self.config.model) if bare else Path(self.config.model)
            self.model = DepthModel.load(path, self.config.threads)
        except (ManifestError, FileNotFoundError) as error:
            raise NodeError(str(error)) from error
        manifest = self.model.manifest
        self.log.info(
            "%s (%s, %dx%d) on %s", manifest.name, manifest.output_kind, manifest.input_width, manifest.input_height,
            self.model.provider,
        )  # fmt: skip
        self.last_ns: int | None = None
        self.undecodable = 0
        self.depth = self.publisher("/depth/raw", Image, qos=SENSOR)
        self.worker = self.background(self.estimate, self.on_result)
        self.subscribe("/camera/image/compressed", CompressedImage, self.on_image, qos=SENSOR)

    def on_image(self, message: Any) -> None:
        # By the pictures' own stamps, so that a replay picks the same ones; 5 % for a camera's uneven pace.
        stamp = stamp_ns(message)
        if self.last_ns is not None and 0 <= stamp - self.last_ns < 0.95e9 / self.config.max_rate_hz:
            return
        self.last_ns = stamp
        self.worker.submit(message)

    def estimate(self, message: Any) -> tuple[Any, NDArray[np.float32] | None]:
        bgr = cv2.imdecode(np.asarray(message.data, np.uint8), cv2.IMREAD_COLOR)
        if bgr is None:
            return message.header, None
        return message.header, self.model.estimate(np.ascontiguousarray(bgr[..., ::-1]))

    def on_result(self, result: tuple[Any, NDArray[np.float32] | None]) -> None:
        header, depth = result
        if depth is None:
            self.undecodable += 1
            self.diagnose("depth", ERROR, "the picture is no JPEG that can be decoded", undecodable=self.undecodable)
            return
        stamp = stamp_ns(header)
        self.depth.publish(image_message(depth, "32FC1", header.frame_id, stamp))
        age_s = (self.clock.now_ns() - stamp) / 1e9
        level = WARN if age_s > self.config.max_age_s else OK
        self.diagnose(
            "depth", level, f"depth is {age_s:.2f} s old when it is published", age_s=round(age_s, 3),
            provider=self.model.provider, skipped=self.worker.skipped, undecodable=self.undecodable,
        )  # fmt: skip


if __name__ == "__main__":
    main(DepthEstimatorNode)
