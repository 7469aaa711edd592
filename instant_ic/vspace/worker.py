"""Worker of the virtual space: one thread shows keyframes, renders requested views, and trains in idle time.

Each piece of work is a job. A keyframe is first shown, then its layers are encoded, then the field learns it. Only the
newest waiting keyframe and the newest waiting view are kept. ``Turns`` divides the time between views and other work.
"""

from __future__ import annotations

import functools
import math
import os
import sys
import threading
import time
from collections import deque
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from instant_ic.geometry.mesh_file import MeshError
from instant_ic.util.diagnosis import Level
from instant_ic.vspace.config import VirtualSpaceConfig
from instant_ic.vspace.devices import is_device_fault
from instant_ic.vspace.layers import Layers, encode
from instant_ic.vspace.mesh_space import Space, make_space
from instant_ic.vspace.space import SpaceState, SpaceStatus, VirtualSpace
from instant_ic.vspace.view import View
from instant_ic.vspace.warm_up import warm_up

KeyframeArrays = tuple[NDArray[np.uint8], NDArray[np.floating], NDArray[np.floating], float | NDArray[np.floating]]
"""Panorama, depth, map_from_camera and relative sigma: the arguments of ``VirtualSpace.prepare``."""
NICE = 5
"""Scheduling priority of the worker's thread, lower than that of robot control."""
LEAST_SHARE = 0.25
"""Smallest training time relative to a view's rendering time, even if views alone take longer than their period."""
SAME_POSE = 2e-3
"""Largest difference of two poses that count as equal, in metres and radians; about a third of a view's pixel."""
_NOTHING_SEEN = 0.98
"""Share of unseen pixels above which a view counts as showing nothing known."""


@dataclass(frozen=True, eq=False)
class IncomingKeyframe:
    """A keyframe as received.

    Attributes:
        id: number of the keyframe.
        message: the received message.
        arrival_ns: time of arrival.
        decode: decodes the keyframe on the worker's thread; may raise ``KeyframeError``.
        image: encoded panorama from the camera; None to encode the keyframe's.
    """

    id: int
    message: Any
    arrival_ns: int
    decode: Callable[[], KeyframeArrays]
    image: bytes | None = None


@dataclass(frozen=True)
class ViewOrder:
    """A requested view. ``pose`` returns map_from_camera or raises ValueError."""

    id: int
    message: Any
    pose: Callable[[], NDArray[np.floating]]
    width: int
    height: int
    fov_rad: float
    jpeg_quality: int

    def same_view(self, other: ViewOrder) -> bool:
        """Return whether both orders request the same view."""
        keys = ("width", "height", "fov_rad", "jpeg_quality")
        alike = all(getattr(self, key) == getattr(other, key) for key in keys)
        return alike and np.allclose(self.pose(), other.pose(), rtol=0, atol=SAME_POSE)


@dataclass(frozen=True)
class EncodedView:
    """A rendered view as it is sent, with its order and its rendering time."""

    order: ViewOrder
    render_ms: float
    view: View
    jpeg: bytes


@dataclass
class Job:
    """One piece of work.

    Attributes:
        name: name in messages.
        subject: name of the diagnosis that a failure sets. After a failure of ``vspace``, which would repeat at once,
            training stops until the next keyframe.
        work: does the work, on the worker's thread.
        then: receives the result, on the node's thread.
        number: id of the keyframe or request that is refused if ``work`` raises ValueError; None if there is none.
        result: result of ``work``.
        error: error of ``work``.
        status: status of the space after the job; None while there is no space.
    """

    name: str
    subject: str
    work: Callable[[], Any]
    then: Callable[[Any], object] = lambda _: None
    number: int | None = None
    result: Any = None
    error: Exception | None = None
    status: SpaceStatus | None = None

    @property
    def refused(self) -> bool:
        """True if the keyframe or the request cannot be used."""
        return self.number is not None and isinstance(self.error, ValueError)

    @property
    def is_bug(self) -> bool:
        """True if neither the sender, nor a device, nor a mesh file is at fault."""
        expected = self.error is None or is_device_fault(self.error) or isinstance(self.error, MeshError)
        return not (expected or self.refused)


class Turns:
    """Division of a device's time between rendering and training that maintains a frame rate.

    Args:
        render_fps: target frame rate of requested views; training gets the remaining time.
        train_ms_per_frame: longest uninterrupted training in ms, and thus the longest wait of a requested view.
    """

    def __init__(self, render_fps: float, train_ms_per_frame: float) -> None:
        self.render_fps = render_fps
        self.train_ms_per_frame = train_ms_per_frame
        self._rendered_last = False
        self._render_ms = 0.0

    def renders_next(self, works: bool) -> bool:
        """Return whether a requested view is next. After each view, other work is next if there is any (``works``)."""
        return not (works and self._rendered_last)

    def rendered(self, render_ms: float) -> None:
        """Record the rendering time of a view."""
        self._rendered_last, self._render_ms = True, render_ms

    def worked(self) -> None:
        """Record that other work than rendering was done."""
        self._rendered_last = False

    def budget_ms(self) -> float:
        """Return how long to train now: the remainder of a view's period, within the limits."""
        left = 1e3 / self.render_fps - self._render_ms if self._rendered_last else self.train_ms_per_frame
        self._rendered_last = False
        return min(self.train_ms_per_frame, max(left, LEAST_SHARE * self._render_ms))


class SpaceWorker:
    """One space and its jobs. ``run`` is called on the worker's thread, everything else on the node's.

    Args:
        config: parameters of the space.
        turns: division of time between rendering and other work.
        now_ns: the node's clock.
        robot: mask of the robot, see ``VirtualSpace``.
        lockstep: compile no kernels in advance, ignore measured times, and train only in ``train``. Otherwise training
            fills idle time.

    Attributes:
        submit: passes a job to the worker's thread; ``take`` receives the finished job.
        diagnose: sets a diagnosis: name, level, text, values by keyword.
        on_layers: receives the layers of a new keyframe.
        on_view: receives a requested view.
        space: the space; None until the warm-up is done.
        keyframe: newest keyframe that views show.
        status: status of the space after the last job.
        failure: error that ended training; empty if there is none.
    """

    submit: Callable[[Job], object]
    diagnose: Callable[..., object]
    on_layers: Callable[[Layers], object]
    on_view: Callable[[ViewOrder, EncodedView], object]

    def __init__(
        self,
        config: VirtualSpaceConfig,
        turns: Turns,
        now_ns: Callable[[], int],
        robot: NDArray[np.bool_] | None = None,
        lockstep: bool = False,
    ) -> None:
        self.config, self.turns = config, turns
        self.space: Space | None = None
        self.keyframe: IncomingKeyframe | None = None
        self.status: SpaceStatus | None = None
        self.failure = ""
        self._now_ns, self._robot, self._lockstep = now_ns, robot, lockstep
        self._waiting_keyframe: IncomingKeyframe | None = None
        self._waiting_view: ViewOrder | None = None
        self._busy = False
        self._todo: deque[Job] = deque()  # remaining jobs of the shown keyframe
        self._learns = False  # True once the field has a scene to learn
        self._ready_seconds: float | None = None  # from the keyframe's arrival until READY
        self._warned = False  # True while there is a warning about the device
        self._layers_version = 0
        self._newest_view: EncodedView | None = None  # valid for the present space; used only by the worker's thread
        self._rendered_ns: deque[int] = deque(maxlen=20)
        # Figures of the last rendered view; 0 is unknown.
        self._render_ms = self._expected_psnr_db = self._unseen_share = 0.0

    # --- which job is next -----------------------------------------------------------------------------------------

    def start(self) -> None:
        """Start with the warm-up."""
        self._start(Job("warm_up", "vspace", self._make_space))

    def offer_keyframe(self, keyframe: IncomingKeyframe) -> None:
        """Prepare and show a keyframe. It replaces a keyframe that is still waiting."""
        self._waiting_keyframe = keyframe
        self.next()

    def request_view(self, order: ViewOrder) -> None:
        """Render a view. It replaces a request that is still waiting."""
        self._waiting_view = order
        self.next()

    def train(self, iterations: int | None, budget_ms: float = math.inf) -> None:
        """Train now, unless a job runs or nothing is left to train."""
        if not self._busy and self._trains:
            self._start(Job("train", "vspace", functools.partial(self._train, iterations, budget_ms), self._trained))

    def next(self) -> None:
        """Start the next job, unless one is running or there is nothing to do."""
        if self._busy or self.status is None:
            return
        trains = self._trains and not self._lockstep
        order, keyframe = self._waiting_view, self._waiting_keyframe
        if order is not None and self.turns.renders_next(trains or bool(self._todo) or keyframe is not None):
            self._waiting_view = None
            then = functools.partial(self._rendered, order)
            self._start(Job("view", "view", functools.partial(self._render, order), then, order.id))
        elif self._todo:
            self.turns.worked()
            self._start(self._todo.popleft())
        elif keyframe is not None:
            self.turns.worked()
            self._waiting_keyframe = None
            work = functools.partial(self._show, keyframe)
            self._start(Job("keyframe", "keyframe", work, self._shown, keyframe.id))
        elif trains:
            self.train(None, self.turns.budget_ms())

    def _start(self, job: Job) -> None:
        self._busy = True
        self.submit(job)

    @property
    def _trains(self) -> bool:
        """True while something is left to train."""
        return self._learns and not self.failure and self.status is not None and not self.status.converged

    # --- the work, on the worker's thread --------------------------------------------------------------------------

    def run(self, job: Job) -> Job:
        """Do a job, and return it with its result or its error."""
        try:
            job.result = job.work()
        except Exception as error:  # noqa: BLE001 - reported on the node's thread, which must know that this one is free
            job.error = error
        job.status = None if self.space is None else self.space.status
        return job

    def _make_space(self) -> None:
        if not self._lockstep:
            _yield_to_others()
            warm_up(self.config)
        self.space = make_space(self.config, self._robot)

    def _show(self, keyframe: IncomingKeyframe) -> IncomingKeyframe:
        self._newest_view = None
        arrays = keyframe.decode()
        if isinstance(self.space, VirtualSpace):
            self.space.show(self.space.prepare(*arrays), dissolve=True)
        elif self.space is not None:
            self.space.set_keyframe(*arrays)
        return keyframe

    def _encode(self, keyframe: IncomingKeyframe) -> Layers:
        assert isinstance(self.space, VirtualSpace) and self.space.shown is not None
        self._layers_version += 1
        return encode(self.space.shown.newest, keyframe.id, keyframe.image, self._layers_version)

    def _learn(self) -> None:
        assert isinstance(self.space, VirtualSpace) and self.space.shown is not None
        self._newest_view = None
        self.space.learn(self.space.shown)

    def _train(self, iterations: int | None, budget_ms: float) -> None:
        assert self.space is not None
        self._newest_view = None
        self.space.train(budget_ms, iterations)

    def _render(self, order: ViewOrder) -> EncodedView:
        """Render a view, or return the newest view if it would be the same, so that a standing robot costs nothing."""
        assert self.space is not None
        if self._newest_view is not None and self._newest_view.order.same_view(order):
            return self._newest_view
        changes, start = self.space.dissolving, time.perf_counter()
        view = self.space.render(order.pose(), order.width, order.height, order.fov_rad)
        _, jpeg = cv2.imencode(".jpg", view.softened()[..., ::-1], [cv2.IMWRITE_JPEG_QUALITY, order.jpeg_quality])
        encoded = EncodedView(order, (time.perf_counter() - start) * 1e3, view, jpeg.tobytes())
        self._newest_view = None if changes else encoded
        return encoded

    # --- the results -----------------------------------------------------------------------------------------------

    def take(self, job: Job) -> None:
        """Receive a finished job, and report its result or its error."""
        self._busy, self.status = False, job.status
        if job.status is not None and (job.status.warning or self._warned):
            self._warned = bool(job.status.warning)
            text = job.status.warning or job.status.device
            self.diagnose("device", Level.WARN if self._warned else Level.OK, text)
        if job.error is None:
            job.then(job.result)
        elif job.refused:
            level, what = (Level.WARN, "Request") if job.subject == "view" else (Level.ERROR, "Keyframe")
            self.diagnose(job.subject, level, f"{what} {job.number} refused: {job.error}", id=job.number)
        else:
            text = f"{job.name}: {type(job.error).__name__}: {job.error}"
            self.diagnose(job.subject, Level.ERROR, text)
            if job.subject == "vspace":
                self.failure = text
        if self.keyframe is not None and self._ready_seconds is None and self.state == SpaceState.READY:
            self._ready_seconds = (self._now_ns() - self.keyframe.arrival_ns) / 1e9

    def _shown(self, keyframe: IncomingKeyframe) -> None:
        """Record that a keyframe is shown, and queue its remaining jobs."""
        assert self.status is not None
        self.keyframe, self.failure, self._ready_seconds = keyframe, "", None
        self._todo.clear()
        if self.status.source in ("warp", "field"):
            self._todo.append(Job("layers", "keyframe", functools.partial(self._encode, keyframe), self.on_layers))
        if self.status.source == "field":
            self._todo.append(Job("learn", "vspace", self._learn, self._learnt))
        self.diagnose("keyframe", Level.OK, f"keyframe {keyframe.id} in use", id=keyframe.id)

    def _learnt(self, _: None) -> None:
        self._learns = True

    def _trained(self, _: None) -> None:
        self.diagnose("vspace", Level.OK, self.text())

    def _rendered(self, order: ViewOrder, encoded: EncodedView) -> None:
        view = encoded.view
        self._render_ms = 0.0 if self._lockstep else encoded.render_ms
        self._expected_psnr_db = 0.0 if math.isnan(view.expected_psnr_db) else view.expected_psnr_db
        self._unseen_share = view.unseen_share
        self.turns.rendered(self._render_ms)
        self._rendered_ns.append(self._now_ns())
        text, empty = f"{order.width} x {order.height} in {self._render_ms:.0f} ms", view.unseen_share > _NOTHING_SEEN
        if empty:
            text += ": no keyframe has seen anything from that pose. Is it far away?"
        self.diagnose("view", Level.WARN if empty else Level.OK, text, id=order.id)
        self.on_view(order, encoded)

    # --- the state -------------------------------------------------------------------------------------------------

    @property
    def state(self) -> SpaceState:
        """State of the space."""
        if self.failure:
            return SpaceState.FAILED
        if self.status is None or (self.keyframe is None and self.config.source != "mesh"):
            return SpaceState.EMPTY
        return self.status.state

    def text(self) -> str:
        """Describe the state for an operator."""
        status = self.status
        if self.failure:
            return self.failure
        if status is None:
            return "warming up: kernels are being compiled"
        if status.source == "mesh":
            return f"the scanned place {Path(self.config.mesh).name}; nothing is trained (source: mesh)"
        if self.keyframe is None:
            return "waiting for the first keyframe"
        if status.source == "warp":
            return "the panorama warped by its depth; nothing is trained (source: warp)"
        text = "trained; idle" if status.converged else "training"
        if status.iterations:
            text += f"; {status.psnr_db:.1f} dB"
        if status.refreshing:
            text += f"; learning keyframe {self.keyframe.id}"
        text += f"; shown: the {'field' if status.shows_field else 'warped panorama'}"
        if not math.isnan(status.gain_db):
            text += f" (field compared with warp on older keyframes: {status.gain_db:+.1f} dB)"
        return text

    def figures(self) -> dict[str, Any]:
        """Return the fields of VspaceStatus.msg; unknown values are 0 or empty."""
        status, keyframe, now_ns, rendered = self.status, self.keyframe, self._now_ns(), self._rendered_ns
        learnt = status if keyframe is not None else None
        timed = len(rendered) > 1 and now_ns - rendered[-1] <= 2_000_000_000 and rendered[-1] > rendered[0]
        return {
            "state": self.state,
            "keyframe_id": 0 if keyframe is None else keyframe.id,
            "ready_radius_m": 0.0 if status is None else status.ready_radius_m,
            "psnr_db": learnt.psnr_db if learnt is not None and learnt.iterations else 0.0,
            "expected_psnr_db": self._expected_psnr_db,
            "unseen_share": self._unseen_share,
            "train_seconds": 0.0 if keyframe is None else (now_ns - keyframe.arrival_ns) / 1e9,
            "ready_seconds": (self._ready_seconds or 0.0) if self.state == SpaceState.READY else 0.0,
            "iterations": 0 if learnt is None else learnt.iterations,
            "ms_per_iteration": 0.0 if learnt is None or self._lockstep else learnt.ms_per_iteration,
            "render_ms": self._render_ms,
            "render_fps": (len(rendered) - 1) * 1e9 / (rendered[-1] - rendered[0]) if timed else 0.0,
            "device": "" if status is None else status.device,
            "message": self.text(),
        }


def _yield_to_others() -> None:
    """Lower this thread's priority, which Linux keeps per thread. Raising it would need root."""
    if sys.platform == "linux":
        thread = threading.get_native_id()
        os.setpriority(os.PRIO_PROCESS, thread, max(NICE, os.getpriority(os.PRIO_PROCESS, thread)))
