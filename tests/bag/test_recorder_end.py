"""What has arrived when a recorder ends belongs to the bag."""

import time
from collections.abc import Callable
from pathlib import Path

import pytest
import zmq

from instant_ic.bag import BagReader
from instant_ic.bus import RELIABLE, registry
from instant_ic.bus.clock import SystemClock
from instant_ic.bus.local_subscription import LocalSubscription
from instant_ic.bus.local_transport import LocalTransport
from nodes.bag_recorder import BagRecorderConfig, BagRecorderNode


def wait_for(what: Callable[[], bool]) -> None:
    deadline = time.monotonic() + 60.0
    while not what():
        assert time.monotonic() < deadline
        time.sleep(0.005)


def test_messages_in_the_sockets_at_the_end_are_in_the_bag(
    tmp_path: Path, tmp_path_factory: pytest.TempPathFactory
) -> None:
    run_dir = registry.prepare(tmp_path_factory.mktemp("r"))
    clock = SystemClock()
    sender = LocalTransport(run_dir, "sender", clock.now_ns)
    publisher = sender.advertise("/a", "std_msgs/msg/Bool", RELIABLE)
    transport = LocalTransport(run_dir, "bag_recorder", clock.now_ns)
    node = BagRecorderNode(BagRecorderConfig(path=str(tmp_path / "bag"), topics=("/a",)), transport, clock)
    try:
        node.be_patient(True)  # only a wait of the node's own thread reads its sockets
        node.start()
        subscription = node.subscriptions[-1].raw
        assert isinstance(subscription, LocalSubscription) and subscription.topic == "/a"
        wait_for(lambda: publisher.subscriber_count == 1)
        publisher.send(b"\0\1\0\0\1")

        def arrived() -> bool:
            with transport.read_lock:
                return bool(int(subscription.socket.getsockopt(zmq.EVENTS)) & zmq.POLLIN)

        wait_for(arrived)
    finally:
        node.close()
        sender.close()
    with BagReader(tmp_path / "bag") as reader:
        assert [m.payload for m in reader.messages({"/a"})] == [b"\0\1\0\0\1"]
