"""Guards of the transition table in ``states.py``: pure functions of a snapshot."""

from __future__ import annotations

import math
from collections.abc import Callable

import numpy as np

from instant_ic.control.freshness import IMAGES
from instant_ic.control.operator_commands import LET_GO_S
from instant_ic.control.reasons import Notice, stale_notice
from instant_ic.control.snapshot import NO_MOTION, Snapshot
from instant_ic.control.sources import images_too_rare
from instant_ic.control.states import GUARDS, Reason

MIN_SWITCH_SPEED_M_S = 0.03
"""Forward speed below which the robot counts as turning on the spot."""
RETURN_SIDE_M = 0.12
"""Width beside the footprint, on each side, that must be free for a return."""
_SILENT_S = 1.0
"""Seconds of silence after which the controls count as released. This holds only if none was held before, since a link
that pauses does not report the release of a held key."""

POSE_UNKNOWN = Notice(Reason.POSE_UNKNOWN, "The robot's pose in the map is not known. Wait for the SLAM.")
NO_COSTMAP = Notice(Reason.NO_COSTMAP, "There is no costmap yet. Wait for a LiDAR scan.")


def estop_pressed(s: Snapshot) -> bool:
    return s.inputs.estop or s.inputs.estop_button


def interrupted(s: Snapshot) -> bool:
    return s.interrupted is not None


def source_lost(s: Snapshot) -> bool:
    return bool(s.lost)


def pose_lost(s: Snapshot) -> bool:
    return s.pose_lost or s.pose_jumped or s.vbot_jumped


def contradicted(s: Snapshot) -> bool:
    return s.contradicted


def vspace_lost(s: Snapshot) -> bool:
    return s.inputs.vspace.failed or min(s.inputs.age("vspace"), s.in_mode_s) > s.config.timeouts.vspace


def obstacle_and_ready(s: Snapshot) -> bool:
    return s.obstacle_ahead and hold(s) is None and s.against_switch is None


def vspace_not_ready(s: Snapshot) -> bool:
    return s.inputs.age("vspace") > s.config.timeouts.vspace or not s.vspace.ready


def no_view_in_time(s: Snapshot) -> bool:
    slow = sum(s.config.timeouts.allowed_s(key, s.inputs.usual.get(key)) for key in IMAGES)
    return s.in_mode_s > s.config.switch.enter_timeout_s + slow + s.inputs.images_late_s


def way_free(s: Snapshot) -> bool:
    """Return whether the way is free over the horizon that triggers an entry, and over a longer and wider one.

    The margin ensures that the conditions of entry and return never hold together.
    """
    inputs, switch, command = s.inputs, s.config.switch, s.command
    if inputs.robot_pose is None or inputs.costmap is None:
        return False
    if command == NO_MOTION and s.idle_s < switch.neutral_return_s:
        # The operator has let go before the obstacle and will most likely repeat the last command, so the camera image
        # returns only after a while.
        command = s.last_command
    return all(
        s.predictor.predict(
            inputs.robot_pose, inputs.robot_velocity, command, inputs.costmap, extra_m=extra_m, side_m=side_m
        ).hit_index
        is None
        for extra_m, side_m in ((0.0, 0.0), (switch.return_margin_m, RETURN_SIDE_M))
    )


def view_fits(s: Snapshot) -> bool:
    switch = s.config.switch
    vbot_placed = s.inputs.age("vbot") < s.in_mode_s
    # Without fresh commands nobody would drive the v-bot, and the r-bot follows the v-bot.
    return (
        vbot_placed
        and s.fresh
        and hold(s) is None
        and images_agree(s, switch.picture_position_m, switch.picture_yaw_deg)
    )


def rejoined(s: Snapshot) -> bool:
    switch = s.config.switch
    if s.agree_s < switch.return_dwell_s or s.in_mode_s < switch.min_virtual_s:
        return False
    if s.gap_m > switch.return_near_m and s.agree_s < switch.return_patience_s:
        return False
    return not s.stale_in_real and hold(s) is None and way_free(s)


def unsafe_again(s: Snapshot) -> bool:
    return s.command != NO_MOTION and s.obstacle_ahead


def image_fits(s: Snapshot) -> bool:
    if hold(s) is not None:
        return False
    switch = s.config.switch
    waited = s.in_mode_s / switch.return_timeout_s
    if waited >= 2.0:
        return True  # the pose jitters by more than the thresholds; the page eases the remaining error
    within_m, within_deg = switch.return_picture_m, switch.return_picture_yaw_deg
    # The last two steps must both agree: SLAM's heading jitters, and the page may still show the previous one.
    yaw_gap = max(abs(s.yaw_gap_rad), abs(s.yaw_gap_before_rad))
    if s.gap_m > within_m or yaw_gap > math.radians(within_deg):
        return False
    if waited >= 1.0:
        return True
    turns = abs(s.inputs.robot_velocity[1]) > switch.return_turn_rad_s
    return not turns and images_agree(s, within_m, within_deg)


def may_resume(s: Snapshot) -> bool:
    if estop_pressed(s) or s.command != NO_MOTION or s.inputs.held_in_vain or s.inputs.robot_pose is None:
        return False
    if (s.awaits_operator and not s.fresh) or images_too_rare(s.inputs, s.config):
        return False
    let_go = not s.held and (s.inputs.operator_command == NO_MOTION or s.inputs.operator_gone)
    silent = s.idle_s >= _SILENT_S and let_go
    if interrupted(s) or s.settles or not (s.let_go_s >= LET_GO_S if s.fresh else silent):
        return False
    return s.fresh_s >= s.config.timeouts.recover_s


GUARD_FUNCTIONS: dict[str, Callable[[Snapshot], bool]] = {name: globals()[name] for name in GUARDS}
"""The functions above; ``states.GUARDS`` explains them."""


def hold(s: Snapshot) -> Notice | None:
    """Return why the robots must not move in this state; None if they may."""
    if s.settles:
        return Notice(Reason.INTERRUPTED, "The robot's controller paused for a moment. The robot has stopped.")
    if s.stale:
        return stale_notice(s.stale)
    if s.inputs.robot_pose is None:
        return POSE_UNKNOWN
    if s.inputs.costmap is None:
        return NO_COSTMAP
    return None


def images_agree(s: Snapshot, within_m: float, within_deg: float) -> bool:
    """Return whether view and camera image show the same place, so that a switch between them does not jump.

    The two arrive at different times. The distance driven between the arrivals is motion, not an error, but the
    operator sees a large one as a jump too.
    """
    inputs = s.inputs
    if inputs.robot_pose is None or abs(s.yaw_gap_rad) > math.radians(within_deg):
        return False
    if inputs.age("view") > s.config.timeouts.allowed_s("view", inputs.usual.get("view")):
        return False
    if inputs.view_position is None or inputs.image_position is None:
        return False
    apart = inputs.view_position[:2] - inputs.image_position[:2]
    yaw = float(inputs.robot_pose[2])
    driven = inputs.robot_velocity[0] * inputs.view_after_image_s * np.array([math.cos(yaw), math.sin(yaw)])
    return bool(np.linalg.norm(apart - driven) <= within_m and np.linalg.norm(apart) <= 2.0 * within_m)


def against_switch(s: Snapshot) -> Notice | None:
    """Return why no switch is possible with an obstacle ahead; ``passage`` checks the way round it."""
    inputs, switch, vspace = s.inputs, s.config.switch, s.vspace
    assert inputs.robot_pose is not None
    if s.pose_doubtful:
        return Notice(Reason.POSE_DOUBTFUL, "The robot is not sure of its place. Drive slowly until it is recognized.")
    if s.inputs.contradiction:
        return Notice(Reason.CONTRADICTION, s.inputs.contradiction.text)
    if abs(s.command[0]) < MIN_SWITCH_SPEED_M_S:
        return Notice(Reason.NO_ROOM_TO_TURN, "There is no room to turn. Drive straight first.")
    if inputs.age("vspace") > s.config.timeouts.vspace:
        return Notice(Reason.VSPACE_NOT_RUNNING, "No virtual space is running. Drive round the obstacle.")
    if not vspace.ready:
        why = f" ({vspace.message})" if vspace.message else ""
        return Notice(
            Reason.VSPACE_NOT_READY, f"The virtual space is not ready{why}. Wait, or drive round the obstacle."
        )
    away_m = float(np.linalg.norm(vspace.position - inputs.robot_pose[:2]))
    if away_m > vspace.ready_radius_m:
        return Notice(
            Reason.VSPACE_TOO_FAR,
            f"The virtual space is valid within {vspace.ready_radius_m:.1f} m of its keyframe, "
            f"which is {away_m:.1f} m away. Wait for the next keyframe.",
        )
    if 0.0 < vspace.expected_psnr_db < switch.min_expected_psnr_db:  # NaN means unknown
        return Notice(
            Reason.VSPACE_TOO_POOR,
            f"The virtual space shows this place too poorly ({vspace.expected_psnr_db:.0f} dB expected, "
            f"{switch.min_expected_psnr_db:.0f} dB needed). Wait for the next keyframe.",
        )
    if s.no_view_fits:
        text = "No view of the virtual space fits here. Let go of the controls, then drive on to try again."
        return Notice(Reason.NO_VIEW_FITS, text)
    if s.since_return_s < switch.min_real_s:
        return Notice(Reason.JUST_RETURNED, "The virtual space has just been left. Wait a moment.")
    if inputs.costmap is None:
        return NO_COSTMAP
    return None


def stop_notice(s: Snapshot) -> Notice:
    """Return the reason of a transition to STOPPED."""
    if estop_pressed(s):
        return Notice(Reason.ESTOP, "The emergency stop was pressed.")
    if s.interrupted is not None:
        return s.interrupted
    if s.lost:
        return stale_notice(s.lost)
    if s.pose_lost:
        return Notice(Reason.POSE_LOST, "The robot has lost its place on the map.")
    if s.pose_jumped:
        return Notice(Reason.POSE_LOST, "The robot's place on the map has jumped. Check where it stands.")
    if s.contradicted:
        return Notice(Reason.CONTRADICTION, s.inputs.contradiction.text)
    if s.vbot_jumped:
        return Notice(Reason.VBOT_STALE, "The virtual robot's place on the map has jumped.")
    if s.inputs.vspace.failed:
        return Notice(Reason.VSPACE_FAILED, f"The virtual space has failed ({s.inputs.vspace.message}).")
    return Notice(Reason.VSPACE_LOST, "The virtual space has stopped reporting.")
