from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pytest

from instant_ic.bag import BagError, BagReader, BagWriter, Schema
from instant_ic.bag.compare import compare
from instant_ic.bag.metadata import with_hash
from instant_ic.bag.replay import ReplayError, ReplayNode, make_node, replay
from instant_ic.bus import LATCHED, RELIABLE, SENSOR, Node
from instant_ic.bus.node_files import NodeFileError
from instant_ic.geometry.transforms import TransformError
from instant_ic.msg import (
    Bool,
    Float32,
    LaserScan,
    TFMessage,
    deserialize,
    scan_message,
    serialize,
    stamp_ns,
    transform_message,
)

START_NS = 1_700_000_000_000_000_000
TENTH_NS = 100_000_000


@dataclass(frozen=True)
class MeanConfig:
    gain: float = 1.0


class MeanNode(Node[MeanConfig]):
    """Mean range of each scan, by a background worker; a timer counts; broadcasts map → odom like a SLAM."""

    name = "mean"

    def setup(self) -> None:
        self.out = self.publisher("/mean", Float32, qos=SENSOR)
        self.ticks = self.publisher("/ticks", Float32, qos=LATCHED)
        self.count = 0
        self.seen: list[str] = []
        _ = self.tf
        self.worker = self.background(lambda scan: float(scan.ranges.mean()), self.on_result)
        self.subscribe("/scan", LaserScan, self.on_scan)
        self.timer(0.25, self.tick)

    def on_scan(self, message: LaserScan) -> None:
        for parent, child in (("map", "odom"), ("odom", "base_link"), ("base_link", "velodyne")):
            try:
                matrix = self.tf.lookup(parent, child)
                self.seen.append(f"{parent}->{child} {matrix[0, 3]:g}")
            except TransformError:
                pass
        self.transforms.broadcast("map", "odom", np.eye(4), stamp_ns(message))
        self.worker.submit(message)

    def on_result(self, mean: float) -> None:
        self.out.publish(Float32(data=mean * self.config.gain))

    def tick(self) -> None:
        self.count += 1
        self.ticks.publish(Float32(data=float(self.count)))


def shift(x: float) -> np.ndarray:
    matrix = np.eye(4)
    matrix[0, 3] = x
    return matrix


def tf(*entries: tuple[str, str, float], stamp: int = START_NS) -> bytes:
    transforms = [transform_message(shift(x), parent, child, stamp) for parent, child, x in entries]
    return bytes(serialize(TFMessage(transforms=transforms)))


@pytest.fixture
def bag(tmp_path: Path) -> Path:
    """Ten scans at 10 Hz with means 0, 1, ... 9, transforms, and the recorded node's own output."""
    rng = np.random.default_rng(0)
    scan_type, float_type, tf_type = "sensor_msgs/msg/LaserScan", "std_msgs/msg/Float32", "tf2_msgs/msg/TFMessage"
    with BagWriter(tmp_path / "bag") as writer:
        writer.write("/tf_static", tf_type, tf(("base_link", "velodyne", 0.5)), START_NS, LATCHED)
        for index in range(10):
            stamp = START_NS + index * TENTH_NS
            ranges = rng.permutation(np.array([index - 0.5, index + 0.5] * 4, np.float32))
            scan = bytes(serialize(scan_message(ranges, 0, 0.1, 0.1, 30, "velodyne", stamp)))
            own = ("map", "odom", 99.0)  # of the recorded run: must not reach the replayed node
            writer.write("/tf", tf_type, tf(own, ("odom", "base_link", index), stamp=stamp), stamp, RELIABLE)
            writer.write("/scan", scan_type, scan, stamp, SENSOR)
            writer.write("/mean", float_type, bytes(serialize(Float32(data=-1.0))), stamp, SENSOR)
        writer.write("/heartbeat", "std_msgs/msg/Bool", bytes(serialize(Bool(data=True))), START_NS, RELIABLE)
    return tmp_path / "bag"


def mean_node(gain: float = 1.0) -> ReplayNode:
    return ReplayNode("mean", MeanNode, MeanConfig(gain))


def values(bag: Path, topic: str) -> list[tuple[float, float]]:
    """(Seconds since the start of the bag, value) of a Float32 topic."""
    with BagReader(bag) as reader:
        return [
            (round((m.stamp_ns - START_NS) / 1e9, 6), deserialize(m.payload, m.type_name).data)
            for m in reader.messages({topic})
        ]


def test_replay_makes_the_nodes_output_at_the_bags_time(bag: Path, tmp_path: Path) -> None:
    shares: list[float] = []
    result = replay(bag, [mean_node(2.0)], tmp_path / "out", ("odom",), shares.append)
    assert values(tmp_path / "out", "/mean") == [(round(0.1 * i, 6), 2.0 * i) for i in range(10)]
    # The bag lasts 0.9 s: the timer of 0.25 s fires three times, at its own times.
    assert values(tmp_path / "out", "/ticks") == [(0.25, 1.0), (0.5, 2.0), (0.75, 3.0)]
    assert result.made == {"/mean": 10, "/ticks": 3, "/tf": 10}
    assert result.left_out == {"/mean": 10, "/heartbeat": 1}
    assert result.fed == {"/tf_static": 1, "/tf": 10, "/scan": 10}
    assert shares[-1] == 1.0 and shares == sorted(shares)
    with BagReader(tmp_path / "out") as reader:
        assert {t.topic: t.qos.name for t in reader.topics}["/ticks"] == "latched"


def test_twice_the_same_bytes(bag: Path, tmp_path: Path) -> None:
    for folder in ("one", "two"):
        replay(bag, [mean_node()], tmp_path / folder / "out")
    assert all(topic.same for topic in compare(tmp_path / "one" / "out", tmp_path / "two" / "out"))
    assert all(topic.same for topic in compare(tmp_path / "one" / "out", tmp_path / "two" / "out"))
    first, second = (tmp_path / folder / "out" / "out.mcap" for folder in ("one", "two"))
    assert first.read_bytes() == second.read_bytes()
    replay(bag, [mean_node(1.5)], tmp_path / "other")
    different = {t.topic: t.first for t in compare(tmp_path / "one" / "out", tmp_path / "other")}
    assert different["/mean"].startswith("message 2: data is 1.0 and 1.5")  # the first mean is 0 either way
    assert different["/ticks"] == "" == different["/tf"]


@pytest.mark.parametrize("drop", [("odom",), ()])
def test_transforms_that_a_replayed_node_broadcasts_are_not_fed(
    bag: Path, tmp_path: Path, drop: tuple[str, ...], monkeypatch: pytest.MonkeyPatch
) -> None:
    made: list[MeanNode] = []

    class Remembered(MeanNode):
        def setup(self) -> None:
            super().setup()
            made.append(self)

    replay(bag, [ReplayNode("mean", Remembered, MeanConfig())], tmp_path / "out", drop)
    seen = made[0].seen
    # Other transforms arrive, whole; the recorded run's map → odom never does once the frame is known to be ours.
    assert seen.count("base_link->velodyne 0.5") == 10
    assert [s for s in seen if s.startswith("odom->")] == [f"odom->base_link {i}" for i in range(10)]
    recorded, own = seen.count("map->odom 99"), seen.count("map->odom 0")
    assert (recorded, own) == ((0, 9) if drop else (1, 9))


def test_frame_that_a_slam_broadcasts_in_anothers_place_is_still_fed(bag: Path, tmp_path: Path) -> None:
    made: list[MeanNode] = []

    class StandIn(MeanNode):
        """Broadcasts the base's frame once, as a SLAM does before the wheel odometry comes."""

        def setup(self) -> None:
            super().setup()
            made.append(self)

        def on_scan(self, message: LaserScan) -> None:
            if not self.seen:
                self.transforms.broadcast("odom", "base_link", shift(50.0), stamp_ns(message))
            super().on_scan(message)

    replay(bag, [ReplayNode("grid_slam", StandIn, MeanConfig())], tmp_path / "out")
    odometry = [entry for entry in made[0].seen if entry.startswith("odom->base_link")]
    assert odometry[-1] == "odom->base_link 9"  # the wheels' own, to the end
    assert "map->odom 99" not in made[0].seen  # while the SLAM's own frame is left out from the beginning


def test_what_cannot_be_replayed_is_told(bag: Path, tmp_path: Path) -> None:
    with pytest.raises(NodeFileError, match="no node 'warp'"):
        make_node("warp", None, [])
    with pytest.raises(BagError, match="already exists"):
        replay(bag, [mean_node()], bag)
    BagWriter(tmp_path / "empty").close()
    with pytest.raises(BagError, match="is empty"):
        replay(tmp_path / "empty", [mean_node()], tmp_path / "out")


def test_type_of_another_definition_is_refused(tmp_path: Path) -> None:
    theirs = with_hash(Schema("sensor_msgs/msg/LaserScan", "ros2msg", "uint8 number\n", ""))
    with BagWriter(tmp_path / "bag") as writer:
        writer.write("/scan", theirs.name, b"\x00\x01\x00\x00\x2a", START_NS, SENSOR, theirs)
    with pytest.raises(ReplayError, match=r"/scan \(sensor_msgs/msg/LaserScan\): the bag defines its type differently"):
        replay(tmp_path / "bag", [mean_node()], tmp_path / "out")


def test_bare_file_split_bag_and_compressed_bag_replay_alike(bag: Path, tmp_path: Path) -> None:
    with BagReader(bag) as reader, BagWriter(tmp_path / "split", True, max_duration_s=0.3) as writer:
        for m in reader.messages():
            writer.write(m.topic, m.type_name, m.payload, m.stamp_ns, m.qos)
    for number, source in enumerate((bag, bag / "bag.mcap", tmp_path / "split")):
        result = replay(source, [mean_node()], tmp_path / f"{number}" / "out", compressed=number == 2)
        assert all(topic.same for topic in compare(tmp_path / "0" / "out", tmp_path / f"{number}" / "out"))
        assert result.bag_s == pytest.approx(0.9) and result.wall_s > 0
