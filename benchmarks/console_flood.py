"""Effect of other clients on the driver: round trip and emergency stop, with and without a flood.

    python benchmarks/console_flood.py                  # 20 clients that send pings as fast as they can
    python benchmarks/console_flood.py --flood limit    # 20 clients that stay just within the limit of a socket
    python benchmarks/console_flood.py --flood http     # 20 clients that request the page as fast as they can
    python benchmarks/console_flood.py --flood connect  # 20 clients that connect as fast as they can

Server, driver and flood are three processes. The flood comes from 127.0.0.2, the driver from 127.0.0.1; ``--same``
floods from the driver's address. A disconnected client reconnects at once. Round trip: ping to pong, 20 Hz, as the page
measures it. Stop: from the driver's ``estop`` (``--post``: ``POST /estop`` on a new connection) until it is on the
topic, by the machine's monotonic clock. Output is JSON in milliseconds; ``ratio`` is flood over quiet.
"""

from __future__ import annotations

import asyncio
import contextlib
import multiprocessing
import os
import time
from multiprocessing.connection import Connection
from typing import Any

import aiohttp
import numpy as np
from reporting import parser_for, report

from instant_ic.console import ConsoleClient, ConsoleServer, ConsoleServerConfig
from instant_ic.console.access import AccessConfig
from instant_ic.console.drive import DriveConfig

ELSEWHERE = "127.0.0.2"
PING = b'{"type":"ping","client_ms":0}'


class Patient(DriveConfig):
    """Takes time-outs that no robot may have, so that a busy machine does not trip them."""

    def __post_init__(self) -> None:
        pass


PATIENT = Patient(watchdog_s=30.0, lease_timeout_s=60.0, beat_timeout_s=30.0, max_command_age_s=60.0)


class Backend:
    """Records when emergency stops reach the topic; ignores the operator's other actions."""

    def __init__(self) -> None:
        self.stops_s: list[float] = []

    def on_estop(self, stop: bool) -> None:
        """Record the time at which the node would publish."""
        if stop:
            self.stops_s.append(time.monotonic())

    def __getattr__(self, name: str) -> Any:
        return lambda *args: None


def serve(channel: Connection, max_clients: int) -> None:
    """Server process: sends its port, and at the end the times of the stops."""
    backend: Any = Backend()
    access = AccessConfig(simulated=True)
    server = ConsoleServer(backend, ConsoleServerConfig(port=0, max_clients=max_clients, drive=PATIENT, access=access))
    server.start()
    for n in range(4):  # data of a running stack, which a new client gets at once
        server.publish(f"state{n}", {"filler": "x" * 400})
    channel.send(server.port)
    channel.recv()
    channel.send(backend.stops_s)
    server.stop()


def flood(channel: Connection, port: int, kind: str, clients: int, address: str) -> None:
    """Flood process: runs until the channel ends it; returns how much it sent and how often it was disconnected."""
    counts = {"sent": 0, "cut_off": 0}
    os.nice(19)  # on a real network, the flood would not cost this machine's time

    async def one() -> None:
        while True:
            try:
                reader, writer = await asyncio.open_connection("127.0.0.1", port, local_addr=(address, 0))
            except OSError:
                counts["cut_off"] += 1
                await asyncio.sleep(0.001)
                continue
            try:
                await send(reader, writer)
            except (OSError, asyncio.IncompleteReadError):
                counts["cut_off"] += 1
            finally:
                writer.close()
            await asyncio.sleep(0.001)

    async def send(reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        head = f"HTTP/1.1\r\nHost: 127.0.0.1:{port}\r\n"
        if kind == "connect":
            return
        if kind == "http":
            batch, period_s = f"GET / {head}\r\n".encode() * 10, 0.001
        else:
            writer.write(
                f"GET /ws {head}Upgrade: websocket\r\nConnection: Upgrade\r\nSec-WebSocket-Version: 13\r\n"
                "Sec-WebSocket-Key: MDEyMzQ1Njc4OWFiY2RlZg==\r\n\r\n".encode()
            )
            if b" 101 " not in await reader.readuntil(b"\r\n\r\n"):
                raise ConnectionError("refused")
            ping = bytes([0x81, 0x80 | len(PING)]) + bytes(4) + PING
            batch, period_s = (ping * 29, 0.1) if kind == "limit" else (ping * 100, 0.001)
        drain = asyncio.create_task(empty(reader))
        try:
            while not drain.done():
                writer.write(batch)
                counts["sent"] += 1
                await writer.drain()
                await asyncio.sleep(period_s)
        finally:
            drain.cancel()
        raise ConnectionError("cut off")

    async def empty(reader: asyncio.StreamReader) -> None:
        with contextlib.suppress(OSError):
            while await reader.read(1 << 16):
                pass

    async def run() -> None:
        asyncio.get_running_loop().set_exception_handler(lambda *_: None)  # disconnections are expected
        tasks = [asyncio.create_task(one()) for _ in range(clients)]
        await asyncio.to_thread(channel.recv)
        for task in tasks:
            task.cancel()

    asyncio.run(run())
    channel.send(counts)


async def post_stop(port: int) -> bool:
    """Stop by a new connection; False: it was refused."""
    try:
        async with aiohttp.ClientSession() as http, http.post(f"http://127.0.0.1:{port}/estop") as response:
            return response.status == 204
    except aiohttp.ClientError:
        return False


async def drive(port: int, seconds: float, post: bool) -> tuple[list[float], list[float], int]:
    """Round trips in seconds, the times at which emergency stops were sent, and how many were refused."""
    trips, stops, refused = [], [], 0
    async with ConsoleClient(f"http://127.0.0.1:{port}/") as driver:
        await driver.acquire()
        driver._tasks.pop().cancel()  # stop the client's own heartbeat; this function sends it
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
                if not post:
                    await driver.estop()
                elif not await post_stop(port):
                    stops.pop()
                    refused += 1
                await driver.release_estop()
            await asyncio.sleep(max(0.0, 0.05 - (time.monotonic() - sent_s)))
    return trips, stops, refused


def summary(values_s: Any) -> dict[str, float]:
    """Median, 99th percentile and maximum, ms."""
    values_ms = 1000 * np.asarray(values_s)
    return {
        "p50_ms": round(float(np.median(values_ms)), 2),
        "p99_ms": round(float(np.percentile(values_ms, 99)), 2),
        "worst_ms": round(float(values_ms.max()), 2),
    }


def measure(kind: str | None, clients: int, seconds: float, address: str, post: bool) -> dict[str, Any]:
    """One run, with a flood of ``kind`` or without."""
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
        trips, sent, result["refused_stops"] = asyncio.run(drive(port, seconds, post))
        if kind is not None:
            flood_ours.send(None)
            result["flood"] = flood_ours.recv()
            attack.join(10)
        ours.send(None)
        came = ours.recv()
        assert len(came) == len(sent), f"{len(sent)} stops were sent, {len(came)} came"
        result |= {"round_trip": summary(trips), "pings": len(trips), "stops": len(sent)}
        result["stop"] = summary(np.subtract(came, sent)) if sent else {}
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
    parser.add_argument("--post", action="store_true", help="stop by a POST /estop on a new connection")
    args = parser.parse_args()
    quiet = measure(None, args.clients, args.seconds, ELSEWHERE, args.post)
    flooded = measure(args.flood, args.clients, args.seconds, "127.0.0.1" if args.same else ELSEWHERE, args.post)
    ratio = {
        what: {key: round(value / quiet[what][key], 2) for key, value in flooded[what].items() if quiet[what]}
        for what in ("round_trip", "stop")
    }
    about = {"flood_by": args.flood, "clients": args.clients, "load": os.getloadavg()[0]}
    report(about | {"quiet": quiet, "under_flood": flooded, "ratio": ratio}, args.json)


if __name__ == "__main__":
    main()
