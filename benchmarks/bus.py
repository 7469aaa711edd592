#!/usr/bin/env python3
"""The bus compared with other middleware: latency, throughput and fan-out between processes, in one run.

    python benchmarks/bus.py --json bus.json     (about 12 minutes)
    python benchmarks/bus.py --quick             (about 2 minutes)

All transports send the same frames at the same pace, alternating within one run, so that other load on the machine
affects all of them alike. Latency is measured from before the send call until the receiver has read one byte of every
4096. A transport whose package is missing is "not measured". iceoryx2 is not in the `dev` extra:
`pip install --no-deps --target FOLDER iceoryx2==0.10.0`, with FOLDER in PYTHONPATH.
"""

from __future__ import annotations

import contextlib
import json
import os
import subprocess
import sys
import tempfile
import time
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from reporting import note, parser_for, report, summary

from instant_ic.experiments.stack import free_port

PEER = Path(__file__).with_name("bus_peer.py")
SIZES = {"b100": 100, "k20": 20_000, "k200": 200_000, "m1": 1_200_000, "m5": 5_500_000}
PERIOD_S = {"b100": 0.01, "k20": 0.01, "k200": 0.02, "m1": 0.035, "m5": 0.07}
FANOUT = 4
QUIET_S = 0.5  # no more messages are expected after this time without one

NAMES = {
    "ours": "Instant IC, bytes",
    "image": "Instant IC, Image to array",
    "zmq": "ZeroMQ ipc (raw)",
    "zenoh_shm": "Zenoh, shared memory",
    "iceoryx2": "iceoryx2",
    "lcm": "LCM udpm",
}


class BusPeer:
    """A process of benchmarks/bus_peer.py."""

    def __init__(self, transport: str, role: str, topics: dict[str, int], address: str) -> None:
        wanted = ",".join(f"{name}={size}" for name, size in topics.items())
        self.process = subprocess.Popen(
            [sys.executable, str(PEER), transport, role, wanted, address],
            stdin=subprocess.PIPE, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True,
        )  # fmt: skip

    def answer(self) -> Any:
        assert self.process.stdout is not None
        line = self.process.stdout.readline()
        if not line:
            self.process.kill()
            assert self.process.stderr is not None
            raise RuntimeError(self.process.stderr.read().strip().splitlines()[-1:] or ["ended without a word"])
        return json.loads(line)

    def ask(self, command: dict[str, Any] | None = None) -> Any:
        assert self.process.stdin is not None
        self.process.stdin.write(json.dumps(command or {}) + "\n")
        self.process.stdin.flush()
        return self.answer()

    def close(self) -> None:
        if self.process.poll() is None:
            self.process.kill()
        self.process.wait(10)
        for stream in (self.process.stdin, self.process.stdout, self.process.stderr):
            if stream is not None:
                stream.close()


@dataclass
class PeerPair:
    """Both sides of one transport."""

    pub: BusPeer
    subs: list[BusPeer]

    def send(self, topic: str, count: int, period_s: float, seconds: float = 60.0) -> tuple[dict[str, Any], list[Any]]:
        """Send frames and wait until all expected ones have arrived."""
        sent = self.pub.ask({"topic": topic, "count": count, "period_s": period_s, "seconds": seconds})
        got: list[dict[str, Any]] = [sub.ask() for sub in self.subs]
        quiet_s = time.monotonic() + QUIET_S
        while min(g["count"] for g in got) < sent["sent"] and time.monotonic() < quiet_s:
            time.sleep(0.05)
            more = [sub.ask() for sub in self.subs]
            if any(m["count"] for m in more):
                quiet_s = time.monotonic() + QUIET_S
            got = [joined(g, m) for g, m in zip(got, more, strict=True)]
        return sent, got

    def warm_up(self, topic: str) -> None:
        """Wait until every reader receives from the publisher.

        Raises:
            RuntimeError: a reader does not.
        """
        heard = [False] * len(self.subs)
        deadline = time.monotonic() + 20.0
        while not all(heard):
            if time.monotonic() > deadline:
                raise RuntimeError(f"nothing came on {topic}")
            _, got = self.send(topic, 5, 0.03)
            heard = [h or g["count"] > 0 for h, g in zip(heard, got, strict=True)]

    def close(self) -> None:
        for peer in (self.pub, *self.subs):
            peer.close()


def joined(a: dict[str, Any], b: dict[str, Any]) -> dict[str, Any]:
    """Merge two collections of one receiver."""
    seconds = a["seconds"] + b["seconds"] if a["count"] and b["count"] else a["seconds"] or b["seconds"]
    return {
        "latencies_us": a["latencies_us"] + b["latencies_us"],
        "count": a["count"] + b["count"],
        "bytes": a["bytes"] + b["bytes"],
        "seconds": seconds,
    }


def addresses(folder: Path) -> dict[str, str]:
    """Return the address of each transport."""
    return {
        **{name: str(folder / name) for name in ("ours", "image", "iceoryx2")},
        "zmq": f"ipc://{folder}/zmq",
        "zenoh_shm": f"tcp/127.0.0.1:{free_port()}",
        "lcm": f"udpm://239.255.76.67:{free_port()}?ttl=0&recv_buf_size=4194304",
    }


def open_pair(transport: str, address: str, topics: dict[str, int], readers: int) -> PeerPair:
    """Start both sides.

    Raises:
        RuntimeError: the transport is not installed or does not work.
    """
    peers: list[BusPeer] = []
    try:
        pub = BusPeer(transport, "pub", topics, address)
        peers.append(pub)
        pub.answer()
        for _ in range(readers):
            peers.append(BusPeer(transport, "sub", topics, address))
            peers[-1].answer()
        pair = PeerPair(pub, peers[1:])
        for topic in topics:
            pair.warm_up(topic)
        return pair
    except Exception:
        for peer in peers:
            peer.close()
        raise


def measure(transports: list[str], rounds: int, count: int, flood_s: float) -> dict[str, Any]:
    """Return all figures by transport."""
    result: dict[str, Any] = {"not_measured": {}, "latency": {}, "throughput": {}, "fanout": {}}
    with tempfile.TemporaryDirectory(prefix="ic") as folder:
        address = addresses(Path(folder))
        with contextlib.ExitStack() as ends:
            pairs: dict[str, PeerPair] = {}
            for transport in transports:
                try:
                    pair = open_pair(transport, address[transport], SIZES, 1)
                    pairs[transport] = ends.enter_context(contextlib.closing(pair))
                except RuntimeError as error:
                    result["not_measured"][transport] = str(error)
                    note(f"{transport}: not measured: {error}")
            result["latency"] = latencies(pairs, rounds, count)
        for transport in pairs:
            try:
                result["throughput"][transport] = flood(transport, address[transport], flood_s)
                note(f"throughput, {transport}")
            except RuntimeError as error:
                note(f"{transport}: throughput not measured: {error}")
        result["fanout"] = fanout({name: address[name] for name in pairs}, max(1, rounds // 2), count)
    return result


def latencies(pairs: dict[str, PeerPair], rounds: int, count: int) -> dict[str, Any]:
    """Return the latencies by transport and size; the transports take turns."""
    gathered: dict[str, dict[str, list[float]]] = {name: {size: [] for size in SIZES} for name in pairs}
    for turn in range(rounds):
        for topic in SIZES:
            for name, pair in pairs.items():
                _, got = pair.send(topic, count, PERIOD_S[topic])
                gathered[name][topic] += got[0]["latencies_us"]
        note(f"latency, round {turn + 1} of {rounds}")
    return {name: {size: summary(values, "us") for size, values in sizes.items()} for name, sizes in gathered.items()}


def fanout(address: dict[str, str], rounds: int, count: int) -> dict[str, Any]:
    """Return the latencies of the largest frames to several readers, by transport."""
    gathered: dict[str, list[float]] = {name: [] for name in address}
    for _ in range(rounds):
        for name in address:
            try:
                with contextlib.closing(open_pair(name, address[name], {"m5": SIZES["m5"]}, FANOUT)) as pair:
                    _, got = pair.send("m5", count, PERIOD_S["m5"])
            except RuntimeError as error:
                note(f"{name}: fan-out not measured: {error}")
                continue
            gathered[name] += [value for one in got for value in one["latencies_us"]]
        note("fan-out")
    return {name: summary(values, "us") for name, values in gathered.items()}


def flood(transport: str, address: str, seconds: float) -> dict[str, Any]:
    """Return the throughput by size when the sender never waits."""
    topics = {f"flood_{name}": size for name, size in SIZES.items()}
    cells = {}
    with contextlib.closing(open_pair(transport, address, topics, 1)) as pair:
        for topic in topics:
            written, got = pair.send(topic, 10**9, 0.0, seconds)
            took = max(written["seconds"], got[0]["seconds"])
            cells[topic.removeprefix("flood_")] = {
                "mb_per_s": round(got[0]["bytes"] / took / 1e6, 1),
                "messages_per_s": round(got[0]["count"] / took),
                "delivered": round(got[0]["count"] / max(1, written["sent"]), 4),
            }
    return cells


def main() -> int:
    parser = parser_for(__doc__)
    parser.add_argument("--quick", action="store_true", help="fewer messages")
    everything = list(NAMES)
    text = "; ".join(f"{key}: {name}" for key, name in NAMES.items())
    parser.add_argument("--only", nargs="+", choices=everything, default=everything, metavar="TRANSPORT", help=text)
    args = parser.parse_args()
    rounds, count, flood_s = (2, 40, 0.5) if args.quick else (6, 100, 2.0)
    result = {
        "cores": os.cpu_count(),
        "load_before": os.getloadavg()[0],
        **measure(args.only, rounds, count, flood_s),
        "load_after": os.getloadavg()[0],
    }
    report(result, args.json)
    return 0


if __name__ == "__main__":
    sys.exit(main())
