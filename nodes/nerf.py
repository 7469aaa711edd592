"""Trains the virtual space from the newest keyframe and renders it, in turns (paper, section IV.A)."""

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
from numpy.typing import NDArray

from instant_ic.bus import ERROR, LATCHED, OK, SENSOR, WARN, Node, NodeError, main
from instant_ic.config.ranges import Percent, Positive, PositiveInt, Range, check_ranges
from instant_ic.depth.keyframes import decode_sigma
from instant_ic.geometry.depth_picture import encode_depth
from instant_ic.limits import decode_image, load_image
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
from instant_ic.vspace import KeyframeError, Space, State, Status, View, VirtualSpace, VirtualSpaceConfig, make_space
from instant_ic.vspace.turns import Turns
from instant_ic.vspace.warm_up import warm_up


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


@dataclass(frozen=True)
class Job:
    """One piece of work: ``keyframe`` and ``scene`` for the preparing thread; ``warm_up``, ``show``, ``learn``,
    ``draw`` and ``train`` for the rendering thread. ``made``: result of the previous job.
    """

    kind: str
    message: Any = None
    budget_ms: float = 0.0
    made: Any = None


@dataclass(frozen=True)
class Outcome:
    """Result of a job; ``error`` is an unexpected fault."""

    job: Job
    status: Status | None = None
    view: View | None = None
    jpeg: bytes = b""
    made: Any = None
    mask_png: bytes = b""
    depth_png: bytes = b""
    depth_near_m: float = 0.0
    elapsed_ms: float = 0.0
    refused: str = ""
    error: Exception | None = None


NOTHING_SEEN = 0.98
"""A view with a larger share of unseen pixels shows nothing that is known."""


def read_mask(path: str) -> NDArray[np.bool_] | None:
    """Load the robot's mask, (H, 2 H); None without a file name.

    Raises:
        NodeError: not an image, or not a panorama.
    """
    if not path:
        return None
    picture = load_image(path, cv2.IMREAD_GRAYSCALE)
    if picture is None:
        raise NodeError(f"robot_mask {path}: no such file, or it cannot be decoded as an image")
    if picture.shape[1] != 2 * picture.shape[0]:
        size = f"{picture.shape[1]} x {picture.shape[0]}"
        raise NodeError(f"robot_mask {path}: must be twice as wide as high, as the panorama is (got {size})")
    return np.asarray(picture > 127)


def decode_keyframe(keyframe: Any) -> tuple[Any, Any, Any, Any]:
    """Arguments of ``VirtualSpace.prepare``.

    Raises:
        KeyframeError: the keyframe is marked unfit, or cannot be decoded.
    """
    if not keyframe.fit:
        raise KeyframeError(f"its depth is marked unfit: {keyframe.message or 'no reason given'}")
    data = np.asarray(keyframe.panorama.data, np.uint8)
    picture = decode_image(data, cv2.IMREAD_COLOR)
    if picture is None:
        raise KeyframeError(f"the panorama ({data.size} bytes) cannot be decoded")
    rgb = cv2.cvtColor(picture, cv2.COLOR_BGR2RGB)
    if keyframe.depth.encoding != "32FC1":
        raise KeyframeError(f"depth must be 32FC1 (got {keyframe.depth.encoding!r})")
    each = keyframe.sigma.data.size > 0
    sigma = decode_sigma(image_array(keyframe.sigma)) if each else keyframe.relative_sigma
    return rgb, image_array(keyframe.depth), pose_matrix(keyframe.pose), sigma


class NerfNode(Node[NerfConfig]):
    """One thread renders and trains in turns; another prepares a new keyframe in two steps.

    The first step makes what views need, so that they show the keyframe; the second what the field needs to learn it.
    """

    name = "nerf"
    live_parameters = (
        *("render_fps", "train_ms_per_frame"),
        *("lockstep_iterations", "max_view_pixels", "jpeg_quality"),
    )

    def setup(self) -> None:
        self.robot = read_mask(self.config.robot_mask)
        self.space: Space | None = None  # used only by the two workers
        self.keyframe: Any = None  # newest one that views show
        self.status: Status | None = None
        self.waiting_keyframe: Any = None
        self.waiting_request: Any = None
        self.job: Job | None = None  # the rendering worker's present job
        self.todo: deque[Job] = deque()  # jobs of the keyframe in preparation
        self.preparing = False
        self.learns = False  # the field has something to learn
        self.warned = False
        self.failure = ""
        self.keyframe_ns = self.ready_ns = 0
        self.ready_seconds = 0.0
        self.render_ms = 0.0
        self.expected_psnr_db = self.unseen_share = 0.0  # of the last rendered view; 0 = unknown
        self.drawn_ns: deque[int] = deque(maxlen=20)
        self.turns = Turns(self.config.render_fps, self.config.train_ms_per_frame)
        self.view_out = self.publisher("/vspace/view", RenderedView, qos=SENSOR)
        self.image_out = self.publisher("/vspace/image/compressed", CompressedImage, qos=SENSOR)
        self.status_out = self.publisher("/vspace/status", VspaceStatus, qos=LATCHED)
        self.worker = self.background(self.work, self.on_outcome)
        self.preparer = self.background(self.work, self.on_prepared)
        self.start_job(Job("warm_up"))
        self.subscribe("/keyframe", Keyframe, self.on_keyframe, qos=LATCHED)
        self.subscribe("/view/request", ViewRequest, self.on_request, qos=SENSOR)
        self.timer(self.config.status_period_s, self.publish_status)
        if self.lockstep:
            self.timer(self.config.lockstep_period_s, self.train_in_lockstep)
        self.publish_status()

    def on_keyframe(self, keyframe: Any) -> None:
        self.waiting_keyframe = (keyframe, self.clock.now_ns())
        self.next_job()

    def on_request(self, request: Any) -> None:
        self.waiting_request = request
        self.next_job()

    # -- scheduling -----------------------------------------------------------------------------------

    def next_job(self) -> None:
        """Give idle threads their next jobs; they stay idle when there is nothing to prepare, render or train."""
        if self.space is not None and self.waiting_keyframe is not None and not self.preparing:
            waiting, self.waiting_keyframe = self.waiting_keyframe, None
            self.preparing = True
            self.preparer.submit(Job("keyframe", waiting))
        if self.job is not None or self.space is None:
            return
        trains = self.trains and not self.lockstep
        if self.todo:
            self.start_job(self.todo.popleft())
        elif self.turns.draws_next(self.waiting_request is not None, trains):
            request, self.waiting_request = self.waiting_request, None
            self.draw(request)
        elif trains:
            self.turns.render_fps, self.turns.train_ms_per_frame = (
                self.config.render_fps,
                self.config.train_ms_per_frame,
            )
            self.start_job(Job("train", budget_ms=self.turns.budget_ms()))

    def train_in_lockstep(self) -> None:
        if self.job is None and self.trains:
            self.start_job(Job("train"))

    @property
    def trains(self) -> bool:
        """Whether anything is left to train."""
        status = self.status
        return not (status is None or not self.learns or self.failure or status.converged)

    def draw(self, request: Any) -> None:
        pixels = int(request.width) * int(request.height)
        if self.state() == State.EMPTY:
            self.diagnose("view", WARN, "a view was requested before the first keyframe")
        elif pixels > self.config.max_view_pixels:
            words = f"{request.width} x {request.height} requested, max_view_pixels is {self.config.max_view_pixels}"
            self.diagnose("view", WARN, words)
        else:
            self.start_job(Job("draw", request))
            return
        self.next_job()

    def start_job(self, job: Job) -> None:
        self.job = job
        self.worker.submit(job)

    # -- on the workers' threads -------------------------------------------------------------------------

    def work(self, job: Job) -> Outcome:
        start = time.perf_counter()
        try:
            outcome = self.do(job)
        except Exception as error:  # noqa: BLE001 - reported on the node's thread, which must know that the worker is free
            # A bad keyframe or request is the sender's fault, anything else is ours.
            refused = job.kind in ("keyframe", "show", "draw") and isinstance(error, ValueError)
            outcome = Outcome(job, refused=str(error)) if refused else Outcome(job, error=error)
        status = None if self.space is None else self.space.status
        return dataclasses.replace(outcome, status=status, elapsed_ms=(time.perf_counter() - start) * 1e3)

    def do(self, job: Job) -> Outcome:
        if job.kind == "warm_up":
            if not self.lockstep:
                self.yield_to_others()
                warm_up(self.config.space)
            self.space = make_space(self.config.space, self.robot)
            return Outcome(job)
        space = self.space
        assert space is not None
        if job.kind == "keyframe":
            self.yield_to_others()
            decoded = decode_keyframe(job.message[0])
            return Outcome(job, made=space.prepare(*decoded) if isinstance(space, VirtualSpace) else decoded)
        if job.kind == "scene":
            assert isinstance(space, VirtualSpace)
            return Outcome(job, made=space.scene_of(job.made))
        if job.kind == "show" and isinstance(space, VirtualSpace):
            space.show(job.made, dissolve=True)
        elif job.kind == "show":
            space.set_keyframe(*job.made)
        elif job.kind == "learn" and isinstance(space, VirtualSpace):
            space.learn(job.made)
        elif job.kind == "train" and self.lockstep:
            space.train(iterations=self.config.lockstep_iterations)
        elif job.kind == "train":
            space.train(budget_ms=job.budget_ms)
        elif job.kind == "draw":
            request = job.message
            view = space.render(pose_matrix(request.pose), request.width, request.height, request.fov_rad)
            quality = [cv2.IMWRITE_JPEG_QUALITY, self.config.jpeg_quality]
            _, jpeg = cv2.imencode(".jpg", view.rgb[..., ::-1], quality)
            depth_png, near_m = encode_depth(view.depth_m, request.fov_rad)
            mask_png = view.mask_png()
            return Outcome(job, None, view, jpeg.tobytes(), None, mask_png, depth_png, near_m)
        return Outcome(job)

    def yield_to_others(self) -> None:
        """Lower this thread's priority (Linux has one per thread)."""
        if self.config.train_nice and sys.platform == "linux":
            os.setpriority(os.PRIO_PROCESS, threading.get_native_id(), self.config.train_nice)

    # -- back on the node's thread -------------------------------------------------------------------

    def on_prepared(self, outcome: Outcome) -> None:
        """Pass the preparing thread's result to the rendering thread."""
        job = outcome.job
        if outcome.error is not None or outcome.refused:
            self.preparing = False
            if outcome.refused:
                self.refuse(job.message[0], outcome.refused)
            else:
                self.on_error("keyframe", outcome.error)
        else:
            self.todo.append(Job("show" if job.kind == "keyframe" else "learn", job.message, made=outcome.made))
        self.next_job()

    def on_outcome(self, outcome: Outcome) -> None:
        self.job = None
        kind = outcome.job.kind
        self.status = outcome.status
        if self.status is not None and (self.status.warning or self.warned):
            self.warned = bool(self.status.warning)
            self.diagnose("device", WARN if self.warned else OK, self.status.warning or self.status.device)
        if kind == "learn" or (kind == "show" and (outcome.error is not None or outcome.refused)):
            self.preparing = False
        if outcome.error is not None:
            self.on_error("keyframe" if kind == "show" else kind, outcome.error)
        elif kind == "show":
            self.on_shown(outcome)
        elif kind == "learn":
            self.learns = True
        elif kind == "draw":
            self.on_drawn(outcome)
        elif kind == "train":
            self.diagnose("vspace", OK, self.words(), iterations=self.status.iterations if self.status else 0)
        if self.keyframe is not None and not self.ready_ns and self.state() == State.READY:
            self.ready_ns = self.clock.now_ns()
            self.ready_seconds = (self.ready_ns - self.keyframe_ns) / 1e9
            self.publish_status()
        self.next_job()

    def on_error(self, kind: str, error: Exception | None) -> None:
        words = f"{kind}: {type(error).__name__}: {error}"
        if kind in ("warm_up", "learn", "train"):
            # It would fail again: no endless loop at full load. A new keyframe tries again.
            self.failure = words
            self.diagnose("vspace", ERROR, words)
            self.publish_status()
        else:
            self.diagnose(kind, ERROR, words)
        if error is not None and type(error).__name__ not in ("OutOfMemoryError", "DeviceError", "MeshError"):
            self.fault(f"virtual space, {kind}", error)  # the named errors are not bugs; they are reported above

    def refuse(self, keyframe: Any, words: str) -> None:
        self.diagnose("keyframe", ERROR, f"keyframe {keyframe.id} refused: {words}", id=keyframe.id)

    def on_shown(self, outcome: Outcome) -> None:
        (keyframe, self.keyframe_ns), made = outcome.job.message, outcome.job.made
        if outcome.refused:
            self.refuse(keyframe, outcome.refused)
            return
        self.keyframe, self.failure = keyframe, ""
        self.ready_ns = 0
        self.diagnose("keyframe", OK, f"keyframe {keyframe.id} in use", id=keyframe.id)
        self.publish_status()
        if isinstance(self.space, VirtualSpace) and self.config.space.source != "warp":
            self.preparer.submit(Job("scene", outcome.job.message, made=made))
        else:
            self.preparing = False

    def on_drawn(self, outcome: Outcome) -> None:
        request, view = outcome.job.message, outcome.view
        if view is None:
            self.diagnose("view", WARN, f"request {request.id} refused: {outcome.refused}", id=request.id)
            return
        now = self.clock.now_ns()
        # Wall time would make a replay differ between runs.
        self.render_ms = 0.0 if self.lockstep else outcome.elapsed_ms
        self.turns.drew(self.render_ms)
        self.drawn_ns.append(now)
        expected = view.expected_psnr_db
        self.expected_psnr_db, self.unseen_share = 0.0 if math.isnan(expected) else expected, view.unseen_share
        words = f"{request.width} x {request.height} in {self.render_ms:.0f} ms"
        if view.unseen_share > NOTHING_SEEN:
            self.diagnose("view", WARN, f"{words}: no keyframe shows anything from that pose; is it far away?")
        else:
            self.diagnose("view", OK, words)
        image = compressed_image_message(outcome.jpeg, "map", now)
        self.view_out.publish(
            RenderedView(
                header=header("map", now),
                request_id=request.id,
                keyframe_id=0 if self.keyframe is None else self.keyframe.id,
                pose=request.pose,
                fov_rad=request.fov_rad,
                width=request.width,
                height=request.height,
                confidence=float(view.confidence.mean()),
                render_ms=self.render_ms,
                image=image,
                confidence_png=np.frombuffer(outcome.mask_png, np.uint8),
                depth_near_m=outcome.depth_near_m,
                depth_png=np.frombuffer(outcome.depth_png, np.uint8),
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
            words += f"; learning keyframe {self.keyframe.id}"
        share = space.picture.panorama_share(self.status.psnr_db)
        return f"{words}; shown: {share:.0%} warped panorama" if share > 0 else words

    def frames_per_second(self, now_ns: int) -> float:
        """Frame rate over the last 20 views; 0 when none was rendered for 2 s."""
        if len(self.drawn_ns) < 2 or now_ns - self.drawn_ns[-1] > 2_000_000_000:
            return 0.0
        span = self.drawn_ns[-1] - self.drawn_ns[0]
        return (len(self.drawn_ns) - 1) * 1e9 / span if span > 0 else 0.0

    def publish_status(self) -> None:
        now, status, keyframe = self.clock.now_ns(), self.status, self.keyframe
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
            message.ready_seconds = self.ready_seconds if message.state == State.READY else 0.0
            message.iterations = status.iterations
            message.ms_per_iteration = 0.0 if self.lockstep else status.ms_per_iteration
        self.status_out.publish(message)


if __name__ == "__main__":
    main(NerfNode)
