#!/usr/bin/env python3
"""The Foxglove bridge with the simulated stack: CPU and memory without viewers and with everything viewed; prints JSON.

python benchmarks/foxglove_bridge.py --json foxglove.json
"""

from __future__ import annotations

import argparse
import json
import os
import shutil
import sys
import tempfile
import time
from pathlib import Path
from typing import Any

import psutil

from instant_ic.bus.registry import list_nodes, list_topics
from instant_ic.experiments.stack import Stack, free_port, free_ports


class Viewer:
    """A client that subscribes to everything and counts messages."""

    def __init__(self, port: int) -> None:
        from websockets.sync.client import connect

        self.socket = connect(
            f"ws://127.0.0.1:{port}", subprotocols=["foxglove.sdk.v1"], max_size=None, compression=None
        ).__enter__()
        self.messages = self.bytes = 0
        self.seen: set[int] = set()

    def watch(self, seconds: float) -> None:
        """Read for some time; subscribe to all offered channels."""
        end = time.monotonic() + seconds
        while (left := end - time.monotonic()) > 0:
            try:
                frame = self.socket.recv(left)
            except TimeoutError:
                return
            if isinstance(frame, bytes):
                self.messages += 1
                self.bytes += len(frame)
                continue
            content = json.loads(frame)
            if content["op"] == "advertise":
                new = [c["id"] for c in content["channels"] if c["id"] not in self.seen]
                self.seen.update(new)
                wanted = [{"id": channel, "channelId": channel} for channel in new]
                self.socket.send(json.dumps({"op": "subscribe", "subscriptions": wanted}))


def cpu_percent(process: psutil.Process, during: Any, seconds: float) -> float:
    """CPU of a process, percent of a core, while ``during`` runs."""
    before, at = sum(process.cpu_times()[:2]), time.monotonic()
    during(seconds)
    return round(100 * (sum(process.cpu_times()[:2]) - before) / (time.monotonic() - at), 1)


def measure(seconds: float) -> dict[str, Any]:
    """Run the stack without page and virtual space, and measure the bridge."""
    run_dir = Path(tempfile.mkdtemp(prefix="ic-"))
    port = free_port()
    arguments = {**free_ports(), "headless": True, "vspace": False, "foxglove": True, "foxglove_port": port}
    try:
        with Stack("sim.yaml", run_dir, arguments) as stack:
            wanted = {"/pose", "/map", "/lidar/points", "/depth/scaled", "/camera/image/compressed"}
            stack.wait_for(lambda: wanted <= {t.topic for t in list_topics(run_dir)}, 180, "the stack's topics")
            pids = {node.name: node.pid for node in list_nodes(run_dir)}
            bridge = psutil.Process(pids["foxglove_bridge"])
            time.sleep(3.0)
            idle = cpu_percent(bridge, time.sleep, seconds)
            viewer = Viewer(port)
            viewer.watch(5.0)
            viewer.messages = viewer.bytes = 0
            watched = cpu_percent(bridge, viewer.watch, seconds)
            return {
                "cores": os.cpu_count(),
                "load_1min": os.getloadavg()[0],
                "cpu_percent_nobody_watches": idle,
                "cpu_percent_everything_watched": watched,
                "topics": len(viewer.seen),
                "messages_per_s": round(viewer.messages / seconds, 1),
                "megabytes_per_s": round(viewer.bytes / seconds / 1e6, 2),
                "rss_mb": round(bridge.memory_info().rss / 1e6, 0),
            }
    finally:
        shutil.rmtree(run_dir, ignore_errors=True)


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--seconds", type=float, default=20.0, help="how long to look, twice (default: %(default)s)")
    parser.add_argument("--json", type=Path, help="where to write the figures, beside printing them")
    args = parser.parse_args()
    text = json.dumps(measure(args.seconds), indent=2)
    print(text)
    if args.json:
        args.json.write_text(text + "\n")
    return 0


if __name__ == "__main__":
    sys.exit(main())
