#!/usr/bin/env python3
"""Soak test of the bus: the stack's topics at twice their rates, `reliable`; no message may be lost; prints JSON.

    python benchmarks/bus_soak.py --seconds 600 --json soak.json

Three processes publish, three read what the stack's nodes read, and one reads everything, as a recorder does. Each
message carries its number and send time. Lost messages are those that the bus reports and those missing in the
numbering.
"""

from __future__ import annotations

import argparse
import json
import os
import struct
import subprocess
import sys
import tempfile
import time
from collections import defaultdict
from pathlib import Path
from typing import Any, NamedTuple

from reporting import parser_of, report

from instant_ic.bus import RECORD, RELIABLE
from instant_ic.bus.clock import SystemClock
from instant_ic.bus.local_transport import LocalTransport
from instant_ic.bus.node import Node
from instant_ic.bus.transport import Received

STAMP = struct.Struct("<qq")  # number of the message, CLOCK_MONOTONIC at sending
TYPE = "std_msgs/msg/UInt8MultiArray"


class Topic(NamedTuple):
    """One topic of the load."""

    rate_hz: float
    bytes: int
    publisher: str
    readers: tuple[str, ...]


# Rates of docs/benchmarks.md (the camera at its maximum), sizes of the messages that the stack sends.
LOAD = {
    "/camera/image/compressed": Topic(30, 200_000, "robot", ("station", "operator")),
    "/lidar/packets": Topic(10, 92_000, "robot", ()),
    "/lidar/points": Topic(10, 660_000, "robot", ("station",)),
    "/scan": Topic(10, 3_000, "robot", ("station", "control")),
    "/wheel/odom": Topic(30, 720, "robot", ("station", "control", "operator")),
    "/tf": Topic(60, 120, "robot", ("station", "control", "operator")),
    "/battery": Topic(1, 150, "robot", ("operator",)),
    "/ground_truth/odom": Topic(30, 720, "robot", ()),
    "/map": Topic(1, 400_000, "station", ("control", "operator")),
    "/pose": Topic(10, 370, "station", ("control", "operator")),
    "/depth/raw": Topic(2, 2_097_200, "station", ("station",)),
    "/depth/scaled": Topic(2, 2_097_200, "station", ("operator",)),
    "/keyframe": Topic(0.5, 2_300_000, "station", ("station",)),
    "/vspace/view": Topic(10, 40_000, "station", ("operator",)),
    "/vspace/status": Topic(2, 200, "station", ("control", "operator")),
    "/ic/state": Topic(20, 400, "control", ("operator", "station")),
    "/ic/trajectory": Topic(10, 6_000, "control", ("operator",)),
    "/ic/subgoal": Topic(10, 120, "control", ("control",)),
    "/nav/cmd_vel": Topic(20, 90, "control", ("control",)),
    "/nav/path": Topic(4, 8_000, "control", ("operator",)),
    "/operator/cmd_vel": Topic(20, 90, "control", ("control",)),
    "/vbot/odom": Topic(20, 720, "control", ("control", "operator")),
    "/cmd_vel": Topic(20, 90, "control", ("station",)),
    "/costmap": Topic(5, 40_000, "control", ("operator",)),
    "/heartbeats": Topic(26, 800, "control", ("operator",)),
    "/diagnostics_of_all": Topic(13, 1_500, "control", ("operator",)),
}
PUBLISHERS = ("robot", "station", "control")
READERS = ("station", "control", "operator", "recorder")


def make_node(run_dir: str, name: str) -> Node[None]:
    clock = SystemClock()
    node = Node[None](None, LocalTransport(Path(run_dir), name, clock.now_ns), clock, name)
    node.start()
    return node


def publish(run_dir: str, name: str, seconds: float, factor: float) -> None:
    """Publish this process's topics once all readers have subscribed."""
    node = make_node(run_dir, f"{name}_out")
    sent = dict.fromkeys((t for t, topic in LOAD.items() if topic.publisher == name), 0)
    outputs = {topic: node.publisher_raw(topic, TYPE, RELIABLE) for topic in sent}
    deadline = time.monotonic() + 60.0
    while any(out.subscriber_count < len(LOAD[topic].readers) + 1 for topic, out in outputs.items()):
        if time.monotonic() > deadline:
            raise TimeoutError(f"{name}: the readers did not come")
        time.sleep(0.02)
    end = time.monotonic() + seconds

    def sender(topic: str) -> Any:
        body = bytearray(os.urandom(1024) * (LOAD[topic].bytes // 1024 + 1))[: LOAD[topic].bytes]

        def send() -> None:
            if time.monotonic() > end:
                node.stop()
                return
            sent[topic] += 1
            STAMP.pack_into(body, 0, sent[topic], time.monotonic_ns())
            outputs[topic].publish_bytes(body)

        return send

    for topic in sent:
        node.timer(1.0 / (LOAD[topic].rate_hz * factor), sender(topic))
    cpu = time.process_time()
    node.spin()
    cpu = time.process_time() - cpu
    not_shared = sum(out.raw.stats.not_shared for out in outputs.values())
    print(json.dumps({"sent": sent, "cpu_s": cpu, "not_shared": not_shared}), flush=True)
    sys.stdin.read()  # wait until the readers have counted; the sockets may close after that
    node.close()


def read(run_dir: str, name: str) -> None:
    """Read until standard input closes, then report the received messages."""
    import threading

    node = make_node(run_dir, f"{name}_in")
    got: dict[str, int] = defaultdict(int)
    gaps: dict[str, int] = defaultdict(int)
    late: list[float] = []

    def take(received: Received) -> None:
        number, sent_ns = STAMP.unpack_from(received.payload)
        late.append((time.monotonic_ns() - sent_ns) / 1e3)
        gaps[received.topic] += number - got[received.topic] - 1
        got[received.topic] = number

    for topic, load in LOAD.items():
        if name == "recorder" or name in load.readers:
            node.subscribe_received(topic, take, RECORD if name == "recorder" else RELIABLE)

    def stop_with_input() -> None:
        sys.stdin.read()
        node.stop()

    threading.Thread(target=stop_with_input, daemon=True).start()
    cpu = time.process_time()
    node.spin()
    late.sort()
    told = {s.raw.topic: s.raw.stats.lost_by for s in node.subscriptions if s.raw.stats.lost}
    result = {
        "last": got, "gaps": {t: n for t, n in gaps.items() if n}, "lost_by": told, "count": len(late),
        "p50_us": round(late[len(late) // 2], 1), "p99_us": round(late[int(len(late) * 0.99)], 1),
        "max_us": round(late[-1], 1), "cpu_s": time.process_time() - cpu,
    }  # fmt: skip
    print(json.dumps(result), flush=True)
    node.close()


def soak(seconds: float, factor: float) -> dict[str, Any]:
    """Run all processes and sum up their reports."""
    with tempfile.TemporaryDirectory(prefix="ic") as run_dir:

        def start(*words: str) -> subprocess.Popen[str]:
            command = [sys.executable, __file__, "--seconds", str(seconds), "--factor", str(factor), "--worker", *words]
            return subprocess.Popen([*command, run_dir], stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True)

        readers = {name: start("read", name) for name in READERS}
        publishers = {name: start("publish", name) for name in PUBLISHERS}
        everyone = [*publishers.values(), *readers.values()]
        try:
            outs = {}
            for name, process in publishers.items():
                assert process.stdout is not None
                outs[name] = json.loads(process.stdout.readline())
            time.sleep(1.0)  # let messages in transit arrive
            ins = {name: json.loads(process.communicate(timeout=60)[0]) for name, process in readers.items()}
            for process in publishers.values():
                process.communicate(timeout=60)
        finally:
            for process in everyone:
                if process.poll() is None:
                    process.kill()
                process.wait(10)
    sent = {topic: count for out in outs.values() for topic, count in out["sent"].items()}
    missing = {
        f"{topic} at {name}": sent[topic] - told["last"].get(topic, 0) + told["gaps"].get(topic, 0)
        for name, told in ins.items()
        for topic, load in LOAD.items()
        if (name == "recorder" or name in load.readers)
        and sent[topic] - told["last"].get(topic, 0) + told["gaps"].get(topic, 0)
    }
    megabytes = sum(count * LOAD[topic].bytes for topic, count in sent.items()) / 1e6
    return {
        "seconds": seconds,
        "factor": factor,
        "messages_sent": sum(sent.values()),
        "share_of_the_wanted_rate": round(
            sum(sent.values()) / (seconds * factor * sum(load.rate_hz for load in LOAD.values())), 4
        ),
        "mb_per_s": round(megabytes / seconds, 1),
        "messages_received": sum(told["count"] for told in ins.values()),
        "lost": sum(n for told in ins.values() for by in told["lost_by"].values() for n in by.values()),
        "missing": missing,
        "large_messages_without_shared_memory": sum(out["not_shared"] for out in outs.values()),
        "latency_us": {name: {k: told[k] for k in ("p50_us", "p99_us", "max_us")} for name, told in ins.items()},
        "cpu_percent": {
            **{f"{name}_out": round(100 * out["cpu_s"] / seconds, 1) for name, out in outs.items()},
            **{f"{name}_in": round(100 * told["cpu_s"] / seconds, 1) for name, told in ins.items()},
        },
    }


def main() -> int:
    parser = parser_of(__doc__)
    parser.add_argument("--seconds", type=float, default=600.0)
    parser.add_argument("--factor", type=float, default=2.0, help="times the stack's own rates")
    parser.add_argument("--worker", nargs=3, metavar=("ROLE", "NAME", "RUN_DIR"), help=argparse.SUPPRESS)
    args = parser.parse_args()
    if args.worker:
        role, name, run_dir = args.worker
        if role == "publish":
            publish(run_dir, name, args.seconds, args.factor)
        else:
            read(run_dir, name)
        return 0
    result = soak(args.seconds, args.factor)
    report(result, args.json)
    return 1 if result["lost"] or result["missing"] else 0


if __name__ == "__main__":
    sys.exit(main())
