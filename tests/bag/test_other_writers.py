"""Bags of other writers: SQLite, bare files, ROS 1."""

from pathlib import Path

import foxglove
import numpy as np
import pytest
from rosbags.rosbag2 import CompressionFormat, CompressionMode, StoragePlugin, Writer

from instant_ic.bag import BagError, BagReader
from instant_ic.bag.metadata import own_schema
from instant_ic.bag.recover import recover
from instant_ic.msg import scan_message, serialize, typestore

BOOL, SCAN, STRING = "std_msgs/msg/Bool", "sensor_msgs/msg/LaserScan", "std_msgs/msg/String"
S = 1_000_000_000


def scan(value: float) -> bytes:
    return bytes(serialize(scan_message(np.full(4, value, np.float32), -1.0, 0.5, 0.1, 30.0, "velodyne", 5 * S + 7)))


def test_ros1_bag_is_refused_with_the_command_that_converts_it(tmp_path: Path) -> None:
    (tmp_path / "old.bag").write_bytes(b"#ROSBAG V2.0")
    with pytest.raises(BagError, match=r"rosbags-convert --src .*old\.bag --dst old"):
        BagReader(tmp_path / "old.bag")


@pytest.mark.parametrize("mode", [CompressionMode.NONE, CompressionMode.MESSAGE, CompressionMode.FILE])
def test_sqlite_bag_is_read(tmp_path: Path, mode: CompressionMode) -> None:
    writer = Writer(tmp_path / "old", version=9, storage_plugin=StoragePlugin.SQLITE3)
    writer.set_compression(mode, CompressionFormat.ZSTD)
    with writer:
        connection = writer.add_connection("/scan", SCAN, typestore=typestore())
        for index in range(4):
            writer.write(connection, index * S, scan(index))
    if mode is CompressionMode.FILE:
        with pytest.raises(BagError, match="rosbags-convert"):
            BagReader(tmp_path / "old")
        return
    with BagReader(tmp_path / "old") as reader:
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
