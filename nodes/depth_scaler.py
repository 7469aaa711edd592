"""Computes metric depth from the network's estimate, the LiDAR or both, and keyframes (paper, section IV.C)."""

from __future__ import annotations

from collections import deque
from dataclasses import dataclass, field, replace
from typing import Annotated, Any

import numpy as np
from numpy.typing import NDArray

from instant_ic.bus import LATCHED, OK, SENSOR, WARN, Node, main
from instant_ic.config.ranges import Positive, Range, check_ranges
from instant_ic.depth.deskew import points_at
from instant_ic.depth.fusion import FusionConfig
from instant_ic.depth.keyframes import KeyframeConfig, KeyframeSelector, encode_sigma
from instant_ic.depth.lidar_depth import LidarDepthConfig
from instant_ic.depth.scaler import ScalerConfig
from instant_ic.depth.sources import DepthResult, DepthSource, SourceConfig, without_body
from instant_ic.geometry.poses import Matrix
from instant_ic.geometry.transforms import TransformError
from instant_ic.msg import (
    CompressedImage,
    DepthModelInfo,
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

# Images and clouds that differ more from the newest depth are discarded.
_KEEP_NS = 4_000_000_000
_MAX_PICTURES = 150
_MAX_CLOUDS = 40
# The network counts as silent after this time with images but no estimate.
_SILENT_NS = 10_000_000_000


@dataclass(frozen=True)
class DepthScalerConfig:
    """Parameters.

    Attributes:
        source: source of the depth: ``fused``, ``lidar`` (needs no network) or ``network``.
        scaler: estimation of the network's scale.
        lidar: depth from points alone.
        fusion: combination of both.
        keyframes: selection of keyframes.
        max_rate_hz: rate of source ``lidar``, by the images' stamps; the others follow ``/depth/raw``.
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
    keyframes: KeyframeConfig = field(default_factory=KeyframeConfig)
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


class DepthScalerNode(Node[DepthScalerConfig]):
    """``/depth/raw``, ``/lidar/points``, ``/tf``, ``/camera/image/compressed`` → ``/depth/scaled``, ``/keyframe``."""

    name = "depth_scaler"
    live_parameters = (
        *("source", "scaler", "lidar", "fusion", "keyframes", "max_rate_hz", "rows", "body_elevation_deg"),
        *("max_cloud_age_s", "map_frame", "odom_frame", "base_frame"),
    )

    def setup(self) -> None:
        self.source = DepthSource(self.config.depth_source)
        self.selector = KeyframeSelector(self.config.keyframes)
        self.pictures: dict[int, Any] = {}
        self.clouds: deque[Any] = deque(maxlen=_MAX_CLOUDS)
        self.model: Any = None
        self.last_ns: int | None = None
        self.waiting: Any = None  # image whose revolution has not arrived yet (source lidar)
        self.pictures_since_ns: int | None = None
        self.scaled = self.publisher("/depth/scaled", Image, qos=SENSOR)
        self.keyframe = self.publisher("/keyframe", Keyframe, qos=LATCHED)
        self.warn_of_method()
        self.transforms = self.tf  # subscribes here: the past must be known when the first depth arrives
        self.subscribe("/depth/model", DepthModelInfo, self.on_model, qos=LATCHED)
        self.subscribe("/camera/image/compressed", CompressedImage, self.on_picture, qos=SENSOR)
        self.subscribe("/lidar/points", PointCloud2, self.on_cloud, qos=SENSOR)
        self.subscribe("/depth/raw", Image, self.on_depth, qos=SENSOR)

    def reconfigure(self, config: DepthScalerConfig) -> None:
        super().reconfigure(config)
        self.source.config, self.selector.config = config.depth_source, config.keyframes
        self.waiting = None
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
            self.diagnose("model", WARN, f"{message.name}: {error}")
            return
        self.source.config = replace(self.config.depth_source, scaler=scaler)
        self.diagnose("model", OK, f"{message.name}: {message.output_kind} depth")

    def on_picture(self, message: Any) -> None:
        stamp = stamp_ns(message)
        self.pictures[stamp] = message
        if len(self.pictures) > _MAX_PICTURES:
            del self.pictures[next(iter(self.pictures))]
        if self.config.source != "lidar":
            self.watch_for_depth(stamp)
            return
        age_s = self.config.max_cloud_age_s
        if self.waiting is not None and abs(stamp - stamp_ns(self.waiting)) > age_s * 1e9:
            self.of_waiting()  # no revolution arrived for it: report it instead of waiting
        period_ns = 1e9 / self.config.max_rate_hz
        if self.waiting is None and (self.last_ns is None or not 0 <= stamp - self.last_ns < 0.99 * period_ns):
            self.waiting = message

    def watch_for_depth(self, stamp: int) -> None:
        newest = max(self.last_ns or 0, self.pictures_since_ns or stamp)
        if self.pictures_since_ns is None or stamp < self.pictures_since_ns:
            self.pictures_since_ns = newest = stamp
        if stamp - newest > _SILENT_NS:
            words = (
                f"no /depth/raw for {(stamp - newest) / 1e9:.0f} s: does depth_estimator run? source lidar needs none"
            )
            self.diagnose("scale", WARN, words)

    def on_cloud(self, message: Any) -> None:
        self.clouds.append(message)
        # The next revolution would be nearer only if the image was taken in its second half.
        if self.waiting is not None and middle_ns(message) >= stamp_ns(self.waiting):
            self.of_waiting()

    def of_waiting(self) -> None:
        picture, self.waiting = self.waiting, None
        self.handle(None, picture.header.frame_id, stamp_ns(picture))

    def on_depth(self, message: Any) -> None:
        if self.config.source != "lidar":
            self.handle(image_array(message), message.header.frame_id, stamp_ns(message))

    def handle(self, raw: NDArray[np.float32] | None, camera: str, stamp: int) -> None:
        """Compute, report and publish the depth of the image taken at ``stamp``."""
        if self.last_ns is not None and stamp < self.last_ns - _KEEP_NS:
            self.log.warning("time went back by %.1f s: restarting", (self.last_ns - stamp) / 1e9)
            self.selector.restart()
        self.last_ns = stamp
        result = self.estimate(raw, camera, stamp)
        self.diagnose(
            "scale", OK if result.ok else WARN, result.message, scale=round(result.scale, 4),
            quality=round(result.quality, 3), points=result.points, source=result.source,
            sigma=round(result.relative_sigma, 4),
        )  # fmt: skip
        if result.ok:
            self.scaled.publish(image_message(result.depth_m, "32FC1", camera, stamp))
        self.offer_keyframe(result, camera, stamp)
        self.let_go(stamp)

    def estimate(self, raw: NDArray[np.float32] | None, camera: str, stamp: int) -> DepthResult:
        """Depth from the revolution nearest in time; the result's message names missing inputs."""
        size = (self.config.rows, 2 * self.config.rows)
        asks = raw is None or self.config.scaler.method != "as_estimated"
        try:
            up, height_m = self.stance(camera, stamp)
            points = self.points_in_camera(camera, stamp) if asks else np.empty((0, 3))
        except TransformError as error:
            return self.source.refuse(raw, str(error), size)
        if points is None:
            return self.source.refuse(raw, f"no LiDAR revolution within {self.config.max_cloud_age_s} s", size)
        result = self.source.estimate(raw, points, up, height_m, size=size)
        if not asks:
            return result  # a camera at another place has another height
        return without_body(result, up, height_m, self.config.body_elevation_deg)

    def stance(self, camera: str, stamp: int) -> tuple[NDArray[np.float64], float]:
        """Up direction in the camera's frame (odometry is level), and the camera's height above the ground.

        Raises:
            TransformError: the poses are not known.
        """
        base_from_camera = self.transforms.lookup(self.config.base_frame, camera, stamp)
        odom_from_camera = self.transforms.lookup(self.config.odom_frame, camera, stamp)
        return np.array(odom_from_camera[2, :3]), float(base_from_camera[2, 3])

    def points_in_camera(self, camera: str, stamp: int) -> NDArray[np.float64] | None:
        """(N, 3) points in the camera's frame at ``stamp``; None without a revolution near it.

        Raises:
            TransformError: the poses are not known.
        """
        best: tuple[float, Any, NDArray[np.floating]] | None = None
        for cloud in self.clouds:
            times = cloud_array(cloud)["time"]
            if len(times) == 0:
                continue
            gap_s = abs(middle_ns(cloud) - stamp) / 1e9
            if gap_s <= self.config.max_cloud_age_s and (best is None or gap_s < best[0]):
                best = (gap_s, cloud, times)
        if best is None:
            return None
        _, cloud, times = best
        lidar, odom = cloud.header.frame_id, self.config.odom_frame
        camera_from_odom = self.transforms.lookup(camera, odom, stamp)

        def camera_from_lidar(at_ns: int) -> Matrix:
            return camera_from_odom @ self.transforms.lookup(odom, lidar, at_ns)

        return points_at(cloud_xyz(cloud), times, stamp_ns(cloud), camera_from_lidar)

    def offer_keyframe(self, result: DepthResult, camera: str, stamp: int) -> None:
        picture = self.pictures.get(stamp)
        if picture is None:
            self.diagnose("keyframe", WARN, "the image that this depth belongs to did not arrive")
            return
        try:
            map_from_camera = self.map_from_camera(camera, stamp)
        except TransformError as error:
            self.diagnose("keyframe", WARN, f"no pose: {error}")
            return
        if not self.selector.take(map_from_camera, result.ok, stamp):
            return
        self.keyframe.publish(
            Keyframe(
                header=header(self.config.map_frame, stamp),
                id=self.selector.count,
                pose=pose_message(map_from_camera),
                panorama=picture,
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
        self.diagnose("keyframe", OK if result.ok else WARN, text, id=self.selector.count)
        self.log.info(text)

    def map_from_camera(self, camera: str, stamp: int) -> Matrix:
        """Odometry at the image's time with the newest correction: the map as known at present."""
        map_from_odom = self.transforms.lookup(self.config.map_frame, self.config.odom_frame)
        return map_from_odom @ self.transforms.lookup(self.config.odom_frame, camera, stamp)

    def let_go(self, stamp: int) -> None:
        # Also images far ahead: they belong to the time before the clock went back.
        for old in [other for other in self.pictures if abs(other - stamp) > _KEEP_NS]:
            del self.pictures[old]
        while self.clouds and abs(stamp_ns(self.clouds[0]) - stamp) > _KEEP_NS:
            self.clouds.popleft()


def middle_ns(cloud: Any) -> int:
    """Time of the middle of a revolution; of an empty one, its stamp."""
    times = cloud_array(cloud)["time"]
    return stamp_ns(cloud) + (round(0.5e9 * float(times[0] + times[-1])) if len(times) else 0)


if __name__ == "__main__":
    main(DepthScalerNode)
