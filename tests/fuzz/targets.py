"""The table of parsers of what comes from outside.

Each function returns a ``Target``; it runs once, as a parser may need files or tables.
"""

from __future__ import annotations

import atexit
import json
import logging
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
TARGETS: dict[str, tuple[Callable[[], Target], int]] = {}
"""Name → the function that makes the target, and the number of inputs of the test that runs with all others."""
_YAML_WORDS = (
    b"&a ", b"*a", b"<<: *a\n", b"!!python/object:os.system ", b"!!timestamp ", b"!!binary ", b"!!int ", b"? ", b": ",
    b"- ", b"\n", b"  ", b"|\n", b">\n", b"{", b"}", b"[", b"]", b"~", b"2001-13-45", b"0o7", b".inf", b".nan", b"\t",
    b"---\n", b"%YAML 1.2\n", b"\xff", b"\xc2\x85", b"!!set ", b"!!omap ", b"!!pairs ", b"!!merge ", b"=", b"1:30:99",
)  # fmt: skip
_BOMB = b"a: &a [x,x,x,x,x,x,x,x,x]\n" + b"".join(
    b"%c: &%c [*%c,*%c,*%c,*%c,*%c,*%c,*%c,*%c,*%c]\n" % ((97 + n, 97 + n) + (96 + n,) * 9) for n in range(1, 9)
)
_JSON_WORDS = (b"null", b"true", b"[]", b"{}", b"NaN", b"Infinity", b"1e400", b'"\\ud800"', b"-0", b",", b":")


def target(name: str, count: int) -> Callable[[Callable[[], Target]], Callable[[], Target]]:
    def add(make: Callable[[], Target]) -> Callable[[], Target]:
        TARGETS[name] = make, count
        return make

    return add


def _folder() -> Path:
    """A folder in memory that goes with the process."""
    folder = Path(tempfile.mkdtemp(prefix="ic-fuzz-", dir="/dev/shm"))
    atexit.register(shutil.rmtree, folder, True)
    return folder


def _by_file(name: str, parse: Callable[[Path], object]) -> Callable[[bytes], object]:
    """A parser that takes a path."""
    path = _folder() / name

    def parse_bytes(data: bytes) -> object:
        path.write_bytes(data)
        return parse(path)

    return parse_bytes


# -- LiDAR and camera --------------------------------------------------------------------------------------------------


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


@target("vlp16-data", 400)
def _vlp16_data() -> Target:
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

    return Target(_data_packets(), parse, words=(b"\xff\xee", b"\x37\x22", b"\x39\x22"))


@target("vlp16-position", 2000)
def _vlp16_position() -> Target:
    from instant_ic.lidar.packets import PacketError, decode_position_packet, encode_position_packet

    sentence = "$GPRMC,123519,A,4807.038,N,01131.000,E,022.4,084.4,230394,003.1,W*6A"
    samples = [encode_position_packet(5), encode_position_packet(3_599_999_999, 2, sentence)]
    words = (b"$GPRMC,", b",A,", b"\r\n", b",,", b"nan", b"1e9")
    return Target(samples, decode_position_packet, (PacketError,), words)


@target("pcap", 800)
def _pcap() -> Target:
    from instant_ic.lidar.capture import CaptureError, CaptureReader

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
    head = block(0x0A0D0D0A, struct.pack("<IHHq", 0x1A2B3C4D, 1, 0, -1))
    samples.append(head + block(1, interface) + 2 * block(6, packet))
    parse = _by_file("capture.pcap", lambda path: list(CaptureReader(path)))
    return Target(samples, parse, (CaptureError,), (b"\x0a\x0d\x0d\x0a", b"\x81\x00"))


def _jpeg() -> bytes:
    import cv2
    import numpy as np

    return bytes(cv2.imencode(".jpg", np.arange(32 * 16 * 3, dtype=np.uint8).reshape(16, 32, 3))[1].tobytes())


def _preview() -> bytes:
    jpeg = _jpeg()
    head = f"Content-type: image/jpeg\r\nContent-Length: {len(jpeg)}\r\n\r\n".encode()
    return 3 * (b"---osclivepreview---\r\n" + head + jpeg + b"\r\n")


@target("theta-preview", 600)
def _theta_preview() -> Target:
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

    words = (b"osclivepreview", b"Content-Length: ", b"\r\n\r\n", b"\xff\xd8", b"\xff\xd9")
    return Target([_preview()], parse, words=words)


@target("theta-http", 300)
def _theta_http() -> Target:
    from requests.auth import HTTPDigestAuth
    from urllib3.util import connection

    from instant_ic.camera.config import ThetaConfig
    from instant_ic.camera.source import CameraError
    from instant_ic.camera.theta import ThetaClient

    info = b'{"model": "RICOH THETA Z1", "firmwareVersion": "3.10.2", "serialNumber": "YL00105307"}'
    state = b'{"fingerprint": "F", "state": {"batteryLevel": 0.83, "_batteryTemp": 30, "_cameraError": ["A", "B"]}}'
    digest = b'Digest realm="RICOH THETA", nonce="00f1c8c4", qop="auth", algorithm=MD5, opaque="x", stale=false'

    def reply(status: bytes, body: bytes, *headers: bytes) -> bytes:
        head = b"\r\n".join((b"HTTP/1.1 " + status, b"Content-Length: %d" % len(body), *headers))
        return head + b"\r\n\r\n" + body

    samples = [
        reply(b"200 OK", info, b"Content-Type: application/json"),
        reply(b"200 OK", state),
        reply(b"401 Unauthorized", b"", b"WWW-Authenticate: " + digest),
        reply(b"302 Found", b"", b"Location: http://other/"),
        reply(b"400 Bad", b'{"state": "error", "error": {"code": "unknownCommand", "message": "x"}}'),
        reply(b"200 OK", _preview(), b"Content-Type: multipart/x-mixed-replace; boundary=osclivepreview"),
        b"HTTP/1.1 200 OK\r\nTransfer-Encoding: chunked\r\n\r\n" + b"%x\r\n%s\r\n0\r\n\r\n" % (len(info), info),
    ]
    content, kept = b"", list[socket.socket]()

    def connected(*_: object, **__: object) -> socket.socket:
        """A camera that has answered already and gone."""
        here, there = socket.socketpair()
        there.setblocking(False)
        there.send(content)
        there.shutdown(socket.SHUT_WR)
        here.settimeout(2.0)
        kept.append(there)
        return here

    client = ThetaClient("http://theta", ThetaConfig(busy_retries=0), "user", "password")

    def parse(data: bytes) -> None:
        nonlocal content
        content = data
        client._session.auth = HTTPDigestAuth("user", "password")  # what one camera asks for is nothing to the next
        client._session.cookies.clear()
        real, connection.create_connection = connection.create_connection, connected
        try:
            client.health()
        finally:
            connection.create_connection = real
            client.close()
            for other in kept:
                other.close()
            kept.clear()

    words = (b"\r\n", b"Content-Encoding: gzip\r\n", b"Transfer-Encoding: chunked\r\n", b"Set-Cookie: a=b\r\n")
    words += (b"HTTP/1.1 100 Continue\r\n\r\n", b"WWW-Authenticate: Digest \r\n", b"Location: \r\n", b"ffffffff\r\n")
    return Target(samples, parse, (CameraError,), words)


# -- base --------------------------------------------------------------------------------------------------------------


@target("roboclaw-replies", 500)
def _roboclaw_replies() -> Target:
    from instant_ic.base.config import RoboclawConfig
    from instant_ic.base.roboclaw import LinkError, Roboclaw
    from instant_ic.sim.roboclaw_emulator import RoboclawEmulator

    def driver(write: Callable[[bytes], object], read: Callable[[int], bytes], reset: Callable[[], None]) -> Roboclaw:
        port: Any = SimpleNamespace(write=write, read=read, reset_input_buffer=reset, close=lambda: None)
        return Roboclaw(RoboclawConfig(port="fuzz", retries=0), lambda _: port, sleep=lambda _: None)

    def session(roboclaw: Roboclaw) -> None:
        roboclaw.connect()
        roboclaw.drive([100.0, -100.0], 400.0)
        roboclaw.encoders()
        roboclaw.battery_v()
        roboclaw.status()
        roboclaw.watchdog_s()
        roboclaw.stop()

    emulator, received, pending = RoboclawEmulator(), bytearray(), bytearray()

    def read_emulator(size: int) -> bytes:
        data = bytes(pending[:size])
        del pending[:size]
        received.extend(data)  # and not the acknowledgement of a blind stop, which nobody reads
        return data

    session(driver(lambda data: pending.extend(emulator.feed(data)), read_emulator, pending.clear))

    def parse(data: bytes) -> None:
        at = 0

        def read(size: int) -> bytes:
            nonlocal at
            at += size
            return data[at - size : at]

        session(driver(lambda data: None, read, lambda: None))

    return Target([bytes(received)], parse, (LinkError,), (b"\xff", b"\0"))


# -- console -----------------------------------------------------------------------------------------------------------


@target("console-messages", 2000)
def _console_messages() -> Target:
    from instant_ic.console.backend import ConsoleBackend
    from instant_ic.console.drive import DriveGate
    from instant_ic.console.protocol import PageProtocolError, parse_text
    from instant_ic.console.server import ConsoleServer
    from instant_ic.console.session import PageSession

    logging.getLogger("instant_ic.console").setLevel(logging.CRITICAL)
    messages: tuple[dict[str, Any], ...] = (
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
    server = ConsoleServer(ConsoleBackend())

    def parse(data: bytes) -> None:
        session = PageSession(1, None, None, None)  # type: ignore[arg-type]
        server.drive.gate = DriveGate(server.config.drive)  # nothing of an input is left for the next
        for line in data.decode().split("\n")[:20]:
            server.pages.handle(session, parse_text(line), 1.0)

    words = tuple(f"{json.dumps(key)}:{json.dumps(m[key])}".encode() for m in messages for key in m)
    samples = [json.dumps(message).encode() for message in messages]
    allowed = (PageProtocolError, UnicodeDecodeError)  # aiohttp closes a socket that sends no UTF-8
    return Target(samples, parse, allowed, words + _JSON_WORDS)


@target("console-headers", 2000)
def _console_headers() -> Target:
    """What the console reads of a request itself: Host and Origin."""
    from instant_ic.console.server import origin_allowed
    from instant_ic.util.web_access import host_allowed

    def parse(data: bytes) -> None:
        first, _, second = data.decode("latin-1").partition("\n")
        host_allowed(first, ("robot.local",))
        origin_allowed(second, first)

    samples = [b"127.0.0.1:8080\nhttp://127.0.0.1:8080", b"[::1]:80\nhttps://[::1]:80", b"robot.local\nnull"]
    return Target(samples, parse, words=(b"[", b"]", b":", b"@", b"//", b"%", b"\n"))


# -- bus and bridges ---------------------------------------------------------------------------------------------------

_KEPT: list[object] = []
"""Hosts of the bus until the process ends: collected before its sockets, a ZeroMQ context waits for them for ever."""


@target("bus-frames", 800)
def _bus_frames() -> Target:
    """The parts of one message, each behind its length; a subscription counts what is wrong and stays usable."""
    import zmq

    from instant_ic.bus import registry
    from instant_ic.bus.frame import HEADER, INLINE, MARK, REFERENCE, SHARED, type_digest
    from instant_ic.bus.host import Host
    from instant_ic.bus.local_subscription import LocalSubscription
    from instant_ic.bus.qos import RELIABLE

    publisher, digest, body = b"publishr", type_digest("std_msgs/msg/String"), b"\0\1\0\0\6\0\0\0hello\0"
    inline = HEADER.pack(INLINE, MARK, 1, 5, publisher, digest, len(body))
    shared = HEADER.pack(SHARED, MARK, 2, 6, publisher, digest, 200_000)
    messages = [(b"/topic" + inline, body), (b"/topic" + shared, REFERENCE.pack(1, 0, 1, 1)), (b"/topic" + inline,)]
    samples = [b"".join(len(part).to_bytes(4, "little") + part for part in parts) for parts in messages]

    host = Host(_folder() / "run", "fuzz", lambda: 0, lambda: 0)
    _KEPT.append(host)
    subscription = LocalSubscription(host, "/topic", "std_msgs/msg/String", RELIABLE, lambda: None)
    stem = host.run_dir / "topics" / "topic" / "stranger"
    claim = registry.Claim(stem, "fuzz")
    claim.write(
        {
            "topic": "/topic", "type": "std_msgs/msg/String", "qos": "reliable", "node": "stranger", "pid": 1,
            "socket": f"{stem}.sock", "id": publisher.hex(), "started_ns": 1,
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

    return Target(samples, parse, words=(b"IIC\0\3\0", b"IIC\0\3\1", b"/topic", publisher))


@target("cdr", 1500)
def _cdr() -> Target:
    """CDR of some types, with the number of the type in front."""
    import numpy as np

    from instant_ic.msg import (
        MessageError,
        TFMessage,
        deserialize,
        message_type,
        scan_message,
        serialize,
        transform_message,
    )

    types = ("Twist", "TwistStamped", "Bool", "String", "LaserScan", "PointCloud2", "OccupancyGrid", "TFMessage")
    messages = {
        "Bool": message_type("Bool")(True),
        "String": message_type("String")("hello"),
        "LaserScan": scan_message(np.ones(8, np.float32), 0.0, 0.1, 0.1, 10.0, "velodyne", 5),
        "TFMessage": TFMessage([transform_message(np.eye(4), "odom", "base_link", 5)]),
    }
    samples = [bytes([types.index(name)]) + bytes(serialize(message)) for name, message in messages.items()]

    def parse(data: bytes) -> None:
        if data:
            deserialize(data[1:], types[data[0] % len(types)])

    return Target(samples, parse, (MessageError,))


@target("control", 800)
def _control() -> Target:
    """Answers are refusals for whatever is no request; only a bug is ``internal``."""
    from instant_ic.bus.control import ControlServer
    from instant_ic.bus.lockstep import LockstepBus
    from nodes.vlp16_driver import Vlp16DriverConfig, Vlp16DriverNode

    requests: tuple[dict[str, Any], ...] = (
        {"op": "describe"},
        {"op": "set", "values": {"period_s": 0.5, "names": ["a"], "inner.gain": 1.0}},
        {"op": "log_level", "level": "debug"},
        {"op": "status"},
        {"op": "call", "command": "go", "arguments": {"speed": 1}},
    )
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

    words = (*_JSON_WORDS, b'"op":', b'"set"', b'"scan.beams"', b'"silence_s"', b'"values":')
    return Target([json.dumps(request).encode() for request in requests], parse, words=words)


@target("bridge-frames", 600)
def _bridge_frames() -> Target:
    """A session that is up and has a topic, and then the input."""
    from instant_ic.bridge import host_protocol as wire
    from instant_ic.bridge.host_session import Session, Side
    from instant_ic.bridge.host_topics import TopicRule

    logging.getLogger("instant_ic.bridge").setLevel(logging.CRITICAL)
    digest = "RIHS01_" + "0" * 64
    hello = wire.Hello(wire.VERSION, "station", "station-1", {"/scan": 5.0}).encode()
    announce = wire.Announce(1, "/cmd", "node", "std_msgs/msg/String", digest, "sensor").encode()
    samples = [
        hello,
        announce,
        wire.Welcome(wire.VERSION, "station", "station-1", {"/scan": 5.0}).encode(),
        wire.Bye("closing", "over").encode(),
        wire.Refuse(1, "no").encode(),
        wire.HostNotice("clock", "off").encode(),
        wire.Ping(1, 5, 6).encode(),
        wire.Pong(1, 5, 6, 7, 8).encode(),
        wire.Ack(5, (1, 2, 3)).encode(),
        wire.Data(1, 1, 5, 5, 5, 10, 0, b"12345").encode(),
        wire.Data(1, 1, 5, 5, 5, 10, 5, b"67890").encode(),
    ]

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

    return Target(samples, parse, (wire.HostProtocolError,), _JSON_WORDS)


@target("zenoh", 1500)
def _zenoh() -> Target:
    from instant_ic.bridge.zenoh_format import Attachment, FormatError, Token, closest_qos

    def parse(data: bytes) -> None:
        text = data.decode("latin-1")
        for read in (lambda: Attachment.unpack(data), lambda: closest_qos(text), lambda: Token.parse(text)):
            try:
                read()
            except FormatError:
                continue

    token = b"@ros2_lv/0/ab/0/1/MP/%/%/n/%t/std_msgs::msg::dds_::String_/RIHS01_0/::,10:,:,:,,"
    return Target([Attachment(5, 6, bytes(16)).pack(), token], parse)


# -- bags --------------------------------------------------------------------------------------------------------------


def _bag(folder: Path, compressed: bool = False) -> bytes:
    """Write a bag; returns its file's content."""
    from instant_ic.bag import BagWriter
    from instant_ic.bus.qos import LATCHED, SENSOR
    from instant_ic.msg import message_type, serialize

    text = message_type("String")
    with BagWriter(folder, compressed) as writer:
        for stamp in range(5):
            payload = bytes(serialize(text(f"message {stamp}")))
            writer.write("/text", "std_msgs/msg/String", payload, 1000 + stamp, SENSOR)
        writer.write("/map", "std_msgs/msg/String", bytes(serialize(text("map"))), 2000, LATCHED)
        writer.set_custom("note", "x")
    return next(folder.glob("*.mcap")).read_bytes()


def _mcap(parse: Callable[[Path], object]) -> Target:
    from instant_ic.bag import BagError

    folder = _folder()
    samples = [_bag(folder / str(compressed), compressed) for compressed in (False, True)]
    return Target(samples, _by_file("bag.mcap", parse), (BagError,), fix=fix_chunk)


def fix_chunk(data: bytes) -> bytes:
    """Take away the check sums of chunks, so that what is inside is read."""
    from mcap.opcode import Opcode

    out, at = bytearray(data), 8
    while at + 9 <= len(out):
        opcode, length = struct.unpack_from("<BQ", out, at)
        if opcode == Opcode.CHUNK and at + 37 <= len(out):
            out[at + 9 + 24 : at + 9 + 28] = bytes(4)
        at += 9 + length
    return bytes(out)


@target("mcap-scan", 400)
def _mcap_scan() -> Target:
    from instant_ic.bag.mcap_scan import McapScan

    return _mcap(lambda path: list(McapScan(path).messages()))


@target("mcap-recover", 20)
def _mcap_recover() -> Target:
    from instant_ic.bag.recover import recover

    def parse(path: Path) -> None:
        shutil.rmtree(path.parent / "recovered", ignore_errors=True)
        recover(path, path.parent / "recovered")

    return _mcap(parse)


def _read_bag(path: Path) -> None:
    from instant_ic.bag import BagError, BagReader

    with BagReader(path) as bag:
        for topic in bag.topics:
            _ = topic.problem
            try:
                bag.decoder(topic)
            except BagError:
                continue
        for _ in bag.messages():
            pass


@target("mcap-read", 100)
def _mcap_read() -> Target:
    return _mcap(_read_bag)


@target("bag-metadata", 20)
def _bag_metadata() -> Target:
    """The metadata of a folder whose message file is good."""
    from instant_ic.bag import BagError

    folder = _folder() / "bag"
    _bag(folder)
    sample = (folder / "metadata.yaml").read_bytes()

    def parse(data: bytes) -> None:
        (folder / "metadata.yaml").write_bytes(data)
        _read_bag(folder)

    return Target([sample], parse, (BagError,), _YAML_WORDS)


@target("sqlite-bag", 60)
def _sqlite_bag() -> Target:
    from rosbags.rosbag2 import StoragePlugin, Writer

    from instant_ic.bag import BagError
    from instant_ic.bag.metadata import ros_qos
    from instant_ic.bus.qos import SENSOR
    from instant_ic.msg import typestore

    folder = _folder() / "bag"
    with Writer(folder, version=9, storage_plugin=StoragePlugin.SQLITE3) as writer:
        connection = writer.add_connection(
            "/text", "std_msgs/msg/String", typestore=typestore(), offered_qos_profiles=[ros_qos(SENSOR)]
        )
        writer.write(connection, 1, b"\0\1\0\0\6\0\0\0hello\0")
    return Target([next(folder.glob("*.db3")).read_bytes()], _by_file("bag.db3", _read_bag), (BagError,))


# -- files -------------------------------------------------------------------------------------------------------------


@target("parameters", 60)
def _parameters() -> Target:
    from instant_ic.config.params import ParameterError, build, load_file
    from nodes.vlp16_driver import Vlp16DriverConfig

    bomb = b"vlp16_driver:\n  ros__parameters:\n" + b"".join(b"    " + line + b"\n" for line in _BOMB.splitlines())
    parse = _by_file("params.yaml", lambda path: build(Vlp16DriverConfig, load_file(path, "vlp16_driver")))
    return Target([(ROOT / "config" / "robot.yaml").read_bytes(), bomb], parse, (ParameterError,), _YAML_WORDS)


_LAUNCH = b"""launch:
- arg: {name: world, default: corridor, description: "a world"}
- arg: {name: port, type: int, default: "8089"}
- let: {name: other, value: "$(var world)-x"}
- set_parameters_from_file: {filename: $(config robot.yaml)}
- node:
    exec: theta_camera
    param:
    - from: $(config robot.yaml)
    - {name: theta.width, value: 640, if: $(eval world == 'room' and port != '')}
    remap: [{from: /a, to: /b}]
    env: [{name: OMP_NUM_THREADS, value: 1}]
    respawn: true
- group:
    run_dir: robot1
    launch:
    - node: {exec: vlp16_driver}
- include: {file: small.yaml, arg: [{name: a, value: $(var world)}]}
"""


@target("launch", 60)
def _launch() -> Target:
    from instant_ic.launch import LaunchFileError, read_launch_file

    small = b"launch:\n- arg: {name: a, default: b}\n- node: {exec: arbiter, name: $(var a)}\n"
    bomb = b"launch:\n- node:\n    exec: arbiter\n    param:\n    - name: p\n      value:\n"
    bomb += b"".join(b"        " + line + b"\n" for line in _BOMB.splitlines())

    def parse(path: Path) -> None:
        path.with_name("small.yaml").write_bytes(small)
        read_launch_file(path, {}, path.parent)

    words = (*_YAML_WORDS, b"$(var ", b"$(eval ", b")", b"$(config ", b"include:", b"if: ")
    return Target([_LAUNCH, small, bomb], _by_file("fuzzed.yaml", parse), (LaunchFileError,), words)


@target("manifest", 100)
def _manifest() -> Target:
    from instant_ic.depth.manifest import ManifestError, load_manifest

    samples = [path.read_bytes() for path in sorted((ROOT / "models").rglob("*.yaml"))]
    samples.append(b"name: m\ninput_width: 512\ninput_height: 256\noutput_kind: metric\ninput: in\nsigma_output: out\n")
    return Target(samples, _by_file("model.yaml", load_manifest), (ManifestError,), _YAML_WORDS)


@target("map-yaml", 150)
def _map_yaml() -> Target:
    from instant_ic.slam.map_files import MapError, load_grid

    samples = [
        b"image: map.pgm\nmode: trinary\nresolution: 0.05\norigin: [0.0, 0.0, 0.0]\nnegate: 0\n"
        b"occupied_thresh: 0.65\nfree_thresh: 0.25\n",
        b"image: map.pgm\nresolution: 0.05\norigin: [-1, 2, 0]\nnegate: 1\noccupied_thresh: 0.9\nfree_thresh: 0.1\n",
    ]

    def parse(path: Path) -> None:
        path.with_name("map.pgm").write_bytes(b"P5\n4 4\n255\n" + bytes(range(16)))
        load_grid(path)

    return Target(samples, _by_file("map.yaml", parse), (MapError,), _YAML_WORDS)


@target("image", 600)
def _image() -> Target:
    import cv2
    import numpy as np

    from instant_ic.util.jpeg import JpegError
    from instant_ic.util.limits import decode_rgb

    png = bytes(cv2.imencode(".png", np.arange(256, dtype=np.uint8).reshape(16, 16))[1].tobytes())
    words = (b"\xff\xd8", b"\xff\xc0", b"IHDR", b"IDAT")
    return Target([_jpeg(), png], lambda data: decode_rgb(data, 8, 8), (JpegError,), words)


@target("glb", 40)
def _glb() -> Target:
    import numpy as np
    import trimesh
    from PIL import Image

    from instant_ic.geometry.mesh_file import MeshError, load_mesh

    logging.getLogger("trimesh").setLevel(logging.CRITICAL)
    box = trimesh.creation.box()
    plain = trimesh.Scene(box).export(file_type="glb")
    image = Image.fromarray(np.arange(48, dtype=np.uint8).reshape(4, 4, 3))
    box.visual = trimesh.visual.TextureVisuals(uv=np.zeros((len(box.vertices), 2)), image=image)
    samples = [bytes(plain), bytes(trimesh.Scene(box).export(file_type="glb"))]
    words = (b'"count":', b'"bufferView":', b'"mesh":0', b"glTF")
    return Target(samples, _by_file("mesh.glb", lambda path: load_mesh(path, 100_000)), (MeshError,), words)
