"""The type index against rosbags' own store, and its cache."""

import dataclasses
from pathlib import Path

import numpy as np
import pytest

from instant_ic.msg import message_type, scan_message, serialize, type_hash, typestore
from instant_ic.msg.store import TypeIndex, entries_of, read_entries
from instant_ic.msg.types import DEFINITIONS


def described(kind: type) -> list[tuple[str, object, object]]:
    """The fields; rosbags' classes have their constants among them."""
    fields = [field for field in dataclasses.fields(kind) if not str(field.type).startswith("ClassVar")]  # type: ignore[arg-type]
    return [(field.name, field.type, field.default) for field in fields]


def test_every_type_has_the_fields_the_constants_and_the_hash_of_rosbags() -> None:
    store = typestore()
    assert len(store.types) > 150
    for name, expected in store.types.items():
        got = message_type(name)
        assert got.__name__ == expected.__name__
        assert described(got) == described(expected)
        constants = {key: value for key, value in vars(expected).items() if key.isupper() or key == "__msgtype__"}
        assert {key: getattr(got, key) for key in constants} == constants
        assert type_hash(name) == store.hash_rihs01(name)


def test_messages_have_the_bytes_of_rosbags_in_both_byte_orders() -> None:
    scan = scan_message(np.linspace(0.5, 4.0, 7), -1.0, 0.3, 0.1, 30.0, "velodyne", 1_234_567_891_000_000_007)
    assert serialize(scan) == typestore().serialize_cdr(scan, "sensor_msgs/msg/LaserScan", little_endian=True)
    index = TypeIndex(entries_of(typestore()))
    for little_endian in (True, False):
        data = typestore().serialize_cdr(scan, "sensor_msgs/msg/LaserScan", little_endian=little_endian)
        back = index.get_msgdef("sensor_msgs/msg/LaserScan").deserialize(data)
        assert (back.header.stamp.nanosec, back.header.frame_id) == (7, "velodyne")
        assert np.array_equal(back.ranges, scan.ranges)


@pytest.mark.parametrize("damage", ["", "{", "[]", '{"key": "of another version", "types": {}}'])
def test_a_damaged_or_old_cache_is_made_again(damage: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))
    made = read_entries(DEFINITIONS, typestore)
    file = tmp_path / "instant_ic" / "message_types.json"

    def never() -> None:
        raise AssertionError("the cache is not used")

    again = read_entries(DEFINITIONS, never)  # type: ignore[arg-type]
    assert again.keys() == made.keys()
    assert again["std_msgs/msg/Header"]["hash"] == made["std_msgs/msg/Header"]["hash"]
    file.write_text(damage)
    assert read_entries(DEFINITIONS, typestore).keys() == made.keys()
    assert read_entries(DEFINITIONS, never).keys() == made.keys()  # type: ignore[arg-type]


def test_without_a_folder_for_the_cache_it_only_takes_longer(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    (tmp_path / "file").touch()
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "file"))
    assert "std_msgs/msg/Header" in read_entries(DEFINITIONS, typestore)
