"""A client of Foxglove's protocol (ws-protocol, spec.md) over a real WebSocket, and a run directory with the bridge."""

import contextlib
import json
import struct
import time
from collections import deque
from dataclasses import dataclass

from live_nodes import LiveNode, Neighbour
from websockets.sync.client import connect

from instant_ic.bus import registry
from instant_ic.bus.node import Node
from nodes.foxglove_bridge import FoxgloveBridgeConfig, FoxgloveBridgeNode


class Client:
    """A client of Foxglove's protocol."""

    def __init__(self, port, host="127.0.0.1", protocol="foxglove.sdk.v1", path="", **options):
        self._open = contextlib.ExitStack()
        self.socket = self._open.enter_context(
            connect(f"ws://{host}:{port}{path}", subprotocols=[protocol], max_size=None, compression=None, **options)
        )
        self.channels = {}
        self.messages = deque()
        self.texts = deque()
        self.info = self.until(lambda: self.text("serverInfo"), "serverInfo")

    def send(self, **content):
        self.socket.send(json.dumps(content))

    def poll(self, timeout_s=0.02):
        """Takes what comes within the time."""
        with contextlib.suppress(TimeoutError):
            frame = self.socket.recv(timeout_s)
            if isinstance(frame, bytes):
                if frame[0] == 1:
                    subscription, log_time = struct.unpack_from("<IQ", frame, 1)
                    self.messages.append((subscription, log_time, frame[13:]))
                return
            content = json.loads(frame)
            if content["op"] == "advertise":
                self.channels.update({c["topic"]: c for c in content["channels"]})
            elif content["op"] == "unadvertise":
                for topic in [t for t, c in self.channels.items() if c["id"] in content["channelIds"]]:
                    del self.channels[topic]
            else:
                self.texts.append(content)

    def text(self, op):
        return next((t for t in self.texts if t["op"] == op), None)

    def until(self, condition, what, timeout_s=30.0):
        deadline = time.monotonic() + timeout_s
        while not (value := condition()):
            assert time.monotonic() < deadline, f"no {what} within {timeout_s:g} s"
            self.poll()
        return value

    def spin(self, seconds):
        end = time.monotonic() + seconds
        while time.monotonic() < end:
            self.poll()

    def subscribe(self, topic, number=1):
        channel = self.until(lambda: self.channels.get(topic), f"advertisement of {topic}")
        self.send(op="subscribe", subscriptions=[{"id": number, "channelId": channel["id"]}])
        return channel

    def unsubscribe(self, number=1):
        self.send(op="unsubscribe", subscriptionIds=[number])

    def parameters(self, *names, request="r"):
        self.texts.clear()
        self.send(op="getParameters", parameterNames=list(names), id=request)
        answer = self.until(lambda: self.text("parameterValues"), "parameters")
        assert answer["id"] == request
        return {p["name"]: p["value"] for p in answer["parameters"]}

    def close(self):
        self._open.close()


class FoxgloveWorld:
    """A run directory with the bridge, and ways to its bus and its server; everything is ended afterwards."""

    def __init__(self, run_dir):
        self.run_dir = run_dir
        self._open = contextlib.ExitStack()

    def __enter__(self):
        return self

    def __exit__(self, *error):
        self.close()

    def close(self):
        """End the clients, the bridge and what is beside it."""
        self._open.close()

    def keep(self, thing):
        self._open.callback(thing.close)
        return thing

    def bridge(self, **parameters):
        config = FoxgloveBridgeConfig(port=0, **{"simulated": True, **parameters})
        self.live = self.keep(LiveNode(self.run_dir, FoxgloveBridgeNode, config, "foxglove_bridge"))
        return self.live.node

    def client(self, **options):
        return self.keep(Client(self.live.node.server.port, **options))

    def neighbour(self, name="talker"):
        return self.keep(Neighbour(self.run_dir, name))

    def running(self, node_class, config, name):
        """A node with parameters, in the registry as every process of the stack."""
        node = self.keep(LiveNode(self.run_dir, node_class, config, name)).node
        claim = registry.Claim(self.run_dir / "nodes" / name, f"node {name}")
        self._open.callback(claim.release)
        claim.write({**node.describe(), "started_ns": 1})
        return node


@dataclass(frozen=True)
class TalkerConfig:
    """Attributes:
    rate_hz: how often.
    words: what.
    """

    rate_hz: float = 2.0
    words: str = "hello"
    places: tuple[float, ...] = (1.0, 2.5)

    def __post_init__(self) -> None:
        if self.rate_hz <= 0:
            raise ValueError(f"rate_hz must be > 0 (got {self.rate_hz})")


class TalkerNode(Node[TalkerConfig]):
    name = "talker"
    live_parameters = ("rate_hz", "places")
