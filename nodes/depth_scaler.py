"""Computes metric depth from the network's estimate, the LiDAR or both, and keyframes (paper, section IV.C)."""

from __future__ import annotations

import functools
from dataclasses import fields, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from instant_ic.bus import LATCHED, OK, SENSOR, WARN, Node, NodeError, main
from instant_ic.depth.inputs import KEEP_NS, DepthRequests, HeldImage, RecentInputs, Revolution, RevolutionTrigger
from instant_ic.depth.keyframes import KeyframeSelector, encode_sigma
from instant_ic.depth.manifest import ManifestError
from instant_ic.depth.metric_depth import MetricDepth, MetricDepthConfig
from instant_ic.depth.model import DepthModel
from instant_ic.depth.node_config import DepthScalerConfig
from instant_ic.depth.sources import DepthResult, DepthSource
from instant_ic.geometry.transforms import TransformError
from instant_ic.limits import decode_rgb
from instant_ic.mapping.local_model import warm_up
from instant_ic.mapping.mapper import CloudError, LocalMapper
from instant_ic.msg import (
    CompressedImage,
    DepthModelInfo,
    Header,
    Image,
    Keyframe,
    MessageError,
    PointCloud2,
    cloud_array,
    cloud_of_points,
    cloud_xyz,
    header,
    image_array,
    image_message,
    pose_message,
    stamp_ns,
)

_SILENT_S = 10.0  # without an answer to any request
_LOCAL_MAP_S = 2.0


class DepthScalerNode(Node[DepthScalerConfig]):
    """``/camera/image/compressed``, ``/tf`` → ``/depth/request``; with ``/depth/raw`` and ``/lidar/points`` →
    ``/depth/scaled``, ``/keyframe``, and the local 3D model as ``/map/local`` where someone subscribes.
    """

    name = "depth_scaler"
    live_parameters = tuple(
        one.name for one in fields(DepthScalerConfig) if one.name not in ("completion", "provider", "threads")
    )

    def setup(self) -> None:
        if self.config.source != "network":
            warm_up()
        self.source = DepthSource(self.config.depth_source)
        self.completion = self.load_completion()
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
        self.metric = MetricDepth(self.source, self.tf, self.inputs, self.metric_config, self.new_mapper())
        self.local_map = self.publisher("/map/local", PointCloud2, qos=SENSOR)
        self.timer(_LOCAL_MAP_S, self.on_local_map)
        self.subscribe("/depth/model", DepthModelInfo, self.on_model, qos=LATCHED)
        self.subscribe("/camera/image/compressed", CompressedImage, self.on_image, qos=SENSOR)
        self.subscribe("/lidar/points", PointCloud2, self.on_cloud, qos=SENSOR)
        self.subscribe("/depth/raw", Image, self.on_depth, qos=SENSOR)

    def reconfigure(self, config: DepthScalerConfig) -> None:
        if config.source == "completed" and self.completion is None:
            raise ValueError("source completed needs its model from the start: start the node with it")
        super().reconfigure(config)
        self.source.config, self.selector.config = config.depth_source, config.keyframes
        self.metric.config = self.metric_config
        if self.metric.mapper.config != config.mapping or self.metric.mapper.frames != (
            config.map_frame, config.odom_frame,
        ):  # fmt: skip
            self.metric.mapper = self.new_mapper()
        self.trigger.clear()
        if self.model is not None:
            self.on_model(self.model)
        self.warn_of_method()

    def load_completion(self) -> DepthModel | None:
        if self.config.source != "completed":
            return None
        try:
            model = DepthModel.find(self.config.completion, self.config.threads, self.config.provider)
        except (ManifestError, FileNotFoundError) as error:
            raise NodeError(str(error)) from error
        self.log.info("depth completed by %s on %s", model.manifest.name, model.provider)
        return model

    @property
    def metric_config(self) -> MetricDepthConfig:
        if self.completion is None:
            return self.config.metric
        return replace(self.config.metric, rows=self.completion.manifest.input_height)

    def new_mapper(self) -> LocalMapper:
        return LocalMapper(self.tf, self.config.mapping, self.config.map_frame, self.config.odom_frame)

    def warn_of_method(self) -> None:
        if self.config.scaler.method == "as_estimated" and not self.config.of_lidar:
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
        if self.config.of_lidar:
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
        try:
            time_s, xyz = cloud_array(message)["time"], functools.partial(cloud_xyz, message)
        except (MessageError, ValueError) as error:  # a cloud of another driver
            return self.diagnose("points", WARN, f"/lidar/points cannot be used: {error}")
        self.diagnose("points", OK, f"{len(time_s)} points")
        revolution = Revolution(message.header.frame_id, stamp_ns(message), time_s, xyz)
        self.add_to_model(revolution)
        self.inputs.revolutions.append(revolution)
        image = self.trigger.revolution(revolution.middle_ns)
        if image is not None:
            self.handle(None, image.frame, image.stamp_ns)

    def add_to_model(self, revolution: Revolution) -> None:
        if self.config.source == "network":
            return
        mapper = self.metric.mapper
        try:
            mapper.revolution(revolution.frame, revolution.stamp_ns, revolution.time_s, revolution.xyz)
        except (CloudError, TransformError, MessageError, ValueError) as error:
            return self.diagnose("local model", WARN, f"no points added: {error}")
        self.diagnose("local model", OK, "growing", revolutions=mapper.model.revolutions)

    def on_local_map(self) -> None:
        if self.local_map.subscriber_count and self.metric.mapper.model.revolutions:
            cloud = cloud_of_points(self.metric.mapper.cloud(), self.config.map_frame, self.image_ns)
            self.local_map.publish(cloud)

    def on_depth(self, message: Any) -> None:
        if not self.config.of_lidar:
            self.requests.answered()
            self.handle(image_array(message), message.header.frame_id, stamp_ns(message))

    def handle(self, raw: NDArray[np.float32] | None, camera: str, stamp: int) -> None:
        """Compute, report and publish the depth of the image taken at ``stamp``."""
        self.last_ns = stamp
        image, model = self.inputs.images.get(stamp), self.completion

        def complete(prior: NDArray[np.float32]) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
            assert image is not None and model is not None
            size = 2 * model.manifest.input_width, 2 * model.manifest.input_height
            return model.complete(decode_rgb(image.data, *size), prior)

        result = self.metric.estimate(raw, camera, stamp, complete if image is not None and model is not None else None)
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
