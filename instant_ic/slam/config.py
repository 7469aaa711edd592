"""Parameters of the grid SLAM: one frozen dataclass per concept. `config/slam.yaml` describes each parameter."""

from __future__ import annotations

import dataclasses
import math
from dataclasses import dataclass
from typing import Any


def _require(config: Any, key: str, condition: bool, rule: str) -> None:
    if not condition:
        raise ValueError(f"{type(config).__name__}.{key} must be {rule} (got {getattr(config, key)!r})")


def _require_positive(config: Any, *keys: str) -> None:
    for key in keys:
        value = getattr(config, key)
        _require(config, key, math.isfinite(value) and value > 0, "> 0")


def _require_not_negative(config: Any, *keys: str) -> None:
    for key in keys:
        value = getattr(config, key)
        _require(config, key, math.isfinite(value) and value >= 0, ">= 0")


BACKENDS = ("graph", "rbpf")


@dataclass(frozen=True)
class OdometryNoise:
    """Standard deviation (1σ) of an odometry step of ``d`` metres and ``a`` radians.

    Translation: ``translation_floor_m + translation_per_m·d``; rotation:
    ``rotation_floor_rad + rotation_per_rad·a + rotation_per_m·d``.
    """

    translation_floor_m: float = 0.01
    translation_per_m: float = 0.2
    rotation_floor_rad: float = 0.03
    rotation_per_rad: float = 0.2
    rotation_per_m: float = 0.1

    def __post_init__(self) -> None:
        _require_positive(self, "translation_floor_m", "rotation_floor_rad")
        _require_not_negative(self, "translation_per_m", "rotation_per_rad", "rotation_per_m")


@dataclass(frozen=True)
class FieldConfig:
    """Local map for scan matching: a likelihood field built from recent keyframes."""

    resolution_m: float = 0.05
    sigma_m: float = 0.06
    surface_sigma_m: float = 0.04
    keyframes: int = 40
    max_range_m: float = 25.0
    join_gap_m: float = 0.3

    def __post_init__(self) -> None:
        _require_positive(self, "resolution_m", "sigma_m", "surface_sigma_m", "max_range_m")
        _require_not_negative(self, "join_gap_m")
        _require(self, "keyframes", self.keyframes >= 1, ">= 1")


@dataclass(frozen=True)
class MatchConfig:
    """Correlative search and Gauss-Newton refinement."""

    max_points: int = 240
    min_points: int = 20
    point_spacing_m: float = 0.04
    search_translation_m: float = 0.3
    search_translation_per_m: float = 0.4
    search_rotation_rad: float = 0.3
    search_rotation_per_rad: float = 0.4
    search_rotation_per_m: float = 0.2
    coarse_rotation_step_rad: float = 0.02
    fine_rotation_step_rad: float = 0.005
    residual_sigma: float = 0.6
    odometry_cutoff: float = 4.0
    refine_iterations: int = 20
    recovery_score: float = 0.6
    recovery_translation_m: float = 1.2
    recovery_rotation_rad: float = 1.2
    min_score: float = 0.35
    restart_after_lost_scans: int = 10
    free_motion_speed_mps: float = 1.0
    free_motion_yaw_rate_radps: float = 1.5

    def __post_init__(self) -> None:
        _require_positive(
            self,
            "search_translation_m",
            "search_rotation_rad",
            "coarse_rotation_step_rad",
            "fine_rotation_step_rad",
            "residual_sigma",
            "odometry_cutoff",
            "recovery_translation_m",
            "recovery_rotation_rad",
            "free_motion_speed_mps",
            "free_motion_yaw_rate_radps",
        )
        _require_not_negative(
            self,
            "point_spacing_m",
            "search_translation_per_m",
            "search_rotation_per_rad",
            "search_rotation_per_m",
        )
        _require(self, "min_points", self.min_points >= 3, ">= 3")
        _require(self, "max_points", self.max_points >= self.min_points, ">= min_points")
        _require(self, "refine_iterations", self.refine_iterations >= 0, ">= 0")
        _require(self, "min_score", 0 < self.min_score < 1, "between 0 and 1")
        _require(self, "recovery_score", self.min_score <= self.recovery_score < 1, "between min_score and 1")
        _require(self, "restart_after_lost_scans", self.restart_after_lost_scans >= 1, ">= 1")


@dataclass(frozen=True)
class KeyframeConfig:
    """Motion since the last keyframe after which a scan becomes a keyframe."""

    distance_m: float = 0.25
    rotation_rad: float = 0.2

    def __post_init__(self) -> None:
        _require_positive(self, "distance_m", "rotation_rad")


@dataclass(frozen=True)
class LoopConfig:
    """Loop closure and pose graph."""

    enabled: bool = True
    spacing_m: float = 0.5
    query_keyframes: int = 10
    chain_keyframes: int = 20
    min_chain_keyframes: int = 5
    chains: int = 2
    max_range_m: float = 20.0
    max_points: int = 250
    sigmas: float = 3.0
    max_reach_m: float = 10.0
    max_reach_rad: float = 0.8
    min_score: float = 0.6
    min_shape: float = 0.05
    min_gain: float = 0.35
    confirmations: int = 3
    sure_m: float = 0.25
    sure_rad: float = 0.06
    step_sigma_m: float = 0.005
    step_sigma_rad: float = 0.0015
    same_place: int = 3
    same_place_m: float = 0.35
    same_place_rad: float = 0.35
    loop_sigma_m: float = 0.03
    loop_sigma_rad: float = 0.01

    def __post_init__(self) -> None:
        _require_positive(
            self, "spacing_m", "max_range_m", "sigmas", "max_reach_m", "max_reach_rad", "sure_m", "sure_rad",
            "step_sigma_m", "step_sigma_rad", "same_place_m", "same_place_rad", "loop_sigma_m", "loop_sigma_rad",
        )  # fmt: skip
        for key in ("query_keyframes", "chain_keyframes", "min_chain_keyframes", "chains", "confirmations"):
            _require(self, key, getattr(self, key) >= 1, ">= 1")
        _require(self, "max_points", self.max_points >= 20, ">= 20")
        _require(self, "same_place", self.same_place >= 0, ">= 0")
        for key in ("min_score", "min_gain"):
            _require(self, key, 0 < getattr(self, key) < 1, "between 0 and 1")
        _require(self, "min_shape", 0 <= self.min_shape < 1, "between 0 and 1")


@dataclass(frozen=True)
class MotionConfig:
    """Thresholds for detecting disagreement between wheel odometry and scans."""

    window_s: float = 2.0
    still_m: float = 0.02
    still_rad: float = 0.03
    moved_m: float = 0.1
    moved_rad: float = 0.15
    carried_jump_m: float = 0.4
    slip_share: float = 0.4
    stuck_share: float = 0.85
    turn_memory: float = 0.95

    def __post_init__(self) -> None:
        _require_positive(self, "window_s", "still_m", "still_rad", "carried_jump_m")
        _require(self, "moved_m", self.moved_m > self.still_m, "> still_m")
        _require(self, "moved_rad", self.moved_rad > self.still_rad, "> still_rad")
        _require(self, "slip_share", 0 < self.slip_share < 1, "between 0 and 1")
        _require(self, "stuck_share", self.slip_share < self.stuck_share < 1, "between slip_share and 1")
        _require(self, "turn_memory", 0 < self.turn_memory < 1, "between 0 and 1")


@dataclass(frozen=True)
class ParticleConfig:
    """The particle filter (``backend: rbpf``), with GMapping's parameter names and defaults."""

    particles: int = 30
    linearUpdate: float = 1.0
    angularUpdate: float = 0.5
    resampleThreshold: float = 0.5
    maxUrange: float = 20.0
    sigma: float = 0.05
    kernelSize: int = 1
    lstep: float = 0.05
    astep: float = 0.05
    iterations: int = 5
    lsigma: float = 0.075
    ogain: float = 3.0
    lskip: int = 0
    minimumScore: float = 0.0
    srr: float = 0.1
    srt: float = 0.2
    str: float = 0.1
    stt: float = 0.2
    delta: float = 0.05
    seed: int = 0

    def __post_init__(self) -> None:
        _require_positive(
            self, "linearUpdate", "angularUpdate", "maxUrange", "sigma", "lstep", "astep", "lsigma", "ogain", "delta"
        )
        _require_not_negative(self, "minimumScore", "srr", "srt", "str", "stt", "lskip", "kernelSize", "seed")
        _require(self, "particles", self.particles >= 1, ">= 1")
        _require(self, "iterations", self.iterations >= 0, ">= 0")
        _require(self, "resampleThreshold", 0 <= self.resampleThreshold <= 1, "between 0 and 1")


@dataclass(frozen=True)
class MapConfig:
    """Occupancy grid, built by ray casting from the keyframes."""

    resolution_m: float = 0.05
    max_range_m: float = 20.0
    no_return_clear_m: float = 0.0
    hit_probability: float = 0.7
    miss_probability: float = 0.4
    min_probability: float = 0.03
    max_probability: float = 0.97
    max_size_m: float = 400.0

    def __post_init__(self) -> None:
        _require_positive(self, "resolution_m", "max_range_m", "max_size_m")
        _require_not_negative(self, "no_return_clear_m")
        _require(self, "hit_probability", 0.5 < self.hit_probability < 1, "between 0.5 and 1")
        _require(self, "miss_probability", 0 < self.miss_probability < 0.5, "between 0 and 0.5")
        _require(self, "min_probability", 0 < self.min_probability < 0.5, "between 0 and 0.5")
        _require(self, "max_probability", 0.5 < self.max_probability < 1, "between 0.5 and 1")
        _require(self, "max_size_m", self.max_size_m >= 2 * self.max_range_m, ">= 2 max_range_m")


@dataclass(frozen=True)
class SlamConfig:
    """All parameters of a SLAM method."""

    backend: str = "graph"
    odometry: OdometryNoise = dataclasses.field(default_factory=OdometryNoise)
    field: FieldConfig = dataclasses.field(default_factory=FieldConfig)
    match: MatchConfig = dataclasses.field(default_factory=MatchConfig)
    keyframe: KeyframeConfig = dataclasses.field(default_factory=KeyframeConfig)
    loop: LoopConfig = dataclasses.field(default_factory=LoopConfig)
    map: MapConfig = dataclasses.field(default_factory=MapConfig)
    motion: MotionConfig = dataclasses.field(default_factory=MotionConfig)
    rbpf: ParticleConfig = dataclasses.field(default_factory=ParticleConfig)

    def __post_init__(self) -> None:
        _require(self, "backend", self.backend in BACKENDS, f"one of {', '.join(BACKENDS)}")
