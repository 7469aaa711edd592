"""From images, LiDAR revolutions and the network's depth to metric depth and keyframes."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from instant_ic.depth.inputs import KEEP_NS, DepthRequests, HeldImage, RecentInputs, RevolutionTrigger
from instant_ic.depth.keyframes import KeyframeSelector
from instant_ic.depth.metric_depth import DepthScalerConfig, MetricDepth
from instant_ic.depth.sources import DepthResult
from instant_ic.geometry.poses import Matrix
from instant_ic.geometry.transforms import TransformBuffer, TransformError
from instant_ic.lidar.deskew import TimedPoints
from instant_ic.util.diagnosis import Level

_SILENT_S = 10.0  # without an answer to any request


class DepthChain:
    """Keeps recent inputs, decides of which images to compute the depth, and which of them become keyframes.

    Args:
        config: parameters.
        transforms: poses over time.
        diagnose: sets a diagnosis: name, level, text, values by keyword.
    """

    def __init__(self, config: DepthScalerConfig, transforms: TransformBuffer, diagnose: Callable[..., None]) -> None:
        self.config, self.inputs, self.selector = config, RecentInputs(), KeyframeSelector(config.keyframes)
        self._diagnose = diagnose
        self._trigger, self.requests = RevolutionTrigger(), DepthRequests()
        self._model: tuple[str, str] | None = None
        self._last_ns: int | None = None  # stamp of the newest depth
        self.image_ns = 0  # stamp of the newest image
        self.metric = MetricDepth(config, transforms, self.inputs)

    def reconfigure(self, config: DepthScalerConfig) -> None:
        """Apply new parameters."""
        self.config, self.selector.config = config, config.keyframes
        self.metric.reconfigure(config)
        self._trigger.clear()
        if self._model is not None:
            self.adopt(*self._model)

    def adopt(self, name: str, output_kind: str) -> None:
        """Adopt the kind of values that the network reports, whatever the configuration says."""
        self._model = name, output_kind
        try:
            scaler = replace(self.config.scaler, output_kind=output_kind)
        except ValueError as error:
            return self._diagnose("model", Level.WARN, f"{name}: {error}")
        self.metric.source.configure(replace(self.config, scaler=scaler))
        self._diagnose("model", Level.OK, f"{name}: {output_kind} depth")

    def add_image(self, image: HeldImage, message: Any) -> float:
        """Keep an image; returns the seconds by which time went back at it: above 0, the keyframes start again."""
        back_s = (self.image_ns - image.stamp_ns) / 1e9
        if restarts := image.stamp_ns < self.image_ns - KEEP_NS:
            self.selector.restart()
        self.image_ns = image.stamp_ns
        self.inputs.add_image(image.stamp_ns, message)
        self.inputs.discard(self.requests.since_ns or image.stamp_ns)
        return back_s if restarts else 0.0

    def due(self, image: HeldImage) -> bool:
        """Return whether a keyframe could be taken of the image."""
        try:
            due = self.selector.due(self.metric.map_from_camera(image.frame, image.stamp_ns), image.stamp_ns)
        except TransformError as error:
            self._diagnose("pose", Level.WARN, f"no keyframe without a pose: {error}")
            return False
        self._diagnose("pose", Level.OK, "the camera's pose is known")
        return due

    def hold(self, image: HeldImage) -> HeldImage | None:
        """Hold an image until the revolution around it is complete; returns an earlier one without a revolution."""
        return self._trigger.image(image, self._last_ns, self.config.max_rate_hz)

    def request_due(self, stamp_ns: int) -> bool:
        """Return whether to request the network's depth of an image."""
        if not self.requests.due(stamp_ns):
            return False
        silent_s = (stamp_ns - (self.requests.since_ns or stamp_ns)) / 1e9
        if silent_s > _SILENT_S:
            text = "does depth_estimator run? source lidar needs none"
            self._diagnose("scale", Level.WARN, f"no /depth/raw for {silent_s:.0f} s: {text}")
        return True

    def add_revolution(self, revolution: TimedPoints) -> HeldImage | None:
        """Add a revolution to the local model; returns the held image that it completes."""
        self._diagnose("points", Level.OK, f"{len(revolution.time_s)} points")
        self.inputs.revolutions.append(revolution)
        if self.config.source != "network":
            mapper = self.metric.mapper
            try:
                mapper.revolution(revolution)
                self._diagnose("local model", Level.OK, "growing", revolutions=mapper.model.revolutions)
            except (TransformError, ValueError) as error:
                self._diagnose("local model", Level.WARN, f"no points added: {error}")
        return self._trigger.revolution(revolution.middle_ns)

    def estimate(self, raw: NDArray[np.float32] | None, image: HeldImage) -> DepthResult:
        """Estimate the depth of an image; ``raw``: the network's, (H, W), if the source needs it."""
        self._last_ns = image.stamp_ns
        return self.metric.estimate(raw, image.frame, image.stamp_ns)

    def report(self, result: DepthResult) -> None:
        self._diagnose("scale", Level.OK if result.ok else Level.WARN, result.message, **result.figures())

    def keyframe_pose(self, result: DepthResult, image: HeldImage) -> Matrix | None:
        """Return map_from_camera of a new keyframe; None if this image does not become one."""
        if image.stamp_ns not in self.inputs.images:
            return self._diagnose("keyframe", Level.WARN, "the image that this depth belongs to did not arrive")
        try:
            map_from_camera = self.metric.map_from_camera(image.frame, image.stamp_ns)
        except TransformError as error:
            return self._diagnose("keyframe", Level.WARN, f"no pose: {error}")
        return map_from_camera if self.selector.take(map_from_camera, result.ok, image.stamp_ns) else None
