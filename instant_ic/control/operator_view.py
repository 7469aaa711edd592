"""Age, rate and place of the images that the operator sees, at the robot and at the page."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from instant_ic.control.freshness import Rhythm
from instant_ic.control.kinematics import extrapolate, move
from instant_ic.geometry.poses import pose2_from_matrix
from instant_ic.geometry.transforms import TransformBuffer, TransformError


@dataclass(frozen=True)
class PageReport:
    """The operator's page's report of its newest images (ShownPictures)."""

    image_stamp_ns: int
    """Exposure of the newest camera image; 0: none."""
    image_age_s: float
    """Seconds from the image's arrival to the sending of this report."""
    view_id: int
    view_age_s: float
    """Seconds from the newest view's arrival to the sending of this report."""
    view_delay_s: float
    """Seconds from the request of a view to its arrival."""
    view_position: NDArray[np.float64]
    """(2,) position of the camera in that view, in the map frame."""

    @property
    def view_after_image_s(self) -> float:
        """Seconds from the arrival of the camera image to that of the view; 0 while one is missing."""
        between_s = self.image_age_s - self.view_age_s
        return between_s if math.isfinite(between_s) else 0.0


class OperatorView:
    """A monitor of the camera images at the robot and of the page's reports. Times are steady-clock nanoseconds."""

    def __init__(self, tf: TransformBuffer) -> None:
        self._tf = tf
        self._camera, self._page, self._views = Rhythm(), Rhythm(), Rhythm()
        self._camera_ns: int | None = None
        self._image: tuple[int, int] = (-1, 0)  # newest camera image at the page: stamp, time of the report
        self._view: tuple[int, int] = (-1, 0)  # newest view there: id, time of the report
        self._views_wanted = False  # views were requested for display at the last report
        self.image_delay_s: float | None = None
        """Seconds from a camera image's exposure to its arrival at the page; None: no page yet."""

    def camera_image(self, steady_ns: int) -> None:
        """Record a camera image at the robot."""
        if self._camera_ns is not None:
            self._camera.heard((steady_ns - self._camera_ns) / 1e9)
        self._camera_ns = steady_ns

    def report(self, report: PageReport | None, views_wanted: bool, now_ns: int, steady_ns: int) -> bool:
        """Record the page's images; return whether one of them is new.

        ``views_wanted``: views are requested for display. Otherwise (in REAL) they are requested rarely, so the time
        between two views says nothing about their rate.
        """
        if report is None:
            return False
        stamp_ns = report.image_stamp_ns
        new = stamp_ns != self._image[0] or report.view_id != self._view[0]
        if stamp_ns not in (0, self._image[0]):
            if self._image[0] > 0:
                self._page.heard((steady_ns - self._image[1]) / 1e9)
            self._image = stamp_ns, steady_ns
            self.image_delay_s = min(max((now_ns - stamp_ns) / 1e9, 0.0), 1.0)
        if report.view_id != self._view[0]:
            if views_wanted and self._views_wanted:
                self._views.heard((steady_ns - self._view[1]) / 1e9)
            self._view, self._views_wanted = (report.view_id, steady_ns), views_wanted
        return new

    def ages(self, report: PageReport | None, report_age_s: float, steady_ns: int) -> dict[str, float]:
        """Return the ages of ``camera`` and ``view`` in seconds; with a page, the ages of its newest images."""
        camera_s = math.inf if self._camera_ns is None else (steady_ns - self._camera_ns) / 1e9
        if report is None:
            return {"camera": camera_s, "view": math.inf}
        return {"camera": max(camera_s, report.image_age_s + report_age_s), "view": report.view_age_s + report_age_s}

    def usual(self, with_page: bool) -> dict[str, float]:
        """Return the usual ages of ``camera`` and ``view`` in seconds at the next arrival; inf while unknown."""
        camera_s = self._camera.usual_s
        return {"camera": max(camera_s, self._page.usual_s) if with_page else camera_s, "view": self._views.usual_s}

    def delay_s(self, report: PageReport | None) -> float:
        """Return the delay of an image or of a view until it is at the page, whichever is longer, in seconds."""
        return max(self.image_delay_s or 0.0, 0.0 if report is None else report.view_delay_s)

    def shown_pose(
        self, report: PageReport | None, pose: NDArray[np.float64] | None, velocity: tuple[float, float], now_ns: int
    ) -> NDArray[np.float64] | None:
        """Return the position of the r-bot when the image now shown was taken, with its present heading (3,).

        "Now" is when a view requested at this moment will be shown, so the pose lies ahead by the delay of a view. None
        without a page, or while ``pose`` is unknown.
        """
        if report is None or pose is None or self.image_delay_s is None:
            return None
        newest_ns = self._tf.newest_ns("base_link") or now_ns
        unknown_s = (now_ns - newest_ns) / 1e9
        now = extrapolate(pose, velocity, unknown_s)
        behind_s = self.image_delay_s - min(report.view_delay_s, 0.5)
        if behind_s <= unknown_s:
            place = move(now, *velocity, -behind_s)
        else:
            try:
                odom_from_base = self._tf.lookup("odom", "base_link", now_ns - round(behind_s * 1e9))
                place = pose2_from_matrix(self._tf.lookup("map", "odom") @ odom_from_base)
            except TransformError:
                return None
        return np.array([place[0], place[1], now[2]])

    def image_position(self) -> NDArray[np.float64] | None:
        """Return the position (2,) of the camera in the map for the page's newest image; None while unknown."""
        for frame in ("camera", "base_link"):
            try:
                odom_from_camera = self._tf.lookup("odom", frame, self._image[0])
                place: NDArray[np.float64] = (self._tf.lookup("map", "odom") @ odom_from_camera)[:2, 3]
                return place
            except TransformError:
                continue
        return None
