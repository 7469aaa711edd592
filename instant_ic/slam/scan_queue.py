"""Queue of scans that wait for the odometry of their stamps."""

from __future__ import annotations

from collections import deque
from collections.abc import Iterator
from dataclasses import dataclass

from instant_ic.geometry.poses import Matrix, pose2_from_matrix
from instant_ic.slam.config import QueueConfig
from instant_ic.slam.odometry import OdometryBuffer
from instant_ic.slam.scan import FloatArray, Scan
from instant_ic.util.diagnosis import Diagnosis, Level

STARTUP_WAIT_S, EXTRAPOLATE_S = 1.0, 0.2
"""Longest time that the first scans wait for any odometry; longest extrapolation of the last motion."""
TIME_JUMP_S = 1.0
"""Jump back in time above which a new map starts, for example when a bag is played again."""
SILENT_NS = 500_000_000
"""Difference between the newest odometry's stamp and a scan's above which the scan does not wait."""


class ScanError(ValueError):
    """A scan cannot be used."""


@dataclass(frozen=True)
class QueuedScan:
    """A scan with the laser's mount base_from_laser (3,) and the time of arrival."""

    scan: Scan
    base_from_laser: FloatArray
    arrived_ns: int


class ScanQueue:
    """Keeps scans until the odometry of their stamps has arrived or their waiting time is over.

    Attributes:
        config: parameters, which may be replaced at any time.
        last_ns: stamp of the newest scan; None before the first.
        dropped: number of scans that could not be used.
        state: diagnosis of the arrival and use of scans.
    """

    def __init__(self, config: QueueConfig) -> None:
        self.config = config
        self.last_ns: int | None = None
        self.dropped = 0
        self.state = Diagnosis("scan", Level.WARN, "No scan on /scan yet. Check that vlp16_driver runs")
        self._came_ns = 0
        self._wheel = OdometryBuffer()
        self._waiting: deque[QueuedScan] = deque()
        self._first_wait_ns: int | None = None

    def restart(self) -> None:
        """Forget all scans."""
        self.last_ns = None
        self._waiting.clear()

    def add_odometry(self, stamp_ns: int, odom_from_base: FloatArray) -> bool:
        """Add odometry (3,), unless it is not finite or not newer than the last. Return whether it was added."""
        newest = self._wheel.newest_ns
        if newest is not None and newest - stamp_ns > TIME_JUMP_S * 1e9:
            self._wheel.clear()
        return self._wheel.add(stamp_ns, odom_from_base)

    def check_stamp(self, stamp_ns: int, now_ns: int) -> float:
        """Return by how many seconds time went back at this scan. If it is above 0, a new map must start.

        Raises:
            ScanError: the scan is too old, in the future or not newer than the last.
        """
        age_s = (now_ns - stamp_ns) * 1e-9
        if abs(age_s) > self.config.max_scan_age_s:
            when = f"{age_s:.2f} s old" if age_s > 0 else f"{-age_s:.2f} s in the future"
            raise ScanError(f"The scan is {when}. Check the clocks, or set use_sim_time for a recording")
        if self.last_ns is None or stamp_ns > self.last_ns:
            return 0.0
        back_s = (self.last_ns - stamp_ns) * 1e-9
        if back_s <= TIME_JUMP_S:
            raise ScanError(f"The scan is not newer than the last ({back_s:.3f} s back in time)")
        return back_s

    def drop(self, reason: str) -> None:
        """Count a scan that cannot be used."""
        self.dropped += 1
        self.state = Diagnosis("scan", Level.WARN, reason, {"dropped": self.dropped})

    def watch(self, steady_ns: int) -> Diagnosis:
        """Return the state at a steady time, which is an error if no scan has arrived for ``max_scan_age_s``."""
        age_s = (steady_ns - self._came_ns) * 1e-9
        if self.last_ns is not None and age_s > self.config.max_scan_age_s:
            return Diagnosis(
                "scan", Level.ERROR, f"No scan for {age_s:.1f} s. Check vlp16_driver", {"dropped": self.dropped}
            )
        return self.state

    def add(self, scan: Scan, base_from_laser: FloatArray, now_ns: int, steady_ns: int) -> None:
        """Add a scan with the laser's mount (3,)."""
        self.last_ns, self._came_ns = scan.stamp_ns, steady_ns
        self.state = Diagnosis("scan", Level.OK, "Fresh", {"dropped": self.dropped})
        self._waiting.append(QueuedScan(scan, base_from_laser, now_ns))

    @property
    def waiting(self) -> bool:
        """True if scans wait for odometry."""
        return bool(self._waiting)

    def ready(self, now_ns: int) -> Iterator[tuple[QueuedScan, FloatArray | None]]:
        """Yield the scans that need not wait any longer, each with odom_from_base (3,) or None."""
        while self._waiting:
            queued = self._waiting[0]
            odometry = None
            if self.config.use_wheel_odom:
                odometry = self._wheel.at(queued.scan.stamp_ns)
                if odometry is None:
                    if self._worth_waiting(queued, now_ns):
                        return
                    odometry = self._wheel.at(queued.scan.stamp_ns, EXTRAPOLATE_S)
            self._waiting.popleft()
            yield queued, odometry

    def _worth_waiting(self, queued: QueuedScan, now_ns: int) -> bool:
        """Return whether odometry for this scan may still come."""
        newest = self._wheel.newest_ns
        if newest is None:
            self._first_wait_ns = self._first_wait_ns or queued.arrived_ns
            return now_ns - self._first_wait_ns < STARTUP_WAIT_S * 1e9
        if abs(queued.scan.stamp_ns - newest) >= SILENT_NS:
            return False  # odometry has stopped, or the scan is older than all stored odometry
        return now_ns - queued.arrived_ns < self.config.odom_wait_s * 1e9


def level_mount(base_from_laser: Matrix) -> FloatArray:
    """Return the planar mount (3,) of a laser. Raise ValueError if its scan plane is not level."""
    if base_from_laser[2, 2] < 0.9:
        raise ValueError("the laser's z axis is more than 25° off the vertical: check its mount (lidar_mount)")
    return pose2_from_matrix(base_from_laser)
