"""Bags of others become ours: SQLite, bare files; merged, filtered."""

from pathlib import Path

import foxglove
import numpy as np
import pytest
from rosbags.rosbag2 import CompressionFormat, CompressionMode, StoragePlugin, Writer

from instant_ic.bag import BagError, BagReader, BagWriter
from instant_ic.bag.choice import TopicChoice
from instant_ic.bag.convert import ConvertOptions, convert
from instant_ic.bag.metadata import own_schema
from instant_ic.bag.recover import recover
from instant_ic.bus import LATCHED, SENSOR
from instant_ic.msg import Bool, deserialize, scan_message, serialize, typestore

BOOL, SCAN, STRING = "std_msgs/msg/Bool", "sensor_msgs/msg/LaserScan", "std_msgs/msg/String"
S = 1_000_000_000


def scan(value: float) -> bytes:
    return bytes(serialize(scan_message(np.full(4, value, np.float32), -1.0, 0.5, 0.1, 30.0, "velodyne", 5 * S + 7)))


def test_ros1_bag_is_refused_with_the_command_that_converts_it(tmp_path: Path) -> None:
    (tmp_path / "old.bag").write_bytes(b"#ROSBAG V2.0")
    with pytest.raises(BagError, match=r"rosbags-convert --src .*old\.bag --dst old"):
        BagReader(tmp_path / "old.bag")


@pytest.mark.parametrize("mode", [CompressionMode.NONE, CompressionMode.FILE, CompressionMode.MESSAGE])
def test_sqlite_bag_becomes_ours(tmp_path: Path, mode: CompressionMode) -> None:
    writer = Writer(tmp_path / "old", version=9, storage_plugin=StoragePlugin.SQLITE3)
    writer.set_compression(mode, CompressionFormat.ZSTD)
    with writer:
        connection = writer.add_connection("/scan", SCAN, typestore=typestore())
        for index in range(4):
            writer.write(connection, index * S, scan(index))
    assert convert([tmp_path / "old"], tmp_path / "new") == {"/scan": 4}
    with BagReader(tmp_path / "new") as reader:
        assert [m.payload for m in reader.messages()] == [scan(i) for i in range(4)]


def test_bare_mcap_of_another_writer(tmp_path: Path) -> None:
    """foxglove-sdk's file has another profile and no QoS; its CDR messages are recovered."""
    with foxglove.open_mcap(str(tmp_path / "their.mcap")):
        schema = foxglove.Schema(name=SCAN, encoding="ros2msg", data=own_schema(SCAN).text.encode())
        channel = foxglove.Channel("/convert_scan", schema=schema, message_encoding="cdr")
        other = foxglove.Channel("/convert_json", message_encoding="json")
        for index in range(3):
            channel.log(scan(index), log_time=(1 + index) * S)
        other.log(b"{}", log_time=S)
    with pytest.raises(BagError, match=r"Profile is not ros2.* ic bag recover"):
        BagReader(tmp_path / "their.mcap")
    result = recover(tmp_path / "their.mcap", tmp_path / "new")
    assert result.skipped == {"/convert_json": "encoding 'json'"} and result.stopped_by == ""
    with BagReader(tmp_path / "new") as reader:
        assert [(m.topic, m.type_name, m.payload) for m in reader.messages()] == [
            ("/convert_scan", SCAN, scan(i)) for i in range(3)
        ]


def ours(path: Path, offset: int = 0) -> Path:
    with BagWriter(path) as writer:
        writer.set_custom("instant_ic.lost", '{"/scan": 2}')
        for stop, stamp in ((False, 0), (True, 3)):
            writer.write("/estop", BOOL, bytes(serialize(Bool(data=stop))), stamp * S + offset, LATCHED)
        for index in range(10):
            writer.write("/scan", SCAN, scan(index), index * S + offset, SENSOR)
    return path


def test_span_of_time_begins_with_the_latched_values(tmp_path: Path) -> None:
    options = ConvertOptions(start_s=4.0, end_s=7.0)
    convert([ours(tmp_path / "bag")], tmp_path / "new", options)
    with BagReader(tmp_path / "new") as reader:
        got = [(m.topic, m.stamp_ns // S) for m in reader.messages()]
        stops = [deserialize(m.payload, BOOL).data for m in reader.messages({"/estop"})]
        assert reader.custom["converted_from"] == "bag" and reader.custom["instant_ic.lost"] == '{"/scan": 2}'
    assert got == [("/estop", 4), ("/scan", 4), ("/scan", 5), ("/scan", 6)] and stops == [True]


def test_topics_are_chosen(tmp_path: Path) -> None:
    bag = ours(tmp_path / "bag")
    options = ConvertOptions(choice=TopicChoice(("/s*",)))
    assert convert([bag], tmp_path / "new", options) == {"/scan": 10}
    with pytest.raises(BagError, match="none of the selected topics"):
        convert([bag], tmp_path / "none", ConvertOptions(choice=TopicChoice(("/nothing",))))
    assert not (tmp_path / "none").exists()


def test_merged_and_compressed(tmp_path: Path) -> None:
    one, two = ours(tmp_path / "one"), ours(tmp_path / "two", offset=S // 2)
    shares: list[float] = []
    counts = convert([one, two], tmp_path / "new", ConvertOptions(compressed=True), shares.append)
    assert counts["/scan"] == 20 and shares[-1] == 1.0 and shares == sorted(shares)
    with BagReader(tmp_path / "new") as reader:
        assert [m.stamp_ns for m in reader.messages({"/scan"})] == [i * S // 2 for i in range(20)]
        assert reader.count == 24 and reader.compression == "zstd"


def test_types_that_nobody_knows_are_copied_as_bytes(tmp_path: Path) -> None:
    with BagWriter(tmp_path / "bag") as writer:
        writer.write("/odd", "their_msgs/msg/Odd", b"x", 1, SENSOR)
    assert convert([tmp_path / "bag"], tmp_path / "new") == {"/odd": 1}
    with BagReader(tmp_path / "new") as reader:
        assert [(m.type_name, m.payload) for m in reader.messages()] == [("their_msgs/msg/Odd", b"x")]


def test_type_of_another_definition_keeps_its_own(tmp_path: Path) -> None:
    """A robot's own Keyframe is not ours: it must be decoded by its own definition, and named."""
    from instant_ic.bag import Schema
    from instant_ic.bag.metadata import with_hash

    theirs = with_hash(Schema("instant_ic_msgs/msg/Keyframe", "ros2msg", "uint8 number\n", ""))
    with BagWriter(tmp_path / "bag") as writer:
        writer.write("/keyframe", theirs.name, b"\x00\x01\x00\x00\x2a", 1, LATCHED, theirs)
    convert([tmp_path / "bag"], tmp_path / "new")
    with BagReader(tmp_path / "new") as reader:
        assert reader.differing_types() == ["instant_ic_msgs/msg/Keyframe"]
        (message,) = reader.messages()
        assert reader.decoder(reader.topics[0])(message.payload).number == 42


def test_nothing_to_convert(tmp_path: Path) -> None:
    BagWriter(tmp_path / "empty").close()
    with pytest.raises(BagError, match="no messages to convert"):
        convert([tmp_path / "empty"], tmp_path / "new")
    with pytest.raises(BagError, match="does not exist"):
        convert([tmp_path / "nowhere"], tmp_path / "new")
