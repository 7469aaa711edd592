"""Trains the virtual space from the newest keyframe and renders it, in turns (paper, section IV.A)."""

from __future__ import annotations

import dataclasses
import functools
from dataclasses import dataclass
from typing import Annotated, Any

import numpy as np

from instant_ic.bus import LATCHED, SENSOR, WARN, Node, NodeError, main
from instant_ic.config.ranges import Percent, Positive, PositiveInt, Range, check_ranges
from instant_ic.depth.keyframes import decode_sigma
from instant_ic.msg import (
    CompressedImage,
    Keyframe,
    RenderedView,
    ViewRequest,
    VspaceLayers,
    VspaceStatus,
    compressed_image_message,
    header,
    image_array,
    matrix_from_pose,
    pose_message,
    to_time,
)
from instant_ic.vspace import KeyframeError, State, VirtualSpaceConfig
from instant_ic.vspace.jobs import (
    Incoming,
    KeyframeArrays,
    Outcome,
    SpaceWorker,
    ViewOrder,
    decode_panorama,
    load_robot_mask,
)
from instant_ic.vspace.layers import Layers
from instant_ic.vspace.schedule import JobSchedule, Turns
from instant_ic.vspace_messages import layers_message


@dataclass(frozen=True)
class NerfConfig:
    """Parameters.

    Attributes:
        render_fps: target frame rate of requested views; training gets the remaining time.
        train_ms_per_frame: longest uninterrupted training in ms, and so the longest wait of a requested view. While no
            view is requested, training has all the time.
        train_nice: nice value, 0 to 19, of the threads that train, render and prepare: robot control comes first.
        lockstep_iterations: iterations per tick of ``lockstep_period_s`` in tests and replay.
        lockstep_period_s: period of these ticks, in seconds.
        max_view_pixels: largest view that may be requested; larger requests are refused.
        jpeg_quality: JPEG quality of views, 1 to 100.
        status_period_s: period of ``/vspace/status``, in seconds.
        robot_mask: image, twice as wide as high, white where the panorama shows the robot itself or its stand (see also
            ``space.geometry.body_below_deg``); empty: no mask.
        space: the virtual space itself.
    """

    render_fps: Annotated[float, Range(0.5, 120)] = 10.0
    train_ms_per_frame: Positive = 50.0
    train_nice: Annotated[int, Range(0, 19)] = 5
    lockstep_iterations: PositiveInt = 5
    lockstep_period_s: Positive = 0.1
    max_view_pixels: PositiveInt = 1280 * 720
    jpeg_quality: Percent = 85
    status_period_s: Positive = 0.5
    robot_mask: str = ""
    space: VirtualSpaceConfig = dataclasses.field(default_factory=VirtualSpaceConfig)

    def __post_init__(self) -> None:
        check_ranges(self)


def decode_keyframe(keyframe: Any) -> KeyframeArrays:
    """Arguments of ``VirtualSpace.prepare``.

    Raises:
        KeyframeError: the keyframe is marked unfit, or cannot be decoded.
    """
    if not keyframe.fit:
        raise KeyframeError(f"its depth is marked unfit: {keyframe.message or 'no reason given'}")
    rgb = decode_panorama(np.asarray(keyframe.panorama.data, np.uint8))
    if keyframe.depth.encoding != "32FC1":
        raise KeyframeError(f"depth must be 32FC1 (got {keyframe.depth.encoding!r})")
    sigma = decode_sigma(image_array(keyframe.sigma)) if keyframe.sigma.data.size else keyframe.relative_sigma
    return rgb, image_array(keyframe.depth), matrix_from_pose(keyframe.pose), sigma


class NerfNode(Node[NerfConfig]):
    """One thread renders and trains in turns, another prepares a new keyframe; ``JobSchedule`` decides what is next."""

    name = "nerf"
    worker_class: type[SpaceWorker] = SpaceWorker
    live_parameters = ("render_fps", "train_ms_per_frame", "lockstep_iterations", "max_view_pixels", "jpeg_quality")

    def setup(self) -> None:
        config = self.config
        try:
            robot = load_robot_mask(config.robot_mask) if config.robot_mask else None
        except ValueError as error:
            raise NodeError(str(error)) from error
        self.view_out = self.publisher("/vspace/view", RenderedView, qos=SENSOR)
        self.image_out = self.publisher("/vspace/image/compressed", CompressedImage, qos=SENSOR)
        self.status_out = self.publisher("/vspace/status", VspaceStatus, qos=LATCHED)
        self.layers_out = self.publisher("/vspace/layers", VspaceLayers, qos=LATCHED)
        self.work = self.worker_class(config.space, robot, config.train_nice, warm=not self.lockstep)
        renderer = self.background(self.work.run, self.on_rendered)
        preparer = self.background(self.work.run, self.on_prepared)
        turns = Turns(config.render_fps, config.train_ms_per_frame)
        self.schedule = JobSchedule(config.space, turns, renderer.submit, preparer.submit, self.lockstep)
        self.schedule.start()
        self.subscribe("/keyframe", Keyframe, self.on_keyframe, qos=LATCHED)
        self.subscribe("/view/request", ViewRequest, self.on_request, qos=SENSOR)
        self.timer(config.status_period_s, self.on_timer)
        if self.lockstep:
            self.timer(config.lockstep_period_s, lambda: self.schedule.train(self.config.lockstep_iterations))
        self.publish_status()

    def reconfigure(self, config: NerfConfig) -> None:
        super().reconfigure(config)
        self.schedule.turns.render_fps = config.render_fps
        self.schedule.turns.train_ms_per_frame = config.train_ms_per_frame

    def on_keyframe(self, keyframe: Any) -> None:
        decode = functools.partial(decode_keyframe, keyframe)
        image = np.asarray(keyframe.panorama.data, np.uint8).tobytes()
        self.schedule.offer_keyframe(Incoming(keyframe.id, keyframe, self.clock.now_ns(), decode, image))

    def on_request(self, request: Any) -> None:
        most = self.config.max_view_pixels
        if self.schedule.state == State.EMPTY:
            self.diagnose("view", WARN, f"no view can be rendered yet: {self.schedule.text()}")
        elif int(request.width) * int(request.height) > most:
            text = f"{request.width} x {request.height} requested, max_view_pixels is {most}"
            self.diagnose("view", WARN, text)
        else:
            pose = functools.partial(matrix_from_pose, request.pose)
            size = request.width, request.height, request.fov_rad
            self.schedule.request_view(ViewOrder(request.id, request, pose, *size, self.config.jpeg_quality))

    def on_prepared(self, outcome: Outcome) -> None:
        self.schedule.take_prepared(outcome)
        self.report(outcome)
        if isinstance(outcome.made, Layers):
            self.layers_out.publish(layers_message(outcome.made, self.clock.now_ns()))
        self.schedule.next()

    def on_timer(self) -> None:
        self.schedule.wants_layers = self.layers_out.subscriber_count > 0
        self.schedule.next()
        self.publish_status()

    def on_rendered(self, outcome: Outcome) -> None:
        changed = self.schedule.take(outcome, self.clock.now_ns())
        self.report(outcome)
        if outcome.encoded is not None:
            self.publish_view(outcome)
        if changed:
            self.publish_status()
        self.schedule.next()

    def report(self, outcome: Outcome) -> None:
        for finding in self.schedule.findings(outcome):
            values = {} if finding.id is None else {"id": finding.id}
            self.diagnose(finding.name, finding.level, finding.text, **values)
        if outcome.error is not None and outcome.is_bug:
            self.fault(f"virtual space, {outcome.job.kind.value}", outcome.error)

    def publish_view(self, outcome: Outcome) -> None:
        order, encoded, keyframe = outcome.job.view, outcome.encoded, self.schedule.keyframe
        assert order is not None and encoded is not None
        now = self.clock.now_ns()
        image = compressed_image_message(encoded.jpeg, "map", now)
        self.view_out.publish(
            RenderedView(
                header=header("map", now),
                request_id=order.id,
                keyframe_id=0 if keyframe is None else keyframe.id,
                pose=encoded.order.message.pose,
                fov_rad=order.fov_rad,
                width=order.width,
                height=order.height,
                confidence=float(encoded.view.confidence.mean()),
                render_ms=self.schedule.figures(now).render_ms,
                image=image,
            )
        )
        self.image_out.publish(image)

    def publish_status(self) -> None:
        now, keyframe = self.clock.now_ns(), self.schedule.keyframe
        figures = self.schedule.figures(now)
        self.status_out.publish(
            VspaceStatus(
                header=header("map", now),
                keyframe_pose=pose_message(np.eye(4)) if keyframe is None else keyframe.message.pose,
                keyframe_stamp=to_time(0) if keyframe is None else keyframe.message.header.stamp,
                **vars(figures),
            )
        )


if __name__ == "__main__":
    main(NerfNode)
