"""Computes metric depth from the network's estimate, the LiDAR or both, and takes keyframes (paper, section IV.C)."""

from __future__ import annotations

import functools
from dataclasses import fields
from typing import Any

from instant_ic.adapters.depth import held_image, keyframe_message, revolution_of
from instant_ic.bus import LATCHED, OK, SENSOR, WARN, Node, NodeError, main
from instant_ic.depth.chain import DepthChain, DepthScalerConfig
from instant_ic.depth.inference import Floats, Inference
from instant_ic.depth.inputs import HeldImage
from instant_ic.depth.manifest import ManifestError
from instant_ic.depth.sources import DepthResult, complete
from instant_ic.mapping.local_model import warm_up
from instant_ic.msg import (
    CompressedImage,
    DepthModelInfo,
    Header,
    Image,
    Keyframe,
    PointCloud2,
    cloud_of_points,
    header,
    image_array,
    image_message,
)

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
        config = self.config
        self.completion: Inference | None = None
        if config.source != "network":
            warm_up()
        if config.source == "completed":
            try:
                self.completion = Inference(config.completion, config.provider, config.threads, self.stop)
            except (ManifestError, FileNotFoundError) as error:
                raise NodeError(str(error)) from error
        self.request = self.publisher("/depth/request", Header, qos=LATCHED)
        self.request.publish(header("", 0))  # requests any image; from now on, depth_estimator waits for requests
        self.scaled = self.publisher("/depth/scaled", Image, qos=SENSOR)
        self.keyframe = self.publisher("/keyframe", Keyframe, qos=LATCHED)
        self.warn_of_method()
        self.chain = DepthChain(config, self.tf, self.diagnose)
        self.worker = self.background(self.corrected, self.publish_depth)
        self.local_map = self.publisher("/map/local", PointCloud2, qos=SENSOR)
        self.timer(_LOCAL_MAP_S, self.on_local_map)
        self.subscribe("/depth/model", DepthModelInfo, lambda m: self.chain.adopt(m.name, m.output_kind), qos=LATCHED)
        self.subscribe("/camera/image/compressed", CompressedImage, self.on_image, qos=SENSOR)
        self.subscribe("/lidar/points", PointCloud2, self.on_cloud, qos=SENSOR)
        self.subscribe("/depth/raw", Image, self.on_depth, qos=SENSOR)

    def reconfigure(self, config: DepthScalerConfig) -> None:
        if config.source == "completed" and self.completion is None:
            raise ValueError("source completed needs its model from the start: start the node with it")
        self.chain.reconfigure(config)
        super().reconfigure(config)
        self.warn_of_method()

    def warn_of_method(self) -> None:
        if self.config.scaler.method == "as_estimated" and self.config.source != "lidar":
            self.log.warning("depth is used as estimated, without the LiDAR: for recordings, not for driving")

    def on_image(self, message: Any) -> None:
        """Have the depth of an image computed if the image could become a keyframe."""
        image = held_image(message)
        if (back_s := self.chain.add_image(image, message)) > 0:
            self.log.warning("time went back by %.1f s: restarting", back_s)
        due = self.chain.due(image)
        if due and self.config.source == "lidar":
            self.handle(self.chain.hold(image))
        elif due and not self.worker.busy and self.chain.request_due(image.stamp_ns):  # else one may be on its way
            self.request.publish(header(image.frame, image.stamp_ns))

    def on_cloud(self, message: Any) -> None:
        try:
            revolution = revolution_of(message)
        except ValueError as error:  # a cloud of another driver
            return self.diagnose("points", WARN, f"/lidar/points cannot be used: {error}")
        self.handle(self.chain.add_revolution(revolution))

    def on_local_map(self) -> None:
        mapper = self.chain.mapper
        if self.local_map.subscriber_count and mapper.model.revolutions:
            self.local_map.publish(cloud_of_points(mapper.cloud(), "map", self.chain.image_ns))

    def on_depth(self, message: Any) -> None:
        if self.config.source != "lidar":
            self.chain.requests.answered()
            self.handle(held_image(message), image_array(message))

    def handle(self, image: HeldImage | None, raw: Floats | None = None) -> None:
        """Compute the depth of an image and publish it, after a completion in the background if one is configured."""
        if image is None:
            return
        result = self.chain.estimate(raw, image)
        panorama = self.chain.images.get(image.stamp_ns)
        if result.prior is None or panorama is None:
            self.publish_depth((image, result))
        else:
            self.worker.submit((image, result, panorama.data))

    def corrected(self, job: tuple[HeldImage, DepthResult, bytes]) -> tuple[HeldImage, DepthResult]:
        image, result, data = job
        assert self.completion is not None  # only with a completion do results have a prior
        return image, complete(result, functools.partial(self.completion.complete, data))

    def publish_depth(self, done: tuple[HeldImage, DepthResult]) -> None:
        image, result = done
        self.chain.report(result)
        if result.ok:
            self.scaled.publish(image_message(result.depth_m, "32FC1", image.frame, image.stamp_ns))
        pose = self.chain.keyframe_pose(result, image)
        if pose is None:
            return
        panorama, count = self.chain.images[image.stamp_ns], self.chain.selector.count
        self.keyframe.publish(keyframe_message(count, "map", pose, panorama, result))
        text, level = f"keyframe {count}: {result.message}", OK if result.ok else WARN
        before = self.diagnoses().get("keyframe", (OK,))[0]
        self.diagnose("keyframe", level, text, id=count)
        if level == before:  # a change of level is logged with the diagnosis
            self.log.info(text)


if __name__ == "__main__":
    main(DepthScalerNode)
