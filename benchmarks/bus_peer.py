#!/usr/bin/env python3
"""One side of one transport, for benchmarks/bus.py; controlled by JSON lines on standard input.

Runs under any Python 3.9, because rospy needs Debian's own interpreter. A frame carries the send time (CLOCK_MONOTONIC,
one clock for all processes of a machine) at byte 8. A receiver reads one byte of every 4096 before it takes the time,
so that a transport gains nothing by delivering data that is not yet in memory.

    bus_peer.py TRANSPORT pub|sub TOPIC=BYTES,... ADDRESS
"""

from __future__ import annotations

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
        node.subscribe_raw(f"/{topic}", lambda _t, _n, payload, _s: receiver.got(payload), qos)
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


def inline_pub(topics, address):
    return _ours_pub_sharing_from(1 << 40, topics, address)


def shared_pub(topics, address):
    return _ours_pub_sharing_from(1, topics, address)


def _ours_pub_sharing_from(size, topics, address):
    from instant_ic.bus import local_publisher

    local_publisher.SHARED_FROM_BYTES = size
    return ours_pub(topics, address)


inline_sub = shared_sub = ours_sub


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


def zmq_curve_sub(topics, address, receiver):
    return _zmq_curve("SUB", topics, address, receiver)


def zmq_curve_pub(topics, address):
    return _zmq_curve("PUB", topics, address, None)


def _zmq_curve(kind, topics, address, receiver):
    import zmq

    # Keys for this measurement only; they are public.
    public, secret = b"Yne@$w-vo<fVvi]a<NY6T1ed:M$fCG*[IaLV{hID", b"D:)Q[IlAW!ahhC2ac:9*A}h:p?([4%wOTJ%JR%cs"
    socket = zmq.Context().socket(getattr(zmq, kind))
    socket.curve_publickey, socket.curve_secretkey = public, secret
    if kind == "PUB":
        socket.curve_server = True
        socket.bind(address)

        def send(topic, frame):
            socket.send_multipart([topic.encode() + b"\0", frame], copy=len(frame) < 65536)

        return send
    socket.curve_serverkey = public
    for topic in topics:
        socket.setsockopt(zmq.SUBSCRIBE, topic.encode() + b"\0")
    socket.connect(address)

    def run():
        while True:
            receiver.got(socket.recv_multipart(copy=False)[1].buffer)

    return run


zmq_tcp_sub, zmq_tcp_pub = zmq_sub, zmq_pub


def zenoh_session(role, address, shared):
    import zenoh

    config = zenoh.Config()
    config.insert_json5("mode", '"peer"')
    config.insert_json5("scouting/multicast/enabled", "false")
    config.insert_json5("listen/endpoints" if role == "pub" else "connect/endpoints", json.dumps([address]))
    if role == "sub":
        config.insert_json5("listen/endpoints", "[]")
    config.insert_json5("transport/shared_memory/enabled", json.dumps(shared))
    KEEP.append(zenoh.open(config))
    return KEEP[-1]


def zenoh_tcp_sub(topics, address, receiver):
    return _zenoh_sub(topics, address, receiver, False)


def zenoh_shm_sub(topics, address, receiver):
    return _zenoh_sub(topics, address, receiver, True)


def _zenoh_sub(topics, address, receiver, shared):
    session = zenoh_session("sub", address, shared)

    def on_sample(sample):
        receiver.got(sample.payload.to_bytes())  # its Python binding offers no view of the payload

    KEEP.extend(session.declare_subscriber(topic, on_sample) for topic in topics)
    return threading.Event().wait


def zenoh_tcp_pub(topics, address):
    session = zenoh_session("pub", address, False)
    publishers = {topic: session.declare_publisher(topic) for topic in topics}
    return lambda topic, frame: publishers[topic].put(bytes(frame))


def zenoh_shm_pub(topics, address):
    import zenoh

    session = zenoh_session("pub", address, True)
    provider = zenoh.shm.ShmProvider.default_backend(256 << 20)
    policy = zenoh.shm.GarbageCollect()
    publishers = {topic: session.declare_publisher(topic) for topic in topics}

    def send(topic, frame):
        buffer = provider.alloc(len(frame), policy=policy)
        buffer[:] = frame
        publishers[topic].put(buffer)

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


def rospy_sub(topics, address, receiver):
    import rospy
    from std_msgs.msg import UInt8MultiArray

    os.environ["ROS_MASTER_URI"] = address
    rospy.init_node("sub", anonymous=True, disable_signals=True)
    for topic in topics:
        rospy.Subscriber(
            topic, UInt8MultiArray, lambda m: receiver.got(m.data), queue_size=1, buff_size=1 << 24, tcp_nodelay=True
        )
    return rospy.spin


def rospy_pub(topics, address):
    import rospy
    from std_msgs.msg import UInt8MultiArray

    os.environ["ROS_MASTER_URI"] = address
    rospy.init_node("pub", anonymous=True, disable_signals=True)
    publishers = {topic: rospy.Publisher(topic, UInt8MultiArray, queue_size=10, tcp_nodelay=True) for topic in topics}
    return lambda topic, frame: publishers[topic].publish(UInt8MultiArray(data=bytes(frame)))


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
                    answer({**receiver.collect(), "cpu_s": time.process_time()})
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
        cpu = time.process_time()
        sent = 0
        while sent < command["count"] and time.monotonic() - start < command["seconds"]:
            frame = ring[sent % FRAMES]
            STAMP.pack_into(frame, STAMP_AT, time.monotonic_ns())
            send(topic, frame)
            sent += 1
            due += command["period_s"]
            if command["period_s"]:
                time.sleep(max(0.0, due - time.monotonic()))
        answer({"sent": sent, "seconds": time.monotonic() - start, "cpu_s": time.process_time() - cpu})
    os._exit(0)


if __name__ == "__main__":
    main()
