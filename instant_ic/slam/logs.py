"""Readers of 2D laser logs: CARMEN (`FLASER`, `ROBOTLASER1`) and the mines recordings of BreezySLAM.

A log is an iterable of `LogEntry`; a fault is a `LogError` that names file and line.
"""

from __future__ import annotations

import gzip
import math
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import IO

import numpy as np

from instant_ic.geometry.poses import relative2
from instant_ic.slam.scan import FloatArray, Scan


class LogError(ValueError):
    """A log that cannot be read: ``path:line: what is wrong``."""


@dataclass(frozen=True)
class LogEntry:
    """A scan with the odometry of its moment.

    Attributes:
        scan: ranges by REP-117.
        odom_pose: odom_from_base (3,).
        base_from_laser: (3,).
    """

    scan: Scan
    odom_pose: FloatArray
    base_from_laser: FloatArray


def open_log(path: str | Path) -> IO[str]:
    """Open a text log, gzip or not; the first two bytes tell."""
    path = Path(path)
    with path.open("rb") as raw:
        packed = raw.read(2) == b"\x1f\x8b"
    if packed:
        return gzip.open(path, "rt", encoding="ascii", errors="replace")
    return path.open(encoding="ascii", errors="replace")


def read_log(path: str | Path) -> Iterator[LogEntry]:
    """Scans of a log of either kind: a line of 24 or more bare numbers is the mines format.

    Raises:
        LogError: a line that cannot be read, or no scan at all.
        OSError: no such file.
    """
    with open_log(path) as lines:
        first = next((line for line in lines if line.strip() and not line.startswith("#")), "")
    fields = first.split()
    mines = len(fields) > _MINES_FIRST_RANGE and fields[0].lstrip("-").isdigit()
    yield from read_mines(path) if mines else read_carmen(path)


def read_carmen(path: str | Path, range_max: float = 80.0) -> Iterator[LogEntry]:
    """Scans of a CARMEN log.

    ``FLASER n r0..rn-1 x y theta odom_x odom_y odom_theta ipc_timestamp host logger_timestamp``: 180° to the front,
    right to left, 1° apart up to 181 beams and 0.5° above, from −90°. ``ROBOTLASER1`` lines carry angles and maximum
    themselves. Other messages are passed over. The laser's place on the robot follows from the line's two poses.

    Args:
        path: the log, gzip or not.
        range_max: FLASER readings at or above it, in metres, mean that nothing was met.

    Raises:
        LogError: a line that cannot be read, or no scan at all.
    """
    scans = 0
    with open_log(path) as lines:
        for number, line in enumerate(lines, start=1):
            kind, *fields = line.split() or [""]
            if kind not in ("FLASER", "ROBOTLASER1"):
                continue
            try:
                entry = _flaser(fields, range_max) if kind == "FLASER" else _robotlaser(fields)
            except (ValueError, IndexError, OverflowError) as error:
                raise LogError(f"{path}:{number}: {kind}: {error}") from None
            scans += 1
            yield entry
    if scans == 0:
        raise LogError(f"{path}: no FLASER or ROBOTLASER1 line: is this a CARMEN log?")


def _numbers(fields: list[str], what: str, count: int) -> FloatArray:
    if len(fields) < count:
        raise ValueError(f"{count} {what} announced, {len(fields)} there: the line is cut short")
    values = np.array([float(text) for text in fields[:count]])
    if not np.isfinite(values).all():
        raise ValueError(f"{what}: not a finite number among them")
    return values


def _count(text: str, what: str) -> int:
    count = int(text)
    if not 0 <= count <= 100_000:
        raise ValueError(f"number of {what} out of bounds: {count}")
    return count


def _stamp_ns(text: str) -> int:
    """Seconds in decimal, exactly: a float64 of an epoch time keeps only a tenth of a microsecond."""
    whole, _, part = text.partition(".")
    if not whole.isdigit() or (part and not part.isdigit()):
        raise ValueError(f"time stamp {text!r} is not a decimal number")
    return int(whole) * 1_000_000_000 + int((part + "000000000")[:9])


def _no_return(ranges: FloatArray, range_max: float) -> FloatArray:
    return np.where(ranges >= range_max, np.inf, ranges)


def _flaser(fields: list[str], range_max: float) -> LogEntry:
    if not fields:
        raise ValueError("the line is empty")
    count = _count(fields[0], "readings")
    ranges = _numbers(fields[1:], "readings", count)
    tail = fields[1 + count :]
    if len(tail) < 7:
        raise ValueError(f"two poses and a time must follow the {count} readings, only {len(tail)} fields do")
    poses = _numbers(tail, "pose values", 6)
    increment = math.radians(1.0 if count <= 181 else 0.5)
    scan = Scan(_no_return(ranges, range_max), -math.pi / 2, increment, 0.02, range_max, _stamp_ns(tail[6]))
    return LogEntry(scan, poses[3:], relative2(poses[3:], poses[:3]))


def _robotlaser(fields: list[str]) -> LogEntry:
    _, start, _, increment, range_max = _numbers(fields, "header values", 5)
    at = 7
    count = _count(fields[at], "readings")
    ranges = _numbers(fields[at + 1 :], "readings", count)
    at += 1 + count
    at += 1 + _count(fields[at], "remissions")
    tail = fields[at:]
    if len(tail) < 12:
        raise ValueError(f"poses, speeds and a time must follow the readings, only {len(tail)} fields do")
    poses = _numbers(tail, "pose values", 6)
    scan = Scan(_no_return(ranges, range_max), start, increment, 0.02, range_max, _stamp_ns(tail[11]))
    return LogEntry(scan, poses[3:], relative2(poses[3:], poses[:3]))


_MINES_FIRST_RANGE = 24
_MINES_RANGES = 682
_MINES_FIELD_OF_VIEW = math.radians(240.0)
_MINES_MARGIN = 70
_MINES_WHEEL_RADIUS_M = 0.077
_MINES_HALF_AXLE_M = 0.165
_MINES_TICKS_PER_TURN = 2000
_MINES_LASER_FORWARD_M = 0.145
_MINES_RANGE_MIN_M = 0.06
_MINES_RANGE_MAX_M = 4.0


def read_mines(path: str | Path) -> Iterator[LogEntry]:
    """Scans of a BreezySLAM `exp*.dat` recording (MinesRover: wheel ticks and a Hokuyo URG-04LX).

    Columns: 0 time in µs, 2 and 3 left and right ticks, from 24 on 682 ranges in mm over 240°, right to left, the
    outer 70 on each side useless. 0 and the sensor's small error codes are erroneous (NaN). The odometry is the
    differential drive's, integrated from the ticks; it starts at the origin.

    Raises:
        LogError: a line that cannot be read, or no scan at all.
    """
    increment = _MINES_FIELD_OF_VIEW / (_MINES_RANGES - 1)
    angle_min = -_MINES_FIELD_OF_VIEW / 2 + _MINES_MARGIN * increment
    metres_per_tick = 2 * math.pi * _MINES_WHEEL_RADIUS_M / _MINES_TICKS_PER_TURN
    pose = np.zeros(3)
    last_ticks: tuple[int, int] | None = None
    with open_log(path) as lines:
        for number, line in enumerate(lines, start=1):
            fields = line.split()
            if not fields:
                continue
            try:
                if len(fields) < _MINES_FIRST_RANGE + _MINES_RANGES:
                    raise ValueError(f"{_MINES_FIRST_RANGE + _MINES_RANGES} columns needed, {len(fields)} there")
                stamp_ns = int(fields[0]) * 1000
                ticks = int(fields[2]), int(fields[3])
                columns = fields[_MINES_FIRST_RANGE + _MINES_MARGIN :][: _MINES_RANGES - 2 * _MINES_MARGIN]
                ranges = np.array([int(text) for text in columns]) * 1e-3
            except ValueError as error:
                raise LogError(f"{path}:{number}: {error}") from None
            if last_ticks is not None:
                left = (ticks[0] - last_ticks[0]) * metres_per_tick
                right = (ticks[1] - last_ticks[1]) * metres_per_tick
                turn = (right - left) / (2 * _MINES_HALF_AXLE_M)
                way = 0.5 * (left + right)
                middle = pose[2] + 0.5 * turn
                pose = pose + np.array([way * math.cos(middle), way * math.sin(middle), turn])
            last_ticks = ticks
            ranges[ranges < _MINES_RANGE_MIN_M] = np.nan
            scan = Scan(
                _no_return(ranges, _MINES_RANGE_MAX_M),
                angle_min,
                increment,
                _MINES_RANGE_MIN_M,
                _MINES_RANGE_MAX_M,
                stamp_ns,
            )
            yield LogEntry(scan, pose.copy(), np.array([_MINES_LASER_FORWARD_M, 0.0, 0.0]))
    if last_ticks is None:
        raise LogError(f"{path}: no scan in it")
