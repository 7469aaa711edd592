"""Nodes on ``/clock``: nothing runs before its first value, and time may go back as when a player begins again."""

import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pytest

from instant_ic.bus import RELIABLE
from instant_ic.bus.clock import ManualClock, SystemClock
from instant_ic.bus.local_transport import LocalTransport
from instant_ic.bus.node import Node
from instant_ic.geometry.transforms import TransformError
from instant_ic.msg import String, message_type, to_time

S = 1_000_000_000


@dataclass(frozen=True)
class ListenerConfig:
    pass


class Listener(Node[ListenerConfig]):
    name = "listener"

    def setup(self) -> None:
        self.heard: list[tuple[str, int]] = []
        self.ticks: list[int] = []
        self.latest_word = self.latest("/chatter", String, max_age_s=5.0, qos=RELIABLE)
        self.subscribe("/chatter", String, lambda m: self.heard.append((m.data, self.clock.now_ns())), qos=RELIABLE)
        self.timer(1.0, lambda: self.ticks.append(self.clock.now_ns()))


@dataclass(frozen=True)
class PlayerConfig:
    pass


class Player(Node[PlayerConfig]):
    name = "player"

    def setup(self) -> None:
        self.words = self.publisher("/chatter", String, qos=RELIABLE)
        self.clock_out = self.publisher("/clock", message_type("Clock"), qos=RELIABLE)

    def show(self, now_ns: int) -> None:
        self.clock_out.publish(message_type("Clock")(clock=to_time(now_ns)))


@pytest.fixture
def nodes(tmp_path_factory: pytest.TempPathFactory) -> Iterator[tuple[Listener, Player]]:
    run_dir: Path = tmp_path_factory.mktemp("r")
    clock, system = ManualClock(), SystemClock()
    listener = Listener(
        ListenerConfig(), LocalTransport(run_dir, "listener", clock.now_ns, clock.steady_ns), clock, use_sim_time=True
    )
    player = Player(PlayerConfig(), LocalTransport(run_dir, "player", system.now_ns), system)
    listener.start()
    player.start()
    wait_for(lambda: player.words.subscriber_count == 2 and player.clock_out.subscriber_count == 1, listener)
    yield listener, player
    listener.close()
    player.close()


def wait_for(condition: Callable[[], bool], node: Node[ListenerConfig], timeout_s: float = 30.0) -> None:
    deadline = time.monotonic() + timeout_s
    while not condition():
        assert time.monotonic() < deadline, "waited too long"
        node.spin_once()
        time.sleep(0.005)


def test_rosbag2_1276_nothing_runs_at_time_0_before_the_first_clock(nodes: tuple[Listener, Player]) -> None:
    listener, player = nodes
    player.words.publish(String(data="early"))
    for _ in range(40):
        listener.spin_once()
        time.sleep(0.01)
    assert listener.heard == [] and listener.ticks == [] and listener.clock.now_ns() == 0
    player.show(1000 * S)
    wait_for(lambda: len(listener.heard) == 1, listener)
    assert listener.heard == [("early", 1000 * S)]  # it waited, and was not lost
    assert all(tick >= 1000 * S for tick in listener.ticks)


def test_time_that_goes_back_stalls_no_timer_and_keeps_nothing_of_the_future(nodes: tuple[Listener, Player]) -> None:
    listener, player = nodes
    player.show(1000 * S)
    wait_for(lambda: listener.clock.now_ns() == 1000 * S, listener)
    player.words.publish(String(data="word"))
    wait_for(lambda: listener.latest_word.message is not None, listener)
    listener.tf.set("odom", "base_link", 1000 * S, np.eye(4))
    listener.ticks.clear()
    player.show(500 * S)
    wait_for(lambda: listener.clock.now_ns() == 500 * S, listener)
    assert listener.latest_word.message is None  # it came in a future that is no more
    with pytest.raises(TransformError):
        listener.tf.lookup("odom", "base_link")
    player.show(501 * S)
    wait_for(lambda: bool(listener.ticks), listener)
    assert listener.ticks == [501 * S]
