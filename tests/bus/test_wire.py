"""Programs without Instant IC on the bus: bare pyzmq with rosbags, and C with libzmq (docs/wire.md)."""

import json
import os
import shutil
import subprocess
import sys
import time
from pathlib import Path

import pytest
import zmq
from local_bus import BYTES, LARGE, Bus, numbered, wait_for

from instant_ic.bus import LATCHED, RELIABLE, registry
from instant_ic.bus.frame import type_digest
from instant_ic.msg import String, deserialize, serialize

HERE = Path(__file__).parent
STRING = "std_msgs/msg/String"


def start(*command: object) -> subprocess.Popen[str]:
    environment = {key: value for key, value in os.environ.items() if key != "PYTHONPATH"}
    return subprocess.Popen(
        [str(word) for word in command], stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True, env=environment
    )


def end(process: subprocess.Popen[str]) -> str:
    try:
        return process.communicate(timeout=60)[0]
    finally:
        process.kill()


def text(size: int) -> bytes:
    return bytes(serialize(String(data="x" * size)))


@pytest.mark.parametrize("size", [100, LARGE], ids=["small", "shared"])
def test_bare_subscriber_gets_latched_and_later_messages(bus: Bus, size: int) -> None:
    out = bus.publisher(qos=LATCHED, type_name=STRING)
    other = bus.reader(qos=LATCHED, type_name=STRING)
    out.send(text(size))
    wait_for(lambda: len(other.poll()) == 1)
    process = start(sys.executable, HERE / "bare_peer.py", "sub", bus.run_dir, "/x", 3)
    try:
        wait_for(lambda: out.subscriber_count == 2)
        out.send(text(50))
        out.send(text(size + 1))
    finally:
        lines = [json.loads(line) for line in end(process).splitlines()]
    kind = int(size == LARGE)
    assert lines == [[kind, 1, size, "xxxxx"], [0, 2, 50, "xxxxx"], [kind, 3, size + 1, "xxxxx"]]
    wait_for(lambda: len(other.poll()) == 3)  # it did not take the last value twice
    assert other.stats.lost == 0


def test_bare_publisher_is_heard(bus: Bus) -> None:
    reader = bus.reader(type_name=STRING)
    process = start(sys.executable, HERE / "bare_peer.py", "pub", bus.run_dir, "/x", 10, 500_000)
    try:
        wait_for(lambda: len(reader.poll()) == 2)
        assert [(t.topic, t.type_name) for t in registry.list_topics(bus.run_dir)] == [("/x", STRING)]
    finally:
        end(process)
    assert [len(deserialize(m.payload, m.type_name).data) for m in reader.received] == [10, 500_000]
    assert {(m.publisher, m.type_name) for m in reader.received} == {("bare", STRING)}
    assert (reader.stats.lost, reader.stats.rejected) == (0, 0)
    assert registry.list_topics(bus.run_dir) == []


def test_subscriber_of_inline_messages_needs_no_shared_memory(bus: Bus) -> None:
    out = bus.publisher(qos=LATCHED)
    out.send(numbered(1, LARGE))
    with zmq.Context() as context, context.socket(zmq.SUB) as socket:
        socket.rcvtimeo = 30_000
        socket.subscribe(b"/x\0")
        socket.subscribe(b"=/x")
        socket.connect(f"ipc://{out.path}")
        assert socket.recv_multipart()[1] == numbered(1, LARGE)
        for value, size in ((2, 10), (3, LARGE)):
            out.send(numbered(value, size))
            first, body = socket.recv_multipart()
            assert body == numbered(value, size) and first[-49] == 0


@pytest.fixture(scope="module")
def c_peer(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """wire_peer.c, linked with the libzmq of pyzmq's wheel."""
    compiler = shutil.which("cc")
    libraries = sorted((Path(zmq.__file__).parents[1] / "pyzmq.libs").glob("lib*.so*"))
    zmq_library = [path for path in libraries if path.name.startswith("libzmq")]
    if compiler is None or not zmq_library:
        pytest.skip("no C compiler (cc) here" if compiler is None else "this pyzmq bundles no libzmq")
    program = tmp_path_factory.mktemp("c") / "wire_peer"
    command = [compiler, "-O1", "-Wall", "-o", program, HERE / "wire_peer.c", *zmq_library]
    command += [
        f"-Wl,-rpath,{zmq_library[0].parent}",
        f"-Wl,-rpath-link,{zmq_library[0].parent}",
        "-Wl,--allow-shlib-undefined",
    ]
    built = subprocess.run(command, capture_output=True, text=True, timeout=120)
    assert built.returncode == 0, built.stderr
    return program


def test_c_program_subscribes_small_and_shared_messages(bus: Bus, c_peer: Path) -> None:
    out = bus.publisher()
    process = start(c_peer, "sub", out.path, "/x", 2)
    try:
        wait_for(lambda: out.subscriber_count == 1)
        messages = numbered(7, 1000), numbered(9, LARGE)
        for message in messages:
            out.send(message)
    finally:
        lines = end(process).splitlines()
    assert lines == [f"{k} {k + 1} {len(m)} {sum(m)}" for k, m in enumerate(messages)]


def test_c_program_publishes(bus: Bus, c_peer: Path) -> None:
    claim, socket = registry.claim_socket(registry.prepare(bus.run_dir), "/x", "from_c")
    identity = os.urandom(8).hex()
    process = start(c_peer, "pub", socket, "/x", identity, type_digest(BYTES).hex())
    try:
        claim.write(
            {
                "topic": "/x", "type": BYTES, "qos": RELIABLE.name, "node": "from_c", "pid": process.pid,
                "socket": str(socket), "id": identity, "started_ns": time.time_ns(),
            }
        )  # fmt: skip
        reader = bus.reader()
        message = wait_for(reader.poll)[0]
    finally:
        end(process)
        claim.release()
    assert (message.payload, message.publisher, message.publish_ns) == (b"\0\1\0\0from", "from_c", 5)
