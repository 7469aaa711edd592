"""The recording without a bus: it never waits for the disk, tells what it left out, survives a full one."""

import errno
import json
import os
import shutil
import threading
import time
from collections.abc import Callable
from contextlib import suppress
from pathlib import Path
from typing import Any

import pytest

from instant_ic.bag import BagError, BagMessage, BagReader, recording
from instant_ic.bag.choice import TopicChoice
from instant_ic.bag.mcap_scan import McapScan
from instant_ic.bag.recorder import Recorder
from instant_ic.bag.recording import DISK_FULL, ENDED, FAILED, RECORDING, BagRecorderConfig, Recording
from instant_ic.bag.snapshot import SnapshotCache
from instant_ic.bus import LATCHED, RELIABLE, SENSOR
from instant_ic.bus.qos import QoS
from instant_ic.bus.registry import PublisherInfo, TopicInfo
from instant_ic.msg import Bool, serialize
from instant_ic.util.diagnosis import Level

BOOL = "std_msgs/msg/Bool"
S = 1_000_000_000
YES, NO = bytes(serialize(Bool(data=True))), bytes(serialize(Bool(data=False)))


@pytest.fixture(autouse=True)
def quick_recorder(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(recording, "FLUSH_S", 0.1)
    monkeypatch.setattr(recording, "SPACE_S", 0.1)


class Losses:
    def __init__(self) -> None:
        self.lost_by: dict[str, int] = {}


def topic_info(topic: str, *presets: QoS) -> TopicInfo:
    publishers = [PublisherInfo(f"n{i}", 1, qos.name, Path("s"), BOOL, "00", 0) for i, qos in enumerate(presets)]
    return TopicInfo(topic, BOOL, publishers)


def recorder_of(
    path: Path, free: Callable[[Path], int] = lambda path: 10**12, losses: Losses | None = None, **options: object
) -> Recorder:
    """A recorder that has found two topics."""
    config = BagRecorderConfig(**options)  # type: ignore[arg-type]
    recorder = Recorder(path, TopicChoice(), lambda topic, take: losses or Losses(), None, config, free)  # type: ignore[arg-type, return-value]
    recorder.discover([topic_info("/scan", SENSOR), topic_info("/estop", LATCHED)])
    return recorder


def make(
    path: Path, free: Callable[[Path], int] = lambda path: 10**12, **options: object
) -> tuple[Recorder, Recording]:
    recorder = recorder_of(path, free, **options)
    assert recorder.bag is not None
    return recorder, recorder.bag


def wait_for(condition: Callable[[], object], what: str) -> None:
    deadline_s = time.monotonic() + 20
    while not condition():
        assert time.monotonic() < deadline_s, f"waited 20 s for {what}"
        time.sleep(0.01)


def read(path: Path) -> list[tuple[str, int, bytes]]:
    with BagReader(path) as reader:
        return [(m.topic, m.stamp_ns, m.payload) for m in reader.messages()]


def custom(path: Path, key: str) -> object:
    with BagReader(path) as reader:
        return json.loads(reader.custom.get(f"instant_ic.{key}", "null"))


class SlowDisk:
    """Every write waits until it is let go."""

    def __init__(self, monkeypatch: pytest.MonkeyPatch) -> None:
        self.go = threading.Event()
        write = os.write

        def wait_and_write(fd: int, data: memoryview) -> int:
            assert self.go.wait(60)
            return write(fd, data)

        self._begin = lambda: monkeypatch.setattr(os, "write", wait_and_write)

    def hang(self) -> None:
        self._begin()


def test_taking_never_waits_for_the_disk_and_what_is_left_out_is_told(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    (recorder, bag), disk = make(tmp_path / "bag", queue_mb=3), SlowDisk(monkeypatch)
    recorder.take("/scan", BOOL, b"first", 1 * S)
    disk.hang()
    # Twenty times 1 MB while the disk takes nothing: three find a place in the queue, some are in the writer's hands.
    for index in range(20):
        recorder.take("/scan", BOOL, bytes([index]) * 1_000_000, 2 * S + index)
    recorder.take("/estop", BOOL, YES, 3 * S)  # latched values always find a place
    assert not disk.go.is_set()  # and all that time nothing was written
    left_out = bag.overflow["/scan"]
    assert 10 <= left_out <= 18
    disk.go.set()
    recorder.close()
    got = read(tmp_path / "bag")
    assert len([m for m in got if m[0] == "/scan"]) == 21 - left_out
    assert ("/estop", 3 * S, YES) in got
    assert custom(tmp_path / "bag", "overflow") == {"/scan": left_out}


def test_a_disk_that_hangs_for_good_does_not_hang_the_end(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    (recorder, _), disk = make(tmp_path / "bag"), SlowDisk(monkeypatch)
    disk.hang()
    recorder.take("/scan", BOOL, b"x" * 2_000_000, 1 * S)
    recorder.take("/estop", BOOL, YES, 2 * S)
    with pytest.raises(BagError, match=r"did not take the last 2 messages \(2\.0 MB\) within 0\.3 s; run"):
        recorder.close(timeout_s=0.3)
    disk.go.set()  # lets the thread go


def test_payload_may_be_overwritten_once_it_was_taken(tmp_path: Path) -> None:
    recorder, _ = make(tmp_path / "bag")
    slot = bytearray(b"aaaa")  # as in shared memory
    recorder.take("/scan", BOOL, memoryview(slot), 1 * S)
    slot[:] = b"bbbb"
    recorder.close()
    assert read(tmp_path / "bag") == [("/scan", 1 * S, b"aaaa")]


def test_reserve_of_the_disk_ends_the_file_and_recording_goes_on_when_there_is_room(tmp_path: Path) -> None:
    free, looks = [10**12], [0]

    def free_bytes(path: Path) -> int:
        looks[0] += 1
        return free[0]

    recorder, bag = make(tmp_path / "bag", free_bytes, min_free_mb=1000)
    recorder.take("/scan", BOOL, b"1", 1 * S)
    wait_for(lambda: bag.status()["messages"] == 1, "the first message")
    free[0] = 900_000_000
    wait_for(lambda: bag.state == DISK_FULL, "the full disk")
    assert "only 900 MB are free" in bag.error and recorder.failed
    # The bag is complete and opens although the recorder still runs.
    assert read(tmp_path / "bag") == [("/scan", 1 * S, b"1")]
    recorder.take("/scan", BOOL, b"2", 2 * S)
    recorder.take("/estop", BOOL, YES, 3 * S)
    free[0], before = 1_063_000_000, looks[0]  # a little above the reserve: not yet, or it would come and go
    wait_for(lambda: looks[0] >= before + 3, "two looks at the new space")
    assert bag.state == DISK_FULL
    free[0] = 2_000_000_000
    wait_for(lambda: bag.state == RECORDING, "room")
    recorder.take("/scan", BOOL, b"4", 4 * S)
    recorder.close()
    # The next file begins with the latched value that was missed.
    assert read(tmp_path / "bag") == [("/scan", 1 * S, b"1"), ("/estop", 4 * S, YES), ("/scan", 4 * S, b"4")]
    assert custom(tmp_path / "bag", "disk_full") == {"/scan": 1, "/estop": 1}


def test_folder_taken_away_is_told(tmp_path: Path) -> None:
    recorder, bag = make(tmp_path / "bag", free=lambda path: shutil.disk_usage(path).free)
    recorder.take("/scan", BOOL, b"1", 1 * S)
    shutil.rmtree(tmp_path / "bag")
    wait_for(lambda: bag.state == FAILED, "the failure")
    assert "its folder was removed" in bag.error
    with pytest.raises(BagError, match="was removed"):
        recorder.close()


def test_old_latched_values_are_filed_under_the_beginning(tmp_path: Path) -> None:
    subscribed: list[str] = []

    def subscribe(topic: str, callback: object) -> Any:
        subscribed.append(topic)
        return Losses()

    recorder = Recorder(tmp_path / "bag", TopicChoice(exclude=("/heart*",)), subscribe)
    recorder.discover([topic_info("/estop", SENSOR, LATCHED), topic_info("/heartbeat", RELIABLE)])
    recorder.discover([topic_info("/estop", LATCHED), topic_info("/scan", SENSOR)])
    assert subscribed == ["/estop", "/scan"]
    recorder.take("/estop", BOOL, b"old", 5)  # minutes before the recording
    recorder.take("/scan", BOOL, b"first", 1000)
    recorder.take("/scan", BOOL, b"second", 1100)
    recorder.take("/scan", BOOL, b"no clock yet", 0)
    recorder.close()
    assert read(tmp_path / "bag") == [("/estop", 1000, b"old"), ("/scan", 1000, b"first"), ("/scan", 1100, b"second")]
    with BagReader(tmp_path / "bag") as reader:
        assert {t.topic: t.qos.name for t in reader.topics} == {"/estop": "latched", "/scan": "sensor"}


def test_a_bag_of_latched_topics_alone_is_written_while_it_is_recorded(tmp_path: Path) -> None:
    recorder, bag = make(tmp_path / "bag")
    recorder.take("/estop", BOOL, NO, 5, "console")  # minutes before the recording
    recorder.take("/estop", BOOL, NO, 6, "robot")
    for second in (1, 2, 3):
        recorder.take("/estop", BOOL, YES, second * S, "console")
    wait_for(lambda: bag.status()["messages"] == 5, "the messages")
    recorder.close()
    stamps = [(payload == YES, stamp_ns // S) for _, stamp_ns, payload in read(tmp_path / "bag")]
    assert stamps == [(False, 1), (False, 1), (True, 1), (True, 2), (True, 3)]


def test_on_simulated_time_foreign_stamps_get_the_time_of_arrival(tmp_path: Path) -> None:
    now_ns = [0]
    recorder = Recorder(tmp_path / "bag", TopicChoice(), lambda topic, take: Losses(), lambda: now_ns[0])  # type: ignore[arg-type, return-value]
    recorder.take("/scan", BOOL, b"early", 0)
    now_ns[0] = 50 * S
    recorder.take("/scan", BOOL, b"follows the clock", 49 * S)
    recorder.take("/scan", BOOL, b"wall time", 1_700_000_000 * S)
    recorder.close()
    assert read(tmp_path / "bag") == [("/scan", 49 * S, b"follows the clock"), ("/scan", 50 * S, b"wall time")]


def test_losses_are_a_warning_only_while_they_grow(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    losses = Losses()
    recorder = recorder_of(tmp_path / "bag", losses=losses)
    second = 0.0
    monkeypatch.setattr("instant_ic.bag.recorder.time.monotonic_ns", lambda: int(second * S))

    def level() -> int:
        (found,) = recorder.diagnoses()
        assert ("lost: /estop 5, /scan 5" in found.text) is bool(losses.lost_by), found.text
        return found.level

    assert level() == Level.OK
    losses.lost_by = {"front": 5}
    assert level() == Level.WARN
    second = 11.0
    assert level() == Level.OK
    recorder.close()


def entry(value: int, size: int = 10, latched: bool = False, publisher: str = "") -> BagMessage:
    qos = LATCHED if latched else SENSOR
    return BagMessage("/estop" if latched else "/scan", BOOL, bytes([value]) * size, value * S, qos, publisher)


def test_snapshot_cache_keeps_the_last_seconds_and_what_was_latched_before() -> None:
    cache = SnapshotCache(3.0, 10_000)
    cache.add(entry(1, latched=True, publisher="a"), 1.0)
    cache.add(entry(2, latched=True, publisher="a"), 2.0)
    cache.add(entry(3, latched=True, publisher="b"), 2.5)
    for second in range(3, 11):
        cache.add(entry(second), second)
    content = cache.content()
    # The window is 7 s to 10 s; the values that held at its beginning come first, with its stamp.
    assert [(e.topic, e.stamp_ns // S, e.payload[0]) for e in content] == [
        ("/estop", 7, 2), ("/estop", 7, 3), ("/scan", 7, 7), ("/scan", 8, 8), ("/scan", 9, 9), ("/scan", 10, 10),
    ]  # fmt: skip
    assert cache.span_s == 3.0


def test_snapshots_are_bags_of_their_own(tmp_path: Path) -> None:
    recorder = recorder_of(tmp_path / "snaps", snapshot=True, snapshot_seconds=60.0)
    with pytest.raises(ValueError, match="no message has been received yet"):
        recorder.snapshot("early")
    recorder.take("/estop", BOOL, NO, 1 * S)
    recorder.take("/scan", BOOL, b"1", 2 * S)
    first = recorder.snapshot("door / stuck!")
    wait_for(lambda: first.done, "the snapshot")
    assert (first.state, first.status()["messages"]) == (ENDED, 2)
    recorder.take("/scan", BOOL, b"2", 3 * S)
    second = recorder.snapshot("door / stuck!", after_s=60.0)
    assert recorder.snapshot("again") is second  # what is not complete holds this moment too
    recorder.take("/estop", BOOL, YES, 4 * S)
    recorder.close()  # also ends the wait
    assert first.path != second.path and "door___stuck" in first.path.name
    assert read(first.path) == [("/estop", 2 * S, NO), ("/scan", 2 * S, b"1")]
    assert read(second.path) == [
        ("/estop", 2 * S, NO), ("/scan", 2 * S, b"1"), ("/scan", 3 * S, b"2"), ("/estop", 4 * S, YES),
    ]  # fmt: skip


def test_a_snapshot_ends_after_its_time_and_takes_more_than_the_queue_holds(tmp_path: Path) -> None:
    recorder = recorder_of(tmp_path / "snaps", snapshot=True, queue_mb=1)
    for second in range(1, 4):
        recorder.take("/scan", BOOL, bytes([second]) * 1_000_000, second * S)
    snapshot = recorder.snapshot(after_s=0.1)
    recorder.take("/scan", BOOL, bytes([4]) * 1_000_000, 4 * S)

    def ended() -> bool:
        recorder.tick()
        return snapshot.done

    wait_for(ended, "the end")
    recorder.take("/scan", BOOL, b"5", 5 * S)
    recorder.close()
    assert [payload[0] for _, _, payload in read(snapshot.path)] == [1, 2, 3, 4] and not recorder.failed


def test_a_snapshot_waits_for_no_disk_and_after_one_that_cannot_be_written_the_next_succeeds(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    recorder, disk = recorder_of(tmp_path / "snaps", snapshot=True), SlowDisk(monkeypatch)
    recorder.take("/scan", BOOL, b"1", 1 * S)
    disk.hang()
    first = recorder.snapshot("hanging")  # returns although not even its file can be begun
    another = recorder.snapshot("hanging")  # in the same second
    assert not first.done and not another.done
    disk.go.set()
    wait_for(lambda: first.done and another.done, "the snapshots")
    assert not first.error and not another.error and first.path != another.path
    with monkeypatch.context() as patch:
        patch.setattr("instant_ic.bag.writer.make_folder", refuse_folder)
        second = recorder.snapshot("refused")
        wait_for(lambda: second.done, "the refusal")
    assert "cannot be created: Permission denied" in second.error and recorder.failed
    third = recorder.snapshot("written")
    wait_for(lambda: third.done, "the snapshot after it")
    assert not third.error and [payload for _, _, payload in read(third.path)] == [b"1"]
    with pytest.raises(BagError, match="Permission denied"):
        recorder.close()


def refuse_folder(path: Path) -> None:
    raise PermissionError(errno.EACCES, os.strerror(errno.EACCES))


def on_the_disk(path: Path) -> list[bytes]:
    """Payloads in all files of a bag, complete or not."""
    return [message.payload for file in path.glob("*.mcap") for message in McapScan(file).messages()]


@pytest.mark.parametrize(
    ("error", "size", "end_fits", "flush_s"),
    [
        (errno.ENOSPC, 100, True, 0.1),
        (errno.ENOSPC, 3_000, True, 0.0),  # a flush before each message
        (errno.ENOSPC, 300_000, False, 0.1),
        (errno.EIO, 100, False, 0.1),
    ],
)
def test_every_message_is_recorded_or_counted_whatever_the_disk_refuses(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, error: int, size: int, end_fits: bool, flush_s: float
) -> None:
    """On a full disk the messages of the chunk that was being written were neither."""
    monkeypatch.setattr(recording, "FLUSH_S", flush_s)
    recorder, bag = make(tmp_path / "bag")
    refused = threading.Event()
    write = os.write

    def refuse(fd: int, data: memoryview) -> int:
        if refused.is_set() and (len(data) > 2_000 or not end_fits):
            raise OSError(error, os.strerror(error))
        return write(fd, data)

    monkeypatch.setattr(os, "write", refuse)
    sent = [index.to_bytes(2) * (size // 2) for index in range(120)]
    for index in range(40):
        recorder.take("/scan", BOOL, sent[index], index + S)
    wait_for(lambda: len(on_the_disk(tmp_path / "bag")) >= 20, "the first messages")
    refused.set()
    for index in range(40, 80):
        recorder.take("/scan", BOOL, sent[index], index + S)
    wait_for(lambda: bag.error, "the refusal")
    refused.clear()
    if bag.state == DISK_FULL:
        wait_for(lambda: bag.state == RECORDING, "room")
    for index in range(80, 120):
        recorder.take("/scan", BOOL, sent[index], index + S)
    with suppress(BagError):
        recorder.close()
    found = on_the_disk(tmp_path / "bag")
    lost = bag.not_written["/scan"]
    assert lost > 0 and len(found) + lost == 120 and set(found) <= set(sent)
    assert custom(tmp_path / "bag", "disk_full") == {"/scan": lost}
    assert not bag.error or f"not recorded: /scan {lost}" in bag.error


class Syncs:
    """What was written to the disk itself: inode → its size then."""

    def __init__(self, monkeypatch: pytest.MonkeyPatch) -> None:
        self.sizes: dict[int, int] = {}
        for name in ("fsync", "fdatasync"):
            monkeypatch.setattr(os, name, self._of(getattr(os, name)))

    def _of(self, sync: Callable[[int], None]) -> Callable[[int], None]:
        def note(fd: int) -> None:
            sync(fd)
            self.sizes[os.fstat(fd).st_ino] = os.fstat(fd).st_size

        return note

    def hold(self, path: Path) -> bool:
        return self.sizes.get(path.stat().st_ino) == path.stat().st_size


def test_bag_is_on_the_disk_itself_at_its_end_and_meanwhile(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(recording, "SYNC_S", 0.05)
    syncs = Syncs(monkeypatch)
    bag = tmp_path / "bag"
    recorder, _ = make(bag)
    recorder.take("/scan", BOOL, b"1" * 100, S)
    wait_for(lambda: len(on_the_disk(bag)) == 1 and syncs.hold(bag / "bag.mcap"), "the message on the disk")
    wait_for(lambda: syncs.hold(bag), "the folder that knows the file")
    recorder.take("/scan", BOOL, b"2" * 100, 2 * S)
    recorder.close()
    assert all(syncs.hold(path) for path in (bag, bag / "bag.mcap", bag / "metadata.yaml"))


# -- recordings on request, in snapshot mode ------------------------------------------------------------------------


def test_recordings_on_request_begin_end_and_begin_again(tmp_path: Path) -> None:
    losses = Losses()
    recorder = recorder_of(tmp_path, losses=losses, snapshot=True)

    def recording_status() -> dict[str, Any]:
        return recorder.status()["recording"]

    assert recording_status()["state"] == "idle" and recording_status()["free_bytes"] > 0
    with pytest.raises(ValueError, match="nothing is being recorded"):
        recorder.stop()
    recorder.take("/estop", BOOL, YES, 1 * S)  # long before: the bag begins with it
    recorder.take("/scan", BOOL, b"1", 2 * S)
    losses.lost_by = {"front": 5}
    first = recorder.record("door / stuck!")
    assert first.parent == tmp_path and first.name.startswith("rec_") and first.name.endswith("_door___stuck")
    with pytest.raises(ValueError, match="is being recorded already"):
        recorder.record()
    losses.lost_by = {"front": 7}
    for second in (3, 4, 5):
        recorder.take("/scan", BOOL, bytes([second]), second * S)
    wait_for(lambda: recording_status()["messages"] == 4, "the messages")
    assert recording_status()["state"] == "recording"
    assert [d.level for d in recorder.diagnoses()] == [Level.WARN]  # of the losses
    assert recorder.stop() == first
    recorder.take("/scan", BOOL, b"6", 6 * S)
    with pytest.raises(ValueError, match="nothing is being recorded"):
        recorder.stop()
    wait_for(lambda: recording_status()["state"] == "idle", "the end")
    status = recording_status()
    assert (status["path"], status["messages"], status["error"]) == (str(first), 4, "") and status["bytes"] > 0
    assert read(first) == [("/estop", 3 * S, YES), *(("/scan", s * S, bytes([s])) for s in (3, 4, 5))]
    assert custom(first, "lost_by") == {"/scan": {"front": 2}, "/estop": {"front": 2}}  # since it began
    second = recorder.record("door / stuck!")
    assert second != first
    recorder.close()
    assert (second / "metadata.yaml").exists()


def test_a_full_disk_is_told_while_a_recording_on_request_waits_and_when_it_ends(tmp_path: Path) -> None:
    recorder = recorder_of(tmp_path, lambda path: 1_000_000, snapshot=True)
    recorder.record()
    recorder.take("/scan", BOOL, YES, 1 * S)
    wait_for(lambda: recorder.status()["recording"]["state"] == DISK_FULL, "the full disk")
    (found,) = recorder.diagnoses()
    assert found.level == Level.ERROR and "only 1 MB are free" in found.text
    recorder.stop()
    wait_for(lambda: recorder.status()["recording"]["state"] == "idle", "the end")
    assert "only 1 MB are free" in recorder.status()["recording"]["error"]
    recorder.close()
    assert recorder.failed


def test_a_recorder_of_one_bag_refuses_requests(tmp_path: Path) -> None:
    recorder, _ = make(tmp_path / "bag")
    for request in (recorder.record, recorder.stop, recorder.snapshot):
        with pytest.raises(ValueError, match="start it with --snapshot"):
            request()
    recorder.close()


def test_a_snapshot_that_takes_long_holds_up_the_end_of_no_recording(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    go = threading.Event()

    def make_folder(path: Path) -> None:
        if "slow" in path.name:
            go.wait(20)
        path.mkdir(parents=True)

    monkeypatch.setattr("instant_ic.bag.writer.make_folder", make_folder)
    recorder = recorder_of(tmp_path / "bags", snapshot=True)
    recorder.record()
    recorder.take("/scan", BOOL, b"1", 1 * S)
    slow = recorder.snapshot("slow")
    closing = threading.Thread(target=recorder.close)
    closing.start()
    assert recorder.bag is not None
    wait_for(lambda: recorder.bag and recorder.bag.done, "the end of the recording")
    assert not slow.done and read(recorder.bag.path) == [("/scan", 1 * S, b"1")]
    go.set()
    closing.join()
    assert not recorder.failed
