"""Conversion of the stack's ROS messages to messages for the page; static/messages.js lists their fields."""

from __future__ import annotations

import math
from typing import Any

import numpy as np

from instant_ic.console.display import Display, finite_pose
from instant_ic.console.layers import pose_fields
from instant_ic.geometry.poses import Matrix, pose2_from_matrix
from instant_ic.msg import (
    BatteryState,
    Path,
    PoseStamped,
    VspaceStatus,
    path_array,
    twist_values,
)

VSPACE_STATES: dict[int, str] = {
    VspaceStatus.EMPTY: "empty",
    VspaceStatus.TRAINING: "training",
    VspaceStatus.READY: "ready",
    VspaceStatus.FAILED: "failed",
}


def state_message(at_ms: float, display: Display) -> dict[str, Any]:
    """Return the ``state`` message: mode, poses and commands."""
    control, vbot = display.control.message, display.vbot.message
    moving = vbot if display.shown == "virtual" and vbot is not None else control and control.robot_twist
    state: dict[str, Any] = {
        "at_ms": at_ms,
        "mode": display.mode,
        "shown": display.shown,
        "robot": planar(display.robot_pose()),
        "vbot": planar(display.vbot_pose()) if display.with_vbot else None,
        "twist": [0.0, 0.0] if moving is None else [finite(value) or 0.0 for value in twist_values(moving)],
    }
    if control is None:
        return state
    return state | {
        "reason": control.reason,
        "estop": bool(control.estop),
        "command": [finite(value) for value in twist_values(control.operator_command)],
    }


def plan_message(
    virtual: bool, trajectory: Path | None, path: Path | None, subgoal: PoseStamped | None
) -> dict[str, Any]:
    """Return the ``plan`` message. Path and subgoal are sent only in ``virtual`` mode."""
    return {
        "trajectory": points(trajectory),
        "path": points(path) if virtual else [],
        "subgoal": planar(finite_pose(subgoal)) if virtual and subgoal is not None else None,
    }


def health_message(
    vspace: VspaceStatus | None,
    battery: BatteryState | None,
    faults: list[dict[str, str]],
    nodes: list[dict[str, Any]],
    pace: str,
) -> dict[str, Any]:
    """Return the ``health`` message. ``pace`` is empty in real time."""
    return {"vspace": _vspace(vspace), "battery": _battery(battery), "faults": faults, "nodes": nodes, "pace": pace}


def _vspace(status: VspaceStatus | None) -> dict[str, Any] | None:
    if status is None:
        return None
    return {
        "state": VSPACE_STATES.get(int(status.state), "empty"),
        "psnr_db": finite(status.psnr_db) or 0.0,
        "expected_psnr_db": finite(status.expected_psnr_db) or 0.0,
        "unseen_share": finite(status.unseen_share) or 0.0,
        "radius_m": finite(status.ready_radius_m) or 0.0,
        "train_seconds": finite(status.train_seconds) or 0.0,
        "message": status.message,
    }


def _battery(battery: BatteryState | None) -> dict[str, Any] | None:
    voltage = None if battery is None else finite(battery.voltage)
    if battery is None or voltage is None:
        return None
    share = finite(battery.percentage)  # 0 to 1; NaN if unknown (sensor_msgs/BatteryState)
    return {"voltage": voltage, "percent": None if share is None else 100.0 * share}


def image_header(captured_ms: float, map_from_camera: Matrix | None) -> dict[str, Any]:
    """Return the header of a panorama's frame, or the first part of a rendered view's header."""
    pose = {"q": None, "p": None} if map_from_camera is None else pose_fields(map_from_camera)
    return {"captured_ms": captured_ms, **pose}


def finite(value: Any) -> float | None:
    """Return a number for JSON; None for infinity and NaN."""
    number = float(value)
    return number if math.isfinite(number) else None


def planar(pose: Matrix | None) -> list[float] | None:
    """Return [x, y, yaw] of a pose in m and rad; None if there is no pose."""
    return None if pose is None else [round(float(value), 4) for value in pose2_from_matrix(pose)]


def points(path: Path | None) -> list[list[float]]:
    """Return the points [x, y] of a path in the map frame, rounded to 1 mm; empty for another frame or no path."""
    if path is None or not path.poses or path.header.frame_id not in ("", "map"):
        return []
    xy = path_array(path)[:, :2]
    found: list[list[float]] = xy[np.isfinite(xy).all(axis=1)].round(3).tolist()
    return found
