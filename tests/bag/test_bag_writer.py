"""Bags of several files: where they are split, what each begins with, how they read as one."""

import json
import sys
from pathlib import Path

import pytest
from rosbags.highlevel import AnyReader
from rosbags.rosbag2 import Reader

from instant_ic.bag import BagError, BagReader, BagWriter
from instant_ic.bag.recover import recover
from instant_ic.bus import LATCHED, RELIABLE, SENSOR
from instant_ic.msg import Bool, TFMessage, serialize, transform_message

BOOL, TF = "std_msgs/msg/Bool", "tf2_msgs/msg/TFMessage"
S = 1_000_000_000


def flag(value: bool) -> bytes:
    return bytes(serialize(Bool(data=value)))


def tf(*children: str) -> bytes:
    import numpy as np

    return bytes(serialize(TFMessage([transform_message(np.eye(4), "base_link", child, 1) for child in children])))


def split_bag(path: Path, **how: float) -> Path:
    """Ten scans of 1 s distance, 1000 bytes; latched values before and between them."""
    with BagWriter(path, **how) as writer:  # type: ignore[arg-type]
        writer.write("/tf_static", TF, tf("camera"), 1 * S, LATCHED, publisher="camera")
        writer.write("/tf_static", TF, tf("velodyne"), 1 * S, LATCHED, publisher="lidar")
        writer.write("/estop", BOOL, flag(False), 1 * S, LATCHED, publisher="console")
        for index in range(10):
            writer.write("/scan", BOOL, bytes([index]) * 1000, (1 + index) * S, SENSOR)
            if index == 4:
                writer.write("/estop", BOOL, flag(True), (1 + index) * S + 1, LATCHED, publisher="console")
    return path


def files(path: Path) -> list[str]:
    return sorted(file.name for file in path.iterdir())


def read(path: Path) -> list[tuple[str, int, bytes]]:
    with BagReader(path) as reader:
        return [(m.topic, m.stamp_ns, m.payload) for m in reader.messages()]


ONE = [
    ("/tf_static", 1 * S, tf("camera")),
    ("/tf_static", 1 * S, tf("velodyne")),
    ("/estop", 1 * S, flag(False)),
    *(("/scan", (1 + i) * S, bytes([i]) * 1000) for i in range(5)),
    ("/estop", 5 * S + 1, flag(True)),
    *(("/scan", (1 + i) * S, bytes([i]) * 1000) for i in range(5, 10)),
]


def test_split_by_time(tmp_path: Path) -> None:
    bag = split_bag(tmp_path / "bag", max_duration_s=3.0)
    assert files(bag) == ["bag_0.mcap", "bag_1.mcap", "bag_2.mcap", "bag_3.mcap", "metadata.yaml"]
    assert read(bag) == ONE  # read as one: nothing twice
    with BagReader(bag) as reader:
        # The counts include the three latched values with which each later file begins.
        assert reader.count == len(ONE) + 9
        assert {t.topic: t.count for t in reader.topics} == {"/estop": 5, "/scan": 10, "/tf_static": 8}
        # From the middle on: nothing is taken for a repetition that is none.
        assert [m.payload[0] for m in reader.messages({"/scan"}, 4 * S)] == [3, 4, 5, 6, 7, 8, 9]
        assert [m.payload for m in reader.messages({"/estop"}, 5 * S)] == [flag(True)]


def test_each_file_alone_begins_with_the_latched_values(tmp_path: Path) -> None:
    bag = split_bag(tmp_path / "bag", max_duration_s=3.0)
    for number, (start_s, stop) in enumerate([(1, False), (4, False), (7, True), (10, True)]):
        with BagReader(bag / f"bag_{number}.mcap") as reader:
            begin = [(m.topic, m.payload) for m in reader.messages() if m.stamp_ns == start_s * S]
        assert sorted(begin[:3]) == sorted(
            [("/tf_static", tf("camera")), ("/tf_static", tf("velodyne")), ("/estop", flag(stop))]
        )
        assert begin[3][0] == "/scan"


def test_other_tools_read_all_files(tmp_path: Path) -> None:
    bag = split_bag(tmp_path / "bag", max_duration_s=3.0)
    with AnyReader([bag]) as reader:
        scans = [c for c in reader.connections if c.topic == "/scan"]
        assert [raw[0] for _, _, raw in reader.messages(scans)] == list(range(10))
        # They see the repetitions as messages: 3 in each of the later files.
        assert reader.message_count == len(ONE) + 9
        assert (reader.start_time, reader.end_time) == (1 * S, 10 * S + 1)
    with Reader(bag) as plain:
        assert [part["path"] for part in plain.storage.files] == [f"bag_{n}.mcap" for n in range(4)]  # type: ignore[attr-defined]


def test_split_by_size(tmp_path: Path) -> None:
    bag = split_bag(tmp_path / "bag", max_bytes=5_000)  # the definitions take about 3 kB of it
    sizes = [(bag / name).stat().st_size for name in files(bag)[:-1]]
    assert len(sizes) >= 3 and max(sizes) < 5_000 + 7_000  # index and the last message come on top
    assert read(bag) == ONE


def test_clock_set_back_ends_a_file_and_reads_in_order(tmp_path: Path) -> None:
    with BagWriter(tmp_path / "bag", max_duration_s=5.0) as writer:
        for stamp_s in (100, 101, 102, 50, 51, 103):
            writer.write("/scan", BOOL, bytes([stamp_s]), stamp_s * S, SENSOR)
    assert [m[2][0] for m in read(tmp_path / "bag")] == [50, 51, 100, 101, 102, 103]
    with BagReader(tmp_path / "bag") as reader:
        assert (len(reader.files), reader.start_ns, reader.end_ns) == (3, 50 * S, 103 * S)


def test_metadata_tells_complete_files_while_the_last_is_written(
    tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    writer = BagWriter(tmp_path / "bag", max_duration_s=2.0)
    for index in range(5):
        writer.write("/scan", BOOL, bytes([index]), index * S, SENSOR)
    writer.flush()
    # Here the process is killed: two files are complete, the third has one message.
    with BagReader(tmp_path / "bag") as reader:
        assert [m.payload[0] for m in reader.messages()] == [0, 1, 2, 3]
        assert [file.name for file in reader.unlisted] == ["bag_2.mcap"]
    assert "bag_2.mcap is not in metadata.yaml" in caplog.text and "ic bag recover" in caplog.text
    result = recover(tmp_path / "bag", tmp_path / "saved")
    assert (result.count, "bag_2.mcap" in result.stopped_by) == (5, True)
    assert [m[2][0] for m in read(tmp_path / "saved")] == [0, 1, 2, 3, 4]
    writer.close()


@pytest.mark.parametrize("damage", ["missing", "no yaml"])
def test_damaged_metadata_is_recovered(tmp_path: Path, damage: str) -> None:
    bag = split_bag(tmp_path / "bag", max_duration_s=3.0)
    before = (bag / "metadata.yaml").read_text()
    if damage == "missing":
        (bag / "metadata.yaml").unlink()
        with pytest.raises(BagError, match="ic bag recover"):
            BagReader(bag)
    else:
        (bag / "metadata.yaml").write_text("{[" if damage == "no yaml" else before.replace("bag_1.mcap", "x.mcap"))
        with pytest.raises(BagError, match="cannot be read"):
            BagReader(bag)
    assert recover(bag, tmp_path / "saved").count == len(ONE)
    assert read(tmp_path / "saved") == ONE


def test_custom_data_survives_a_recovery(tmp_path: Path) -> None:
    with BagWriter(tmp_path / "bag") as writer:
        writer.set_custom("instant_ic.lost", json.dumps({"/scan": 3}))
        writer.write("/scan", BOOL, b"x", 1, SENSOR)
    (tmp_path / "bag" / "metadata.yaml").unlink()
    recover(tmp_path / "bag", tmp_path / "saved")
    with BagReader(tmp_path / "saved") as reader:
        assert json.loads(reader.custom["instant_ic.lost"]) == {"/scan": 3}


def test_recover_leaves_out_a_damaged_chunk_and_goes_on(tmp_path: Path) -> None:
    with BagWriter(tmp_path / "bag") as writer:
        for index in range(9):
            writer.write("/scan", BOOL, bytes([index]) * 5000, 100 + index, SENSOR)
            if index % 3 == 2:
                writer.flush()
    file = tmp_path / "bag" / "bag.mcap"
    data = bytearray(file.read_bytes())
    at = data.find(bytes([4]) * 5000) + 2500
    data[at] ^= 0xFF  # a flipped byte in the picture of the middle chunk
    file.write_bytes(data)
    result = recover(tmp_path / "bag", tmp_path / "saved")
    assert [m[2][0] for m in read(tmp_path / "saved")] == [0, 1, 2, 6, 7, 8]
    assert len(result.damaged) == 1 and "checksum" in result.damaged[0] and result.stopped_by == ""


def test_unknown_type_is_kept_as_bytes_without_definition(tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    with BagWriter(tmp_path / "bag") as writer:
        writer.write("/odd", "their_msgs/msg/Odd", b"\x00\x01\x00\x00bytes", 1, RELIABLE)
    assert "/odd: type their_msgs/msg/Odd is unknown here" in caplog.text
    with BagReader(tmp_path / "bag") as reader:
        assert [(m.type_name, m.payload) for m in reader.messages()] == [
            ("their_msgs/msg/Odd", b"\x00\x01\x00\x00bytes")
        ]
        with pytest.raises(BagError, match=r"/odd: type their_msgs/msg/Odd is unknown"):
            reader.decoder(reader.topics[0])


def test_a_closed_writer_holds_no_payload(tmp_path: Path) -> None:
    """A recorder keeps the writers of all its snapshots; a latched map takes megabytes."""
    payload = bytes(1000)
    before = sys.getrefcount(payload)
    with BagWriter(tmp_path / "b") as writer:
        writer.write("/map", BOOL, payload, 1 * S, LATCHED)
    assert sys.getrefcount(payload) == before and writer.count == 1
