"""Scales the estimated depth by the LiDAR (paper, section IV.C) and makes keyframes of it."""

from __future__ import annotations

from collections import deque
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy.typing import NDArray

from instant_ic.bus import LATCHED, OK, SENSOR, WARN, Node, main
from instant_ic.depth.deskew import points_at
from instant_ic.depth.keyframes import KeyframeConfig, KeyframeSelector
from instant_ic.depth.scaler import DepthScaler, ScaleFit, ScalerConfig
from instant_ic.geometry.poses import Matrix
from instant_ic.geometry.transforms import TransformError
from instant_ic.msg import (
    CompressedImage,
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
from instant_ic.ranges import Positive, check_ranges

# Pictures and clouds older than this against the newest depth are let go of.
_KEEP_NS = 4_000_000_000
_MAX_PICTURES = 150
_MAX_CLOUDS = 40


@dataclass(frozen=True)
class DepthScalerConfig:
    """Parameters.

    Attributes:
        scaler: how the scale is found.
        keyframes: when keyframes are taken.
        max_cloud_age_s: the middle of a revolution may lie so far from the picture's time.
        map_frame, odom_frame: frames of the keyframe's pose and of the motion compensation.
    """

    scaler: ScalerConfig = field(default_factory=ScalerConfig)
    keyframes: KeyframeConfig = field(default_factory=KeyframeConfig)
    max_cloud_age_s: Positive = 0.3
    map_frame: str = "map"
    odom_frame: str = "odom"

    def __post_init__(self) -> None:
        check_ranges(self)


class DepthScalerNode(Node[DepthScalerConfig]):
    """``/depth/raw``, ``/lidar/points``, ``/tf``, ``/camera/image/compressed`` → ``/depth/scaled``, ``/keyframe``."""

    name = "depth_scaler"
    live_parameters = ("scaler", "keyframes", "max_cloud_age_s", "map_frame", "odom_frame")

    def setup(self) -> None:
        self.scaler = DepthScaler(self.config.scaler)
        self.selector = KeyframeSelector(self.config.keyframes)
        self.pictures: dict[int, Any] = {}
        self.clouds: deque[Any] = deque(maxlen=_MAX_CLOUDS)
        self.last_ns: int | None = None
        self.scaled = self.publisher("/depth/scaled", Image, qos=SENSOR)
        self.keyframe = self.publisher("/keyframe", Keyframe, qos=LATCHED)
        self.warn_of_method()
        self.transforms = self.tf  # subscribes now: the past must be known when the first depth comes
        self.subscribe("/camera/image/compressed", CompressedImage, self.on_picture, qos=SENSOR)
        self.subscribe("/lidar/points", PointCloud2, self.clouds.append, qos=SENSOR)
        self.subscribe("/depth/raw", Image, self.on_depth, qos=SENSOR)

    def reconfigure(self, config: DepthScalerConfig) -> None:
        super().reconfigure(config)
        self.scaler.config, self.selector.config = config.scaler, config.keyframes
        self.warn_of_method()

    def warn_of_method(self) -> None:
        if self.config.scaler.method == "as_estimated":
            self.log.warning("depth is taken as estimated, the LiDAR is not asked: for recordings, not for driving")

    def on_picture(self, message: Any) -> None:
        self.pictures[stamp_ns(message)] = message
        if len(self.pictures) > _MAX_PICTURES:
            del self.pictures[next(iter(self.pictures))]

    def on_depth(self, message: Any) -> None:
        stamp = stamp_ns(message)
        if self.last_ns is not None and stamp < self.last_ns - _KEEP_NS:
            self.log.warning("time went back by %.1f s: starting anew", (self.last_ns - stamp) / 1e9)
            self.selector.restart()
        self.last_ns = stamp
        camera = message.header.frame_id
        fit = self.fit(image_array(message), camera, stamp)
        self.diagnose(
            "scale", OK if fit.ok else WARN, fit.message, scale=round(fit.scale, 4), quality=round(fit.quality, 3),
            points=fit.points,
        )  # fmt: skip
        if fit.ok:
            self.scaled.publish(image_message(fit.depth_m, "32FC1", camera, stamp))
        self.offer_keyframe(fit, camera, stamp)
        self.let_go(stamp)

    def fit(self, depth: NDArray[np.float32], camera: str, stamp: int) -> ScaleFit:
        """Scales by the revolution nearest in time; what is missing is told by the fit's message."""
        if self.config.scaler.method == "as_estimated":
            return self.scaler.as_estimated(depth)
        try:
            points = self.points_in_camera(camera, stamp)
        except TransformError as error:
            return self.scaler.refuse(depth, str(error))
        if points is None:
            return self.scaler.refuse(depth, f"no LiDAR revolution within {self.config.max_cloud_age_s} s")
        return self.scaler.fit(depth, points)

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
            middle_ns = stamp_ns(cloud) + 0.5e9 * float(times[0] + times[-1])
            gap_s = abs(middle_ns - stamp) / 1e9
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

    def offer_keyframe(self, fit: ScaleFit, camera: str, stamp: int) -> None:
        picture = self.pictures.get(stamp)
        if picture is None:
            self.diagnose("keyframe", WARN, "the picture that this depth is of did not arrive here")
            return
        try:
            map_from_camera = self.map_from_camera(camera, stamp)
        except TransformError as error:
            self.diagnose("keyframe", WARN, f"no pose: {error}")
            return
        if not self.selector.take(map_from_camera, fit.ok, stamp):
            return
        self.keyframe.publish(
            Keyframe(
                header=header(self.config.map_frame, stamp),
                id=self.selector.count,
                pose=pose_message(map_from_camera),
                panorama=picture,
                depth=image_message(fit.depth_m, "32FC1", camera, stamp),
                scale=fit.scale,
                quality=fit.quality,
                relative_sigma=fit.relative_sigma,
                fit=fit.ok,
                message=fit.message,
            )
        )
        text = f"keyframe {self.selector.count}: {fit.message}"
        self.diagnose("keyframe", OK if fit.ok else WARN, text, id=self.selector.count)
        self.log.info(text)

    def map_from_camera(self, camera: str, stamp: int) -> Matrix:
        """Odometry of the picture's time under the newest correction: the map as it is known now."""
        map_from_odom = self.transforms.lookup(self.config.map_frame, self.config.odom_frame)
        return map_from_odom @ self.transforms.lookup(self.config.odom_frame, camera, stamp)

    def let_go(self, stamp: int) -> None:
        # Also what is far ahead: it belongs to the time before the clock went back.
        for old in [other for other in self.pictures if abs(other - stamp) > _KEEP_NS]:
            del self.pictures[old]
        while self.clouds and abs(stamp_ns(self.clouds[0]) - stamp) > _KEEP_NS:
            self.clouds.popleft()


if __name__ == "__main__":
    main(DepthScalerNode)
