"""Diagnoses of the grid SLAM after a scan."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np

from instant_ic.slam.front_end import SlamStatus
from instant_ic.slam.grid_slam import GridSlam, SlamResult
from instant_ic.util.diagnosis import Diagnosis, Level

_STATUSES = {
    SlamStatus.FIRST: (Level.OK, "A map has been started"),
    SlamStatus.TRACKED: (Level.OK, "Tracking"),
    SlamStatus.RECOVERED: (
        Level.WARN,
        "Odometry was far off, but the wide search has found the scan. Check tracks and encoders",
    ),
    SlamStatus.LOST: (Level.ERROR, "The scan fits nowhere near; the pose follows odometry. Drive slowly"),
    SlamStatus.RESTARTED: (
        Level.ERROR,
        "The robot is lost and has started a separate map. Drive slowly until its place is recognized",
    ),
    SlamStatus.NO_POINTS: (Level.WARN, "The scan has too few points; the pose follows odometry. Uncover the LiDAR"),
    SlamStatus.TIME_BACKWARDS: (Level.WARN, "The scan is not newer than the last and is ignored"),
}


def diagnoses(slam: GridSlam, result: SlamResult, with_odometry: bool, use_wheel_odom: bool) -> Iterator[Diagnosis]:
    """Yield the diagnoses of the SLAM after a scan.

    Args:
        slam: the SLAM after `GridSlam.process`.
        result: result of the scan.
        with_odometry: whether the scan came with odometry.
        use_wheel_odom: whether scans should come with odometry.
    """
    sigma_m = float(np.sqrt(max(np.diag(result.covariance)[:2])))
    figures = {"score": round(result.score, 3), "sigma_xy_m": round(sigma_m, 4), **slam.figures()}
    yield Diagnosis("slam", *_STATUSES[result.status], figures)
    trust = result.integrity
    figures = {
        "lost_probability": round(trust.lost_probability, 4),
        "position_bound_m": round(trust.position_bound_m, 3),
        "heading_bound_rad": round(trust.heading_bound_rad, 4),
        "contradiction": round(slam.monitor.contradiction, 3),
    }
    text = "The pose is trusted" if trust.trusted else "The robot is probably elsewhere. Check where it stands"
    yield Diagnosis("integrity", Level.OK if trust.trusted else Level.ERROR, text, figures)
    if not result.localized:
        why = "ambiguous: several places look alike" if slam.saved and slam.saved.ambiguous else "not known yet"
        text = f"The robot's place in the saved map is {why}. Drive on, or set it (/initialpose)"
        yield Diagnosis("place", Level.WARN, text)
    elif slam.saved is not None:
        yield Diagnosis("place", Level.OK, "Found in the saved map")
    level = Level.OK
    text = "The robot moves as its tracks do" if with_odometry else "No wheel odometry to compare with"
    if slam.contradiction.state:
        level, text = Level.ERROR, slam.contradiction.state.text
    figures = {
        "turn_factor": round(slam.turn_factor.value, 3),
        "turn_factor_sigma": round(min(slam.turn_factor.sigma, 9.999), 3),
        "contradictions": slam.contradiction.count,
    }
    yield Diagnosis("motion", level, text, figures)
    if with_odometry:
        correction_m = round(float(np.hypot(*slam.frames.map_from_odom[:2])), 3)
        yield Diagnosis("odometry", Level.OK, "Wheel odometry", {"correction_m": correction_m})
    elif use_wheel_odom:
        text = "No wheel odometry on /wheel/odom; LiDAR odometry replaces it. Check crawler_base"
        yield Diagnosis("odometry", Level.WARN, text)
    else:
        yield Diagnosis("odometry", Level.OK, "LiDAR odometry (use_wheel_odom is false)")
    if slam.map.clipped:
        yield Diagnosis(
            "map",
            Level.WARN,
            "The map has reached max_size_m. Raise it, or start a new map",
            {"points_left_out": slam.map.clipped},
        )
