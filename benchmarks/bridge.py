#!/usr/bin/env python3
"""Latency of commands, images and states between two machines, with and without the bridge, and its CPU; prints JSON.

    python benchmarks/bridge.py --seconds 15 --json bridge.json

Commands go 20 times per second from the station to the robot; images (200 kB, 10 per second) and states (20 per second)
the other way. Two bridges with CURVE and the shipped topic lists run in their own processes; the network is
``impaired_link.py`` in a third.
"""

from __future__ import annotations

import contextlib
import subprocess
import sys
import tempfile
import threading
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import psutil
from reporting import parser_for, report, summary

from instant_ic.bridge.host_keys import KeyStore, Peer
from instant_ic.bus import SENSOR
from instant_ic.bus.clock import SystemClock
from instant_ic.bus.local_transport import LocalTransport
from instant_ic.experiments.stack import StackObserver, _NoParameters, free_port
from instant_ic.msg import (
    CompressedImage,
    Odometry,
    TwistStamped,
    compressed_image_message,
    odometry_message,
    stamp_ns,
    twist_stamped,
)
from instant_ic.util.paths import node_file, shipped_file

COMMAND, IMAGE, STATE = "/operator/cmd_vel", "/camera/image/compressed", "/vbot/odom"
IMAGE_BYTES = 200_000
SCENARIOS: dict[str, list[str] | None] = {
    "no bridge, one host": None,
    "bridge over loopback": [],
    "bridge, 20 ms ± 5 ms": ["--delay-ms=20", "--jitter-ms=5"],
    "bridge, 20 ms ± 5 ms, 1 % stalls of 0.2 s": ["--delay-ms=20", "--jitter-ms=5", "--stall-share=0.01"],
    "bridge, 20 ms ± 5 ms, 10 Mbit/s (images need 16)": ["--delay-ms=20", "--jitter-ms=5", "--rate-mbit=10"],
}


class BusHost:
    """A node that publishes and subscribes, spinning on its own thread."""

    def __init__(self, run_dir: Path, name: str) -> None:
        self.node = StackObserver(_NoParameters(), LocalTransport(run_dir, name, time.time_ns), SystemClock(), name)
        self.ages_ms: dict[str, list[float]] = {}
        self.thread = threading.Thread(target=self._spin, daemon=True)
        self.stop = threading.Event()

    def listen(self, topic: str, message_class: Any) -> None:
        """Record the age of every message when its callback runs."""
        ages = self.ages_ms.setdefault(topic, [])
        self.node.subscribe(topic, message_class, lambda m: ages.append((time.time_ns() - stamp_ns(m)) / 1e6), SENSOR)

    def _spin(self) -> None:
        while not self.stop.is_set():
            self.node.rest(0.1)
            self.node.spin_once()

    def close(self) -> None:
        self.stop.set()
        self.thread.join(5)
        self.node.close()


@contextlib.contextmanager
def bridges(folder: Path, network: list[str]) -> Iterator[list[psutil.Process]]:
    """Start the bridges of robot and station with a network between them; yield their processes."""
    stores = {host: KeyStore(folder / f"k{host[0]}") for host in ("robot", "station")}
    made = {host: store.create(host) for host, store in stores.items()}
    stores["robot"].allow(Peer("station", "driver", made["station"].public_key))
    stores["station"].allow(Peer("robot", "driver", made["robot"].public_key))
    listen, through = free_port(), free_port()
    ends = {"robot": f"listen:=tcp://127.0.0.1:{listen}", "station": f"connect:=tcp://127.0.0.1:{through}"}
    commands = [[str(Path(__file__).with_name("impaired_link.py")), str(through), "127.0.0.1", str(listen), *network]]
    for host, end in ends.items():
        parameters = ["-p", end, "-p", f"keys:={stores[host].folder}"]
        config = str(shipped_file("config", "bridge.yaml"))
        run_dir = str(folder / host[0])
        commands.append([str(node_file("host_bridge")), "--run-dir", run_dir, "--params-file", config, *parameters])
    processes = [subprocess.Popen([sys.executable, *words], stderr=subprocess.DEVNULL) for words in commands]
    try:
        yield [psutil.Process(process.pid) for process in processes[1:]]
    finally:
        for process in processes:
            process.terminate()
        for process in processes:
            process.wait(10)


def run(network: list[str] | None, seconds: float) -> dict[str, Any]:
    """Measure one scenario; without a network, robot and station share one bus."""
    with tempfile.TemporaryDirectory(prefix="icb") as name, contextlib.ExitStack() as stack:
        folder = Path(name)
        processes = [] if network is None else stack.enter_context(bridges(folder, network))
        robot_dir, station_dir = folder / "r", folder / ("r" if network is None else "s")
        robot, station = BusHost(robot_dir, "bench_robot"), BusHost(station_dir, "bench_station")
        stack.callback(robot.close)
        stack.callback(station.close)
        robot.listen(COMMAND, TwistStamped)
        station.listen(IMAGE, CompressedImage)
        station.listen(STATE, Odometry)
        command = station.node.publisher(COMMAND, TwistStamped)
        image, state = robot.node.publisher(IMAGE, CompressedImage), robot.node.publisher(STATE, Odometry)
        jpeg = np.random.default_rng(0).bytes(IMAGE_BYTES)
        robot.thread.start()
        station.thread.start()

        def send(step: int) -> None:
            now = time.time_ns()
            command.publish(twist_stamped(0.1, 0.0, now))
            state.publish(odometry_message(np.eye(4), 0.0, 0.0, "map", "vbot", now))
            if step % 2 == 0:
                image.publish(compressed_image_message(jpeg, "camera", now))

        def pace(duration_s: float, until: Any = None) -> None:
            begin = time.monotonic()
            for step in range(int(duration_s * 20)):
                time.sleep(max(0.0, begin + step / 20 - time.monotonic()))
                send(step)
                if until is not None and until():
                    return

        every = (robot.ages_ms[COMMAND], station.ages_ms[IMAGE], station.ages_ms[STATE])
        pace(60.0, lambda: all(len(ages) > 20 for ages in every))  # connected and warm
        if not all(every):
            raise SystemExit("the bridges did not link within 60 s")
        for ages in every:
            ages.clear()
        cpu_before = [sum(p.cpu_times()[:2]) for p in processes]
        begin = time.monotonic()
        pace(seconds)
        elapsed_s = time.monotonic() - begin
        cpu = [sum(p.cpu_times()[:2]) - before for p, before in zip(processes, cpu_before, strict=True)]
        figures: dict[str, Any] = {
            "command": summary(robot.ages_ms[COMMAND]),
            "image": summary(station.ages_ms[IMAGE]),
            "state": summary(station.ages_ms[STATE]),
        }
        if processes:
            figures["cpu_percent"] = {
                host: round(100 * used / elapsed_s, 1) for host, used in zip(("robot", "station"), cpu, strict=True)
            }
        return figures


def main() -> None:
    parser = parser_for(__doc__)
    parser.add_argument("--seconds", type=float, default=20.0, help="duration of each scenario (default 20)")
    args = parser.parse_args()
    scenarios = {name: run(network, args.seconds) for name, network in SCENARIOS.items()}
    report({"seconds": args.seconds, "scenarios": scenarios}, args.json)


if __name__ == "__main__":
    main()
