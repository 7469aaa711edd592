"""The transports that benchmarks/bus.py compares, and their sending and receiving processes.

A frame carries the send time (CLOCK_MONOTONIC, one clock for all processes of a machine) at byte 8. A receiver reads
one byte of every 4096 before it takes the time, so that a transport gains nothing by delivering data that is not yet in
memory.
"""

from __future__ import annotations

import json
import os
import struct
import threading
import time
from array import array
from collections.abc import Callable, Sequence
from multiprocessing.connection import Connection
from pathlib import Path
from typing import Any

import numpy as np

Got = Callable[..., None]
"""Takes a received frame, and its send time in ns where the frame itself does not carry it."""
Send = Callable[[str, bytearray], Any]
STAMP, STAMP_AT = struct.Struct("<q"), 8
KEPT: list[Any] = []
"""Sessions that must outlive the function that opens them."""
FRAMES = 8
"""A sender cycles through this many frames, as a camera driver does."""


def our_node(address: str, name: str) -> Any:
    from instant_ic.bus.clock import SystemClock
    from instant_ic.bus.local_transport import LocalTransport
    from instant_ic.bus.node import Node

    clock = SystemClock()
    node = Node(None, LocalTransport(Path(address), name, clock.now_ns), clock, name)
    node.start()
    return node


def ours_sub(topics: Sequence[str], address: str, got: Got) -> Callable[[], Any]:
    from instant_ic.bus import SENSOR

    node = our_node(address, f"sub{os.getpid()}")
    for topic in topics:
        node.subscribe_received(f"/{topic}", lambda received: got(received.payload), SENSOR)
    return node.spin


def ours_pub(topics: Sequence[str], address: str) -> Send:
    from instant_ic.bus import SENSOR

    node = our_node(address, "pub")
    kind = "std_msgs/msg/UInt8MultiArray"
    publishers = {topic: node.publisher_raw(f"/{topic}", kind, SENSOR) for topic in topics}
    threading.Thread(target=node.spin, daemon=True).start()
    return lambda topic, frame: publishers[topic].publish_bytes(frame)


def image_sub(topics: Sequence[str], address: str, got: Got) -> Callable[[], Any]:
    from instant_ic.bus import SENSOR
    from instant_ic.msg import Image, image_array, stamp_ns

    node = our_node(address, f"sub{os.getpid()}")
    for topic in topics:
        node.subscribe(f"/{topic}", Image, lambda m: got(image_array(m).reshape(-1).data, stamp_ns(m)), SENSOR)
    return node.spin


def image_pub(topics: Sequence[str], address: str) -> Send:
    from instant_ic.bus import SENSOR
    from instant_ic.msg import Image, image_message

    node = our_node(address, "pub")
    publishers = {topic: node.publisher(f"/{topic}", Image, SENSOR) for topic in topics}
    threading.Thread(target=node.spin, daemon=True).start()

    def send(topic: str, frame: bytearray) -> None:
        image, stamp = np.frombuffer(frame, np.uint8).reshape(1, -1), STAMP.unpack_from(frame, STAMP_AT)[0]
        publishers[topic].publish(image_message(image, "mono8", "camera", stamp))

    return send


def zmq_sub(topics: Sequence[str], address: str, got: Got) -> Callable[[], Any]:
    import zmq

    socket = zmq.Context().socket(zmq.SUB)
    socket.setsockopt(zmq.RCVHWM, 32)
    for topic in topics:
        socket.setsockopt(zmq.SUBSCRIBE, topic.encode() + b"\0")
    socket.connect(address)

    def run() -> None:
        while True:
            got(socket.recv_multipart(copy=False)[1].buffer)

    return run


def zmq_pub(topics: Sequence[str], address: str) -> Send:
    import zmq

    socket = zmq.Context().socket(zmq.PUB)
    socket.bind(address)
    return lambda topic, frame: socket.send_multipart([topic.encode() + b"\0", frame], copy=len(frame) < 65536)


def _zenoh_session(end: str, address: str) -> Any:
    import zenoh

    config = zenoh.Config()
    config.insert_json5("mode", '"peer"')
    config.insert_json5("scouting/multicast/enabled", "false")
    config.insert_json5("listen/endpoints", "[]")
    config.insert_json5(f"{end}/endpoints", json.dumps([address]))
    config.insert_json5("transport/shared_memory/enabled", "true")
    KEPT.append(zenoh.open(config))
    return KEPT[-1]


def zenoh_shm_sub(topics: Sequence[str], address: str, got: Got) -> Callable[[], Any]:
    session = _zenoh_session("connect", address)
    # Zenoh's Python binding offers no view of the payload, only a copy.
    KEPT.extend(session.declare_subscriber(topic, lambda sample: got(sample.payload.to_bytes())) for topic in topics)
    return threading.Event().wait


def zenoh_shm_pub(topics: Sequence[str], address: str) -> Send:
    import zenoh

    session = _zenoh_session("listen", address)
    provider, policy = zenoh.shm.ShmProvider.default_backend(256 << 20), zenoh.shm.GarbageCollect()
    publishers = {topic: session.declare_publisher(topic) for topic in topics}

    def send(topic: str, frame: bytearray) -> None:
        buffer = provider.alloc(len(frame), policy=policy)
        buffer[:] = frame
        publishers[topic].put(buffer)

    return send


def lcm_sub(topics: Sequence[str], address: str, got: Got) -> Callable[[], Any]:
    import lcm

    link = lcm.LCM(address)
    for topic in topics:
        link.subscribe(topic, lambda _channel, data: got(data)).set_queue_capacity(100)

    def run() -> None:
        while True:
            link.handle()

    return run


def lcm_pub(topics: Sequence[str], address: str) -> Send:
    import lcm

    link = lcm.LCM(address)
    return lambda topic, frame: link.publish(topic, bytes(frame))


TRANSPORTS: dict[str, tuple[Callable[..., Send], Callable[..., Callable[[], Any]]]] = {
    "ours": (ours_pub, ours_sub),
    "image": (image_pub, image_sub),
    "zmq": (zmq_pub, zmq_sub),
    "zenoh_shm": (zenoh_shm_pub, zenoh_shm_sub),
    "lcm": (lcm_pub, lcm_sub),
}
"""Publisher and subscriber by name."""


class Receiver:
    """Latencies in µs of the received frames."""

    def __init__(self) -> None:
        self.latencies_us = array("d")

    def got(self, data: Any, sent_ns: int | None = None) -> None:
        view = memoryview(data)
        sum(view[::4096])
        now = time.monotonic_ns()
        sent_ns = STAMP.unpack_from(view, STAMP_AT)[0] if sent_ns is None else sent_ns
        self.latencies_us.append((now - sent_ns) / 1e3)


def publish(channel: Connection, transport: str, topics: dict[str, int], address: str) -> None:
    """Run the sending process: send frames of ``topics`` (name: bytes) on request."""
    try:
        send = TRANSPORTS[transport][0](topics, address)
    except Exception as error:  # noqa: BLE001 - a missing package is a result
        channel.send(error)
        return
    channel.send("ready")
    while True:
        topic, count, period_s = channel.recv()
        ring = [
            bytearray(os.urandom(1 << 12) * (topics[topic] // (1 << 12) + 1))[: topics[topic]] for _ in range(FRAMES)
        ]
        due = time.monotonic()
        for number in range(count):
            frame = ring[number % FRAMES]
            STAMP.pack_into(frame, STAMP_AT, time.monotonic_ns())
            send(topic, frame)
            due += period_s
            time.sleep(max(0.0, due - time.monotonic()))
        channel.send("sent")


def receive(channel: Connection, transport: str, topics: dict[str, int], address: str) -> None:
    """Run a receiving process: answer requests with the number of frames, or with the receiver, and replace it."""
    receiver = Receiver()
    try:
        run = TRANSPORTS[transport][1](topics, address, lambda *frame: receiver.got(*frame))
    except Exception as error:  # noqa: BLE001 - a missing package is a result
        channel.send(error)
        return

    def serve() -> None:
        nonlocal receiver
        while True:
            if channel.recv() == "count":
                channel.send(len(receiver.latencies_us))
            else:
                done, receiver = receiver, Receiver()
                channel.send(done)

    channel.send("ready")
    threading.Thread(target=serve, daemon=True).start()
    run()
