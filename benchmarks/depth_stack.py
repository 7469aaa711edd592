#!/usr/bin/env python3
"""Age of depth in the whole simulated stack; prints JSON.

    python benchmarks/depth_stack.py --json depth_stack.json

Starts ``launch/sim.yaml`` at its own pace, waits for a virtual space, then measures while the robot stands and while it
turns on the spot (which creates keyframes and keeps all nodes busy). Reported for each: the time from a panorama's
arrival on the bus to its depth, and from its stamp (exposure) to its depth; the target is 0.6 s.
"""

from __future__ import annotations

import argparse
import json
import os
import shutil
import sys
import tempfile
import time
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from instant_ic.bus import LATCHED
from instant_ic.experiments.stack import Stack, free_ports
from instant_ic.msg import message_type, stamp_ns, twist_stamped

TARGET_S = 0.6
TOPICS = ("/depth/raw", "/depth/scaled")


class Ages:
    """Arrival times of panoramas and of their depth, by the panorama's stamp."""

    def __init__(self, stack: Stack) -> None:
        self.pictures: dict[int, float] = {}
        self.from_picture: dict[str, list[float]] = {}
        self.from_stamp: dict[str, list[float]] = {}
        self.keyframes = 0
        observer = stack.observer
        observer.subscribe("/camera/image/compressed", message_type("CompressedImage"), self.on_picture)
        observer.subscribe("/keyframe", message_type("Keyframe"), self.on_keyframe, LATCHED)
        for topic in TOPICS:
            observer.subscribe(topic, message_type("Image"), partial(self.on_depth, topic))

    def on_picture(self, message: Any) -> None:
        self.pictures[stamp_ns(message)] = time.time()

    def on_keyframe(self, message: Any) -> None:
        self.keyframes += 1

    def on_depth(self, topic: str, message: Any) -> None:
        now, stamp = time.time(), stamp_ns(message)
        self.from_stamp.setdefault(topic, []).append(now - stamp / 1e9)
        if stamp in self.pictures:
            self.from_picture.setdefault(topic, []).append(now - self.pictures[stamp])

    def clear(self) -> None:
        self.from_picture, self.from_stamp, self.keyframes = {}, {}, 0

    def summary(self) -> dict[str, Any]:
        return {
            "keyframes": self.keyframes,
            **{
                topic: {
                    "from_picture_s": spread(self.from_picture.get(topic, [])),
                    "from_stamp_s": spread(self.from_stamp.get(topic, [])),
                }
                for topic in TOPICS
            },
        }


def spread(values: list[float]) -> dict[str, Any]:
    if not values:
        return {"count": 0}
    median, p95 = np.quantile(values, (0.5, 0.95))
    return {"count": len(values), "median": round(median, 3), "p95": round(p95, 3), "max": round(max(values), 3)}


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--seconds", type=float, default=30.0, help="of each part (default: %(default)g)")
    parser.add_argument("--turn", type=float, default=0.3, metavar="RAD/S", help="on the spot (default: %(default)g)")
    parser.add_argument("--json", type=Path, metavar="OUT", help="also write the result here")
    parser.add_argument("arguments", nargs="*", metavar="NAME:=VALUE", help="launch arguments")
    args = parser.parse_args()
    chosen = dict(word.split(":=", 1) for word in args.arguments)
    run_dir = Path(tempfile.mkdtemp(prefix="ic-"))
    result: dict[str, Any] = {"cores": os.cpu_count(), "arguments": chosen, "target_s": TARGET_S}
    try:
        with Stack("sim.yaml", run_dir, {**free_ports(), **chosen}) as stack:
            ages = Ages(stack)
            drive = stack.observer.publisher("/operator/cmd_vel", message_type("TwistStamped"))
            vspace = stack.observer.latest("/vspace/status", message_type("VspaceStatus"), max_age_s=1e6, qos=LATCHED)
            stack.wait_for(lambda: ages.keyframes > 0 and vspace.message is not None, 240, "a keyframe")
            for name, turn in (("standing", 0.0), ("turning", args.turn)):
                ages.clear()
                end = time.monotonic() + args.seconds
                last = [0.0]

                def done(turn: float = turn, end: float = end, last: list[float] = last) -> bool:
                    now = time.monotonic()
                    if turn and now - last[0] > 0.05:
                        last[0] = now
                        drive.publish(twist_stamped(0.0, turn, time.time_ns()))
                    return now > end

                stack.wait_for(done, args.seconds + 30, f"the end of {name}")
                result[name] = ages.summary()
                print(f"{name}: {result[name]}", file=sys.stderr, flush=True)
    finally:
        shutil.rmtree(run_dir, ignore_errors=True)
    text = json.dumps(result, indent=2)
    if args.json:
        args.json.write_text(text + "\n")
    print(text)
    return 0


if __name__ == "__main__":
    sys.exit(main())
