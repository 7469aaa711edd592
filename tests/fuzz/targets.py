"""The table of parsers of what comes from outside: samples, function, errors."""

from __future__ import annotations

import atexit
import json
import logging
import random
import shutil
import socket
import struct
import tempfile
from collections.abc import Callable
from pathlib import Path
from types import SimpleNamespace
from typing import Any

from tests.fuzz.harness import Target

ROOT = Path(__file__).resolve().parents[2]


def _folder() -> Path:
    """A folder in memory that goes with the process."""
    memory = Path("/dev/shm")
    folder = Path(tempfile.mkdtemp(prefix="ic-fuzz-", dir=memory if memory.is_dir() else None))
    atexit.register(shutil.rmtree, folder, True)
    return folder


def _by_file(name: str, parse: Callable[[Path], object]) -> Callable[[bytes], object]:
    """A parser that takes a path."""
    path = _folder() / name

    def parse_bytes(data: bytes) -> object:
        path.write_bytes(data)
        return parse(path)

    return parse_bytes


# -- LiDAR -------------------------------------------------------------------------------------------------------------


def _data_packets() -> list[bytes]:
    import numpy as np

    from instant_ic.lidar.packets import RETURN_DUAL, RETURN_STRONGEST, encode_data_packet

    rng = np.random.default_rng(0)
    samples = []
    for mode, step in ((RETURN_STRONGEST, 1327), (RETURN_DUAL, 664)):
        packets = [
            encode_data_packet(
                (17_800 + 480 * index + 40 * np.arange(12)) % 36000,
                rng.integers(0, 5000, (12, 2, 16)),
                rng.integers(0, 256, (12, 2, 16)),
                1_000_000 + step * index,
                mode,
            )
            for index in range(4)
        ]
        samples += [packets[0], b"".join(packets)]
    return samples


def _parse_data_packets() -> Callable[[bytes], object]:
    import numpy as np

    from instant_ic.lidar.config import FlatScanConfig
    from instant_ic.lidar.flatscan import coverage, flat_scan, warm_up
    from instant_ic.lidar.stream import PacketStream

    warm_up()
    config, mount = FlatScanConfig(), np.eye(4)

    def parse(data: bytes) -> None:
        stream = PacketStream()
        revolutions = [
            stream.feed(data[at : at + 1206], 1_000_000_000 + at * 1_000) for at in range(0, max(1, len(data)), 1206)
        ]
        for revolution in (*revolutions, stream.finish()):
            if revolution is not None:
                coverage(revolution)
                flat_scan(revolution, mount, config, None)

    return parse


def _position_packets() -> list[bytes]:
    from instant_ic.lidar.packets import encode_position_packet

    sentence = "$GPRMC,123519,A,4807.038,N,01131.000,E,022.4,084.4,230394,003.1,W*6A"
    return [encode_position_packet(5), encode_position_packet(3_599_999_999, 2, sentence)]


def _parse_position_packet() -> Callable[[bytes], object]:
    from instant_ic.lidar.packets import decode_position_packet

    return lambda data: decode_position_packet(data)


def _captures() -> list[bytes]:
    payload = _data_packets()[0]
    udp = struct.pack(">HHHH", 2368, 2368, 8 + len(payload), 0) + payload
    ip = struct.pack(">BBHHHBBH8s", 0x45, 0, 20 + len(udp), 0, 0, 64, 17, 0, bytes(8)) + udp
    frame = bytes(12) + b"\x08\x00" + ip
    samples = []
    for order, magic in (("<", 0xA1B2C3D4), (">", 0xA1B23C4D)):
        head = struct.pack(order + "IHHiIII", magic, 2, 4, 0, 0, 65535, 1)
        samples.append(head + 2 * (struct.pack(order + "IIII", 5, 6, len(frame), len(frame)) + frame))

    def block(kind: int, body: bytes) -> bytes:
        body += bytes(-len(body) % 4)
        return struct.pack("<II", kind, 12 + len(body)) + body + struct.pack("<I", 12 + len(body))

    interface = struct.pack("<HHI", 1, 0, 65535) + struct.pack("<HHB3xHH", 9, 1, 9, 0, 0)
    packet = struct.pack("<IIIII", 0, 1, 2, len(frame), len(frame)) + frame
    samples.append(
        block(0x0A0D0D0A, struct.pack("<IHHq", 0x1A2B3C4D, 1, 0, -1)) + block(1, interface) + 2 * block(6, packet)
    )
    return samples


def _parse_capture() -> Callable[[bytes], object]:
    from instant_ic.lidar.capture import CaptureReader

    return _by_file("capture.pcap", lambda path: list(CaptureReader(path)))


def _capture_errors() -> tuple[type[BaseException], ...]:
    from instant_ic.lidar.capture import CaptureError

    return (CaptureError,)


# -- base --------------------------------------------------------------------------------------------------------------


def _roboclaw_session() -> tuple[bytes, bytes]:
    """What a driver sends in a session with the emulator, and what comes back."""
    from instant_ic.base.config import RoboclawConfig
    from instant_ic.base.roboclaw import Roboclaw
    from instant_ic.sim.roboclaw_emulator import RoboclawEmulator

    emulator, sent, received = RoboclawEmulator(), bytearray(), bytearray()
    pending = bytearray()

    def write(data: bytes) -> None:
        sent.extend(data)
        pending.extend(emulator.feed(data))

    def read(size: int) -> bytes:
        data = bytes(pending[:size])
        del pending[:size]
        received.extend(data)  # and not the acknowledgement of a blind stop, which nobody reads
        return data

    port: Any = SimpleNamespace(write=write, read=read, reset_input_buffer=pending.clear, close=lambda: None)
    _drive_session(Roboclaw(RoboclawConfig(port="fuzz", retries=0), lambda _: port, sleep=lambda _: None))
    return bytes(sent), bytes(received)


def _drive_session(roboclaw: Any) -> None:
    roboclaw.connect()
    roboclaw.drive([100.0, -100.0], 400.0)
    roboclaw.encoders()
    roboclaw.battery_v()
    status = roboclaw.status()
    assert isinstance(status.faults, list) and isinstance(status.warnings, list)
    roboclaw.watchdog_s()
    roboclaw.stop()


def _parse_replies() -> Callable[[bytes], object]:

    from instant_ic.base.config import RoboclawConfig
    from instant_ic.base.roboclaw import LinkError, Roboclaw

    config = RoboclawConfig(port="fuzz", retries=0)

    def parse(data: bytes) -> None:
        at = 0

        def read(size: int) -> bytes:
            nonlocal at
            at += size
            return data[at - size : at]

        port: Any = SimpleNamespace(
            write=lambda data: None, read=read, reset_input_buffer=lambda: None, close=lambda: None
        )
        roboclaw = Roboclaw(config, lambda _: port, sleep=lambda _: None)
        try:
            _drive_session(roboclaw)
        except LinkError:
            # Each reply alone too: the first that is bad would hide the others.
            for name in ("encoders", "battery_v", "status", "watchdog_s", "version"):
                roboclaw._port = port
                try:
                    getattr(roboclaw, name)()
                except LinkError:
                    continue

    return parse


def _parse_requests() -> Callable[[bytes], object]:
    from instant_ic.sim.roboclaw_emulator import MAX_SPEED_PPS, RoboclawEmulator

    def parse(data: bytes) -> None:
        emulator = RoboclawEmulator()
        emulator.feed(data[: len(data) // 2])
        emulator.advance(0.005)
        emulator.feed(data[len(data) // 2 :])
        emulator.advance(0.05)
        assert abs(emulator.setpoint_pps).max() <= MAX_SPEED_PPS

    return parse


def _fix_request(data: bytes, rng: random.Random) -> bytes:
    from instant_ic.base.protocol import crc16

    return (
        data + crc16(data).to_bytes(2, "big") if rng.random() < 0.5 else data[:-2] + crc16(data[:-2]).to_bytes(2, "big")
    )


# -- Theta -------------------------------------------------------------------------------------------------------------


def _jpeg() -> bytes:
    import cv2
    import numpy as np

    return bytes(cv2.imencode(".jpg", np.arange(32 * 16 * 3, dtype=np.uint8).reshape(16, 32, 3))[1].tobytes())


def _previews() -> list[bytes]:
    jpeg = _jpeg()
    head = f"Content-type: image/jpeg\r\nContent-Length: {len(jpeg)}\r\n\r\n".encode()
    return [
        3 * (b"---osclivepreview---\r\n" + head + jpeg + b"\r\n"),
        2 * (b"--osclivepreview\r\n" + head + jpeg + b"\r\n"),
    ]


def _parse_preview() -> Callable[[bytes], object]:
    from instant_ic.camera.preview import PreviewParser
    from instant_ic.util.jpeg import JpegError, jpeg_size

    def parse(data: bytes) -> None:
        parser = PreviewParser(max_frame_bytes=2000)
        for at in range(0, len(data), 700):
            for jpeg in parser.feed(data[at : at + 700]):
                try:
                    jpeg_size(jpeg)
                except JpegError:
                    continue
            assert len(parser._buffer) < 10_000

    return parse


_DIGEST = b'Digest realm="RICOH THETA", nonce="00f1c8c4", qop="auth", algorithm=MD5, opaque="x", stale=false'


def _camera_errors() -> tuple[type[BaseException], ...]:
    from instant_ic.camera.source import CameraError

    return (CameraError,)


def _http_replies() -> list[bytes]:
    info = b'{"model": "RICOH THETA Z1", "firmwareVersion": "3.10.2", "serialNumber": "YL00105307"}'
    state = b'{"fingerprint": "F", "state": {"batteryLevel": 0.83, "_batteryTemp": 30, "_cameraError": ["A", "B"]}}'

    def reply(status: bytes, body: bytes, *headers: bytes) -> bytes:
        head = b"\r\n".join((b"HTTP/1.1 " + status, b"Content-Length: %d" % len(body), *headers))
        return head + b"\r\n\r\n" + body

    chunked = b"HTTP/1.1 200 OK\r\nTransfer-Encoding: chunked\r\n\r\n" + b"%x\r\n%s\r\n0\r\n\r\n" % (len(info), info)
    return [
        reply(b"200 OK", info, b"Content-Type: application/json"),
        reply(b"200 OK", state),
        reply(b"401 Unauthorized", b"", b"WWW-Authenticate: " + _DIGEST),
        reply(b"302 Found", b"", b"Location: http://other/"),
        reply(b"400 Bad", b'{"state": "error", "error": {"code": "unknownCommand", "message": "x"}}'),
        reply(b"200 OK", _previews()[0], b"Content-Type: multipart/x-mixed-replace; boundary=osclivepreview"),
        chunked,
    ]


def _parse_http() -> Callable[[bytes], object]:
    from requests.auth import HTTPDigestAuth
    from urllib3.util import connection

    from instant_ic.camera.config import ThetaConfig
    from instant_ic.camera.theta import ThetaClient

    content = b""

    def connected(*_: object, **__: object) -> socket.socket:
        """A camera that has answered already and gone."""
        here, there = socket.socketpair()
        there.setblocking(False)
        there.send(content)
        there.shutdown(socket.SHUT_WR)
        here.settimeout(2.0)
        kept.append(there)
        return here

    kept: list[socket.socket] = []
    client = ThetaClient("http://theta", ThetaConfig(busy_retries=0), "user", "password")

    def parse(data: bytes) -> None:
        nonlocal content
        content = data
        client._session.auth = HTTPDigestAuth("user", "password")  # what one camera asks for is nothing to the next
        client._session.cookies.clear()
        real, connection.create_connection = connection.create_connection, connected
        try:
            client.state()
        finally:
            connection.create_connection = real
            client.close()
            for other in kept:
                other.close()
            kept.clear()

    return parse


# -- console -----------------------------------------------------------------------------------------------------------

_MESSAGES: tuple[dict[str, Any], ...] = (
    {"type": "ping", "client_ms": 12.5, "away": False},
    {"type": "drive", "seq": 7, "time_ms": 100.0, "linear": 0.3, "angular": -0.5},
    {"type": "lease", "take": True},
    {"type": "yield"},
    {"type": "estop"},
    {"type": "estop_release"},
    {"type": "look", "yaw": 0.1, "pitch": 0.2, "hfov": 1.5, "vfov": 1.0},
    {"type": "record", "on": True},
    {"type": "snapshot"},
    {"type": "bookmark"},
    {"type": "ack", "kind": 1, "seq": 5},
)
_JSON_WORDS = tuple(
    word.encode()
    for message in _MESSAGES
    for key, value in message.items()
    for word in (json.dumps(key) + ":" + json.dumps(value),)
) + (b"null", b"true", b"[]", b"{}", b"NaN", b"Infinity", b"1e400", b'"\\ud800"', b"-0", b",", b":")


def _parse_console() -> Callable[[bytes], object]:
    from instant_ic.console.drive import DriveGate
    from instant_ic.console.protocol import PageProtocolError, parse_text
    from instant_ic.console.server import ConsoleServer
    from instant_ic.console.session import PageSession

    logging.getLogger("instant_ic.console").setLevel(logging.CRITICAL)
    nothing = lambda *_: None  # noqa: E731
    names = ("drive", "operator", "estop", "look", "record", "snapshot", "bookmark")
    backend: Any = SimpleNamespace(**{f"on_{name}": nothing for name in names})
    server = ConsoleServer(backend)

    def parse(data: bytes) -> None:
        try:
            text = data.decode()
        except UnicodeDecodeError:  # aiohttp closes such a socket
            return
        session = PageSession(1, None, None, None)  # type: ignore[arg-type]
        server.drive.gate = DriveGate(server.config.drive)  # nothing of an input is left for the next
        for line in text.split("\n")[:20]:
            try:
                server.pages.handle(session, parse_text(line), 1.0)
            except PageProtocolError:
                continue

    return parse


def _console_frames() -> list[bytes]:
    from instant_ic.console.protocol import FrameKind, PageFrame, encode_frame

    return [encode_frame(PageFrame(kind, 5, {"stamp": 1.5, "width": 4}, b"payload")) for kind in FrameKind]


def _parse_console_frame() -> Callable[[bytes], object]:
    from instant_ic.console.protocol import decode_frame

    return decode_frame


def _console_errors() -> tuple[type[BaseException], ...]:
    from instant_ic.console.protocol import PageProtocolError

    return (PageProtocolError,)


def _parse_http_headers() -> Callable[[bytes], object]:
    """What the console reads of a request itself: Host, Origin, session cookie, token."""
    from instant_ic.console.server import origin_allowed
    from instant_ic.util.web_access import host_allowed

    def parse(data: bytes) -> None:
        first, _, second = data.decode("latin-1").partition("\n")
        host_allowed(first, ("robot.local",))
        origin_allowed(second, first)

    return parse


# -- bus and bridge ----------------------------------------------------------------------------------------------------


_BUS_PUBLISHER = b"publishr"


def _bus_frames() -> list[bytes]:
    """The parts of one message, each behind its length in four bytes."""
    from instant_ic.bus.frame import HEADER, INLINE, MARK, REFERENCE, SHARED, type_digest

    digest, body = type_digest("std_msgs/msg/String"), b"\0\1\0\0\6\0\0\0hello\0"
    inline = HEADER.pack(INLINE, MARK, 1, 5, _BUS_PUBLISHER, digest, len(body))
    shared = HEADER.pack(SHARED, MARK, 2, 6, _BUS_PUBLISHER, digest, 200_000)
    messages = [
        (b"/topic" + inline, body),
        (b"/topic" + shared, REFERENCE.pack(1, 0, 1, 1)),
        (b"/topic" + inline,),
        (b"/topic" + inline, body, body),
    ]
    return [b"".join(len(part).to_bytes(4, "little") + part for part in parts) for parts in messages]


_KEPT: list[object] = []
"""Hosts of the bus until the process ends: collected before its sockets, a ZeroMQ context waits for them for ever."""


def _parse_bus() -> Callable[[bytes], object]:
    """Give parts to a subscription; it counts what is wrong and stays usable."""
    import zmq

    from instant_ic.bus import registry
    from instant_ic.bus.host import Host
    from instant_ic.bus.local_subscription import LocalSubscription
    from instant_ic.bus.qos import RELIABLE

    host = Host(_folder() / "run", "fuzz", lambda: 0, lambda: 0)
    _KEPT.append(host)
    subscription = LocalSubscription(host, "/topic", "std_msgs/msg/String", RELIABLE, lambda: None)
    stem = host.run_dir / "topics" / "topic" / "stranger"
    claim = registry.Claim(stem, "fuzz")
    claim.write(
        {
            "topic": "/topic", "type": "std_msgs/msg/String", "qos": "reliable", "node": "stranger", "pid": 1,
            "socket": f"{stem}.sock", "id": _BUS_PUBLISHER.hex(), "started_ns": 1,
        }
    )  # fmt: skip
    logging.getLogger("instant_ic.bus").setLevel(logging.CRITICAL)
    out = host.context.socket(zmq.PUB)
    out.bind("inproc://fuzz")
    subscription.socket.connect("inproc://fuzz")
    subscription.read()

    def parse(data: bytes) -> None:
        parts, at = [], 0
        while at + 4 <= len(data) and len(parts) < 8:
            size = int.from_bytes(data[at : at + 4], "little")
            parts.append(data[at + 4 : at + 4 + size])
            at += 4 + size
        out.send_multipart(parts or [data])
        subscription.read()
        subscription.take()
        assert claim.json_path.exists()  # the registry's entry stays alive
        for source in subscription.sources.values():
            source.expected = 0

    return parse


def _fix_prefix(data: bytes, rng: random.Random) -> bytes:
    """The header's length of a console frame: all that follows."""
    from instant_ic.console.protocol import PREFIX, VERSION

    return PREFIX.pack(VERSION, rng.randrange(6), 0, 5, max(0, len(data) - PREFIX.size)) + data[PREFIX.size :]


_CDR_TYPES = ("Twist", "TwistStamped", "Bool", "String", "LaserScan", "PointCloud2", "OccupancyGrid", "TFMessage")


def _cdr() -> list[bytes]:
    """CDR of some types, with the number of the type in front."""
    import numpy as np

    from instant_ic.msg import TFMessage, message_type, scan_message, serialize, transform_message

    messages = {
        "Bool": message_type("Bool")(True),
        "String": message_type("String")("hello"),
        "LaserScan": scan_message(np.ones(8, np.float32), 0.0, 0.1, 0.1, 10.0, "velodyne", 5),
        "TFMessage": TFMessage([transform_message(np.eye(4), "odom", "base_link", 5)]),
    }
    return [bytes([_CDR_TYPES.index(name)]) + bytes(serialize(message)) for name, message in messages.items()]


def _parse_cdr() -> Callable[[bytes], object]:
    from instant_ic.msg import deserialize

    return lambda data: deserialize(data[1:], _CDR_TYPES[data[0] % len(_CDR_TYPES)]) if data else None


def _message_errors() -> tuple[type[BaseException], ...]:
    from instant_ic.msg import MessageError

    return (MessageError,)


def _control_requests() -> list[bytes]:
    requests: tuple[dict[str, Any], ...] = (
        {"op": "describe"},
        {"op": "get"},
        {"op": "set", "values": {"period_s": 0.5, "names": ["a"], "inner.gain": 1.0}},
        {"op": "log_level", "level": "debug"},
        {"op": "status"},
        {"op": "call", "command": "go", "arguments": {"speed": 1}},
    )
    return [json.dumps(request).encode() for request in requests]


def _parse_control() -> Callable[[bytes], object]:
    """Answers are refusals for whatever is no request; only a bug is ``internal``."""
    from instant_ic.bus.control import ControlServer
    from instant_ic.bus.lockstep import LockstepBus
    from nodes.vlp16_driver import Vlp16DriverConfig, Vlp16DriverNode

    node = LockstepBus().add(Vlp16DriverNode, Vlp16DriverConfig(source="topic"))
    node.commands["go"] = lambda speed=0: speed
    server = ControlServer.__new__(ControlServer)
    server._node = node
    server._on_node = lambda function: function()  # type: ignore[method-assign]

    def parse(data: bytes) -> None:
        answer = server.answer(data)
        if answer.get("kind") == "internal":
            raise RuntimeError(answer["error"])
        json.dumps(answer, default=str)

    return parse


def _bridge_frames() -> list[bytes]:
    from instant_ic.bridge import host_protocol as wire

    digest = "RIHS01_" + "0" * 64
    return [
        wire.Hello(wire.VERSION, "station", "station-1", {"/scan": 5.0}).encode(),
        wire.Welcome(wire.VERSION, "station", "station-1", {"/scan": 5.0}).encode(),
        wire.Bye("closing", "over").encode(),
        wire.Announce(1, "/cmd", "node", "std_msgs/msg/String", digest, "sensor").encode(),
        wire.Refuse(1, "no").encode(),
        wire.HostNotice("clock", "off").encode(),
        wire.Ping(1, 5, 6).encode(),
        wire.Pong(1, 5, 6, 7, 8).encode(),
        wire.Ack(5, (1, 2, 3)).encode(),
        wire.Data(1, 1, 5, 5, 5, 10, 0, b"12345").encode(),
        wire.Data(1, 1, 5, 5, 5, 10, 5, b"67890").encode(),
    ]


def _parse_bridge() -> Callable[[bytes], object]:
    """A session that is up and has a topic, and then the input."""
    from instant_ic.bridge import host_protocol as wire
    from instant_ic.bridge.host_session import Session, Side
    from instant_ic.bridge.host_topics import TopicRule

    logging.getLogger("instant_ic.bridge").setLevel(logging.CRITICAL)
    digest = "RIHS01_" + "0" * 64
    hello = wire.Hello(wire.VERSION, "station", "station-1", {}).encode()
    announce = wire.Announce(1, "/cmd", "node", "std_msgs/msg/String", digest, "sensor").encode()

    def parse(data: bytes) -> None:
        wire.decode(data)
        for connecting in (False, True):
            session = Session(Side("robot", "robot-1", {"/cmd": TopicRule("/cmd")}, lambda name: digest), connecting)
            session.receive(hello if not connecting else wire.Welcome.KIND.to_bytes(1, "little") + hello[1:])
            session.drives = True
            session.receive(announce)
            session.receive(data)
            session.receive(data)
            list(session.outgoing())

    return parse


def _bridge_errors() -> tuple[type[BaseException], ...]:
    from instant_ic.bridge.host_protocol import HostProtocolError

    return (HostProtocolError,)


# -- bags --------------------------------------------------------------------------------------------------------------


def _bags(compressed: bool) -> list[bytes]:
    from instant_ic.bag import BagWriter

    folder = _folder() / "bag"
    _fill(BagWriter(folder, compressed))
    content = next(folder.glob("*.mcap")).read_bytes()
    shutil.rmtree(folder)
    return [content]


def _fill(bag: Any) -> None:
    from instant_ic.bus.qos import LATCHED, SENSOR
    from instant_ic.msg import message_type, serialize

    text = message_type("String")
    with bag as writer:
        for stamp in range(5):
            payload = bytes(serialize(text(f"message {stamp}")))
            writer.write("/text", "std_msgs/msg/String", payload, 1000 + stamp, SENSOR)
        writer.write("/map", "std_msgs/msg/String", bytes(serialize(text("map"))), 2000, LATCHED)
        writer.set_custom("note", "x")


def _mcaps() -> list[bytes]:
    return _bags(False) + _bags(True)


def _parse_scan() -> Callable[[bytes], object]:
    from instant_ic.bag.mcap_scan import McapScan

    return _by_file("bag.mcap", lambda path: list(McapScan(path).messages()))


def _parse_recover() -> Callable[[bytes], object]:
    from instant_ic.bag.recover import recover

    def parse(path: Path) -> None:
        target = path.parent / "recovered"
        shutil.rmtree(target, ignore_errors=True)
        recover(path, target)

    return _by_file("bag.mcap", parse)


def _read_bag(path: Path) -> None:
    from instant_ic.bag import BagError, BagReader

    with BagReader(path) as bag:
        for topic in bag.topics:
            try:
                bag.decoder(topic)
            except BagError:
                continue
        bag.differing_types()
        assert isinstance(bag.compression, str)
        for _ in bag.messages():
            pass


def _parse_bag() -> Callable[[bytes], object]:
    return _by_file("bag.mcap", _read_bag)


def _metadata_files() -> list[bytes]:
    from instant_ic.bag import BagWriter

    folder = _folder() / "bag"
    _fill(BagWriter(folder))
    return [(folder / "metadata.yaml").read_bytes()]


def _parse_metadata() -> Callable[[bytes], object]:
    """The metadata of a folder whose message file is good."""
    from instant_ic.bag import BagWriter

    folder = _folder() / "bag"
    _fill(BagWriter(folder))

    def parse(data: bytes) -> None:
        (folder / "metadata.yaml").write_bytes(data)
        _read_bag(folder)

    return parse


def _sqlite_bags() -> list[bytes]:
    from rosbags.rosbag2 import StoragePlugin, Writer

    from instant_ic.bag.metadata import ros_qos
    from instant_ic.bus.qos import SENSOR
    from instant_ic.msg import typestore

    folder = _folder() / "bag"
    with Writer(folder, version=9, storage_plugin=StoragePlugin.SQLITE3) as writer:
        profiles = [ros_qos(SENSOR)]
        connection = writer.add_connection(
            "/text", "std_msgs/msg/String", typestore=typestore(), offered_qos_profiles=profiles
        )
        writer.write(connection, 1, b"\0\1\0\0\6\0\0\0hello\0")
    content = next(folder.glob("*.db3")).read_bytes()
    return [content]


def _parse_sqlite() -> Callable[[bytes], object]:
    return _by_file("bag.db3", _read_bag)


def _bag_errors() -> tuple[type[BaseException], ...]:
    from instant_ic.bag import BagError

    return (BagError,)


def fix_chunk(data: bytes, rng: random.Random) -> bytes:
    """Take away the check sums of chunks, so that what is inside is read."""
    from mcap.opcode import Opcode

    out, at = bytearray(data), 8
    while at + 9 <= len(out):
        opcode, length = struct.unpack_from("<BQ", out, at)
        if opcode == Opcode.CHUNK and at + 37 <= len(out):
            out[at + 9 + 24 : at + 9 + 28] = bytes(4)
        at += 9 + length
    return bytes(out)


# -- files -------------------------------------------------------------------------------------------------------------

_YAML_WORDS = (
    b"&a ", b"*a", b"<<: *a\n", b"!!python/object:os.system ", b"!!timestamp ", b"!!binary ", b"!!int ", b"? ", b": ",
    b"- ", b"\n", b"  ", b"|\n", b">\n", b"{", b"}", b"[", b"]", b"~", b"2001-13-45", b"0o7", b".inf", b".nan", b"\t",
    b"---\n", b"%YAML 1.2\n", b"\xff", b"\xc2\x85", b"!!set ", b"!!omap ", b"!!pairs ", b"!!merge ", b"=", b"1:30:99",
)  # fmt: skip
_BOMB = b"a: &a [x,x,x,x,x,x,x,x,x]\n" + b"".join(
    b"%c: &%c [*%c,*%c,*%c,*%c,*%c,*%c,*%c,*%c,*%c]\n" % ((97 + n, 97 + n) + (96 + n,) * 9) for n in range(1, 9)
)


def _parse_parameters() -> Callable[[bytes], object]:
    from instant_ic.config.params import build, load_file
    from nodes.vlp16_driver import Vlp16DriverConfig

    return _by_file("params.yaml", lambda path: build(Vlp16DriverConfig, load_file(path, "vlp16_driver")))


def _parameter_samples() -> list[bytes]:
    bomb = b"vlp16_driver:\n  ros__parameters:\n" + b"".join(b"    " + line + b"\n" for line in _BOMB.splitlines())
    return [(ROOT / "config" / "robot.yaml").read_bytes(), bomb]


def _parameter_errors() -> tuple[type[BaseException], ...]:
    from instant_ic.config.params import ParameterError

    return (ParameterError,)


_LAUNCH = b"""launch:
- arg: {name: world, default: corridor, description: "a world"}
- arg: {name: port, type: int, default: "8089"}
- let: {name: other, value: "$(var world)-x"}
- set_parameters_from_file: {filename: $(config robot.yaml)}
- node:
    exec: theta_camera
    param:
    - from: $(config robot.yaml)
    - {name: theta.width, value: 640, if: $(eval world == 'room' and port > 5)}
    remap: [{from: /a, to: /b}]
    env: [{name: OMP_NUM_THREADS, value: 1}]
    respawn: true
- group:
    run_dir: robot1
    launch:
    - node: {exec: vlp16_driver}
- include: {file: small.yaml, arg: [{name: a, value: $(var world)}]}
"""
_BOMB_LAUNCH = b"launch:\n- node:\n    exec: arbiter\n    param:\n    - name: p\n      value:\n" + b"".join(
    b"        " + line + b"\n" for line in _BOMB.splitlines()
)
_SMALL_LAUNCH = b"launch:\n- arg: {name: a, default: b}\n- node: {exec: arbiter, name: $(var a)}\n"


def _parse_launch() -> Callable[[bytes], object]:
    from instant_ic.launch.reader import read_launch_file

    folder = _folder()
    (folder / "small.yaml").write_bytes(_SMALL_LAUNCH)
    path = folder / "fuzzed.yaml"

    def parse(data: bytes) -> None:
        path.write_bytes(data)
        read_launch_file(path, {}, folder)

    return parse


def _launch_errors() -> tuple[type[BaseException], ...]:
    from instant_ic.launch.source import LaunchFileError

    return (LaunchFileError,)


def _manifests() -> list[bytes]:
    return [path.read_bytes() for path in sorted((ROOT / "models").rglob("*.yaml"))] + [
        b"name: m\ninput_width: 512\ninput_height: 256\noutput_kind: metric\ninput: in\nsigma_output: out\n"
    ]


def _parse_manifest() -> Callable[[bytes], object]:
    from instant_ic.depth.manifest import load_manifest

    return _by_file("model.yaml", load_manifest)


def _manifest_errors() -> tuple[type[BaseException], ...]:
    from instant_ic.depth.manifest import ManifestError

    return (ManifestError,)


def _maps() -> list[bytes]:
    return [
        b"image: map.pgm\nmode: trinary\nresolution: 0.05\norigin: [0.0, 0.0, 0.0]\nnegate: 0\n"
        b"occupied_thresh: 0.65\nfree_thresh: 0.25\n",
        b"image: map.pgm\nresolution: 0.05\norigin: [0, 0]\nmode: raw\n",
    ]


def _parse_map() -> Callable[[bytes], object]:
    from instant_ic.slam.map_files import load_grid

    folder = _folder()
    (folder / "map.pgm").write_bytes(b"P5\n4 4\n255\n" + bytes(range(16)))

    def with_image(data: bytes) -> None:
        (folder / "map.yaml").write_bytes(data)
        load_grid(folder / "map.yaml")

    return with_image


def _map_errors() -> tuple[type[BaseException], ...]:
    from instant_ic.slam.map_files import MapError

    return (MapError,)


def _images() -> list[bytes]:
    import cv2
    import numpy as np

    grey = np.arange(256, dtype=np.uint8).reshape(16, 16)
    return [_jpeg(), bytes(cv2.imencode(".png", grey)[1].tobytes())]


def _parse_image() -> Callable[[bytes], object]:
    from instant_ic.util.limits import decode_rgb

    return lambda data: decode_rgb(data, 8, 8)


def _image_errors() -> tuple[type[BaseException], ...]:
    from instant_ic.util.jpeg import JpegError

    return (JpegError,)


def _logs() -> list[bytes]:
    flaser = "FLASER 4 1.0 2.0 3.0 4.0 0.1 0.2 0.3 0.1 0.2 0.3 12.5 host 12.6\n"
    robot = "ROBOTLASER1 0 -1.57 3.14 0.5 80.0 0.01 0 4 1 2 3 4 0 1 2 3 1 2 3 0 0 0.1 0.1 1.0 12.5 host 12.6\n"
    mines = " ".join(["1000000", "5", "6", *["0"] * 21, *["1500"] * 20]) + "\n"
    return [(3 * flaser).encode(), (3 * robot).encode(), (3 * mines).encode()]


def _parse_log() -> Callable[[bytes], object]:
    from instant_ic.experiments.slam_logs import read_log

    return _by_file("log", lambda path: list(read_log(path)))


def _log_errors() -> tuple[type[BaseException], ...]:
    from instant_ic.experiments.slam_logs import LogError

    return (LogError,)


def _meshes() -> list[bytes]:
    import numpy as np
    import trimesh
    from PIL import Image

    box = trimesh.creation.box()
    plain = trimesh.Scene(box).export(file_type="glb")
    image = Image.fromarray(np.arange(48, dtype=np.uint8).reshape(4, 4, 3))
    box.visual = trimesh.visual.TextureVisuals(uv=np.zeros((len(box.vertices), 2)), image=image)
    return [bytes(plain), bytes(trimesh.Scene(box).export(file_type="glb"))]


def _parse_mesh() -> Callable[[bytes], object]:
    from instant_ic.vspace.scanned_mesh import load_mesh

    logging.getLogger("trimesh").setLevel(logging.CRITICAL)
    return _by_file("mesh.glb", lambda path: load_mesh(path, 100_000))


def _mesh_errors() -> tuple[type[BaseException], ...]:
    from instant_ic.geometry.mesh_file import MeshError

    return (MeshError,)


def _zenoh() -> list[bytes]:
    from instant_ic.bridge.zenoh_format import Attachment

    return [Attachment(5, 6, bytes(16)).pack()]


def _parse_zenoh() -> Callable[[bytes], object]:
    from instant_ic.bridge.zenoh_format import Attachment, FormatError, Token, TopicQoS

    def parse(data: bytes) -> None:
        for read in (Attachment.unpack, lambda raw: TopicQoS.decode(raw.decode("latin-1"))):
            try:
                read(data)
            except FormatError:
                continue
        try:
            Token.parse(data.decode("latin-1"))
        except FormatError:
            return

    return parse


def _position_errors() -> tuple[type[BaseException], ...]:
    from instant_ic.lidar.packets import PacketError

    return (PacketError,)


def _lines(samples: tuple[dict[str, Any], ...]) -> list[bytes]:
    return [json.dumps(sample).encode() for sample in samples]


TARGETS = {
    target.name: target
    for target in (
        Target(
            "vlp16-data",
            _data_packets,
            _parse_data_packets,
            dictionary=(b"\xff\xee", b"\x37\x22", b"\x39\x22"),
            share=600,
        ),
        Target(
            "vlp16-position",
            _position_packets,
            _parse_position_packet,
            _position_errors(),
            (b"$GPRMC,", b",A,", b"\r\n", b",,", b"nan", b"1e9"),
            share=3000,
        ),
        Target("pcap", _captures, _parse_capture, _capture_errors(), (b"\x0a\x0d\x0d\x0a", b"\x81\x00"), share=1500),
        Target(
            "roboclaw-replies", lambda: [_roboclaw_session()[1]], _parse_replies, dictionary=(b"\xff", b"\0"), share=800
        ),
        Target(
            "roboclaw-requests",
            lambda: [_roboclaw_session()[0]],
            _parse_requests,
            dictionary=(b"\x80", b"\x80\x15", b"\x80\x28"),
            fix=_fix_request,
            share=1500,
        ),
        Target(
            "theta-preview",
            _previews,
            _parse_preview,
            dictionary=(b"osclivepreview", b"Content-Length: ", b"\r\n\r\n", b"\xff\xd8", b"\xff\xd9"),
            share=1000,
        ),
        Target(
            "theta-http",
            _http_replies,
            _parse_http,
            _camera_errors(),
            (
                b"\r\n",
                b"Content-Encoding: gzip\r\n",
                b"Transfer-Encoding: chunked\r\n",

                b"HTTP/1.1 100 Continue\r\n\r\n",
                b"Set-Cookie: a=b\r\n",
                b"WWW-Authenticate: Digest \r\n",
                b"Location: \r\n",
                b"ffffffff\r\n",
            ),
            share=400,
        ),
        Target("console-messages", lambda: _lines(_MESSAGES), _parse_console, dictionary=_JSON_WORDS, share=3000),
        Target("console-frames", _console_frames, _parse_console_frame, _console_errors(), _JSON_WORDS,
               fix=_fix_prefix, share=3000),
        Target(
            "console-headers",
            lambda: [b"127.0.0.1:8080\nhttp://127.0.0.1:8080", b"[::1]:80\nhttps://[::1]:80", b"robot.local\nnull"],
            _parse_http_headers,
            dictionary=(b"[", b"]", b":", b"@", b"//", b"%", b"\n"),
            share=3000,
        ),
        Target(
            "bus-frames",
            _bus_frames,
            _parse_bus,
            dictionary=(b"IIC\0\3\0", b"IIC\0\3\1", b"/topic", _BUS_PUBLISHER),
            share=1000,
        ),
        Target("cdr", _cdr, _parse_cdr, _message_errors(), share=2000),
        Target(
            "control",
            _control_requests,
            _parse_control,
            dictionary=(*_JSON_WORDS, b'"op":', b'"set"', b'"scan.beams"', b'"silence_s"', b'"values":'),
            share=1000,
        ),
        Target("bridge-frames", _bridge_frames, _parse_bridge, _bridge_errors(), _JSON_WORDS, share=800),
        Target("zenoh", _zenoh, _parse_zenoh, share=2000),
        Target("mcap-scan", _mcaps, _parse_scan, _bag_errors(), fix=fix_chunk, share=800),
        Target("mcap-recover", _mcaps, _parse_recover, _bag_errors(), fix=fix_chunk, share=30),
        Target("mcap-read", _mcaps, _parse_bag, _bag_errors(), fix=fix_chunk, share=150),
        Target("bag-metadata", _metadata_files, _parse_metadata, _bag_errors(), _YAML_WORDS, share=20),
        Target("sqlite-bag", _sqlite_bags, _parse_sqlite, _bag_errors(), share=100),
        Target("parameters", _parameter_samples, _parse_parameters, _parameter_errors(), _YAML_WORDS, share=100),
        Target(
            "launch",
            lambda: [_LAUNCH, _SMALL_LAUNCH, _BOMB_LAUNCH],
            _parse_launch,
            _launch_errors(),
            (*_YAML_WORDS, b"$(var ", b"$(eval ", b")", b"$(config ", b"include:", b"if: "),
            share=100,
        ),
        Target("manifest", _manifests, _parse_manifest, _manifest_errors(), _YAML_WORDS, share=150),
        Target("map-yaml", _maps, _parse_map, _map_errors(), _YAML_WORDS, share=300),
        Target(
            "image", _images, _parse_image, _image_errors(), (b"\xff\xd8", b"\xff\xc0", b"IHDR", b"IDAT"), share=1000
        ),
        Target(
            "slam-log",
            _logs,
            _parse_log,
            _log_errors(),
            (b"FLASER ", b"ROBOTLASER1 ", b"nan ", b"inf ", b"-1 ", b"\n"),
            share=500,
        ),
        Target(
            "glb", _meshes, _parse_mesh, _mesh_errors(),
               (b'"count":', b'"bufferView":', b'"mesh":0', b"glTF"), share=60
        ),
    )
}  # fmt: skip
