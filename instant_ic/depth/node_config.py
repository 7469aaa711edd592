"""Parameters of the node ``depth_scaler``."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Annotated

from instant_ic.config.ranges import Positive, PositiveInt, Range
from instant_ic.depth.keyframes import KeyframeSelectionConfig
from instant_ic.depth.sources import SourceConfig
from instant_ic.mapping.mapper import MapperConfig


@dataclass(frozen=True)
class DepthScalerConfig(SourceConfig):
    """Parameters.

    Attributes:
        completion: completion model for ``completed``: ONNX file; a bare name is searched for in ``models/``.
        provider, threads: execution provider and CPU threads of the completion.
        keyframes: selection of keyframes.
        mapping: the local 3D model, from which the sources ``fused`` and ``lidar`` take depth first.
        max_rate_hz: highest rate of the source ``lidar``, by the images' stamps; that of the others is
            depth_estimator's.
        rows: height of the depth image of source ``lidar``; the others have the network's.
        body_elevation_deg: below this elevation the image shows the robot itself, not the room; -90: nowhere.
        map_frame, odom_frame: frames of the keyframe's pose and of the motion compensation.
        base_frame: frame on the ground; reference of the camera's height.
    """

    completion: str = ""
    provider: str = "auto"
    threads: PositiveInt = 1
    keyframes: KeyframeSelectionConfig = field(default_factory=KeyframeSelectionConfig)
    mapping: MapperConfig = field(default_factory=MapperConfig)
    max_rate_hz: Positive = 2.0
    rows: Annotated[int, Range(32, 1024)] = 256
    body_elevation_deg: Annotated[float, Range(-90, 0)] = -70.0
    map_frame: str = "map"
    odom_frame: str = "odom"
    base_frame: str = "base_link"

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.source == "completed" and not self.completion:
            raise ValueError("source completed needs a model: set completion to a file of ic depth train --export")
