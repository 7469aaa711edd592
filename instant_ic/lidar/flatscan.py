"""Flat scan: one range per direction from the points in a height interval, motion-compensated to one instant."""

import numpy as np
from numba import njit
from numpy.typing import NDArray

from instant_ic.geometry.transforms import TransformBuffer, TransformError
from instant_ic.lidar.config import FlatScanConfig
from instant_ic.lidar.head import TURN_CDEG, Sector
from instant_ic.lidar.motion import MotionError, PlanarMotion, base_motion
from instant_ic.lidar.packets import BLOCKS, FIRINGS, LASERS, encode_data_packet
from instant_ic.lidar.stream import PacketStream, Revolution
from instant_ic.util.diagnosis import Diagnosis, Level
from instant_ic.util.jit import leave_out_blas

_MOTION_SAMPLES = 65
"""Samples of the motion over a revolution; they are 1.6 ms apart, so the path between them is straight within 1 um."""

MAX_TILT_DEG = 5.0
"""A flat scan lies in the sensor's plane. At this tilt, a point 0.7 m above or below the sensor is 6 cm off."""


def flat_scan(
    revolution: Revolution,
    base_from_lidar: NDArray[np.float64],
    config: FlatScanConfig,
    motion: PlanarMotion | None = None,
) -> NDArray[np.float32]:
    """Project a revolution to a planar scan in the sensor's frame.

    Each point is moved by the base's motion from its firing to the end of the revolution. Each beam takes its smallest
    range.

    Args:
        revolution: decoded points.
        base_from_lidar: mount of the sensor; the origin of base_link is on the ground, (4, 4).
        config: height interval and beams.
        motion: poses of the base around the revolution; without them the base is assumed to stand still.

    Returns:
        Ranges at the end of the revolution, metres as in REP-117: +inf no return, -inf too close, nan not measured;
        (beams,). Beam i points to -pi + i * 2 pi / beams, counter-clockwise from ahead.

    Raises:
        MotionError: the poses do not cover the revolution.
    """
    duration_s = max(1e-6, (revolution.end_ns - revolution.stamp_ns) * 1e-9)
    shifts = np.zeros((_MOTION_SAMPLES, 3))
    if motion is not None:
        times_ns = revolution.stamp_ns + np.linspace(0.0, duration_s * 1e9, _MOTION_SAMPLES).astype(np.int64)
        shifts = motion.end_from_time(revolution.end_ns, times_ns)
    ranges = np.empty(config.beams, np.float32)
    per_sample = (_MOTION_SAMPLES - 1) / duration_s
    firings = revolution.firing_azimuth, revolution.firing_time, revolution.firing_too_close
    _mark_firings(firings, shifts, per_sample, ranges)
    rotation = np.ascontiguousarray(base_from_lidar[:3, :3], np.float64)
    translation = np.ascontiguousarray(base_from_lidar[:3, 3], np.float64)
    heights, limits = (config.min_height, config.max_height), (config.range_min, config.range_max)
    _project(revolution.points, rotation, translation, shifts, per_sample, heights, limits, ranges)
    return ranges


def compensated_scan(
    revolution: Revolution, base_from_lidar: NDArray[np.float64], config: FlatScanConfig, tf: TransformBuffer
) -> tuple[NDArray[np.float32], Diagnosis]:
    """Return the flat scan of a revolution as `flat_scan`, and the diagnosis ``motion`` of its compensation.

    Args:
        revolution: decoded points.
        base_from_lidar: mount of the sensor, (4, 4).
        config: height interval and beams.
        tf: holds ``odom`` to ``base_link``; without it the base is assumed to stand still.
    """
    try:
        motion = base_motion(tf, revolution.stamp_ns, revolution.end_ns)
        text = "no odometry: the base is assumed to stand still" if motion is None else "scan is motion-compensated"
        return flat_scan(revolution, base_from_lidar, config, motion), Diagnosis("motion", Level.OK, text)
    except (MotionError, TransformError) as error:
        state = Diagnosis("motion", Level.WARN, f"scan is not motion-compensated: {error}")
    return flat_scan(revolution, base_from_lidar, config, None), state


def check_level(base_from_lidar: NDArray[np.float64]) -> None:
    """Check that a mount (4, 4) is level enough for a flat scan.

    Raises:
        ValueError: the sensor's z axis is more than MAX_TILT_DEG off the vertical.
    """
    tilt_deg = float(np.degrees(np.arccos(np.clip(base_from_lidar[2, 2], -1.0, 1.0))))
    if tilt_deg > MAX_TILT_DEG:
        raise ValueError(
            f"The LiDAR is mounted {tilt_deg:.1f}° off the vertical, but /scan needs a level sensor (at most "
            f"{MAX_TILT_DEG:g}°). Mount it level, or correct roll and pitch of its mount."
        )


def coverage(revolution: Revolution, blocked: Sector | None = None) -> float:
    """Return the share of the configured field of view that a revolution measured, counted in whole degrees, 0-1.

    It is below 1 for a partial revolution: after the start, at a jump of the sensor's clock, or with missing packets.

    Args:
        revolution: decoded points.
        blocked: sector outside the configured field of view; None for a view of the whole circle.
    """
    wanted = np.ones(360, np.bool_)
    if blocked is not None:
        wanted = (np.arange(50, TURN_CDEG, 100) - blocked.start) % TURN_CDEG >= blocked.width
    measured = np.zeros(360, np.bool_)
    measured[np.floor(np.degrees(revolution.firing_azimuth)).astype(np.int64) % 360] = True
    return float(measured[wanted].mean()) if wanted.any() else 0.0


def warm_up() -> None:
    """Compile decoder and projection now (takes seconds the first time on a machine), before packets arrive."""
    leave_out_blas()
    stream = PacketStream()
    nothing = np.zeros((BLOCKS, FIRINGS, LASERS), np.int64)
    stream.feed(encode_data_packet(np.zeros(BLOCKS, np.int64), nothing + 1000, nothing, 0), 0)
    revolution = stream.finish()
    assert revolution is not None
    flat_scan(revolution, np.eye(4), FlatScanConfig())


@njit(nogil=True, cache=True)
def _sample(time_s, per_sample, last):  # type: ignore[no-untyped-def]
    """Return the sample of the motion before a time, and the share of the way to the next one."""
    at = min(max(time_s * per_sample, 0.0), float(last))
    k = min(int(at), last - 1)
    return k, at - k


@njit(nogil=True, cache=True)
def _mark_firings(firings, shifts, per_sample, ranges):  # type: ignore[no-untyped-def]
    """Set each beam to +inf where a firing measured, to -inf where a return was too close, else to nan.

    Args:
        firings: azimuth (rad), time (s) and too-close flag of each firing sequence, (F,) each.
        shifts: poses of the base over the revolution relative to its end, (S, 3).
        per_sample: samples of ``shifts`` per second.
        ranges: output, (beams,).
    """
    azimuth, time_s, too_close = firings
    beams = ranges.shape[0]
    per_beam = 2.0 * np.pi / beams
    ranges[:] = np.nan
    for i in range(azimuth.shape[0]):
        k, alpha = _sample(time_s[i], per_sample, shifts.shape[0] - 1)
        yaw = shifts[k, 2] + alpha * (shifts[k + 1, 2] - shifts[k, 2])
        # The mount's rotation drops out: a yaw of the base turns the sensor by the same angle.
        beam = int(np.floor((yaw - azimuth[i] + np.pi) / per_beam + 0.5)) % beams
        if too_close[i]:
            ranges[beam] = -np.inf
        elif np.isnan(ranges[beam]):
            ranges[beam] = np.inf


@njit(nogil=True, cache=True)
def _project(  # type: ignore[no-untyped-def]
    points, rotation, translation, shifts, per_sample, heights, limits, ranges
):
    """Lower the range of each beam to its nearest point.

    Args:
        points: points in the sensor's frame, `POINT_DTYPE`, (N,).
        rotation: mount of the sensor, (3, 3).
        translation: mount of the sensor, metres, (3,).
        shifts: as in `_mark_firings`.
        per_sample: as in `_mark_firings`.
        heights: smallest and largest height of an obstacle, metres.
        limits: smallest and largest range of the scan, metres.
        ranges: updated in place, (beams,).
    """
    beams = ranges.shape[0]
    per_beam = 2.0 * np.pi / beams
    for i in range(points.shape[0]):
        point = points[i]
        x = rotation[0, 0] * point.x + rotation[0, 1] * point.y + rotation[0, 2] * point.z + translation[0]
        y = rotation[1, 0] * point.x + rotation[1, 1] * point.y + rotation[1, 2] * point.z + translation[1]
        z = rotation[2, 0] * point.x + rotation[2, 1] * point.y + rotation[2, 2] * point.z + translation[2]
        if z < heights[0] or z > heights[1]:
            continue
        k, alpha = _sample(point.time, per_sample, shifts.shape[0] - 1)
        yaw = shifts[k, 2] + alpha * (shifts[k + 1, 2] - shifts[k, 2])
        c = np.cos(yaw)
        s = np.sin(yaw)
        moved_x = c * x - s * y + shifts[k, 0] + alpha * (shifts[k + 1, 0] - shifts[k, 0]) - translation[0]
        moved_y = s * x + c * y + shifts[k, 1] + alpha * (shifts[k + 1, 1] - shifts[k, 1]) - translation[1]
        moved_z = z - translation[2]
        # Back to the sensor's axes (the transposed rotation).
        scan_x = rotation[0, 0] * moved_x + rotation[1, 0] * moved_y + rotation[2, 0] * moved_z
        scan_y = rotation[0, 1] * moved_x + rotation[1, 1] * moved_y + rotation[2, 1] * moved_z
        distance = np.hypot(scan_x, scan_y)
        if distance > limits[1]:
            continue
        beam = int(np.floor((np.arctan2(scan_y, scan_x) + np.pi) / per_beam + 0.5)) % beams
        if distance < limits[0]:
            ranges[beam] = -np.inf
        elif not distance >= ranges[beam]:
            # This also fills beams that no firing marked as measured (nan compares false).
            ranges[beam] = distance
