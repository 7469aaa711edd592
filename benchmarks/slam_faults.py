"""SLAM under faults: each fault is put into a log at several places; error, detection, false alarms and recovery.

1. ``_clean_run``: run the log as it is, and keep a copy of the SLAM before each place.
2. A fault changes what the robot sees from a place on (``heading_jump``, ``gap``, ``blind``, ``kidnap``).
3. ``_figures``: run the copy on that, and compare its poses with those of the clean run. A pose is wrong if it is more
   than `WRONG_M` from the clean run's pose of the same scan.
4. ``relocalizations``: switch robots on anywhere in the map of every second scan.

The clean run is the reference. Relations or ground truth are not needed, so any log will do.
"""

from __future__ import annotations

import copy
import math
import time
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from instant_ic.experiments.slam import ascending, final_poses, from_anchor
from instant_ic.experiments.slam_logs import LogEntry, LogError
from instant_ic.geometry.poses import compose2, relative2, wrap_angle
from instant_ic.slam import GridSlam, SlamConfig, SlamResult
from instant_ic.slam.localization import SavedMap
from instant_ic.slam.scan import FloatArray
from instant_ic.slam.start import warm_up

WRONG_M = 0.5
"""A pose farther from the reference is wrong."""
KIDNAP_M = 3.0
"""Smallest distance of a kidnapping."""
GAP_S = 10.0
"""Duration of a gap in the scans, and of blindness."""
HEADING_JUMP_RAD = math.radians(85.0)
HORIZON_S, LEAST_SCANS, MOST_SCANS = 60.0, 100, 400
"""How long a fault at a place is followed: in seconds, and at least and at most in scans."""
WARM_UP_SCANS = 15
"""Scans from the start in the saved map to the kidnapping."""
STEADY_SCANS = 10
"""The robot has recovered when this many scans in a row are trusted and right."""
RANGE_NOISE_M = 0.01
"""Noise added to scans that are shown a second time, because they must not equal those in the map."""
WRONG_RAD = 0.2
"""A relocalization is wrong if its heading is off by more than this, or its position by more than `WRONG_M`."""
RELOCALIZATION_S, IN_TIME_S = 6.0, 2.0
"""How long a relocalization may take, and how long it should."""


@dataclass(frozen=True)
class Faulted:
    """Part of a log with a fault.

    Attributes:
        entries: scans that the robot sees.
        source: index of each scan in the clean log, (n,).
    """

    entries: list[LogEntry]
    source: NDArray[np.intp]


@dataclass(frozen=True)
class CleanRun:
    """Run without a fault: poses (n, 3) online and after the last optimisation, trust (n,), and the final state."""

    online: FloatArray
    final: FloatArray
    trusted: NDArray[np.bool_]
    slam: GridSlam

    def errors(self, poses: FloatArray, source: NDArray[np.intp], anchor: int | None) -> FloatArray:
        """Return the distance (n,) of ``poses`` (n, 3) from the reference.

        The map may have been optimised since the reference was published, and may be optimised again in the run with
        the fault. The smallest of three distances therefore counts: from the reference online, at the end, and relative
        to the pose of scan ``anchor`` (None: no anchor).
        """
        references = [self.online[source], self.final[source]]
        if anchor is not None:
            start = compose2(self.online[anchor], relative2(self.final[anchor], np.zeros(3)))
            references.append(np.array([compose2(start, pose) for pose in self.final[source]]))
        return np.min([np.hypot(*(poses - reference)[:, :2].T) for reference in references], axis=0)


def _part(entries: Sequence[LogEntry], at: int) -> range:
    """Return the indices of the scans from ``at`` for the time that a fault is followed."""
    end_ns = entries[at].scan.stamp_ns + int(HORIZON_S * 1e9)
    in_time = sum(entry.scan.stamp_ns <= end_ns for entry in entries[at : at + MOST_SCANS])
    return range(at, min(len(entries), at + max(in_time, LEAST_SCANS)))


def _seen_again_at(entries: Sequence[LogEntry], at: int) -> int:
    """Return the stamp in ns until which the scans of a gap that begins after scan ``at`` − 1 are lost."""
    return entries[at - 1].scan.stamp_ns + int(GAP_S * 1e9)


def _moved_odometry(entry: LogEntry, moved: FloatArray) -> LogEntry:
    return entry if entry.odom_pose is None else replace(entry, odom_pose=compose2(moved, entry.odom_pose))


def heading_jump(entries: Sequence[LogEntry], at: int, end: int, rng: np.random.Generator) -> Faulted:
    """Turn the odometry by 85° between two scans, permanently."""
    before = entries[at - 1].odom_pose
    moved = np.zeros(3)
    if before is not None:
        turned = compose2(before, [0.0, 0.0, HEADING_JUMP_RAD * rng.choice([-1.0, 1.0])])
        moved = compose2(turned, relative2(before, np.zeros(3)))
    part = range(at, end)
    return Faulted([_moved_odometry(entries[k], moved) for k in part], np.array(part))


def gap(entries: Sequence[LogEntry], at: int, end: int, rng: np.random.Generator) -> Faulted:
    """Leave out the scans of ten seconds; odometry goes on."""
    part = [k for k in range(at, end) if entries[k].scan.stamp_ns >= _seen_again_at(entries, at)]
    return Faulted([entries[k] for k in part], np.array(part, dtype=np.intp))


def blind(entries: Sequence[LogEntry], at: int, end: int, rng: np.random.Generator) -> Faulted:
    """Remove all returns from the scans of ten seconds; odometry goes on."""
    until_ns = _seen_again_at(entries, at)
    empty = [replace(e, scan=replace(e.scan, ranges=np.full_like(e.scan.ranges, np.inf))) for e in entries[at:end]]
    shown = [e if e.scan.stamp_ns < until_ns else entry for e, entry in zip(empty, entries[at:end], strict=True)]
    return Faulted(shown, np.arange(at, end))


def kidnap(entries: Sequence[LogEntry], at: int, end: int, there: int, rng: np.random.Generator) -> Faulted:
    """Move the robot of scan ``at`` − 1 to where scan ``there`` was taken; its odometry does not change meanwhile."""
    part = _part(entries, there)[: end - at]
    odometry, here = entries[at - 1].odom_pose, entries[there].odom_pose
    moved = np.zeros(3) if odometry is None or here is None else compose2(odometry, relative2(here, np.zeros(3)))
    step_ns = int(np.median(np.diff([entry.scan.stamp_ns for entry in entries])))
    begin_ns = entries[at - 1].scan.stamp_ns + step_ns - entries[there].scan.stamp_ns
    shown = []
    for k in part:
        entry = _moved_odometry(entries[k], moved)
        ranges = entry.scan.ranges + RANGE_NOISE_M * rng.standard_normal(len(entry.scan.ranges))
        scan = replace(entry.scan, ranges=ranges, stamp_ns=entry.scan.stamp_ns + begin_ns)
        shown.append(replace(entry, scan=scan))
    return Faulted(shown, np.array(part))


PLACE_FAULTS: dict[str, Callable[[Sequence[LogEntry], int, int, np.random.Generator], Faulted]] = {
    "heading_jump_85deg": heading_jump,
    "gap_10s": gap,
    "blind_10s": blind,
}
KIDNAPPINGS = ("kidnapped_mapping", "kidnapped_localized")
RELOCALIZATION = "relocalization"
FAULTS = (*PLACE_FAULTS, *KIDNAPPINGS, RELOCALIZATION)


def _steps(slam: GridSlam, entries: Sequence[LogEntry], last_ns: int | None = None) -> Iterator[SlamResult]:
    """Run the SLAM over entries; background work runs between the scans."""
    for entry, scan in ascending(entries, last_ns):
        result = slam.process(scan, entry.odom_pose, entry.base_from_laser)
        yield result
        job = slam.background_job()
        if job is not None:
            slam.take_over(job())


def _figures(
    slam: GridSlam, faulted: Faulted, clean: CleanRun, anchor: int | None, last_ns: int
) -> dict[str, float | int | None]:
    """Run a part with a fault and return the figures of its place; the time of an event that never occurs is None.

    ``recovered_after_s`` counts from the fault until ``STEADY_SCANS`` scans in a row are trusted and right.
    """
    results = list(_steps(slam, faulted.entries, last_ns))
    error_m = clean.errors(np.array([result.map_from_base for result in results]), faulted.source, anchor)
    trusted = np.array([result.trusted for result in results])
    wrong = error_m > WRONG_M
    right = trusted & ~wrong
    detected = recovered = None
    if wrong.any():
        onset = int(np.argmax(wrong))
        alarms = np.flatnonzero(~trusted[onset:])
        detected = int(alarms[0]) if len(alarms) else None
        steady = np.convolve(right, np.ones(STEADY_SCANS), "valid") >= STEADY_SCANS
        back = np.flatnonzero(steady[onset:])
        if len(back):
            recovered = (faulted.entries[onset + int(back[0])].scan.stamp_ns - last_ns) * 1e-9
    return {
        "end_error_m": float(error_m[-1]),
        "wrong_scans": int(wrong.sum()),
        "trusted_wrong_scans": int((wrong & trusted).sum()),
        "detected_after_scans": detected,
        "recovered_after_s": recovered,
        "right_at_end": bool(right[-1]),
    }


def summary(runs: Sequence[dict[str, float | int | None]]) -> dict[str, object]:
    """Return the figures of one fault over its places."""
    seconds = [run["recovered_after_s"] for run in runs if run["recovered_after_s"] is not None]
    return {
        "places": len(runs),
        "went_wrong": sum(bool(run["wrong_scans"]) for run in runs),
        "detected": sum(run["detected_after_scans"] is not None for run in runs),
        "trusted_wrong_scans_max": max((int(run["trusted_wrong_scans"] or 0) for run in runs), default=None),
        "recovered": len(seconds),
        "recovery_s_max": max(seconds, default=None),
        "right_at_end": sum(bool(run["right_at_end"]) for run in runs),
        "end_error_m_max": max((float(run["end_error_m"] or 0.0) for run in runs), default=None),
        "runs": list(runs),
    }


def evaluate_faults(
    entries: Sequence[LogEntry],
    config: SlamConfig | None = None,
    *,
    places: int = 5,
    seed: int = 0,
    faults: Sequence[str] = FAULTS,
    on_step: Callable[[str], None] = lambda name: None,
) -> dict[str, object]:
    """Put each fault into the log and compare with the run without faults; return figures for JSON, by fault.

    Args:
        entries: scans of the log.
        config: configuration of the SLAM; None: its defaults.
        places: number of places for each fault; chosen by ``seed``, the same for every fault.
        seed: seed of the places and of all other choices.
        faults: names of ``FAULTS``.
        on_step: called with the name of the run that begins.

    Raises:
        LogError: the log is too short.
    """
    if len(entries) < 2 * LEAST_SCANS:
        raise LogError(f"the log has {len(entries)} scans: too few to put faults into it ({2 * LEAST_SCANS} needed)")
    warm_up(config)
    rng = np.random.default_rng(seed)
    first, last = max(WARM_UP_SCANS + 1, len(entries) // 5), len(entries) - LEAST_SCANS // 2
    at = np.sort(rng.choice(np.arange(first, last), size=min(places, last - first), replace=False))
    on_step("clean")
    # A copy of the SLAM takes tens of megabytes.
    clean, before = _clean_run(entries, config, [int(k) for k in at] if {*faults} - {RELOCALIZATION} else [])
    alarms = int((clean.trusted[:-1] & ~clean.trusted[1:]).sum())
    hours = (entries[-1].scan.stamp_ns - entries[0].scan.stamp_ns) / 3.6e12
    report: dict[str, object] = {"clean": {"scans": len(entries), "hours": hours, "false_alarms": alarms}}
    for name in faults:
        on_step(name)
        if name == RELOCALIZATION:
            report[name] = relocalizations(entries, config, places, rng)
        else:
            runs = (_run_at(name, entries, k, slam, clean, np.random.default_rng([seed, k])) for k, slam in before)
            report[name] = summary([run for run in runs if run is not None])
    return report


def _run_at(
    name: str, entries: Sequence[LogEntry], at: int, slam: GridSlam, clean: CleanRun, rng: np.random.Generator
) -> dict[str, float | int | None] | None:
    """Run a fault from scan ``at`` on, after which ``slam`` is untouched; return None if the place is not suitable."""
    end = _part(entries, at).stop
    if name in PLACE_FAULTS:
        faulted = PLACE_FAULTS[name](entries, at, end, rng)
    else:
        away = np.hypot(*(clean.final - clean.final[at - 1])[: len(entries) - LEAST_SCANS, :2].T)
        far = np.flatnonzero(away > KIDNAP_M)
        if len(far) == 0:
            return None
        faulted = kidnap(entries, at, end, int(rng.choice(far)), rng)
    if len(faulted.entries) == 0:
        return None
    start_ns = entries[at - 1].scan.stamp_ns
    if name == "kidnapped_localized":
        return _figures(_localized(slam.config, entries, at, clean), faulted, clean, None, start_ns)
    return _figures(copy.deepcopy(slam), faulted, clean, at - 1, start_ns)


def relocalizations(
    entries: Sequence[LogEntry], config: SlamConfig | None, starts: int, rng: np.random.Generator
) -> dict[str, object]:
    """Return the figures of robots that are switched on at ``starts`` places of a map.

    Every second scan makes the map; the others are what the robots see. Their odometry starts anywhere.
    """
    made, _ = _clean_run(entries[::2], config, [])
    seen = entries[1::2]
    # The true pose of a scan between two scans of the map is interpolated between theirs.
    stamps = np.array([entry.scan.stamp_ns for entry in entries], dtype=np.float64)
    truth = np.column_stack([
        np.interp(stamps[1::2], stamps[::2], values)
        for values in (made.final[:, 0], made.final[:, 1], np.unwrap(made.final[:, 2]))
    ])  # fmt: skip
    grid = made.slam.grid()
    found_s: list[float] = []
    cpu_s: list[float] = []
    wrong = ambiguous = 0
    for place in rng.integers(0, max(len(seen) - LEAST_SCANS // 2, 1), starts):
        anywhere = np.array([*rng.uniform(-50.0, 50.0, 2), rng.uniform(-math.pi, math.pi)])
        last_ns = seen[place].scan.stamp_ns + int(RELOCALIZATION_S * 1e9)
        shown = [_moved_odometry(entry, anywhere) for entry in seen[place:] if entry.scan.stamp_ns <= last_ns]
        saved = SavedMap(config or SlamConfig(), grid)
        begin = time.process_time()
        for k, result in enumerate(_steps(GridSlam(config, saved), shown)):
            if result.localized:
                rest = relative2(truth[place + k], result.map_from_base)
                wrong += bool(math.hypot(rest[0], rest[1]) > WRONG_M or abs(wrap_angle(float(rest[2]))) > WRONG_RAD)
                found_s.append((shown[k].scan.stamp_ns - shown[0].scan.stamp_ns) * 1e-9)
                break
        cpu_s.append(time.process_time() - begin)
        ambiguous += not saved.located and saved.ambiguous
    seconds, cpu = np.array(found_s), np.array(cpu_s)
    return {
        "starts": starts,
        "found": len(seconds),
        "wrong": wrong,
        "ambiguous": ambiguous,
        "found_in_time": int((seconds <= IN_TIME_S).sum()),
        "seconds_median": float(np.median(seconds)) if len(seconds) else None,
        "cpu_s_median": float(np.median(cpu)),
    }


def _clean_run(
    entries: Sequence[LogEntry], config: SlamConfig | None, at: Sequence[int]
) -> tuple[CleanRun, list[tuple[int, GridSlam]]]:
    """Run without a fault; return the run, and copies of the SLAM before the scans ``at``."""
    slam = GridSlam(config)
    before: list[tuple[int, GridSlam]] = []
    online, trusted, anchored = [], [], []
    for k, result in enumerate(_steps(slam, entries)):
        online.append(result.map_from_base)
        trusted.append(result.trusted)
        anchored.append(from_anchor(result))
        if k + 1 in at:
            # The generator has not run the background work of this scan yet, so the copy will run it, too.
            before.append((k + 1, copy.deepcopy(slam)))
    slam.finish()
    return CleanRun(np.array(online), final_poses(anchored), np.array(trusted), slam), before


def _localized(config: SlamConfig, entries: Sequence[LogEntry], at: int, clean: CleanRun) -> GridSlam:
    """Return a robot that localises in the clean run's map and has just seen scan ``at`` − 1."""
    slam = GridSlam(config, SavedMap(config, clean.slam.grid()))
    for k in range(at - WARM_UP_SCANS, at):
        entry = entries[k]
        slam.process(entry.scan, entry.odom_pose, entry.base_from_laser)
        if k == at - WARM_UP_SCANS:
            slam.set_pose(clean.final[k])
    return slam
