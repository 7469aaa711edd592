"""SLAM on a log: trajectory, relation error, CPU time a scan.

The relation metric is that of Kümmerle et al., On measuring the accuracy of SLAM algorithms, Autonomous Robots 2009: a
relation says how the robot's pose at one time, checked by a person, lay to that at another; the error is what remains
of `inverse(relation) ∘ relative(estimate)`. It does not punish an early error again in every later pose.
"""

from __future__ import annotations

import math
import resource
import time
from collections.abc import Callable, Iterable
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from instant_ic.geometry.poses import relative2, wrap_angle
from instant_ic.slam import GridSlam, SlamConfig
from instant_ic.slam.grid_slam import warm_up
from instant_ic.slam.logs import LogEntry, LogError, open_log
from instant_ic.slam.scan import FloatArray


@dataclass(frozen=True)
class Relations:
    """Checked relations: times in seconds (n, 2), relative planar poses (n, 3)."""

    times_s: FloatArray
    poses: FloatArray

    def __len__(self) -> int:
        return len(self.times_s)

    def at_stamps(self, stamps_s: FloatArray, tolerance_s: float) -> Relations:
        """Those whose both ends lie within ``tolerance_s`` of one of ``stamps_s`` (m,)."""
        stamps = np.sort(stamps_s)
        if len(stamps) == 0:
            return Relations(self.times_s[:0], self.poses[:0])
        after = np.clip(np.searchsorted(stamps, self.times_s), 0, len(stamps) - 1)
        before = np.maximum(after - 1, 0)
        gap = np.minimum(np.abs(stamps[after] - self.times_s), np.abs(stamps[before] - self.times_s))
        keep = (gap <= tolerance_s).all(axis=1)
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
                raise LogError(f"{path}:{number}: {what} has {count} numbers, {len(row)} there")
            rows.append(row)
    if not rows:
        raise LogError(f"{path}: no {what} in it")
    return np.array(rows)


def read_relations(path: str | Path) -> Relations:
    """A `.relations` file: ``t1 t2 x y z roll pitch yaw`` a line.

    Raises:
        LogError: with the line number.
    """
    rows = _read_columns(path, 8, "a relation")
    return Relations(rows[:, :2], rows[:, [2, 3, 7]])


def read_stamps(path: str | Path) -> FloatArray:
    """Times in seconds, one a line, (n,)."""
    return _read_columns(path, 1, "a stamp")[:, 0]


@dataclass(frozen=True)
class RelationError:
    """Errors of each relation: metres (n,), degrees (n,)."""

    translation_m: FloatArray
    rotation_deg: FloatArray

    def summary(self) -> dict[str, float | int]:
        """Mean, standard deviation, median, largest."""
        return {
            "translation_mean_m": float(self.translation_m.mean()),
            "translation_std_m": float(self.translation_m.std()),
            "translation_median_m": float(np.median(self.translation_m)),
            "translation_max_m": float(self.translation_m.max()),
            "rotation_mean_deg": float(self.rotation_deg.mean()),
            "rotation_std_deg": float(self.rotation_deg.std()),
            "relations": len(self.translation_m),
        }


def interpolate_trajectory(trajectory: FloatArray, times_s: FloatArray) -> FloatArray:
    """Poses (m, 3) at ``times_s`` (m,) of a trajectory ``t x y yaw`` (n, 4) with growing times; its ends are held."""
    yaw = np.interp(times_s, trajectory[:, 0], np.unwrap(trajectory[:, 3]))
    x = np.interp(times_s, trajectory[:, 0], trajectory[:, 1])
    y = np.interp(times_s, trajectory[:, 0], trajectory[:, 2])
    return np.stack([x, y, yaw], axis=1)


def relation_error(trajectory: FloatArray, relations: Relations) -> RelationError:
    """Error of a trajectory ``t x y yaw`` (n, 4) against relations inside its time.

    Raises:
        ValueError: no relation is inside the trajectory's time.
    """
    inside = ((relations.times_s >= trajectory[0, 0] - 1e-3) & (relations.times_s <= trajectory[-1, 0] + 1e-3)).all(
        axis=1
    )
    if not inside.any():
        raise ValueError(
            f"none of {len(relations)} relations lies within the trajectory's time: is it this log's file?"
        )
    times, truth = relations.times_s[inside], relations.poses[inside]
    first = interpolate_trajectory(trajectory, times[:, 0])
    second = interpolate_trajectory(trajectory, times[:, 1])
    translation, rotation = [], []
    for a, b, relation in zip(first, second, truth, strict=True):
        rest = relative2(relation, relative2(a, b))
        translation.append(math.hypot(rest[0], rest[1]))
        rotation.append(math.degrees(abs(wrap_angle(float(rest[2])))))
    return RelationError(np.array(translation), np.array(rotation))


@dataclass(frozen=True)
class LogResult:
    """A log run through SLAM.

    Attributes:
        trajectory: ``t x y yaw`` (n, 4), one row a scan, map_from_base, seconds.
        cpu_ms: CPU milliseconds of each scan (n,).
        scores: match score of each scan (n,).
        statuses: how often each status came.
        slam: the state at the end, for its map.
    """

    trajectory: FloatArray
    cpu_ms: FloatArray
    scores: FloatArray
    statuses: dict[str, int]
    slam: GridSlam

    def report(self) -> dict[str, object]:
        """Figures for JSON."""
        return {
            "scans": len(self.trajectory),
            "cpu_ms_per_scan_mean": float(self.cpu_ms.mean()),
            "cpu_ms_per_scan_p99": float(np.percentile(self.cpu_ms, 99)),
            "peak_rss_mb": resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024,
            "score_mean": float(self.scores.mean()),
            "keyframes": len(self.slam.front_end.trajectory),
            "statuses": self.statuses,
        }


def run_log(
    entries: Iterable[LogEntry],
    config: SlamConfig | None = None,
    *,
    use_wheel_odom: bool = True,
    on_scan: Callable[[int], None] | None = None,
) -> LogResult:
    """Run SLAM over a log as fast as it goes.

    Args:
        entries: of `instant_ic.slam.logs.read_log`, or anything like it.
        config: defaults when None.
        use_wheel_odom: False leaves the log's odometry out.
        on_scan: called with the number of scans done, for a progress bar.
    """
    warm_up(config)
    slam = GridSlam(config)
    rows: list[list[float]] = []
    cpu_ms: list[float] = []
    scores: list[float] = []
    statuses: dict[str, int] = {}
    for entry in entries:
        begin = time.process_time()
        odom_pose = entry.odom_pose if use_wheel_odom else None
        result = slam.process(entry.scan, odom_pose, entry.base_from_laser)
        cpu_ms.append(1e3 * (time.process_time() - begin))
        rows.append([entry.scan.stamp_ns * 1e-9, *result.map_from_base])
        scores.append(result.score)
        statuses[result.status.value] = statuses.get(result.status.value, 0) + 1
        if on_scan is not None:
            on_scan(len(rows))
    return LogResult(np.array(rows).reshape(-1, 4), np.array(cpu_ms), np.array(scores), statuses, slam)


def evaluate_log(
    entries: Iterable[LogEntry],
    relations: Relations | None = None,
    config: SlamConfig | None = None,
    *,
    use_wheel_odom: bool = True,
    on_scan: Callable[[int], None] | None = None,
) -> tuple[dict[str, object], LogResult]:
    """Run a log and measure it: figures for JSON, and the run itself."""
    result = run_log(entries, config, use_wheel_odom=use_wheel_odom, on_scan=on_scan)
    report: dict[str, object] = {}
    if relations is not None:
        report.update(relation_error(result.trajectory, relations).summary())
    report.update(result.report())
    return report, result
