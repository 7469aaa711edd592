"""Trains the virtual space from the newest keyframe and draws it by turns (paper, section IV.A)."""

from __future__ import annotations

import dataclasses
import math
import os
import sys
import threading
import time
from collections import deque
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any

import cv2
import numpy as np

from instant_ic.bus import ERROR, LATCHED, OK, SENSOR, WARN, Node, main
from instant_ic.depth.keyframes import decode_sigma
from instant_ic.msg import (
    CompressedImage,
    Keyframe,
    RenderedView,
    ViewRequest,
    VspaceStatus,
    compressed_image_message,
    header,
    image_array,
    pose_matrix,
    pose_message,
    to_time,
)
from instant_ic.nerf import KeyframeError, Space, State, Status, View, VirtualSpaceConfig, make_space
from instant_ic.nerf.warm_up import warm_up
from instant_ic.ranges import Percent, Positive, PositiveInt, Range, check_ranges


@dataclass(frozen=True)
class NerfConfig:
    """Parameters.

    Attributes:
        train_slice_ms: training between two pictures, at least; a request waits about this long.
        train_share: training's time between two pictures, against the last picture's, where that is more.
        train_share_until_ready: the same before the space is fit to show: there is more need of training than pictures.
        train_nice: of the thread that trains and draws: what steers the robot comes first on a busy machine; 0 to 19.
        lockstep_iterations: iterations at each tick of ``lockstep_period_s`` in tests and replay.
        lockstep_period_s: see ``lockstep_iterations``.
        max_view_pixels: larger requests are refused.
        jpeg_quality: 1 to 100.
        status_period_s: of ``/vspace/status``.
        space: the virtual space itself.
    """

    train_slice_ms: Positive = 30.0
    train_share: Positive = 0.3
    train_share_until_ready: Positive = 2.0
    train_nice: Annotated[int, Range(0, 19)] = 5
    lockstep_iterations: PositiveInt = 5
    lockstep_period_s: Positive = 0.1
    max_view_pixels: PositiveInt = 1280 * 720
    jpeg_quality: Percent = 85
    status_period_s: Positive = 0.5
    space: VirtualSpaceConfig = dataclasses.field(default_factory=VirtualSpaceConfig)

    def __post_init__(self) -> None:
        check_ranges(self)


@dataclass(frozen=True)
class Job:
    """One piece of work for the worker: ``warm_up``, ``keyframe``, ``draw`` or ``train``."""

    kind: str
    message: Any = None
    budget_ms: float = 0.0


@dataclass(frozen=True)
class Outcome:
    """What a job came to; ``error`` is a fault that the job did not expect."""

    job: Job
    status: Status | None = None
    view: View | None = None
    jpeg: bytes = b""
    mask_png: bytes = b""
    elapsed_ms: float = 0.0
    refused: str = ""
    error: Exception | None = None


class NerfNode(Node[NerfConfig]):
    """Hands the worker one job at a time: a new keyframe first, then pictures and slices of training by turns."""

    name = "nerf"
    live_parameters = (
        *("train_slice_ms", "train_share", "train_share_until_ready"),
        *("lockstep_iterations", "max_view_pixels", "jpeg_quality"),
    )

    def setup(self) -> None:
        self.space: Space | None = None  # touched by the worker alone
        self.keyframe: Any = None  # newest that the space has taken
        self.shown: Any = None  # the one that pictures show: the one before while the newest is learnt
        self.status: Status | None = None
        self.waiting_keyframe: Any = None
        self.waiting_request: Any = None
        self.job: Job | None = None
        self.warned = False
        self.last_drew = False
        self.failure = ""
        self.keyframe_ns = self.ready_ns = 0
        self.shown_seconds = 0.0
        self.render_ms = 0.0
        self.expected_psnr_db = self.unseen_share = 0.0  # of the picture drawn last; 0 = unknown
        self.drawn_ns: deque[int] = deque(maxlen=20)
        self.view_out = self.publisher("/vspace/view", RenderedView, qos=SENSOR)
        self.image_out = self.publisher("/vspace/image/compressed", CompressedImage, qos=SENSOR)
        self.status_out = self.publisher("/vspace/status", VspaceStatus, qos=LATCHED)
        self.worker = self.background(self.work, self.on_outcome)
        self.start_job(Job("warm_up"))
        self.subscribe("/keyframe", Keyframe, self.on_keyframe, qos=LATCHED)
        self.subscribe("/view/request", ViewRequest, self.on_request, qos=SENSOR)
        self.timer(self.config.status_period_s, self.publish_status)
        if self.lockstep:
            self.timer(self.config.lockstep_period_s, self.train_in_lockstep)
        self.publish_status()

    def on_keyframe(self, keyframe: Any) -> None:
        self.waiting_keyframe = keyframe
        self.next_job()

    def on_request(self, request: Any) -> None:
        self.waiting_request = request
        self.next_job()

    # -- who is next ---------------------------------------------------------------------------------

    def next_job(self) -> None:
        """Gives the idle worker its next job; idle it stays when there is nothing to train, draw or take in."""
        if self.job is not None or self.space is None:
            return
        if self.waiting_keyframe is not None and self.takes_keyframe:
            keyframe, self.waiting_keyframe = self.waiting_keyframe, None
            self.start_job(Job("keyframe", keyframe))
        elif self.waiting_request is not None and (self.lockstep or not (self.trains and self.last_drew)):
            request, self.waiting_request = self.waiting_request, None
            self.draw(request)
        elif self.trains and not self.lockstep:
            self.start_job(Job("train", budget_ms=self.slice_ms()))

    @property
    def takes_keyframe(self) -> bool:
        """Each keyframe is learnt until it is fit to show, however fast they come; of those that wait, the newest."""
        return self.keyframe is None or self.ready_ns > 0 or not self.trains

    def slice_ms(self) -> float:
        """On a busy machine a picture takes long: training must not starve beside it."""
        share = self.config.train_share if self.state() == State.READY else self.config.train_share_until_ready
        drew = self.render_ms if self.last_drew else 0.0
        return max(self.config.train_slice_ms, share * drew)

    def train_in_lockstep(self) -> None:
        if self.job is None and self.trains:
            self.start_job(Job("train"))

    @property
    def trains(self) -> bool:
        """Whether there is anything left to train."""
        status = self.status
        empty = status is None or status.state == State.EMPTY
        return not (empty or self.failure or (status is not None and status.converged))

    def draw(self, request: Any) -> None:
        pixels = int(request.width) * int(request.height)
        if self.state() == State.EMPTY:
            self.diagnose("view", WARN, "a view was asked for, but no keyframe has come yet")
        elif pixels > self.config.max_view_pixels:
            words = f"{request.width} x {request.height} asked for, max_view_pixels is {self.config.max_view_pixels}"
            self.diagnose("view", WARN, words)
        else:
            self.start_job(Job("draw", request))
            return
        self.next_job()

    def start_job(self, job: Job) -> None:
        self.job = job
        self.last_drew = job.kind == "draw"
        self.worker.submit(job)

    # -- the worker's thread -------------------------------------------------------------------------

    def work(self, job: Job) -> Outcome:
        start = time.perf_counter()
        try:
            outcome = self.do(job)
        except Exception as error:  # noqa: BLE001 - told on the node's thread, which must learn that the worker is free
            # A keyframe or request that is no good is the sender's fault, anything else is ours.
            refused = job.kind in ("keyframe", "draw") and isinstance(error, ValueError)
            outcome = Outcome(job, refused=str(error)) if refused else Outcome(job, error=error)
        status = None if self.space is None else self.space.status
        return dataclasses.replace(outcome, status=status, elapsed_ms=(time.perf_counter() - start) * 1e3)

    def do(self, job: Job) -> Outcome:
        if job.kind == "warm_up":
            if not self.lockstep:
                self.yield_to_others()
                warm_up(self.config.space)
            self.space = make_space(self.config.space)
            return Outcome(job)
        assert self.space is not None
        if job.kind == "keyframe":
            self.take_keyframe(self.space, job.message)
        elif job.kind == "train" and self.lockstep:
            self.space.train(iterations=self.config.lockstep_iterations)
        elif job.kind == "train":
            self.space.train(budget_ms=job.budget_ms)
        elif job.kind == "draw":
            request = job.message
            view = self.space.render(pose_matrix(request.pose), request.width, request.height, request.fov_rad)
            quality = [cv2.IMWRITE_JPEG_QUALITY, self.config.jpeg_quality]
            _, jpeg = cv2.imencode(".jpg", view.rgb[..., ::-1], quality)
            return Outcome(job, view=view, jpeg=jpeg.tobytes(), mask_png=view.mask_png())
        return Outcome(job)

    def yield_to_others(self) -> None:
        """Lowers this thread's priority (Linux has one for each thread)."""
        if self.config.train_nice and sys.platform == "linux":
            os.setpriority(os.PRIO_PROCESS, threading.get_native_id(), self.config.train_nice)

    @staticmethod
    def take_keyframe(space: Space, keyframe: Any) -> None:
        if not keyframe.fit:
            raise KeyframeError(f"its depth is not fit: {keyframe.message or 'no reason given'}")
        data = np.asarray(keyframe.panorama.data, np.uint8)
        picture = cv2.imdecode(data, cv2.IMREAD_COLOR) if data.size else None
        if picture is None:
            raise KeyframeError(f"the panorama ({data.size} bytes) cannot be decoded")
        rgb = cv2.cvtColor(picture, cv2.COLOR_BGR2RGB)
        if keyframe.depth.encoding != "32FC1":
            raise KeyframeError(f"depth must be 32FC1 (got {keyframe.depth.encoding!r})")
        each = keyframe.sigma.data.size > 0
        sigma = decode_sigma(image_array(keyframe.sigma)) if each else keyframe.relative_sigma
        space.set_keyframe(rgb, image_array(keyframe.depth), pose_matrix(keyframe.pose), sigma)

    # -- back on the node's thread -------------------------------------------------------------------

    def on_outcome(self, outcome: Outcome) -> None:
        self.job = None
        kind = outcome.job.kind
        self.status = outcome.status
        if self.status is not None and (self.status.warning or self.warned):
            self.warned = bool(self.status.warning)
            self.diagnose("device", WARN if self.warned else OK, self.status.warning or self.status.device)
        if outcome.error is not None:
            self.on_error(kind, outcome.error)
        elif kind == "keyframe":
            self.on_keyframe_taken(outcome)
        elif kind == "draw":
            self.on_drawn(outcome)
        elif kind == "train":
            self.diagnose("vspace", OK, self.words(), iterations=self.status.iterations if self.status else 0)
        learnt = self.state() == State.READY and not (self.status is not None and self.status.refreshing)
        if self.keyframe is not None and not self.ready_ns and learnt:
            self.ready_ns, self.shown = self.clock.now_ns(), self.keyframe
            self.shown_seconds = (self.ready_ns - self.keyframe_ns) / 1e9
            self.publish_status()
        self.next_job()

    def on_error(self, kind: str, error: Exception) -> None:
        words = f"{kind}: {type(error).__name__}: {error}"
        if kind in ("warm_up", "train"):
            # What fails once fails again: no endless loop at full load. A new keyframe tries again.
            self.failure = words
            self.diagnose("vspace", ERROR, words)
            self.publish_status()
        else:
            self.diagnose(kind, ERROR, words)
        if type(error).__name__ not in ("OutOfMemoryError", "DeviceError", "MeshError"):  # no bugs, and told
            self.fault(f"virtual space, {kind}", error)

    def on_keyframe_taken(self, outcome: Outcome) -> None:
        keyframe = outcome.job.message
        if outcome.refused:
            self.diagnose("keyframe", ERROR, f"keyframe {keyframe.id} refused: {outcome.refused}", id=keyframe.id)
            return
        self.keyframe, self.failure = keyframe, ""
        self.keyframe_ns, self.ready_ns = self.clock.now_ns(), 0
        if self.status is None or not self.status.refreshing:
            self.shown = keyframe
        self.diagnose("keyframe", OK, f"keyframe {keyframe.id} in use", id=keyframe.id)
        self.publish_status()

    def on_drawn(self, outcome: Outcome) -> None:
        request, view = outcome.job.message, outcome.view
        if view is None:
            self.diagnose("view", WARN, f"request {request.id} refused: {outcome.refused}", id=request.id)
            return
        now = self.clock.now_ns()
        # Wall time would make a replay differ from run to run.
        self.render_ms = 0.0 if self.lockstep else outcome.elapsed_ms
        self.drawn_ns.append(now)
        expected = view.expected_psnr_db
        self.expected_psnr_db, self.unseen_share = 0.0 if math.isnan(expected) else expected, view.unseen_share
        self.diagnose("view", OK, f"{request.width} x {request.height} in {self.render_ms:.0f} ms")
        image = compressed_image_message(outcome.jpeg, "map", now)
        self.view_out.publish(
            RenderedView(
                header=header("map", now),
                request_id=request.id,
                keyframe_id=0 if self.shown is None else self.shown.id,
                pose=request.pose,
                fov_rad=request.fov_rad,
                width=request.width,
                height=request.height,
                confidence=float(view.confidence.mean()),
                render_ms=self.render_ms,
                image=image,
                confidence_png=np.frombuffer(outcome.mask_png, np.uint8),
            )
        )
        self.image_out.publish(image)

    # -- status --------------------------------------------------------------------------------------

    def state(self) -> State:
        if self.failure:
            return State.FAILED
        if self.status is None or (self.keyframe is None and self.config.space.source != "mesh"):
            return State.EMPTY
        return self.status.state

    def words(self) -> str:
        if self.failure:
            return self.failure
        if self.status is None:
            return "warming up: kernels are being compiled"
        space = self.config.space
        if space.source == "mesh":
            return f"the scanned place {Path(space.mesh).name}; nothing is trained (source: mesh)"
        if self.keyframe is None:
            return "waiting for the first keyframe"
        if space.source == "warp":
            return "the panorama warped by its depth; nothing is trained (source: warp)"
        if self.status.converged:
            words = f"trained, {self.status.psnr_db:.1f} dB; idle"
        else:
            words = f"training, {self.status.psnr_db:.1f} dB" if self.status.iterations else "training"
        if self.status.refreshing:
            return f"{words}; keyframe {self.keyframe.id} takes over soon"
        share = space.picture.panorama_share(self.status.psnr_db)
        return f"{words}; shown: {share:.0%} warped panorama" if share > 0 else words

    def frames_per_second(self, now_ns: int) -> float:
        """Over the last 20 pictures; 0 when none was drawn for 2 s."""
        if len(self.drawn_ns) < 2 or now_ns - self.drawn_ns[-1] > 2_000_000_000:
            return 0.0
        span = self.drawn_ns[-1] - self.drawn_ns[0]
        return (len(self.drawn_ns) - 1) * 1e9 / span if span > 0 else 0.0

    def publish_status(self) -> None:
        now, status, keyframe = self.clock.now_ns(), self.status, self.shown
        message = VspaceStatus(
            header=header("map", now),
            state=int(self.state()),
            keyframe_id=0,
            keyframe_pose=pose_message(np.eye(4)),
            keyframe_stamp=to_time(0),
            ready_radius_m=0.0,
            psnr_db=0.0,
            expected_psnr_db=self.expected_psnr_db,
            unseen_share=self.unseen_share,
            train_seconds=0.0,
            ready_seconds=0.0,
            iterations=0,
            ms_per_iteration=0.0,
            render_ms=self.render_ms,
            render_fps=self.frames_per_second(now),
            device="" if status is None else status.device,
            message=self.words(),
        )
        if status is not None and self.config.space.source == "mesh":
            message.ready_radius_m = status.ready_radius_m
        if status is not None and keyframe is not None:
            message.keyframe_id = keyframe.id
            message.keyframe_pose = keyframe.pose
            message.keyframe_stamp = keyframe.header.stamp
            message.ready_radius_m = status.ready_radius_m
            message.psnr_db = status.psnr_db if status.iterations else 0.0
            message.train_seconds = (now - self.keyframe_ns) / 1e9
            message.ready_seconds = self.shown_seconds if message.state == State.READY else 0.0
            message.iterations = status.iterations
            message.ms_per_iteration = 0.0 if self.lockstep else status.ms_per_iteration
        self.status_out.publish(message)


if __name__ == "__main__":
    main(NerfNode)
