"""Bridge between two machines: latency of commands, age of images and state with and without the bridge, CPU; as JSON.

python benchmarks/bridge.py [SECONDS]     # seconds per scenario, default 20
python benchmarks/bridge.py --losses      # seconds until the link detects a loss and until it is back

Commands go 20 times per second from the station to the robot; images (200 kB, 10 per second) and states (20 per second)
the other way. Two bridges with CURVE and the shipped topic lists run in their own processes; the network is
``instant_ic.experiments.impaired_link`` in a third.
"""

from __future__ import annotations

import contextlib
import json
import platform
import statistics
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

from instant_ic.bridge.host_connector import ConnectingLink
from instant_ic.bridge.host_keys import KeyStore, Peer
from instant_ic.bridge.host_listener import ListeningLink
from instant_ic.bridge.host_session import Ended, LinkTimes, Side, Up
from instant_ic.bridge.host_topics import TopicRule
from instant_ic.bus import SENSOR
from instant_ic.bus.clock import SystemClock
from instant_ic.bus.local_transport import LocalTransport
from instant_ic.experiments.impaired_link import ImpairedLink, Impairment
from instant_ic.experiments.stack import Observer, _NoParameters, free_port
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

COMMAND, PICTURE, STATE = "/operator/cmd_vel", "/camera/image/compressed", "/vbot/odom"
PICTURE_BYTES = 200_000
SCENARIOS: dict[str, list[str] | None] = {
    "no bridge, one host": None,
    "bridge over loopback": [],
    "bridge, 20 ms ± 5 ms": ["--delay-ms=20", "--jitter-ms=5"],
    "bridge, 20 ms ± 5 ms, 1 % stalls of 0.2 s": ["--delay-ms=20", "--jitter-ms=5", "--stall-share=0.01"],
    "bridge, 20 ms ± 5 ms, 10 Mbit/s (images need 16)": ["--delay-ms=20", "--jitter-ms=5", "--rate-mbit=10"],
}


class Host:
    """A node that publishes and subscribes, spinning on its own thread."""

    def __init__(self, run_dir: Path, name: str) -> None:
        self.node = Observer(_NoParameters(), LocalTransport(run_dir, name, time.time_ns), SystemClock(), name)
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
    """Robot's and station's bridge, with a network between them."""
    stores = {host: KeyStore(folder / f"k{host[0]}") for host in ("robot", "station")}
    made = {host: store.create(host) for host, store in stores.items()}
    stores["robot"].allow(Peer("station", "driver", made["station"].public_key))
    stores["station"].allow(Peer("robot", "driver", made["robot"].public_key))
    listen, through = free_port(), free_port()
    ends = {"robot": f"listen:=tcp://127.0.0.1:{listen}", "station": f"connect:=tcp://127.0.0.1:{through}"}
    commands = [["-m", "instant_ic.experiments.impaired_link", str(through), "127.0.0.1", str(listen), *network]]
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


def summary(ages_ms: list[float]) -> dict[str, float]:
    if not ages_ms:
        return {"count": 0}
    p50, p99 = np.percentile(ages_ms, [50, 99])
    return {"count": len(ages_ms), "p50_ms": round(p50, 2), "p99_ms": round(p99, 2), "max_ms": round(max(ages_ms), 2)}


def run(network: list[str] | None, seconds: float) -> dict[str, Any]:
    with tempfile.TemporaryDirectory(prefix="icb") as name, contextlib.ExitStack() as stack:
        folder = Path(name)
        processes = [] if network is None else stack.enter_context(bridges(folder, network))
        robot_dir, station_dir = folder / "r", folder / ("r" if network is None else "s")
        robot, station = Host(robot_dir, "bench_robot"), Host(station_dir, "bench_station")
        stack.callback(robot.close)
        stack.callback(station.close)
        robot.listen(COMMAND, TwistStamped)
        station.listen(PICTURE, CompressedImage)
        station.listen(STATE, Odometry)
        command = station.node.publisher(COMMAND, TwistStamped)
        picture, state = robot.node.publisher(PICTURE, CompressedImage), robot.node.publisher(STATE, Odometry)
        jpeg = np.random.default_rng(0).bytes(PICTURE_BYTES)
        robot.thread.start()
        station.thread.start()

        def send(step: int) -> None:
            now = time.time_ns()
            command.publish(twist_stamped(0.1, 0.0, now))
            state.publish(odometry_message(np.eye(4), 0.0, 0.0, "map", "vbot", now))
            if step % 2 == 0:
                picture.publish(compressed_image_message(jpeg, "camera", now))

        def pace(duration_s: float, until: Any = None) -> None:
            begin = time.monotonic()
            for step in range(int(duration_s * 20)):
                time.sleep(max(0.0, begin + step / 20 - time.monotonic()))
                send(step)
                if until is not None and until():
                    return

        every = (robot.ages_ms[COMMAND], station.ages_ms[PICTURE], station.ages_ms[STATE])
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
        report: dict[str, Any] = {
            "command": summary(robot.ages_ms[COMMAND]),
            "picture": summary(station.ages_ms[PICTURE]),
            "state": summary(station.ages_ms[STATE]),
        }
        if processes:
            report["cpu_percent"] = {
                host: round(100 * used / elapsed_s, 1) for host, used in zip(("robot", "station"), cpu, strict=True)
            }
        return report


class LinkEnd:
    """One end of a link on its own, with the monotonic time of each of its events."""

    def __init__(self, link_class: Any, *where: Any, name: str, store: KeyStore, exports: Any, imports: Any) -> None:
        self.events: list[tuple[float, Any]] = []
        side = Side(name, f"{name}-{time.monotonic_ns()}", {imports.topic: imports}, lambda type_name: "same")
        self.link = link_class(*where, side, {exports.topic: exports}, store, self._note, LinkTimes())
        self.link.start()

    def _note(self, peer: str, event: Any) -> None:
        self.events.append((time.monotonic(), event))

    def since(self, begin_s: float, kind: Any) -> float:
        """Seconds from a time to the first later event of a kind.

        Raises:
            SystemExit: there is none within 30 s.
        """
        give_up_s = time.monotonic() + 30
        while time.monotonic() < give_up_s:
            for at_s, event in self.events:
                if at_s >= begin_s and isinstance(event, kind):
                    return at_s - begin_s
            time.sleep(0.001)
        raise SystemExit(f"no {kind.__name__} within 30 s")


def losses(repeat: int) -> dict[str, Any]:
    """Network outage, restart of the robot's bridge, and revocation of a key: seconds, median and worst."""
    seconds: dict[str, list[float]] = {name: [] for name in ("hole_noticed", "hole_back", "restart_back", "revoked")}
    command, state = TopicRule(COMMAND, lane="command", max_age_s=0.25), TopicRule(STATE)
    for _ in range(repeat):
        with tempfile.TemporaryDirectory(prefix="icb") as name, contextlib.ExitStack() as ends:
            stores = {host: KeyStore(Path(name) / host) for host in ("robot", "station")}
            keys = {host: store.create(host) for host, store in stores.items()}
            peers = {host: Peer(host, "driver", key.public_key) for host, key in keys.items()}
            stores["robot"].allow(peers["station"])
            port = free_port()

            def robot(stores: Any = stores, port: int = port) -> LinkEnd:
                address = f"tcp://127.0.0.1:{port}"
                return LinkEnd(
                    ListeningLink, address, name="robot", store=stores["robot"], exports=state, imports=command
                )

            first = robot()
            network = ends.enter_context(ImpairedLink(("127.0.0.1", port), Impairment(delay_s=0.01)))
            station = LinkEnd(
                ConnectingLink, f"tcp://127.0.0.1:{network.port}", peers["robot"],
                name="station", store=stores["station"], exports=command, imports=state,
            )  # fmt: skip
            ends.callback(station.link.stop)
            station.since(0.0, Up)
            began = time.monotonic()
            network.cut()
            seconds["hole_noticed"].append(max(first.since(began, Ended), station.since(began, Ended)))
            began = time.monotonic()
            network.mend()
            seconds["hole_back"].append(station.since(began, Up))
            first.link.stop()
            began = time.monotonic()
            second = robot()
            ends.callback(second.link.stop)
            seconds["restart_back"].append(station.since(began, Up))
            began = time.monotonic()
            stores["robot"].revoke("station")
            seconds["revoked"].append(second.since(began, Ended))
    return {
        f"{name}_s": {"median": round(statistics.median(each), 2), "worst": round(max(each), 2)}
        for name, each in seconds.items()
    }


def main() -> None:
    if sys.argv[1:] == ["--losses"]:
        print(json.dumps({"repeat": 10, **losses(10)}, indent=2))
        return
    seconds = float(sys.argv[1]) if len(sys.argv) > 1 else 20.0
    scenarios = {name: run(network, seconds) for name, network in SCENARIOS.items()}
    print(json.dumps({"python": platform.python_version(), "seconds": seconds, "scenarios": scenarios}, indent=2))


if __name__ == "__main__":
    main()
