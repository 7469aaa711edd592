"""What users of other recorders and players complain about, by name: here it does not happen."""

import threading
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pytest

from instant_ic.bag import BagReader, BagWriter
from instant_ic.bag.choice import TopicChoice
from instant_ic.bag.player import BagPlayer, PlayOptions
from instant_ic.bag.recorder import BagRecorderConfig, Recorder
from instant_ic.bus import LATCHED, RELIABLE, SENSOR, Node
from instant_ic.bus.lockstep import LockstepBus
from instant_ic.bus.qos import QoS
from instant_ic.bus.registry import PublisherInfo, TopicInfo
from instant_ic.geometry.transforms import TransformError
from instant_ic.msg import (
    Clock,
    Float32,
    TFMessage,
    deserialize,
    serialize,
    to_time,
    transform_message,
)

BOOL, FLOAT, TF = "std_msgs/msg/Bool", "std_msgs/msg/Float32", "tf2_msgs/msg/TFMessage"
S = 1_000_000_000


class Losses:
    lost = 0
    lost_by: dict[str, int] = {}  # noqa: RUF012


def tf_static(*children: str) -> bytes:
    transforms = [transform_message(np.eye(4), "base_link", child, 1) for child in children]
    return bytes(serialize(TFMessage(transforms)))


def recorder(path: Path, presets: dict[str, QoS], **options: object) -> Recorder:
    made = Recorder(path, TopicChoice(), lambda topic, take: Losses(), None, BagRecorderConfig(**options))  # type: ignore[arg-type]
    for topic, qos in presets.items():
        made.discover([TopicInfo(topic, BOOL, [PublisherInfo("n", 1, qos.name, Path("s"), BOOL, "00", 0)])])
    return made


def frames(path: Path) -> list[list[str]]:
    with BagReader(path) as reader:
        messages = [deserialize(m.payload, m.type_name) for m in reader.messages({"/tf_static"})]
    return [[t.child_frame_id for t in message.transforms] for message in messages]


def test_rosbag2_1049_latched_topic_published_before_the_recording_is_in_the_bag(tmp_path: Path) -> None:
    made = recorder(tmp_path / "bag", {"/tf_static": LATCHED, "/scan": SENSOR})
    made.take("/tf_static", TF, tf_static("camera"), 5 * S, "camera")  # sent an hour ago, served on joining
    made.take("/scan", BOOL, b"x", 3600 * S, "lidar")
    made.close()
    with BagReader(tmp_path / "bag") as reader:
        assert [(m.topic, m.stamp_ns // S) for m in reader.messages()] == [("/tf_static", 3600), ("/scan", 3600)]
        assert {t.topic: t.qos.name for t in reader.topics}["/tf_static"] == "latched"
    # And whoever plays from the middle gets it as well.
    player = BagPlayer(tmp_path / "bag", PlayOptions())
    sent: list[str] = []
    player.play(lambda message: sent.append(message.topic), threading.Event())
    player.close()
    assert sent == ["/tf_static", "/scan"]


@dataclass(frozen=True)
class NoParameters:
    pass


class Follower(Node[NoParameters]):
    """Follows the simulated clock and notes when what happened."""

    name = "follower"

    def setup(self) -> None:
        self.times: list[tuple[str, float]] = []
        self.fresh = self.latest("/scan", Float32, max_age_s=1.0)
        self.subscribe("/scan", Float32, lambda m: self.note("scan"))
        self.timer(1.0, lambda: self.note("timer"))
        _ = self.tf

    def note(self, what: str) -> None:
        self.times.append((what, self.clock.now_ns() / S))


@pytest.fixture
def follower() -> Follower:
    """On a bus without threads, with a clock of its own that starts at 0 as in a process."""
    bus = LockstepBus(start_ns=0)
    source = bus.add(Follower)  # for a transport
    node = Follower(NoParameters(), source._transport, bus.clock, "other", lockstep=True, use_sim_time=True)
    node.start()
    node.bus = bus  # type: ignore[attr-defined]
    return node


def publish(node: Follower, topic: str, message: object) -> None:
    node.bus.publish(topic, message)  # type: ignore[attr-defined]


def tick(node: Follower, seconds: float) -> None:
    publish(node, "/clock", Clock(clock=to_time(int(seconds * S))))
    node.spin_once()


def test_rosbag2_1276_nothing_happens_at_time_zero_before_the_first_clock(follower: Follower) -> None:
    publish(follower, "/scan", Float32(data=1.0))  # overtakes the clock, as topics on other sockets may
    for _ in range(3):
        follower.spin_once()
    assert follower.times == []
    tick(follower, 1000.0)
    follower.spin_once()
    assert follower.times == [("scan", 1000.0)]  # it was kept, and is handed over at the bag's time
    tick(follower, 1000.9)
    tick(follower, 1001.0)
    assert follower.times[1:] == [("timer", 1001.0)]  # a period of a second begins with the time, not before it


def test_rosbag2_1276_the_clock_is_the_first_thing_that_a_player_sends(tmp_path: Path) -> None:
    with BagWriter(tmp_path / "bag") as writer:
        writer.write("/tf_static", TF, tf_static("camera"), 5 * S, LATCHED)
        writer.write("/scan", BOOL, b"x", 7 * S, SENSOR)
    for start_s in (0.0, 1.0):
        player = BagPlayer(tmp_path / "bag", PlayOptions(start_offset_s=start_s, rate=100.0))
        order: list[tuple[str, float]] = []
        player.play(
            lambda m: order.append((m.topic, m.stamp_ns / S)),  # noqa: B023
            threading.Event(),
            on_clock=lambda ns: order.append(("clock", ns / S)),  # noqa: B023
        )
        player.close()
        assert order[0] == ("clock", 5.0 + start_s) and all(at > 0 for _, at in order)


def test_a_loop_of_the_player_does_not_stop_timers_or_keep_old_data_fresh(follower: Follower) -> None:
    """Time goes back when a bag begins again: without care timers wait for the old time to come round."""
    for second in (100.0, 101.5, 103.0):
        tick(follower, second)
    publish(follower, "/tf", TFMessage([transform_message(np.eye(4), "map", "odom", int(102.9 * S))]))
    publish(follower, "/tf_static", TFMessage([transform_message(np.eye(4), "base_link", "camera", 1)]))
    publish(follower, "/scan", Float32(data=1.0))
    follower.spin_once()
    assert follower.fresh.message is not None and follower.tf.lookup("map", "odom") is not None
    follower.times.clear()
    tick(follower, 50.0)  # the bag begins again
    assert follower.fresh.message is None  # of 53 s in the future
    with pytest.raises(TransformError):
        follower.tf.lookup("map", "odom")
    assert follower.tf.lookup("base_link", "camera") is not None  # fixed
    for second in (50.5, 51.2, 52.4):
        tick(follower, second)
    assert [at for what, at in follower.times if what == "timer"] == [51.2, 52.4]


def test_dora_2152_a_player_ends_with_its_bag_even_when_reading_fails(tmp_path: Path) -> None:
    with BagWriter(tmp_path / "bag") as writer:
        writer.write("/x", FLOAT, bytes(serialize(Float32(data=1.0))), S, RELIABLE)
    player = BagPlayer(tmp_path / "bag", PlayOptions(loop=True, rate=100.0))
    stop = threading.Event()
    thread = threading.Thread(target=lambda: player.play(lambda m: None, stop))
    thread.start()
    stop.set()
    thread.join(20)
    assert not thread.is_alive()
    player.close()
