"""The part of ``ic doctor`` for a running stack: faults reported by its nodes, and what to do about them."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

from instant_ic import pace
from instant_ic.bus import ERROR, OK, registry
from instant_ic.cli.doctor import FAIL, Finding
from instant_ic.cli.doctor import OK as FINE
from instant_ic.cli.doctor import WARN as DOUBTFUL
from instant_ic.msg import DiagnosticArray, deserialize

_LONGEST_S = 20.0

ADVICE: tuple[tuple[str, str], ...] = (
    ("emergency stop button", "let the button on the robot out, then release the stop on the page"),
    ("emergency stop", "release it on the operator's page"),
    ("let go of the controls", "let go of keys, stick and pad once"),
    ("operator's link", "open the operator's page, or look at its network (ic topic info /operator/cmd_vel)"),
    ("LiDAR scan", "look at the VLP-16's cable and network (ic topic info /scan)"),
    ("3D points", "look at the VLP-16's driver (ic topic info /lidar/points)"),
    ("wheel odometry", "look at crawler_base and its serial port (ic topic info /wheel/odom)"),
    ("SLAM pose", "look at grid_slam and the machine's load (ic top)"),
    ("camera image", "look at the camera and the link to the page (ic topic info /camera/image/compressed)"),
    ("view of the virtual space", "look at nerf, the console and the machine's load (ic top)"),
    ("virtual space", "look at depth and keyframes; without a virtual space the robot stops before obstacles"),
    (
        "no way round",
        "drive round by hand; what the map holds and no scan sees is forgotten in seconds (docs/control.md)",
    ),
    ("path follower", "look at navigator (ic log navigator)"),
    ("v-bot", "look at virtual_robot (ic log virtual_robot)"),
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
        yield Finding(FAIL, "running stack", str(error), "ic log shows what its nodes say")
        return
    faults = {name: words for name, words in told.items() if words[0] > OK}
    if not told:
        yield Finding(DOUBTFUL, "running stack", f"its {len(nodes)} nodes say nothing", "ic log; ic top")
    elif not faults:
        yield Finding(FINE, "running stack", f"{len(nodes)} nodes, no faults")
    for name, (level, words) in sorted(faults.items()):
        advice = next((advice for part, advice in ADVICE if part in words), f"ic log {name.partition(':')[0]}")
        yield Finding(FAIL if level >= ERROR else DOUBTFUL, name, words, advice)
