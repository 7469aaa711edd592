"""The token that the console makes at its start: on the terminal and in one file for its owner, and nowhere else."""

import os
import pty
import re
import signal
import socket
import stat
import subprocess
import sys
import threading
import time

import pytest

from instant_ic.bus import RELIABLE, registry
from instant_ic.bus.local_transport import LocalTransport

pytestmark = pytest.mark.system
STACK = """
launch:
- node: {{exec: console, param: [{{name: server.host, value: {host}}}, {{name: server.port, value: {port}}}]}}
- node: {{exec: bag_recorder, param: [{{name: path, value: {bags}}}]}}
"""
TOPICS = ("/rosout", "/diagnostics", "/heartbeat")


def free_port():
    with socket.create_server(("127.0.0.1", 0)) as taken:
        return taken.getsockname()[1]


@pytest.mark.parametrize(
    ("host", "terminal"),
    [("0.0.0.0", False), ("127.0.0.1", True)],
    ids=["network, journal", "terminal"],
)
def test_fault_the_token_goes_to_the_log(tmp_path_factory, host, terminal):
    folder = tmp_path_factory.mktemp("t")
    (folder / "stack.yaml").write_text(STACK.format(host=host, port=free_port(), bags=folder / "bags"))
    run_dir, shown = folder / "r", bytearray()
    registry.prepare(run_dir)
    transport = LocalTransport(run_dir, "stranger", time.time_ns)
    inboxes = {topic: transport.subscribe(topic, None, RELIABLE, lambda: None) for topic in TOPICS}
    heard = {topic: bytearray() for topic in TOPICS}
    ours, theirs = pty.openpty() if terminal else os.pipe()
    process = subprocess.Popen(
        [sys.executable, "-m", "instant_ic.cli.main", "launch", str(folder / "stack.yaml"), "--plain"],
        env={**os.environ, "INSTANT_IC_RUN_DIR": str(run_dir), "COLUMNS": "200", "TERM": "dumb"},
        cwd=folder,
        stdout=theirs,
        stderr=subprocess.STDOUT,
    )
    os.close(theirs)

    def read():
        try:
            while data := os.read(ours, 65536):
                shown.extend(data)
        except OSError:  # a terminal's end
            pass

    reader = threading.Thread(target=read, daemon=True)
    reader.start()

    def wait_for(condition, what):
        deadline = time.monotonic() + 120
        while not condition():
            for topic, inbox in inboxes.items():
                for received in inbox.take():
                    heard[topic] += bytes(received.payload)
            assert time.monotonic() < deadline and process.poll() is None, f"no {what}:\n{shown.decode()}"
            time.sleep(0.05)

    file = run_dir / "console.sign_in"
    try:
        wait_for(lambda: "launch │ console: ".encode() in shown, "address")
        address = file.read_text().strip()
        assert stat.S_IMODE(file.stat().st_mode) == 0o600
        token = re.fullmatch(r"http://127\.0\.0\.1:\d+/\?token=(\S{20,})", address)[1].encode()
        # What was logged before a reader of /rosout had found the console is in its log file alone.
        wait_for(lambda: b"image from the camera" in heard["/rosout"], "log of the console on /rosout")
        wait_for(lambda: heard["/diagnostics"] and heard["/heartbeat"], "diagnostics")
    finally:
        process.send_signal(signal.SIGINT)
        assert process.wait(60) == 0
        reader.join(10)
        transport.close()
        os.close(ours)
    assert (token in shown) is terminal
    assert str(file).encode() in shown or terminal
    for topic, payload in heard.items():
        assert token not in payload, topic
    assert not file.exists()
    written = [path for path in folder.rglob("*") if path.is_file()]
    assert any("bags" in path.parts for path in written)
    logged = b"".join(path.read_bytes() for path in written if path.suffix == ".log")
    assert b"console.sign_in" in logged and (b"Plain HTTP" in logged) is (host == "0.0.0.0")
    for path in written:
        assert token not in path.read_bytes(), path
