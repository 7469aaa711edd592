#!/usr/bin/env python3
"""The bus compared with other middleware: latency and fan-out between processes, in one run.

    python benchmarks/bus.py --json bus.json     (about 12 minutes)
    python benchmarks/bus.py --quick             (about 2 minutes)

All transports send the same frames at the same pace, alternating within one run, so that other load on the machine
affects all of them alike. Latency is measured from before the send call until the receiver has read one byte of every
4096. A transport whose package is missing is "not measured".
"""

from __future__ import annotations

import contextlib
import multiprocessing
import os
import tempfile
import time
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import bus_transports
from bus_transports import Receiver
from reporting import note, parser_for, report, summary

from instant_ic.experiments.stack import free_port

SIZES = {"b100": 100, "k20": 20_000, "k200": 200_000, "m1": 1_200_000, "m5": 5_500_000}
PERIOD_S = {"b100": 0.01, "k20": 0.01, "k200": 0.02, "m1": 0.035, "m5": 0.07}
FANOUT = 4
QUIET_S = 0.5
"""Seconds without a message after which no more messages are expected."""
NAMES = {
    "ours": "Instant IC, bytes",
    "image": "Instant IC, Image to array",
    "zmq": "ZeroMQ ipc (raw)",
    "zenoh_shm": "Zenoh, shared memory",
    "lcm": "LCM udpm",
}


class BusPeer:
    """A process that sends or receives (benchmarks/bus_transports.py)."""

    def __init__(self, role: str, transport: str, topics: dict[str, int], address: str) -> None:
        context = multiprocessing.get_context("spawn")
        self._channel, theirs = context.Pipe()
        target = getattr(bus_transports, role)
        self._process = context.Process(target=target, args=(theirs, transport, topics, address), daemon=True)
        self._process.start()
        theirs.close()

    def answer(self) -> Any:
        """Return the process's next answer.

        Raises:
            RuntimeError: the process has failed.
        """
        try:
            found = self._channel.recv()
        except EOFError:
            raise RuntimeError("the process ended without an answer") from None
        if isinstance(found, Exception):
            raise RuntimeError(f"{type(found).__name__}: {found}")
        return found

    def ask(self, question: Any) -> Any:
        """Send a question and return its answer."""
        self._channel.send(question)
        return self.answer()

    def close(self) -> None:
        """Kill the process."""
        self._process.kill()
        self._process.join(10)


@dataclass
class PeerPair:
    """Both sides of one transport."""

    pub: BusPeer
    subs: list[BusPeer]

    def send(self, topic: str, count: int, period_s: float) -> list[Receiver]:
        """Send frames, wait until all have arrived, and return each reader's receiver."""
        self.pub.ask((topic, count, period_s))
        quiet_s, before = time.monotonic() + QUIET_S, 0
        while time.monotonic() < quiet_s:
            counts = [sub.ask("count") for sub in self.subs]
            if min(counts) >= count:
                break
            if sum(counts) > before:
                quiet_s, before = time.monotonic() + QUIET_S, sum(counts)
            time.sleep(0.05)
        return [sub.ask("all") for sub in self.subs]

    def warm_up(self, topic: str) -> None:
        """Wait until every reader receives from the publisher.

        Raises:
            RuntimeError: a reader receives nothing.
        """
        heard = [False] * len(self.subs)
        deadline = time.monotonic() + 20.0
        while not all(heard):
            if time.monotonic() > deadline:
                raise RuntimeError(f"no frame arrived on {topic}")
            got = self.send(topic, 5, 0.03)
            heard = [h or bool(one.latencies_us) for h, one in zip(heard, got, strict=True)]

    def close(self) -> None:
        """Kill both sides."""
        for peer in (self.pub, *self.subs):
            peer.close()


def addresses(folder: Path) -> dict[str, str]:
    """Return the address of each transport."""
    return {
        **{name: str(folder / name) for name in ("ours", "image")},
        "zmq": f"ipc://{folder}/zmq",
        "zenoh_shm": f"tcp/127.0.0.1:{free_port()}",
        "lcm": f"udpm://239.255.76.67:{free_port()}?ttl=0&recv_buf_size=4194304",
    }


def open_pair(transport: str, address: str, topics: dict[str, int], readers: int) -> PeerPair:
    """Start both sides.

    Raises:
        RuntimeError: the transport is not installed or does not work.
    """
    peers = [BusPeer(role, transport, topics, address) for role in ("publish", *["receive"] * readers)]
    try:
        for peer in peers:
            peer.answer()
        pair = PeerPair(peers[0], peers[1:])
        for topic in topics:
            pair.warm_up(topic)
        return pair
    except Exception:
        for peer in peers:
            peer.close()
        raise


def measure(transports: list[str], rounds: int, count: int) -> dict[str, Any]:
    """Return all figures by transport."""
    result: dict[str, Any] = {"not_measured": {}, "latency": {}, "fanout": {}}
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
        result["fanout"] = fanout({name: address[name] for name in pairs}, max(1, rounds // 2), count)
    return result


def latencies(pairs: dict[str, PeerPair], rounds: int, count: int) -> dict[str, Any]:
    """Return the latencies by transport and size; the transports take turns."""
    gathered: dict[str, dict[str, list[float]]] = {name: {size: [] for size in SIZES} for name in pairs}
    for turn in range(rounds):
        for topic in SIZES:
            for name, pair in pairs.items():
                (got,) = pair.send(topic, count, PERIOD_S[topic])
                gathered[name][topic] += got.latencies_us
        note(f"latency, round {turn + 1} of {rounds}")
    return {name: {size: summary(values, "us") for size, values in sizes.items()} for name, sizes in gathered.items()}


def fanout(address: dict[str, str], rounds: int, count: int) -> dict[str, Any]:
    """Return the latencies of the largest frames to several readers, by transport."""
    gathered: dict[str, list[float]] = {name: [] for name in address}
    for _ in range(rounds):
        for name in address:
            try:
                with contextlib.closing(open_pair(name, address[name], {"m5": SIZES["m5"]}, FANOUT)) as pair:
                    got = pair.send("m5", count, PERIOD_S["m5"])
            except RuntimeError as error:
                note(f"{name}: fan-out not measured: {error}")
                continue
            gathered[name] += [value for one in got for value in one.latencies_us]
        note("fan-out")
    return {name: summary(values, "us") for name, values in gathered.items()}


def main() -> None:
    parser = parser_for(__doc__)
    parser.add_argument("--quick", action="store_true", help="fewer messages")
    everything = list(NAMES)
    text = "; ".join(f"{key}: {name}" for key, name in NAMES.items())
    parser.add_argument("--only", nargs="+", choices=everything, default=everything, metavar="TRANSPORT", help=text)
    args = parser.parse_args()
    rounds, count = (2, 40) if args.quick else (6, 100)
    result = {
        "cores": os.cpu_count(),
        "load_before": os.getloadavg()[0],
        **measure(args.only, rounds, count),
        "load_after": os.getloadavg()[0],
    }
    report(result, args.json)


if __name__ == "__main__":
    main()
