"""Recordings on request: one at a time, the disk's state told, an end that does not wait for the disk."""

import time
from collections.abc import Callable
from pathlib import Path

import pytest

from instant_ic.bag import BagError, BagReader
from instant_ic.bag.choice import TopicChoice
from instant_ic.bag.on_demand import OnDemand
from instant_ic.bag.recorder import BagRecorderConfig, Recorder, TakeMessage
from instant_ic.bag.recorder_thread import DISK_FULL
from instant_ic.bus import SENSOR
from instant_ic.bus.registry import PublisherInfo, TopicInfo
from instant_ic.msg import Bool, serialize

BOOL = "std_msgs/msg/Bool"
SCAN = TopicInfo("/scan", BOOL, [PublisherInfo("n", 1, SENSOR.name, Path("s"), BOOL, "00", 0)])
YES = bytes(serialize(Bool(data=True)))


class Losses:
    def __init__(self) -> None:
        self.lost = 0
        self.lost_by: dict[str, int] = {}


class Source:
    """Gives a message to every recorder that listens."""

    def __init__(self, folder: Path, free_bytes: int = 10**12) -> None:
        self.takes: list[TakeMessage] = []
        self.dropped = 0
        self.free_bytes = free_bytes
        self.recordings = OnDemand(folder, self.begin)

    def begin(self, path: Path) -> tuple[Recorder, Callable[[], None]]:
        def listen(topic: str, take: TakeMessage) -> Losses:
            self.takes.append(take)
            return Losses()

        def drop() -> None:
            self.takes.clear()
            self.dropped += 1

        return Recorder(path, TopicChoice(), listen, None, BagRecorderConfig(), lambda _: self.free_bytes), drop

    def say(self, stamp_ns: int) -> None:
        for take in self.takes:
            take("/scan", BOOL, YES, stamp_ns)

    def wait_for(self, condition: Callable[[], object], what: str) -> None:
        deadline_s = time.monotonic() + 20
        while not condition():
            assert time.monotonic() < deadline_s, f"waited 20 s for {what}: {self.recordings.status()}"
            self.recordings.tick()
            time.sleep(0.005)


def test_begin_end_and_begin_again(tmp_path: Path) -> None:
    source = Source(tmp_path)
    recordings = source.recordings
    assert recordings.status()["state"] == "idle" and recordings.status()["free_bytes"] > 0
    with pytest.raises(ValueError, match="nothing is being recorded"):
        recordings.stop()
    first = recordings.start("door / stuck!")
    assert first.parent == tmp_path and first.name.startswith("rec_") and first.name.endswith("_door___stuck")
    with pytest.raises(ValueError, match="is being recorded already"):
        recordings.start()
    recordings.discover([SCAN])
    for stamp in (1, 2, 3):
        source.say(stamp)
    source.wait_for(lambda: recordings.status()["messages"] == 3, "the messages")
    assert recordings.status()["state"] == "recording" and recordings.trouble() == ""
    assert recordings.stop() == first and source.dropped == 1
    with pytest.raises(ValueError, match="nothing is being recorded"):
        recordings.stop()
    source.wait_for(lambda: recordings.status()["state"] == "idle", "the end")
    told = recordings.status()
    assert (told["path"], told["messages"], told["error"]) == (str(first), 3, "") and told["bytes"] > 0
    with BagReader(first) as reader:
        assert [m.stamp_ns for m in reader.messages()] == [1, 2, 3]
    source.wait_for(lambda: recordings._recorder is None, "room for the next")
    second = recordings.start("door / stuck!")
    assert second != first
    recordings.close()
    assert source.dropped == 2


def test_a_full_disk_is_told_while_it_records_and_when_it_ends(tmp_path: Path) -> None:
    source = Source(tmp_path, free_bytes=1_000_000)
    source.recordings.start()
    source.recordings.discover([SCAN])
    source.say(1)
    source.wait_for(lambda: source.recordings.status()["state"] == DISK_FULL, "the full disk")
    assert "only 1 MB are free" in source.recordings.trouble()
    source.recordings.stop()
    source.wait_for(lambda: source.recordings.status()["state"] == "idle", "the end")
    assert "only 1 MB are free" in source.recordings.status()["error"]
    with pytest.raises(BagError, match="only 1 MB are free"):
        source.recordings.close()
