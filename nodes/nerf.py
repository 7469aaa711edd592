"""Trains the virtual space from the newest keyframe and renders it, in turns (paper, section IV.A)."""

from __future__ import annotations

import functools
from typing import Any

import numpy as np

from instant_ic.adapters.nerf import decode_keyframe, status_message, view_message
from instant_ic.adapters.vspace import layers_message
from instant_ic.bus import LATCHED, SENSOR, WARN, Node, NodeError, main
from instant_ic.msg import (
    CompressedImage,
    Keyframe,
    RenderedView,
    ViewRequest,
    VspaceLayers,
    VspaceStatus,
    matrix_from_pose,
)
from instant_ic.vspace import SpaceState
from instant_ic.vspace.config import NerfConfig
from instant_ic.vspace.layers import Layers
from instant_ic.vspace.prior import load_robot_mask
from instant_ic.vspace.worker import EncodedView, IncomingKeyframe, Job, SpaceWorker, Turns, ViewOrder

_STATUS_S = 0.5
_LOCKSTEP_S, _LOCKSTEP_ITERATIONS = 0.1, 5  # in tests and replay, training is limited by iterations, not by time


class NerfNode(Node[NerfConfig]):
    """``/keyframe``, ``/view/request`` → ``/vspace/view``, ``/vspace/layers``, ``/vspace/status``."""

    name = "nerf"
    live_parameters = ("render_fps", "train_ms_per_frame", "max_view_pixels", "jpeg_quality")

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
        turns = Turns(config.render_fps, config.train_ms_per_frame)
        self.worker = worker = SpaceWorker(config.space, turns, self.clock.now_ns, robot, self.lockstep)
        worker.submit = self.background(worker.run, self.on_done).submit
        worker.diagnose, worker.on_layers, worker.on_view = self.diagnose, self.publish_layers, self.publish_view
        worker.start()
        self.subscribe("/keyframe", Keyframe, self.on_keyframe, qos=LATCHED)
        self.subscribe("/view/request", ViewRequest, self.on_request, qos=SENSOR)
        self.timer(_STATUS_S, self.publish_status)
        if self.lockstep:
            self.timer(_LOCKSTEP_S, lambda: worker.train(_LOCKSTEP_ITERATIONS))
        self.publish_status()

    def reconfigure(self, config: NerfConfig) -> None:
        super().reconfigure(config)
        self.worker.turns.render_fps = config.render_fps
        self.worker.turns.train_ms_per_frame = config.train_ms_per_frame

    def on_keyframe(self, keyframe: Any) -> None:
        decode = functools.partial(decode_keyframe, keyframe)
        image = np.asarray(keyframe.panorama.data, np.uint8).tobytes()
        self.worker.offer_keyframe(IncomingKeyframe(keyframe.id, keyframe, self.clock.now_ns(), decode, image))

    def on_request(self, request: Any) -> None:
        most = self.config.max_view_pixels
        if self.worker.state == SpaceState.EMPTY:
            self.diagnose("view", WARN, f"no view can be rendered yet: {self.worker.text()}")
        elif int(request.width) * int(request.height) > most:
            text = f"{request.width} x {request.height} requested, max_view_pixels is {most}"
            self.diagnose("view", WARN, text)
        else:
            pose = functools.partial(matrix_from_pose, request.pose)
            size = request.width, request.height, request.fov_rad
            self.worker.request_view(ViewOrder(request.id, request, pose, *size, self.config.jpeg_quality))

    def on_done(self, job: Job) -> None:
        before = self.worker.state, self.worker.keyframe
        self.worker.take(job)
        if job.error is not None and job.is_bug:
            self.callbacks.fault(f"virtual space, {job.name}", job.error)
        if (self.worker.state, self.worker.keyframe) != before:
            self.publish_status()
        self.worker.next()

    def publish_layers(self, layers: Layers) -> None:
        self.layers_out.publish(layers_message(layers, self.clock.now_ns()))

    def publish_view(self, order: ViewOrder, encoded: EncodedView) -> None:
        view = view_message(order, encoded, self.worker, self.clock.now_ns())
        self.view_out.publish(view)
        self.image_out.publish(view.image)

    def publish_status(self) -> None:
        self.status_out.publish(status_message(self.worker, self.clock.now_ns()))


if __name__ == "__main__":
    main(NerfNode)
