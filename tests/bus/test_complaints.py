"""What users of other middlewares complain about, each complaint with its test: we do not have it."""

import errno
import gc
import signal
import subprocess
import sys
import threading
import time
import tracemalloc
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
import zmq
from local_bus import LARGE, Bus, number, numbered, wait_for, whole

from instant_ic.bus import LATCHED, OK, RELIABLE, SENSOR, QoS, RegistryError, registry
from instant_ic.bus.clock import SystemClock
from instant_ic.bus.node import Node
from instant_ic.msg import Image, deserialize, image_array, image_message

HERE = Path(__file__).parent
PICTURE = (1080, 1700, 3)  # 5.5 MB


def test_rclpy_763_rmw_fastrtps_757_slow_images_in_python(bus: Bus) -> None:
    """A picture is copied once: into the memory that its readers look at."""
    node = Node[None](None, bus.node("sender"), SystemClock(), "sender")
    out = node.publisher("/picture", Image, SENSOR)
    reader = bus.reader("/picture", SENSOR, type_name="sensor_msgs/msg/Image")
    wait_for(lambda: out.subscriber_count == 1)
    picture = np.random.default_rng(0).integers(0, 256, PICTURE, dtype=np.uint8)
    message = image_message(picture, "rgb8", "camera", 5)
    out.publish(message)  # the first one makes the buffer
    wait_for(reader.poll)
    reader.received.clear()
    tracemalloc.start()
    out.publish(message)
    received = wait_for(reader.poll)[0]
    got = image_array(deserialize(received.payload, received.type_name))
    _, peak = tracemalloc.get_traced_memory()
    tracemalloc.stop()
    assert peak < picture.nbytes // 10  # no second copy on either side
    assert np.array_equal(got, picture)
    assert not got.flags.writeable
    assert out.raw.stats.not_shared == 0


@pytest.mark.parametrize("size", [100, LARGE], ids=["small", "shared"])
def test_ros_comm_536_buff_size_lag_a_slow_node_works_on_the_newest(bus: Bus, size: int) -> None:
    """While a callback lasts, fifty frames are sent; the next callback gets the fiftieth and no other."""
    out = bus.publisher(qos=SENSOR)
    node = Node[None](None, bus.node("slow"), SystemClock(), "slow")
    worked_on: list[int] = []

    def slow(received) -> None:
        worked_on.append(number(received))
        if len(worked_on) == 1:
            for i in range(2, 51):
                out.send(numbered(i, size))
            wait_for(lambda: number(subscription.raw.queue[-1]) == 50 if subscription.raw.queue else False)
        else:
            node.stop()

    subscription = node.subscribe_received("/x", slow, SENSOR)
    wait_for(lambda: out.subscriber_count == 1)
    out.send(numbered(1, size))
    node.start()
    node.spin()
    assert worked_on == [1, 50]
    assert subscription.raw.stats.lost == 0


def test_a_slow_callback_does_not_age_what_waits_behind_it(bus: Bus) -> None:
    """Two topics came together; while the first one's callback lasts, the second one's newest is replaced."""
    slow, quick = bus.publisher("/slow", SENSOR), bus.publisher("/quick", SENSOR)
    node = Node[None](None, bus.node("busy"), SystemClock(), "busy")
    worked_on: list[int] = []

    def last() -> int:
        queue = quick_in.raw.queue
        return number(queue[-1]) if queue else 0

    def work(_) -> None:
        for i in range(2, 10):
            quick.send(numbered(i))
        wait_for(lambda: last() == 9)

    def note(received) -> None:
        worked_on.append(number(received))
        node.stop()

    slow_in = node.subscribe_received("/slow", work, SENSOR)
    quick_in = node.subscribe_received("/quick", note, SENSOR)
    wait_for(lambda: slow.subscriber_count == 1 and quick.subscriber_count == 1)
    slow.send(numbered(1))
    wait_for(lambda: slow_in.raw.stats.count == 1)
    quick.send(numbered(1))
    wait_for(lambda: quick_in.raw.stats.count == 1)
    node.start()
    node.spin()
    assert worked_on == [9]


def test_dora_515_and_3428_silent_input_loss(bus: Bus) -> None:
    """What does not fit a reader's queue is counted, with the name of the node that sent it."""
    out = bus.publisher()
    reader = bus.reader(qos=QoS("short", depth=5, reliable=True))
    wait_for(lambda: out.subscriber_count == 1)
    for i in range(1, 21):
        out.send(numbered(i))
    wait_for(lambda: reader.stats.count == 20)
    assert reader.numbers() == [16, 17, 18, 19, 20]
    assert reader.stats.lost_by == {"sender": 15}


def test_dora_3518_loss_of_a_reader_that_stands_still_is_counted(bus: Bus) -> None:
    """Sockets and queues full, as of a recorder on a stalled disk: received and lost together are what was sent."""
    out, reader = bus.publisher(), bus.reader()
    wait_for(lambda: out.subscriber_count == 1)
    with reader.transport.read_lock:  # its process stands still
        for i in range(1, 3001):
            out.send(numbered(i, 2000))
    sent = 3000

    def newest() -> bool:
        """Messages are dropped until the queue has room again; then the next one shows the gap."""
        nonlocal sent
        if reader.poll() and number(reader.received[-1]) == sent > 3000:
            return True
        out.send(numbered(sent := sent + 1))
        time.sleep(0.05)
        return False

    wait_for(newest)
    assert reader.stats.lost > 0
    assert len(reader.received) + reader.stats.lost == sent
    assert reader.numbers() == sorted(set(reader.numbers()))


def test_losses_stand_in_heartbeat_and_diagnostics_by_publisher(bus: Bus, monkeypatch: pytest.MonkeyPatch) -> None:
    out = bus.publisher()
    node = Node[None](None, bus.node("reader"), SystemClock(), "reader")
    subscription = node.subscribe_received("/x", lambda _: None)
    node.start()
    wait_for(lambda: out.subscriber_count == 1)
    out.send(numbered(1))
    out.sequence += 3  # three messages that never reached the wire
    out.send(numbered(5))
    wait_for(lambda: subscription.raw.stats.count == 2)
    told: list = []
    for publisher in (node.node_report.heartbeat, node.node_report.diagnostics):
        monkeypatch.setattr(publisher, "publish", told.append)
    node.node_report.beat()
    node.node_report.publish_diagnostics()
    beat, diagnostics = told
    assert (beat.lost_topics, beat.lost_publishers, list(beat.lost_counts)) == (["/x"], ["sender"], [3])
    (entry,) = [status for status in diagnostics.status if status.name == "reader: input /x"]
    assert (entry.level, entry.message) == (OK, "nothing lost in the last 10 s")  # the start-up's are no warning
    assert {value.key: value.value for value in entry.values}["lost from sender"] == "3"


def test_zeromq_conflate_gives_a_piece_of_a_message(bus: Bus) -> None:
    """The newest message, and the whole of it, when many were replaced on the way."""
    out, reader = bus.publisher(qos=SENSOR), bus.reader(qos=SENSOR)
    wait_for(lambda: out.subscriber_count == 1)
    with reader.transport.read_lock:
        for i in range(1, 101):
            out.send(numbered(i, 90_000))  # through the socket, which takes it in parts
    wait_for(lambda: reader.raw.queue and number(reader.raw.queue[-1]) == 100)
    (message,) = reader.poll()
    assert len(message.payload) == 90_000 and whole(message)


@pytest.mark.parametrize("size", [100, LARGE], ids=["small", "shared"])
def test_ros_comm_706_latched_value_for_a_late_joiner_and_no_duplicate_for_others(bus: Bus, size: int) -> None:
    out = bus.publisher(qos=LATCHED)
    early = bus.reader(qos=LATCHED, node="early")
    wait_for(lambda: out.subscriber_count == 1)
    for i in range(1, 4):
        out.send(numbered(i, size))
    late = bus.reader(qos=LATCHED, node="late")
    wait_for(late.poll)
    out.send(numbered(4, size))
    wait_for(lambda: late.numbers() == [3, 4])
    wait_for(lambda: early.numbers() == [1, 2, 3, 4])
    assert all(whole(message) for message in late.received + early.received)


def holder(bus: Bus, *arguments: str) -> subprocess.Popen[str]:
    return subprocess.Popen(
        [sys.executable, str(HERE / "holding_reader.py"), str(bus.run_dir), *arguments],
        stdout=subprocess.PIPE, text=True,
    )  # fmt: skip


def leased(out) -> int:
    """Number of slots that a reader has locked."""
    free = [slot for slot in out.pool.slots if slot.lock()]
    for slot in free:
        slot.unlock()
    return len(out.pool.slots) - len(free)


def test_reader_killed_gives_its_buffers_back_and_is_back_when_restarted(bus: Bus) -> None:
    out = bus.publisher()
    for _ in range(2):
        process = holder(bus)
        try:
            wait_for(lambda: out.subscriber_count == 1)
            for i in range(1, 5):
                out.send(numbered(i, LARGE))
            assert process.stdout.readline() == "holding 4\n"
            assert leased(out) == 4
        finally:
            process.kill()
            process.wait(10)
            process.stdout.close()
        wait_for(lambda: out.subscriber_count == 0)
        assert leased(out) == 0


def test_killed_publisher_leaves_no_memory_behind_and_its_place_is_swept(bus: Bus) -> None:
    def mapped() -> int:
        gc.collect()
        return Path("/proc/self/maps").read_text().count("memfd:instant_ic ")

    reader = bus.reader()  # has a page of memory of its own
    before = mapped()
    process = subprocess.Popen([sys.executable, str(HERE / "large_talker.py"), str(bus.run_dir)])
    try:
        wait_for(lambda: len(reader.poll()) >= 3)
        assert isinstance(reader.received[0].payload, memoryview)  # it did come through shared memory
    finally:
        process.kill()
        process.wait(10)
    assert mapped() > before and all(whole(message) for message in reader.received)
    reader.received.clear()
    wait_for(lambda: mapped() <= before)
    assert registry.sweep(bus.run_dir) == 1
    assert list(bus.run_dir.glob("topics/*/*.sock")) == []


def test_message_of_another_type_is_refused_counted_and_named(bus: Bus, caplog: pytest.LogCaptureFixture) -> None:
    out = bus.publisher(type_name="std_msgs/msg/Bool")
    reader = bus.reader(type_name="std_msgs/msg/String")
    wait_for(lambda: out.subscriber_count == 1)
    for size in (100, LARGE):
        out.send(numbered(1, size))
    wait_for(lambda: reader.stats.rejected == 2)
    assert reader.poll() == []
    assert "/x: node sender sends std_msgs/msg/Bool, std_msgs/msg/String expected" in caplog.text
    assert caplog.text.count("refused and counted") == 1  # told once, not with every message


def test_dora_515_a_publisher_that_ends_tells_that_its_readers_were_too_slow(
    bus: Bus, caplog: pytest.LogCaptureFixture
) -> None:
    """No later message will show the gap."""
    out = bus.publisher()
    with zmq.Context() as context, context.socket(zmq.SUB) as sleeper:  # takes nothing
        sleeper.linger = 0
        sleeper.rcvhwm = 1
        sleeper.subscribe(b"/x")
        sleeper.connect(f"ipc://{registry.topic_publishers(bus.run_dir, '/x')[0].socket}")
        wait_for(lambda: out.subscriber_count == 1)
        for k in range(60):
            out.send(numbered(k, 50_000))
        started = time.monotonic()
        bus.node("sender").close()
        assert time.monotonic() - started < 20.0
    assert "sender closed, but a reader was too slow: its last messages are lost" in caplog.text


def test_full_memory_is_not_tried_and_logged_with_every_image(
    bus: Bus, monkeypatch: pytest.MonkeyPatch, caplog
) -> None:
    tries: list[int] = []

    def full(_descriptor: int, _at: int, size: int) -> None:
        tries.append(size)
        raise OSError(errno.ENOSPC, "No space left on device")

    out, reader = bus.publisher(qos=LATCHED), bus.reader()
    monkeypatch.setattr("instant_ic.bus.shm.os.posix_fallocate", full)
    with pytest.raises(OSError):
        bus.reader("/y")  # it leaves no socket open, for which the end would wait for ever
    tries.clear()
    for extra in range(8):  # compressed images differ in size
        out.send(numbered(extra, LARGE + 8 * extra))
    assert len(tries) == 1
    assert caplog.text.count("no shared memory for") == 1 and out.stats.not_shared == 8
    wait_for(lambda: reader.poll() and number(reader.received[-1]) == 7)


def test_reader_that_cannot_map_memory_asks_for_bytes(
    bus: Bus, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    def refuse(*_: object) -> None:
        raise OSError(errno.ENOMEM, "Cannot allocate memory")

    monkeypatch.setattr("instant_ic.bus.local_subscription.Slot.open", refuse)
    out, reader = bus.publisher(qos=LATCHED), bus.reader()
    wait_for(lambda: out.subscriber_count == 1)
    out.send(numbered(1, LARGE))
    message = wait_for(reader.poll)[0]
    assert number(message) == 1 and whole(message)
    assert "shared memory of sender cannot be used (Cannot allocate memory); large messages" in caplog.text


def test_torn_frames_fast_writer_slow_readers(bus: Bus) -> None:
    """Readers keep views for a while, let them go in any order, and look at every byte before and after."""
    out = bus.publisher(qos=SENSOR)
    readers = [bus.reader(qos=qos, node=f"reader{i}") for i, qos in enumerate((SENSOR, RELIABLE, SENSOR))]
    wait_for(lambda: out.subscriber_count == 3)
    stop = threading.Event()
    sent = 0

    def write() -> None:
        nonlocal sent
        while not stop.is_set():
            sent += 1
            out.send(numbered(sent, LARGE + sent % 7 * 50_000))

    writer = threading.Thread(target=write)
    writer.start()
    random = np.random.default_rng(1)
    try:
        held: list = []
        looked_at = 0
        while looked_at < 200:
            for reader in readers:
                held += reader.raw.take()
            random.shuffle(held)
            while len(held) > 9:
                message = held.pop()
                assert whole(message), f"message {number(message)} was written over"
                looked_at += 1
    finally:
        stop.set()
        writer.join()
    assert all(whole(message) for message in held)
    assert all(reader.stats.overwritten == 0 and reader.raw.stats.rejected == 0 for reader in readers)
    held.clear()


def test_writing_over_a_lent_buffer_is_seen_and_told(bus: Bus, caplog: pytest.LogCaptureFixture) -> None:
    """A publisher that breaks the rule: its readers notice after use, and before it."""
    out, reader = bus.publisher(), bus.reader()
    wait_for(lambda: out.subscriber_count == 1)
    out.send(numbered(1, LARGE))
    wait_for(reader.poll)
    out.pool.slots[0].finish(99)
    reader.received.clear()
    gc.collect()
    wait_for(lambda: reader.stats.overwritten == 1)
    with reader.transport.read_lock:
        out.send(numbered(2, LARGE))
        out.pool.slots[-1].finish(98)
    wait_for(lambda: reader.stats.lost_by == {"sender": 1})
    assert reader.poll() == [] and reader.stats.overwritten == 1
    assert "sender overwrote a message that was still in use" in caplog.text


def test_a_recorder_that_collects_does_not_starve_the_publisher(bus: Bus) -> None:
    """A queue of a hundred large messages holds four buffers; the rest are copies, and nothing is lost."""
    out, collector, other = bus.publisher(), bus.reader(node="collector"), bus.reader(node="other", qos=SENSOR)
    wait_for(lambda: out.subscriber_count == 2)
    for i in range(1, 101):
        out.send(numbered(i, LARGE))
        # Of both: a reader whose thread has not run yet holds what lies in its socket, too.
        wait_for(lambda i=i: collector.stats.count == i and other.raw.queue and number(other.raw.queue[-1]) == i)
    assert collector.numbers() == list(range(1, 101))
    assert all(whole(message) for message in collector.received)
    assert collector.stats.lost == 0
    assert out.stats.not_shared == 0
    assert len(out.pool.slots) <= 8


@pytest.mark.parametrize("qos", [SENSOR, RELIABLE], ids=["sensor", "reliable"])
def test_reader_goes_on_after_it_held_all_it_may_hold(bus: Bus, qos: QoS) -> None:
    """Found by the soak: a queue that waited for a buffer was never sent when the next message brought it back."""
    out, reader, other = bus.publisher(qos=qos), bus.reader(qos=qos), bus.reader(qos=qos, node="other")
    wait_for(lambda: out.subscriber_count == 2)
    last = 0
    for _ in range(5):
        with reader.transport.read_lock:  # its process stands still, and then both go on together
            for _ in range(30):
                out.send(numbered(last := last + 1, LARGE))
        out.send(numbered(last := last + 1, LARGE))
    for each in (reader, other):
        wait_for(lambda each=each: each.poll() and number(each.received[-1]) == last)
        assert each.stats.lost == 0
        assert all(whole(message) for message in each.received)
    if qos is RELIABLE:
        assert reader.numbers() == list(range(1, last + 1))


def test_full_disk_under_the_run_directory_is_told(bus: Bus, monkeypatch: pytest.MonkeyPatch) -> None:
    def full(*_: object, **__: object) -> None:
        raise OSError(errno.ENOSPC, "No space left on device")

    monkeypatch.setattr(registry, "replacing", full)
    with pytest.raises(
        RegistryError, match=r"publisher of /x by node sender cannot be registered: .*No space left on device"
    ):
        bus.publisher()
    monkeypatch.undo()
    out, reader = bus.publisher(), bus.reader()  # the name is free again
    wait_for(lambda: out.subscriber_count == 1)
    out.send(numbered(1))
    wait_for(lambda: reader.numbers() == [1])


def test_message_that_does_not_fit_its_type_leaves_the_topic_usable(bus: Bus) -> None:
    from instant_ic.msg import MessageError

    node = Node[None](None, bus.node("sender"), SystemClock(), "sender")
    out = node.publisher("/picture", Image, SENSOR)
    reader = bus.reader("/picture", SENSOR, type_name="sensor_msgs/msg/Image")
    wait_for(lambda: out.subscriber_count == 1)
    message = image_message(np.zeros(PICTURE, np.uint8), "rgb8", "camera", 5)
    wrong = image_message(np.zeros(PICTURE, np.uint8), "rgb8", "camera", 5)
    wrong.step = "no number"
    for _ in range(12):
        with pytest.raises(MessageError, match="sensor_msgs/msg/Image"):
            out.publish(wrong)
    out.publish(message)
    wait_for(reader.poll)
    assert reader.stats.lost == 0 and len(out.raw.pool.slots) == 1


def test_large_messages_through_the_socket_are_bounded_in_bytes(bus: Bus, monkeypatch: pytest.MonkeyPatch) -> None:
    out = bus.publisher()
    bus.reader()
    wait_for(lambda: out.subscriber_count == 1)
    monkeypatch.setattr(out.pool, "acquire", lambda *_: None)
    monkeypatch.setattr(out, "_progress", {b"": SimpleNamespace(sequence=lambda: 0, newest_only=False)})  # stopped
    for i in range(1, 200):
        out.send(numbered(i, 1 << 20))
    assert sum(size for _, size in out.inlined) <= 128 << 20


def test_dora_2152_a_node_exits_though_its_reader_stands_still(bus: Bus) -> None:
    reader = bus.reader("/chatter", type_name="std_msgs/msg/String")
    process = subprocess.Popen(
        [sys.executable, str(HERE / "talker_node.py"), "-p", "period_s:=0.001", "--run-dir", str(bus.run_dir)]
    )
    try:
        wait_for(lambda: len(reader.poll()) > 10)
        with reader.transport.read_lock:
            process.send_signal(signal.SIGINT)
            assert process.wait(30) == 0
    finally:
        process.kill()
        process.wait(10)
