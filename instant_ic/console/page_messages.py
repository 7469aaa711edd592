"""Messages to the page from the stack's ROS messages; static/messages.js lists their fields."""

from __future__ import annotations

import math
from typing import Any

from instant_ic.console.display import Display
from instant_ic.console.layers import pose_fields
from instant_ic.console.robot_poses import RobotPoses, planar
from instant_ic.geometry.poses import Matrix
from instant_ic.msg import (
    BatteryState,
    ControlState,
    Odometry,
    Path,
    PoseStamped,
    RenderedView,
    VspaceStatus,
    matrix_from_pose,
    twist_values,
)

VSPACE_STATES: dict[int, str] = {
    VspaceStatus.EMPTY: "empty",
    VspaceStatus.TRAINING: "training",
    VspaceStatus.READY: "ready",
    VspaceStatus.FAILED: "failed",
}


def state_message(
    at_ms: float, display: Display, poses: RobotPoses, control: ControlState | None, vbot: Odometry | None
) -> dict[str, Any]:
    """Return the ``state`` message: mode, poses and commands."""
    moving = vbot if display.shown == "virtual" and vbot is not None else control and control.robot_twist
    state: dict[str, Any] = {
        "at_ms": at_ms,
        "mode": display.mode,
        "shown": display.shown,
        "robot": planar(poses.robot_pose()),
        "vbot": planar(poses.vbot_pose()) if display.with_vbot else None,
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
    display: Display, poses: RobotPoses, trajectory: Path | None, path: Path | None, subgoal: PoseStamped | None
) -> dict[str, Any]:
    """Return the ``plan`` message; path and subgoal belong to the virtual mode."""
    virtual = display.mode == "virtual"
    return {
        "trajectory": poses.points(trajectory),
        "path": poses.points(path) if virtual else [],
        "subgoal": planar(matrix_from_pose(subgoal)) if virtual and subgoal is not None else None,
    }


def health_message(
    vspace: VspaceStatus | None,
    battery: BatteryState | None,
    faults: list[dict[str, str]],
    nodes: list[dict[str, Any]],
    pace: str,
) -> dict[str, Any]:
    """Return the ``health`` message; ``pace`` is empty in real time."""
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
    share = finite(battery.percentage)  # 0..1; NaN where unknown (sensor_msgs/BatteryState)
    return {"voltage": voltage, "percent": None if share is None else 100.0 * share}


def panorama_header(captured_ms: float, map_from_camera: Matrix | None) -> dict[str, Any]:
    """Return the header of a panorama's frame."""
    if map_from_camera is None:
        return {"captured_ms": captured_ms, "q": None, "p": None}
    return {"captured_ms": captured_ms, **pose_fields(map_from_camera)}


def view_header(captured_ms: float, view: RenderedView) -> dict[str, Any]:
    """Return the header of a rendered view's frame."""
    return {
        "captured_ms": captured_ms,
        **pose_fields(matrix_from_pose(view.pose)),
        "fov": float(view.fov_rad),
    }


def finite(value: Any) -> float | None:
    """Return a number for JSON; None for infinity and NaN."""
    number = float(value)
    return number if math.isfinite(number) else None
