"""The part of ``ic doctor`` for a running stack: faults reported by its nodes, and what to do about them."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

from instant_ic.bus import ERROR, OK, registry
from instant_ic.cli import doctor
from instant_ic.cli.doctor import FAIL, Finding
from instant_ic.control.states import Reason
from instant_ic.msg import DiagnosticArray, DiagnosticStatus, deserialize
from instant_ic.util import pace

_LONGEST_S = 20.0

ADVICE: dict[Reason, str] = {
    Reason.ESTOP: "release it on the operator's page",
    Reason.ESTOP_BUTTON: "release the button on the robot, then release the stop on the operator's page",
    Reason.STARTING: "wait for every sensor, or check the nodes (ic top)",
    Reason.RELEASE_CONTROLS: "release all keys, the joystick and the pad once",
    Reason.INTERRUPTED: "release all keys; if it comes again, check the CPU load and memory (ic top)",
    Reason.OPERATOR_LOST: "open the operator's page, or check its network (ic topic info /operator/cmd_vel)",
    Reason.SCAN_STALE: "check the VLP-16's cable and network (ic topic info /scan)",
    Reason.POINTS_STALE: "check the VLP-16's driver (ic topic info /lidar/points)",
    Reason.ODOMETRY_STALE: "check crawler_base and its serial port (ic topic info /wheel/odom)",
    Reason.POSE_STALE: "check grid_slam and the CPU load (ic top)",
    Reason.POSE_LOST: "release the controls, then drive on slowly where the map is known, or set /initialpose",
    Reason.BLIND: "uncover the LiDAR, or drive the other way",
    Reason.CONTRADICTION: "do what the text says, then release the controls; the robot drives slowly until both agree",
    Reason.POSE_UNKNOWN: "check grid_slam and the CPU load (ic top)",
    Reason.CAMERA_STALE: "check the camera and the link to the page (ic topic info /camera/image/compressed)",
    Reason.IMAGES_TOO_RARE: "check the camera and the link to the page (ic topic info /camera/image/compressed)",
    Reason.ESTOP_INPUT_STALE: "check the emergency stop button and its cable (ic topic info /robot/estop)",
    Reason.VIEW_STALE: "check nerf, the console and the CPU load (ic top)",
    Reason.VBOT_STALE: "check virtual_robot (ic log virtual_robot)",
    Reason.NAV_STALE: "check navigator (ic log navigator)",
    Reason.NO_WAY_ROUND: "drive around by hand; obstacles that no scan sees are cleared within seconds",
    **dict.fromkeys(
        (
            *(Reason.VSPACE_NOT_RUNNING, Reason.VSPACE_NOT_READY, Reason.VSPACE_TOO_FAR, Reason.VSPACE_TOO_POOR),
            *(Reason.VSPACE_FAILED, Reason.VSPACE_LOST, Reason.NO_VIEW_FITS),
        ),
        "check depth and keyframes; without a virtual space the robot stops at obstacles",
    ),
}
"""Reason of the arbiter's diagnosis ``control`` → what to do."""


def check_running(run_dir: Path, seconds: float = 2.5) -> Iterator[Finding]:
    """Yield the faults that running nodes report within some seconds of the stack's time; nothing if no node runs."""
    from instant_ic.cli.observer import TopicObserver

    nodes = registry.list_nodes(run_dir)
    if not nodes:
        return
    found: dict[str, DiagnosticStatus] = {}
    try:
        factor = pace.read(run_dir).factor
        with TopicObserver("/diagnostics", run_dir=run_dir) as observer:
            for batch in observer.batches(min(seconds / factor, _LONGEST_S), 0.2):
                for received in batch:
                    message: DiagnosticArray = deserialize(received.payload, received.type_name)
                    found |= {status.name: status for status in message.status}
    except (registry.RegistryError, pace.PaceError) as error:
        yield Finding(FAIL, "running stack", str(error), "see ic log")
        return
    faults = {name: status for name, status in found.items() if status.level > OK}
    if not found:
        yield Finding(
            doctor.WARN,
            "running stack",
            f"none of its {len(nodes)} nodes publishes diagnostics",
            "see ic log and ic top",
        )
    elif not faults:
        yield Finding(doctor.OK, "running stack", f"{len(nodes)} nodes, no faults")
    for name, status in sorted(faults.items()):
        yield Finding(FAIL if status.level >= ERROR else doctor.WARN, name, status.message, _advice(status))


def _advice(status: DiagnosticStatus) -> str:
    name = next((value.value for value in status.values if value.key == "reason"), "")
    reason = Reason.__members__.get(name, Reason.UNKNOWN)
    return ADVICE.get(reason, f"ic log {status.name.partition(':')[0]}")
