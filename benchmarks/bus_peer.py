#!/usr/bin/env python3
"""One side of one transport, for benchmarks/bus.py; controlled by JSON lines on standard input.

A frame carries the send time (CLOCK_MONOTONIC, one clock for all processes of a machine) at byte 8. A receiver reads
one byte of every 4096 before it takes the time, so that a transport gains nothing by delivering data that is not yet in
memory.

    bus_peer.py TRANSPORT pub|sub TOPIC=BYTES,... ADDRESS
"""

from __future__ import annotations

import ctypes
import json
import os
import struct
import sys
import threading
import time

KEEP = []  # sessions that must outlive the function that opens them
STAMP = struct.Struct("<q")
STAMP_AT = 8
FRAMES = 8  # a sender cycles through this many frames, as a camera driver does


class Receiver:
    """Latencies of the received frames."""

    def __init__(self):
        self.latencies = []
        self.bytes = 0
        self.first_ns = self.last_ns = 0

    def got(self, data, sent_ns=None):
        view = memoryview(data)
        sum(view[::4096])
        now = time.monotonic_ns()
        if sent_ns is None:
            sent_ns = STAMP.unpack_from(view, STAMP_AT)[0]
        self.latencies.append((now - sent_ns) / 1e3)
        self.bytes += len(view)
        self.first_ns = self.first_ns or now
        self.last_ns = now

    def collect(self):
        result = {
            "latencies_us": self.latencies,
            "count": len(self.latencies),
            "bytes": self.bytes,
            "seconds": (self.last_ns - self.first_ns) / 1e9,
        }
        self.__init__()
        return result


# Each transport: open_sub(topics, address, receiver) returns the main thread's function; open_pub(topics, address)
# returns send(topic, frame).


def ours_sub(topics, address, receiver):
    from instant_ic.bus import RELIABLE, SENSOR

    node = ours_node(address, f"sub{os.getpid()}")
    for topic in topics:
        qos = RELIABLE if topic.startswith("flood") else SENSOR
        node.subscribe_received(f"/{topic}", lambda received: receiver.got(received.payload), qos)
    return node.spin


def ours_pub(topics, address):
    from instant_ic.bus import RELIABLE, SENSOR

    node = ours_node(address, "pub")
    publishers = {
        topic: node.publisher_raw(
            f"/{topic}", "std_msgs/msg/UInt8MultiArray", RELIABLE if topic.startswith("flood") else SENSOR
        )
        for topic in topics
    }
    threading.Thread(target=node.spin, daemon=True).start()
    return lambda topic, frame: publishers[topic].publish_bytes(frame)


def ours_node(address, name):
    from pathlib import Path

    from instant_ic.bus.clock import SystemClock
    from instant_ic.bus.local_transport import LocalTransport
    from instant_ic.bus.node import Node

    clock = SystemClock()
    node = Node(None, LocalTransport(Path(address), name, clock.now_ns), clock, name)
    node.start()
    return node


def image_sub(topics, address, receiver):
    from instant_ic.bus import SENSOR
    from instant_ic.msg import Image, image_array, stamp_ns

    def on_image(message):
        receiver.got(image_array(message).reshape(-1).data, stamp_ns(message))

    node = ours_node(address, f"sub{os.getpid()}")
    for topic in topics:
        node.subscribe(f"/{topic}", Image, on_image, SENSOR)
    return node.spin


def image_pub(topics, address):
    import numpy as np

    from instant_ic.bus import SENSOR
    from instant_ic.msg import Image, image_message

    node = ours_node(address, "pub")
    publishers = {topic: node.publisher(f"/{topic}", Image, SENSOR) for topic in topics}
    threading.Thread(target=node.spin, daemon=True).start()

    def send(topic, frame):
        picture = np.frombuffer(frame, np.uint8).reshape(1, -1)
        stamp = STAMP.unpack_from(frame, STAMP_AT)[0]
        publishers[topic].publish(image_message(picture, "mono8", "camera", stamp))

    return send


def zmq_sub(topics, address, receiver):
    import zmq

    socket = zmq.Context().socket(zmq.SUB)
    socket.setsockopt(zmq.RCVHWM, 0 if "flood" in "".join(topics) else 32)
    for topic in topics:
        socket.setsockopt(zmq.SUBSCRIBE, topic.encode() + b"\0")
    socket.connect(address)

    def run():
        while True:
            receiver.got(socket.recv_multipart(copy=False)[1].buffer)

    return run


def zmq_pub(topics, address):
    import zmq

    socket = zmq.Context().socket(zmq.PUB)
    socket.bind(address)

    def send(topic, frame):
        socket.send_multipart([topic.encode() + b"\0", frame], copy=len(frame) < 65536)

    return send


def zenoh_session(role, address):
    import zenoh

    config = zenoh.Config()
    config.insert_json5("mode", '"peer"')
    config.insert_json5("scouting/multicast/enabled", "false")
    config.insert_json5("listen/endpoints" if role == "pub" else "connect/endpoints", json.dumps([address]))
    if role == "sub":
        config.insert_json5("listen/endpoints", "[]")
    config.insert_json5("transport/shared_memory/enabled", "true")
    KEEP.append(zenoh.open(config))
    return KEEP[-1]


def zenoh_shm_sub(topics, address, receiver):
    session = zenoh_session("sub", address)

    def on_sample(sample):
        receiver.got(sample.payload.to_bytes())  # its Python binding offers no view of the payload

    KEEP.extend(session.declare_subscriber(topic, on_sample) for topic in topics)
    return threading.Event().wait


def zenoh_shm_pub(topics, address):
    import zenoh

    session = zenoh_session("pub", address)
    provider = zenoh.shm.ShmProvider.default_backend(256 << 20)
    policy = zenoh.shm.GarbageCollect()
    publishers = {topic: session.declare_publisher(topic) for topic in topics}

    def send(topic, frame):
        buffer = provider.alloc(len(frame), policy=policy)
        buffer[:] = frame
        publishers[topic].put(buffer)

    return send


def iceoryx2_node(address):
    import iceoryx2

    iceoryx2.set_log_level(iceoryx2.LogLevel.Fatal)
    node = iceoryx2.NodeBuilder.new().create(iceoryx2.ServiceType.Ipc)

    def service(topic):
        name = iceoryx2.ServiceName.new(f"{address}/{topic}")
        data = node.service_builder(name).publish_subscribe(iceoryx2.Slice[ctypes.c_uint8])
        data = data.subscriber_max_buffer_size(100).open_or_create()
        # It has no blocking receive: one event for all topics wakes the reader.
        return data, node.service_builder(iceoryx2.ServiceName.new(address)).event().open_or_create()

    KEEP.append(node)
    return service


def iceoryx2_sub(topics, address, receiver):
    import iceoryx2
    import numpy

    service = iceoryx2_node(address)
    services = [service(topic) for topic in topics]
    subscribers = [data.subscriber_builder().buffer_size(100).create() for data, _ in services]
    listener = services[0][1].listener_builder().create()

    def run():
        while True:
            listener.timed_wait(iceoryx2.Duration.from_secs(1))
            for subscriber in subscribers:
                while (sample := subscriber.receive()) is not None:
                    receiver.got(numpy.frombuffer(sample.payload().as_memory_view(), numpy.uint8).data)
                    sample.delete()

    return run


def iceoryx2_pub(topics, address):
    service = iceoryx2_node(address)
    publishers = {}
    for topic, size in topics.items():
        data, event = service(topic)
        publisher = data.publisher_builder().initial_max_slice_len(size).create()
        publishers[topic] = publisher, event.notifier_builder().create()

    def send(topic, frame):
        publisher, notifier = publishers[topic]
        sample = publisher.loan_slice_uninit(len(frame))
        ctypes.memmove(sample.payload_ptr, (ctypes.c_char * len(frame)).from_buffer(frame), len(frame))
        sample.assume_init().send()
        notifier.notify()

    return send


def lcm_sub(topics, address, receiver):
    import lcm

    link = lcm.LCM(address)
    for topic in topics:
        link.subscribe(topic, lambda _channel, data: receiver.got(data)).set_queue_capacity(100)

    def run():
        while True:
            link.handle()

    return run


def lcm_pub(topics, address):
    import lcm

    link = lcm.LCM(address)
    return lambda topic, frame: link.publish(topic, bytes(frame))


def main():
    transport, role, wanted, address = sys.argv[1:]
    topics = {name: int(size) for name, size in (word.split("=") for word in wanted.split(","))}
    out = os.fdopen(os.dup(1), "w")
    os.dup2(2, 1)  # keep output of libraries out of the answers

    def answer(value):
        out.write(json.dumps(value) + "\n")
        out.flush()

    if role == "sub":
        receiver = Receiver()
        run = globals()[transport + "_sub"](topics, address, receiver)

        def serve():
            try:
                for _ in sys.stdin:
                    answer(receiver.collect())
            finally:  # whatever the main thread is doing
                os._exit(0)

        threading.Thread(target=serve, daemon=True).start()
        answer("ready")
        run()
        return
    send = globals()[transport + "_pub"](topics, address)
    frames = {}
    answer("ready")
    for line in sys.stdin:
        command = json.loads(line)
        topic = command["topic"]
        if topic not in frames:
            frames = {
                topic: [
                    bytearray(os.urandom(1 << 12) * (topics[topic] // (1 << 12) + 1))[: topics[topic]]
                    for _ in range(FRAMES)
                ]
            }
        ring = frames[topic]
        start = due = time.monotonic()
        sent = 0
        while sent < command["count"] and time.monotonic() - start < command["seconds"]:
            frame = ring[sent % FRAMES]
            STAMP.pack_into(frame, STAMP_AT, time.monotonic_ns())
            send(topic, frame)
            sent += 1
            due += command["period_s"]
            if command["period_s"]:
                time.sleep(max(0.0, due - time.monotonic()))
        answer({"sent": sent, "seconds": time.monotonic() - start})
    os._exit(0)


if __name__ == "__main__":
    main()
