"""Jobs on a virtual space, which one thread does in turn."""

from __future__ import annotations

import enum
import os
import sys
import threading
import time
from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from instant_ic.geometry.mesh_file import MeshError
from instant_ic.util.limits import decode_image, load_image
from instant_ic.vspace.config import VirtualSpaceConfig
from instant_ic.vspace.devices import is_device_fault
from instant_ic.vspace.layers import Layers, encode
from instant_ic.vspace.mesh_space import Space, make_space
from instant_ic.vspace.prior import KeyframeError
from instant_ic.vspace.space import SpaceStatus, VirtualSpace
from instant_ic.vspace.view import View
from instant_ic.vspace.warm_up import warm_up

KeyframeArrays = tuple[NDArray[np.uint8], NDArray[np.floating], NDArray[np.floating], float | NDArray[np.floating]]
"""Panorama, depth, map_from_camera and relative sigma, as ``VirtualSpace.prepare`` takes them."""


class JobKind(enum.Enum):
    """Kinds of jobs."""

    WARM_UP = "warm_up"
    KEYFRAME = "keyframe"
    LAYERS = "layers"
    LEARN = "learn"
    RENDER = "view"
    TRAIN = "train"


NICE = 5
"""Scheduling priority of the worker's thread: robot control comes first."""
SAME_POSE = 2e-3
"""Largest difference of two poses that count as equal, in metres and radians: a third of a view's pixel."""
_CHANGES = (JobKind.KEYFRAME, JobKind.LEARN, JobKind.TRAIN)
"""Jobs after which the same request gives another view."""
_INPUT_JOBS = (JobKind.KEYFRAME, JobKind.RENDER)
"""Jobs in which a ValueError is the sender's fault: the keyframe or the request is refused."""


@dataclass(frozen=True)
class IncomingKeyframe:
    """A keyframe as it arrived.

    Attributes:
        id: its number.
        message: the message.
        arrival_ns: time of its arrival.
        decode: decodes it on the worker's thread; may raise ``KeyframeError``.
        image: the camera's encoded panorama; None to encode it here.
    """

    id: int
    message: Any
    arrival_ns: int
    decode: Callable[[], KeyframeArrays]
    image: bytes | None = None


@dataclass(frozen=True)
class ViewOrder:
    """A requested view; ``pose`` returns map_from_camera or raises ValueError."""

    id: int
    message: Any
    pose: Callable[[], NDArray[np.floating]]
    width: int
    height: int
    fov_rad: float
    jpeg_quality: int

    def same_view(self, other: ViewOrder) -> bool:
        """Return whether both ask for the same view."""
        keys = ("width", "height", "fov_rad", "jpeg_quality")
        alike = all(getattr(self, key) == getattr(other, key) for key in keys)
        return alike and np.allclose(self.pose(), other.pose(), rtol=0, atol=SAME_POSE)


@dataclass(frozen=True)
class Job:
    """One piece of work.

    Attributes:
        kind: what to do.
        keyframe: keyframe of ``KEYFRAME``, ``LAYERS`` and ``LEARN``.
        view: requested view of ``RENDER``.
        iterations: limit of ``TRAIN``; None for no limit.
        budget_ms: time limit of ``TRAIN``.
    """

    kind: JobKind
    keyframe: IncomingKeyframe | None = None
    view: ViewOrder | None = None
    iterations: int | None = None
    budget_ms: float = float("inf")


@dataclass(frozen=True)
class EncodedView:
    """A rendered view as it is sent, the order that it was rendered for, and the time that this took."""

    order: ViewOrder
    render_ms: float
    view: View
    jpeg: bytes


@dataclass(frozen=True)
class JobOutcome:
    """Result of a job.

    Attributes:
        job: the job.
        layers: the keyframe's layers, of ``LAYERS``.
        encoded: the view of ``RENDER``.
        status: status of the space after the job; None while there is no space.
        refused: reason why the job's input was refused; empty otherwise.
        error: a fault that is not the input's.
        is_bug: the error is neither a missing device, nor too little memory, nor an unusable mesh.
    """

    job: Job
    layers: Layers | None = None
    encoded: EncodedView | None = None
    status: SpaceStatus | None = None
    refused: str = ""
    error: Exception | None = None
    is_bug: bool = False


class SpaceWorker:
    """Runs jobs on one space, one at a time.

    Args:
        config: parameters of the space.
        robot: mask of the robot, as ``VirtualSpace`` takes it.
        warm: compile the kernels in ``WARM_UP``.
    """

    def __init__(self, config: VirtualSpaceConfig, robot: NDArray[np.bool_] | None, warm: bool) -> None:
        self.config = config
        self.space: Space | None = None
        self._robot, self._warm = robot, warm
        self._newest: EncodedView | None = None  # view of the space as it is
        self._version = 0  # of the layers

    def run(self, job: Job) -> JobOutcome:
        """Do a job; errors are part of the outcome."""
        try:
            outcome = self.do(job)
        except Exception as error:  # noqa: BLE001 - reported on the node's thread, which must know that this one is free
            if job.kind in _INPUT_JOBS and isinstance(error, ValueError):
                outcome = JobOutcome(job, refused=str(error))
            else:
                expected = is_device_fault(error) or isinstance(error, MeshError)
                outcome = JobOutcome(job, error=error, is_bug=not expected)
        status = None if self.space is None else self.space.status
        return replace(outcome, status=status)

    def do(self, job: Job) -> JobOutcome:
        """Do a job; errors are raised."""
        if job.kind is JobKind.WARM_UP:
            if self._warm:
                _yield_to_others()
                warm_up(self.config)
            self.space = make_space(self.config, self._robot)
            return JobOutcome(job)
        space, keyframe = self.space, job.keyframe
        assert space is not None
        if job.kind in _CHANGES:
            self._newest = None
        if job.view is not None:
            return JobOutcome(job, encoded=self._rendered(space, job.view))
        if job.kind is JobKind.TRAIN:
            space.train(job.budget_ms, job.iterations)
        elif keyframe is not None and job.kind is JobKind.KEYFRAME:
            arrays = keyframe.decode()
            if isinstance(space, VirtualSpace):
                space.show(space.prepare(*arrays), dissolve=True)
            else:
                space.set_keyframe(*arrays)
        elif keyframe is not None and isinstance(space, VirtualSpace) and space.shown is not None:
            if job.kind is JobKind.LEARN:
                space.learn(space.shown)
                return JobOutcome(job)
            self._version += 1
            return JobOutcome(job, encode(space.shown.newest, keyframe.id, keyframe.image, self._version))
        return JobOutcome(job)

    def _rendered(self, space: Space, order: ViewOrder) -> EncodedView:
        """Render a view, or return the newest one if it would be the same: a standing robot costs nothing."""
        if self._newest is not None and self._newest.order.same_view(order):
            return self._newest
        changes, start = space.dissolving, time.perf_counter()
        view = space.render(order.pose(), order.width, order.height, order.fov_rad)
        _, jpeg = cv2.imencode(".jpg", view.softened()[..., ::-1], [cv2.IMWRITE_JPEG_QUALITY, order.jpeg_quality])
        encoded = EncodedView(order, (time.perf_counter() - start) * 1e3, view, jpeg.tobytes())
        self._newest = None if changes else encoded
        return encoded


def _yield_to_others() -> None:
    """Lower this thread's priority (Linux has one per thread); never raise it, which only root may."""
    if sys.platform == "linux":
        thread = threading.get_native_id()
        os.setpriority(os.PRIO_PROCESS, thread, max(NICE, os.getpriority(os.PRIO_PROCESS, thread)))


def decode_panorama(data: NDArray[np.uint8]) -> NDArray[np.uint8]:
    """Decode a keyframe's panorama.

    Args:
        data: JPEG or PNG.

    Returns:
        RGB image, (H, W, 3).

    Raises:
        KeyframeError: it cannot be decoded.
    """
    image = decode_image(data, cv2.IMREAD_COLOR)
    if image is None:
        raise KeyframeError(f"the panorama ({data.size} bytes) cannot be decoded")
    return cv2.cvtColor(image, cv2.COLOR_BGR2RGB)


def load_robot_mask(path: str | Path) -> NDArray[np.bool_]:
    """Load the mask of the robot in its panoramas.

    Args:
        path: image file, bright where a panorama shows the robot.

    Returns:
        The mask, (H, 2 H).

    Raises:
        ValueError: not an image, or not twice as wide as high.
    """
    image = load_image(path, cv2.IMREAD_GRAYSCALE)
    if image is None:
        raise ValueError(f"robot_mask {path}: no such file, or it cannot be decoded as an image")
    if image.shape[1] != 2 * image.shape[0]:
        size = f"{image.shape[1]} x {image.shape[0]}"
        raise ValueError(f"robot_mask {path}: must be twice as wide as high, as the panorama is (got {size})")
    return np.asarray(image > 127)
