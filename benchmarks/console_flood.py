#!/usr/bin/env python3
"""Effect of other clients on the driver: round trip and emergency stop, with and without a flood; prints JSON.

    python benchmarks/console_flood.py                  # 20 clients that send pings as fast as they can
    python benchmarks/console_flood.py --flood limit    # 20 clients that stay just within the limit of a socket
    python benchmarks/console_flood.py --flood http     # 20 clients that request the page as fast as they can
    python benchmarks/console_flood.py --flood connect  # 20 clients that connect as fast as they can

Server, driver and flood are three processes. The flood comes from 127.0.0.2, the driver from 127.0.0.1; ``--same``
floods from the driver's address. A disconnected client reconnects at once. Round trip: ping to pong, 20 Hz, as the page
measures it. Stop: from the driver's ``estop`` until it is on the topic, by the machine's monotonic clock.
"""

from __future__ import annotations

import asyncio
import contextlib
import multiprocessing
import os
import time
from multiprocessing.connection import Connection
from typing import Any

from reporting import parser_for, report, summary

from instant_ic.console import ConsoleBackend, ConsoleClient, ConsoleServer, ConsoleServerConfig
from instant_ic.console.access import AccessConfig
from instant_ic.console.drive import DriveConfig

ELSEWHERE = "127.0.0.2"
PING = b'{"type":"ping","client_ms":0}'


class Patient(DriveConfig):
    """Time-outs so long that a busy machine does not trip them; no robot may have them."""

    def __post_init__(self) -> None:
        pass


PATIENT = Patient(watchdog_s=30.0, lease_timeout_s=60.0, beat_timeout_s=30.0, max_command_age_s=60.0)


class StopRecorder(ConsoleBackend):
    """A backend of the console that records emergency stops and ignores the operator's other actions."""

    def __init__(self) -> None:
        self.stops_s: list[float] = []

    def on_estop(self, stop: bool) -> None:
        """Record the time at which the node would publish."""
        if stop:
            self.stops_s.append(time.monotonic())


def serve(channel: Connection, max_clients: int) -> None:
    """Run the server process; send its port, and at the end the times of the stops."""
    backend = StopRecorder()
    access = AccessConfig(simulated=True)
    server = ConsoleServer(backend, ConsoleServerConfig(port=0, max_clients=max_clients, drive=PATIENT, access=access))
    server.start()
    for n in range(4):  # data of a running stack, which a new client gets at once
        server.publish(f"state{n}", {"filler": "x" * 400})
    channel.send(server.port)
    channel.recv()
    channel.send(backend.stops_s)
    server.stop()


class Flood:
    """Hostile clients that connect again whenever they are disconnected.

    Attributes:
        counts: batches sent, and disconnections.
    """

    def __init__(self, port: int, kind: str, address: str) -> None:
        self.counts = {"sent": 0, "cut_off": 0}
        self._port, self._kind, self._address = port, kind, address

    async def one_client(self) -> None:
        """Connect and send until cancelled."""
        while True:
            with contextlib.suppress(OSError, asyncio.IncompleteReadError):
                reader, writer = await asyncio.open_connection("127.0.0.1", self._port, local_addr=(self._address, 0))
                try:
                    await self._send(reader, writer)
                finally:
                    writer.close()
            self.counts["cut_off"] += self._kind != "connect"
            await asyncio.sleep(0.001)

    async def _send(self, reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        head = f"HTTP/1.1\r\nHost: 127.0.0.1:{self._port}\r\n"
        if self._kind == "connect":
            return
        if self._kind == "http":
            batch, period_s = f"GET / {head}\r\n".encode() * 10, 0.001
        else:
            writer.write(
                f"GET /ws {head}Upgrade: websocket\r\nConnection: Upgrade\r\nSec-WebSocket-Version: 13\r\n"
                "Sec-WebSocket-Key: MDEyMzQ1Njc4OWFiY2RlZg==\r\n\r\n".encode()
            )
            if b" 101 " not in await reader.readuntil(b"\r\n\r\n"):
                return
            ping = bytes([0x81, 0x80 | len(PING)]) + bytes(4) + PING
            batch, period_s = (ping * 29, 0.1) if self._kind == "limit" else (ping * 100, 0.001)
        answers = asyncio.create_task(discard(reader))
        try:
            while not answers.done():
                writer.write(batch)
                self.counts["sent"] += 1
                await writer.drain()
                await asyncio.sleep(period_s)
        finally:
            answers.cancel()


async def discard(reader: asyncio.StreamReader) -> None:
    """Read until the connection ends."""
    with contextlib.suppress(OSError):
        while await reader.read(1 << 16):
            pass


def flood(channel: Connection, port: int, kind: str, clients: int, address: str) -> None:
    """Run the flood process until the channel ends it; send its counts."""
    os.nice(19)  # on a real network, the flood would not cost this machine's time
    attack = Flood(port, kind, address)

    async def run() -> None:
        asyncio.get_running_loop().set_exception_handler(lambda *_: None)  # disconnections are expected
        tasks = [asyncio.create_task(attack.one_client()) for _ in range(clients)]
        await asyncio.to_thread(channel.recv)
        for task in tasks:
            task.cancel()

    asyncio.run(run())
    channel.send(attack.counts)


async def drive(port: int, seconds: float) -> tuple[list[float], list[float]]:
    """Drive; return round trips in seconds, and the times at which emergency stops were sent."""
    trips, stops = [], []
    async with ConsoleClient(f"http://127.0.0.1:{port}/") as driver:
        await driver.acquire()
        driver.silence()  # this function sends the heartbeat
        end_s = time.monotonic() + seconds
        while time.monotonic() < end_s:
            sent_s = time.monotonic()
            driver.messages.pop("pong", None)
            await driver.send({"type": "ping", "client_ms": sent_s * 1000})
            await driver.wait_for(lambda c: "pong" in c.messages, 30)
            assert driver.round_trip_s is not None
            trips.append(driver.round_trip_s)
            if len(trips) % 5 == 0:
                stops.append(time.monotonic())
                await driver.estop()
                await driver.release_estop()
            await asyncio.sleep(max(0.0, 0.05 - (time.monotonic() - sent_s)))
    return trips, stops


def measure(kind: str | None, clients: int, seconds: float, address: str) -> dict[str, Any]:
    """Run driver and server, with a flood of ``kind`` or without one."""
    context = multiprocessing.get_context("spawn")
    ours, theirs = context.Pipe()
    server = context.Process(target=serve, args=(theirs, clients + 4), daemon=True)
    server.start()
    port = ours.recv()
    result: dict[str, Any] = {}
    try:
        if kind is not None:
            flood_ours, flood_theirs = context.Pipe()
            attack = context.Process(target=flood, args=(flood_theirs, port, kind, clients, address), daemon=True)
            attack.start()
            time.sleep(2.0)
        trips, sent = asyncio.run(drive(port, seconds))
        if kind is not None:
            flood_ours.send(None)
            result["flood"] = flood_ours.recv()
            attack.join(10)
        ours.send(None)
        came = ours.recv()
        assert len(came) == len(sent), f"{len(sent)} stops were sent, {len(came)} came"
        waits = [1000 * (at - since) for at, since in zip(came, sent, strict=True)]
        result |= {"round_trip": summary([1000 * trip for trip in trips]), "stop": summary(waits)}
    finally:
        server.join(10)
        server.kill()
    return result


def main() -> None:
    parser = parser_for(__doc__)
    parser.add_argument("--flood", choices=("pings", "limit", "http", "connect"), default="pings")
    parser.add_argument("--clients", type=int, default=20)
    parser.add_argument("--seconds", type=float, default=20.0)
    parser.add_argument("--same", action="store_true", help="flood from the driver's own address")
    args = parser.parse_args()
    quiet = measure(None, args.clients, args.seconds, ELSEWHERE)
    flooded = measure(args.flood, args.clients, args.seconds, "127.0.0.1" if args.same else ELSEWHERE)
    about = {"flood_by": args.flood, "clients": args.clients, "load": os.getloadavg()[0]}
    report(about | {"quiet": quiet, "under_flood": flooded}, args.json)


if __name__ == "__main__":
    main()
