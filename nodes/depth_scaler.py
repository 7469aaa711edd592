"""Computes metric depth from the network's estimate, the LiDAR or both, and keyframes (paper, section IV.C)."""

from __future__ import annotations

import functools
from dataclasses import dataclass, field, fields, replace
from typing import Annotated, Any

import numpy as np
from numpy.typing import NDArray

from instant_ic.bus import LATCHED, OK, SENSOR, WARN, Node, main
from instant_ic.config.ranges import Positive, Range, check_ranges
from instant_ic.depth.fusion import FusionConfig
from instant_ic.depth.inputs import KEEP_NS, DepthRequests, HeldImage, RecentInputs, Revolution, RevolutionTrigger
from instant_ic.depth.keyframes import KeyframeSelectionConfig, KeyframeSelector, encode_sigma
from instant_ic.depth.lidar_depth import LidarDepthConfig
from instant_ic.depth.metric_depth import Frames, MetricDepth, MetricDepthConfig
from instant_ic.depth.scaler import ScalerConfig
from instant_ic.depth.sources import DepthResult, DepthSource, SourceConfig
from instant_ic.geometry.transforms import TransformError
from instant_ic.msg import (
    CompressedImage,
    DepthModelInfo,
    Header,
    Image,
    Keyframe,
    PointCloud2,
    cloud_array,
    cloud_xyz,
    header,
    image_array,
    image_message,
    pose_message,
    stamp_ns,
)

_SILENT_S = 10.0  # without an answer to any request


@dataclass(frozen=True)
class DepthScalerConfig:
    """Parameters.

    Attributes:
        source: source of the depth: ``fused``, ``lidar`` (needs no network) or ``network``.
        scaler: estimation of the network's scale.
        lidar: depth from points alone.
        fusion: combination of both.
        keyframes: selection of keyframes.
        max_rate_hz: highest rate of source ``lidar``, by the images' stamps; that of the others is depth_estimator's.
        rows: height of the depth image of source ``lidar``; the others have the network's.
        body_elevation_deg: below this elevation the image shows the robot itself, not the room; -90: nowhere.
        max_cloud_age_s: largest difference in seconds between the middle of a revolution and the image.
        map_frame, odom_frame: frames of the keyframe's pose and of the motion compensation.
        base_frame: frame on the ground; reference of the camera's height.
    """

    source: str = "fused"
    scaler: ScalerConfig = field(default_factory=ScalerConfig)
    lidar: LidarDepthConfig = field(default_factory=LidarDepthConfig)
    fusion: FusionConfig = field(default_factory=FusionConfig)
    keyframes: KeyframeSelectionConfig = field(default_factory=KeyframeSelectionConfig)
    max_rate_hz: Positive = 2.0
    rows: Annotated[int, Range(32, 1024)] = 256
    body_elevation_deg: Annotated[float, Range(-90, 0)] = -70.0
    max_cloud_age_s: Positive = 0.3
    map_frame: str = "map"
    odom_frame: str = "odom"
    base_frame: str = "base_link"

    def __post_init__(self) -> None:
        check_ranges(self)
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


class DepthScalerNode(Node[DepthScalerConfig]):
    """``/camera/image/compressed``, ``/tf`` → ``/depth/request``; with ``/depth/raw`` and ``/lidar/points`` →
    ``/depth/scaled``, ``/keyframe``.
    """

    name = "depth_scaler"
    live_parameters = tuple(one.name for one in fields(DepthScalerConfig))

    def setup(self) -> None:
        self.source = DepthSource(self.config.depth_source)
        self.selector = KeyframeSelector(self.config.keyframes)
        self.inputs, self.trigger, self.requests = RecentInputs(), RevolutionTrigger(), DepthRequests()
        self.model: Any = None
        self.last_ns: int | None = None  # stamp of the newest depth
        self.image_ns = 0
        self.request = self.publisher("/depth/request", Header, qos=LATCHED)
        self.request.publish(header("", 0))  # any image: from now on depth_estimator waits for requests
        self.scaled = self.publisher("/depth/scaled", Image, qos=SENSOR)
        self.keyframe = self.publisher("/keyframe", Keyframe, qos=LATCHED)
        self.warn_of_method()
        self.metric = MetricDepth(self.source, self.tf, self.inputs, self.config.metric)
        self.subscribe("/depth/model", DepthModelInfo, self.on_model, qos=LATCHED)
        self.subscribe("/camera/image/compressed", CompressedImage, self.on_image, qos=SENSOR)
        self.subscribe("/lidar/points", PointCloud2, self.on_cloud, qos=SENSOR)
        self.subscribe("/depth/raw", Image, self.on_depth, qos=SENSOR)

    def reconfigure(self, config: DepthScalerConfig) -> None:
        super().reconfigure(config)
        self.source.config, self.selector.config = config.depth_source, config.keyframes
        self.metric.config = config.metric
        self.trigger.clear()
        if self.model is not None:
            self.on_model(self.model)
        self.warn_of_method()

    def warn_of_method(self) -> None:
        if self.config.scaler.method == "as_estimated" and self.config.source != "lidar":
            self.log.warning("depth is used as estimated, without the LiDAR: for recordings, not for driving")

    def on_model(self, message: Any) -> None:
        """Adopt the kind of values that the network reports, whatever the configuration says."""
        self.model = message
        try:
            scaler = replace(self.config.scaler, output_kind=message.output_kind)
        except ValueError as error:
            return self.diagnose("model", WARN, f"{message.name}: {error}")
        self.source.config = replace(self.config.depth_source, scaler=scaler)
        self.diagnose("model", OK, f"{message.name}: {message.output_kind} depth")

    def on_image(self, message: Any) -> None:
        """Have the depth of an image computed if a keyframe could be taken of it."""
        stamp, camera = stamp_ns(message), message.header.frame_id
        if stamp < self.image_ns - KEEP_NS:
            self.log.warning("time went back by %.1f s: restarting", (self.image_ns - stamp) / 1e9)
            self.selector.restart()
        self.image_ns = stamp
        self.inputs.add_image(stamp, message)
        self.inputs.discard(self.requests.since_ns or stamp)
        try:
            due = self.selector.due(self.metric.map_from_camera(camera, stamp), stamp)
        except TransformError as error:
            return self.diagnose("pose", WARN, f"no keyframe without a pose: {error}")
        self.diagnose("pose", OK, "the camera's pose is known")
        if not due:
            return
        if self.config.source == "lidar":
            image = HeldImage(camera, stamp)
            late = self.trigger.image(image, self.last_ns, self.config.max_rate_hz, self.config.max_cloud_age_s)
            if late is not None:
                self.handle(None, late.frame, late.stamp_ns)
        elif self.requests.due(stamp):
            self.request.publish(header(camera, stamp))
            silent_s = (stamp - (self.requests.since_ns or stamp)) / 1e9
            if silent_s > _SILENT_S:
                text = "does depth_estimator run? source lidar needs none"
                self.diagnose("scale", WARN, f"no /depth/raw for {silent_s:.0f} s: {text}")

    def on_cloud(self, message: Any) -> None:
        time_s, xyz = cloud_array(message)["time"], functools.partial(cloud_xyz, message)
        revolution = Revolution(message.header.frame_id, stamp_ns(message), time_s, xyz)
        self.inputs.revolutions.append(revolution)
        image = self.trigger.revolution(revolution.middle_ns)
        if image is not None:
            self.handle(None, image.frame, image.stamp_ns)

    def on_depth(self, message: Any) -> None:
        if self.config.source != "lidar":
            self.requests.answered()
            self.handle(image_array(message), message.header.frame_id, stamp_ns(message))

    def handle(self, raw: NDArray[np.float32] | None, camera: str, stamp: int) -> None:
        """Compute, report and publish the depth of the image taken at ``stamp``."""
        self.last_ns = stamp
        result = self.metric.estimate(raw, camera, stamp)
        self.diagnose("scale", OK if result.ok else WARN, result.message, **result.figures())
        if result.ok:
            self.scaled.publish(image_message(result.depth_m, "32FC1", camera, stamp))
        self.offer_keyframe(result, camera, stamp)

    def offer_keyframe(self, result: DepthResult, camera: str, stamp: int) -> None:
        image = self.inputs.images.get(stamp)
        if image is None:
            return self.diagnose("keyframe", WARN, "the image that this depth belongs to did not arrive")
        try:
            map_from_camera = self.metric.map_from_camera(camera, stamp)
        except TransformError as error:
            return self.diagnose("keyframe", WARN, f"no pose: {error}")
        if not self.selector.take(map_from_camera, result.ok, stamp):
            return
        self.keyframe.publish(
            Keyframe(
                header=header(self.config.map_frame, stamp),
                id=self.selector.count,
                pose=pose_message(map_from_camera),
                panorama=image,
                depth=image_message(result.depth_m, "32FC1", camera, stamp),
                sigma=image_message(encode_sigma(result.sigma), "mono8", camera, stamp),
                source=result.source,
                scale=result.scale,
                quality=result.quality,
                relative_sigma=result.relative_sigma,
                fit=result.ok,
                message=result.message,
            )
        )
        text = f"keyframe {self.selector.count}: {result.message}"
        before, level = self._diagnoses.get("keyframe", (OK,))[0], OK if result.ok else WARN
        self.diagnose("keyframe", level, text, id=self.selector.count)
        if level == before:  # else the diagnosis is in the log already
            self.log.info(text)


if __name__ == "__main__":
    main(DepthScalerNode)
