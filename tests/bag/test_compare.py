"""Two bags field by field: values worked out by hand."""

import math
from pathlib import Path

import numpy as np
import pytest

from instant_ic.bag import BagWriter
from instant_ic.bag.compare import FieldDifference, Tolerance, TopicDifference, compare
from instant_ic.bus import SENSOR
from instant_ic.msg import Float32, TFMessage, scan_message, serialize, transform_message

SCAN, TF, FLOAT = "sensor_msgs/msg/LaserScan", "tf2_msgs/msg/TFMessage", "std_msgs/msg/Float32"
S = 1_000_000_000


def bag(path: Path, values: list[list[float]], stamps_s: list[float] | None = None, header_ns: int = 0) -> Path:
    """Scans with these ranges, a second apart or at these times."""
    with BagWriter(path) as writer:
        for index, ranges in enumerate(values):
            message = scan_message(np.array(ranges, np.float32), 0.0, 0.1, 0.1, 30.0, "velodyne", index * S + header_ns)
            stamp_s = float(index) if stamps_s is None else stamps_s[index]
            writer.write("/scan", SCAN, bytes(serialize(message)), int((10 + stamp_s) * S), SENSOR)
    return path


def scan_difference(a: Path, b: Path, tolerance: Tolerance | None = None) -> TopicDifference:
    (found,) = compare(a, b, tolerance=tolerance or Tolerance())
    return found


def test_largest_difference_of_a_field(tmp_path: Path) -> None:
    a = bag(tmp_path / "a", [[1, 2, 3], [1, 2, 3], [1, 2, 3]])
    b = bag(tmp_path / "b", [[1, 2, 3], [1, 2.5, 3.25], [1.125, 2, 3]])
    found = scan_difference(a, b)
    assert found.differing == 2 and not found.same
    assert found.fields == {"ranges": FieldDifference(2, 2, 0.5, found.fields["ranges"].words)}
    assert found.first == "message 2: ranges[1] is 2.0 and 2.5 (2 of 3 entries differ)"


@pytest.mark.parametrize(
    ("tolerance", "differing"),
    [
        (Tolerance(atol=0.5), 0),
        (Tolerance(atol=0.49), 1),
        (Tolerance(fields={"ranges": 0.5}), 0),
        (Tolerance(fields={"/scan:ranges": 0.5}), 0),
        (Tolerance(fields={"/other:ranges": 0.5}), 2),
        (Tolerance(fields={"ranges": 0.2}, atol=9.0), 1),  # a field's own goes before the general one
        (Tolerance(ignore=("ranges",)), 0),
        (Tolerance(ignore=("range",)), 2),
        (Tolerance(ignore=("range*",)), 0),
    ],
)
def test_tolerances(tmp_path: Path, tolerance: Tolerance, differing: int) -> None:
    a = bag(tmp_path / "a", [[1, 2, 3], [1, 2, 3], [1, 2, 3]])
    b = bag(tmp_path / "b", [[1, 2, 3], [1, 2.5, 3.25], [1.125, 2, 3]])
    found = scan_difference(a, b, tolerance)
    assert (found.differing, found.same) == (differing, differing == 0)


def test_ignored_field_covers_what_is_in_it(tmp_path: Path) -> None:
    a = bag(tmp_path / "a", [[1, 2]])
    b = bag(tmp_path / "b", [[1, 2]], header_ns=5)
    assert list(scan_difference(a, b).fields) == ["header.stamp.nanosec"]
    for pattern in ("header", "header.stamp", "header.stamp.nanosec", "*.stamp"):
        assert scan_difference(a, b, Tolerance(ignore=(pattern,))).same, pattern
    for pattern in ("stamp", "header.frame_id", "head"):
        assert not scan_difference(a, b, Tolerance(ignore=(pattern,))).same, pattern


def test_paired_by_stamp_a_missing_message_shifts_nothing(tmp_path: Path) -> None:
    a = bag(tmp_path / "a", [[0], [1], [2], [3]], [0.0, 1.0, 2.0, 3.0])
    b = bag(tmp_path / "b", [[0], [2], [3], [4]], [0.01, 2.02, 2.99, 4.0])
    found = scan_difference(a, b, Tolerance(ignore=("header",), stamp_s=0.05))
    assert (found.count_a, found.count_b, found.only_a, found.only_b, found.differing) == (4, 4, 1, 1, 0)
    assert found.first == "the message at 11.000000 s is only in the first bag"
    # By their order everything after the missing one differs, and the stamps do at once.
    assert scan_difference(a, b).first == "message 1: stamps differ by +0.010000000 s"
    assert scan_difference(a, b).differing == 4


def test_not_finite_values(tmp_path: Path) -> None:
    inf, nan = math.inf, math.nan
    a = bag(tmp_path / "a", [[inf, nan, 1.0], [inf, 1.0, 2.0]])
    b = bag(tmp_path / "b", [[inf, nan, 1.5], [1.0, 1.0, 2.0]])
    found = scan_difference(a, b, Tolerance(atol=1.0))
    # Equal infinities and two nans are no difference; inf against 1 is one of any size.
    assert found.differing == 1 and found.first.startswith("message 2: ranges[0] is inf and 1.0")
    assert found.fields["ranges"].largest == inf


def test_entries_of_lists_are_named_together(tmp_path: Path) -> None:
    def tf(path: Path, *xs: float) -> Path:
        matrices = [np.eye(4) for _ in xs]
        for matrix, x in zip(matrices, xs, strict=True):
            matrix[0, 3] = x
        transforms = [transform_message(m, "map", f"f{i}", 1) for i, m in enumerate(matrices)]
        with BagWriter(path) as writer:
            writer.write("/tf", TF, bytes(serialize(TFMessage(transforms))), 1, SENSOR)
        return path

    a, b = tf(tmp_path / "a", 1.0, 2.0), tf(tmp_path / "b", 1.25, 2.5)
    (found,) = compare(a, b)
    assert found.fields["transforms[].transform.translation.x"].largest == 0.5
    assert found.first == "message 1: transforms[0].transform.translation.x is 1.0 and 1.25"
    for pattern in ("transforms.transform.translation", "transforms[].transform", "transforms.*.translation.x"):
        assert compare(a, b, tolerance=Tolerance(fields={pattern: 0.5}))[0].same, pattern
    (longer,) = compare(a, tf(tmp_path / "c", 1.0), tolerance=Tolerance(atol=100.0))
    assert longer.first == "message 1: transforms has 2 and 1 entries"


def test_zero_and_minus_zero_differ_only_bit_by_bit(tmp_path: Path) -> None:
    def one(path: Path, value: float) -> Path:
        with BagWriter(path) as writer:
            writer.write("/x", FLOAT, bytes(serialize(Float32(data=value))), 1, SENSOR)
        return path

    a, b = one(tmp_path / "a", 0.0), one(tmp_path / "b", -0.0)
    assert compare(a, b)[0].first == "message 1: data is 0.0 and -0.0"
    assert compare(a, b, tolerance=Tolerance(atol=1e-12))[0].same


def test_topics_by_pattern(tmp_path: Path) -> None:
    a, b = bag(tmp_path / "a", [[1]]), bag(tmp_path / "b", [[2]])
    assert compare(a, b, ignore=("/s*",)) == []
    with BagWriter(tmp_path / "more") as writer:
        writer.write("/x", FLOAT, b"", 1, SENSOR)
    assert [t.topic for t in compare(a, tmp_path / "more")] == ["/scan", "/x"]
    assert compare(a, tmp_path / "more", common=True) == []
    assert compare(a, tmp_path / "more")[0].first == "1 and 0 messages"


@pytest.mark.parametrize("bad", [{"atol": math.nan}, {"stamp_s": -0.1}, {"fields": {"a": -1.0}}])
def test_bad_tolerance_is_told(bad: dict[str, object]) -> None:
    with pytest.raises(ValueError, match="must be >= 0"):
        Tolerance(**bad)  # type: ignore[arg-type]
