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
from instant_ic.vspace.jobs import IncomingKeyframe, JobOutcome, SpaceWorker, ViewOrder, load_robot_mask
from instant_ic.vspace.schedule import JobSchedule, Turns

_STATUS_S = 0.5
_LOCKSTEP_S, _LOCKSTEP_ITERATIONS = 0.1, 5  # in tests and replay training runs by iterations, not by time


class NerfNode(Node[NerfConfig]):
    """One thread takes keyframes, renders and trains in turn; ``JobSchedule`` decides what is next."""

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
        self.work = SpaceWorker(config.space, robot, warm=not self.lockstep)
        worker = self.background(self.work.run, self.on_outcome)
        turns = Turns(config.render_fps, config.train_ms_per_frame)
        self.schedule = JobSchedule(config.space, turns, worker.submit, self.lockstep)
        self.schedule.start()
        self.subscribe("/keyframe", Keyframe, self.on_keyframe, qos=LATCHED)
        self.subscribe("/view/request", ViewRequest, self.on_request, qos=SENSOR)
        self.timer(_STATUS_S, self.publish_status)
        if self.lockstep:
            self.timer(_LOCKSTEP_S, lambda: self.schedule.train(_LOCKSTEP_ITERATIONS))
        self.publish_status()

    def reconfigure(self, config: NerfConfig) -> None:
        super().reconfigure(config)
        self.schedule.turns.render_fps = config.render_fps
        self.schedule.turns.train_ms_per_frame = config.train_ms_per_frame

    def on_keyframe(self, keyframe: Any) -> None:
        decode = functools.partial(decode_keyframe, keyframe)
        image = np.asarray(keyframe.panorama.data, np.uint8).tobytes()
        self.schedule.offer_keyframe(IncomingKeyframe(keyframe.id, keyframe, self.clock.now_ns(), decode, image))

    def on_request(self, request: Any) -> None:
        most = self.config.max_view_pixels
        if self.schedule.state == SpaceState.EMPTY:
            self.diagnose("view", WARN, f"no view can be rendered yet: {self.schedule.text()}")
        elif int(request.width) * int(request.height) > most:
            text = f"{request.width} x {request.height} requested, max_view_pixels is {most}"
            self.diagnose("view", WARN, text)
        else:
            pose = functools.partial(matrix_from_pose, request.pose)
            size = request.width, request.height, request.fov_rad
            self.schedule.request_view(ViewOrder(request.id, request, pose, *size, self.config.jpeg_quality))

    def on_outcome(self, outcome: JobOutcome) -> None:
        changed = self.schedule.take(outcome, self.clock.now_ns())
        self.report(outcome)
        if outcome.layers is not None:
            self.layers_out.publish(layers_message(outcome.layers, self.clock.now_ns()))
        if outcome.encoded is not None:
            self.publish_view(outcome)
        if changed:
            self.publish_status()
        self.schedule.next()

    def report(self, outcome: JobOutcome) -> None:
        self.diagnose_all(*self.schedule.findings(outcome))
        if outcome.error is not None and outcome.is_bug:
            self.callbacks.fault(f"virtual space, {outcome.job.kind.value}", outcome.error)

    def publish_view(self, outcome: JobOutcome) -> None:
        assert outcome.job.view is not None and outcome.encoded is not None
        view = view_message(outcome.job.view, outcome.encoded, self.schedule, self.clock.now_ns())
        self.view_out.publish(view)
        self.image_out.publish(view.image)

    def publish_status(self) -> None:
        self.status_out.publish(status_message(self.schedule, self.clock.now_ns()))


if __name__ == "__main__":
    main(NerfNode)
