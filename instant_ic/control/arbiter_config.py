"""Configuration of the arbiter."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Annotated

from instant_ic.config.ranges import Checked, Plausible, check_ranges, require_protection
from instant_ic.control.costmap import CostmapConfig
from instant_ic.control.footprint import Footprint
from instant_ic.control.freshness import TimeoutConfig
from instant_ic.control.kinematics import MotionLimits
from instant_ic.control.passage import PassageConfig
from instant_ic.control.prediction import PredictionConfig, stopping_distance
from instant_ic.control.safety import CollisionMonitorConfig

MOST_BLIND_M = 1.0
"""Longest distance driven at full speed before a lost source stops the robot."""


@dataclass(frozen=True)
class SwitchConfig(Checked):
    """Thresholds for switching between real and virtual.

    Attributes:
        position_m: largest distance between the two robots at which they agree, in metres.
        yaw_deg: largest difference in heading at which they agree, in degrees.
        return_dwell_s: seconds that the two must agree before the return begins.
        return_near_m: distance in metres to which the r-bot may close up before the return; faster than easing.
        return_patience_s: seconds of agreement after which the return begins from any remaining distance.
        picture_position_m: largest position error between view and camera image at a switch, in metres.
        picture_yaw_deg: largest heading error at a switch, in degrees.
        return_picture_m: as picture_position_m, for the return; smaller, because the v-bot is eased onto the r-bot.
        return_picture_yaw_deg: as picture_yaw_deg, at the return.
        return_turn_rad_s: rad/s; no return to the camera while the r-bot turns faster: its heading estimate lags.
        enter_timeout_s: seconds over which the r-bot slows to a stop while no view fits. The arbiter then waits for an
            image and a view of that place.
        return_timeout_s: seconds after which the return ends even if view and image are too rare to match.
        min_virtual_s: shortest stay in the virtual space, in seconds.
        min_real_s: seconds between a return, or an abandoned entry, and the next entry.
        return_margin_m: length in metres that must be free beyond the horizon that triggers an entry.
        neutral_return_s: seconds without a command after which the camera image returns even in front of an obstacle.
        lead_back_after_s: seconds without a command after which the v-bot goes back to an r-bot that cannot follow; 0:
            never.
        stop_margin_m: distance in metres kept to an obstacle when no switch is possible.
        min_expected_psnr_db: smallest expected quality in dB of a view at the robot's place; 0: not checked.
        ready_hold_s: seconds for which the virtual space still counts as ready while it learns its next keyframe.
    """

    position_m: Annotated[float, Plausible(0.01, 1)] = 0.15
    yaw_deg: Annotated[float, Plausible(0.5, 45)] = 10.0
    return_dwell_s: Annotated[float, Plausible(0, 10)] = 0.5
    return_near_m: Annotated[float, Plausible(0.005, 1)] = 0.05
    return_patience_s: Annotated[float, Plausible(0, 30)] = 1.5
    picture_position_m: Annotated[float, Plausible(0.001, 0.5)] = 0.02
    picture_yaw_deg: Annotated[float, Plausible(0.05, 20)] = 0.5
    return_picture_m: Annotated[float, Plausible(0.001, 0.5)] = 0.015
    return_picture_yaw_deg: Annotated[float, Plausible(0.05, 20)] = 0.3
    return_turn_rad_s: Annotated[float, Plausible(0.01, 6)] = 0.2
    enter_timeout_s: Annotated[float, Plausible(0.1, 60)] = 2.0
    return_timeout_s: Annotated[float, Plausible(0.5, 120)] = 8.0
    min_virtual_s: Annotated[float, Plausible(0, 60)] = 1.0
    min_real_s: Annotated[float, Plausible(0, 60)] = 1.0
    return_margin_m: Annotated[float, Plausible(0.05, 5)] = 0.5
    neutral_return_s: Annotated[float, Plausible(0, 600)] = 3.0
    lead_back_after_s: Annotated[float, Plausible(0, 600)] = 6.0
    stop_margin_m: Annotated[float, Plausible(0, 2)] = 0.15
    min_expected_psnr_db: Annotated[float, Plausible(0, 60)] = 12.0
    ready_hold_s: Annotated[float, Plausible(0, 60)] = 2.0


@dataclass(frozen=True)
class PoseTrustConfig:
    """Restrictions while the SLAM doubts its pose.

    Attributes:
        slow: probability of being lost from which the r-bot drives slowly and does not switch.
        stop: probability of being lost from which the r-bot stops, until the operator lets go of the controls.
        speed_m_s: speed limit in m/s from ``slow`` on.
        jump_m: m; a pose that jumps by this much more than the robot can have driven stops the r-bot as a lost pose
            does: the robot was carried off, or its pose was wrong.
        jump_deg: degrees; as jump_m, for the heading.
    """

    slow: Annotated[float, Plausible(0.01, 0.95)] = 0.1
    stop: Annotated[float, Plausible(0.01, 0.95)] = 0.5
    speed_m_s: Annotated[float, Plausible(0.02, 0.5)] = 0.15
    jump_m: Annotated[float, Plausible(0.05, 2)] = 0.4
    jump_deg: Annotated[float, Plausible(2, 90)] = 25.0

    def __post_init__(self) -> None:
        check_ranges(self)
        if self.stop < self.slow:
            raise ValueError(f"stop must be >= slow (got {self.stop}, {self.slow})")


@dataclass(frozen=True)
class ArbiterConfig(Checked):
    """Parameters of the node ``arbiter``.

    Attributes:
        collision_monitor: last step before /cmd_vel; the most restrictive polygon wins.
        timeouts: s; the command is zero when a message is older. For images (camera, view): late_s after their usual
            arrival, if that is later.
        rate_hz: steps of the state machine and messages on /cmd_vel, per second; while the robot rests, at most 10.
        unprotected: allow switching off the polygons stop and approach, the blind radius, the memory or the 3D points,
            with a permanent warning.
    """

    limits: MotionLimits = field(default_factory=MotionLimits)
    footprint: Footprint = field(default_factory=Footprint)
    prediction: PredictionConfig = field(default_factory=PredictionConfig)
    collision_monitor: CollisionMonitorConfig = field(default_factory=CollisionMonitorConfig)
    passage: PassageConfig = field(default_factory=PassageConfig)
    switch: SwitchConfig = field(default_factory=SwitchConfig)
    timeouts: TimeoutConfig = field(default_factory=TimeoutConfig)
    pose_trust: PoseTrustConfig = field(default_factory=PoseTrustConfig)
    rate_hz: Annotated[float, Plausible(5, 200)] = 20.0
    costmap: CostmapConfig = field(default_factory=CostmapConfig)
    unprotected: bool = False

    def __post_init__(self) -> None:
        check_ranges(self)
        require_protection(self.unprotected, self.unprotected_by, "the robot does not stop before an obstacle")
        self._check_approach()
        self._check_distances()

    @property
    def unprotected_by(self) -> list[str]:
        """Names of the parameters that switch a protection off."""
        monitor = self.collision_monitor
        off = {
            f"collision_monitor.{name}": not polygon.enabled
            for name, polygon in {"stop": monitor.stop, "approach": monitor.approach}.items()
        }
        off["collision_monitor.blind_radius_m"] = monitor.blind_radius_m == 0.0
        off["collision_monitor.memory_range_m"] = monitor.memory_range_m == 0.0
        off["costmap.points.enabled"] = not self.costmap.points.enabled
        return [name for name, is_off in off.items() if is_off]

    def _check_approach(self) -> None:
        braking_s = self.limits.max_linear_m_s / self.limits.max_linear_accel_m_s2
        approach = self.collision_monitor.approach
        if approach.enabled and approach.time_before_collision < braking_s:
            raise ValueError(
                f"collision_monitor.approach.time_before_collision must be at least {braking_s:.2g} s, to brake "
                f"from max_linear_m_s by max_linear_accel_m_s2 (got {approach.time_before_collision})"
            )

    def _check_distances(self) -> None:
        speed = self.limits.max_linear_m_s
        for name in ("scan", "odometry", "pose", "command"):
            if (blind_m := getattr(self.timeouts, name) * speed) > MOST_BLIND_M:
                raise ValueError(
                    f"timeouts.{name} must be at most {MOST_BLIND_M / speed:.2g} s: at max_linear_m_s the robot drives "
                    f"{blind_m:.2g} m without it (got {getattr(self.timeouts, name)})"
                )
        needed_m = stopping_distance(speed, self.limits, self.prediction.latency_s) + 0.5 * self.footprint.length_m
        seen_m = min(self.costmap.obstacle_max_range, 0.5 * self.costmap.width)
        if needed_m > seen_m:
            raise ValueError(
                f"limits.max_linear_accel_m_s2 must stop the robot within {seen_m:.2g} m, which the costmap sees (got "
                f"{self.limits.max_linear_accel_m_s2}: {needed_m:.2g} m from {speed:g} m/s)"
            )
