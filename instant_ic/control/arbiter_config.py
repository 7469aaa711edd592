"""Configuration of the arbiter."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Annotated, TypeAlias

from instant_ic.config.ranges import Checked, NotNegative, Positive, Range, check_ranges
from instant_ic.control.costmap import CostmapConfig
from instant_ic.control.footprint import Footprint
from instant_ic.control.freshness import TimeoutConfig
from instant_ic.control.kinematics import MotionLimits
from instant_ic.control.passage import PassageConfig
from instant_ic.control.planner import PlannerConfig
from instant_ic.control.prediction import PredictionConfig
from instant_ic.control.safety import CollisionMonitorConfig
from instant_ic.control.subgoal import SubgoalConfig

_Probability: TypeAlias = Annotated[float, Range(above=0, high=1)]


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
        return_picture_m: as picture_position_m, at the return, where the v-bot is eased until the page has switched.
        return_picture_yaw_deg: as picture_yaw_deg, at the return.
        return_turn_rad_s: rad/s; no return to the camera while the r-bot turns faster: its heading estimate lags.
        enter_timeout_s: seconds in which the r-bot slows to a stand while no view fits. The arbiter then waits for an
            image and a view of that place.
        return_timeout_s: seconds after which the return ends although view and image (too rare) do not match.
        min_virtual_s: shortest stay in the virtual space, in seconds.
        min_real_s: seconds between a return, or an abandoned entry, and the next entry.
        return_margin_m: length in metres that must be free beyond the horizon that triggers an entry.
        neutral_return_s: seconds of hands off after which the real view returns even before an obstacle.
        lead_back_after_s: seconds of hands off after which the v-bot goes back to an r-bot that cannot come; 0: never.
        stop_margin_m: distance in metres kept to an obstacle when no switch is possible.
        min_expected_psnr_db: expected quality in dB that a view of the robot's place needs; 0: not checked.
        ready_hold_s: seconds for which a virtual space that learns its next keyframe counts as ready with the last one.
        require_view: false: nobody shows the virtual space; views are not waited for and may be missing.
    """

    position_m: Positive = 0.15
    yaw_deg: Positive = 10.0
    return_dwell_s: NotNegative = 0.5
    return_near_m: Positive = 0.05
    return_patience_s: NotNegative = 1.5
    picture_position_m: Positive = 0.02
    picture_yaw_deg: Positive = 0.5
    return_picture_m: Positive = 0.015
    return_picture_yaw_deg: Positive = 0.3
    return_turn_rad_s: Positive = 0.2
    enter_timeout_s: Positive = 2.0
    return_timeout_s: Positive = 8.0
    min_virtual_s: NotNegative = 1.0
    min_real_s: NotNegative = 1.0
    return_margin_m: Positive = 0.5
    neutral_return_s: NotNegative = 3.0
    lead_back_after_s: NotNegative = 6.0
    stop_margin_m: NotNegative = 0.15
    min_expected_psnr_db: NotNegative = 12.0
    ready_hold_s: NotNegative = 2.0
    require_view: bool = True


@dataclass(frozen=True)
class PoseTrustConfig:
    """What the robot may do when the SLAM doubts its pose.

    Attributes:
        slow: probability of being lost from which the r-bot drives slowly and does not switch.
        stop: probability of being lost from which the r-bot stops, until the operator lets go of the controls.
        speed_m_s: speed limit in m/s from the first of the two on.
        jump_m: m; a jump of the pose by more than this, and than the robot can have driven meanwhile, stops the r-bot
            as a lost pose does: it was carried off, or its pose was wrong.
        jump_deg: degrees; as jump_m, for the heading.
    """

    slow: _Probability = 0.1
    stop: _Probability = 0.5
    speed_m_s: Positive = 0.15
    jump_m: Positive = 0.4
    jump_deg: Positive = 25.0

    def __post_init__(self) -> None:
        check_ranges(self)
        if self.stop < self.slow:
            raise ValueError(f"stop must be >= slow (got {self.stop}, {self.slow})")


@dataclass(frozen=True)
class ArbiterConfig(Checked):
    """Parameters of the node ``arbiter``.

    Attributes:
        collision_monitor: last step before /cmd_vel; the most restrictive polygon wins.
        planner: finds out whether there is a way round the obstacle; the navigator has its own.
        timeouts: s; with an older message the command is zero. Images (camera, view): late_s after their usual arrival,
            if longer.
        rate_hz: steps of the state machine and messages on /cmd_vel, per second; while the robot rests, at most 10.
        wall_min_length_m: m; a straight run of occupied map cells this long is a wall, a shorter one is an obstacle.
    """

    limits: MotionLimits = field(default_factory=MotionLimits)
    footprint: Footprint = field(default_factory=Footprint)
    prediction: PredictionConfig = field(default_factory=PredictionConfig)
    collision_monitor: CollisionMonitorConfig = field(default_factory=CollisionMonitorConfig)
    passage: PassageConfig = field(default_factory=PassageConfig)
    planner: PlannerConfig = field(default_factory=PlannerConfig)
    subgoal: SubgoalConfig = field(default_factory=SubgoalConfig)
    switch: SwitchConfig = field(default_factory=SwitchConfig)
    timeouts: TimeoutConfig = field(default_factory=TimeoutConfig)
    pose_trust: PoseTrustConfig = field(default_factory=PoseTrustConfig)
    rate_hz: Positive = 20.0
    wall_min_length_m: Positive = 1.5
    costmap: CostmapConfig = field(default_factory=CostmapConfig)
