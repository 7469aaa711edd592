"""Arbiter of illusory control: which robot the operator drives and which command is sent (paper, III.A).

Each step takes a snapshot of the inputs, runs the table of ``states.py`` with the guards of ``guards.py``, and returns
the command of the resulting state (``commands.py``).
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from instant_ic.control.arbiter_config import ArbiterConfig
from instant_ic.control.commands import CommandRules
from instant_ic.control.guards import GUARD_FUNCTIONS, against_switch, estop_pressed, hold, images_agree, stop_notice
from instant_ic.control.interruptions import Interruptions
from instant_ic.control.operator_commands import OperatorCommands
from instant_ic.control.passage import find_passage
from instant_ic.control.planner import HybridPlanner
from instant_ic.control.prediction import Prediction, Predictor
from instant_ic.control.reasons import Notice
from instant_ic.control.snapshot import NO_MOTION, ArbiterInputs, Snapshot, Twist2, Vspace
from instant_ic.control.sources import SourceMonitor
from instant_ic.control.states import TRANSITIONS, Mode, Reason, Transition, VbotAction
from instant_ic.control.subgoal import Subgoal, choose_subgoal
from instant_ic.geometry.poses import wrap_angle
from instant_ic.util.diagnosis import Diagnosis, Level

_PASSAGE_PERIOD_S = 0.2
STANDS_M_S, STANDS_RAD_S = 0.03, 0.1
"""Below this speed a robot counts as standing."""


@dataclass(frozen=True)
class Decision:
    """Result of one step: what to send and what to show."""

    mode: Mode
    reason: str
    """Text for the operator."""
    reason_code: Reason
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
    """(3,) goal of the v-bot: the r-bot's pose as the operator will see it; for LED_BACK the r-bot's present pose."""
    vbot_limit_m_s: float
    """Speed limit of the v-bot that follows from the rate of the views, in m/s."""
    hard: bool = False
    """The command is zero because a source is lost or an obstacle is near: the base must brake hard."""

    @property
    def diagnosis(self) -> Diagnosis:
        """Mode and reason; a warning while the robot is stopped or blocked."""
        level = Level.WARN if self.mode == Mode.STOPPED or self.blocked else Level.OK
        return Diagnosis("control", level, self.reason, {"mode": self.mode.name, "reason": self.reason_code.name})


class Arbiter:
    """The state machine of illusory control. It reads no clock and no topic: only ``now_ns`` and ``ArbiterInputs``."""

    def __init__(self, config: ArbiterConfig | None = None) -> None:
        self.reconfigure(config or ArbiterConfig())
        self.mode = Mode.STOPPED
        self.transitions = 0
        self._since_ns: int | None = None  # start of the present mode
        self._shown_since_ns: int | None = None  # start of showing the v-bot
        self._returned_ns: int | None = None  # last return or abandoned entry
        self._fresh_since_ns: int | None = None
        self._agree_since_ns: int | None = None
        self._slow_since_ns: int | None = None  # the v-bot drives slower than commanded since then
        self._ready: tuple[Vspace, int] | None = None  # last ready state of the virtual space, and its time
        self._leading_back = False
        self._no_view_fits = False  # the last entry was abandoned
        self._hard = False  # the last command was a hard stop
        self._yaw_gap_before = 0.0  # in the previous step
        self._stopped_for_pose = False  # stopped for a doubtful pose, which has not been trusted since
        self._poses_before: dict[str, tuple[NDArray[np.float64], int]] = {}  # previous pose and its time, by robot
        self._contradictions = 0  # number of contradictions that have stopped the robot
        self._stopped_by = Notice(Reason.STARTING, "The robot waits for its sensors.")
        self._awaits_operator = False  # STOPPED until an operator's command shows that no key is held
        self._operator = OperatorCommands()
        self._interruptions = Interruptions()
        self._interrupted: Notice | None = None  # since the previous step
        self._vbot_start: NDArray[np.float64] = np.zeros(3)
        self._passage: tuple[Notice | None, int] | None = None  # last result of find_passage, and its time
        self._actions: dict[str, Callable[[Snapshot, int], None]] = {
            "stop": self._stop,
            "call_vbot": _nothing,
            "place_vbot": self._place_vbot,
            "ease_vbot": _nothing,
            "drive_vbot_on": self._place_vbot,
            "hand_back": self._hand_back,
            "abandon_entry": self._abandon_entry,
        }

    def reconfigure(self, config: ArbiterConfig) -> None:
        """Apply new parameters from the next step on. Mode and history are kept."""
        predictor, rules = Predictor(config.prediction, config.limits, config.footprint), CommandRules(config)
        # From here on nothing fails: unusable values have raised above.
        self.config, self.predictor, self.rules = config, predictor, rules
        self._sources = SourceMonitor(config)
        self._planner = HybridPlanner(config.footprint)

    def step(self, inputs: ArbiterInputs, now_ns: int) -> Decision:
        """Take at most one transition, then return the command of the resulting state."""
        if self._since_ns is None:
            self._since_ns = now_ns
        self._interrupted = self._interruption(inputs, now_ns)
        self._awaits_operator |= self._interrupted is not None
        snapshot = self.assess(inputs, now_ns)
        rows = (row for row in TRANSITIONS if row.source == self.mode)
        row = next((row for row in rows if GUARD_FUNCTIONS[row.guard](snapshot)), None)
        if row is not None:
            self._take(row, snapshot, now_ns)
            # Another robot is driven now: prediction and gap change.
            snapshot = self.assess(inputs, now_ns)
        self._yaw_gap_before = snapshot.yaw_gap_rad
        if self.mode == Mode.STOPPED:
            self._contradictions = inputs.contradictions
        sent = self.rules.command(snapshot, self._stopped_by)
        # Hard braking stays hard when the operator lets go of the key.
        self._hard = sent.twist == NO_MOTION and (self._hard or sent.hard)
        prediction = snapshot.prediction
        return Decision(
            mode=self.mode,
            reason=sent.notice.text,
            reason_code=sent.notice.reason,
            command=sent.twist,
            blocked=sent.blocked,
            transitions=self.transitions,
            changed=row is not None,
            vbot_start=self._vbot_start.copy(),
            vbot_pose=snapshot.vbot_pose.copy(),
            pose_gap_m=snapshot.gap_m,
            yaw_gap_rad=snapshot.yaw_gap_rad,
            time_to_obstacle_s=math.inf if prediction is None else prediction.time_to_obstacle_s,
            trajectory=np.zeros((0, 3)) if prediction is None else prediction.poses,
            subgoal=snapshot.subgoal,
            estop=estop_pressed(snapshot),
            operator_command=snapshot.command,
            vbot_action=_vbot_action(snapshot),
            vbot_target=np.array(inputs.robot_pose if snapshot.leading_back else snapshot.target),
            hard=self._hard,
            vbot_limit_m_s=self._sources.vbot_limit_m_s(inputs, self.mode),
        )

    def stale_in_s(self, inputs: ArbiterInputs, now_ns: int) -> float:
        """Return seconds from this step until the first fresh source becomes stale; inf for none.

        A step at that moment sends the zero command on time, not up to a period later.
        """
        return self._sources.stale_in_s(inputs, self.mode, *self._durations_s(now_ns))

    def _interruption(self, inputs: ArbiterInputs, now_ns: int) -> Notice | None:
        """Record this step and its command; return why the controls must be released before driving on, or None."""
        longest_s, operator = self.config.timeouts.stop_after_s, self._operator
        found = self._interruptions.step(now_ns, inputs.suspended_ns, inputs.instances, longest_s)
        if found is not None or self._interruptions.gap_s:
            # The sources were not watched during the gap.
            self._fresh_since_ns = self._agree_since_ns = self._slow_since_ns = None
            operator.forget_zeros()
        fresh = self._sources.command_is_fresh(inputs)
        held = operator.step(inputs, fresh, self.config.limits, longest_s, now_ns)
        return found or held

    # -- transitions

    def _take(self, row: Transition, snapshot: Snapshot, now_ns: int) -> None:
        self._actions[row.action](snapshot, now_ns)
        if not row.source.shows_vbot:
            self._shown_since_ns = now_ns
        self.mode = row.target
        self.transitions += 1
        self._since_ns = now_ns
        self._agree_since_ns = None

    def _stop(self, snapshot: Snapshot, now_ns: int) -> None:
        self._stopped_by = stop_notice(snapshot)
        self._stopped_for_pose |= snapshot.pose_lost
        lost = () if estop_pressed(snapshot) else snapshot.lost
        left = any(stale.source.reason == Reason.OPERATOR_LOST for stale in lost)
        self._awaits_operator = left or self._interrupted is not None

    def _place_vbot(self, snapshot: Snapshot, now_ns: int) -> None:
        self._vbot_start = snapshot.vbot_pose.copy()

    def _hand_back(self, snapshot: Snapshot, now_ns: int) -> None:
        self._operator.hand_back(now_ns)
        if snapshot.mode != Mode.STOPPED:
            self._returned_ns = now_ns

    def _abandon_entry(self, snapshot: Snapshot, now_ns: int) -> None:
        self._hand_back(snapshot, now_ns)
        self._no_view_fits = True

    # -- assessing the inputs

    def assess(self, inputs: ArbiterInputs, now_ns: int) -> Snapshot:
        """Return the snapshot of this step, and update the start times of its durations."""
        in_mode_s = self._since_s(self._since_ns, now_ns, 0.0)
        operator = self._operator
        if inputs.vspace.ready:
            self._ready = (inputs.vspace, now_ns)
        stale = self._sources.stale(inputs, self.mode, *self._durations_s(now_ns))
        stale_in_real = self._sources.stale(inputs, Mode.REAL, in_mode_s)
        self._fresh_since_ns = None if stale_in_real else _kept(self._fresh_since_ns, now_ns)
        target = _target(inputs)
        vbot = self._vbot_pose(inputs, target, in_mode_s)
        # The gap is measured to the r-bot as shown: the two images that the operator sees must agree.
        gap_m, yaw_gap_rad = float(np.linalg.norm(vbot[:2] - target[:2])), wrap_angle(float(vbot[2] - target[2]))
        agree = self.mode == Mode.VIRTUAL and inputs.robot_pose is not None and self._poses_agree(gap_m, yaw_gap_rad)
        self._agree_since_ns = _kept(self._agree_since_ns, now_ns) if agree else None
        self._slow_since_ns = _kept(self._slow_since_ns, now_ns) if self._vbot_is_slow(inputs) else None
        snapshot = Snapshot(
            config=self.config,
            predictor=self.predictor,
            inputs=inputs,
            mode=self.mode,
            in_mode_s=in_mode_s,
            command=operator.command,
            fresh=operator.fresh,
            last_command=operator.last,
            idle_s=operator.idle_s(now_ns),
            stale=stale,
            lost=tuple(one for one in stale if self._sources.is_lost(one, inputs)),
            stale_in_real=stale_in_real,
            fresh_s=self._since_s(self._fresh_since_ns, now_ns, -1.0),
            vspace=self._vspace(inputs, now_ns),
            target=target,
            vbot_pose=vbot,
            gap_m=gap_m,
            yaw_gap_rad=yaw_gap_rad,
            yaw_gap_before_rad=self._yaw_gap_before,
            agree_s=self._since_s(self._agree_since_ns, now_ns, -1.0),
            prediction=self._prediction(inputs, operator.command, vbot),
            since_return_s=self._since_s(self._returned_ns, now_ns, math.inf),
            awaits_operator=self._awaits_operator,
            slow_s=self._since_s(self._slow_since_ns, now_ns, 0.0),
            let_go_s=operator.let_go_s(now_ns),
            held=operator.held_by != "",
            interrupted=self._interrupted,
            settles=self._interruptions.gap.settles(now_ns),
            pose_lost=self._pose_lost(inputs),
            pose_jumped=self._jumps("r-bot", inputs.robot_pose, now_ns),
            contradicted=self._contradicted(inputs),
            vbot_jumped=self._vbot_jumps(vbot, now_ns),
        )
        self._no_view_fits = self._no_view_fits and not _may_enter_again(snapshot)
        self._leading_back = self._leads_back(snapshot)
        snapshot = replace(
            snapshot,
            no_view_fits=self._no_view_fits,
            leading_back=self._leading_back,
            subgoal=self._subgoal(snapshot),
        )
        return replace(snapshot, against_switch=self._against_switch(snapshot, now_ns))

    def _vbot_is_slow(self, inputs: ArbiterInputs) -> bool:
        """Return whether the operator drives the v-bot, and it is slower than commanded."""
        wanted_m_s = min(abs(self._operator.command[0]), self._sources.vbot_limit_m_s(inputs, self.mode))
        return self.mode == Mode.VIRTUAL and abs(inputs.vbot_velocity[0]) < 0.8 * wanted_m_s

    def _pose_lost(self, inputs: ArbiterInputs) -> bool:
        """Return whether the SLAM is lost, and the robot has not been stopped for it yet."""
        trust, lost = self.config.pose_trust, inputs.pose_lost_probability
        self._stopped_for_pose = self._stopped_for_pose and lost >= trust.slow
        return lost >= trust.stop and not self._stopped_for_pose

    def _contradicted(self, inputs: ArbiterInputs) -> bool:
        """Return whether wheels and LiDAR contradict each other, and the robot has not been stopped for it yet."""
        self._contradictions = min(self._contradictions, inputs.contradictions)  # a restarted SLAM counts from 0
        return inputs.contradictions > self._contradictions

    def _vbot_jumps(self, pose: NDArray[np.float64], now_ns: int) -> bool:
        """Return whether the v-bot's pose jumps while it is shown and the r-bot follows it."""
        if not self.mode.shows_vbot:
            self._poses_before.pop("v-bot", None)
            return False
        return self._jumps("v-bot", pose, now_ns)

    def _jumps(self, robot: str, pose: NDArray[np.float64] | None, now_ns: int) -> bool:
        """Return whether a pose is not finite, or farther from the previous pose than the robot can have driven."""
        if pose is None:
            return False
        before, self._poses_before[robot] = self._poses_before.get(robot, (pose, now_ns)), (pose, now_ns)
        trust, limits = self.config.pose_trust, self.config.limits
        elapsed_s = max(0, now_ns - before[1]) / 1e9
        moved_m = math.dist(pose[:2], before[0][:2])
        turned_rad = abs(wrap_angle(float(pose[2] - before[0][2])))
        return not (
            moved_m <= trust.jump_m + limits.max_linear_m_s * elapsed_s
            and turned_rad <= math.radians(trust.jump_deg) + limits.max_angular_rad_s * elapsed_s
        )

    def _durations_s(self, now_ns: int) -> tuple[float, float]:
        """Return the seconds since the last change of mode, and the seconds for which the v-bot has been shown."""
        return self._since_s(self._since_ns, now_ns, 0.0), self._since_s(self._shown_since_ns, now_ns, 0.0)

    @staticmethod
    def _since_s(since_ns: int | None, now_ns: int, otherwise_s: float) -> float:
        return otherwise_s if since_ns is None else (now_ns - since_ns) / 1e9

    def _vspace(self, inputs: ArbiterInputs, now_ns: int) -> Vspace:
        """Return the status of the virtual space. While it learns, its last ready status is kept for a short time."""
        now = inputs.vspace
        if now.ready or not now.training or self._ready is None:
            return now
        before, since_ns = self._ready
        return before if self._since_s(since_ns, now_ns, 0.0) <= self.config.switch.ready_hold_s else now

    def _vbot_pose(self, inputs: ArbiterInputs, target: NDArray[np.float64], in_mode_s: float) -> NDArray[np.float64]:
        if self.mode in (Mode.REAL, Mode.STOPPED):
            return target
        # Poses sent before the entry do not yet start from the right place.
        if self.mode == Mode.ENTERING and (inputs.vbot_pose is None or inputs.age("vbot") >= in_mode_s):
            return target
        return self._vbot_start if inputs.vbot_pose is None else np.asarray(inputs.vbot_pose)

    def _poses_agree(self, gap_m: float, yaw_gap_rad: float) -> bool:
        switch = self.config.switch
        return gap_m <= switch.position_m and abs(yaw_gap_rad) <= math.radians(switch.yaw_deg)

    def _prediction(self, inputs: ArbiterInputs, command: Twist2, vbot: NDArray[np.float64]) -> Prediction | None:
        if self.mode == Mode.VIRTUAL:
            return self.predictor.predict(vbot, inputs.vbot_velocity, command, inputs.costmap)
        if inputs.robot_pose is None:
            return None
        return self.predictor.predict(inputs.robot_pose, inputs.robot_velocity, command, inputs.costmap)

    def _subgoal(self, s: Snapshot) -> Subgoal | None:
        if s.mode != Mode.VIRTUAL or s.prediction is None or s.inputs.costmap is None:
            return None
        forward = (s.command[0] or s.inputs.vbot_velocity[0]) >= 0.0
        extend_m = self.config.passage.max_pass_m
        return choose_subgoal(s.inputs.costmap, s.vbot_pose, s.prediction, forward, s.inputs.walls, extend_m)

    def _leads_back(self, s: Snapshot) -> bool:
        """Return whether the v-bot returns to the r-bot by itself: nobody drives it, and the r-bot cannot reach it."""
        after_s = self.config.switch.lead_back_after_s
        if s.mode != Mode.VIRTUAL or s.inputs.robot_pose is None or after_s == 0.0 or s.idle_s < after_s:
            return False
        if self._leading_back or s.idle_s >= 3.0 * after_s:
            return True
        linear, angular = s.inputs.robot_velocity
        return s.agree_s < 0.0 and abs(linear) < STANDS_M_S and abs(angular) < STANDS_RAD_S

    def _against_switch(self, s: Snapshot, now_ns: int) -> Notice | None:
        """Return why no switch is possible in REAL with an obstacle ahead; None if one is, or no obstacle is ahead."""
        if s.mode != Mode.REAL or not s.obstacle_ahead:
            return None
        if estop_pressed(s):
            return stop_notice(s)
        return hold(s) or against_switch(s) or self._blocked_passage(s, now_ns)

    def _blocked_passage(self, s: Snapshot, now_ns: int) -> Notice | None:
        """Return why there is no way round the obstacle ahead; None if there is a way.

        Planning takes milliseconds, so the answer is kept for a costmap's period.
        """
        assert s.prediction is not None and s.inputs.costmap is not None
        if self._passage is None or self._since_s(self._passage[1], now_ns, 0.0) >= _PASSAGE_PERIOD_S:
            forward, config = s.command[0] > 0, self.config.passage
            found = find_passage(s.inputs.costmap, s.prediction, forward, s.inputs.walls, self._planner, config)
            self._passage = (found, now_ns)
        return self._passage[0]


def _nothing(snapshot: Snapshot, now_ns: int) -> None:
    """Do nothing more than the new state does."""


def _kept(since_ns: int | None, now_ns: int) -> int:
    return now_ns if since_ns is None else since_ns


def _target(inputs: ArbiterInputs) -> NDArray[np.float64]:
    for pose in (inputs.shown_pose, inputs.robot_pose):
        if pose is not None:
            return np.asarray(pose)
    return np.zeros(3)


def _may_enter_again(s: Snapshot) -> bool:
    """Block a retry after an abandoned entry until a view fits or the operator lets go of the controls."""
    if s.mode != Mode.REAL:
        return False
    switch = s.config.switch
    return s.command == NO_MOTION or images_agree(s, switch.picture_position_m, switch.picture_yaw_deg)


def _vbot_action(s: Snapshot) -> VbotAction:
    if s.mode == Mode.RETURNING:
        return VbotAction.EASED
    if s.mode != Mode.VIRTUAL:
        return VbotAction.WITH_ROBOT
    if s.settles or any(stale.source.key in ("view", "command") for stale in s.stale):
        return VbotAction.HELD  # the operator does not see or does not drive the v-bot
    return VbotAction.LED_BACK if s.leading_back else VbotAction.DRIVEN
