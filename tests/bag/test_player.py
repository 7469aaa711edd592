import threading
from pathlib import Path

import pytest

from instant_ic.bag import BagError, BagMessage, BagWriter
from instant_ic.bag.choice import TopicChoice
from instant_ic.bag.player import BagPlayer, PlayOptions
from instant_ic.bus import LATCHED, RELIABLE, SENSOR

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


@pytest.fixture
def bag(tmp_path: Path) -> Path:
    with BagWriter(tmp_path / "bag") as writer:
        writer.write("/tf_static", TF, b"camera", 1_000_000_000, LATCHED)
        writer.write("/tf_static", TF, b"lidar", 1_000_000_000, LATCHED)
        writer.write("/map", BOOL, b"old map", 1_000_000_000, LATCHED)
        writer.write("/map", BOOL, b"new map", 1_200_000_000, LATCHED)
        writer.write("/clock", BOOL, b"", 1_000_000_000, RELIABLE)
        for index in range(5):
            writer.write("/scan", BOOL, bytes([index]), 1_000_000_000 + index * 500_000_000, SENSOR)
    return tmp_path / "bag"


def played(bag: Path, options: PlayOptions, time: FakeTime | None = None) -> list[tuple[float, str, bytes]]:
    clock = time or FakeTime()
    began_s = clock.now_s
    sent: list[tuple[float, str, bytes]] = []

    def send(message: BagMessage) -> None:
        sent.append((round(clock.now_s - began_s, 6), message.topic, message.payload))

    player = BagPlayer(bag, options)
    player.play(send, clock, lambda: clock.now_s)  # type: ignore[arg-type]
    player.close()
    return sent


def scans(sent: list[tuple[float, str, bytes]]) -> list[tuple[float, int]]:
    return [(at_s, payload[0]) for at_s, topic, payload in sent if topic == "/scan"]


def test_pace_of_the_bag_and_twice_as_fast(bag: Path) -> None:
    sent = played(bag, PlayOptions())
    assert scans(sent) == [(0.0, 0), (0.5, 1), (1.0, 2), (1.5, 3), (2.0, 4)]
    assert "/clock" not in {topic for _, topic, _ in sent}
    assert scans(played(bag, PlayOptions(rate=2.0))) == [(0.0, 0), (0.25, 1), (0.5, 2), (0.75, 3), (1.0, 4)]


def test_start_offset_sends_the_state_that_was_skipped(bag: Path) -> None:
    sent = played(bag, PlayOptions(start_offset_s=1.0, duration_s=0.5))
    assert sent[:3] == [(0.0, "/tf_static", b"camera"), (0.0, "/tf_static", b"lidar"), (0.0, "/map", b"new map")]
    assert sent[3:] == [(0.0, "/scan", b"\x02"), (0.5, "/scan", b"\x03")]


def test_choice_of_topics(bag: Path) -> None:
    sent = played(bag, PlayOptions(choice=TopicChoice(("/tf*", "/map"), ("/map",))))
    assert {topic for _, topic, _ in sent} == {"/tf_static"}


def test_loop_begins_again_until_stopped(bag: Path) -> None:
    sent = played(bag, PlayOptions(loop=True, choice=TopicChoice(("/scan",))), FakeTime(stop_at_s=50.0 + 4.2))
    assert [value for _, value in scans(sent)] == [0, 1, 2, 3, 4, 0, 1, 2, 3, 4, 0]


def test_stop_interrupts_waiting(bag: Path) -> None:
    player = BagPlayer(bag, PlayOptions(rate=1e-6))
    stop = threading.Event()

    def send(message: BagMessage) -> None:
        if message.topic == "/scan":
            stop.set()  # the next message would come in six days

    assert player.play(send, stop) is False
    player.close()


@pytest.mark.parametrize(
    ("options", "message"),
    [
        (PlayOptions(choice=TopicChoice(("/nothing",))), "none of the topics"),
        (PlayOptions(start_offset_s=60.0), "ends before start_offset_s = 60"),
    ],
)
def test_nothing_to_play_is_told(bag: Path, options: PlayOptions, message: str) -> None:
    with pytest.raises(BagError, match=message):
        BagPlayer(bag, options)


@pytest.mark.parametrize("bad", [{"rate": 0.0}, {"start_offset_s": -1.0}, {"duration_s": -1.0}])
def test_bad_options_name_the_key(bad: dict[str, float]) -> None:
    with pytest.raises(ValueError, match=f"{next(iter(bad))} must be"):
        PlayOptions(**bad)  # type: ignore[arg-type]
