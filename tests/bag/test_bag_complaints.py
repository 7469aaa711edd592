"""What users of other recorders and players complain about, by name: here it does not happen."""

import json
import threading
import time
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
    Bool,
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


def test_rosbag2_1159_latched_topics_are_in_every_file_of_a_split_bag(tmp_path: Path) -> None:
    made = recorder(tmp_path / "bag", {"/tf_static": LATCHED, "/scan": SENSOR}, max_bag_duration=10.0)
    made.take("/tf_static", TF, tf_static("camera"), 1 * S, "camera")
    made.take("/tf_static", TF, tf_static("velodyne"), 1 * S, "lidar")
    for second in range(1, 40):
        made.take("/scan", BOOL, b"x", second * S, "lidar")
    made.close()
    files = sorted((tmp_path / "bag").glob("*.mcap"))
    assert len(files) == 4
    for file in files:
        assert sorted(frames(file)) == [["camera"], ["velodyne"]]  # both publishers' values
    assert sorted(frames(tmp_path / "bag")) == [["camera"], ["velodyne"]]  # and once in the bag as a whole


def test_ros_comm_706_a_later_latched_value_replaces_the_earlier_in_the_next_file(tmp_path: Path) -> None:
    with BagWriter(tmp_path / "bag", max_duration_s=10.0) as writer:
        for second in range(25):
            writer.write("/scan", BOOL, b"x", second * S, SENSOR)
            if second in (2, 5):
                writer.write("/tf_static", TF, tf_static("camera", *["arm"] * (second == 5)), second * S, LATCHED)
    assert frames(tmp_path / "bag" / "bag_0.mcap") == [["camera"], ["camera", "arm"]]
    assert frames(tmp_path / "bag" / "bag_1.mcap") == frames(tmp_path / "bag" / "bag_2.mcap") == [["camera", "arm"]]


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


def test_dora_3518_a_recorder_that_cannot_follow_says_so(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    import os

    made = recorder(tmp_path / "bag", {"/scan": SENSOR}, queue_mb=1)
    made.take("/scan", BOOL, b"x", S)
    slow, write = threading.Event(), os.write
    monkeypatch.setattr(os, "write", lambda fd, data: (slow.wait(60), write(fd, data))[1])
    for index in range(30):
        made.take("/scan", BOOL, b"x" * 100_000, 2 * S + index)
    told = made.status()["overflow"]["/scan"]
    assert told >= 15
    slow.set()
    made.close()
    with BagReader(tmp_path / "bag") as reader:
        assert json.loads(reader.custom["instant_ic.overflow"]) == {"/scan": told}
        assert reader.count == 31 - told


def test_rerun_recording_does_not_block_the_control_loop(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    import os

    made = recorder(tmp_path / "bag", {"/image": SENSOR})
    made.take("/image", BOOL, b"x", S)
    slow, write = threading.Event(), os.write
    monkeypatch.setattr(os, "write", lambda fd, data: (slow.wait(60), write(fd, data))[1])
    picture = bytes(5_500_000)
    began_s = time.monotonic()
    for index in range(20):  # 110 MB while the disk takes nothing at all
        made.take("/image", BOOL, memoryview(picture), 2 * S + index)
    assert time.monotonic() - began_s < 20  # it would wait 60 s for the disk
    assert not slow.is_set()
    slow.set()
    made.close()
    with BagReader(tmp_path / "bag") as reader:
        assert reader.count == 21


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


def test_lerobot_a_picture_costs_its_bytes_and_no_more(tmp_path: Path) -> None:
    """Base64 in JSON costs a third; here a message costs 31 bytes of head, and 16 in the index."""
    with BagWriter(tmp_path / "bag") as writer:
        for index in range(20):
            writer.write("/image", BOOL, bytes(500_000), index, SENSOR)
    size = (tmp_path / "bag" / "bag.mcap").stat().st_size
    assert size < 20 * (500_000 + 47) + 6_000


def test_message_of_a_type_nobody_knows_is_kept(tmp_path: Path) -> None:
    made = recorder(tmp_path / "bag", {"/odd": SENSOR})
    made.take("/odd", "their_msgs/msg/Odd", b"\x00\x01\x00\x00?", S)
    made.take("/flag", BOOL, bytes(serialize(Bool(data=True))), S)
    made.close()
    assert made.unknown_types() == {"their_msgs/msg/Odd": "/odd"}
    with BagReader(tmp_path / "bag") as reader:
        assert reader.count == 2
