"""The arbiter in a recorded drive: states, holds, jumps at each switch, regularity of its inputs.

    ic launch sim record:=drive          # drive through the virtual space on the page, then Ctrl-C
    python benchmarks/switches.py drive --json switches.json

Times are those of the stack. The jump at a switch is computed from the page's data: the position of its newest camera
image at the exposure, from /tf, against the pose of its newest view; and the headings of the two robots.
"""

from __future__ import annotations

import argparse
import json
import math
from collections import Counter
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np

from instant_ic.bag import BagReader
from instant_ic.control.states import Mode, Reason
from instant_ic.geometry.transforms import TransformBuffer, TransformError
from instant_ic.msg import deserialize, matrix_from_pose, stamp_ns, transform_matrix

SOURCES = (
    *("/scan", "/lidar/points", "/wheel/odom", "/pose", "/camera/image/compressed", "/vspace/view"),
    *("/vbot/odom", "/nav/cmd_vel", "/operator/cmd_vel"),
)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("bag", type=Path)
    parser.add_argument("--json", type=Path, help="also write it there")
    args = parser.parse_args()
    text = json.dumps(measure(args.bag), indent=2)
    if args.json:
        args.json.write_text(text + "\n")
    print(text)


def measure(bag: Path) -> dict[str, Any]:
    """Figures of the drive in ``bag``."""
    tree, states, pages, stamps = TransformBuffer(cache_s=86400.0), [], [], {topic: [] for topic in SOURCES}
    wanted = {"/ic/state", "/view/shown", "/tf", "/tf_static", *SOURCES}
    with BagReader(bag) as reader:
        for entry in reader.current_messages(wanted):
            topic, at_ns = entry.topic, entry.stamp_ns
            if topic in stamps:
                stamps[topic].append(at_ns)
                continue
            message = deserialize(entry.payload, entry.type_name)
            if topic == "/ic/state":
                states.append((at_ns, message))
            elif topic == "/view/shown":
                pages.append((at_ns, message))
            else:
                for t in message.transforms:
                    parent, child = t.header.frame_id, t.child_frame_id
                    tree.set(parent, child, stamp_ns(t), transform_matrix(t), static=topic == "/tf_static")
    return {
        "seconds": seconds_by_state(states),
        "transitions": [
            Mode(m.mode).label for k, (_, m) in enumerate(states) if k == 0 or states[k - 1][1].mode != m.mode
        ],
        "held_s": holds(states),
        "switches": [
            jump(tree, pages, at_ns, before, after)
            for (_, before), (at_ns, after) in pairwise(states)
            if before.shown != after.shown and Mode.STOPPED not in (before.mode, after.mode)
        ],
        "gap_ms": {topic: gaps(np.array(times)) for topic, times in stamps.items() if len(times) > 2},
    }


def seconds_by_state(states: list[tuple[int, Any]]) -> dict[str, float]:
    """Seconds in each state."""
    total: Counter[str] = Counter()
    for (at, message), (then, _) in pairwise(states):
        total[Mode(message.mode).label] += (then - at) / 1e9
    return {name: round(seconds, 2) for name, seconds in total.items()}


def holds(states: list[tuple[int, Any]]) -> dict[str, float]:
    """Seconds for which a moving state was held because a source was stale, by reason."""
    total: Counter[str] = Counter()
    for (at, message), (then, _) in pairwise(states):
        reason = Reason(message.reason_code)
        if message.mode != Mode.STOPPED and reason.is_stale_source:
            total[reason.label] += (then - at) / 1e9
    return {name: round(seconds, 2) for name, seconds in total.items()}


def jump(tree: TransformBuffer, pages: list[tuple[int, Any]], at_ns: int, before: Any, after: Any) -> dict[str, Any]:
    """Position and heading difference between the image before a switch and the one after it."""
    had = [message for stamp, message in pages if stamp <= at_ns]
    error_m = math.nan
    if had:
        try:
            taken = tree.lookup("map", "camera", stamp_ns(had[-1].picture_stamp))[:2, 3]
            error_m = float(np.linalg.norm(taken - matrix_from_pose(had[-1].view_pose)[:2, 3]))
        except TransformError:
            pass
    return {
        "to": Mode(after.mode).label,
        "position_error_m": round(error_m, 4) if math.isfinite(error_m) else None,
        "yaw_error_deg": round(abs(math.degrees(before.yaw_gap_rad)), 3),
    }


def gaps(times_ns: np.ndarray) -> dict[str, float]:
    """Milliseconds between messages."""
    milliseconds = np.diff(times_ns) / 1e6
    return {
        "median": round(float(np.median(milliseconds)), 1),
        "p99": round(float(np.percentile(milliseconds, 99)), 1),
        "max": round(float(milliseconds.max()), 1),
    }


if __name__ == "__main__":
    main()
