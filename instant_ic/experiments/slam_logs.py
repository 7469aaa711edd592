"""Readers of 2D laser logs: CARMEN (`FLASER`, `ROBOTLASER1`), the mines recordings of BreezySLAM, and bags.

A log is an iterable of `LogEntry`. A line that cannot be read is an error with file and line: the reader raises it as
`LogError`, or adds it to a list and leaves the line out.
"""

from __future__ import annotations

import gzip
import io
import math
import zlib
from collections.abc import Iterator
from dataclasses import dataclass
from decimal import Decimal, InvalidOperation
from pathlib import Path
from typing import IO, Any

import numpy as np

from instant_ic.bag import BagError, BagReader
from instant_ic.geometry.motion import along_arc
from instant_ic.geometry.poses import Pose2, pose2_from_matrix, relative2
from instant_ic.geometry.transforms import TransformBuffer, TransformError
from instant_ic.msg import deserialize, pose2_from_message, stamp_ns, transform_matrix
from instant_ic.slam.odometry import OdometryBuffer
from instant_ic.slam.scan import FloatArray, Scan

_MOST_LINE = 1 << 20
_MOST_LOG = 8 << 30


class LogError(ValueError):
    """A log cannot be read: ``path:line: what is wrong``."""


@dataclass(frozen=True)
class LogEntry:
    """A scan with the odometry at its stamp.

    Attributes:
        scan: ranges by REP-117.
        odom_pose: odom_from_base (3,); None if the log has no odometry.
        base_from_laser: (3,).
    """

    scan: Scan
    odom_pose: FloatArray | None
    base_from_laser: FloatArray


class _Lines(io.TextIOWrapper):
    """Lines of a text file, limited in length: a few kilobytes of gzip can hold one line of gigabytes."""

    def __init__(self, raw: Any, path: Path, bad: list[str] | None) -> None:
        super().__init__(raw, encoding="ascii", errors="replace")
        self._path, self._left, self._bad = path, _MOST_LOG, bad

    def __next__(self) -> str:  # type: ignore[override]
        try:
            line = self.readline(_MOST_LINE + 1)
        except (EOFError, zlib.error, gzip.BadGzipFile) as error:
            refuse(LogError(f"{self._path}: the gzip file is cut or damaged: {error}"), self._bad)
            raise StopIteration from None
        self._left -= len(line)
        if not line:
            raise StopIteration
        if len(line) > _MOST_LINE or self._left < 0:
            raise LogError(f"{self._path}: a line exceeds {_MOST_LINE} characters, or the log {_MOST_LOG}")
        return line


def refuse(error: LogError, bad: list[str] | None) -> None:
    """Add the error of an ignored line to ``bad``, or raise it if ``bad`` is None."""
    if bad is None:
        raise error
    bad.append(str(error))


def open_log(path: str | Path, bad: list[str] | None = None) -> IO[str]:
    """Open a text log; gzip is detected from the first two bytes. A cut gzip file gives the lines that it holds."""
    path = Path(path)
    with path.open("rb") as raw:
        packed = raw.read(2) == b"\x1f\x8b"
    return _Lines(gzip.open(path, "rb") if packed else path.open("rb"), path, bad)


def read_log(path: str | Path, bad: list[str] | None = None) -> Iterator[LogEntry]:
    """Read the scans of a text log; a line of 24 or more bare numbers is the mines format.

    Args:
        path: log file, gzip or plain.
        bad: receives the errors of lines that cannot be read, which are left out; None: the first one raises.

    Raises:
        LogError: a line cannot be read, or the log has no scan.
        OSError: the file does not exist.
    """
    with open_log(path, []) as lines:  # the reader called below reports damaged lines
        first = next((line for line in lines if line.strip() and not line.startswith("#")), "")
    fields = first.split()
    mines = len(fields) > _MINES_FIRST_RANGE and fields[0].lstrip("-").isdigit()
    yield from read_mines(path, bad) if mines else read_carmen(path, bad)


@dataclass(frozen=True)
class _Survey:
    """Properties of a CARMEN log that can only be determined from the whole file.

    Attributes:
        range_max: FLASER readings at or above it mean "no return", metres.
        mount: base_from_laser (3,).
        odometry: slice of the line's six pose values that holds the odometry; None if there is none.
    """

    range_max: float
    mount: FloatArray
    odometry: slice | None


_LASER_POSE, _ROBOT_POSE = slice(0, 3), slice(3, 6)
_SICK_RANGE_MAX_M = 80.0
_SURVEYED_SCANS = 400


def read_carmen(path: str | Path, bad: list[str] | None = None) -> Iterator[LogEntry]:
    """Read the scans of a CARMEN log.

    ``FLASER n r0..rn-1 x y theta odom_x odom_y odom_theta ipc_timestamp host logger_timestamp``, right to left, with
    the middle beam pointing forward. ``ROBOTLASER1`` lines hold their own angles and maximum range. Other messages are
    skipped. The laser's mounting pose is the difference between the two poses of a line, if it is the same on all
    lines. Otherwise the first pose is a corrected one, and the laser is assumed to be mounted at the robot's centre.
    The odometry is the second pose, the first if the second never changes, or none if neither changes. FLASER readings
    mean "no return" at or above a limit: the log's own ``PARAM``, the value at which readings pile up, or 80 m.
    Arguments and errors are those of `read_log`.
    """
    survey = _survey(path)
    scans = 0
    with open_log(path, bad) as lines:
        for number, line in enumerate(lines, start=1):
            kind, *fields = line.split() or [""]
            if kind not in _CARMEN_SCANS:
                continue
            try:
                entry = _flaser(fields, survey) if kind == "FLASER" else _robotlaser(fields, survey)
            except (ValueError, IndexError, OverflowError) as error:
                refuse(LogError(f"{path}:{number}: {kind}: {error}"), bad)
                continue
            scans += 1
            yield entry
    if scans == 0:
        raise _nothing(LogError(f"{path}: no FLASER or ROBOTLASER1 line: is this a CARMEN log?"), bad)


def _nothing(error: LogError, bad: list[str] | None) -> LogError:
    """Return the error of a log without a scan: its first bad line's error, if it has a bad line."""
    return LogError(f"{bad[0]} (and no line can be read)") if bad else error


def _survey(path: str | Path) -> _Survey:
    """Read a whole CARMEN log once; malformed lines are skipped here and reported by the reader."""
    range_max: float | None = None
    poses: list[FloatArray] = []
    readings: list[FloatArray] = []
    with open_log(path, []) as lines:
        for line in lines:
            kind, *fields = line.split() or [""]
            try:
                if kind == "PARAM" and fields[0] in ("robot_front_laser_max", "robot_frontlaser_max"):
                    range_max = float(fields[1]) if range_max is None else range_max
                if kind not in _CARMEN_SCANS:
                    continue
                if kind == "FLASER":
                    count = _count(fields[0], "readings")
                    if len(readings) < _SURVEYED_SCANS and len(poses) % (1 if len(poses) < 100 else 10) == 0:
                        readings.append(_numbers(fields[1:], "readings", count))
                    tail = fields[1 + count :]
                else:
                    at = 8 + _count(fields[7], "readings")
                    tail = fields[at + 1 + _count(fields[at], "remissions") :]
                poses.append(_numbers(tail, "pose values", 6))
            except (ValueError, IndexError, OverflowError):
                continue
    if range_max is None:
        range_max = _pile(np.concatenate(readings)) if readings else _SICK_RANGE_MAX_M
    if not poses:
        return _Survey(range_max, np.zeros(3), _ROBOT_POSE)
    both = np.array(poses)
    moves = [len(both) == 1 or bool((both[:, part] != both[0, part]).any()) for part in (_LASER_POSE, _ROBOT_POSE)]
    if not moves[1]:
        return _Survey(range_max, np.zeros(3), _LASER_POSE if moves[0] else None)
    offsets = np.array([relative2(pose[_ROBOT_POSE], pose[_LASER_POSE]) for pose in poses])
    mount = np.median(offsets, axis=0)
    constant = (np.abs(offsets - mount).max(axis=0) <= _MOUNT_WOBBLE).all() and math.hypot(mount[0], mount[1]) < 2.0
    return _Survey(range_max, mount if constant else np.zeros(3), _ROBOT_POSE)


_CARMEN_SCANS = ("FLASER", "ROBOTLASER1")
_MOUNT_WOBBLE = np.array([0.05, 0.05, 0.05])


def _pile(readings: FloatArray) -> float:
    """Return the range that means "no return": the value at which the largest readings pile up, or the SICK's 80 m.

    A laser may write its maximum range for a beam without return (8.183 m, 50 m, ...). Taken as hits, these readings
    would add arcs of wall to the map.
    """
    readings = readings[readings < _SICK_RANGE_MAX_M]
    if len(readings) == 0:
        return _SICK_RANGE_MAX_M
    top = float(readings.max())
    at_top = readings >= top - 5e-4  # exactly the same value; readings of a wall are scattered
    below = int((~at_top & (readings >= 0.9 * top)).sum())
    piled = int(at_top.sum())
    return top - 5e-4 if piled >= max(50, 0.002 * len(readings)) and piled > below else _SICK_RANGE_MAX_M


def _numbers(fields: list[str], what: str, count: int) -> FloatArray:
    if len(fields) < count:
        raise ValueError(f"expected {count} {what}, found {len(fields)}: the line is truncated")
    values = np.array([float(text) for text in fields[:count]])
    if not np.isfinite(values).all():
        raise ValueError(f"{what}: a value is not a finite number")
    return values


def _count(text: str, what: str) -> int:
    count = int(text)
    if not 0 <= count <= 100_000:
        raise ValueError(f"number of {what} out of range: {count}")
    return count


_MOST_STAMP_S = 9_000_000_000
"""Largest stamp; in nanoseconds it still fits into 64 bits."""


def _stamp_ns(text: str) -> int:
    """Convert decimal seconds exactly: an epoch time in float64 keeps only a tenth of a microsecond."""
    try:
        seconds = Decimal(text)
        # int() of 1e9999999 would take minutes.
        if -_MOST_STAMP_S < seconds < _MOST_STAMP_S:
            return int(seconds * 1_000_000_000)
    except InvalidOperation:
        pass
    raise ValueError(f"time stamp {text[:40]!r} is not a decimal number below {_MOST_STAMP_S} s")


def _no_return(ranges: FloatArray, range_max: float) -> FloatArray:
    return np.where(ranges >= range_max, np.inf, ranges)


_FLASER_INCREMENT_DEG = {
    90: 2.0, 91: 2.0, 101: 1.0, 180: 1.0, 181: 1.0, 201: 0.5, 360: 0.5, 361: 0.5, 401: 0.25, 540: 0.5, 541: 0.5,
    681: 0.36, 682: 0.36, 720: 0.25, 721: 0.25, 1081: 0.25,
}  # fmt: skip
"""Degrees between the beams of common planar lasers, by number of beams; other numbers mean a 180° field of view."""


def _flaser(fields: list[str], survey: _Survey) -> LogEntry:
    if not fields:
        raise ValueError("the line is empty")
    count = _count(fields[0], "readings")
    ranges = _numbers(fields[1:], "readings", count)
    tail = fields[1 + count :]
    if len(tail) < 7:
        raise ValueError(f"expected two poses and a time after the {count} readings, found {len(tail)} fields")
    poses = _numbers(tail, "pose values", 6)
    increment = math.radians(_FLASER_INCREMENT_DEG.get(count, 180.0 / max(count - 1, 1) if count > 181 else 1.0))
    # 180 of 181 beams: the last one, at +90°, is missing. The same holds for the other even numbers.
    angle_min = -increment * (count // 2) if count in _FLASER_INCREMENT_DEG else -math.pi / 2
    scan = Scan(_no_return(ranges, survey.range_max), angle_min, increment, 0.02, survey.range_max, _stamp_ns(tail[6]))
    return _entry(scan, poses, survey)


def _robotlaser(fields: list[str], survey: _Survey) -> LogEntry:
    _, start, _, increment, range_max = _numbers(fields, "header values", 5)
    at = 7
    count = _count(fields[at], "readings")
    ranges = _numbers(fields[at + 1 :], "readings", count)
    at += 1 + count
    at += 1 + _count(fields[at], "remissions")
    tail = fields[at:]
    if len(tail) < 12:
        raise ValueError(f"expected poses, speeds and a time after the readings, found {len(tail)} fields")
    poses = _numbers(tail, "pose values", 6)
    scan = Scan(_no_return(ranges, range_max), start, increment, 0.02, range_max, _stamp_ns(tail[11]))
    return _entry(scan, poses, survey)


def _entry(scan: Scan, poses: FloatArray, survey: _Survey) -> LogEntry:
    odometry = None if survey.odometry is None else poses[survey.odometry]
    return LogEntry(scan, odometry, survey.mount)


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


def read_mines(path: str | Path, bad: list[str] | None = None) -> Iterator[LogEntry]:
    """Read the scans of a BreezySLAM `exp*.dat` recording (MinesRover: wheel ticks and a Hokuyo URG-04LX).

    Columns: 0 is the time in µs, 2 and 3 the left and right ticks, from 24 on 682 ranges in mm over 240°, right to
    left. The outer 70 on each side are unusable. 0 and the sensor's small error codes become NaN. The odometry
    is integrated from the ticks with differential drive kinematics and starts at the origin. Arguments and errors are
    those of `read_log`.
    """
    increment = _MINES_FIELD_OF_VIEW / (_MINES_RANGES - 1)
    angle_min = -_MINES_FIELD_OF_VIEW / 2 + _MINES_MARGIN * increment
    metres_per_tick = 2 * math.pi * _MINES_WHEEL_RADIUS_M / _MINES_TICKS_PER_TURN
    pose = np.zeros(3)
    last_ticks: tuple[int, int] | None = None
    with open_log(path, bad) as lines:
        for number, line in enumerate(lines, start=1):
            fields = line.split()
            if not fields:
                continue
            try:
                if len(fields) < _MINES_FIRST_RANGE + _MINES_RANGES:
                    raise ValueError(f"expected {_MINES_FIRST_RANGE + _MINES_RANGES} columns, found {len(fields)}")
                stamp_ns = int(fields[0]) * 1000
                ticks = int(fields[2]), int(fields[3])
                columns = fields[_MINES_FIRST_RANGE + _MINES_MARGIN :][: _MINES_RANGES - 2 * _MINES_MARGIN]
                ranges = np.array([int(text) for text in columns]) * 1e-3
            except (ValueError, OverflowError) as error:
                refuse(LogError(f"{path}:{number}: {error}"), bad)
                continue
            if last_ticks is not None:
                left = (ticks[0] - last_ticks[0]) * metres_per_tick
                right = (ticks[1] - last_ticks[1]) * metres_per_tick
                turn = (right - left) / (2 * _MINES_HALF_AXLE_M)
                way = 0.5 * (left + right)
                x, y, yaw = pose.tolist()
                pose = np.array(along_arc(x, y, yaw, way, turn))
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
        raise _nothing(LogError(f"{path}: contains no scan"), bad)


def is_bag(path: Path) -> bool:
    """Return whether a path looks like a bag: a folder, or a file with a bag's extension."""
    return path.is_dir() or path.suffix in (".mcap", ".db3")


def read_bag(path: Path, scan_topic: str | None = None) -> Iterator[LogEntry]:
    """Read the scans of a bag from ``scan_topic``, from ``/scan``, or from its only topic of type LaserScan.

    Odometry comes from the bag's Odometry topic (``/wheel/odom`` before ``/odom`` before any other), interpolated to
    the scan's stamp; the mount from ``/tf_static``. A scan outside the odometry's time range has none. Without a
    transform to ``base_link``, the laser is assumed to be mounted at the robot's centre.

    Raises:
        LogError: the path is no bag, the topic does not exist, or a scan is malformed.
    """
    try:
        with BagReader(path) as bag:
            types = {summary.topic: summary.type_name for summary in bag.topics}
            topic = _choose(path, types, "sensor_msgs/msg/LaserScan", scan_topic, ("/scan",))
            if topic is None:
                raise LogError(f"{path}: the bag has no topic of type LaserScan, only {', '.join(types) or 'none'}")
            odometry = OdometryBuffer(keep_s=1e9)
            wheels = _choose(path, types, "nav_msgs/msg/Odometry", None, ("/wheel/odom", "/odom"))
            transforms = TransformBuffer()
            for message in bag.messages([name for name in (wheels, "/tf_static") if name in types]):
                value = deserialize(message.payload, message.type_name)
                if message.topic == wheels:
                    odometry.add(stamp_ns(value), pose2_from_message(value))
                    continue
                for one in value.transforms:
                    transforms.set(one.header.frame_id, one.child_frame_id, 0, transform_matrix(one), True)
            scans = 0
            for message in bag.messages([topic]):
                value = deserialize(message.payload, message.type_name)
                stamp = stamp_ns(value)
                try:
                    scan = Scan(
                        np.asarray(value.ranges), float(value.angle_min), float(value.angle_increment),
                        float(value.range_min), float(value.range_max), stamp,
                    )  # fmt: skip
                except ValueError as error:
                    raise LogError(f"{path}: scan {scans + 1} on {topic}: {error}") from None
                scans += 1
                yield LogEntry(scan, odometry.at(stamp), _mount(transforms, value.header.frame_id))
            if scans == 0:
                raise LogError(f"{path}: no scan on {topic}")
    except BagError as error:
        raise LogError(str(error)) from None


def _choose(path: Path, types: dict[str, str], kind: str, wanted: str | None, usual: tuple[str, ...]) -> str | None:
    found = sorted(topic for topic, type_name in types.items() if type_name == kind)
    if wanted is not None:
        if wanted not in found:
            raise LogError(f"{path}: no LaserScan topic {wanted}; available: {', '.join(found) or 'none'}")
        return wanted
    for topic in usual:
        if topic in found:
            return topic
    if len(found) > 1 and kind.endswith("LaserScan"):
        raise LogError(f"{path}: several LaserScan topics ({', '.join(found)}): choose one with --scan-topic")
    return found[0] if found else None


def _mount(transforms: TransformBuffer, laser_frame: str) -> Pose2:
    try:
        return pose2_from_matrix(transforms.lookup("base_link", laser_frame))
    except TransformError:
        return np.zeros(3)
