"""Clients that flood, hold connections or do not read: what they cost others. Counts and order, not speed."""

import asyncio
import contextlib
import json
import logging
import ssl
import subprocess
import sys
import textwrap
import threading
from collections import Counter
from types import SimpleNamespace

import aiohttp
import pytest
from aiohttp import WSMsgType
from console_servers import DRIVE, WAIT_S, WATCH, token_file, until
from test_console_access import certificate

from instant_ic.bus.clock import ManualClock
from instant_ic.console import ConsoleClient, ConsoleServerConfig, FrameKind
from instant_ic.console import connections as connections_module
from instant_ic.console.connections import LogRate
from instant_ic.console.faults import MOST_NAMES, FaultList
from instant_ic.console.pages import WATCHER_SHARE
from instant_ic.util.web_access import AddressBuckets, TokenBucket, network_of

__all__ = ["certificate"]  # a fixture
PING = b'{"type":"ping","client_ms":0}'
TEXT, CONTINUATION, PING_FRAME = 0x1, 0x0, 0x9
ELSEWHERE = ("127.0.0.2", 0)  # another address on this machine


def frame(payload, opcode=TEXT, fin=True):
    """A client's WebSocket frame, masked by zeros."""
    assert len(payload) < 126
    return bytes([(fin << 7) | opcode, 0x80 | len(payload)]) + bytes(4) + payload


async def raw_socket(server, local=None):
    """A WebSocket without a library, which would hold back what it sends."""
    reader, writer = await asyncio.open_connection("127.0.0.1", server.port, local_addr=local)
    writer.write(
        f"GET /ws HTTP/1.1\r\nHost: 127.0.0.1:{server.port}\r\nUpgrade: websocket\r\nConnection: Upgrade\r\n"
        "Sec-WebSocket-Version: 13\r\nSec-WebSocket-Key: MDEyMzQ1Njc4OWFiY2RlZg==\r\n\r\n".encode()
    )
    assert b" 101 " in await reader.readuntil(b"\r\n\r\n")
    return reader, writer


async def frames_of(reader):
    """Frames that the server sends, (opcode, payload), until the connection ends."""
    while True:
        try:
            first, length = await reader.readexactly(2)
            if length >= 126:
                length = int.from_bytes(await reader.readexactly(2 if length == 126 else 8), "big")
            yield first & 0x0F, await reader.readexactly(length)
        except (asyncio.IncompleteReadError, ConnectionError):
            return


async def all_of(reader):
    """Return what the server sends until it closes; data that it has not read resets the connection."""
    text = b""
    with contextlib.suppress(ConnectionError):
        while part := await reader.read(4096):
            text += part
    return text


async def count_replies(reader):
    """How many pongs came, and what the closing frame says."""
    pongs, closed = 0, None
    async for opcode, payload in frames_of(reader):
        if opcode == 0x8:
            closed = int.from_bytes(payload[:2], "big"), payload[2:].decode()
            break
        pongs += opcode == 0xA or b'"pong"' in payload
    return pongs, closed


# ---- floods ------------------------------------------------------------------------------------------


def test_a_token_bucket_lets_its_rate_through():
    bucket = TokenBucket(rate=10.0, burst=5.0)
    assert [bucket.take(100.0) for _ in range(7)] == [True] * 5 + [False] * 2
    assert bucket.wait_s() == pytest.approx(0.1)
    assert [bucket.take(100.25) for _ in range(4)] == [True, True, False, False]  # 2.5 came back
    assert bucket.take(1000.0, 5.0) and not bucket.take(1000.0)  # never more than the burst
    buckets = AddressBuckets(1.0, 1.0)
    assert buckets.of("a").take(0.0) and not buckets.of("a").take(0.0) and buckets.of("b").take(0.0)


@pytest.mark.parametrize(
    ("flood", "messages"),
    [
        (frame(PING), True),
        (frame(b"", PING_FRAME), True),  # of the protocol itself
        (frame(b"", CONTINUATION, fin=False) * 200, False),  # of the message begun below: it never comes
    ],
    ids=["pings", "protocol pings", "endless fragments"],
)
async def test_fault_a_flood_closes_its_own_socket_with_a_reason_and_no_other(serve, flood, messages, caplog):
    server = serve(max_messages_per_s=100.0)
    async with ConsoleClient(server.url) as driver:
        await driver.acquire()
        reader, writer = await raw_socket(server)
        replies = asyncio.create_task(count_replies(reader))
        if not messages:
            writer.write(frame(b"", TEXT, fin=False))
        while not replies.done():
            writer.write(flood)
            with contextlib.suppress(TimeoutError, ConnectionError):
                await asyncio.wait_for(writer.drain(), 0.01)
            await asyncio.sleep(0)
        pongs, closed = await replies
        if closed is None:  # what still comes in after the close resets the connection: the frame may be lost
            assert "sends too many messages" in caplog.text
        else:
            assert closed[0] == 1008
            assert closed[1] == "too many messages"
        if messages:
            assert pongs <= 200 + 100 * WAIT_S  # 2 s of them at once, then the rate
        writer.close()
        await driver.wait_for(lambda c: c.session["clients"] == 1)
        assert driver.session["driver"] == "you" and not driver.closed


async def test_the_message_that_is_one_too_many_still_stops_the_robot(serve):
    server = serve(max_messages_per_s=1.0)
    reader, writer = await raw_socket(server)
    writer.write(frame(b'{"type":"estop"}') * 100)
    _, closed = await count_replies(reader)
    assert closed == (1008, "too many messages")
    writer.close()
    assert server.backend.estops == [True]


async def test_fault_an_emergency_stop_waits_behind_other_clients_messages(serve):
    """Each client has one message a turn: between stop and topic comes one of each flooder, not its queue."""
    server = serve(max_messages_per_s=1e6)
    handled, at_the_stop, loops = Counter(), [], []
    handle = server.pages.handle
    server.pages.handle = lambda session, message, now: (
        handled.update([session.number]),
        handle(session, message, now),
    )
    server.backend.on_watched = lambda _: loops.append(asyncio.get_running_loop())
    server.backend.on_estop = lambda stopped: at_the_stop.append(handled.copy())
    held, release, here = asyncio.Event(), threading.Event(), asyncio.get_running_loop()

    async def hold():
        here.call_soon_threadsafe(held.set)
        assert release.wait(WAIT_S)

    flooders = [await raw_socket(server, ELSEWHERE) for _ in range(5)]
    watcher, stopper = await raw_socket(server)
    await until(lambda: len(server.pages.sessions) == 6)
    number = max(server.pages.sessions)
    # On the server's own thread: its turns stand still until all bytes lie in the sockets.
    gate = asyncio.run_coroutine_threadsafe(hold(), loops[0])
    await held.wait()
    for _, writer in flooders:
        writer.write(frame(PING) * 1000)
        await writer.drain()
    stopper.write(frame(b'{"type":"estop"}'))
    await stopper.drain()
    release.set()
    await asyncio.wrap_future(gate)
    await until(lambda: at_the_stop)
    others = [count for client, count in at_the_stop[0].items() if client != number]
    assert sum(others) <= 5 * 3  # of 5000
    assert len(at_the_stop) == 1
    for _, writer in [*flooders, (watcher, stopper)]:
        writer.close()


async def test_an_emergency_stop_comes_by_a_connection_of_its_own(serve):
    server = serve()
    async with ConsoleClient(server.url) as driver, aiohttp.ClientSession() as http:
        await driver.acquire()
        async with http.post(server.url + "estop", headers={"Origin": server.url.rstrip("/")}) as response:
            assert response.status == 204
        await driver.wait_for(lambda c: c.session["estop"])
    assert server.backend.estops == [True]


async def test_fault_a_client_that_does_not_read_grows_the_servers_memory(serve, monkeypatch):
    for limit in ("BYTES_PER_S", "BURST_BYTES"):  # which would close it before
        monkeypatch.setattr(connections_module, limit, 1e9)
    server = serve(max_messages_per_s=1e6)
    async with ConsoleClient(server.url) as driver:
        await driver.acquire()
        _, writer = await raw_socket(server)  # reads nothing from here on
        await until(lambda: len(server.pages.sessions) == 2)
        session = server.pages.sessions[max(server.pages.sessions)]
        while session.number in server.pages.sessions:
            server.send_frame(FrameKind.PANORAMA, {}, bytes(200_000))
            writer.write(frame(PING) * 100)
            with contextlib.suppress(TimeoutError, ConnectionError):
                await asyncio.wait_for(writer.drain(), 0.01)
        assert session.chokes or session.connection.transport is None  # its replies are bounded
        await until(lambda: session.connection.transport is None)  # cut off although it takes no closing frame
        writer.close()
        await driver.wait_for(lambda c: c.session["clients"] == 1)


async def test_fault_requests_whose_clients_have_left_wait_for_ever(serve, monkeypatch):
    """The limits count connections; a client that opens and closes them could leave any number of waiting requests."""
    asked = Counter()

    class Full:
        def take(self, now):
            asked["waiting"] += 1
            return False

        def wait_s(self):
            return 0.01

    monkeypatch.setattr("instant_ic.console.server.AddressBuckets", lambda *_: SimpleNamespace(of=lambda _: Full()))
    server = serve()
    for _ in range(5):
        before = asked["waiting"]
        _, writer = await asyncio.open_connection("127.0.0.1", server.port)
        writer.write(b"GET /ws HTTP/1.1\r\nHost: 127.0.0.1\r\n\r\n")
        await until(lambda before=before: asked["waiting"] > before)
        writer.close()
    before = -1
    while asked["waiting"] > before:  # nobody asks any more
        before = asked["waiting"]
        await asyncio.sleep(0.2)


# ---- connections -------------------------------------------------------------------------------------


def test_fault_another_machines_reports_grow_the_consoles_memory():
    """Each under a new name: they come over the bridge, also from a host that does not drive."""
    clock, most = ManualClock(), MOST_NAMES
    faults = FaultList(clock)
    for number in range(3 * most):
        clock.set(number * 1_000_000)
        name = f"node{number}"
        status = SimpleNamespace(name=f"{name}: link", level=2, message="lost")
        faults.take_diagnoses(SimpleNamespace(status=[status]))
        faults.take_heartbeat(SimpleNamespace(node=name, state=2, cpu_percent=1.0))
    clock.set(1_000_000_000)
    assert len(faults.nodes()) == most
    assert faults.worst()[0]["text"] == "lost"
    late = SimpleNamespace(name="arbiter: control", level=2, message="stopped")
    clock.set(100_000_000_000)
    faults.take_diagnoses(SimpleNamespace(status=[late]))
    assert [fault["text"] for fault in faults.worst()].count("stopped") == 1  # it finds a place


def test_networks_of_addresses():
    assert network_of("10.1.2.3") == "10.1.2.3"
    assert network_of("::ffff:10.1.2.3") == "10.1.2.3"
    assert network_of("2001:db8:1:2:3:4:5:6") == network_of("2001:db8:1:2::9") == "2001:db8:1:2::/64"
    assert network_of("fe80::1%eth0") == "fe80::/64"
    assert network_of("unknown") == "unknown"


@pytest.mark.parametrize("sent", [b"", b"GET / HTTP/1.1\r\nHost: 127.0.0.1\r\n"], ids=["idle", "half-open"])
async def test_fault_idle_connections_starve_the_driver(serve, sent):
    server = serve(max_connections=20, max_connections_per_address=10)
    held = []
    for local in [ELSEWHERE] * 30 + [("127.0.0.3", 0)] * 15:
        reader, writer = await asyncio.open_connection("127.0.0.1", server.port, local_addr=local)
        writer.write(sent)
        held.append((reader, writer))
    async with ConsoleClient(server.url) as driver:
        await driver.acquire()
        listener = server.listener
        assert len(listener.admitted) <= 20
        counts = Counter(connection.network for connection in listener.admitted)
        assert max(counts.values()) <= 10
        # The address that holds them still gets in itself, by its oldest.
        async with aiohttp.ClientSession(connector=aiohttp.TCPConnector(local_addr=ELSEWHERE)) as http:
            async with http.get(server.url + "health") as response:
                assert response.status == 200
        assert not driver.closed
    for _, writer in held:
        writer.close()


async def test_fault_headers_bodies_and_handshakes_take_for_ever(serve, monkeypatch, tmp_path):
    monkeypatch.setattr(connections_module, "HEADERS_S", 0.3)
    monkeypatch.setattr("instant_ic.console.server.HEADERS_S", 0.3)
    server = serve(access={"token_file": token_file(tmp_path, "drive", DRIVE)})
    slow = b"POST /sign-in HTTP/1.1\r\nHost: 127.0.0.1\r\nContent-Type: application/x-www-form-urlencoded\r\n"

    async def trickle(start, more):
        """Sends a byte now and again; returns what the server said until it closed."""
        reader, writer = await asyncio.open_connection("127.0.0.1", server.port)
        writer.write(start)
        answer = asyncio.create_task(all_of(reader))
        while not answer.done():
            writer.write(more)
            await asyncio.wait({answer}, timeout=0.05)
        writer.close()
        return await answer

    assert await trickle(b"GET / HTTP/1.1\r\nX-Slow: ", b"x") == b""
    assert await trickle(b"", b"") == b""
    assert b" 408 " in await trickle(slow + b"Content-Length: 4000\r\n\r\n", b"x")


async def test_fault_a_tls_handshake_takes_for_ever(serve, monkeypatch, certificate):
    monkeypatch.setattr(connections_module, "HEADERS_S", 0.5)
    server = serve(access=certificate)
    reader, writer = await asyncio.open_connection("127.0.0.1", server.port)
    assert await reader.read() == b""
    writer.close()
    await until(lambda: not server.listener.admitted)


async def test_a_page_that_may_only_watch_leaves_places_for_drivers(serve, files):
    server = serve(max_clients=4, access=files)
    async with ConsoleClient(server.url, token=WATCH), ConsoleClient(server.url, token=WATCH):
        with pytest.raises(aiohttp.WSServerHandshakeError) as refused:
            await ConsoleClient(server.url, token=WATCH).connect()
        assert refused.value.status == 503
        async with ConsoleClient(server.url, token=DRIVE) as driver:
            await driver.acquire()


async def test_more_connections_a_second_than_a_page_needs_are_refused_without_a_log_flood(serve, monkeypatch, caplog):
    monkeypatch.setattr(connections_module, "BURST_CONNECTIONS", 5.0)
    monkeypatch.setattr(connections_module, "CONNECTIONS_PER_S", 0.001)
    server = serve()
    with caplog.at_level(logging.WARNING):
        for _ in range(50):
            _, writer = await asyncio.open_connection("127.0.0.1", server.port, local_addr=ELSEWHERE)
            writer.write(b"GET / HTTP/1.1\r\nHost: 127.0.0.1\r\n\r\n")
        await until(lambda: server.listener.refused == 45)
        async with ConsoleClient(server.url) as driver:  # from another address
            await driver.acquire()
    # How many seconds it took, the machine decides: once a second, and 45 at once are one line.
    assert 1 <= sum("refused a connection from 127.0.0.2" in line for line in caplog.messages) < 45


STOP = b"POST /estop HTTP/1.1\r\nHost: 127.0.0.1\r\n"
STRANGERS = {
    "wrong token": STOP + b"Authorization: Bearer wrong\r\n\r\n",
    "none": STOP + b"\r\n",
    "half": STOP,
    "nothing": b"",
}


@pytest.mark.parametrize(("sent", "tls"), [("wrong token", False), ("none", True), ("half", False), ("nothing", True)])
async def test_fault_a_right_stop_is_refused_because_of_strangers_at_its_address(
    serve, monkeypatch, tmp_path, certificate, sent, tls
):
    """Whoever else is behind the same router, or a user of the same machine, opens 15 connections to each stop."""
    monkeypatch.setattr(connections_module, "BURST_CONNECTIONS", 5.0)
    monkeypatch.setattr(connections_module, "CONNECTIONS_PER_S", 1e-5)
    monkeypatch.setattr(connections_module, "BURST_HANDSHAKES", 1e5)
    sent = STRANGERS[sent]
    drive = token_file(tmp_path, "drive", DRIVE)
    server = serve(access={"token_file": drive} | (certificate if tls else {}))
    trusting = ssl.create_default_context(cafile=certificate["tls_certificate"]) if tls else None

    async def stranger():
        with contextlib.suppress(OSError):  # refused
            _, writer = await asyncio.open_connection("127.0.0.1", server.port, ssl=trusting)
            writer.write(sent)
            return writer

    async def answer(request):
        async with aiohttp.ClientSession() as http:  # a new connection
            method, path, headers = request
            given = {"headers": headers, "ssl": trusting or True, "allow_redirects": False}
            async with http.request(method, server.url + path, **given) as response:
                return response.status, response.headers.get("Set-Cookie", "").partition(";")[0]

    held = []
    entered, cookie = await answer(("GET", f"?token={DRIVE}", {}))
    assert entered == 303
    ways = {"Authorization": f"bearer  {DRIVE}"}, {"Cookie": f"other=1; {cookie}; more"}
    for number in range(6):
        held += await asyncio.gather(*(stranger() for _ in range(15)))
        assert (await answer(("POST", "estop", ways[number % 2])))[0] == 204
    assert (await answer(("GET", f"?token={DRIVE}", {})))[0] == 303
    if sent.endswith(b"\r\n\r\n"):
        assert (await answer(("POST", "estop", {"Authorization": "Bearer wrong"})))[0] == 429
        assert (await answer(("GET", "", {})))[0] == 429
    for writer in filter(None, held):
        writer.close()
    assert server.backend.estops == [True] * 6


async def test_without_a_sign_in_only_stops_are_admitted_above_the_rate_of_an_address(serve, monkeypatch):
    monkeypatch.setattr(connections_module, "BURST_CONNECTIONS", 5.0)
    monkeypatch.setattr(connections_module, "CONNECTIONS_PER_S", 1e-5)
    server = serve()

    async def answer(request):
        reader, writer = await asyncio.open_connection("127.0.0.1", server.port)
        writer.write(request)
        status = (await reader.readuntil(b"\r\n"))[9:12]
        writer.close()
        return status

    page = STOP.replace(b"POST /estop", b"GET /") + b"\r\n"
    assert [await answer(page) for _ in range(7)] == [b"200"] * 5 + [b"429"] * 2
    assert [await answer(STOP + b"\r\n") for _ in range(20)] == [b"204"] * 20


async def test_connections_without_complete_headers_are_few_and_small(serve, monkeypatch):
    monkeypatch.setattr(connections_module, "MOST_NEWCOMERS", 10)
    server = serve()
    opened = [await asyncio.open_connection("127.0.0.1", server.port, local_addr=ELSEWHERE) for _ in range(50)]
    ends = [asyncio.create_task(all_of(reader)) for reader, _ in opened]
    await until(lambda: sum(end.done() for end in ends) >= 40)
    other, long = await asyncio.open_connection("127.0.0.1", server.port)
    long.write(b"GET / HTTP/1.1\r\nX: " + bytes(connections_module.MOST_HEADERS))
    assert await all_of(other) == b""
    assert ends[-1].done() is False  # the oldest of the address with the most make room
    for _, writer in [*opened, (other, long)]:
        writer.close()
    await asyncio.gather(*ends)


SERVER_WITHOUT_FILES = """
    import resource, sys
    from instant_ic.console import ConsoleBackend, ConsoleServer, ConsoleServerConfig
    from instant_ic.console.access import AccessConfig
    many = dict(max_connections=1000, max_connections_per_address=1000)
    server = ConsoleServer(ConsoleBackend(), ConsoleServerConfig(port=0, access=AccessConfig(simulated=True), **many))
    server.start()
    resource.setrlimit(resource.RLIMIT_NOFILE, (40, 40))
    print(server.port, flush=True)
    sys.stdin.read()
    server.stop()
"""


async def test_fault_no_file_descriptors_floods_the_log_and_locks_the_driver_out(tmp_path):
    with (tmp_path / "log").open("wb") as log:
        process = subprocess.Popen(
            [sys.executable, "-c", textwrap.dedent(SERVER_WITHOUT_FILES)],
            stdin=subprocess.PIPE, stdout=subprocess.PIPE, stderr=log,
        )  # fmt: skip
    try:
        port = int(process.stdout.readline())
        held = [await asyncio.open_connection("127.0.0.1", port, local_addr=ELSEWHERE) for _ in range(60)]
        await until(lambda: b"cannot accept" in (tmp_path / "log").read_bytes())
        async with ConsoleClient(f"http://127.0.0.1:{port}/") as driver:
            await driver.acquire()
        for _, writer in held:
            writer.close()
    finally:
        process.communicate(timeout=WAIT_S)
    assert process.returncode == 0
    lines = (tmp_path / "log").read_text().splitlines()
    assert 1 <= len(lines) <= 2 * WAIT_S and (tmp_path / "log").stat().st_size < 20_000


def test_log_lines_of_one_place_come_once_a_second_with_a_count():
    now = [0.0]
    rate = LogRate(lambda: now[0])

    def record(line, text="from %s"):
        return logging.LogRecord("asyncio", logging.WARNING, "server.py", line, text, ("a",), None)

    passed = [rate.filter(record(1)) for _ in range(1000)]
    assert passed == [True] + [False] * 999
    assert rate.filter(record(2))
    now[0] = 1.0
    after = record(1)
    assert rate.filter(after) and after.getMessage() == "from a (999 similar messages dropped)"
    now[0] = 2.0
    after = record(1)
    assert rate.filter(after) and after.getMessage() == "from a"


# ---- messages ----------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("kind", "payload", "code"),
    [(WSMsgType.BINARY, b"x", 1003), (WSMsgType.TEXT, b"x" * 5000, 1009), (WSMsgType.TEXT, b"\xff", 1007)],
    ids=["binary", "too long", "no UTF-8"],
)
async def test_messages_that_no_page_sends_close_the_socket(serve, kind, payload, code):
    server = serve()
    async with aiohttp.ClientSession() as http, http.ws_connect(server.url + "ws") as socket:
        await socket.send_frame(payload, kind)
        while (await socket.receive()).type is WSMsgType.TEXT:
            pass
        assert socket.close_code == code


def test_the_page_keeps_within_its_limits():
    """What page and client send at most, by their own periods, with a touch display of 120 Hz."""
    config = ConsoleServerConfig()
    watching = 20 + 2 * 30 + 10  # beats, acknowledgements (which count by their bytes only), looks
    messages_per_s = watching + 120 + 20  # stick, repeated commands
    assert messages_per_s < config.max_messages_per_s
    assert watching < WATCHER_SHARE * config.max_messages_per_s
    longest = len(json.dumps({"type": "drive", "seq": 2**40, "time_ms": 1e12 / 3, "linear": -1 / 3, "angular": 1 / 3}))
    assert messages_per_s * (longest + 8) < connections_module.BYTES_PER_S
