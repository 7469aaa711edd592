"""State machine of illusory control: which robot the operator drives and which command is sent (paper, III.A).

The tables are data in ``states.py``; ``Arbiter.step`` runs them.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, field
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from instant_ic.config.ranges import NotNegative, Positive, check_ranges
from instant_ic.control.costmap import Costmap
from instant_ic.control.footprint import Footprint
from instant_ic.control.freshness import IMAGES, TimeoutConfig
from instant_ic.control.kinematics import MotionLimits, clip_twist
from instant_ic.control.passage import Passage, PassageConfig, find_passage
from instant_ic.control.planner import HybridPlanner, PlannerConfig
from instant_ic.control.prediction import Prediction, PredictionConfig, Predictor
from instant_ic.control.safety import CollisionMonitor, CollisionMonitorConfig, MonitoredCommand
from instant_ic.control.states import OPERATOR_LOST, SOURCES, TRANSITIONS, Mode, Source, VbotAction
from instant_ic.control.subgoal import Subgoal, SubgoalConfig, choose_subgoal
from instant_ic.control.walls import WallMap
from instant_ic.geometry.poses import wrap_angle

Twist2 = tuple[float, float]
"""Linear m/s, angular rad/s."""


PASSAGE_PERIOD_NS = 200_000_000
STEP_AFTER_S = 0.001
"""Delay of a step after the time-out it checks: the source is then surely stale. Time-outs end that much sooner."""
_STANDS_M_S, _STANDS_RAD_S = 0.03, 0.1
"""Below this speed a robot counts as standing."""
_CATCH_UP = 0.8
"""Speed limit of the v-bot as a share of the r-bot's."""
_SLOW_NS = 800_000_000
"""Longer than the v-bot takes to reach full speed."""


@dataclass(frozen=True)
class SwitchConfig:
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
        return_side_m: width in metres that must be free beside the footprint, on each side.
        neutral_return_s: seconds of hands off after which the real view returns even before an obstacle.
        lead_back_after_s: seconds of hands off after which the v-bot goes back to an r-bot that cannot come; 0: never.
        stop_margin_m: distance in metres kept to an obstacle when no switch is possible.
        min_switch_speed_m_s: forward speed in m/s below which the robot counts as turning.
        min_expected_psnr_db: expected quality in dB that a view of the robot's place needs; 0: not checked.
        ready_hold_s: seconds for which a virtual space that learns its next keyframe counts as ready with the last one.
        require_camera: false: drive without camera images (tests, replays).
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
    return_side_m: Positive = 0.12
    neutral_return_s: NotNegative = 3.0
    lead_back_after_s: NotNegative = 6.0
    stop_margin_m: NotNegative = 0.15
    min_switch_speed_m_s: NotNegative = 0.03
    min_expected_psnr_db: NotNegative = 12.0
    ready_hold_s: NotNegative = 2.0
    require_camera: bool = True
    require_view: bool = True

    def __post_init__(self) -> None:
        check_ranges(self)


@dataclass(frozen=True)
class ArbiterConfig:
    """Configuration of the arbiter's library part.

    Attributes:
        collision_monitor: last step before /cmd_vel; the most restrictive polygon wins.
        planner: answers «is there a way round?»; the navigator has its own.
        timeouts: s; with an older message the command is zero. Images (camera, view): late_s after their usual arrival,
            if longer.
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


@dataclass(frozen=True)
class Vspace:
    """State that the virtual space reports (VspaceStatus)."""

    ready: bool = False
    training: bool = False
    failed: bool = False
    position: NDArray[np.float64] = field(default_factory=lambda: np.zeros(2))
    """(2,) position of the newest keyframe in the map frame."""
    ready_radius_m: float = 0.0
    message: str = ""
    expected_psnr_db: float = 0.0
    """Of the view requested last; 0 or NaN: unknown."""


@dataclass(frozen=True)
class ArbiterInputs:
    """Inputs of one step; an age is inf until the first message."""

    robot_pose: NDArray[np.float64] | None = None
    """(3,) map_from_base of the r-bot; None while unknown."""
    robot_velocity: Twist2 = (0.0, 0.0)
    operator_command: Twist2 = (0.0, 0.0)
    operator_gone: bool = False
    """The client that sent the command has left since: the command is void, whatever its age."""
    estop: bool = False
    estop_button: bool = False
    """The button on the robot is pressed; only releasing it ends the stop."""
    estop_why: str = ""
    """Operator's text for a stop that nobody pressed in this run; empty: the usual text."""
    scan_points: NDArray[np.float64] = field(default_factory=lambda: np.zeros((0, 2)))
    """(N, 2) hits of the newest scan and 3D points in ``base_link``, at the robot's present pose."""
    costmap: Costmap | None = None
    walls: WallMap | None = None
    vspace: Vspace = field(default_factory=Vspace)
    vbot_pose: NDArray[np.float64] | None = None
    """(3,) pose of the v-bot in the map frame."""
    vbot_velocity: Twist2 = (0.0, 0.0)
    nav_command: Twist2 = (0.0, 0.0)
    shown_pose: NDArray[np.float64] | None = None
    """(3,) position of the r-bot when the camera image now shown was taken, with its present heading, to which the page
    turns each image; None: ``robot_pose``."""
    picture_position: NDArray[np.float64] | None = None
    """(2,) position of the camera in the map frame for the newest image that the operator has."""
    view_position: NDArray[np.float64] | None = None
    """(2,) position of the camera in the map frame for the newest rendered view that the operator has."""
    view_after_picture_s: float = 0.0
    """Seconds from the arrival of that image to the arrival of that view."""
    ages: dict[str, float] = field(default_factory=dict)
    """Seconds since the last message of: scan, odometry, pose, camera, view, vbot, nav, command, vspace; points and
    estop_input from their first message on."""
    usual: dict[str, float] = field(default_factory=dict)
    """Usual age of a source in seconds when its next message arrives (``freshness.Rhythm``)."""
    images_late_s: float = 0.0
    """Seconds until the operator has an image, from its exposure, or from the view's request if that takes longer."""

    def age(self, key: str) -> float:
        """Age of a source in seconds; inf before its first message."""
        return self.ages.get(key, math.inf)


@dataclass(frozen=True)
class Decision:
    """Result of one step: what to send and what to show."""

    mode: Mode
    reason: str
    """Text for the operator."""
    command: Twist2
    """For ``/cmd_vel``, after the collision monitor."""
    blocked: bool
    transitions: int
    changed: bool
    """This step changed the mode."""
    vbot_start: NDArray[np.float64]
    vbot_pose: NDArray[np.float64]
    pose_gap_m: float
    yaw_gap_rad: float
    time_to_obstacle_s: float
    trajectory: NDArray[np.float64]
    """(N, 3) predicted poses of the driven robot."""
    subgoal: Subgoal | None
    estop: bool
    operator_command: Twist2
    """The command as used: zero when stale."""
    vbot_action: VbotAction
    vbot_target: NDArray[np.float64]
    """(3,) pose that the v-bot moves to: the r-bot as it will be shown; for LED_BACK the r-bot itself."""
    vbot_limit_m_s: float
    """Speed limit of the v-bot that follows from the rate of the views, in m/s."""
    hard: bool = False
    """The command is zero because a source is lost or an obstacle is near: the base must brake hard."""


@dataclass
class _Situation:
    """Inputs of one step and the values derived from them."""

    inputs: ArbiterInputs
    now_ns: int
    command: Twist2
    """The operator's command; zero when stale."""
    prediction: Prediction | None
    target: NDArray[np.float64]
    """(3,) pose of the r-bot as it is, or will be, shown."""
    vbot_pose: NDArray[np.float64]
    gap_m: float
    yaw_gap_rad: float
    fresh: bool = True
    """The operator's command is not stale, and its client is still there."""


class _Driven(NamedTuple):
    command: Twist2
    at_ns: int


class Arbiter:
    """Runs the transition table; pure: time comes in as ``now_ns``, everything else as ``ArbiterInputs``."""

    def __init__(self, config: ArbiterConfig | None = None) -> None:
        self.reconfigure(config or ArbiterConfig())
        self.mode = Mode.STOPPED
        self.transitions = 0
        self._since_ns: int | None = None  # start of the present mode
        self._returned_ns: int | None = None  # last return or abandoned entry
        self._fresh_since_ns: int | None = None
        self._agree_since_ns: int | None = None
        self._driven: _Driven | None = None  # last command that was not zero
        self._leading_back = False
        self._hard = False  # the last command was a hard stop
        self._monitor_stops = False  # the collision monitor stopped the robot in this step
        self._yaw_gap_before = 0.0  # in the previous step
        self._slow_since_ns: int | None = None  # the v-bot drives slower than commanded since then
        self._stop_reason = "waiting for the sensors"
        self._await_operator = False  # STOPPED because the operator's link was lost
        self._ready: tuple[int, Vspace] | None = None  # when the v-space was last ready, and its status then
        self._vbot_start: NDArray[np.float64] = np.zeros(3)
        self._subgoal: Subgoal | None = None
        self._passage_found: tuple[int, Passage] | None = None
        self._no_view_fits = False  # the last entry was abandoned
        self._guards: dict[str, Callable[[_Situation], str]] = {
            "estop_pressed": self._estop_pressed,
            "source_lost": self._source_lost,
            "vspace_lost": self._vspace_lost,
            "obstacle_and_ready": self._obstacle_and_ready,
            "entry_moot": self._entry_moot,
            "view_fits": self._view_fits,
            "rejoined": self._rejoined,
            "unsafe_again": self._unsafe_again,
            "picture_fits": self._picture_fits,
            "may_resume": self._may_resume,
        }
        self._actions: dict[str, Callable[[_Situation, str], None]] = {
            "stop": self._stop,
            "call_vbot": self._keep,
            "place_vbot": self._place_vbot,
            "ease_vbot": self._keep,
            "drive_vbot_on": self._place_vbot,
            "hand_back": self._hand_back,
        }

    def reconfigure(self, config: ArbiterConfig) -> None:
        """Apply other parameters from the next step on; mode and history stay."""
        self.config = config
        self.predictor = Predictor(config.prediction, config.limits, config.footprint)
        self.monitor = CollisionMonitor(config.collision_monitor, config.footprint)
        self._planner = HybridPlanner(config.planner, config.footprint)

    def step(self, inputs: ArbiterInputs, now_ns: int) -> Decision:
        """Take at most one transition, then return the command of the resulting state."""
        if self._since_ns is None:
            self._since_ns = now_ns
        situation = self._assess(inputs, now_ns)
        changed = self._transit(situation)
        if changed:
            # The driven robot has changed, and with it prediction and gap.
            situation = self._assess(inputs, now_ns)
        self._yaw_gap_before = situation.yaw_gap_rad
        self._monitor_stops = False
        command, blocked, reason = self._command(situation)
        # Letting go of the key during hard braking does not make it softer.
        self._hard = command == (0.0, 0.0) and (self._hard or self._stops_hard(situation))
        prediction = situation.prediction
        return Decision(
            mode=self.mode,
            reason=reason,
            command=command,
            blocked=blocked,
            transitions=self.transitions,
            changed=changed,
            vbot_start=self._vbot_start.copy(),
            vbot_pose=situation.vbot_pose.copy(),
            pose_gap_m=situation.gap_m,
            yaw_gap_rad=situation.yaw_gap_rad,
            time_to_obstacle_s=math.inf if prediction is None else prediction.time_to_obstacle_s,
            trajectory=np.zeros((0, 3)) if prediction is None else prediction.poses,
            subgoal=self._subgoal,
            estop=inputs.estop or inputs.estop_button,
            operator_command=situation.command,
            vbot_action=self._vbot_action(situation),
            vbot_target=(
                inputs.robot_pose if self._leading_back and inputs.robot_pose is not None else situation.target
            ).copy(),
            hard=self._hard,
            vbot_limit_m_s=self._vbot_limit_m_s(inputs),
        )

    # -- assessing the inputs

    def _assess(self, inputs: ArbiterInputs, now_ns: int) -> _Situation:
        fresh = inputs.age("command") <= self._command_s and not inputs.operator_gone
        command = clip_twist(*inputs.operator_command, self.config.limits) if fresh else (0.0, 0.0)
        if command != (0.0, 0.0):
            self._driven = _Driven(command, now_ns)
        if inputs.vspace.ready:
            self._ready = (now_ns, inputs.vspace)
        if self._lacking(inputs, Mode.REAL, now_ns):
            self._fresh_since_ns = None
        elif self._fresh_since_ns is None:
            self._fresh_since_ns = now_ns
        robot = inputs.robot_pose
        target = inputs.shown_pose if inputs.shown_pose is not None else robot if robot is not None else np.zeros(3)
        vbot = self._vbot_pose(inputs, target, now_ns)
        # Compared with the r-bot as shown, not as it is: the two images that the operator sees must agree.
        gap = float(np.linalg.norm(vbot[:2] - target[:2]))
        yaw_gap = wrap_angle(float(vbot[2] - target[2]))
        prediction = None
        if self.mode == Mode.VIRTUAL:
            prediction = self.predictor.predict(vbot, inputs.vbot_velocity, command, inputs.costmap)
        elif robot is not None:
            prediction = self.predictor.predict(robot, inputs.robot_velocity, command, inputs.costmap)
        situation = _Situation(inputs, now_ns, command, prediction, np.asarray(target), vbot, gap, yaw_gap, fresh)
        self._watch_agreement(situation)
        if self._no_view_fits and self.mode == Mode.REAL:
            # Do not retry under a held key: wait until a view fits or the operator lets go.
            switch = self.config.switch
            fits = self._pictures_agree(situation, switch.picture_position_m, switch.picture_yaw_deg)
            self._no_view_fits = not fits and command != (0.0, 0.0)
        self._leading_back = self._leads_back(situation)
        wanted_m_s = min(abs(command[0]), self._vbot_limit_m_s(inputs))
        slow = self.mode == Mode.VIRTUAL and abs(inputs.vbot_velocity[0]) < 0.8 * wanted_m_s
        self._slow_since_ns = (self._slow_since_ns or now_ns) if slow else None
        self._subgoal = None
        if self.mode == Mode.VIRTUAL and prediction is not None and inputs.costmap is not None:
            forward = (command[0] or inputs.vbot_velocity[0]) >= 0.0
            self._subgoal = choose_subgoal(inputs.costmap, vbot, prediction, forward, inputs.walls, self.config.subgoal)
        return situation

    def _vbot_pose(self, inputs: ArbiterInputs, target: NDArray[np.float64], now_ns: int) -> NDArray[np.float64]:
        if self.mode in (Mode.REAL, Mode.STOPPED):
            return np.asarray(target)
        # Poses sent before the entry do not yet start from the right place.
        if inputs.vbot_pose is None or (self.mode == Mode.ENTERING and not self._vbot_spoke(inputs, now_ns)):
            return np.asarray(target if self.mode == Mode.ENTERING else self._vbot_start)
        return np.asarray(inputs.vbot_pose)

    def _vbot_spoke(self, inputs: ArbiterInputs, now_ns: int) -> bool:
        return inputs.age("vbot") < self._seconds_in_mode(now_ns)

    def _leads_back(self, situation: _Situation) -> bool:
        """Whether the v-bot returns to the r-bot by itself: nobody drives it, and the r-bot cannot reach it."""
        after, idle_s = self.config.switch.lead_back_after_s, self._idle_s(situation)
        if self.mode != Mode.VIRTUAL or situation.inputs.robot_pose is None or after == 0.0 or idle_s < after:
            return False
        if self._leading_back or idle_s >= 3.0 * after:
            return True
        linear, angular = situation.inputs.robot_velocity
        return self._agree_since_ns is None and abs(linear) < _STANDS_M_S and abs(angular) < _STANDS_RAD_S

    def _idle_s(self, situation: _Situation) -> float:
        """Seconds since the operator's last command that was not zero."""
        return (situation.now_ns - (self._since_ns or 0 if self._driven is None else self._driven.at_ns)) / 1e9

    def _watch_agreement(self, situation: _Situation) -> None:
        switch = self.config.switch
        agree = (
            self.mode == Mode.VIRTUAL
            and situation.inputs.robot_pose is not None
            and situation.gap_m <= switch.position_m
            and abs(situation.yaw_gap_rad) <= math.radians(switch.yaw_deg)
        )
        if not agree:
            self._agree_since_ns = None
        elif self._agree_since_ns is None:
            self._agree_since_ns = situation.now_ns

    def _lacking(self, inputs: ArbiterInputs, mode: Mode, now_ns: int) -> list[tuple[Source, float]]:
        """Stale sources that ``mode`` needs, with their ages."""
        lacking = []
        for source in self._required(mode):
            if source.optional and source.key not in inputs.ages:
                continue
            age = self._source_age_s(source, inputs, now_ns)
            if age > self._allowed_s(source, inputs) or (source.key == "command" and inputs.operator_gone):
                lacking.append((source, age))
        return lacking

    def _required(self, mode: Mode | None = None) -> list[Source]:
        """Sources that a mode (default: the present one) needs under this configuration."""
        mode, switch = self.mode if mode is None else mode, self.config.switch
        unused = {key for key, used in (("camera", switch.require_camera), ("view", switch.require_view)) if not used}
        return [source for source in SOURCES if mode in source.modes and source.key not in unused]

    def _source_age_s(self, source: Source, inputs: ArbiterInputs, now_ns: int) -> float:
        age = inputs.age(source.key)
        # A source that REAL does not need may be silent before the change: its age counts from the change.
        return min(age, self._seconds_in_mode(now_ns)) if Mode.REAL not in source.modes else age

    def stale_in_s(self, inputs: ArbiterInputs, now_ns: int) -> float:
        """Seconds from this step until the first fresh source becomes stale; inf for none.

        A step at that moment sends the zero command on time, not up to a period later.
        """
        left = [math.inf]
        for source in SOURCES:
            if self.mode in source.modes:
                left.append(self._allowed_s(source, inputs) - self._source_age_s(source, inputs, now_ns))
        left.append(self._command_s - inputs.age("command"))
        # 0: not stale yet, but right after this step.
        return min(one for one in left if one >= 0.0)

    def _allowed_s(self, source: Source, inputs: ArbiterInputs) -> float:
        usual_s = inputs.usual.get(source.key) if source.steady else None
        return self.config.timeouts.allowed_s(source.key, usual_s) - STEP_AFTER_S

    @property
    def _command_s(self) -> float:
        """Age in seconds up to which the operator's command counts."""
        return self.config.timeouts.command - STEP_AFTER_S

    def _lost_s(self, source: Source, inputs: ArbiterInputs) -> float:
        return self.config.timeouts.lost_s(source.key, inputs.usual.get(source.key) if source.steady else None)

    def _speed_limit_m_s(self, inputs: ArbiterInputs) -> float:
        """Speed at which the robot drives at most ``image_travel_m`` until a missing image stops it.

        Rare images therefore slow the robot, instead of stopping it at each late one.
        """
        longest_s = max(
            (self._allowed_s(source, inputs) for source in self._required() if source.key in IMAGES), default=0.0
        )
        most = self.config.limits.max_linear_m_s
        return min(most, self.config.timeouts.image_travel_m / longest_s) if longest_s > 0 else most

    def _vbot_limit_m_s(self, inputs: ArbiterInputs) -> float:
        """Speed limit of the v-bot; below full speed it is slow enough for the r-bot to catch up."""
        limit = self._speed_limit_m_s(inputs)
        return limit if limit >= self.config.limits.max_linear_m_s else _CATCH_UP * limit

    def _too_rare(self, inputs: ArbiterInputs) -> bool:
        """Whether camera images are too rare to drive by, or their rate is not known yet."""
        usual_s = inputs.usual.get("camera", 0.0) if self.config.switch.require_camera else 0.0
        return usual_s > self.config.timeouts.slowest_image_s

    def _seconds_in_mode(self, now_ns: int) -> float:
        return (now_ns - (self._since_ns or now_ns)) / 1e9

    # -- transitions

    def _transit(self, situation: _Situation) -> bool:
        for row in TRANSITIONS:
            if row.source != self.mode:
                continue
            reason = self._guards[row.guard](situation)
            if reason:
                self._actions[row.action](situation, reason)
                if row.source in (Mode.ENTERING, Mode.RETURNING) and row.target == Mode.REAL:
                    self._returned_ns = situation.now_ns
                self.mode = row.target
                self.transitions += 1
                self._since_ns = situation.now_ns
                self._agree_since_ns = None
                return True
        return False

    # A guard returns its reason when it holds, else "".

    def _estop_pressed(self, situation: _Situation) -> str:
        return "emergency stop" if situation.inputs.estop or situation.inputs.estop_button else ""

    def _source_lost(self, situation: _Situation) -> str:
        lacking = self._lacking(situation.inputs, self.mode, situation.now_ns)
        lost = [(source, age) for source, age in lacking if age > self._lost_s(source, situation.inputs)]
        return _no_data(lost) if lost else ""

    def _vspace_lost(self, situation: _Situation) -> str:
        if situation.inputs.vspace.failed:
            return f"the virtual space failed: {situation.inputs.vspace.message}"
        age = min(situation.inputs.age("vspace"), self._seconds_in_mode(situation.now_ns))
        return "the virtual space is silent" if age > self.config.timeouts.vspace else ""

    def _obstacle_and_ready(self, situation: _Situation) -> str:
        prediction = situation.prediction
        if prediction is None or prediction.hit_index is None or self._hold_reason(situation):
            return ""
        if self._why_not_virtual(situation):
            return ""
        return f"obstacle in {prediction.time_to_obstacle_s:.1f} s: switching to the virtual space"

    def _why_not_virtual(self, situation: _Situation) -> str:
        """Reason against a switch although an obstacle is ahead; "" when there is none."""
        inputs, switch = situation.inputs, self.config.switch
        assert inputs.robot_pose is not None and situation.prediction is not None
        if abs(situation.command[0]) < switch.min_switch_speed_m_s:
            return "there is no room to turn"
        if inputs.age("vspace") > self.config.timeouts.vspace:
            return "no virtual space is running"
        vspace = self._shown_vspace(situation)
        if not vspace.ready:
            return "the virtual space is not ready" + (f" ({vspace.message})" if vspace.message else "")
        away = float(np.linalg.norm(vspace.position - inputs.robot_pose[:2]))
        if away > vspace.ready_radius_m:
            return (
                f"the virtual space is valid within {vspace.ready_radius_m:.1f} m of its keyframe, "
                f"which is {away:.1f} m away"
            )
        if 0.0 < vspace.expected_psnr_db < switch.min_expected_psnr_db:  # NaN means unknown
            return (
                f"the virtual space shows this place too poorly ({vspace.expected_psnr_db:.0f} dB expected, "
                f"{switch.min_expected_psnr_db:.0f} dB needed)"
            )
        if self._no_view_fits:
            return "no view of the virtual space fits here; let go, then drive on to try again"
        back = self._returned_ns
        if back is not None and situation.now_ns - back < switch.min_real_s * 1e9:
            return "just back from the virtual space"
        if inputs.costmap is None:
            return "there is no costmap yet"
        return self._passage(situation, inputs.costmap).reason

    def _shown_vspace(self, situation: _Situation) -> Vspace:
        """Status of the virtual space, or of its last ready keyframe for a short time while it learns the next one."""
        now = situation.inputs.vspace
        if now.ready or not now.training or self._ready is None:
            return now
        since_ns, before = self._ready
        return before if situation.now_ns - since_ns <= self.config.switch.ready_hold_s * 1e9 else now

    def _passage(self, situation: _Situation, costmap: Costmap) -> Passage:
        """Way round the obstacle ahead; planning takes milliseconds, so the answer is kept for a costmap's period."""
        assert situation.prediction is not None
        if self._passage_found is None or situation.now_ns - self._passage_found[0] >= PASSAGE_PERIOD_NS:
            passage = find_passage(
                costmap,
                situation.prediction,
                situation.command[0] > 0,
                situation.inputs.walls,
                self._planner,
                self.config.passage,
            )
            self._passage_found = (situation.now_ns, passage)
        return self._passage_found[1]

    def _entry_moot(self, situation: _Situation) -> str:
        inputs = situation.inputs
        if inputs.age("vspace") > self.config.timeouts.vspace or not self._shown_vspace(situation).ready:
            return "the virtual space is no longer ready"
        if self._seconds_in_mode(situation.now_ns) > self._entry_patience_s(inputs):
            self._no_view_fits = True
            return "no fitting view of the virtual space has arrived"
        return "you drive the robot" if self._safe_ahead(situation) else ""

    def _entry_patience_s(self, inputs: ArbiterInputs) -> float:
        """Seconds in ENTERING after which an image and a view of the standing r-bot must have arrived."""
        slow = (self.config.timeouts.allowed_s(key, inputs.usual.get(key)) for key in IMAGES)
        return self.config.switch.enter_timeout_s + sum(slow) + inputs.images_late_s

    def _view_fits(self, situation: _Situation) -> str:
        if self._hold_reason(situation) or not self._vbot_spoke(situation.inputs, situation.now_ns):
            return ""
        switch = self.config.switch
        agree = self._pictures_agree(situation, switch.picture_position_m, switch.picture_yaw_deg)
        return "you drive the virtual robot" if agree else ""

    def _pictures_agree(self, situation: _Situation, within_m: float, within_deg: float) -> bool:
        """Whether view and camera image show the same place, so that a switch between them does not jump.

        They arrive at different times. The distance driven between the two arrivals is motion, not an error; but the
        operator sees even that as a jump when it is large.
        """
        inputs, switch = situation.inputs, self.config.switch
        if inputs.robot_pose is None:
            return False
        if abs(situation.yaw_gap_rad) > math.radians(within_deg):
            return False
        if not (switch.require_view and switch.require_camera):
            return True
        if inputs.age("view") > self.config.timeouts.allowed_s("view", inputs.usual.get("view")):
            return False
        if inputs.view_position is None or inputs.picture_position is None:
            return False
        apart = inputs.view_position[:2] - inputs.picture_position[:2]
        yaw = float(inputs.robot_pose[2])
        driven = inputs.robot_velocity[0] * inputs.view_after_picture_s * np.array([math.cos(yaw), math.sin(yaw)])
        return bool(np.linalg.norm(apart - driven) <= within_m and np.linalg.norm(apart) <= 2.0 * within_m)

    def _rejoined(self, situation: _Situation) -> str:
        now_ns, switch, inputs = situation.now_ns, self.config.switch, situation.inputs
        since = self._agree_since_ns
        if since is None or now_ns - since < switch.return_dwell_s * 1e9:
            return ""
        if self._seconds_in_mode(now_ns) < switch.min_virtual_s:
            return ""
        if situation.gap_m > switch.return_near_m and now_ns - since < switch.return_patience_s * 1e9:
            return ""
        if self._lacking(inputs, Mode.REAL, now_ns) or self._hold_reason(situation):
            return ""
        return "you drive the robot" if self._safe_ahead(situation) else ""

    def _safe_ahead(self, situation: _Situation) -> bool:
        """Whether the operator may drive the r-bot with the present command.

        The way that triggers an entry must be free, and also a longer and wider one. Thus the conditions for entry and
        return never hold together.
        """
        inputs, switch = situation.inputs, self.config.switch
        if inputs.robot_pose is None or inputs.costmap is None:
            return False
        command = situation.command
        if command == (0.0, 0.0) and self._driven is not None and self._idle_s(situation) < switch.neutral_return_s:
            # Hands off before the obstacle: the next command is most likely the last one again. The real view returns
            # only after a while.
            command = self._driven.command
        return all(
            self.predictor.predict(
                inputs.robot_pose, inputs.robot_velocity, command, inputs.costmap, extra_m=extra_m, side_m=side_m
            ).hit_index
            is None
            for extra_m, side_m in ((0.0, 0.0), (switch.return_margin_m, switch.return_side_m))
        )

    def _unsafe_again(self, situation: _Situation) -> str:
        prediction = situation.prediction
        if situation.command == (0.0, 0.0) or prediction is None or prediction.hit_index is None:
            return ""
        return f"obstacle in {prediction.time_to_obstacle_s:.1f} s: you drive the virtual robot"

    def _picture_fits(self, situation: _Situation) -> str:
        if self._hold_reason(situation):
            return ""
        switch, words = self.config.switch, "you drive the robot"
        waited = self._seconds_in_mode(situation.now_ns) / switch.return_timeout_s
        if waited >= 2.0:
            return words  # the pose jitters by more than the thresholds; the page eases the rest
        within_m, within_deg = switch.return_picture_m, switch.return_picture_yaw_deg
        # In two consecutive steps: SLAM's heading jitters, and the pose shown before counts too.
        yaw_gap = max(abs(situation.yaw_gap_rad), abs(self._yaw_gap_before))
        if situation.gap_m > within_m or yaw_gap > math.radians(within_deg):
            return ""
        if waited >= 1.0:
            return words
        turns = abs(situation.inputs.robot_velocity[1]) > switch.return_turn_rad_s
        return words if not turns and self._pictures_agree(situation, within_m, within_deg) else ""

    def _may_resume(self, situation: _Situation) -> str:
        inputs = situation.inputs
        if inputs.estop or inputs.estop_button or situation.command != (0.0, 0.0) or inputs.robot_pose is None:
            return ""
        if self._operator_missed(situation) or self._too_rare(inputs):
            return ""
        since = self._fresh_since_ns
        if since is None or situation.now_ns - since < self.config.timeouts.recover_s * 1e9:
            return ""
        return "you drive the robot"

    def _operator_missed(self, situation: _Situation) -> bool:
        """Whether the machine stopped because the operator's link was lost, and it still is."""
        inputs = situation.inputs
        return self._await_operator and (inputs.operator_gone or inputs.age("command") > self._command_s)

    # Actions

    def _stop(self, situation: _Situation, reason: str) -> None:
        self._stop_reason = reason
        self._await_operator = OPERATOR_LOST in reason

    def _place_vbot(self, situation: _Situation, reason: str) -> None:
        self._vbot_start = situation.vbot_pose.copy()

    def _keep(self, situation: _Situation, reason: str) -> None:
        """Do nothing: the new state does everything."""

    def _hand_back(self, situation: _Situation, reason: str) -> None:
        self._driven = _Driven(situation.command, situation.now_ns)

    # -- the command of each state

    def _command(self, situation: _Situation) -> tuple[Twist2, bool, str]:
        """Command after the collision monitor, whether it is blocked, and the reason."""
        if self.mode == Mode.STOPPED:
            return (0.0, 0.0), False, self._why_stopped(situation)
        hold = self._hold_reason(situation)
        if hold:
            return (0.0, 0.0), False, hold
        if self.mode == Mode.VIRTUAL:
            return self._virtual_command(situation)
        return self._real_command(situation)

    def _stops_hard(self, situation: _Situation) -> bool:
        """Whether a zero command has another cause than the operator."""
        if self.mode == Mode.STOPPED or self._hold_reason(situation) or not situation.fresh:
            return True
        return self._monitor_stops

    def _virtual_command(self, situation: _Situation) -> tuple[Twist2, bool, str]:
        inputs = situation.inputs
        reason = "you drive the virtual robot" + self._far_from_keyframe(situation)
        if self._leading_back:
            return (0.0, 0.0), False, "no command: the view goes back to the robot; drive to continue"
        if self._subgoal is None:
            return (0.0, 0.0), False, reason + "; no free place for the robot near it"
        wanted = clip_twist(*inputs.nav_command, self.config.limits)
        if inputs.age("nav") > self.config.timeouts.nav:
            wanted = (0.0, 0.0)  # at first: the follower has not sent a command yet
        sent = self._monitored(self._paced(wanted, situation), situation)
        left_s = self.config.switch.lead_back_after_s - self._idle_s(situation)
        if self._agree_since_ns is None and 0.0 < left_s < self.config.switch.lead_back_after_s - 1.0:
            reason = f"the robot cannot reach your place: the view goes back to the robot in {left_s:.0f} s"
        elif sent.action != "free":
            reason += "; the robot slows down near an obstacle"
        elif self._slow_since_ns is not None and situation.now_ns - self._slow_since_ns > _SLOW_NS:
            reason += "; slowed: a wall is ahead, or the robot must catch up"
        return sent.command, False, reason

    def _vbot_action(self, situation: _Situation) -> VbotAction:
        if self.mode == Mode.RETURNING:
            return VbotAction.EASED
        if self.mode != Mode.VIRTUAL:
            return VbotAction.WITH_ROBOT
        lacking = self._lacking(situation.inputs, self.mode, situation.now_ns)
        if any(source.key in ("view", "command") for source, _ in lacking):
            return VbotAction.HELD  # nobody sees it, or nobody drives it
        return VbotAction.LED_BACK if self._leading_back else VbotAction.DRIVEN

    def _far_from_keyframe(self, situation: _Situation) -> str:
        """Text for a v-bot outside the region that the virtual space shows well; "" inside."""
        expected_db = situation.inputs.vspace.expected_psnr_db
        if 0.0 < expected_db < self.config.switch.min_expected_psnr_db:
            return f"; most of the view is guessed here ({expected_db:.0f} dB expected)"
        if self._ready is None:
            return ""
        vspace = self._ready[1]
        away = float(np.linalg.norm(situation.vbot_pose[:2] - vspace.position))
        return "" if away <= vspace.ready_radius_m else f"; the view gets worse {away:.1f} m from its keyframe"

    def _real_command(self, situation: _Situation) -> tuple[Twist2, bool, str]:
        command, prediction = situation.command, situation.prediction
        blocked, reason = False, "you drive the robot"
        if prediction is not None and prediction.hit_index is not None and command != (0.0, 0.0):
            command = self._slowed(command, prediction.distance_m)
            if self.mode == Mode.REAL:
                blocked = True
                why = self._why_not_virtual(situation) or "obstacle ahead"
                reason = f"blocked: obstacle in {prediction.distance_m:.1f} m; {why}"
        if self.mode == Mode.ENTERING:
            reason = "obstacle ahead: switching to the virtual space"
            waited = self._seconds_in_mode(situation.now_ns) / self.config.switch.enter_timeout_s
            left = max(0.0, 1.0 - waited**2)  # hardly noticed if the view comes in time
            command = (command[0] * left, command[1] * left)
        elif self.mode == Mode.RETURNING:
            reason = "you drive the robot; switching back to the camera"
        paced = self._paced(command, situation)
        if paced != command and not blocked:
            reason += "; slowed: the image rate is low"
        sent = self._monitored(paced, situation)
        if sent.action in ("approach", "stop") and not blocked:
            blocked = True
            reason = f"blocked: contact in {sent.time_to_collision_s:.1f} s"
        elif sent.action != "free" and not blocked:
            reason += "; slowed down near an obstacle"
        return sent.command, blocked, reason

    def _monitored(self, command: Twist2, situation: _Situation) -> MonitoredCommand:
        """The command after the collision monitor, which gets all points seen and remembered near the robot."""
        inputs = situation.inputs
        points = inputs.scan_points
        if inputs.costmap is not None and inputs.robot_pose is not None:
            config = self.config.collision_monitor
            memory = inputs.costmap.memory_near(inputs.robot_pose, config.blind_radius_m, config.memory_range_m)
            points = np.concatenate([points, np.repeat(memory, self.monitor.most_points_needed, axis=0)])
        sent = self.monitor.limit(command, points, max(inputs.age("scan"), inputs.ages.get("points", 0.0)))
        self._monitor_stops = sent.action == "stop"
        return sent

    def _slowed(self, command: Twist2, distance_m: float) -> Twist2:
        """The command slowed so that the robot can stop ``stop_margin_m`` before the obstacle."""
        left = max(0.0, distance_m - self.config.switch.stop_margin_m)
        # Half of the base's deceleration; the other half covers the latency.
        allowed = math.sqrt(self.config.limits.max_linear_accel_m_s2 * left)
        speed = abs(command[0]) + self.predictor.reach_m * abs(command[1])
        factor = min(1.0, allowed / speed) if speed > 0 else 1.0
        return command[0] * factor, command[1] * factor

    def _paced(self, command: Twist2, situation: _Situation) -> Twist2:
        """The command slowed to what the image rate allows, with the same curvature."""
        factor = min(1.0, self._speed_limit_m_s(situation.inputs) / max(abs(command[0]), 1e-9))
        return command[0] * factor, command[1] * factor

    def _hold_reason(self, situation: _Situation) -> str:
        """Reason why nothing may move in this state; "" when it may."""
        lacking = self._lacking(situation.inputs, self.mode, situation.now_ns)
        if lacking:
            return "stopped: " + _no_data(lacking)
        if situation.inputs.robot_pose is None:
            return "the robot's pose in the map is not known"
        if situation.inputs.costmap is None:
            return "there is no costmap yet"
        return ""

    def _why_stopped(self, situation: _Situation) -> str:
        inputs = situation.inputs
        if inputs.estop_button:
            return "emergency stop button is pressed: release it, then release the stop here"
        if inputs.estop:
            return inputs.estop_why or "emergency stop: release it to continue"
        lacking = self._lacking(inputs, Mode.REAL, situation.now_ns)
        if lacking:
            return "stopped: " + _no_data(lacking)
        if inputs.robot_pose is None:
            return "stopped: the robot's pose in the map is not known"
        if self._too_rare(inputs):
            return f"stopped: waiting for a camera image every {self.config.timeouts.slowest_image_s:g} s or more often"
        if situation.command != (0.0, 0.0):
            return f"let go of the controls to continue (stopped: {self._stop_reason})"
        return f"stopped: {self._stop_reason}"


def _no_data(lacking: list[tuple[Source, float]]) -> str:
    return ", ".join(
        source.words or (f"no {source.name} yet" if math.isinf(age) else f"no {source.name} for {age:.1f} s")
        for source, age in lacking
    )
