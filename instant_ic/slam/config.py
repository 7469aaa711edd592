"""Parameters of the grid SLAM: one frozen dataclass per concept. Metres, radians, seconds.

Values that depend only on the method, and not on robot, sensor or place, are constants beside the code that uses them.
"""

from __future__ import annotations

import dataclasses
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Literal

from instant_ic.config.ranges import Checked, NotNegative, Positive, Range, check_ranges


@dataclass(frozen=True)
class LikelihoodFieldConfig(Checked):
    """Local map for scan matching: a likelihood field built from recent keyframes.

    Attributes:
        resolution_m: cell size; also the translation step of the search.
        max_range_m: largest range of hits that are matched.
    """

    resolution_m: Positive = 0.05
    max_range_m: Positive = 25.0


@dataclass(frozen=True)
class MatchConfig(Checked):
    """Search for the pose of a scan in the local map.

    Attributes:
        max_points: maximum number of points per scan, evenly chosen; the cost grows with it.
        free_motion_speed_mps: maximum speed of the robot, which sets the width of the search without odometry.
        free_motion_yaw_rate_radps: maximum yaw rate, which sets the width of the search without odometry.
    """

    max_points: Annotated[int, Range(low=20)] = 240
    free_motion_speed_mps: Positive = 1.0
    free_motion_yaw_rate_radps: Positive = 1.5


@dataclass(frozen=True)
class MapConfig:
    """Occupancy grid, built by ray casting from the keyframes.

    Attributes:
        resolution_m: cell size of /map.
        max_range_m: maximum length of a ray that is entered into the map.
        max_size_m: maximum side length of the map, centred on the start.
    """

    resolution_m: Positive = 0.05
    max_range_m: Positive = 20.0
    max_size_m: Positive = 400.0

    def __post_init__(self) -> None:
        check_ranges(self)
        if self.max_size_m < 2 * self.max_range_m:
            raise ValueError(f"max_size_m must be >= 2 max_range_m (got {self.max_size_m}, {self.max_range_m})")


@dataclass(frozen=True)
class SlamConfig:
    """All parameters of the grid SLAM."""

    field: LikelihoodFieldConfig = dataclasses.field(default_factory=LikelihoodFieldConfig)
    match: MatchConfig = dataclasses.field(default_factory=MatchConfig)
    map: MapConfig = dataclasses.field(default_factory=MapConfig)


@dataclass(frozen=True)
class QueueConfig(Checked):
    """Odometry and age of the scans.

    Attributes:
        use_wheel_odom: use wheel odometry. Without it, LiDAR odometry is used and the node broadcasts odom→base_link.
        odom_wait_s: maximum time for which a scan waits for the odometry of its stamp.
        max_scan_age_s: age above which scans are dropped with a warning, and time without a scan that is an ERROR.
    """

    use_wheel_odom: bool = True
    odom_wait_s: NotNegative = 0.1
    max_scan_age_s: Positive = 1.0


@dataclass(frozen=True)
class GridSlamConfig(SlamConfig, QueueConfig):
    """Parameters of the node ``grid_slam``, in addition to those of the method and of the queue.

    Attributes:
        mode: ``mapping`` makes a map or extends map_file; ``localization`` only localises in map_file.
        map_file: saved map, NAME or NAME.yaml ("ic map save NAME"); empty starts a new map.
        map_period_s: minimum period of /map; raise it for slow links.
    """

    mode: Literal["mapping", "localization"] = "mapping"
    map_file: str = ""
    map_period_s: Positive = 1.0

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.mode == "localization" and not self.map_file:
            raise ValueError("mode localization needs map_file, the map to localise in")

    @property
    def saved_map(self) -> Path | None:
        """The saved map's file; None for a new map."""
        return Path(self.map_file).expanduser() if self.map_file else None
