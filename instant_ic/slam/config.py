"""Parameters of the grid SLAM: one frozen dataclass per concept. Metres, radians, seconds.

Values that depend on the method alone, not on the robot, the sensor or the place, are constants beside the code that
uses them.
"""

from __future__ import annotations

import dataclasses
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Literal

from instant_ic.config.ranges import NotNegative, Positive, PositiveInt, Range, check_ranges

Score = Annotated[float, Range(above=0, below=1)]


@dataclass(frozen=True)
class OdometryNoise:
    """Standard deviation (1σ) of an odometry step of ``d`` metres and ``a`` radians.

    Translation: ``translation_floor_m + translation_per_m·d``; rotation:
    ``rotation_floor_rad + rotation_per_rad·a + rotation_per_m·d``.

    Attributes:
        translation_floor_m: constant part of σ in translation, also while standing.
        translation_per_m: σ in translation per metre of odometry translation; tracks slip.
        rotation_floor_rad: constant part of σ in heading, also while standing.
        rotation_per_rad: σ in heading per radian of odometry; skid steering turns less than the encoders.
        rotation_per_m: σ in heading per metre of odometry translation.
    """

    translation_floor_m: Positive = 0.01
    translation_per_m: NotNegative = 0.2
    rotation_floor_rad: Positive = 0.03
    rotation_per_rad: NotNegative = 0.2
    rotation_per_m: NotNegative = 0.1

    def __post_init__(self) -> None:
        check_ranges(self)


@dataclass(frozen=True)
class FieldConfig:
    """Local map for scan matching: a likelihood field built from recent keyframes.

    Attributes:
        resolution_m: cell size; also the translation step of the search.
        sigma_m: width of a surface; a larger value tolerates larger errors but is less precise.
        keyframes: number of recent keyframes in the local map; more reduce drift and cost more.
        max_range_m: farther hits are not matched.
    """

    resolution_m: Positive = 0.05
    sigma_m: Positive = 0.06
    keyframes: PositiveInt = 40
    max_range_m: Positive = 25.0

    def __post_init__(self) -> None:
        check_ranges(self)


@dataclass(frozen=True)
class MatchConfig:
    """Search for the pose of a scan in the local map.

    Attributes:
        max_points: maximum number of points per scan, evenly chosen; the cost grows with it.
        min_points: a scan with fewer points is not matched; odometry decides.
        search_translation_m: half width of the search around the predicted pose; grows with the odometry step.
        search_rotation_rad: half width of the search in heading; grows with the odometry step.
        recovery_score: a score below this (0..1) starts the wide search.
        recovery_translation_m: half width of the wide search.
        recovery_rotation_rad: half width of the wide search in heading.
        min_score: below this the scan counts as lost: the pose comes from odometry.
        free_motion_speed_mps: without odometry: maximum speed of the robot, for the width of the search.
        free_motion_yaw_rate_radps: without odometry: maximum yaw rate, for the width of the search.
    """

    max_points: PositiveInt = 240
    min_points: Annotated[int, Range(low=3)] = 20
    search_translation_m: Positive = 0.3
    search_rotation_rad: Positive = 0.3
    recovery_score: Score = 0.6
    recovery_translation_m: Positive = 1.2
    recovery_rotation_rad: Positive = 1.2
    min_score: Score = 0.35
    free_motion_speed_mps: Positive = 1.0
    free_motion_yaw_rate_radps: Positive = 1.5

    def __post_init__(self) -> None:
        check_ranges(self)
        if self.max_points < self.min_points:
            raise ValueError(f"max_points must be >= min_points (got {self.max_points}, {self.min_points})")
        if self.recovery_score < self.min_score:
            raise ValueError(f"recovery_score must be >= min_score (got {self.recovery_score}, {self.min_score})")


@dataclass(frozen=True)
class KeyframeConfig:
    """Motion since the last keyframe after which a scan becomes a keyframe.

    Attributes:
        distance_m: translation after which a scan becomes a keyframe of the map.
        rotation_rad: rotation after which a scan becomes a keyframe of the map.
    """

    distance_m: Positive = 0.25
    rotation_rad: Positive = 0.2

    def __post_init__(self) -> None:
        check_ranges(self)


@dataclass(frozen=True)
class LoopConfig:
    """Loop closure and pose graph.

    Attributes:
        enabled: false: scan matching without loop closure.
        max_reach_m: maximum search range in translation; the range itself is 3σ of the drift.
        max_reach_rad: maximum search range in heading.
        min_score: minimum match score (0..1) of a loop, and of the robot's place in a saved map.
    """

    enabled: bool = True
    max_reach_m: Positive = 10.0
    max_reach_rad: Positive = 0.8
    min_score: Score = 0.6

    def __post_init__(self) -> None:
        check_ranges(self)


@dataclass(frozen=True)
class MapConfig:
    """Occupancy grid, built by ray casting from the keyframes.

    Attributes:
        resolution_m: cell size of /map.
        max_range_m: maximum length of a ray entered into the map.
        no_return_clear_m: length cleared by a beam without return; 0: none (glass, black walls).
        max_size_m: maximum side length of the map, centred on the start.
    """

    resolution_m: Positive = 0.05
    max_range_m: Positive = 20.0
    no_return_clear_m: NotNegative = 0.0
    max_size_m: Positive = 400.0

    def __post_init__(self) -> None:
        check_ranges(self)
        if self.max_size_m < 2 * self.max_range_m:
            raise ValueError(f"max_size_m must be >= 2 max_range_m (got {self.max_size_m}, {self.max_range_m})")


@dataclass(frozen=True)
class SlamConfig:
    """All parameters of the grid SLAM."""

    odometry: OdometryNoise = dataclasses.field(default_factory=OdometryNoise)
    field: FieldConfig = dataclasses.field(default_factory=FieldConfig)
    match: MatchConfig = dataclasses.field(default_factory=MatchConfig)
    keyframe: KeyframeConfig = dataclasses.field(default_factory=KeyframeConfig)
    loop: LoopConfig = dataclasses.field(default_factory=LoopConfig)
    map: MapConfig = dataclasses.field(default_factory=MapConfig)


@dataclass(frozen=True)
class QueueConfig:
    """Odometry and time of the scans.

    Attributes:
        use_wheel_odom: false: LiDAR odometry only; the node then broadcasts odom→base_link itself.
        odom_wait_s: maximum time that a scan waits for the odometry of its stamp.
        odom_startup_wait_s: maximum time that the first scans wait for any odometry.
        odom_extrapolate_s: maximum extrapolation of the last motion after odom_wait_s.
        max_scan_age_s: older scans are dropped with a warning; after this time without a scan: ERROR.
        reset_on_time_jump_s: a larger jump back in time starts a new map (a bag played again).
    """

    use_wheel_odom: bool = True
    odom_wait_s: NotNegative = 0.1
    odom_startup_wait_s: NotNegative = 1.0
    odom_extrapolate_s: NotNegative = 0.2
    max_scan_age_s: Positive = 1.0
    reset_on_time_jump_s: Positive = 1.0

    def __post_init__(self) -> None:
        check_ranges(self)


@dataclass(frozen=True)
class GridSlamConfig(SlamConfig, QueueConfig):
    """Parameters of the node ``grid_slam``, in addition to those of the method and of the queue.

    Attributes:
        mode: mapping: make a map, or extend map_file; localization: only localise in map_file.
        map_file: saved map, NAME or NAME.yaml ("ic map save NAME"); empty: start a new map.
        map_frame: frame of /map and /pose.
        odom_frame: frame of the odometry; corrections are published as map_frame → odom_frame.
        base_frame: frame of the robot, on the ground.
        map_period_s: minimum period of /map_updates, which holds the changed part of the map.
        map_full_period_s: minimum period of /map (whole map); raise it for slow links with /map_updates.
        correction_speed_mps: speed limit of a large correction of map→odom, so that the pose does not jump.
        correction_yaw_rate_radps: speed limit of a large correction in heading.
    """

    mode: Literal["mapping", "localization"] = "mapping"
    map_file: str = ""
    map_frame: str = "map"
    odom_frame: str = "odom"
    base_frame: str = "base_link"
    map_period_s: Positive = 1.0
    map_full_period_s: Positive = 1.0
    correction_speed_mps: Positive = 1.0
    correction_yaw_rate_radps: Positive = 1.0

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.mode == "localization" and not self.map_file:
            raise ValueError("mode localization needs map_file, the map to drive in")

    @property
    def saved_map(self) -> Path | None:
        """The saved map's file; None starts a new map."""
        return Path(self.map_file).expanduser() if self.map_file else None
