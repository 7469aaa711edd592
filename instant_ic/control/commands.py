"""The command for the r-bot in each state, after the collision monitor."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from instant_ic.control.arbiter_config import ArbiterConfig
from instant_ic.control.guards import POSE_UNKNOWN, hold
from instant_ic.control.reasons import Notice, stale_notice
from instant_ic.control.safety import CollisionMonitor, MonitoredCommand
from instant_ic.control.snapshot import NO_MOTION, ArbiterInputs, Snapshot, Twist2
from instant_ic.control.sources import SourceMonitor, images_too_rare
from instant_ic.control.states import Mode, Reason

_SLOW_S = 0.8
"""Longer than the v-bot takes to reach full speed."""
_NEAR_OBSTACLE = " The robot slows down near an obstacle."


@dataclass(frozen=True)
class DriveCommand:
    """A command for ``/cmd_vel``."""

    twist: Twist2
    notice: Notice
    blocked: bool = False
    """An obstacle limits the operator's command."""
    hard: bool = False
    """A zero command has another cause than the operator: the base must brake hard."""


class CommandRules:
    """The rules that turn a snapshot into a command, without state."""

    def __init__(self, config: ArbiterConfig) -> None:
        self.config = config
        self.monitor = CollisionMonitor(config.collision_monitor, config.footprint, config.limits)
        self.sources = SourceMonitor(config)

    def command(self, s: Snapshot, stopped_by: Notice) -> DriveCommand:
        """Return the command of the present state; ``stopped_by`` is the reason of STOPPED."""
        if s.mode == Mode.STOPPED:
            return DriveCommand(NO_MOTION, why_stopped(s, stopped_by), hard=True)
        held = hold(s)
        if held is not None:
            return DriveCommand(NO_MOTION, held, hard=True)
        sent = self._virtual(s) if s.mode == Mode.VIRTUAL else self._real(s)
        ahead, behind = s.inputs.blind
        if (ahead and sent.twist[0] > 0.0) or (behind and sent.twist[0] < 0.0):
            text = f"The LiDAR is covered {'ahead' if ahead else 'behind'}. Uncover it, or drive another way."
            return DriveCommand(NO_MOTION, Notice(Reason.BLIND, text), blocked=True, hard=True)
        return sent

    def _virtual(self, s: Snapshot) -> DriveCommand:
        """Return the path follower's command; the operator drives the v-bot."""
        hard = not s.fresh
        if s.leading_back:
            text = "No command: the view goes back to the robot. Drive to continue."
            return DriveCommand(NO_MOTION, Notice(Reason.LEADING_BACK, text), hard=hard)
        text = "You drive the virtual robot."
        if s.subgoal is None:
            text += " The robot has no free place near it."
            return DriveCommand(NO_MOTION, Notice(Reason.NO_SUBGOAL, text), hard=hard)
        wanted = self.config.limits.clip(*s.inputs.nav_command)
        if s.inputs.age("nav") > self.config.timeouts.nav:
            wanted = NO_MOTION  # the follower has not sent its first command yet
        sent = self.monitored(self._paced(wanted, s), s.inputs)
        notice = Notice(Reason.DRIVE_VBOT, text)
        left_s = self.config.switch.lead_back_after_s - s.idle_s
        if s.agree_s < 0.0 and 0.0 < left_s < self.config.switch.lead_back_after_s - 1.0:
            text = f"The robot cannot reach your place. The view goes back to the robot in {left_s:.0f} s."
            notice = Notice(Reason.ROBOT_CANNOT_FOLLOW, text)
        elif sent.action != "free":
            notice = Notice(Reason.DRIVE_VBOT, text + _NEAR_OBSTACLE)
        elif slowed := self.sources.slowed(s.inputs, s.mode, abs(s.command[0])):
            notice = Notice(Reason.DRIVE_VBOT, text + slowed)
        elif s.slow_s > _SLOW_S:
            notice = Notice(Reason.DRIVE_VBOT, text + " It is slow: a wall is ahead, or the robot must catch up.")
        return DriveCommand(sent.command, notice, hard=hard or sent.action == "stop")

    def _real(self, s: Snapshot) -> DriveCommand:
        """Return the operator's command, slowed before an obstacle and during a switch."""
        command, blocked, notice = s.command, False, Notice(Reason.DRIVE_ROBOT, "You drive the robot.")
        if s.prediction is not None and s.obstacle_ahead and command != NO_MOTION:
            command = self._slowed(command, s.prediction.distance_m, s.predictor.reach_m)
            if s.mode == Mode.REAL:
                blocked = True
                reason, why = s.against_switch or (Reason.OBSTACLE_AHEAD, "Drive another way.")
                notice = Notice(reason, f"Obstacle in {s.prediction.distance_m:.1f} m. {why}")
        if s.mode == Mode.ENTERING:
            notice = Notice(Reason.SWITCHING_TO_VIRTUAL, "Obstacle ahead. Switching to the virtual space.")
            waited = s.in_mode_s / self.config.switch.enter_timeout_s
            left = max(0.0, 1.0 - waited**2)  # slows late: hardly noticed if the view comes in time
            command = (command[0] * left, command[1] * left)
        elif s.mode == Mode.RETURNING:
            notice = Notice(Reason.SWITCHING_TO_CAMERA, "You drive the robot. Switching back to the camera.")
        paced = self._paced(command, s)
        if not blocked and s.pose_doubtful:
            text = "The robot is not sure of its place. Drive slowly, by the camera, until it is recognized."
            notice = Notice(notice.reason, text)
        elif not blocked and s.must_be_slow:
            notice = Notice(notice.reason, f"{s.inputs.contradiction.text} The robot is slow until both agree.")
        elif not blocked:
            notice = Notice(notice.reason, notice.text + self.sources.slowed(s.inputs, s.mode, abs(command[0])))
        sent = self.monitored(paced, s.inputs)
        if sent.action in ("approach", "stop") and not blocked:
            blocked = True
            notice = Notice(Reason.CONTACT, f"Contact in {sent.time_to_collision_s:.1f} s. Drive another way.")
        elif sent.action != "free" and not blocked:
            notice = Notice(notice.reason, notice.text + _NEAR_OBSTACLE)
        return DriveCommand(sent.command, notice, blocked, hard=not s.fresh or sent.action == "stop")

    def monitored(self, command: Twist2, inputs: ArbiterInputs) -> MonitoredCommand:
        """Return the command after the collision monitor, which checks all seen and remembered points nearby."""
        points = inputs.scan_points
        if command != NO_MOTION and inputs.costmap is not None and inputs.robot_pose is not None:
            config = self.config.collision_monitor
            memory = inputs.costmap.memory_near(inputs.robot_pose, config.blind_radius_m, config.memory_range_m)
            points = np.concatenate([points, np.repeat(memory, self.monitor.most_points_needed, axis=0)])
        age_s = max(inputs.age("scan"), inputs.ages.get("points", 0.0))
        return self.monitor.limit(command, points, age_s, inputs.robot_velocity, inputs.moving)

    def _slowed(self, command: Twist2, distance_m: float, reach_m: float) -> Twist2:
        """Return the command slowed so that the robot can stop ``stop_margin_m`` before the obstacle."""
        left = max(0.0, distance_m - self.config.switch.stop_margin_m)
        # This assumes half of the base's deceleration; the other half covers the latency.
        allowed = math.sqrt(self.config.limits.max_linear_accel_m_s2 * left)
        speed = abs(command[0]) + reach_m * abs(command[1])
        factor = min(1.0, allowed / speed) if speed > 0 else 1.0
        return command[0] * factor, command[1] * factor

    def _paced(self, command: Twist2, s: Snapshot) -> Twist2:
        """Return the command at the speed that image rate and trust in the pose allow, with the same curvature."""
        limit = self.sources.speed_limit_m_s(s.inputs, s.mode)
        if s.must_be_slow:
            limit = min(limit, self.config.pose_trust.speed_m_s)
        factor = min(1.0, limit / max(abs(command[0]), 1e-9))
        return command[0] * factor, command[1] * factor


def why_stopped(s: Snapshot, stopped_by: Notice) -> Notice:
    """Return the reason that keeps the robot in STOPPED; ``stopped_by`` is the reason of the stop."""
    inputs = s.inputs
    if inputs.estop_button:
        text = "The robot's emergency stop button is pressed. Release it, then release the stop here."
        return Notice(Reason.ESTOP_BUTTON, text)
    if inputs.estop:
        return Notice(Reason.ESTOP, inputs.estop_why or "Emergency stop is pressed. Release it to continue.")
    if s.stale_in_real:
        return stale_notice(s.stale_in_real)
    if inputs.robot_pose is None:
        return POSE_UNKNOWN
    if images_too_rare(inputs, s.config):
        longest_s = s.config.timeouts.slowest_image_s
        text = (
            f"The robot waits for a camera image every {longest_s:g} s or more often. Check the camera if this lasts."
        )
        return Notice(Reason.IMAGES_TOO_RARE, text)
    if s.command != NO_MOTION or inputs.held_in_vain:
        return Notice(Reason.RELEASE_CONTROLS, f"{stopped_by.text} Let go of the controls to continue.")
    return stopped_by
