import math
import threading
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from instant_ic.bag import BagError, BagMessage, BagWriter, Schema, player
from instant_ic.bag.metadata import with_hash
from instant_ic.bag.player import BagPlayer, BagPlayerConfig
from instant_ic.bus import LATCHED, RELIABLE, SENSOR
from instant_ic.bus.clock import ManualClock
from instant_ic.msg import message_type, serialize, transform_message
from nodes.bag_player import BagPlayerNode

BOOL, TF = "std_msgs/msg/Bool", "tf2_msgs/msg/TFMessage"


class FakeTime:
    """An event whose waiting moves the clock."""

    def __init__(self, stop_at_s: float = float("inf")) -> None:
        self.now_s = 50.0
        self.stop_at_s = stop_at_s

    def wait(self, seconds: float) -> bool:
        self.now_s += seconds
        return self.is_set()

    def is_set(self) -> bool:
        return self.now_s >= self.stop_at_s


def mount(frame: str) -> bytes:
    transform = transform_message(np.eye(4), "base_link", frame, 1_000_000_000)
    return bytes(serialize(message_type("TFMessage")(transforms=[transform])))


@pytest.fixture
def bag(tmp_path: Path) -> Path:
    with BagWriter(tmp_path / "bag") as writer:
        writer.write("/tf_static", TF, mount("camera"), 1_000_000_000, LATCHED)
        writer.write("/tf_static", TF, mount("lidar"), 1_000_000_000, LATCHED)
        writer.write("/map", BOOL, b"old map", 1_000_000_000, LATCHED)
        writer.write("/map", BOOL, b"new map", 1_200_000_000, LATCHED)
        writer.write("/clock", BOOL, b"", 1_000_000_000, RELIABLE)
        for index in range(5):
            writer.write("/scan", BOOL, bytes([index]), 1_000_000_000 + index * 500_000_000, SENSOR)
    return tmp_path / "bag"


@pytest.fixture(autouse=True)
def clock_at_20_hz(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(player, "CLOCK_HZ", 20.0)


def played(bag: Path, time: FakeTime | None = None, **options: Any) -> list[tuple[float, str, bytes]]:
    clock = time or FakeTime()
    began_s = clock.now_s
    sent: list[tuple[float, str, bytes]] = []

    def send(message: BagMessage) -> None:
        sent.append((round(clock.now_s - began_s, 6), message.topic, message.payload))

    player = BagPlayer(BagPlayerConfig(bag=str(bag), **options))
    player.play(send, clock, lambda: clock.now_s)  # type: ignore[arg-type]
    player.close()
    return sent


def scans(sent: list[tuple[float, str, bytes]]) -> list[tuple[float, int]]:
    return [(at_s, payload[0]) for at_s, topic, payload in sent if topic == "/scan"]


def test_pace_of_the_bag_and_twice_as_fast(bag: Path) -> None:
    sent = played(bag)
    assert scans(sent) == [(0.0, 0), (0.5, 1), (1.0, 2), (1.5, 3), (2.0, 4)]
    assert "/clock" not in {topic for _, topic, _ in sent}
    assert scans(played(bag, rate=2.0)) == [(0.0, 0), (0.25, 1), (0.5, 2), (0.75, 3), (1.0, 4)]


def test_start_offset_sends_the_state_that_was_skipped(bag: Path) -> None:
    sent = played(bag, start_offset_s=1.0, duration_s=0.5)
    mounts = [(0.0, "/tf_static", mount("camera")), (0.0, "/tf_static", mount("lidar"))]
    assert sent[:3] == [*mounts, (0.0, "/map", b"new map")]
    assert sent[3:] == [(0.0, "/scan", b"\x02"), (0.5, "/scan", b"\x03")]


def test_loop_begins_again_until_stopped(bag: Path) -> None:
    sent = played(bag, FakeTime(stop_at_s=50.0 + 4.2), loop=True, topics=("/scan",))
    assert [value for _, value in scans(sent)] == [0, 1, 2, 3, 4, 0, 1, 2, 3, 4, 0]


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"topics": ("/nothing",)}, "none of the selected topics"),
        ({"start_offset_s": 60.0}, "ends before start_offset_s = 60"),
    ],
)
def test_nothing_to_play_is_told(bag: Path, options: dict[str, Any], message: str) -> None:
    with pytest.raises(BagError, match=message):
        BagPlayer(BagPlayerConfig(bag=str(bag), **options))


class Steered:
    """Plays on a clock of its own; ``at`` lets controls act at times of it."""

    def __init__(self, bag: Path, options: dict[str, Any], at: dict[float, Callable[[BagPlayer], None]]) -> None:
        self.player = BagPlayer(BagPlayerConfig(bag=str(bag), **options))
        self.sent: list[tuple[float, int]] = []
        self.clock: list[tuple[float, float]] = []
        self.now_s = 50.0
        self._at = sorted((50.0 + when, number, act) for number, (when, act) in enumerate(at.items()))
        self._end_s = 50.0 + 30.0
        self.finished = self.player.play(self._send, self, lambda: self.now_s, self._tick)  # type: ignore[arg-type]
        self.player.close()

    def wait(self, seconds: float) -> bool:
        until_s = self.now_s + seconds
        while self._at and self._at[0][0] <= until_s:
            self.now_s, _, act = self._at.pop(0)
            act(self.player)
        self.now_s = max(self.now_s, until_s)
        return self.is_set()

    def is_set(self) -> bool:
        return self.now_s >= self._end_s

    def _send(self, message: BagMessage) -> None:
        self.sent.append((round(self.now_s - 50.0, 2), message.payload[0]))

    def _tick(self, stamp_ns: int) -> None:
        self.clock.append((round(self.now_s - 50.0, 3), round(stamp_ns / 1e9 - 1.0, 3)))


SCANS = ("/scan",)  # at 0, 0.5, 1, 1.5, 2 s


def steered(bag: Path, at: dict[float, Callable[[BagPlayer], None]], **options: Any) -> Steered:
    return Steered(bag, {"topics": SCANS, **options}, at)


def near(sent: list[tuple[float, int]]) -> list[tuple[float, int]]:
    """Times on the grid of the player's looks at its controls, 0.05 s."""
    return [(round(round(at_s / 0.05) * 0.05, 2), value) for at_s, value in sent]


def test_pause_and_resume_shift_what_follows(bag: Path) -> None:
    run = steered(bag, {0.7: BagPlayer.pause, 3.0: BagPlayer.resume})
    # Paused for 2.3 s after 0.7 s of the bag: 1.0 s of the bag comes at 3.3 s.
    assert near(run.sent) == [(0.0, 0), (0.5, 1), (3.3, 2), (3.8, 3), (4.3, 4)] and run.finished


def test_clock_goes_on_in_gaps_and_is_repeated_in_a_pause(bag: Path) -> None:
    run = steered(bag, {0.7: BagPlayer.pause, 3.0: BagPlayer.resume})
    assert run.clock[0] == (0.0, 0.0)  # before anything else
    bag_s = [stamp_s for _, stamp_s in run.clock]
    assert bag_s == sorted(bag_s)
    gap = [stamp_s for at_s, stamp_s in run.clock if 0.01 < at_s < 0.49]
    assert len(gap) == 9 and gap == pytest.approx([0.05 * i for i in range(1, 10)], abs=0.01)
    paused = [stamp_s for at_s, stamp_s in run.clock if 0.8 < at_s < 2.9]
    assert len(paused) > 35 and set(paused) == {paused[0]} and paused[0] == pytest.approx(0.7, abs=0.06)


def test_step_sends_the_next_messages_and_stands_still(bag: Path) -> None:
    steps: dict[float, Callable[[BagPlayer], None]] = {
        0.98: BagPlayer.step, 1.98: lambda player: player.step(2), 4.98: BagPlayer.resume,
    }  # fmt: skip
    run = steered(bag, steps, start_paused=True)
    # The fourth message is of 1.5 s of the bag: half a second after the pause, which ended at 1.0 s of the bag.
    assert near(run.sent) == [(1.0, 0), (2.0, 1), (2.0, 2), (5.5, 3), (6.0, 4)]
    with pytest.raises(ValueError, match="count must be >= 1"):
        run.player.step(0)


def test_rate_changes_while_it_plays(bag: Path) -> None:
    run = steered(bag, {1.0: lambda player: player.set_rate(0.5)})
    assert near(run.sent) == [(0.0, 0), (0.5, 1), (1.0, 2), (2.0, 3), (3.0, 4)]
    for bad in (0.0, -1.0, 1000.0, float("nan")):
        with pytest.raises(ValueError, match=r"rate must lie in 0\.01\.\.100"):
            run.player.set_rate(bad)


def test_of_a_topic_with_two_types_one_is_played(tmp_path: Path) -> None:
    with BagWriter(tmp_path / "bag") as writer:
        writer.write("/a", TF, b"tf", 1, SENSOR)
        for stamp_ns in (2, 3):
            writer.write("/a", BOOL, b"b", stamp_ns, SENSOR)
    player = BagPlayer(BagPlayerConfig(bag=str(tmp_path / "bag")))
    assert [(t.topic, t.type_name) for t in player.topics] == [("/a", BOOL)]
    assert player.left_out == {f"/a ({TF}, 1 messages)": "the topic also has another type"}
    sent: list[bytes] = []
    player.play(lambda message: sent.append(message.payload), threading.Event())
    player.close()
    assert sent == [b"b", b"b"]


def test_damage_found_while_playing_is_told(tmp_path: Path) -> None:
    with BagWriter(tmp_path / "bag") as writer:
        for index in range(6):
            writer.write("/scan", BOOL, bytes([index]) * 1000, index, SENSOR)
            writer.flush()
    file = tmp_path / "bag" / "bag.mcap"
    data = bytearray(file.read_bytes())
    data[data.find(bytes([4]) * 1000) + 10] ^= 0xFF
    file.write_bytes(data)
    player = BagPlayer(BagPlayerConfig(bag=str(tmp_path / "bag")))
    sent: list[int] = []
    with pytest.raises(BagError, match=r"is damaged.*ic bag recover"):
        player.play(lambda message: sent.append(message.payload[0]), threading.Event())
    player.close()
    assert sent == [0, 1, 2, 3]


def test_types_that_cannot_be_sent_are_named(tmp_path: Path) -> None:
    theirs = with_hash(Schema(BOOL, "ros2msg", "uint8 number\n", ""))
    new = with_hash(Schema("rover_msgs/msg/Cells", "ros2msg", "uint8 number\n", ""))
    with BagWriter(tmp_path / "bag") as writer:
        writer.write("/unknown", "their_msgs/msg/Odd", b"u", 1, SENSOR)
        writer.write("/other", BOOL, b"o", 1, SENSOR, theirs)
    with pytest.raises(BagError, match=r"/unknown \(their_msgs/msg/Odd, 1 messages\): its type is unknown"):
        BagPlayer(BagPlayerConfig(bag=str(tmp_path / "bag")))
    with BagWriter(tmp_path / "more") as writer:
        writer.write("/cells", new.name, b"c", 1, SENSOR, new)
        writer.write("/other", BOOL, b"o", 1, SENSOR, theirs)
    player = BagPlayer(BagPlayerConfig(bag=str(tmp_path / "more")))
    assert [t.topic for t in player.topics] == ["/cells"]  # its definition is in the bag
    assert player.left_out == {f"/other ({BOOL}, 1 messages)": "the bag defines its type differently"}
    player.close()


def test_a_message_is_published_at_the_bags_time_also_when_the_players_own_clock_comes_back_late(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    sent: list[tuple[bytes, int | None]] = []

    class Out:
        def publish_bytes(self, payload: bytes, publish_ns: int | None = None) -> None:
            sent.append((payload, publish_ns))

    node = BagPlayerNode.__new__(BagPlayerNode)
    node.clock, node.config, node._next_base_s = ManualClock(), BagPlayerConfig(bag="drive"), math.inf
    node._out = {"/a": Out()}  # type: ignore[dict-item]
    # What the node hears of its own /clock on another thread sets the time back between these two steps.
    monkeypatch.setattr(node, "_publish_time", lambda stamp_ns: node.clock.set(stamp_ns - 700_000))
    node._send(BagMessage("/a", BOOL, b"x", 5_000_000_000, SENSOR))
    assert sent == [(b"x", 5_000_000_000)]
