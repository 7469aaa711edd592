#!/usr/bin/env python3
"""The bus compared with other middleware: latency, throughput and fan-out between processes, in one run.

    python benchmarks/bus.py --json bus.json     (about 12 minutes)
    python benchmarks/bus.py --quick             (about 2 minutes)

All transports send the same frames at the same pace, alternating within one run, so that other load on the machine
affects all of them alike. Latency is measured from before the send call until the receiver has read one byte of every
4096. A transport whose package is missing is "not measured". iceoryx2 and eCAL are not in the `dev` extra (eCAL needs
an older protobuf): `pip install --no-deps --target FOLDER iceoryx2==0.10.0 eclipse_ecal==6.1.1`, with FOLDER in
PYTHONPATH.
"""

from __future__ import annotations

import json
import os
import socket
import statistics
import subprocess
import sys
import tempfile
import time
from collections import defaultdict
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from reporting import parser_for, report

PEER = Path(__file__).with_name("bus_peer.py")
SIZES = {"b100": 100, "k20": 20_000, "k200": 200_000, "m1": 1_200_000, "m5": 5_500_000}
LABELS = {"b100": "100 B", "k20": "20 kB", "k200": "200 kB", "m1": "1.2 MB", "m5": "5.5 MB"}
PERIOD_S = {"b100": 0.01, "k20": 0.01, "k200": 0.02, "m1": 0.035, "m5": 0.07}
FANOUT = 4
QUIET_S = 0.5  # no more messages are expected after this time without one

NAMES = {
    "ours": "Instant IC, bytes",
    "image": "Instant IC, Image to array",
    "zmq": "ZeroMQ ipc (raw)",
    "zenoh_shm": "Zenoh, shared memory",
    "iceoryx2": "iceoryx2",
    "ecal": "eCAL",
    "lcm": "LCM udpm",
}


class Peer:
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
class Pair:
    """Both sides of one transport."""

    pub: Peer
    subs: list[Peer]

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


def free_port() -> int:
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        return int(probe.getsockname()[1])


def addresses(folder: Path) -> dict[str, str]:
    """Address of each transport."""
    return {
        **{name: str(folder / name) for name in ("ours", "image", "iceoryx2", "ecal")},
        "zmq": f"ipc://{folder}/zmq",
        "zenoh_shm": f"tcp/127.0.0.1:{free_port()}",
        "lcm": f"udpm://239.255.76.67:{free_port()}?ttl=0&recv_buf_size=4194304",
    }


def open_pair(transport: str, address: str, topics: dict[str, int], readers: int) -> Pair:
    """Start both sides.

    Raises:
        RuntimeError: the transport is not installed or does not work.
    """
    peers: list[Peer] = []
    try:
        pub = Peer(transport, "pub", topics, address)
        peers.append(pub)
        pub.answer()
        for _ in range(readers):
            peers.append(Peer(transport, "sub", topics, address))
            peers[-1].answer()
        pair = Pair(pub, peers[1:])
        for topic in topics:
            pair.warm_up(topic)
        return pair
    except Exception:
        for peer in peers:
            peer.close()
        raise


def summary(latencies: list[float], sent: int) -> dict[str, Any]:
    """Figures of one table cell."""
    if not latencies:
        return {"p50_us": None, "p99_us": None, "received": 0, "sent": sent}
    ordered = sorted(latencies)
    return {
        "p50_us": round(statistics.median(ordered), 1),
        "p99_us": round(ordered[min(len(ordered) - 1, int(len(ordered) * 0.99))], 1),
        "received": len(ordered),
        "sent": sent,
    }


def measure(transports: list[str], rounds: int, count: int, flood_s: float, note: Any) -> dict[str, Any]:
    """All figures by transport."""
    latency: dict[str, dict[str, list[float]]] = defaultdict(lambda: defaultdict(list))
    sent: dict[str, dict[str, int]] = defaultdict(lambda: defaultdict(int))
    result: dict[str, Any] = {"not_measured": {}, "latency": {}, "throughput": {}, "fanout": {}}
    topics = dict(SIZES)
    with tempfile.TemporaryDirectory(prefix="ic") as folder:
        address = addresses(Path(folder))
        pairs: dict[str, Pair] = {}
        try:
            for transport in transports:
                try:
                    pairs[transport] = open_pair(transport, address[transport], topics, 1)
                except RuntimeError as error:
                    result["not_measured"][transport] = str(error)
                    note(f"{transport}: not measured: {error}")
            for turn in range(rounds):
                for topic in topics:
                    for transport, pair in pairs.items():
                        written, got = pair.send(topic, count, PERIOD_S[topic])
                        latency[transport][topic] += got[0]["latencies_us"]
                        sent[transport][topic] += written["sent"]
                note(f"latency, round {turn + 1} of {rounds}")
        finally:
            for pair in pairs.values():
                pair.close()
        for transport in pairs:
            result["latency"][transport] = {t: summary(latency[transport][t], sent[transport][t]) for t in topics}
        for transport in pairs:
            try:
                result["throughput"][transport] = flood(transport, address[transport], flood_s)
                note(f"throughput, {transport}")
            except RuntimeError as error:
                note(f"{transport}: throughput not measured: {error}")
        gathered: dict[str, list[float]] = defaultdict(list)
        fan_sent: dict[str, int] = defaultdict(int)
        for _ in range(max(1, rounds // 2)):
            for transport in pairs:
                try:
                    pair = open_pair(transport, address[transport], {"m5": SIZES["m5"]}, FANOUT)
                except RuntimeError as error:
                    note(f"{transport}: fan-out not measured: {error}")
                    continue
                try:
                    written, got = pair.send("m5", count, PERIOD_S["m5"])
                finally:
                    pair.close()
                gathered[transport] += [value for g in got for value in g["latencies_us"]]
                fan_sent[transport] += written["sent"] * FANOUT
            note("fan-out")
        result["fanout"] = {t: summary(gathered[t], fan_sent[t]) for t in pairs if t in gathered}
    return result


def flood(transport: str, address: str, seconds: float) -> dict[str, Any]:
    """Throughput by size when the sender never waits."""
    topics = {f"flood_{name}": size for name, size in SIZES.items()}
    pair = open_pair(transport, address, topics, 1)
    try:
        cells = {}
        for topic in topics:
            written, got = pair.send(topic, 10**9, 0.0, seconds)
            took = max(written["seconds"], got[0]["seconds"])
            cells[topic.removeprefix("flood_")] = {
                "mb_per_s": round(got[0]["bytes"] / took / 1e6, 1),
                "messages_per_s": round(got[0]["count"] / took),
                "delivered": round(got[0]["count"] / max(1, written["sent"]), 4),
            }
        return cells
    finally:
        pair.close()


def verdicts(result: dict[str, Any]) -> dict[str, Any]:
    """Check the targets, each with its figure."""
    latency = result["latency"]

    def p50(transport: str, topic: str) -> float | None:
        return latency.get(transport, {}).get(topic, {}).get("p50_us")

    found: dict[str, Any] = {}
    for rival, topic, most in (("zmq", "k20", 1.15), ("zmq", "m5", 0.8), ("zenoh_shm", "m5", 0.5)):
        if (value := p50(rival, topic)) and (own := p50("ours", topic)):
            found[f"p50 at {LABELS[topic]} over {NAMES[rival]}"] = {"ratio": round(own / value, 2), "at most": most}
    return found


def table(result: dict[str, Any]) -> str:
    """Format the figures as Markdown."""
    lines = ["| p50 / p99 in µs | " + " | ".join(LABELS.values()) + " | 5.5 MB to four |", "|---" * 7 + "|"]
    for transport, name in NAMES.items():
        if transport not in result["latency"]:
            if transport in result["not_measured"]:
                lines.append(f"| {name} | " + " | ".join(["not measured"] * 6) + " |")
            continue
        cells = [result["latency"][transport][t] for t in SIZES] + [result["fanout"].get(transport, {})]
        words = [f"{c['p50_us']:.0f} / {c['p99_us']:.0f}" if c.get("p50_us") else "not measured" for c in cells]
        lines.append(f"| {name} | " + " | ".join(words) + " |")
    lines += ["", "| Flat out, MB/s (share delivered) | " + " | ".join(LABELS.values()) + " |", "|---" * 6 + "|"]
    for transport, cells in result["throughput"].items():
        words = [f"{c['mb_per_s']:.0f} ({c['delivered']:.0%})" for c in cells.values()]
        lines.append(f"| {NAMES[transport]} | " + " | ".join(words) + " |")
    return "\n".join(lines)


def main() -> int:
    parser = parser_for(__doc__)
    parser.add_argument("--quick", action="store_true", help="fewer messages")
    parser.add_argument(
        "--only",
        nargs="+",
        choices=list(NAMES),
        default=list(NAMES),
        metavar="TRANSPORT",
        help=", ".join(NAMES),
    )
    args = parser.parse_args()
    started = time.monotonic()

    def note(text: str) -> None:
        print(f"{time.monotonic() - started:5.0f} s  {text}", file=sys.stderr, flush=True)

    rounds, count, flood_s = (2, 40, 0.5) if args.quick else (6, 100, 2.0)
    result = {
        "cores": os.cpu_count(),
        "load_before": os.getloadavg()[0],
        **measure(args.only, rounds, count, flood_s, note),
        "load_after": os.getloadavg()[0],
    }
    result["targets"] = verdicts(result)
    report(result, args.json)
    print(table(result), file=sys.stderr)
    return 0


if __name__ == "__main__":
    sys.exit(main())
