"""The part of ``ic doctor`` for a running stack: faults reported by its nodes, and what to do about them."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

from instant_ic import pace
from instant_ic.bus import ERROR, OK, registry
from instant_ic.cli.finding import FAIL, Finding
from instant_ic.cli.finding import OK as FINE
from instant_ic.cli.finding import WARN as DOUBTFUL
from instant_ic.msg import DiagnosticArray, deserialize

_LONGEST_S = 20.0

ADVICE: tuple[tuple[str, str], ...] = (
    ("emergency stop button", "release the button on the robot, then release the stop on the operator's page"),
    ("emergency stop", "release it on the operator's page"),
    ("let go of the controls", "release all keys, the joystick and the pad once"),
    ("operator's link", "open the operator's page, or check its network (ic topic info /operator/cmd_vel)"),
    ("LiDAR scan", "check the VLP-16's cable and network (ic topic info /scan)"),
    ("3D points", "check the VLP-16's driver (ic topic info /lidar/points)"),
    ("wheel odometry", "check crawler_base and its serial port (ic topic info /wheel/odom)"),
    ("SLAM pose", "check grid_slam and the CPU load (ic top)"),
    ("camera image", "check the camera and the link to the page (ic topic info /camera/image/compressed)"),
    ("view of the virtual space", "check nerf, the console and the CPU load (ic top)"),
    ("virtual space", "check depth and keyframes; without a virtual space the robot stops at obstacles"),
    (
        "no way round",
        "drive around by hand; obstacles that no scan sees are cleared within seconds (docs/control.md)",
    ),
    ("path follower", "check navigator (ic log navigator)"),
    ("v-bot", "check virtual_robot (ic log virtual_robot)"),
)
"""Pattern in a fault's text → advice; the first match counts."""


def check_running(run_dir: Path, seconds: float = 2.5) -> Iterator[Finding]:
    """Faults that running nodes report within some seconds of the stack's time; nothing where no node runs."""
    from instant_ic.cli.observer import Observer

    nodes = registry.list_nodes(run_dir)
    if not nodes:
        return
    told: dict[str, tuple[int, str]] = {}
    try:
        factor = pace.read(run_dir).factor
        with Observer("/diagnostics", run_dir=run_dir) as observer:
            for batch in observer.batches(min(seconds / factor, _LONGEST_S), 0.2):
                for received in batch:
                    message: DiagnosticArray = deserialize(received.payload, received.type_name)
                    told |= {status.name: (int(status.level), status.message) for status in message.status}
    except (registry.RegistryError, pace.PaceError) as error:
        yield Finding(FAIL, "running stack", str(error), "see ic log")
        return
    faults = {name: words for name, words in told.items() if words[0] > OK}
    if not told:
        yield Finding(
            DOUBTFUL, "running stack", f"none of its {len(nodes)} nodes publishes diagnostics", "see ic log and ic top"
        )
    elif not faults:
        yield Finding(FINE, "running stack", f"{len(nodes)} nodes, no faults")
    for name, (level, words) in sorted(faults.items()):
        advice = next((advice for part, advice in ADVICE if part in words), f"ic log {name.partition(':')[0]}")
        yield Finding(FAIL if level >= ERROR else DOUBTFUL, name, words, advice)
