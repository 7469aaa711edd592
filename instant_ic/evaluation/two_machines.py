"""Two machines on one: network namespaces joined by a virtual cable that can be slow, lossy, or pulled out."""

from __future__ import annotations

import os
import shutil
import subprocess
import sys
import time
from pathlib import Path
from types import TracebackType
from typing import Any, Self

from .stack import Stack, StackError

ROBOT_ADDRESS, STATION_ADDRESS = "10.231.75.1", "10.231.75.2"
PORT = 7450


def missing() -> str:
    """What this machine lacks for it; empty if nothing."""
    if os.geteuid() != 0:
        return "network namespaces need root"
    if shutil.which("ip") is None:
        return "there is no ip command (Debian package iproute2)"
    name = f"ict{os.getpid()}"
    made = subprocess.run(["ip", "netns", "add", name], capture_output=True, text=True)
    if made.returncode:
        return f"network namespaces cannot be made: {made.stderr.strip()}"
    subprocess.run(["ip", "netns", "del", name], check=True)
    return ""


class TwoMachines:
    """Robot and station, each with a network of its own, a run directory and keys; a context manager.

    Delay and loss are made by the kernel (``tc netem``) where it can, else by a proxy on the station's side
    (:mod:`~instant_ic.evaluation.impaired_link`), where a lost packet is a stall of 0.2 s; ``made_by`` tells.

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
        """Where the station finds the robot's bridge."""

    def __enter__(self) -> Self:
        """Makes networks and keys."""
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
        """Takes everything down."""
        self._take_down()

    def prefix(self, host: str) -> list[str]:
        """Command that starts another inside a host's network."""
        return ["ip", "netns", "exec", self._names[host]]

    def run_dir(self, host: str) -> Path:
        """A host's run directory."""
        return self.folder / host[0]

    def keys(self, host: str) -> Path:
        """A host's folder of keys."""
        return self.folder / f"k{host[0]}"

    def robot(self, **arguments: Any) -> Stack:
        """The robot's stack, against simulated devices."""
        arguments = {"keys": self.keys("robot"), "listen": f"tcp://{ROBOT_ADDRESS}:{PORT}", **arguments}
        return Stack("sim_robot", self.run_dir("robot"), arguments, prefix=self.prefix("robot"))

    def station(self, **arguments: Any) -> Stack:
        """The station's stack."""
        host, port = self.station_target
        arguments = {"keys": self.keys("station"), "robot_host": host, "robot_port": port, **arguments}
        return Stack("station", self.run_dir("station"), arguments, prefix=self.prefix("station"))

    def cut(self) -> None:
        """Pulls the cable out."""
        self._ip("-n", self._names["station"], "link", "set", "ics", "down")

    def mend(self) -> None:
        """Puts the cable back."""
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
        self.made_by = "proxy"  # the kernel has no sch_netem
        words = [str(PORT), ROBOT_ADDRESS, str(PORT), f"--delay-ms={self.delay_ms}", f"--jitter-ms={self.jitter_ms}"]
        module = "instant_ic.evaluation.impaired_link"
        self._proxy = subprocess.Popen(
            [*self.prefix("station"), sys.executable, "-m", module, *words, f"--stall-share={self.loss}"]
        )
        self.station_target = ("127.0.0.1", PORT)

    def _make_keys(self) -> None:
        from ..bridge.host_keys import KeyStore, Peer

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
    """An operator's hand: commands on ``/operator/cmd_vel`` of a stack, 20 a second, from a thread of its own.

    Args:
        stack: where; its observer publishes.
    """

    def __init__(self, stack: Stack) -> None:
        import threading

        from ..msg import message_type, twist_stamped

        self.command = (0.0, 0.0)
        self._message = twist_stamped
        self._out = stack.observer.publisher("/operator/cmd_vel", message_type("TwistStamped"))
        self._stop = threading.Event()
        self._thread = threading.Thread(target=self._run, name="hand", daemon=True)
        self._thread.start()

    def _run(self) -> None:
        while not self._stop.wait(0.05):
            self._out.publish(self._message(*self.command, time.time_ns()))

    def let_go(self) -> None:
        """Sends nothing any more."""
        self._stop.set()
        self._thread.join(5)
