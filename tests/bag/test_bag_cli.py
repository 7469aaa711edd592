"""``ic bag`` and ``ic replay`` on files: what is printed, and what mistakes are told."""

import argparse
import json
from pathlib import Path

import numpy as np
import pytest

from instant_ic.bag import BagWriter
from instant_ic.bus import LATCHED, SENSOR
from instant_ic.cli.commands.bag import size
from instant_ic.cli.main import main
from instant_ic.msg import Bool, message_type, scan_message, serialize

SCAN, BOOL = "sensor_msgs/msg/LaserScan", "std_msgs/msg/Bool"
S = 1_000_000_000
CORRIDOR = Path(__file__).resolve().parents[1] / "data" / "corridor_drive"


def make(path: Path, gain: float = 1.0, **how: float) -> Path:
    with BagWriter(path, **how) as writer:  # type: ignore[arg-type]
        writer.set_custom("instant_ic.lost", json.dumps({"/scan": 3}))
        writer.set_custom("instant_ic.lost_by", json.dumps({"/scan": {"front": 3}}))
        writer.set_custom("instant_ic.overflow", json.dumps({"/scan": 7}))
        writer.write("/operator/estop", BOOL, bytes(serialize(Bool(data=False))), 1 * S, LATCHED)
        for index in range(10):
            message = scan_message(np.full(4, gain * index, np.float32), 0, 0.1, 0.1, 30, "velodyne", index * S)
            writer.write("/scan", SCAN, bytes(serialize(message)), (1 + index) * S, SENSOR)
    return path


def ic(capsys: pytest.CaptureFixture[str], *words: str | Path) -> tuple[int, str, str]:
    status = main([str(word) for word in words])
    out, error = capsys.readouterr()
    return status, out, error


def test_info(capsys: pytest.CaptureFixture[str], tmp_path: Path) -> None:
    bag = make(tmp_path / "bag", max_duration_s=5.0)
    status, out, _ = ic(capsys, "bag", "info", bag)
    assert status == 0 and "bag_0.mcap" in out and "bag_1.mcap" in out
    assert "1.00 Hz  sensor  3 lost (3 from front)" in out
    assert "left out because the disk was too slow: /scan 7" in out
    status, out, _ = ic(capsys, "bag", "info", bag, "--json")
    told = json.loads(out)
    assert (told["messages"], told["duration_s"], len(told["files"])) == (12, 9.0, 2)
    assert {t["topic"]: (t["messages"], t["lost_by"]) for t in told["topics"]} == {
        "/operator/estop": (2, {}),  # each file begins with it
        "/scan": (10, {"front": 3}),
    }


def test_info_lists_bookmarks(capsys: pytest.CaptureFixture[str], tmp_path: Path) -> None:
    bag, text = make(tmp_path / "bag"), message_type("String")
    assert "bookmark:" not in ic(capsys, "bag", "info", bag)[1]
    with BagWriter(tmp_path / "marked") as writer:
        writer.write("/scan", BOOL, bytes(serialize(Bool(data=True))), 1 * S, SENSOR)
        for stamp_ns, name in ((2 * S, "door stuck"), (4 * S + S // 2, "person")):
            payload = bytes(serialize(text(data=name)))
            writer.write("/operator/bookmark", "std_msgs/msg/String", payload, stamp_ns, SENSOR)
    assert (
        "bookmark: 1.000 s  door stuck\nbookmark: 3.500 s  person\n"
        in ic(capsys, "bag", "info", tmp_path / "marked")[1]
    )
    told = json.loads(ic(capsys, "bag", "info", tmp_path / "marked", "--json")[1])
    assert told["bookmarks"] == [{"at_s": 1.0, "name": "door stuck"}, {"at_s": 3.5, "name": "person"}]


def test_diff_prints_what_differs(capsys: pytest.CaptureFixture[str], tmp_path: Path) -> None:
    a, b = make(tmp_path / "a"), make(tmp_path / "b", gain=1.5)
    status, out, _ = ic(capsys, "bag", "diff", a, b)
    assert status == 1 and "message 2: ranges[0] is 1.0 and 1.5 (4 of 4 entries differ)" in out
    assert "ranges: largest difference 4.5, in 9 messages, first in message 2" in out
    assert "1 of 2 topics are the same" in out
    status, out, _ = ic(capsys, "bag", "diff", a, b, "--tolerance", "/scan:ranges=4.5")
    assert status == 0 and "2 of 2 topics are the same" in out
    assert ic(capsys, "bag", "diff", a, b, "--ignore-field", "ranges")[0] == 0
    assert ic(capsys, "bag", "diff", a, b, "--ignore", "/scan")[0] == 0
    status, out, _ = ic(capsys, "bag", "diff", a, b, "--json")
    (estop, scan) = json.loads(out)
    assert status == 1 and estop["same"] and scan["fields"]["ranges"]["largest"] == 4.5 and scan["differing"] == 9


@pytest.mark.parametrize(
    ("words", "message"),
    [
        (("--tolerance", "ranges"), "--tolerance ranges: expected FROM=TO"),
        (("--tolerance", "ranges=much"), "--tolerance ranges=much: much is not a number"),
        (("--tolerance", "ranges=-1"), "tolerance of ranges must be >= 0"),
    ],
)
def test_wrong_tolerances_are_told(
    capsys: pytest.CaptureFixture[str], tmp_path: Path, words: tuple[str, ...], message: str
) -> None:
    bag = make(tmp_path / "bag")
    status, _, error = ic(capsys, "bag", "diff", bag, bag, *words)
    assert status == 2 and message in error


@pytest.mark.parametrize(
    ("text", "bytes_"), [("1000000", 10**6), ("500MB", 5 * 10**8), ("1.5GiB", 3 * 2**29), ("2 gb", 2 * 10**9)]
)
def test_sizes(text: str, bytes_: int) -> None:
    assert size(text) == bytes_


@pytest.mark.parametrize("text", ["", "MB", "5XB", "-5MB", "1e9"])
def test_what_is_no_size(text: str) -> None:
    with pytest.raises(argparse.ArgumentTypeError, match="is not a size"):
        size(text)


def test_replay_compares_with_a_reference(capsys: pytest.CaptureFixture[str], tmp_path: Path) -> None:
    words = ("replay", CORRIDOR, "--nodes", "vlp16_driver", "-p", "vlp16_driver.source:=topic")
    status, out, _ = ic(capsys, *words, "-o", tmp_path / "one")
    assert status == 0 and "x real time" in out and "/scan: 48" in out
    status, out, _ = ic(capsys, *words, "-o", tmp_path / "two", "--compare", tmp_path / "one")
    assert status == 0 and "3 of 3 topics are the same" in out, out
