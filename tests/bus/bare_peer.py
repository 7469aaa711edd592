"""The bus without Instant IC: docs/wire.md in Python with pyzmq and rosbags alone.

bare_peer.py sub RUN_DIR TOPIC COUNT         print the text of COUNT messages, as JSON
bare_peer.py pub RUN_DIR TOPIC SIZE...       publish a text of each size until standard input ends
"""

import fcntl
import json
import mmap
import os
import struct
import sys
import time
from pathlib import Path

import zmq
from rosbags.typesys import Stores, get_typestore

HEADER = struct.Struct("<B4sB3xQq8s8sQ")
REFERENCE = struct.Struct("<IIII")
TYPES = get_typestore(Stores.ROS2_HUMBLE)
STRING = "std_msgs/msg/String"
HASH = bytes.fromhex(TYPES.hash_rihs01(STRING)[7:23])


def shared(reference: bytes, sequence: int, size: int) -> bytes | None:
    """A copy of the message in a slot; None if it has been overwritten."""
    pid, descriptor, _, _ = REFERENCE.unpack(reference)
    with Path(f"/proc/{pid}/fd/{descriptor}").open("rb") as slot:
        try:
            fcntl.flock(slot, fcntl.LOCK_SH | fcntl.LOCK_NB)
        except BlockingIOError:
            return None
        memory = mmap.mmap(slot.fileno(), 0, prot=mmap.PROT_READ)
        return memory[60 : 60 + size] if struct.unpack_from("<Q", memory)[0] == sequence else None


def subscribe(run_dir: Path, topic: str, count: int) -> None:
    folder = run_dir / "topics" / topic[1:].replace("/", ".")
    socket = zmq.Context().socket(zmq.SUB)
    socket.subscribe(topic.encode())
    socket.rcvtimeo = 30_000
    while not (found := list(folder.glob("*.json"))):
        time.sleep(0.05)
    for path in found:
        socket.connect("ipc://" + json.loads(path.read_text())["socket"])
    for _ in range(count):
        first, body = socket.recv_multipart()
        kind, magic, version, sequence, _, _, type_hash, size = HEADER.unpack_from(first, len(topic))
        assert (magic, version, type_hash) == (b"IIC\0", 4, HASH)
        cdr = shared(body, sequence, size) if kind == 1 else body
        text = TYPES.deserialize_cdr(cdr, STRING).data
        sys.stdout.write(json.dumps([kind, sequence, len(text), text[:5]]) + "\n")


def publish(run_dir: Path, topic: str, sizes: list[int]) -> None:
    folder = run_dir / "topics" / topic[1:].replace("/", ".")
    folder.mkdir(mode=0o700, parents=True, exist_ok=True)
    lock = (folder / "bare.lock").open("w")
    fcntl.flock(lock, fcntl.LOCK_EX)
    identity = os.urandom(8)
    socket = zmq.Context().socket(zmq.XPUB)
    socket.bind(f"ipc://{folder}/bare.sock")
    entry = {"topic": topic, "type": STRING, "qos": "reliable", "node": "bare", "pid": os.getpid(),
             "socket": f"{folder}/bare.sock", "id": identity.hex(), "started_ns": time.time_ns()}  # fmt: skip
    (folder / "bare.json").write_text(json.dumps(entry))
    while socket.recv() != b"\1" + topic.encode():
        pass
    for sequence, size in enumerate(sizes, start=1):
        cdr = bytes(TYPES.serialize_cdr(TYPES.types[STRING](data="x" * size), STRING))
        header = HEADER.pack(0, b"IIC\0", 4, sequence, time.time_ns(), identity, HASH, len(cdr))
        socket.send_multipart([topic.encode() + header, cdr])
    sys.stdin.read()


if __name__ == "__main__":
    role, where, name, *numbers = sys.argv[1:]
    if role == "sub":
        subscribe(Path(where), name, int(numbers[0]))
    else:
        publish(Path(where), name, [int(number) for number in numbers])
    assert "instant_ic" not in sys.modules
