"""Decoder from data packets to points, one revolution at a time."""

from dataclasses import dataclass, field

import numpy as np
from numba import njit
from numba.extending import register_jitable
from numpy.typing import NDArray

from instant_ic.lidar.packets import (
    BLOCK_PERIOD_US,
    BLOCKS,
    DATA_PACKET_BYTES,
    DISTANCE_UNIT_M,
    FIRING_PERIOD_US,
    FIRINGS,
    LASER_ELEVATION_DEG,
    LASER_PERIOD_US,
    LASER_RING,
    LASER_VERTICAL_OFFSET_M,
    LASERS,
    RETURN_DUAL,
)

POINT_DTYPE = np.dtype(
    {
        "names": ["x", "y", "z", "intensity", "ring", "time"],
        "formats": ["<f4", "<f4", "<f4", "<f4", "<u2", "<f4"],
        "offsets": [0, 4, 8, 12, 16, 18],
        "itemsize": 22,
    }
)
"""Point in the layout of ros-drivers/velodyne; ``time`` is in seconds after the first firing."""

_ELEVATION = np.radians(LASER_ELEVATION_DEG)
_COS_ELEVATION = np.cos(_ELEVATION)
_SIN_ELEVATION = np.sin(_ELEVATION)
_AZIMUTH = np.radians(np.arange(36000) / 100.0)
_COS_AZIMUTH = np.cos(_AZIMUTH)
_SIN_AZIMUTH = np.sin(_AZIMUTH)
_RAY_TIME_US = FIRING_PERIOD_US * np.arange(FIRINGS)[:, None] + LASER_PERIOD_US * np.arange(LASERS)
"""Time of each ray of a block after the first ray of the block, (2, 16)."""
_TURN_CDEG = 36000
_BACK_CDEG = 50
"""Largest apparent backward turn of a standing head from one block to the next."""
_MAX_STEP_CDEG = 100
"""Largest turn from one block to the next, in 0.01 degrees: 80 at 1200 rpm, the highest speed, and a margin."""
_LONGEST_TURN_US = 200_000.0
"""Time of a turn at 300 rpm, the lowest speed: an upper limit of the time in a blocked sector."""


@dataclass(frozen=True)
class DecodedPackets:
    """Points of consecutive packets, and the firing sequences, including those without a return.

    Attributes:
        points: returns within the range limits, ordered by firing time, `POINT_DTYPE`, (N,).
        firing_azimuth: azimuth of each firing sequence, rad, clockwise from ahead, (F,).
        firing_time: time of each firing sequence after the first one, seconds, (F,).
        firing_too_close: whether a laser of the firing sequence had a return nearer than min_range, (F,).
        duration_s: time from the first firing to the end of the last one.
        start_us: time of the first firing after the first firing of its packet, microseconds.
    """

    points: NDArray[np.void]
    firing_azimuth: NDArray[np.float32]
    firing_time: NDArray[np.float32]
    firing_too_close: NDArray[np.bool_]
    duration_s: float
    start_us: float = field(default=0.0, kw_only=True)


def decode_packets(
    packets: NDArray[np.uint8],
    time_us: NDArray[np.float64],
    first_block: int = 0,
    end_block: int = BLOCKS,
    min_range: float = 0.4,
    max_range: float = 130.0,
) -> DecodedPackets:
    """Decode consecutive packets of one return mode.

    Axes follow ROS: x ahead (azimuth 0), y left, z up. The azimuth of each ray is interpolated with the mean turn rate
    of its packet and rounded to the sensor's unit, 0.01 degrees. In dual return mode a ray yields its last return, then
    its strongest (or second strongest) one; two returns at the same distance yield one point.

    A sensor with a limited field of view sends no blocks of the other directions, so a packet may span that gap. The
    turn rate is then computed without it, and blocks after the gap are later by the time of the turn across it.

    Args:
        packets: payloads, (P, 1206); all have the return mode of the first.
        time_us: time of each packet's first firing, any origin, (P,).
        first_block: first block to read in the first packet; an even number in dual return mode.
        end_block: first block not to read in the last packet; an even number in dual return mode.
        min_range: nearer returns are left out, metres.
        max_range: farther returns are left out, metres.
    """
    if packets.ndim != 2 or packets.shape[1] != DATA_PACKET_BYTES or len(packets) == 0:
        raise ValueError(f"packets must be (P, {DATA_PACKET_BYTES}) with P > 0 (got {packets.shape})")
    pair = 2 if packets[0, 1204] == RETURN_DUAL else 1
    points = np.empty(len(packets) * BLOCKS * FIRINGS * LASERS, POINT_DTYPE)
    firings = len(packets) * BLOCKS // pair * FIRINGS
    azimuth = np.empty(firings, np.float32)
    time = np.empty(firings, np.float32)
    too_close = np.empty(firings, np.bool_)
    limits = (
        int(np.ceil(min_range / DISTANCE_UNIT_M - 1e-6)),
        int(np.floor(max_range / DISTANCE_UNIT_M + 1e-6)),
    )
    n_points, n_firings, start_us, end_us = _decode(
        packets, time_us, first_block, end_block, pair, limits, points, (azimuth, time, too_close)
    )
    return DecodedPackets(
        points[:n_points],
        azimuth[:n_firings],
        time[:n_firings],
        too_close[:n_firings],
        end_us * 1e-6,
        start_us=start_us,
    )


@register_jitable
def turn_to(before: int, after: int) -> int:
    """Return the turn from one azimuth to the next, 0.01 degrees; slightly negative if the head stands."""
    turn = (after - before) % _TURN_CDEG
    return turn - _TURN_CDEG if turn >= _TURN_CDEG - _BACK_CDEG else turn


@register_jitable
def largest_step(smallest: int) -> int:
    """Return the largest turn between neighbouring blocks of a packet; a larger one spans a gap.

    Args:
        smallest: smallest turn between consecutive blocks of the packet, 0.01 degrees.
    """
    return min(_MAX_STEP_CDEG, smallest + max(smallest, 0) // 4 + 2)


@njit(nogil=True, cache=True)
def _steps(packet, pair, steps):  # type: ignore[no-untyped-def]
    """Write the turn before each column of a packet into ``steps``; return the neighbours' number, turn, and limit."""
    smallest = _TURN_CDEG
    before = packet[2] | np.int32(packet[3]) << 8
    for column in range(1, BLOCKS // pair):
        at = 100 * pair * column
        azimuth = packet[at + 2] | np.int32(packet[at + 3]) << 8
        steps[column] = turn_to(before, azimuth)
        smallest = min(smallest, steps[column])
        before = azimuth
    limit = largest_step(smallest)
    count, turned = 0, 0
    for column in range(1, BLOCKS // pair):
        if steps[column] <= limit:
            count += 1
            turned += steps[column]
    return count, turned, limit


@njit(nogil=True, cache=True)
def _column_times(steps, columns, count, limit, per_us, sent_us, column_us):  # type: ignore[no-untyped-def]
    """Write the time of each column of a packet after its first one into ``column_us``.

    Args:
        steps: turn before each column, 0.01 degrees.
        columns: number of columns.
        count: number of steps between neighbours.
        limit: largest step between neighbours.
        per_us: turn rate, 0.01 degrees per microsecond.
        sent_us: time to the next packet; infinite if unknown.
        column_us: output.
    """
    jumped = 0.0
    for column in range(1, columns):
        if steps[column] > limit:
            jumped += steps[column]
    gap_us = 0.0
    if jumped > 0.0:
        gap_us = min(jumped / per_us, _LONGEST_TURN_US) if per_us > 0.0 else BLOCK_PERIOD_US
        # The next packet's time is exact, unless packets are missing before it.
        exact_us = sent_us - (count + 1) * BLOCK_PERIOD_US
        if exact_us < gap_us + 0.5 * BLOCK_PERIOD_US * columns:
            gap_us = max(exact_us, 0.0)
    column_us[0] = 0.0
    for column in range(1, columns):
        step_us = BLOCK_PERIOD_US if steps[column] <= limit else gap_us * steps[column] / jumped
        column_us[column] = column_us[column - 1] + step_us


@njit(nogil=True, cache=True, boundscheck=False)
def _decode(packets, time_us, first_block, end_block, pair, limits, points, firings):  # type: ignore[no-untyped-def]
    """Decode packets (kernel of `decode_packets`, whose arrays it takes); ``pair`` is 2 in dual return mode, else 1.

    Returns:
        Number of points, number of firing sequences, start and end time in microseconds.
    """
    n_points = 0
    n_firings = 0
    n_packets = packets.shape[0]
    steps = np.zeros(BLOCKS, np.int64)
    column_us = np.zeros(BLOCKS)
    per_us = np.float32(0.0)
    start_us = 0.0
    end_us = 0.0
    for p in range(n_packets):
        packet = packets[p]
        count, turned, limit = _steps(packet, pair, steps)
        if count > 0:
            # Single precision and order of additions as in the C++ drivers, so that ties round the same way.
            per_us = np.float32(turned) / np.float32(count) / np.float32(BLOCK_PERIOD_US)
        sent_us = time_us[p + 1] - time_us[p] if p + 1 < n_packets else np.inf
        _column_times(steps, BLOCKS // pair, count, limit, per_us, sent_us, column_us)
        if p == 0:
            start_us = column_us[first_block // pair]
        start = first_block if p == 0 else 0
        stop = end_block if p == n_packets - 1 else BLOCKS
        for block in range(start, stop, pair):
            block_us = time_us[p] - time_us[0] - start_us + column_us[block // pair]
            n_points = _decode_block(
                packet, block, pair, per_us, block_us, limits, points, n_points, firings, n_firings
            )
            n_firings += FIRINGS
            end_us = block_us + FIRING_PERIOD_US * (FIRINGS - 1) + FIRING_PERIOD_US
    return n_points, n_firings, start_us, end_us


@njit(nogil=True, cache=True, boundscheck=False)
def _decode_block(  # type: ignore[no-untyped-def]
    packet, block, pair, per_us, block_us, limits, points, n_points, firings, n_firings
):
    """Decode a block, or a pair of dual returns; return the new number of points.

    ``per_us`` is the turn rate in 0.01 degrees per microsecond, ``block_us`` the time of the block's first ray after
    the revolution's first firing. ``limits`` are the smallest and the largest range in units of 2 mm.
    """
    firing_azimuth, firing_time, firing_too_close = firings
    at = 100 * block
    block_azimuth = np.float32(packet[at + 2] | np.int32(packet[at + 3]) << 8)
    for firing in range(FIRINGS):
        too_close = False
        for laser in range(LASERS):
            ray_us = _RAY_TIME_US[firing, laser]
            azimuth = block_azimuth + per_us * np.float32(ray_us)
            offset = at + 4 + 48 * firing + 3 * laser
            n_points, near = _decode_ray(
                packet, offset, laser, pair, azimuth, block_us + ray_us, limits, points, n_points
            )
            too_close |= near
        firing_us = FIRING_PERIOD_US * firing
        turn = (block_azimuth + per_us * np.float32(firing_us)) * np.float32(0.01)
        firing_azimuth[n_firings + firing] = np.radians(turn % np.float32(360.0))
        firing_time[n_firings + firing] = np.float32((block_us + firing_us) * 1e-6)
        firing_too_close[n_firings + firing] = too_close
    return n_points


@register_jitable(inline="always")
def _decode_ray(  # type: ignore[no-untyped-def]
    packet, offset, laser, pair, azimuth, time_us, limits, points, n_points
):
    """Decode the one or two returns of a ray; return the new number of points, and whether a return was too close.

    ``offset`` is the first byte of the first return; the second one follows a block later.
    """
    min_units, max_units = limits
    index = int(azimuth + np.float32(0.5) + np.float32(36000.0)) % 36000
    too_close = False
    before = -1
    for number in range(pair):
        at = offset + 100 * number
        units = packet[at] | np.int32(packet[at + 1]) << 8
        if units == 0 or units == before or units > max_units:
            continue
        if units < min_units:
            too_close = True
            continue
        before = units
        distance = units * DISTANCE_UNIT_M
        across = distance * _COS_ELEVATION[laser]
        point = points[n_points]
        point.x = np.float32(across * _COS_AZIMUTH[index])
        point.y = np.float32(-across * _SIN_AZIMUTH[index])
        point.z = np.float32(distance * _SIN_ELEVATION[laser] + LASER_VERTICAL_OFFSET_M[laser])
        point.intensity = np.float32(packet[at + 2])
        point.ring = LASER_RING[laser]
        point.time = np.float32(time_us * 1e-6)
        n_points += 1
    return n_points, too_close
