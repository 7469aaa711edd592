"""Parameters of the node ``depth_scaler``."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Annotated

from instant_ic.config.ranges import Positive, PositiveInt, Range, check_ranges
from instant_ic.depth.fusion import FusionConfig
from instant_ic.depth.keyframes import KeyframeSelectionConfig
from instant_ic.depth.lidar_depth import LidarDepthConfig
from instant_ic.depth.metric_depth import Frames, MetricDepthConfig
from instant_ic.depth.scaler import ScalerConfig
from instant_ic.depth.sources import SourceConfig
from instant_ic.mapping.mapper import MapperConfig


@dataclass(frozen=True)
class DepthScalerConfig:
    """Parameters.

    Attributes:
        source: source of the depth: ``fused``, ``lidar`` (needs no network), ``network``, or ``completed``
            (``fused``, corrected by ``completion`` in this node).
        completion: completion model for ``completed``: ONNX file; a bare name is searched for in ``models/``.
        provider, threads: execution provider and CPU threads of the completion.
        scaler: estimation of the network's scale.
        lidar: depth from points alone.
        fusion: combination of both.
        keyframes: selection of keyframes.
        mapping: the local 3D model, from which the sources ``fused`` and ``lidar`` take depth first.
        max_rate_hz: highest rate of the source ``lidar``, by the images' stamps; that of the others is
            depth_estimator's.
        rows: height of the depth image of source ``lidar``; the others have the network's.
        body_elevation_deg: below this elevation the image shows the robot itself, not the room; -90: nowhere.
        max_cloud_age_s: largest difference in seconds between the middle of a revolution and the image.
        map_frame, odom_frame: frames of the keyframe's pose and of the motion compensation.
        base_frame: frame on the ground; reference of the camera's height.
    """

    source: str = "fused"
    completion: str = ""
    provider: str = "auto"
    threads: PositiveInt = 1
    scaler: ScalerConfig = field(default_factory=ScalerConfig)
    lidar: LidarDepthConfig = field(default_factory=LidarDepthConfig)
    fusion: FusionConfig = field(default_factory=FusionConfig)
    keyframes: KeyframeSelectionConfig = field(default_factory=KeyframeSelectionConfig)
    mapping: MapperConfig = field(default_factory=MapperConfig)
    max_rate_hz: Positive = 2.0
    rows: Annotated[int, Range(32, 1024)] = 256
    body_elevation_deg: Annotated[float, Range(-90, 0)] = -70.0
    max_cloud_age_s: Positive = 0.3
    map_frame: str = "map"
    odom_frame: str = "odom"
    base_frame: str = "base_link"

    def __post_init__(self) -> None:
        check_ranges(self)
        if self.source == "completed" and not self.completion:
            raise ValueError("source completed needs a model: set completion to a file of ic depth train --export")
        self.depth_source  # noqa: B018 - raises ValueError on an unknown source

    @property
    def depth_source(self) -> SourceConfig:
        """The library's part of the parameters."""
        return SourceConfig(self.source, self.scaler, self.lidar, self.fusion)

    @property
    def metric(self) -> MetricDepthConfig:
        """The library's part about images, revolutions and poses."""
        frames = Frames(self.map_frame, self.odom_frame, self.base_frame)
        return MetricDepthConfig(frames, self.rows, self.body_elevation_deg, self.max_cloud_age_s)
