"""SLAM on a log: trajectory, relation error, CPU time per scan.

The relation metric is that of Kümmerle et al., On measuring the accuracy of SLAM algorithms, Autonomous Robots 2009. A
relation is the robot's pose at one time relative to another, verified by a person. The error is the residual of
`inverse(relation) ∘ relative(estimate)`. An early error does not count again in every later pose.

The final trajectory is evaluated, as is usual with this metric: each scan is attached to its keyframe and moves with it
in the last optimisation. The poses published online are kept beside it.
"""

from __future__ import annotations

import resource
import time
from collections import Counter
from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from instant_ic.experiments.slam_logs import LogEntry, LogError, open_log
from instant_ic.geometry.poses import compose2, relative2
from instant_ic.slam import GridSlam, Scan, SlamConfig, SlamResult
from instant_ic.slam.keyframes import ScanKeyframe
from instant_ic.slam.scan import FloatArray
from instant_ic.slam.start import warm_up

MATCH_S = 0.006
"""Two times that differ by at most this many seconds count as the same."""


@dataclass(frozen=True)
class Relations:
    """Verified relations: times in seconds (n, 2), relative planar poses (n, 3)."""

    times_s: FloatArray
    poses: FloatArray

    def __len__(self) -> int:
        return len(self.times_s)

    def at_stamps(self, stamps_s: FloatArray) -> Relations:
        """Return the relations with both ends within ``MATCH_S`` of one of ``stamps_s`` (m,)."""
        stamps = np.sort(stamps_s)
        if len(stamps) == 0:
            return Relations(self.times_s[:0], self.poses[:0])
        after = np.clip(np.searchsorted(stamps, self.times_s), 0, len(stamps) - 1)
        before = np.maximum(after - 1, 0)
        gap = np.minimum(np.abs(stamps[after] - self.times_s), np.abs(stamps[before] - self.times_s))
        keep = (gap <= MATCH_S).all(axis=1)
        return Relations(self.times_s[keep], self.poses[keep])


def _read_columns(path: str | Path, count: int, what: str) -> FloatArray:
    rows: list[list[float]] = []
    with open_log(path) as lines:
        for number, line in enumerate(lines, start=1):
            fields = line.split()
            if not fields or fields[0].startswith("#"):
                continue
            try:
                row = [float(text) for text in fields]
            except ValueError as error:
                raise LogError(f"{path}:{number}: {error}") from None
            if len(row) != count:
                raise LogError(f"{path}:{number}: expected {count} numbers for a {what}, found {len(row)}")
            rows.append(row)
    if not rows:
        raise LogError(f"{path}: contains no {what}")
    return np.array(rows)


def read_relations(path: str | Path) -> Relations:
    """Read a `.relations` file: ``t1 t2 x y z roll pitch yaw`` per line.

    Raises:
        LogError: a line cannot be read; the message names it.
    """
    rows = _read_columns(path, 8, "relation")
    return Relations(rows[:, :2], rows[:, [2, 3, 7]])


def read_stamps(path: str | Path) -> FloatArray:
    """Read times in seconds, one per line, (n,)."""
    return _read_columns(path, 1, "stamp")[:, 0]


def interpolate_trajectory(trajectory: FloatArray, times_s: FloatArray) -> FloatArray:
    """Interpolate a trajectory ``t x y yaw`` (n, 4) at times (m,), clamped at its ends; return poses (m, 3)."""
    yaw = np.interp(times_s, trajectory[:, 0], np.unwrap(trajectory[:, 3]))
    x = np.interp(times_s, trajectory[:, 0], trajectory[:, 1])
    y = np.interp(times_s, trajectory[:, 0], trajectory[:, 2])
    return np.stack([x, y, yaw], axis=1)


def relation_error(trajectory: FloatArray, relations: Relations) -> dict[str, float | int]:
    """Compare a trajectory ``t x y yaw`` (n, 4) with the relations within its time range; return figures.

    Raises:
        ValueError: no relation is within the trajectory's time range.
    """
    begin_s, end_s = trajectory[0, 0] - 1e-3, trajectory[-1, 0] + 1e-3
    inside = ((relations.times_s >= begin_s) & (relations.times_s <= end_s)).all(axis=1)
    if not inside.any():
        raise ValueError(
            f"none of {len(relations)} relations lies within the trajectory's time: is it this log's file?"
        )
    times, truth = relations.times_s[inside], relations.poses[inside]
    first = interpolate_trajectory(trajectory, times[:, 0])
    second = interpolate_trajectory(trajectory, times[:, 1])
    found = np.array([relative2(a, b) for a, b in zip(first, second, strict=True)])
    translation_m, rotation_deg = trajectory_errors(found, truth)
    return {
        "translation_mean_m": float(translation_m.mean()),
        "translation_std_m": float(translation_m.std()),
        "translation_median_m": float(np.median(translation_m)),
        "translation_max_m": float(translation_m.max()),
        "rotation_mean_deg": float(rotation_deg.mean()),
        "rotation_std_deg": float(rotation_deg.std()),
        "relations": len(times),
    }


def log_error(entries: Sequence[LogEntry], poses: FloatArray, relations: Relations) -> dict[str, float | int]:
    """Return ``relation_error`` of the poses (n, 3) of a log's scans."""
    times = np.array([entry.scan.stamp_ns * 1e-9 for entry in entries])
    order = np.argsort(times, kind="stable")
    return relation_error(np.column_stack([times, poses])[order], relations)


@dataclass(frozen=True)
class LogResult:
    """Result of running SLAM on a log.

    Attributes:
        trajectory: ``t x y yaw`` (n, 4), one row per scan, map_from_base after the last optimisation, seconds.
        online: the same with the poses published online.
        cpu_ms: CPU milliseconds of the scan thread per scan (n,), including the transfer of optimisation results.
        background_ms: CPU milliseconds of loop closure and optimisation after each scan (n,).
        scores: match score of each scan (n,).
        statuses: count of each status.
        slam: the final state, with its map.
    """

    trajectory: FloatArray
    online: FloatArray
    cpu_ms: FloatArray
    background_ms: FloatArray
    scores: FloatArray
    statuses: dict[str, int]
    slam: GridSlam

    def report(self) -> dict[str, object]:
        """Return figures for JSON; the mean counts all CPU time, the 99th percentile that of the scan thread."""
        return {
            "scans": len(self.trajectory),
            "cpu_ms_per_scan_mean": float((self.cpu_ms + self.background_ms).mean()),
            "cpu_ms_per_scan_p99": float(np.percentile(self.cpu_ms, 99)),
            "scan_thread_ms_mean": float(self.cpu_ms.mean()),
            "scan_thread_ms_max": float(self.cpu_ms.max()),
            "background_ms_per_scan_mean": float(self.background_ms.mean()),
            "peak_rss_mb": resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024,
            "score_mean": float(self.scores.mean()),
            "statuses": self.statuses,
            **self.slam.figures(),
        }


def run_log(
    entries: Iterable[LogEntry],
    config: SlamConfig | None = None,
    *,
    use_wheel_odom: bool = True,
    on_scan: Callable[[int], None] | None = None,
) -> LogResult:
    """Run SLAM over a log as fast as possible; background work runs between the scans.

    Clocks of public logs repeat and step back. SLAM gets a scan that is not newer than the previous one with a stamp
    one millisecond after it; the trajectory keeps the original stamp.

    Args:
        entries: scans with odometry, for example of ``slam_logs.read_log``.
        config: configuration of the SLAM; None: its defaults.
        use_wheel_odom: False ignores the log's odometry.
        on_scan: called with the number of processed scans, for a progress bar.

    Raises:
        LogError: the log has no scan.
    """
    slam = GridSlam(config)
    warm_up(config)
    stamps: list[float] = []
    online: list[FloatArray] = []
    anchored: list[tuple[ScanKeyframe | None, FloatArray]] = []
    cpu_ms: list[float] = []
    background_ms: list[float] = []
    scores: list[float] = []
    statuses: Counter[str] = Counter()
    for entry, scan in ascending(entries):
        begin = time.thread_time()
        result = slam.process(scan, entry.odom_pose if use_wheel_odom else None, entry.base_from_laser)
        scanned = time.thread_time()
        anchored.append(from_anchor(result))
        job = slam.background_job()
        outcome = None if job is None else job()
        worked = time.thread_time()
        if outcome is not None:
            slam.take_over(outcome)
        cpu_ms.append(1e3 * (time.thread_time() - worked + scanned - begin))
        background_ms.append(1e3 * (worked - scanned))
        stamps.append(entry.scan.stamp_ns * 1e-9)
        online.append(result.map_from_base)
        scores.append(result.score)
        statuses[result.status.value] += 1
        if on_scan is not None:
            on_scan(len(online))
    if not online:
        raise LogError("the log contains no scan")
    slam.finish()
    return LogResult(
        np.column_stack([stamps, final_poses(anchored)]),
        np.column_stack([stamps, np.array(online)]),
        np.array(cpu_ms),
        np.array(background_ms),
        np.array(scores),
        dict(statuses),
        slam,
    )


def ascending(entries: Iterable[LogEntry], last_ns: int | None = None) -> Iterator[tuple[LogEntry, Scan]]:
    """Yield each entry and its scan, stamped a millisecond after the previous one if it is not newer."""
    for entry in entries:
        scan = entry.scan
        if last_ns is not None and scan.stamp_ns <= last_ns:
            scan = replace(scan, stamp_ns=last_ns + 1_000_000)
        last_ns = scan.stamp_ns
        yield entry, scan


def from_anchor(result: SlamResult) -> tuple[ScanKeyframe | None, FloatArray]:
    """Return the pose (3,) relative to its keyframe, or the pose itself if there is none."""
    if result.anchor is None:
        return None, result.map_from_base
    return result.anchor, relative2(result.anchor.pose(), result.map_from_base)


def final_poses(anchored: Iterable[tuple[ScanKeyframe | None, FloatArray]]) -> FloatArray:
    """Return the poses (n, 3) of ``from_anchor`` after the last optimisation."""
    return np.array([there if anchor is None else compose2(anchor.pose(), there) for anchor, there in anchored])


def evaluate_log(
    entries: Iterable[LogEntry],
    relations: Relations | None = None,
    config: SlamConfig | None = None,
    *,
    use_wheel_odom: bool = True,
    on_scan: Callable[[int], None] | None = None,
) -> tuple[dict[str, object], LogResult]:
    """Run SLAM on a log and evaluate it; return figures for JSON, and the run itself.

    Figures of the final trajectory have plain names; ``online_translation_mean_m`` and ``online_rotation_mean_deg``
    refer to the poses published online. The other arguments are those of ``run_log``.
    """
    entries = list(entries)
    result = run_log(entries, config, use_wheel_odom=use_wheel_odom, on_scan=on_scan)
    report: dict[str, object] = {}
    if relations is not None:
        online = log_error(entries, result.online[:, 1:], relations)
        report.update(log_error(entries, result.trajectory[:, 1:], relations))
        report["online_translation_mean_m"] = online["translation_mean_m"]
        report["online_rotation_mean_deg"] = online["rotation_mean_deg"]
    report.update(result.report())
    return report, result


def trajectory_errors(estimate: FloatArray, truth: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Return distance in metres and angle in degrees of each pose (n, 3) from its ground truth (n, 3)."""
    rest = np.array([relative2(a, b) for a, b in zip(truth, estimate, strict=True)])
    return np.hypot(rest[:, 0], rest[:, 1]), np.degrees(np.abs(rest[:, 2]))
