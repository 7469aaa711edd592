"""Two machines simulated on one: network namespaces joined by a virtual cable that can be slow, lossy or cut."""

from __future__ import annotations

import math
import os
import shutil
import subprocess
import sys
import threading
import time
from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path
from types import TracebackType
from typing import Any, Self

import numpy as np
from numpy.typing import NDArray

from instant_ic.bridge.host_keys import KeyStore, Peer
from instant_ic.bus import LATCHED, RELIABLE
from instant_ic.experiments.stack import Stack, StackError
from instant_ic.msg import message_type, stamp_ns, twist_stamped

ROBOT_ADDRESS, STATION_ADDRESS = "10.231.75.1", "10.231.75.2"
PORT = 7450


def missing() -> str:
    """Return what this machine lacks for the simulation; empty if nothing."""
    if os.geteuid() != 0:
        return "network namespaces need root"
    if shutil.which("ip") is None:
        return "there is no ip command (Debian package iproute2)"
    name = f"ict{os.getpid()}"
    tries = (
        f"ip netns add {name}",
        f"ip link add ict0 netns {name} type veth peer name ict1 netns {name}",
        f"ip netns exec {name} true",
    )
    try:
        for words in tries:
            made = subprocess.run(words.split(), capture_output=True, text=True)
            if made.returncode:
                return f"network namespaces cannot be made: {words}: {made.stderr.strip()}"
    finally:
        subprocess.run(["ip", "netns", "del", name], capture_output=True)
    return ""


class TwoMachines:
    """Robot and station with separate networks, run directories and keys; a context manager.

    The kernel adds delay and loss (``tc netem``) if it can. Otherwise a proxy on the station's side does
    (``benchmarks/impaired_link.py``), in which a lost packet is a stall of 0.2 s. ``made_by`` names the
    method.

    Args:
        folder: short path for run directories and keys.
        delay_ms, jitter_ms: of each direction.
        loss: share of packets.
    """

    def __init__(self, folder: Path, delay_ms: float = 0.0, jitter_ms: float = 0.0, loss: float = 0.0) -> None:
        self.folder = folder
        self.delay_ms, self.jitter_ms, self.loss = delay_ms, jitter_ms, loss
        self.made_by = "nothing"
        self._names = {host: f"ic{host[0]}{os.getpid()}" for host in ("robot", "station")}
        self._proxy: subprocess.Popen[bytes] | None = None
        self.station_target = (ROBOT_ADDRESS, PORT)
        """Address of the robot's bridge for the station."""

    def __enter__(self) -> Self:
        """Create networks and keys."""
        try:
            self._make_networks()
            self._make_keys()
        except BaseException:
            self._take_down()
            raise
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        """Remove everything."""
        self._take_down()

    def prefix(self, host: str) -> list[str]:
        """Command prefix that runs another command inside a host's network."""
        return ["ip", "netns", "exec", self._names[host]]

    def run_dir(self, host: str) -> Path:
        """Return a host's run directory."""
        return self.folder / host[0]

    def keys(self, host: str) -> Path:
        """Return a host's key folder."""
        return self.folder / f"k{host[0]}"

    def robot(self, **arguments: Any) -> Stack:
        """The robot's stack with simulated devices."""
        arguments = {"keys": self.keys("robot"), "listen": f"tcp://{ROBOT_ADDRESS}:{PORT}", **arguments}
        return Stack("sim_robot", self.run_dir("robot"), arguments, prefix=self.prefix("robot"))

    def station(self, **arguments: Any) -> Stack:
        """The station's stack."""
        host, port = self.station_target
        arguments = {
            "keys": self.keys("station"),
            "robot_host": host,
            "robot_port": port,
            "simulated": "true",
            **arguments,
        }
        return Stack("station", self.run_dir("station"), arguments, prefix=self.prefix("station"))

    def cut(self) -> None:
        """Disconnect the cable."""
        self._ip("-n", self._names["station"], "link", "set", "ics", "down")

    def mend(self) -> None:
        """Reconnect the cable."""
        self._ip("-n", self._names["station"], "link", "set", "ics", "up")

    # -- inside ------------------------------------------------------------------------------------

    def _ip(self, *words: str) -> None:
        done = subprocess.run(["ip", *words], capture_output=True, text=True)
        if done.returncode:
            raise StackError(f"ip {' '.join(words)}: {done.stderr.strip()}")

    def _make_networks(self) -> None:
        robot, station = self._names["robot"], self._names["station"]
        for name in (robot, station):
            self._ip("netns", "add", name)
            self._ip("-n", name, "link", "set", "lo", "up")
        self._ip("link", "add", "icr", "netns", robot, "type", "veth", "peer", "name", "ics", "netns", station)
        for name, device, address in ((robot, "icr", ROBOT_ADDRESS), (station, "ics", STATION_ADDRESS)):
            self._ip("-n", name, "addr", "add", f"{address}/24", "dev", device)
            self._ip("-n", name, "link", "set", device, "up")
        if not (self.delay_ms or self.jitter_ms or self.loss):
            return
        netem = [f"delay {self.delay_ms}ms {self.jitter_ms}ms loss {self.loss:.3%}".split()] * 2
        added = [
            subprocess.run(
                ["tc", "-n", name, "qdisc", "add", "dev", device, "root", "netem", *words], capture_output=True
            ).returncode
            for name, device, words in ((robot, "icr", netem[0]), (station, "ics", netem[1]))
        ]
        if not any(added):
            self.made_by = "tc netem"
            return
        self.made_by = "proxy"  # the kernel lacks sch_netem
        words = [str(PORT), ROBOT_ADDRESS, str(PORT), f"--delay-ms={self.delay_ms}", f"--jitter-ms={self.jitter_ms}"]
        link = Path(__file__).resolve().parents[2] / "benchmarks" / "impaired_link.py"
        self._proxy = subprocess.Popen(
            [*self.prefix("station"), sys.executable, str(link), *words, f"--stall-share={self.loss}"]
        )
        self.station_target = ("127.0.0.1", PORT)

    def _make_keys(self) -> None:
        stores = {host: KeyStore(self.keys(host)) for host in ("robot", "station")}
        made = {host: store.create(host) for host, store in stores.items()}
        stores["robot"].allow(Peer("station", "driver", made["station"].public_key))
        stores["station"].allow(Peer("robot", "driver", made["robot"].public_key))

    def _take_down(self) -> None:
        if self._proxy is not None:
            self._proxy.terminate()
            self._proxy.wait(10)
        for name in self._names.values():
            subprocess.run(["ip", "netns", "del", name], capture_output=True)


class Hand:
    """Simulated operator: publishes commands on ``/operator/cmd_vel`` of a stack, 20 per second; a context manager.

    Args:
        stack: target; its observer publishes.
    """

    def __init__(self, stack: Stack) -> None:
        self.command = (0.0, 0.0)
        self._out = stack.observer.publisher("/operator/cmd_vel", message_type("TwistStamped"))
        self._stop = threading.Event()
        self._thread = threading.Thread(target=self._run, name="hand", daemon=True)

    def _run(self) -> None:
        while not self._stop.wait(0.05):
            self._out.publish(twist_stamped(*self.command, time.time_ns()))

    def __enter__(self) -> Self:
        """Start sending."""
        self._thread.start()
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        """Stop sending."""
        self._stop.set()
        self._thread.join(5)


@dataclass
class CutDrive:
    """Result of :func:`drive_and_cut`; seconds and metres.

    Attributes:
        picture_age_s: from the exposure of the newest image at the station until the cut.
        driven_m: by the operator's command, before the cut.
        stop_s: from the cut to the last motion of the wheels.
        drift_m: of the stopped robot, until the cable is reconnected and the station linked.
        relink_s: from reconnecting the cable to the link.
        driven_again_m: after the link is back.
        offset_ms, rtt_ms, jitter_ms: of the robot's clock as seen by the station.
        console: data missing on the station's page; empty if nothing.
        words: messages of both bridges during the cut.
    """

    picture_age_s: float = math.nan
    driven_m: float = 0.0
    stop_s: float = math.nan
    drift_m: float = math.nan
    relink_s: float = math.nan
    driven_again_m: float = 0.0
    offset_ms: float = math.nan
    rtt_ms: float = math.nan
    jitter_ms: float = math.nan
    console: dict[str, str] = field(default_factory=dict)
    words: dict[str, str] = field(default_factory=dict)


class _Diagnoses:
    """Newest diagnostics on a stack's bus by name: message and values."""

    def __init__(self, stack: Stack) -> None:
        self.words: dict[str, str] = {}
        self.values: dict[str, dict[str, str]] = {}
        stack.observer.subscribe("/diagnostics", message_type("DiagnosticArray"), self._take, RELIABLE)

    def _take(self, message: Any) -> None:
        for status in message.status:
            self.words[status.name] = status.message
            self.values[status.name] = {pair.key: pair.value for pair in status.values}


def drive_and_cut(machines: TwoMachines, robot: Stack, station: Stack) -> CutDrive:
    """Drive the robot from the station, disconnect the cable while it moves, reconnect it, and drive on.

    Raises:
        StackError: a condition was not met in time.
    """
    result = CutDrive()
    real = message_type("ControlState").REAL
    odometry, state_type = message_type("Odometry"), message_type("ControlState")
    speeds, states = robot.collect("/wheel/odom", odometry), robot.collect("/ic/state", state_type, LATCHED)
    truth = robot.collect("/ground_truth/odom", odometry)
    pictures = station.collect("/camera/image/compressed", message_type("CompressedImage"))
    maps = station.collect("/map", message_type("OccupancyGrid"), LATCHED)
    seen, told = _Diagnoses(station), _Diagnoses(robot)

    def wait(condition: Callable[[], Any], timeout_s: float, what: str) -> None:
        def look() -> Any:
            robot.observer.spin_once()
            return condition()

        station.wait_for(look, timeout_s, what)

    def place() -> NDArray[np.float64]:
        point = truth[-1].pose.pose.position
        return np.array([point.x, point.y])

    def driven_from(start: NDArray[np.float64]) -> float:
        return float(np.linalg.norm(place() - start))

    def speed() -> float:
        return abs(speeds[-1].twist.twist.linear.x) if speeds else 0.0

    # The operator's data arrives: image, state, pose and map, as judged by the console.
    wait(lambda: pictures and maps, 180, "image and map at the station")
    names = [f"console: {name}" for name in ("camera", "controller", "pose")]
    wait(lambda: all(seen.words.get(name) == "" for name in names), 120, "console that misses nothing")
    result.console = {name: seen.words[name] for name in names}
    result.picture_age_s = (time.time_ns() - stamp_ns(pictures[-1])) / 1e9
    wait(lambda: states and states[-1].mode == real, 120, "robot that may drive")
    with Hand(station) as hand:
        start = place()
        hand.command = (0.25, 0.0)
        wait(lambda: driven_from(start) > 0.3 and speed() > 0.15, 60, "motion")
        result.driven_m = driven_from(start)
        machines.cut()
        moved_s = cut_s = time.monotonic()

        def stands() -> bool:
            nonlocal moved_s
            if any(abs(message.twist.twist.linear.x) > 0.01 for message in speeds):
                moved_s = time.monotonic()
            speeds.clear()
            return time.monotonic() - moved_s > 1.5

        wait(stands, 30, "robot that stands")
        result.stop_s = moved_s - cut_s
        standing = place()
        link = "host_bridge: link"
        wait(lambda: "nothing heard" in told.words.get(link, ""), 30, "words of the robot's bridge")
        wait(lambda: seen.words.get(link, "").startswith(("robot:", "tcp:")), 30, "words of the station's bridge")
        result.words = {"robot": told.words[link], "station": seen.words[link]}
        hand.command = (0.0, 0.0)
        machines.mend()
        mended_s = time.monotonic()
        wait(lambda: seen.words.get(link, "").startswith("linked with robot"), 60, "link")
        result.relink_s = time.monotonic() - mended_s
        result.drift_m = driven_from(standing)
        count = len(pictures)
        wait(lambda: len(pictures) > count + 3, 60, "images after the cut")
        wait(lambda: states[-1].mode == real, 120, "robot that may drive again")
        start = place()
        hand.command = (-0.25, 0.0)
        wait(lambda: driven_from(start) > 0.2, 60, "motion after the cut")
        result.driven_again_m = driven_from(start)
    clock = seen.values["host_bridge: clock of robot"]
    result.offset_ms, result.rtt_ms, result.jitter_ms = (float(clock[k]) for k in ("offset_ms", "rtt_ms", "jitter_ms"))
    return result
