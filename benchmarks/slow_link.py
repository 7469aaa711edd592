#!/usr/bin/env python3
"""Measures how long a large version of the virtual space delays the driver's round trip on a slow link; prints JSON.

    python benchmarks/slow_link.py [--megabit 10] [--delay-ms 20] [--kilobytes 1400]

The page's server and a client, with a proxy between them that passes on so many bits a second to the client, after a
queue of 64 kB. ``idle``: before the layers are sent; ``loading``: until they have arrived. The page takes a second
without any message for a lost link.
"""

from __future__ import annotations

import argparse
import asyncio
import contextlib
import functools
import json
import statistics
import time
from typing import Any

import numpy as np

from instant_ic.console import ConsoleClient, ConsoleServer, FrameKind, ServerConfig
from instant_ic.console.layers import PageLayer, PageLayers

QUEUE = 64 * 1024
TIMEOUT_S = 120.0


class Nobody:
    """Backend that does nothing."""

    def __getattr__(self, name: str) -> Any:
        return lambda *args: None


def layers(size: int) -> PageLayers:
    corners = np.array([[0, 0], [0, 1], [1, 0]], np.uint16)
    triangle = np.array([[0, 1, 2]], np.uint32)
    image = np.random.default_rng(0).bytes(size)
    layer = PageLayer(image, b"", (1.0, 1.0, 1.0), np.eye(4), (2, 4), corners, np.ones(3, np.float32), triangle)
    return PageLayers(1, (0.0, 0.0, 1.2), (layer,))


async def proxied(port: int, bytes_per_s: float, delay_s: float) -> asyncio.Server:
    """A slow way to a port of this machine."""

    async def fast(reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        while data := await reader.read(4096):
            await asyncio.sleep(delay_s)
            writer.write(data)
            await writer.drain()
        writer.close()

    async def slow(reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        while data := await reader.read(4096):
            await asyncio.sleep(len(data) / bytes_per_s)
            asyncio.get_running_loop().call_later(delay_s, writer.write, data)

    async def connect(reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        there, back = await asyncio.open_connection("127.0.0.1", port, limit=QUEUE // 2)
        with contextlib.suppress(asyncio.CancelledError):  # asyncio's streams would report the end as an error
            await asyncio.gather(fast(reader, back), slow(there, writer), return_exceptions=True)

    return await asyncio.start_server(connect, "127.0.0.1", 0)


def answered(sent: float, client: ConsoleClient) -> bool:
    """Whether the ping of that time has its answer."""
    return bool(client.messages.get("pong", {}).get("client_ms", 0.0) >= sent)


async def measure(server: ConsoleServer, args: argparse.Namespace) -> dict[str, Any]:
    proxy = await proxied(server.port, args.megabit * 1e6 / 8, args.delay_ms / 2000)
    port = proxy.sockets[0].getsockname()[1]
    trips: list[float] = []
    async with ConsoleClient(f"http://127.0.0.1:{port}/") as client:

        async def watch() -> None:
            while True:
                sent = time.monotonic() * 1000 + 0.5
                await client.send({"type": "ping", "client_ms": sent})
                await client.wait_for(functools.partial(answered, sent), TIMEOUT_S)
                trips.append(time.monotonic() * 1000 - sent)
                await asyncio.sleep(0.03)

        watcher = asyncio.create_task(watch())
        await asyncio.sleep(2)
        idle, start = len(trips), time.monotonic()
        server.send_layers(layers(args.kilobytes * 1000))
        await client.wait_for(lambda c: FrameKind.LAYERS in c.frames, TIMEOUT_S)
        loaded_s = time.monotonic() - start
        await asyncio.sleep(0.2)
        watcher.cancel()
    proxy.close()

    def figures(values: list[float]) -> dict[str, float]:
        return {"p50_ms": round(statistics.median(values), 1), "max_ms": round(max(values), 1)}

    return {"idle": figures(trips[:idle]), "loading": figures(trips[idle:]), "loaded_s": round(loaded_s, 2)}


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--megabit", type=float, default=10.0, help="a second, towards the page (default 10)")
    parser.add_argument("--delay-ms", type=float, default=20.0, help="of the link, there and back (default 20)")
    parser.add_argument("--kilobytes", type=int, default=1400, help="of the layers (default 1400)")
    args = parser.parse_args()
    server = ConsoleServer(Nobody(), ServerConfig(port=0))
    server.start()
    try:
        print(json.dumps(vars(args) | asyncio.run(measure(server, args)), indent=2))
    finally:
        server.stop()


if __name__ == "__main__":
    main()
