"""Sign-in by token, watchers, TLS: over real sockets where a browser or program would come in."""

import asyncio
import gc
import shutil
import ssl
import subprocess
import time

import aiohttp
import pytest
from console_servers import DRIVE, WATCH, Backend, token_file

from instant_ic.console import ConsoleClient, ConsoleError, ConsoleServer, ConsoleServerConfig
from instant_ic.console.access import COOKIE, Access, AccessConfig, AccessError, Role, read_token
from instant_ic.util.web_access import is_loopback


@pytest.mark.parametrize(
    ("host", "sign_in", "simulated", "with_file", "required", "unguarded"),
    [
        ("127.0.0.1", "auto", True, False, False, False),
        ("localhost", "auto", True, False, False, False),
        ("::1", "auto", True, False, False, False),
        ("127.0.0.1", "auto", False, False, True, False),
        ("::1", "auto", False, False, True, False),
        ("0.0.0.0", "auto", True, False, True, False),
        ("192.168.1.5", "auto", False, False, True, False),
        ("127.0.0.1", "auto", True, True, True, False),
        ("127.0.0.1", "always", True, False, True, False),
        ("0.0.0.0", "never", True, False, False, True),
        ("127.0.0.1", "never", False, True, False, True),
        ("127.0.0.1", "never", True, True, False, False),
    ],
)
def test_when_a_sign_in_is_needed(files, host, sign_in, simulated, with_file, required, unguarded):
    given = {"token_file": files["token_file"]} if with_file else {}
    access = Access(AccessConfig(sign_in=sign_in, simulated=simulated, **given), host)
    assert (access.required, access.unguarded) == (required, unguarded)
    assert bool(access.made_token) == (required and not with_file)
    assert is_loopback(host) == (host in ("127.0.0.1", "localhost", "::1"))


async def test_fault_every_local_user_drives_a_real_robot():
    """A console that does not know whether its robot is real asks for a token on this machine too."""
    server = ConsoleServer(Backend(), ConsoleServerConfig(port=0))
    server.start()
    try:
        async with aiohttp.ClientSession() as http:
            for method, path in (("GET", ""), ("GET", "ws"), ("GET", "health"), ("POST", "estop")):
                async with http.request(method, server.url + path) as response:
                    assert response.status == 401, path
        async with ConsoleClient(server.sign_in_url) as owner:
            assert owner.messages["hello"]["may_drive"] is True
    finally:
        server.stop()
    assert server.backend.estops == []


def test_tokens_are_told_apart_and_sessions_end(files):
    access = Access(AccessConfig(session_hours=1.0, **files), "0.0.0.0")
    assert access.role_of_token(DRIVE) is Role.DRIVE
    assert access.role_of_token(WATCH) is Role.WATCH
    assert access.role_of_token("") is None
    cookie = access.open_session(Role.WATCH, 100.0)
    assert access.role_of_session(cookie, 3699.0) is Role.WATCH
    assert access.role_of_session(cookie, 3701.0) is None
    assert access.role_of_session("other", 100.0) is None
    access.close_session(cookie)
    assert access.role_of_session(cookie, 200.0) is None


def test_sign_ins_of_watchers_displace_no_driver(files):
    access = Access(AccessConfig(**files), "0.0.0.0")
    driver = access.open_session(Role.DRIVE, 0.0)
    watchers = [access.open_session(Role.WATCH, 0.0) for _ in range(257)]
    assert access.role_of_session(driver, 1.0) is Role.DRIVE
    roles = [access.role_of_session(cookie, 1.0) for cookie in watchers]
    assert roles == [None] + 256 * [Role.WATCH]  # a bounded number, and the oldest goes


def test_guessing_is_slowed_down_for_each_address(files):
    access = Access(AccessConfig(tries_per_minute=3, **files), "0.0.0.0")
    waits = [access.count_wrong_token("a", float(second)) for second in range(200)]
    assert waits[:8] == 3 * [0.0] + 5 * [4.0] and waits.count(0.0) == 3 + 9  # later one each 20 s
    assert access.count_wrong_token("b", 200.0) == 0.0
    assert access.count_wrong_token("a", 300.0) == 0.0


def test_bad_token_files_are_named(tmp_path):
    with pytest.raises(AccessError, match=r"missing: No such file"):
        read_token(str(tmp_path / "missing"))
    with pytest.raises(AccessError, match=r"open is readable by others: run `chmod 600"):
        read_token(token_file(tmp_path, "open", DRIVE, 0o640))
    for name, token in (("short", "abc"), ("spaced", "a token with some spaces"), ("accents", "jétonjétonjétonjéton")):
        with pytest.raises(AccessError, match=rf"{name}: a token must have at least 16 ASCII characters"):
            read_token(token_file(tmp_path, name, token))
    same = token_file(tmp_path, "a", DRIVE), token_file(tmp_path, "b", DRIVE)
    with pytest.raises(ConsoleError, match="the same token"):
        ConsoleServer(
            Backend(), ConsoleServerConfig(port=0, access=AccessConfig(token_file=same[0], watch_token_file=same[1]))
        )


async def test_fault_no_authentication(serve, files):
    server = serve(access=files)
    async with aiohttp.ClientSession() as http:
        async with http.get(server.url) as response:
            page = await response.text()
            assert response.status == 401
            assert 'type="password"' in page and "app.js" not in page
            assert "form-action 'self'" in response.headers["Content-Security-Policy"]
        for path in ("health", "ws", "nowhere"):
            async with http.get(server.url + path) as response:
                assert response.status == 401
        async with http.get(server.url + "static/style.css") as response:
            assert response.status == 200
        with pytest.raises(aiohttp.WSServerHandshakeError) as refused:
            await http.ws_connect(server.url + "ws", headers={"Authorization": "Bearer wrong"})
        assert refused.value.status == 401


async def test_a_browser_signs_in_by_address_or_form_and_out_again(serve, files):
    server = serve(access=files)
    jar = aiohttp.CookieJar(unsafe=True)  # cookies of an address without a name, as browsers keep them
    async with aiohttp.ClientSession(cookie_jar=jar) as http:
        async with http.get(f"{server.url}?token={DRIVE}", allow_redirects=False) as response:
            assert (response.status, response.headers["Location"]) == (303, "/")
            cookie = response.headers["Set-Cookie"]
            assert "HttpOnly" in cookie and "SameSite=Strict" in cookie and DRIVE not in cookie
        async with http.get(server.url) as response:
            assert response.status == 200 and "app.js" in await response.text()
        async with http.post(server.url + "sign-out", allow_redirects=False) as response:
            assert response.status == 303
        async with http.get(server.url) as response:
            assert response.status == 401
        async with http.post(server.url + "sign-in", data={"token": "wrong"}) as response:
            assert response.status == 401 and "Wrong token." in await response.text()
        async with http.post(server.url + "sign-in", data={"token": f" {WATCH} "}) as response:
            assert response.status == 200 and "app.js" in await response.text()
        # A signed-out cookie does not come back to life.
        async with http.get(server.url, headers={"Cookie": cookie.partition(";")[0]}) as response:
            assert COOKIE in cookie
            assert response.status == 200  # the jar's newer one goes with it
    async with aiohttp.ClientSession() as http:
        async with http.get(server.url, headers={"Cookie": cookie.partition(";")[0]}) as response:
            assert response.status == 401


async def test_fault_a_right_token_waits_behind_wrong_ones_of_the_same_address(serve, files, monkeypatch):
    """Whatever waits here waits for more than a day, so that no right token can have waited."""
    monkeypatch.setattr("instant_ic.console.access.MAX_WAIT_S", 1e5)
    for rate, burst in (("REQUESTS_PER_S", "BURST_REQUESTS"), ("SOCKETS_PER_S", "BURST_SOCKETS")):
        monkeypatch.setattr(f"instant_ic.console.server.{rate}", 1e-5)
        monkeypatch.setattr(f"instant_ic.console.server.{burst}", 8.0)
    server = serve(access=files | {"tries_per_minute": 1})
    counted, count = [], server.access.count_wrong_token
    monkeypatch.setattr(server.access, "count_wrong_token", lambda *given: (counted.append(given), count(*given))[1])
    right, wrong = ({"Authorization": f"Bearer {token}"} for token in (DRIVE, "wrong"))

    async def guess(stranger):
        while True:  # the first wrong token is answered, one waits, and the address has no requests left after a few
            async with stranger.post(server.url + "estop", headers=wrong) as response:
                assert response.status == 401

    jar = aiohttp.CookieJar(unsafe=True)
    async with aiohttp.ClientSession() as stranger, aiohttp.ClientSession(cookie_jar=jar) as browser:
        guesses = [asyncio.create_task(guess(stranger)) for _ in range(12)]
        while len(counted) < 8:
            await asyncio.sleep(0.01)
        async with aiohttp.ClientSession() as program:
            for _ in range(20):
                async with program.post(server.url + "estop", headers=right) as response:
                    assert response.status == 204
            async with program.get(server.url + "health", headers=right) as response:
                assert response.status == 200
            async with program.ws_connect(server.url + "ws", headers=right):
                pass
        async with browser.get(f"{server.url}?token={DRIVE}", allow_redirects=False) as response:
            assert response.status == 303
        async with browser.post(server.url + "estop") as response:
            assert response.status == 204
        async with browser.ws_connect(server.url + "ws"):
            pass
        async with aiohttp.ClientSession() as form:
            sent = {"data": {"token": DRIVE}, "allow_redirects": False}
            async with form.post(server.url + "sign-in", **sent) as response:
                assert response.status == 303
        assert not any(task.done() for task in guesses)
        for task in guesses:
            task.cancel()
    assert server.backend.estops == [True] * 21


async def drive_signed_in(http, server):
    """Signs in and drives by a page's WebSocket, which is returned."""
    async with http.post(server.url + "sign-in", data={"token": DRIVE}, allow_redirects=False) as response:
        assert response.status == 303
    socket = await http.ws_connect(server.url + "ws")
    await socket.send_json({"type": "lease", "take": True})
    await socket.send_json({"type": "drive", "seq": 1, "time_ms": server.now_ms(), "linear": 0.2, "angular": 0.0})
    return socket


async def read_to_the_end(socket):
    while (received := await socket.receive()).type is aiohttp.WSMsgType.TEXT:
        pass
    return received


async def expect_nobody_drives(http, server, other):
    await other.wait_for(lambda c: c.session["driver"] == "none")
    assert server.backend.commands[-1] == (0.0, 0.0)
    with pytest.raises(aiohttp.WSServerHandshakeError) as refused:
        await http.ws_connect(server.url + "ws")
    assert refused.value.status == 401
    await other.acquire()


async def test_fault_a_signed_out_socket_drives_on(serve, files):
    server = serve(access=files)
    jar = aiohttp.CookieJar(unsafe=True)
    async with aiohttp.ClientSession(cookie_jar=jar) as http, ConsoleClient(server.url, token=DRIVE) as other:
        socket = await drive_signed_in(http, server)
        while (0.2, 0.0) not in server.backend.commands:
            await asyncio.sleep(0.01)
        async with http.post(server.url + "sign-out", allow_redirects=False) as response:
            assert response.status == 303
        assert server.backend.commands[-1] == (0.0, 0.0)  # before the answer to the sign-out
        # What it says now no longer counts.
        await socket.send_json({"type": "lease", "take": True})
        closed = await read_to_the_end(socket)
        assert (socket.close_code, closed.extra) == (1008, "signed out")
        await expect_nobody_drives(http, server, other)


async def test_fault_an_expired_sign_in_drives_on(serve, files):
    server = serve(access=files | {"session_hours": 0.7 / 3600.0})
    jar = aiohttp.CookieJar(unsafe=True)
    async with aiohttp.ClientSession(cookie_jar=jar) as http, ConsoleClient(server.url, token=DRIVE) as other:
        # On a busy machine a sign-in may end before it drives: the next one then.
        while (0.2, 0.0) not in server.backend.commands:
            try:
                socket = await drive_signed_in(http, server)
            except (aiohttp.WSServerHandshakeError, ConnectionError):
                continue
            closed = await read_to_the_end(socket)
        assert (socket.close_code, closed.extra) == (1008, "signed out")
        await expect_nobody_drives(http, server, other)


async def test_sign_ins_leave_no_timers(serve, files):
    """A right token signs in a thousand times a second."""
    server = serve(access=files)
    async with aiohttp.ClientSession(cookie_jar=aiohttp.DummyCookieJar()) as http:
        for _ in range(20):
            async with http.post(server.url + "sign-in", data={"token": WATCH}, allow_redirects=False) as response:
                assert response.status == 303
    timers = [each for each in gc.get_objects() if isinstance(each, asyncio.TimerHandle)]
    assert not [timer for timer in timers if timer.when() > time.monotonic() + 3600.0]


async def test_the_sign_ins_of_others_and_of_programs_stay_when_one_signs_out(serve, files):
    server = serve(access=files)
    jars = [aiohttp.CookieJar(unsafe=True) for _ in range(2)]
    async with (
        aiohttp.ClientSession(cookie_jar=jars[0]) as first,
        aiohttp.ClientSession(cookie_jar=jars[1]) as second,
        ConsoleClient(server.url, token=WATCH) as program,
    ):
        for http in (first, second):
            async with http.post(server.url + "sign-in", data={"token": DRIVE}) as response:
                assert response.status == 200
        async with first.ws_connect(server.url + "ws"), second.ws_connect(server.url + "ws"):
            await program.wait_for(lambda c: c.session["clients"] == 3)
            async with first.post(server.url + "sign-out", allow_redirects=False):
                pass
            await program.wait_for(lambda c: c.session["clients"] == 2)


async def test_fault_error_replies_lack_the_security_headers(serve, files):
    server = serve(access=files)
    statuses = set()
    signed_in = {"Authorization": f"Bearer {DRIVE}"}
    requests = [
        ("GET", "nowhere", {}),
        ("GET", "", {}),
        ("GET", "nowhere", signed_in),
        ("DELETE", "health", signed_in),
        ("POST", "sign-in", {"data": "token=" + "x" * 9000, "Content-Type": "application/x-www-form-urlencoded"}),
        ("GET", "", {"Host": "evil.example"}),
        ("POST", "estop", signed_in | {"Origin": "http://evil.example"}),
        ("GET", "health", signed_in),
        ("GET", "static/style.css", {}),
    ]
    async with aiohttp.ClientSession() as http:
        for method, path, headers in requests:
            data = headers.pop("data", None)
            async with http.request(method, server.url + path, headers=headers, data=data) as response:
                check_headers(response.headers)
                statuses.add(response.status)
    assert statuses == {200, 401, 403, 404, 405, 413}


def check_headers(headers):
    assert headers["Cross-Origin-Resource-Policy"] == "same-origin"
    assert "default-src 'self'" in headers["Content-Security-Policy"]
    assert headers["X-Content-Type-Options"] == "nosniff"


@pytest.mark.parametrize(("host", "warned"), [("0.0.0.0", True), ("127.0.0.1", False)])
async def test_plain_http_on_a_network_address_is_warned_of(files, host, warned):
    server = ConsoleServer(Backend(), ConsoleServerConfig(host=host, port=0, access=AccessConfig(**files)))
    assert server.plain_http is warned
    server.start()
    try:
        async with aiohttp.ClientSession() as http, http.get(server.url) as response:
            assert ("Plain HTTP" in await response.text()) is warned
    finally:
        server.stop()


async def test_watchers_see_and_stop_but_do_not_drive(serve, files):
    server = serve(access=files)
    async with ConsoleClient(server.url, token=WATCH) as watcher:
        assert watcher.messages["hello"]["may_drive"] is False
        await watcher.send({"type": "lease", "take": True})
        await watcher.wait_for(lambda c: "watch_only" in c.refused)
        assert watcher.session["driver"] == "none"
        async with ConsoleClient(f"{server.url}?token={DRIVE}") as driver:
            await driver.acquire()
            await watcher.send({"type": "estop"})
            await driver.wait_for(lambda c: c.session.get("estop") is True)
    assert server.backend.estops == [True]
    assert [c for c in server.backend.commands if c != (0.0, 0.0)] == []


@pytest.fixture(scope="module")
def certificate(tmp_path_factory):
    if shutil.which("openssl") is None:
        pytest.skip("openssl is not here to make a certificate")
    folder = tmp_path_factory.mktemp("tls")
    command = (
        "openssl req -x509 -newkey ec -pkeyopt ec_paramgen_curve:prime256v1 -nodes -days 2 -subj /CN=robot "
        "-addext subjectAltName=IP:127.0.0.1 -keyout key.pem -out cert.pem"
    )
    subprocess.run(command.split(), cwd=folder, check=True, capture_output=True, timeout=60)
    return {"tls_certificate": str(folder / "cert.pem"), "tls_key": str(folder / "key.pem")}


async def test_tls_from_page_to_websocket(serve, files, certificate):
    server = serve(access=files | certificate)
    assert server.url.startswith("https://")
    async with ConsoleClient(server.url, token=DRIVE, ca_file=certificate["tls_certificate"]) as client:
        await client.acquire()
    trusting = ssl.create_default_context(cafile=certificate["tls_certificate"])
    async with aiohttp.ClientSession() as http:
        address = f"{server.url}?token={DRIVE}"
        async with http.get(address, ssl=trusting, allow_redirects=False) as response:
            assert "Secure" in response.headers["Set-Cookie"]
        with pytest.raises(aiohttp.ClientConnectorCertificateError):
            await http.get(server.url)


def test_bad_certificates_are_named(tmp_path):
    (tmp_path / "c.pem").write_text("no certificate")
    for name in ("c.pem", "missing.pem"):
        files = {"tls_certificate": str(tmp_path / name), "tls_key": str(tmp_path / "c.pem")}
        with pytest.raises(ConsoleError, match=rf"TLS certificate .*{name}"):
            ConsoleServer(Backend(), ConsoleServerConfig(port=0, access=AccessConfig(**files)))
