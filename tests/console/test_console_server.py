"""The server by real sockets: lease, watchdog, origin, emergency stop, slow clients."""

import asyncio
import socket

import aiohttp
import pytest
from console_servers import WAIT_S, Backend, Patient, until

from instant_ic.console import ConsoleClient, ConsoleError, ConsoleServer, ConsoleServerConfig, FrameKind
from instant_ic.console.server import origin_allowed
from instant_ic.util import pace
from instant_ic.util.web_access import host_allowed


def frame_number(client, kind):
    return client.frames[kind].header["n"] if kind in client.frames else None


def motion(backend):
    """Commands other than the keep-alive's zeros."""
    return [command for command in backend.commands if command != (0.0, 0.0)]


def cut(client):
    """End a connection without a closing handshake."""
    client.socket.get_extra_info("socket").shutdown(socket.SHUT_RDWR)


async def test_the_first_page_and_the_end_of_the_last_are_reported(serve):
    server = serve()
    watched = server.backend.watched
    async with ConsoleClient(server.url):
        async with ConsoleClient(server.url):
            assert watched == [True]
        await until(lambda: len(server.pages.sessions) == 1)
        assert watched == [True]
    await until(lambda: watched == [True, False])


async def test_fault_any_client_drives(serve):
    server = serve()
    async with ConsoleClient(server.url) as first, ConsoleClient(server.url) as second:
        await first.acquire()
        await second.send({"type": "lease", "take": False})
        await second.look(1.0)
        await second.send_drive(0.2, 0.0)
        await second.wait_for(lambda c: c.refused == ["not_driver"] and c.session["driver"] == "other", WAIT_S)
        assert motion(server.backend) == [] and server.backend.looks == []
        await first.look(-0.5, 0.1)
        await first.send_drive(0.3, 0.1)
        await server.backend.wait(lambda b: (0.3, 0.1) in b.commands)
        assert [(look.yaw, look.pitch) for look in server.backend.looks] == [(-0.5, 0.1)]
        await second.acquire(take=True)
        await server.backend.wait(lambda b: b.commands[-1] == (0.0, 0.0))
        await first.wait_for(lambda c: c.session["driver"] == "other", WAIT_S)
        await first.send_drive(0.3, 0.1)
        await first.wait_for(lambda c: c.refused == ["not_driver"], WAIT_S)
        await second.send({"type": "yield"})
        await first.wait_for(lambda c: c.session["driver"] == "none", WAIT_S)


async def test_fault_robot_runs_its_last_command_when_its_page_falls_silent(serve):
    server = serve(drive=Patient(watchdog_s=0.25, lease_timeout_s=60.0, max_command_age_s=10.0))
    async with ConsoleClient(server.url) as client:
        await client.acquire()
        await client.send_drive(0.3, 0.0)  # one command, then none
        await until(lambda: server.drive.gate.watchdog_trips == 1)
        await server.backend.wait(lambda b: b.commands[-1] == (0.0, 0.0))
    assert (0.3, 0.0) in server.backend.commands


async def test_the_watchdog_follows_the_pace_of_a_simulation(serve):
    """A busy machine slows the simulation; it must not take the operator's command for lost."""
    pace.use(pace.Pace.from_now(0.02))
    try:
        server = serve(drive=Patient(watchdog_s=0.25, lease_timeout_s=60.0, max_command_age_s=10.0))
        async with ConsoleClient(server.url) as client:
            await client.acquire()
            await client.send_drive(0.3, 0.0)
            await server.backend.wait(lambda b: (0.3, 0.0) in b.commands)
            await asyncio.sleep(0.6)
            assert server.drive.gate.watchdog_trips == 0 and server.backend.commands[-1] == (0.3, 0.0)
    finally:
        pace.use(pace.Pace())


async def test_fault_socket_cut_leaves_the_throttle(serve):
    server = serve()
    client = ConsoleClient(server.url)
    await client.connect()
    await client.acquire()
    await client.send_drive(0.3, 0.0)
    await server.backend.wait(lambda b: b.commands)
    cut(client)  # no closing handshake
    await server.backend.wait(lambda b: b.commands[-1] == (0.0, 0.0))
    await client.close()


def test_a_console_that_starts_again_names_its_clients_anew():
    """Behind a bridge the arbiter notices the restart by these names alone."""
    first, second = (ConsoleServer(Backend(), ConsoleServerConfig(port=0)).drive.client for _ in range(2))
    assert first != second


@pytest.mark.parametrize("how", ["silent", "hidden", "given back", "cut"])
async def test_the_loss_of_the_driver_is_told_at_once(serve, how):
    """Not by the silence alone: that has to last before it counts. The page's beats are made by the test."""
    server = serve()
    async with ConsoleClient(server.url) as client:
        await client.acquire()
        await server.backend.wait(lambda b: b.operator[:1] == [True])
        client.silence()
        await server.backend.wait(lambda b: b.operator[-1] is False)
        if how != "silent":
            told = len(server.backend.operator)
            await client.send({"type": "ping", "client_ms": 0})
            await server.backend.wait(lambda b: len(b.operator) > told)
        if how == "hidden":
            await client.send({"type": "ping", "client_ms": 0, "away": True})
        elif how == "given back":
            await client.send({"type": "yield"})
        elif how == "cut":
            cut(client)
        await server.backend.wait(lambda b: b.operator[-1] is False)
        await client.close()
    # Each turn once.
    assert server.backend.operator == [True, False] * (1 if how == "silent" else 2)


async def test_fault_old_commands_are_obeyed(serve):
    server = serve(drive=Patient(max_command_age_s=5.0, lease_timeout_s=60.0))
    async with ConsoleClient(server.url) as client:
        await client.acquire()
        await client.send_drive(0.3, 0.0, age_s=60.0)
        await client.wait_for(lambda c: c.refused == ["old"], WAIT_S)
        await client.send_drive(0.3, 0.0, age_s=-60.0)
        await client.wait_for(lambda c: c.refused == ["old", "future"], WAIT_S)
    assert motion(server.backend) == []


async def test_emergency_stop_from_a_watcher_is_latched_until_the_driver_releases_it(serve):
    server = serve()
    async with ConsoleClient(server.url) as driver, ConsoleClient(server.url) as watcher:
        await driver.acquire()
        await driver.send_drive(0.3, 0.0)
        await server.backend.wait(lambda b: b.commands)
        await watcher.estop()
        await server.backend.wait(lambda b: b.commands[-1] == (0.0, 0.0) and b.estops == [True])
        await driver.wait_for(lambda c: c.session["estop"], WAIT_S)
        await driver.send_drive(0.3, 0.0)
        await driver.wait_for(lambda c: c.refused == ["stopped"], WAIT_S)
        await watcher.release_estop()
        await watcher.wait_for(lambda c: c.refused == ["not_driver"], WAIT_S)
        assert server.backend.estops == [True]
        await driver.release_estop()
        await server.backend.wait(lambda b: b.estops == [True, False])
    assert server.backend.commands.count((0.3, 0.0)) >= 1


async def test_a_page_shows_who_drives_the_robot_and_not_who_has_this_servers_lease(serve):
    server = serve()
    async with ConsoleClient(server.url) as client, ConsoleClient(server.url) as second:
        server.follow_robot("host_bridge/tablet/console/page 1 abc", False)
        await client.send({"type": "lease", "take": False})
        await server.backend.wait(lambda b: b.commands)  # zeros ask the robot for its lease
        name = server.drive.client
        other = ("other", "host_bridge/tablet/console")
        for one in (client, second):
            await one.wait_for(lambda c: (c.session["driver"], c.session["door"]) == other, WAIT_S)
        await client.send_drive(0.3, 0.0)  # published, so that the arbiter sees that a key is held
        await client.wait_for(lambda c: c.refused == ["not_driver"], WAIT_S)
        await client.release_estop()
        await client.wait_for(lambda c: c.refused == ["not_driver"] * 2, WAIT_S)
        assert server.backend.estops == []
        server.follow_robot(f"console/{name}", False)
        await client.wait_for(lambda c: (c.session["driver"], c.session["door"]) == ("you", ""), WAIT_S)
        await second.wait_for(lambda c: (c.session["driver"], c.session["door"]) == ("other", ""), WAIT_S)
        await second.send({"type": "lease", "take": True})
        await until(lambda: server.backend.released == [name])
        await client.wait_for(lambda c: c.session["driver"] == "other", WAIT_S)
        assert second.session["driver"] == "other"  # until the robot has granted it
        server.follow_robot(f"console/{server.drive.client}", False)
        await second.wait_for(lambda c: c.session["driver"] == "you", WAIT_S)


async def test_a_page_shows_the_robots_emergency_stop_whoever_pressed_or_released_it(serve):
    server = serve()
    async with ConsoleClient(server.url) as client:
        await client.acquire()
        server.follow_robot(f"console/{server.drive.client}", False)
        await client.estop()
        await client.wait_for(lambda c: c.session["estop"], WAIT_S)
        server.follow_robot(f"console/{server.drive.client}", True)
        server.follow_robot(f"console/{server.drive.client}", False)  # another console has released it
        await client.wait_for(lambda c: not c.session["estop"], WAIT_S)
        server.follow_robot(f"console/{server.drive.client}", True)  # and pressed it
        await client.wait_for(lambda c: c.session["estop"], WAIT_S)
        await client.release_estop()
        await server.backend.wait(lambda b: b.estops == [True, False])
        await client.send_drive(0.3, 0.0)
        await client.wait_for(lambda c: c.refused == ["stopped"], WAIT_S)  # the robot has not released it
        assert client.session["estop"]
        server.follow_robot(f"console/{server.drive.client}", False)
        await client.wait_for(lambda c: not c.session["estop"], WAIT_S)


EVIL = "evil.example"


@pytest.mark.parametrize(
    ("method", "path", "headers"),
    [
        ("GET", "ws", {"Origin": f"http://{EVIL}"}),
        ("GET", "ws", {"Origin": "null"}),
        ("GET", "ws", {"Origin": f"http://{EVIL}", "Host": EVIL}),
        ("GET", "", {"Host": EVIL}),
        ("POST", "estop", {"Origin": f"http://{EVIL}"}),
        ("POST", "estop", {"Origin": f"http://{EVIL}", "Host": EVIL}),
    ],
)
async def test_fault_host_or_origin_is_unchecked(serve, method, path, headers):
    """A foreign page may point its own name at 127.0.0.1; its Origin then equals its Host."""
    server = serve()
    async with aiohttp.ClientSession() as http:
        async with http.request(method, server.url + path, headers=headers) as response:
            assert response.status == 403
    assert server.backend.estops == []


@pytest.mark.parametrize(
    ("host", "allowed", "expected"),
    [
        ("localhost:8080", (), True),
        ("127.0.0.1:8080", (), True),
        ("[::1]:8080", (), True),
        ("192.168.1.5", (), True),
        ("robot.local:8080", ("robot.local",), True),
        ("robot.local:8080", (), False),
        ("localhost.evil.example", (), False),
        ("", (), False),
        ("[::1", (), False),
    ],
)
def test_hosts(host, allowed, expected):
    assert host_allowed(host, allowed) is expected


def test_origins():
    assert origin_allowed(None, "a:1")
    assert origin_allowed("http://a:1", "A:1")
    assert not origin_allowed("http://a:2", "a:1")
    assert not origin_allowed("ftp://a:1", "a:1")
    assert not origin_allowed("http://", "")


async def test_pictures_wait_for_the_acknowledgement_and_only_the_newest_is_sent(serve):
    server = serve()
    async with ConsoleClient(server.url, acknowledge=False) as client:
        server.send_frame(FrameKind.PANORAMA, {"n": 0}, b"0")
        await client.wait_for(lambda c: c.frame_counts[FrameKind.PANORAMA] == 1, WAIT_S)
        for n in range(1, 50):
            server.send_frame(FrameKind.PANORAMA, {"n": n}, b"x" * 1000)
        server.publish("state", {"mode": "real"})
        await client.wait_for(lambda c: c.mode == "real", WAIT_S)
        assert client.frame_counts[FrameKind.PANORAMA] == 1
        await client.send({"type": "ack", "kind": 1, "seq": 999})  # of a frame never sent
        await client.send({"type": "ack", "kind": 1, "seq": 1})
        await client.wait_for(lambda c: c.frame_counts[FrameKind.PANORAMA] == 2, WAIT_S)
        assert client.frames[FrameKind.PANORAMA].header == {"n": 49}


async def test_fault_slow_client_slows_another(serve):
    server = serve()
    picture = bytes(300_000)
    async with ConsoleClient(server.url) as quick, aiohttp.ClientSession() as http:
        # Never reads after the handshake, so its socket fills; never acknowledges either.
        slow = await http.ws_connect(server.url + "ws")
        for n in range(40):
            for kind in FrameKind:
                server.send_frame(kind, {"n": n}, picture)
            server.publish("state", {"n": n, "filler": "x" * 500_000})
            await quick.wait_for(
                lambda c, n=n: c.state.get("n") == n and frame_number(c, FrameKind.COSTMAP) == n, WAIT_S
            )
        await slow.close()


async def test_hidden_picture_is_sent_rarely(serve):
    server = serve(background_picture_hz=0.001)
    async with ConsoleClient(server.url) as client:
        server.show(FrameKind.VIEW)
        for n in range(5):
            server.send_frame(FrameKind.PANORAMA, {"n": n}, b"p")
            server.send_frame(FrameKind.VIEW, {"n": n}, b"v")
            await client.wait_for(lambda c, n=n: frame_number(c, FrameKind.VIEW) == n, WAIT_S)
        assert client.frame_counts[FrameKind.PANORAMA] == 1
        server.show(FrameKind.PANORAMA)
        await client.wait_for(lambda c: frame_number(c, FrameKind.PANORAMA) == 4, WAIT_S)


async def test_late_client_gets_the_newest_state_and_map(serve):
    server = serve(page={"dissolve_ms": 1})
    server.publish("state", {"mode": "virtual"})
    server.send_frame(FrameKind.MAP, {"resolution": 0.05}, b"png")
    async with ConsoleClient(server.url) as client:
        await client.wait_for(lambda c: c.mode == "virtual" and FrameKind.MAP in c.frames, WAIT_S)
        assert client.messages["hello"]["page"] == {"dissolve_ms": 1}
        assert client.messages["hello"]["max_linear"] == 0.4


@pytest.mark.parametrize("text", ["no json", '{"type":"warp"}', '{"type":"lease","take":1}'])
async def test_bad_message_is_answered_and_many_end_the_connection(serve, text):
    server = serve()
    async with ConsoleClient(server.url) as client:
        await client.acquire()
        await client.socket.send_str(text)
        await client.wait_for(lambda c: len(c.errors) == 1, WAIT_S)
    assert motion(server.backend) == []


async def test_end_of_the_server_stops_the_robot_and_closes_the_clients(serve):
    server = serve()
    async with ConsoleClient(server.url) as client:
        await client.acquire()
        await client.send_drive(0.3, 0.0)
        await server.backend.wait(lambda b: b.commands)
        await asyncio.to_thread(server.stop)
        with pytest.raises(ConnectionError):
            await client.wait_for(lambda c: False, WAIT_S)
    assert server.backend.commands[-1] == (0.0, 0.0)


def test_used_port_is_told(serve):
    server = serve()
    with pytest.raises(ConsoleError, match=f"{server.port}.*server.port"):
        ConsoleServer(Backend(), ConsoleServerConfig(port=server.port)).start()


def test_a_host_that_is_no_name_is_told():
    with pytest.raises(ConsoleError, match="cannot listen on aaa"):
        ConsoleServer(Backend(), ConsoleServerConfig(host=70 * "a", port=0)).start()
