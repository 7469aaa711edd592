"""Processing of images, LiDAR revolutions and the network's depth to metric depth and keyframes."""

from __future__ import annotations

from collections import deque
from collections.abc import Callable
from dataclasses import dataclass, field, replace
from typing import Annotated, Any

import numpy as np
from numpy.typing import NDArray

from instant_ic.config.ranges import Positive, PositiveInt, Range
from instant_ic.depth.inputs import KEEP_NS, MAX_CLOUD_AGE_S, DepthRequests, HeldImage, RevolutionTrigger
from instant_ic.depth.keyframes import KeyframeSelectionConfig, KeyframeSelector
from instant_ic.depth.model import DEFAULT_COMPLETION
from instant_ic.depth.sources import DepthResult, DepthSource, SourceConfig, without_body
from instant_ic.geometry.poses import Matrix
from instant_ic.geometry.transforms import TransformBuffer, TransformError
from instant_ic.lidar.deskew import TimedPoints, points_at
from instant_ic.mapping.mapper import LocalMapper, LocalView, MapperConfig, correction
from instant_ic.util.diagnosis import Level

_MAX_IMAGES, _MAX_REVOLUTIONS = 150, 40
_SILENT_S = 10.0
"""Seconds without an answer to any request after which the node warns."""


@dataclass(frozen=True)
class DepthScalerConfig(SourceConfig):
    """Parameters of the node ``depth_scaler``.

    Attributes:
        completion: ONNX file of the completion model for ``completed``; a bare name is searched for in ``models/``.
        provider, threads: execution provider and CPU threads of the completion.
        keyframes: selection of keyframes.
        mapping: the local 3D model, from which all sources except ``network`` take depth first.
        max_rate_hz: highest rate of the source ``lidar``, by the images' stamps; depth_estimator sets the rate of the
            other sources.
        rows: height of the depth image of source ``lidar``; the network sets the height of the other sources.
        body_elevation_deg: degrees; pixels below this elevation show the robot itself; -90: none.
    """

    source: str = "completed"
    completion: str = DEFAULT_COMPLETION
    provider: str = "auto"
    threads: PositiveInt = 1
    keyframes: KeyframeSelectionConfig = field(default_factory=KeyframeSelectionConfig)
    mapping: MapperConfig = field(default_factory=MapperConfig)
    max_rate_hz: Positive = 2.0
    rows: Annotated[int, Range(32, 1024)] = 256
    body_elevation_deg: Annotated[float, Range(-90, 0)] = -70.0

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.source == "completed" and not self.completion:
            raise ValueError("source completed needs a model; set completion to a file of ic depth train --export")


class DepthChain:
    """Chain from recent images and points to keyframes: depth of possible keyframes, and selection among them.

    Args:
        config: parameters.
        transforms: poses over time.
        diagnose: sets a diagnosis: name, level, text, values by keyword.

    Attributes:
        images: recent images by their stamp.
        image_ns: stamp of the newest image.
        requests: requests for the network's depth.
        selector: selection of keyframes.
        source: computes depth.
        mapper: the local 3D model.
    """

    def __init__(self, config: DepthScalerConfig, transforms: TransformBuffer, diagnose: Callable[..., None]) -> None:
        self.config = config
        self.images: dict[int, Any] = {}
        self.image_ns = 0
        self.requests, self.selector = DepthRequests(), KeyframeSelector(config.keyframes)
        self.source, self.mapper = DepthSource(config), LocalMapper(transforms, config.mapping)
        self._transforms, self._diagnose = transforms, diagnose
        self._trigger = RevolutionTrigger()
        self._revolutions: deque[TimedPoints] = deque(maxlen=_MAX_REVOLUTIONS)
        self._model: tuple[str, str] | None = None
        self._last_ns: int | None = None  # stamp of the newest depth

    def reconfigure(self, config: DepthScalerConfig) -> None:
        """Apply new parameters. If those of the local model change, the local model starts again."""
        before, self.config, self.selector.config = self.config, config, config.keyframes
        self.source.configure(config)
        if before.mapping != config.mapping:
            self.mapper = LocalMapper(self._transforms, config.mapping)
        self._trigger = RevolutionTrigger()
        if self._model is not None:
            self.adopt(*self._model)

    def adopt(self, name: str, output_kind: str) -> None:
        """Use the kind of values that the network reports instead of the configured kind."""
        self._model = name, output_kind
        try:
            scaler = replace(self.config.scaler, output_kind=output_kind)
        except ValueError as error:
            return self._diagnose("model", Level.WARN, f"{name}: {error}")
        self.source.configure(replace(self.config, scaler=scaler))
        self._diagnose("model", Level.OK, f"{name}: {output_kind} depth")

    def add_image(self, image: HeldImage, message: Any) -> float:
        """Keep an image; return the seconds by which time jumped back, or 0. After a jump, keyframes start again."""
        back_s = (self.image_ns - image.stamp_ns) / 1e9
        if restarts := image.stamp_ns < self.image_ns - KEEP_NS:
            self.selector.restart()
        self.image_ns = image.stamp_ns
        self.images[image.stamp_ns] = message
        if len(self.images) > _MAX_IMAGES:
            del self.images[next(iter(self.images))]
        # Inputs from the future are discarded too, because the clock may have been set back.
        kept_ns = self.requests.since_ns or image.stamp_ns
        for old in [other for other in self.images if abs(other - kept_ns) > KEEP_NS]:
            del self.images[old]
        while self._revolutions and abs(self._revolutions[0].stamp_ns - kept_ns) > KEEP_NS:
            self._revolutions.popleft()
        return back_s if restarts else 0.0

    def due(self, image: HeldImage) -> bool:
        """Return whether the image may become a keyframe."""
        try:
            due = self.selector.due(self.map_from_camera(image), image.stamp_ns)
        except TransformError as error:
            self._diagnose("pose", Level.WARN, f"no keyframe without a pose: {error}")
            return False
        self._diagnose("pose", Level.OK, "the camera's pose is known")
        return due

    def hold(self, image: HeldImage) -> HeldImage | None:
        """Hold an image until the revolution around it is complete; return an earlier one whose revolution is late."""
        return self._trigger.image(image, self._last_ns, self.config.max_rate_hz)

    def request_due(self, stamp_ns: int) -> bool:
        """Return whether to request the network's depth of an image."""
        if not self.requests.due(stamp_ns):
            return False
        silent_s = (stamp_ns - (self.requests.since_ns or stamp_ns)) / 1e9
        if silent_s > _SILENT_S:
            text = "check that depth_estimator runs, or set source to lidar"
            self._diagnose("scale", Level.WARN, f"no /depth/raw for {silent_s:.0f} s; {text}")
        return True

    def add_revolution(self, revolution: TimedPoints) -> HeldImage | None:
        """Add a revolution to the local model; return the held image that it completes."""
        self._diagnose("points", Level.OK, f"{len(revolution.time_s)} points")
        self._revolutions.append(revolution)
        if self.config.source != "network":
            try:
                self.mapper.revolution(revolution)
                self._diagnose("local model", Level.OK, "growing", revolutions=self.mapper.model.revolutions)
            except (TransformError, ValueError) as error:
                self._diagnose("local model", Level.WARN, f"no points added: {error}")
        return self._trigger.revolution(revolution.middle_ns)

    def estimate(self, raw: NDArray[np.float32] | None, image: HeldImage) -> DepthResult:
        """Estimate the depth of an image. Without poses or points the result is not ok, and its message says why.

        Args:
            raw: the network's depth, (H, W); None for the source ``lidar``.
            image: the image.
        """
        self._last_ns, size = image.stamp_ns, (self.config.rows, 2 * self.config.rows)
        try:
            up, height_m = self._camera_stance(image)
            if raw is not None and self.source.config.scaler.method == "as_estimated":
                # The robot is not masked, because the camera may be elsewhere and have another height.
                return self.source.estimate(raw, np.empty((0, 3)), up, height_m, size=size)
            points, local = self._points_in_camera(image), None
            if self.source.config.source != "network":
                local = LocalView(self.mapper.model, self.mapper.model_from_camera(image.frame, image.stamp_ns))
        except TransformError as error:
            return self.source.refuse(raw, str(error), size)
        if points is None:
            return self.source.refuse(raw, f"no LiDAR revolution within {MAX_CLOUD_AGE_S} s", size)
        result = self.source.estimate(raw, points, up, height_m, size=size, local=local)
        return without_body(result, up, height_m, self.config.body_elevation_deg)

    def _camera_stance(self, image: HeldImage) -> tuple[NDArray[np.float64], float]:
        """Return the up direction in the camera's frame and the camera's height over the ground; odometry is level."""
        base_from_camera = self._transforms.lookup("base_link", image.frame, image.stamp_ns)
        odom_from_camera = self._transforms.lookup("odom", image.frame, image.stamp_ns)
        return np.array(odom_from_camera[2, :3]), float(base_from_camera[2, 3])

    def _points_in_camera(self, image: HeldImage) -> NDArray[np.float64] | None:
        """Return the nearest revolution's points (N, 3) in the camera's frame, motion-compensated; None if missing."""

        def gap_ns(revolution: TimedPoints) -> int:
            return abs(revolution.middle_ns - image.stamp_ns)

        revolution = min((one for one in self._revolutions if len(one.time_s)), key=gap_ns, default=None)
        if revolution is None or gap_ns(revolution) / 1e9 > MAX_CLOUD_AGE_S:
            return None
        lidar, camera_from_odom = revolution.frame, self._transforms.lookup(image.frame, "odom", image.stamp_ns)

        def camera_from_lidar(at_ns: int) -> Matrix:
            return camera_from_odom @ self._transforms.lookup("odom", lidar, at_ns)

        return points_at(revolution.xyz(), revolution.time_s, revolution.stamp_ns, camera_from_lidar)

    def map_from_camera(self, image: HeldImage) -> Matrix:
        """Return the camera's pose from odometry and its correction at the image's time.

        The correction must be that of the image's time. Tracks slip in a turn, so it changes by degrees in a second.

        Raises:
            TransformError: the poses are not known.
        """
        odom_from_camera = self._transforms.lookup("odom", image.frame, image.stamp_ns)
        return correction(self._transforms, image.stamp_ns) @ odom_from_camera

    def report(self, result: DepthResult) -> None:
        self._diagnose("scale", Level.OK if result.ok else Level.WARN, result.message, **result.figures())

    def keyframe_pose(self, result: DepthResult, image: HeldImage) -> Matrix | None:
        """Return map_from_camera of a new keyframe; None if this image does not become one."""
        if image.stamp_ns not in self.images:
            return self._diagnose("keyframe", Level.WARN, "the image that this depth belongs to did not arrive")
        try:
            map_from_camera = self.map_from_camera(image)
        except TransformError as error:
            return self._diagnose("keyframe", Level.WARN, f"no pose: {error}")
        return map_from_camera if self.selector.take(map_from_camera, result.ok, image.stamp_ns) else None
