"""Panoramas of a recorded drive with their fused depth, and with what the LiDAR measured there later as labels."""

from __future__ import annotations

import functools
from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import maximum_filter, minimum_filter, uniform_filter

from instant_ic.bag.files import BagReader
from instant_ic.calibration.bag import read_clouds, read_images
from instant_ic.depth.inputs import RecentInputs
from instant_ic.depth.manifest import InferenceError
from instant_ic.depth.metric_depth import DepthScalerConfig, MetricDepth
from instant_ic.depth.model import DepthModel
from instant_ic.depth.scaler import ScalerConfig
from instant_ic.geometry.poses import Matrix
from instant_ic.geometry.transforms import TransformError
from instant_ic.lidar.deskew import Revolution
from instant_ic.mapping.kernels import MEASURED
from instant_ic.mapping.local_model import LocalDepth
from instant_ic.msg import cloud_points, stamp_ns
from instant_ic.util.jpeg import JpegError
from instant_ic.util.limits import decode_rgb

Floats = NDArray[np.floating]
EVERY_M = 0.25
MOST_KEYFRAMES = 400
"""A longer drive has them farther apart: 2.5 MB each."""
LATER_M = 5.0
"""A keyframe gets its label when the robot has come so much farther: half of what the local model keeps."""
_LEAST_LABEL = 0.01
_SAME, _NEAR = 0.05, 9
"""Ranges that differ by a smaller share are one surface; side in pixels of the square in which the points decide."""
_EDGE, _BESIDE = 0.1, 5
"""Labels that differ by this share within a square of so many pixels are at a depth edge, which voxels blur."""


class DriveError(ValueError):
    """A bag has no panoramas with labels; the text says why."""


@dataclass(frozen=True)
class Keyframe:
    """A panorama of the drive.

    Attributes:
        rgb: (H, W, 3) uint8.
        prior: (6, H, W) float16, as ``depth_scaler`` would have given it to a completion at this moment.
        label_m: (H, W) float16, radial metres that the LiDAR measured until later; 0 where nothing is known.
        model_from_camera: (4, 4) pose; its z axis is up.
        path_m: how far the robot had come.
        stamp_ns: of the image.
    """

    rgb: NDArray[np.uint8]
    prior: NDArray[np.float16]
    label_m: NDArray[np.float16]
    model_from_camera: Matrix
    path_m: float
    stamp_ns: int


def read_drive(
    path: Path, network: DepthModel, size: tuple[int, int], show: Callable[[float], None] = lambda share: None
) -> list[Keyframe]:
    """Play a bag and take a keyframe every ``EVERY_M`` metres.

    Args:
        path: bag with panoramas, LiDAR (points or packets), /tf and /tf_static.
        network: estimates the depth of the image alone, as in ``depth_estimator``.
        size: height and width of the completion's image.
        show: receives the share that has been read.

    Raises:
        BagError, CalibrationError: the bag is damaged, or has no panoramas or LiDAR data.
        DriveError: no keyframe has a label.
    """
    with BagReader(path) as bag:
        transforms, clouds = read_clouds(bag)
        images = read_images(bag)
        scaler = ScalerConfig(output_kind=network.manifest.output_kind)
        config = DepthScalerConfig(scaler=scaler)
        drive = _Drive(MetricDepth(config, transforms, RecentInputs()), network, size)
        image = next(images, None)
        for cloud in clouds:
            points = cloud.points
            try:
                xyz = functools.partial(cloud_points, points)
                revolution = Revolution(cloud.frame_id, cloud.stamp_ns, points["time"], xyz)
                drive.metric.inputs.revolutions.append(revolution)
                drive.metric.mapper.revolution(revolution)
            except (TransformError, ValueError) as error:  # ValueError: other fields, or an empty cloud
                drive.problem = str(error)
                if drive.metric.mapper.model.revolutions == 0:  # time went back
                    drive.waiting.clear()
                continue
            while image is not None and stamp_ns(image) <= revolution.middle_ns:
                drive.add(image)
                image = next(images, None)
            show((revolution.stamp_ns - bag.start_ns) / max(bag.end_ns - bag.start_ns, 1))
    return drive.labelled(str(path))


class _Drive:
    """Keyframes so far; the last of them wait for their label."""

    def __init__(self, metric: MetricDepth, network: DepthModel, size: tuple[int, int]) -> None:
        self.metric, self.network, self.size = metric, network, size
        self.keyframes: list[Keyframe] = []
        self.waiting: list[tuple[Keyframe, Callable[[LocalDepth], Floats]]] = []
        self._every_m, self._path_m = EVERY_M, 0.0
        self._last: Matrix | None = None
        self.images, self.problem = 0, "none comes before a LiDAR revolution: are the clocks synchronised?"

    def add(self, image: Any) -> None:
        """Take a keyframe of an image (CompressedImage) if the robot has come far enough."""
        self.images += 1
        camera, stamp, (height, width) = image.header.frame_id, stamp_ns(image), self.size
        try:
            pose = self.metric.mapper.model_from_camera(camera, stamp)
            moved_m = self._every_m if self._last is None else float(np.linalg.norm(pose[:3, 3] - self._last[:3, 3]))
            if moved_m < self._every_m:
                return
            rgb = decode_rgb(bytes(image.data), 2 * width, 2 * height)
            result = self.metric.estimate(self.network.estimate(rgb), camera, stamp)
            points = self.metric.points_in_camera(camera, stamp)
        except (TransformError, JpegError, InferenceError, ValueError) as error:
            self.problem = str(error)
            return
        if result.prior is None or points is None:
            self.problem = result.message
            return
        if result.prior.channels.shape[1:] != self.size:
            raise DriveError(f"{self.network.manifest.name} gives {result.prior.channels.shape[1]} rows, but the "
                             f"completion takes {height}: give another --network")  # fmt: skip
        if self._last is not None:
            self._path_m += moved_m
        self._last = pose
        rgb = np.asarray(cv2.resize(rgb, (width, height), interpolation=cv2.INTER_AREA), np.uint8)
        prior = result.prior.channels.astype(np.float16)
        keyframe = Keyframe(rgb, prior, np.zeros(self.size, np.float16), pose, self._path_m, stamp)
        free_m = self.metric.mapper.model.render(pose, self.size).free_m.astype(np.float16)
        ranges_m = self.metric.source.structure.ranges(points, self.size).astype(np.float16)
        label = functools.partial(label_of, free_m=free_m, ranges_m=ranges_m, robot=result.prior.robot)
        self.waiting.append((keyframe, label))
        self._finish(self._path_m - LATER_M)

    def _finish(self, until_m: float) -> None:
        """Label the waiting keyframes up to a place on the path."""
        while self.waiting and self.waiting[0][0].path_m <= until_m:
            keyframe, label = self.waiting.pop(0)
            later = self.metric.mapper.model.render(keyframe.model_from_camera, self.size)
            label_m = label(later).astype(np.float16)
            if (label_m > 0).mean() <= _LEAST_LABEL:
                self.problem = "the LiDAR measured too little around the images"
                continue
            self.keyframes.append(replace(keyframe, label_m=label_m))
            if len(self.keyframes) > MOST_KEYFRAMES:
                self.keyframes, self._every_m = self.keyframes[::2], 2 * self._every_m

    def labelled(self, where: str) -> list[Keyframe]:
        """All keyframes, at the end of the drive."""
        self._finish(np.inf)
        if not self.keyframes:
            raise DriveError(f"{where}: none of {self.images} images can be used: {self.problem}")
        return self.keyframes


def label_of(later: LocalDepth, free_m: Floats, ranges_m: Floats, robot: NDArray[np.bool_]) -> NDArray[np.float32]:
    """Depth (H, W) that is known from what the LiDAR measured later; 0 elsewhere and at depth edges.

    Args:
        later: the local model at a later time, from the keyframe's pose.
        free_m: (H, W) how far beams had come at the keyframe's time: what stands nearer has come since.
        ranges_m: (H, W) range of the point in each pixel at the keyframe's time, 0 without one. Where most points
            around a pixel are nearer than the label, something stood there that has gone.
        robot: (H, W) pixels that show the robot.
    """
    label = np.where((later.kind == MEASURED) & ~robot, later.depth_m, np.float32(0))
    label[label < (1 - _SAME) * free_m] = 0
    seen = (label > 0) & (ranges_m > 0)
    gone = seen & (ranges_m < (1 - _SAME) * label)
    votes = gone.astype(np.float32) - (seen & ~gone)
    around = ("nearest", "wrap")
    label[uniform_filter(votes, _NEAR, mode=around) > 1e-6] = 0
    nearest = minimum_filter(np.where(label > 0, label, np.inf), _BESIDE, mode=around)
    label[maximum_filter(label, _BESIDE, mode=around) > (1 + _EDGE) * nearest] = 0
    return label
