"""The lockstep bus: timers in order, latched values, workers inline, the same result twice."""

from dataclasses import dataclass

import pytest

from instant_ic.bus import LATCHED, Node
from instant_ic.bus.lockstep import LockstepBus
from instant_ic.geometry.poses import pose_matrix
from instant_ic.msg import Float64, String

S = 1_000_000_000


@dataclass(frozen=True)
class DoublerConfig:
    period_s: float = 0.25


class Doubler(Node[DoublerConfig]):
    name = "doubler"

    def setup(self):
        self.out = self.publisher("/double", Float64)
        self.ticks = self.publisher("/ticks", String)
        self.latest_input = self.latest("/number", Float64, max_age_s=0.5)
        self.worker = self.background(lambda x: 2 * x, lambda y: self.out.publish(Float64(data=y)))
        self.subscribe("/number", Float64, lambda m: self.worker.submit(m.data))
        self.timer(self.config.period_s, self.tick)

    def tick(self):
        known = self.latest_input.message
        self.ticks.publish(String(data=f"{self.clock.now_ns() / S:.2f} {known.data if known else '-'}"))


def test_timers_fire_at_their_time_and_freshness_ends():
    with LockstepBus(start_ns=S) as bus:
        bus.add(Doubler)
        bus.publish("/number", Float64(data=4.0), stamp_ns=int(1.3 * S))
        assert [m.data for m in bus.messages("/double")] == [8.0]
        bus.advance_to(int(2.1 * S))
    # Started at 1.00 with 0.25 s: the tick at 1.25 is before the message, those over 0.5 s after it know nothing.
    assert [m.data for m in bus.messages("/ticks")] == ["1.25 -", "1.50 4.0", "1.75 4.0", "2.00 -"]
    assert [r.stamp_ns for r in bus.records("/ticks")] == [int(t * S) for t in (1.25, 1.5, 1.75, 2.0)]


def test_latched_value_reaches_a_node_added_later():
    class Reader(Node[DoublerConfig]):
        name = "reader"

        def setup(self):
            self.heard = []
            self.subscribe("/map", String, lambda m: self.heard.append(m.data), LATCHED)

    with LockstepBus() as bus:
        bus.publish("/map", String(data="old"), latched=True)
        bus.publish("/map", String(data="new"), latched=True)
        assert bus.add(Reader).heard == ["new"]


def test_transforms_and_remaps():
    class Broadcaster(Node[DoublerConfig]):
        name = "broadcaster"

        def setup(self):
            self.transforms.broadcast_static("base_link", "camera", pose_matrix(z=1.2))
            self.transforms.broadcast("odom", "base_link", pose_matrix(x=1.0), 2 * S)
            self.publisher("/a", String).publish(String(data="x"))

    class Asker(Node[DoublerConfig]):
        name = "asker"

        def setup(self):
            assert self.tf is not None

    with LockstepBus() as bus:
        asker = bus.add(Asker)
        bus.add(Broadcaster, remaps={"/a": "/b"}, namespace="")
        assert asker.tf.lookup("odom", "camera")[:3, 3] == pytest.approx([1.0, 0.0, 1.2])
        assert [m.data for m in bus.messages("/b")] == ["x"]


def test_error_in_a_callback_is_not_hidden():
    class Broken(Node[DoublerConfig]):
        name = "broken"

        def setup(self):
            self.subscribe("/number", Float64, lambda m: 1 / 0)

    bus = LockstepBus()
    bus.add(Broken)
    with pytest.raises(ZeroDivisionError):
        bus.publish("/number", Float64(data=0.0))


def test_nodes_that_answer_each_other_for_ever_are_found():
    class Echo(Node[DoublerConfig]):
        name = "echo"

        def setup(self):
            out = self.publisher("/ball", Float64)
            self.subscribe("/ball", Float64, out.publish)

    bus = LockstepBus()
    bus.add(Echo)
    with pytest.raises(RuntimeError, match="endlessly"):
        bus.publish("/ball", Float64(data=0.0))
