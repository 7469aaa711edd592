"""Who is driven and what is sent: the state machine of illusory control (paper, III.A).

The machine is data: ``TRANSITIONS`` (states, guards, actions), ``GUARDS`` (what each guard means) and ``SOURCES``
(what must be fresh in which state). ``diagram.py`` prints them for the docs; ``Arbiter.step`` runs them.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, field
from enum import IntEnum
from typing import Annotated, TypeAlias

import numpy as np
from numpy.typing import NDArray

from ..geometry.poses import wrap_angle
from ..ranges import NotNegative, Positive, Range, check_ranges
from .costmap import Costmap
from .footprint import Footprint
from .kinematics import MotionLimits, clip_twist
from .passage import Passage, PassageConfig, find_passage
from .planner import HybridPlanner, PlannerConfig
from .prediction import Prediction, PredictionConfig, Predictor
from .safety import CollisionMonitor, CollisionMonitorConfig, MonitoredCommand
from .subgoal import Subgoal, SubgoalConfig, choose_subgoal
from .walls import WallMap

Twist2 = tuple[float, float]
"""Linear m/s, angular rad/s."""


PASSAGE_PERIOD_NS = 200_000_000


class Mode(IntEnum):
    """Values of ControlState.mode."""

    REAL = 0
    VIRTUAL = 1
    STOPPED = 2


@dataclass(frozen=True)
class Transition:
    """One arrow: from ``source`` to ``target`` when ``guard`` holds, doing ``action``."""

    source: Mode
    target: Mode
    guard: str
    action: str


TRANSITIONS: tuple[Transition, ...] = (
    Transition(Mode.REAL, Mode.STOPPED, "estop_pressed", "stop"),
    Transition(Mode.REAL, Mode.STOPPED, "source_lost", "stop"),
    Transition(Mode.REAL, Mode.VIRTUAL, "obstacle_and_ready", "place_vbot"),
    Transition(Mode.VIRTUAL, Mode.STOPPED, "estop_pressed", "stop"),
    Transition(Mode.VIRTUAL, Mode.STOPPED, "source_lost", "stop"),
    Transition(Mode.VIRTUAL, Mode.STOPPED, "vspace_lost", "stop"),
    Transition(Mode.VIRTUAL, Mode.REAL, "rejoined", "hand_back"),
    Transition(Mode.STOPPED, Mode.REAL, "may_resume", "hand_back"),
)
"""In order: the first row of the present state whose guard holds is taken, at most one a step."""

GUARDS: dict[str, str] = {
    "estop_pressed": "the emergency stop is pressed",
    "source_lost": "a source that this state needs has been silent for stop_after_s",
    "vspace_lost": "the virtual space has failed, or its node is silent",
    "obstacle_and_ready": "the predicted path meets an obstacle, the virtual space is ready here, and there is a way "
    "round for the r-bot",
    "rejoined": "r-bot and v-bot agree in position and yaw for return_dwell_s, and the operator's command is safe for "
    "the r-bot over a longer and wider way than the one that switches in",
    "may_resume": "the emergency stop is released, every source is fresh for recover_s, the operator's command is zero "
    "(silence counts as zero), and the operator's link is back where its loss was the reason",
}

ACTIONS: dict[str, str] = {
    "stop": "command zero; the r-bot is shown",
    "place_vbot": "the v-bot starts at the r-bot's pose; it is driven and shown",
    "hand_back": "the r-bot is driven and shown",
}


@dataclass(frozen=True)
class Source:
    """An input that must be fresh: beyond its time-out the command is zero; beyond ``stop_after_s``, STOPPED."""

    key: str
    name: str
    modes: tuple[Mode, ...]
    words: str = ""
    """What the operator is told of its loss; empty: "no NAME for SECONDS"."""
    optional: bool = False
    """Needed only once it has come: a robot without 3D points drives by its flat scan."""


OPERATOR_LOST = "the operator's link is lost, the robot waits"

SOURCES: tuple[Source, ...] = (
    Source("scan", "LiDAR scan", (Mode.REAL, Mode.VIRTUAL)),
    Source("points", "3D points", (Mode.REAL, Mode.VIRTUAL), optional=True),
    Source("odometry", "wheel odometry", (Mode.REAL, Mode.VIRTUAL)),
    Source("pose", "SLAM pose", (Mode.REAL, Mode.VIRTUAL)),
    Source("camera", "camera picture", (Mode.REAL,)),
    Source("vbot", "v-bot", (Mode.VIRTUAL,)),
    Source("nav", "path follower", (Mode.VIRTUAL,)),
    # In REAL its silence is a zero command and no more; in VIRTUAL the r-bot would go on to the v-bot by itself.
    Source("command", "operator's link", (Mode.VIRTUAL,), OPERATOR_LOST),
)


_Timeout: TypeAlias = Annotated[float, Range(above=0, high=10)]
"""Longer than this is no time-out: a robot must not drive on what it saw or was told so long ago."""


@dataclass(frozen=True)
class TimeoutConfig:
    """Age in seconds beyond which a source is stale and the command is zero."""

    scan: _Timeout = 0.3
    points: _Timeout = 0.5
    odometry: _Timeout = 0.3
    pose: _Timeout = 1.0
    camera: _Timeout = 1.0
    vbot: _Timeout = 0.3
    nav: _Timeout = 0.3
    command: _Timeout = 0.3
    vspace: _Timeout = 2.0
    stop_after_s: _Timeout = 1.5
    recover_s: _Timeout = 0.5

    def __post_init__(self) -> None:
        check_ranges(self)


@dataclass(frozen=True)
class SwitchConfig:
    """Thresholds of the change between real and virtual."""

    position_m: Positive = 0.15
    yaw_deg: Positive = 10.0
    return_dwell_s: NotNegative = 0.5
    min_virtual_s: NotNegative = 1.0
    min_real_s: NotNegative = 1.0
    return_margin_m: Positive = 0.5
    return_side_m: Positive = 0.12
    neutral_return_s: NotNegative = 5.0
    stop_margin_m: NotNegative = 0.15
    min_switch_speed_m_s: NotNegative = 0.03
    ready_hold_s: NotNegative = 2.0
    require_camera: bool = True

    def __post_init__(self) -> None:
        check_ranges(self)


@dataclass(frozen=True)
class ArbiterConfig:
    """Everything that the arbiter's library part is set up by."""

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
    """What the virtual space says of itself (VspaceStatus)."""

    ready: bool = False
    training: bool = False
    failed: bool = False
    position: NDArray[np.float64] = field(default_factory=lambda: np.zeros(2))
    """(2,) of the newest keyframe in the map frame."""
    ready_radius_m: float = 0.0
    message: str = ""


@dataclass(frozen=True)
class ArbiterInputs:
    """The world as the arbiter sees it in one step; an age is inf while nothing has come yet."""

    robot_pose: NDArray[np.float64] | None = None
    """(3,) map_from_base of the r-bot; None while unknown."""
    robot_velocity: Twist2 = (0.0, 0.0)
    operator_command: Twist2 = (0.0, 0.0)
    estop: bool = False
    scan_points: NDArray[np.float64] = field(default_factory=lambda: np.zeros((0, 2)))
    """(N, 2) hits of the newest scan and 3D points in ``base_link``, where the robot is now."""
    costmap: Costmap | None = None
    walls: WallMap | None = None
    vspace: Vspace = field(default_factory=Vspace)
    vbot_pose: NDArray[np.float64] | None = None
    """(3,) of the v-bot in the map frame."""
    vbot_velocity: Twist2 = (0.0, 0.0)
    nav_command: Twist2 = (0.0, 0.0)
    ages: dict[str, float] = field(default_factory=dict)
    """Seconds since the last of: scan, odometry, pose, camera, vbot, nav, command, vspace; points once they came."""

    def age(self, key: str) -> float:
        """Age of a source; inf when it has never been seen."""
        return self.ages.get(key, math.inf)


@dataclass(frozen=True)
class Decision:
    """What the arbiter wants sent and shown."""

    mode: Mode
    reason: str
    """Plain words for the operator."""
    command: Twist2
    """For ``/cmd_vel``, past the collision monitor."""
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
    """(N, 3) predicted for the robot that is driven."""
    subgoal: Subgoal | None
    estop: bool
    operator_command: Twist2
    """As it counts: zero when it is old."""


@dataclass
class _Situation:
    """One step's inputs and what was worked out from them."""

    inputs: ArbiterInputs
    now_ns: int
    command: Twist2
    """The operator's, zero when stale."""
    prediction: Prediction | None
    vbot_pose: NDArray[np.float64]
    gap_m: float
    yaw_gap_rad: float


class Arbiter:
    """Runs the table; pure: time comes in as ``now_ns``, everything else as ``ArbiterInputs``."""

    def __init__(self, config: ArbiterConfig | None = None) -> None:
        self.reconfigure(config or ArbiterConfig())
        self.mode = Mode.STOPPED
        self.transitions = 0
        self._since_ns: int | None = None  # of the present mode
        self._returned_ns: int | None = None  # of the last change from VIRTUAL to REAL
        self._fresh_since_ns: int | None = None
        self._agree_since_ns: int | None = None
        self._driven: Twist2 = (0.0, 0.0)  # the last command that was not zero
        self._driven_ns: int | None = None
        self._stop_reason = "waiting for the sensors"
        self._await_operator = False  # STOPPED because the operator's link was lost
        self._ready: tuple[int, Vspace] | None = None  # when the v-space was ready last, and what it said then
        self._vbot_start: NDArray[np.float64] = np.zeros(3)
        self._subgoal: Subgoal | None = None
        self._passage_found: tuple[int, Passage] | None = None
        self._guards: dict[str, Callable[[_Situation], str]] = {
            "estop_pressed": self._estop_pressed,
            "source_lost": self._source_lost,
            "vspace_lost": self._vspace_lost,
            "obstacle_and_ready": self._obstacle_and_ready,
            "rejoined": self._rejoined,
            "may_resume": self._may_resume,
        }
        self._actions: dict[str, Callable[[_Situation, str], None]] = {
            "stop": self._stop,
            "place_vbot": self._place_vbot,
            "hand_back": self._hand_back,
        }

    def reconfigure(self, config: ArbiterConfig) -> None:
        """Takes other parameters from the next step on; mode and history stay as they are."""
        self.config = config
        self.predictor = Predictor(config.prediction, config.limits, config.footprint)
        self.monitor = CollisionMonitor(config.collision_monitor, config.footprint)
        self._planner = HybridPlanner(config.planner, config.footprint)

    def step(self, inputs: ArbiterInputs, now_ns: int) -> Decision:
        """One step: at most one transition, then the command of the state that it left the machine in."""
        if self._since_ns is None:
            self._since_ns = now_ns
        situation = self._assess(inputs, now_ns)
        changed = self._transit(situation)
        if changed:
            # The robot driven is another one now: its prediction, its gap.
            situation = self._assess(inputs, now_ns)
        command, blocked, reason = self._command(situation)
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
            estop=inputs.estop,
            operator_command=situation.command,
        )

    # -- what the step starts from

    def _assess(self, inputs: ArbiterInputs, now_ns: int) -> _Situation:
        fresh = inputs.age("command") <= self.config.timeouts.command
        command = clip_twist(*inputs.operator_command, self.config.limits) if fresh else (0.0, 0.0)
        if command != (0.0, 0.0):
            self._driven, self._driven_ns = command, now_ns
        if inputs.vspace.ready:
            self._ready = (now_ns, inputs.vspace)
        if self._lacking(inputs, Mode.REAL, now_ns):
            self._fresh_since_ns = None
        elif self._fresh_since_ns is None:
            self._fresh_since_ns = now_ns
        robot = inputs.robot_pose
        vbot = robot if robot is not None else np.zeros(3)
        gap, yaw_gap, prediction = 0.0, 0.0, None
        if self.mode == Mode.VIRTUAL:
            # What the v-bot said before the change was not yet from where it starts.
            spoken = inputs.vbot_pose is not None and inputs.age("vbot") < self._seconds_in_mode(now_ns)
            vbot = inputs.vbot_pose if spoken and inputs.vbot_pose is not None else self._vbot_start
            if robot is not None:
                gap = float(np.linalg.norm(vbot[:2] - robot[:2]))
                yaw_gap = wrap_angle(float(vbot[2] - robot[2]))
            prediction = self.predictor.predict(vbot, inputs.vbot_velocity, command, inputs.costmap)
        elif robot is not None:
            prediction = self.predictor.predict(robot, inputs.robot_velocity, command, inputs.costmap)
        situation = _Situation(inputs, now_ns, command, prediction, np.asarray(vbot), gap, yaw_gap)
        self._watch_agreement(situation)
        self._subgoal = None
        if self.mode == Mode.VIRTUAL and prediction is not None and inputs.costmap is not None:
            forward = (command[0] or inputs.vbot_velocity[0]) >= 0.0
            self._subgoal = choose_subgoal(
                inputs.costmap, np.asarray(vbot), prediction, forward, inputs.walls, self.config.subgoal
            )
        return situation

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

    def _timeout(self, key: str) -> float:
        return float(getattr(self.config.timeouts, key))

    def _lacking(self, inputs: ArbiterInputs, mode: Mode, now_ns: int) -> list[tuple[Source, float]]:
        """Sources that ``mode`` needs and that are stale, with their ages."""
        lacking = []
        for source in SOURCES:
            if mode not in source.modes or (source.key == "camera" and not self.config.switch.require_camera):
                continue
            if source.optional and source.key not in inputs.ages:
                continue
            age = inputs.age(source.key)
            if source.modes == (Mode.VIRTUAL,):
                # It speaks in this state only: its silence counts from the change.
                age = min(age, self._seconds_in_mode(now_ns))
            if age > self._timeout(source.key):
                lacking.append((source, age))
        return lacking

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
                if row.source == Mode.VIRTUAL and row.target == Mode.REAL:
                    self._returned_ns = situation.now_ns
                self.mode = row.target
                self.transitions += 1
                self._since_ns = situation.now_ns
                self._agree_since_ns = None
                return True
        return False

    # Guards give the reason when they hold, "" when they do not.

    def _estop_pressed(self, situation: _Situation) -> str:
        return "emergency stop" if situation.inputs.estop else ""

    def _source_lost(self, situation: _Situation) -> str:
        lacking = self._lacking(situation.inputs, self.mode, situation.now_ns)
        after = self.config.timeouts.stop_after_s
        lost = [(source, age) for source, age in lacking if age > max(after, self._timeout(source.key))]
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
        return f"obstacle in {prediction.time_to_obstacle_s:.1f} s: you drive the virtual robot"

    def _why_not_virtual(self, situation: _Situation) -> str:
        """What keeps the machine from switching although an obstacle is ahead; "" when nothing does."""
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
            return f"the virtual space is fit to show {vspace.ready_radius_m:.1f} m round a place {away:.1f} m off"
        back = self._returned_ns
        if back is not None and situation.now_ns - back < switch.min_real_s * 1e9:
            return "just back from the virtual space"
        if inputs.costmap is None:
            return "there is no costmap yet"
        return self._passage(situation, inputs.costmap).reason

    def _shown_vspace(self, situation: _Situation) -> Vspace:
        """The virtual space by its last keyframe that was ready, while it learns the next one for a moment."""
        now = situation.inputs.vspace
        if now.ready or not now.training or self._ready is None:
            return now
        since_ns, before = self._ready
        return before if situation.now_ns - since_ns <= self.config.switch.ready_hold_s * 1e9 else now

    def _passage(self, situation: _Situation, costmap: Costmap) -> Passage:
        """Way round the obstacle ahead; planning takes milliseconds, so an answer holds for a costmap's period."""
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

    def _rejoined(self, situation: _Situation) -> str:
        now_ns, switch, inputs = situation.now_ns, self.config.switch, situation.inputs
        since = self._agree_since_ns
        if since is None or now_ns - since < switch.return_dwell_s * 1e9:
            return ""
        if self._seconds_in_mode(now_ns) < switch.min_virtual_s:
            return ""
        if self._lacking(inputs, Mode.REAL, now_ns) or inputs.robot_pose is None or inputs.costmap is None:
            return ""
        command = situation.command
        if command == (0.0, 0.0):
            # Hands off before the obstacle: what would be driven next is most likely what was driven last. Only
            # after a while is the real view given back.
            idle_ns = now_ns - (self._driven_ns if self._driven_ns is not None else now_ns)
            if idle_ns < switch.neutral_return_s * 1e9:
                command = self._driven
        ahead = self.predictor.predict(
            inputs.robot_pose,
            inputs.robot_velocity,
            command,
            inputs.costmap,
            extra_m=switch.return_margin_m,
            side_m=switch.return_side_m,
        )
        return "you drive the robot" if ahead.hit_index is None else ""

    def _may_resume(self, situation: _Situation) -> str:
        inputs = situation.inputs
        if inputs.estop or situation.command != (0.0, 0.0) or inputs.robot_pose is None:
            return ""
        if self._operator_missed(situation):
            return ""
        since = self._fresh_since_ns
        if since is None or situation.now_ns - since < self.config.timeouts.recover_s * 1e9:
            return ""
        return "you drive the robot"

    def _operator_missed(self, situation: _Situation) -> bool:
        """Whether the machine stopped because of the operator's silence, which goes on."""
        return self._await_operator and situation.inputs.age("command") > self.config.timeouts.command

    # Actions

    def _stop(self, situation: _Situation, reason: str) -> None:
        self._stop_reason = reason
        self._await_operator = OPERATOR_LOST in reason

    def _place_vbot(self, situation: _Situation, reason: str) -> None:
        assert situation.inputs.robot_pose is not None
        self._vbot_start = np.asarray(situation.inputs.robot_pose, dtype=np.float64).copy()

    def _hand_back(self, situation: _Situation, reason: str) -> None:
        self._driven, self._driven_ns = situation.command, situation.now_ns

    # -- the command of each state

    def _command(self, situation: _Situation) -> tuple[Twist2, bool, str]:
        """Command past the collision monitor, whether it is held back, and why."""
        if self.mode == Mode.STOPPED:
            return (0.0, 0.0), False, self._why_stopped(situation)
        hold = self._hold_reason(situation)
        if hold:
            return (0.0, 0.0), False, hold
        if self.mode == Mode.VIRTUAL:
            wanted = clip_twist(*situation.inputs.nav_command, self.config.limits)
            if situation.inputs.age("nav") > self._timeout("nav"):
                wanted = (0.0, 0.0)  # in the first moments: the follower has not spoken yet
            sent = self._monitored(wanted, situation)
            reason = "you drive the virtual robot" + self._far_from_keyframe(situation)
            if self._subgoal is None:
                return (0.0, 0.0), False, reason + "; no free place for the robot near it"
            held = "" if sent.action == "free" else "; the robot slows down for something close"
            return sent.command, False, reason + held
        return self._real_command(situation)

    def _far_from_keyframe(self, situation: _Situation) -> str:
        """Words for a v-bot that has left what the virtual space is fit to show; "" within."""
        if self._ready is None:
            return ""
        vspace = self._ready[1]
        away = float(np.linalg.norm(situation.vbot_pose[:2] - vspace.position))
        return (
            "" if away <= vspace.ready_radius_m else f"; the picture gets worse {away:.1f} m from where it was learnt"
        )

    def _real_command(self, situation: _Situation) -> tuple[Twist2, bool, str]:
        command, prediction = situation.command, situation.prediction
        blocked, reason = False, "you drive the robot"
        if prediction is not None and prediction.hit_index is not None and command != (0.0, 0.0):
            blocked = True
            why = self._why_not_virtual(situation) or "obstacle ahead"
            reason = f"blocked: obstacle in {prediction.distance_m:.1f} m; {why}"
            command = self._slowed(command, prediction.distance_m)
        sent = self._monitored(command, situation)
        if sent.action in ("approach", "stop") and not blocked:
            blocked = True
            reason = f"blocked: contact in {sent.time_to_collision_s:.1f} s"
        elif sent.action != "free" and not blocked:
            reason += "; slowed down for something close"
        return sent.command, blocked, reason

    def _monitored(self, command: Twist2, situation: _Situation) -> MonitoredCommand:
        """The command past the collision monitor, by all that is seen and remembered near the robot."""
        inputs = situation.inputs
        points = inputs.scan_points
        if inputs.costmap is not None and inputs.robot_pose is not None:
            config = self.config.collision_monitor
            memory = inputs.costmap.memory_near(inputs.robot_pose, config.blind_radius_m, config.memory_range_m)
            points = np.concatenate([points, np.repeat(memory, self.monitor.most_points_needed, axis=0)])
        return self.monitor.limit(command, points, max(inputs.age("scan"), inputs.ages.get("points", 0.0)))

    def _slowed(self, command: Twist2, distance_m: float) -> Twist2:
        """The command slowed so that the robot can stop ``stop_margin_m`` before the obstacle."""
        left = max(0.0, distance_m - self.config.switch.stop_margin_m)
        # Half of the base's deceleration: the other half is there for the latency.
        allowed = math.sqrt(self.config.limits.max_linear_accel_m_s2 * left)
        speed = abs(command[0]) + self.predictor.reach_m * abs(command[1])
        factor = min(1.0, allowed / speed) if speed > 0 else 1.0
        return command[0] * factor, command[1] * factor

    def _hold_reason(self, situation: _Situation) -> str:
        """Why nothing may move although the state would let it; "" when it may."""
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
        if inputs.estop:
            return "emergency stop: release it to go on"
        lacking = self._lacking(inputs, Mode.REAL, situation.now_ns)
        if lacking:
            return "stopped: " + _no_data(lacking)
        if inputs.robot_pose is None:
            return "stopped: the robot's pose in the map is not known"
        if situation.command != (0.0, 0.0):
            return f"let go of the controls to go on (stopped: {self._stop_reason})"
        return f"stopped: {self._stop_reason}"


def _no_data(lacking: list[tuple[Source, float]]) -> str:
    return ", ".join(
        source.words or (f"no {source.name} yet" if math.isinf(age) else f"no {source.name} for {age:.1f} s")
        for source, age in lacking
    )
