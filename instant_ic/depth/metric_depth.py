"""Metric depth of an image: the network's estimate or none, the LiDAR around it, and the poses of both."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Annotated

import numpy as np
from numpy.typing import NDArray

from instant_ic.config.ranges import Positive, PositiveInt, Range
from instant_ic.depth.inputs import MAX_CLOUD_AGE_S, RecentInputs
from instant_ic.depth.keyframes import KeyframeSelectionConfig
from instant_ic.depth.model import DEFAULT_COMPLETION
from instant_ic.depth.sources import DepthResult, DepthSource, SourceConfig, without_body
from instant_ic.geometry.poses import Matrix
from instant_ic.geometry.transforms import TransformBuffer, TransformError
from instant_ic.lidar.deskew import points_at
from instant_ic.mapping.mapper import LocalMapper, LocalView, MapperConfig, correction


@dataclass(frozen=True)
class DepthScalerConfig(SourceConfig):
    """Parameters of the node ``depth_scaler``.

    Attributes:
        completion: completion model for ``completed``: ONNX file; a bare name is searched for in ``models/``.
        provider, threads: execution provider and CPU threads of the completion.
        keyframes: selection of keyframes.
        mapping: the local 3D model, from which all sources but ``network`` take depth first.
        max_rate_hz: highest rate of the source ``lidar``, by the images' stamps; that of the others is
            depth_estimator's.
        rows: height of the depth image of source ``lidar``; the others have the network's.
        body_elevation_deg: below this elevation the image shows the robot itself, not the room; -90: nowhere.
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
            raise ValueError("source completed needs a model: set completion to a file of ic depth train --export")


class MetricDepth:
    """Joins a ``DepthSource`` and the local 3D model with the poses of camera and LiDAR.

    Args:
        config: parameters.
        transforms: poses over time.
        inputs: recent revolutions.
    """

    def __init__(self, config: DepthScalerConfig, transforms: TransformBuffer, inputs: RecentInputs) -> None:
        self.config, self.transforms, self.inputs = config, transforms, inputs
        self.source = DepthSource(config)
        self.mapper = LocalMapper(transforms, config.mapping)

    def reconfigure(self, config: DepthScalerConfig) -> None:
        """Apply new parameters; the local model starts again if they change it."""
        before, self.config = self.config, config
        self.source.configure(config)
        if before.mapping != config.mapping:
            self.mapper = LocalMapper(self.transforms, config.mapping)

    def estimate(self, raw: NDArray[np.float32] | None, camera: str, stamp_ns: int) -> DepthResult:
        """Estimate the depth of an image; if something is missing the result is not ok, and its message says what.

        Args:
            raw: (H, W) the network's depth; None for the source ``lidar``.
            camera: the camera's frame.
            stamp_ns: the image's time.
        """
        config, size = self.config, (self.config.rows, 2 * self.config.rows)
        try:
            up, height_m = self.camera_stance(camera, stamp_ns)
            if raw is not None and self.source.config.scaler.method == "as_estimated":
                # Not masked: a camera at another place has another height.
                return self.source.estimate(raw, np.empty((0, 3)), up, height_m, size=size)
            points = self.points_in_camera(camera, stamp_ns)
            local = None
            if self.source.config.source != "network":
                local = LocalView(self.mapper.model, self.mapper.model_from_camera(camera, stamp_ns))
        except TransformError as error:
            return self.source.refuse(raw, str(error), size)
        if points is None:
            return self.source.refuse(raw, f"no LiDAR revolution within {MAX_CLOUD_AGE_S} s", size)
        result = self.source.estimate(raw, points, up, height_m, size=size, local=local)
        return without_body(result, up, height_m, config.body_elevation_deg)

    def camera_stance(self, camera: str, stamp_ns: int) -> tuple[NDArray[np.float64], float]:
        """Return the up direction in the camera's frame (odometry is level) and the camera's height over the ground.

        Raises:
            TransformError: the poses are not known.
        """
        base_from_camera = self.transforms.lookup("base_link", camera, stamp_ns)
        odom_from_camera = self.transforms.lookup("odom", camera, stamp_ns)
        return np.array(odom_from_camera[2, :3]), float(base_from_camera[2, 3])

    def points_in_camera(self, camera: str, stamp_ns: int) -> NDArray[np.float64] | None:
        """Return motion-compensated points at ``stamp_ns`` in the camera's frame, (N, 3); None without a revolution.

        Raises:
            TransformError: the poses are not known.
        """
        revolution = self.inputs.nearest_revolution(stamp_ns)
        if revolution is None:
            return None
        lidar, camera_from_odom = revolution.frame, self.transforms.lookup(camera, "odom", stamp_ns)

        def camera_from_lidar(at_ns: int) -> Matrix:
            return camera_from_odom @ self.transforms.lookup("odom", lidar, at_ns)

        return points_at(revolution.xyz(), revolution.time_s, revolution.stamp_ns, camera_from_lidar)

    def map_from_camera(self, camera: str, stamp_ns: int) -> Matrix:
        """Return the camera's pose from odometry and its correction at the image's time.

        Tracks slip in a turn: one second later the correction differs by degrees.

        Raises:
            TransformError: the poses are not known.
        """
        return correction(self.transforms, stamp_ns) @ self.transforms.lookup("odom", camera, stamp_ns)
