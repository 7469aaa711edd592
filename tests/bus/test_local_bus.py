"""The bus over real sockets, most of it between processes."""

import os
import signal
import subprocess
import sys
import threading
import time
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from types import SimpleNamespace

import pytest
from local_bus import BYTES, wait_for

from instant_ic.bus import LATCHED, RELIABLE, SENSOR, RegistryError, local_subscription, registry
from instant_ic.bus.local_transport import LocalTransport
from instant_ic.bus.node import Node
from instant_ic.bus.topics import Publisher
from instant_ic.msg import String, deserialize, serialize

TALKER = Path(__file__).with_name("talker_node.py")
INTERRUPTED = Path(__file__).with_name("interrupted_node.py")


@pytest.fixture
def run_dir(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return tmp_path_factory.mktemp("r")


def start_talker(run_dir: Path, *arguments: str) -> subprocess.Popen[str]:
    environment = {**os.environ, "INSTANT_IC_RUN_DIR": str(run_dir)}
    return subprocess.Popen(
        [sys.executable, str(TALKER), *arguments], env=environment, stderr=subprocess.PIPE, text=True
    )


class Inbox:
    """Collects the strings of one topic."""

    def __init__(self, transport: LocalTransport, topic: str, qos=RELIABLE):
        self.event = threading.Event()
        self.raw = transport.subscribe(topic, "std_msgs/msg/String", qos, self.event.set)
        self.texts: list[str] = []
        self.instances: list[bytes] = []

    def poll(self) -> list[str]:
        taken = self.raw.take()
        self.texts += [deserialize(m.payload, m.type_name).data for m in taken]
        self.instances += [m.instance for m in taken]
        return self.texts


@pytest.fixture
def transport(run_dir: Path):
    transport = LocalTransport(run_dir, "tester", time.time_ns)
    yield transport
    transport.close()


@pytest.fixture
def talker(run_dir: Path):
    processes: list[subprocess.Popen[str]] = []

    def start(*arguments: str) -> subprocess.Popen[str]:
        processes.append(start_talker(run_dir, *arguments))
        return processes[-1]

    yield start
    for process in processes:
        process.kill()
        process.wait(10)
        process.stderr.close()


def test_messages_latched_values_and_clean_exit(transport, talker, run_dir):
    inbox, greeting = Inbox(transport, "/chatter"), Inbox(transport, "/greeting", LATCHED)
    process = talker("-p", "text:=bonjour")
    wait_for(lambda: len(inbox.poll()) >= 5)
    numbers = [int(text.split()[1]) for text in inbox.texts]
    assert numbers == list(range(numbers[0], numbers[0] + len(numbers)))
    assert wait_for(greeting.poll) == ["bonjour"]
    # A late joiner gets the latched value; who was there before gets it no second time.
    late = Inbox(transport, "/greeting", LATCHED)
    assert wait_for(late.poll) == ["bonjour"]
    assert greeting.poll() == ["bonjour"]
    assert [n.name for n in registry.list_nodes(run_dir)] == ["talker"]
    assert {t.topic for t in registry.list_topics(run_dir)} >= {"/chatter", "/greeting", "/heartbeat"}
    process.send_signal(signal.SIGINT)
    assert process.wait(10) == 0
    assert registry.list_nodes(run_dir) == []
    assert registry.list_topics(run_dir) == []
    assert list(run_dir.glob("topics/*/*.sock")) == []


def test_publisher_killed_and_restarted_is_heard_again(transport, talker, run_dir):
    inbox = Inbox(transport, "/chatter")
    first = talker()
    wait_for(lambda: len(inbox.poll()) >= 3)
    first.kill()
    first.wait(10)
    assert registry.list_topics(run_dir) == []  # dead, though its files are still there
    assert list(run_dir.glob("topics/chatter/*.sock")) != []
    heard = len(inbox.poll())
    talker("-p", "text:=again")
    wait_for(lambda: [t for t in inbox.poll()[heard:] if t.startswith("again")])
    assert inbox.raw.stats.lost == 0
    assert len(set(inbox.instances)) == 2, "a process that is started again is another publisher"
    assert inbox.instances[0] != inbox.instances[-1]


def test_publisher_that_leaves_the_registry_long_after_the_last_look_is_heard_for_the_grace(
    transport, run_dir, monkeypatch
):
    said_before = ["known"]

    def say(text: str) -> None:
        publisher.send(serialize(String(data=text)))

    ahead_s = 0.0
    clock = SimpleNamespace(**vars(time) | {"monotonic": lambda: time.monotonic() + ahead_s})
    monkeypatch.setattr(local_subscription, "time", clock)
    monkeypatch.setattr(registry, "time", clock)
    monkeypatch.setattr(local_subscription, "_GRACE_S", 60.0)
    sender = LocalTransport(run_dir, "sender", time.time_ns)
    try:
        publisher = sender.advertise("/chatter", "std_msgs/msg/String", RELIABLE)
        inbox = Inbox(transport, "/chatter")
        wait_for(lambda: publisher.subscriber_count)
        for text in said_before:
            say(text)
        wait_for(lambda: inbox.poll() == said_before)
        ahead_s = 1000.0
        next(run_dir.glob("topics/chatter/*.json")).unlink()
        wait_for(lambda: inbox.raw.folder.publishers == [])
        say("late")
        wait_for(lambda: inbox.poll() == [*said_before, "late"])
        assert inbox.raw.stats.rejected == 0
        ahead_s = 2000.0
        wait_for(lambda: publisher.subscriber_count == 0)
    finally:
        sender.close()


def test_sweep_clears_what_the_dead_left_and_nothing_else(transport, talker, run_dir):
    process = talker()
    wait_for(lambda: len(registry.list_topics(run_dir)) >= 5)
    assert registry.sweep(run_dir) == 0
    process.kill()
    process.wait(10)
    assert registry.sweep(run_dir) >= 5
    assert list(run_dir.glob("topics/*")) == [] == list(run_dir.glob("nodes/*"))


def test_a_name_that_passes_on_is_locked_in_the_file_that_its_path_names(run_dir, monkeypatch):
    stem = run_dir / "nodes" / "walker"
    registry.prepare(run_dir)
    for _ in range(20):
        first = registry.Claim(stem, "node walker")
        with ThreadPoolExecutor() as pool:
            monkeypatch.setattr(registry, "_PREDECESSOR_S", 30.0)
            waiting = pool.submit(registry.Claim, stem, "node walker")
            first.release()
            registry.sweep(run_dir)
            second = waiting.result()
        second.write({"name": "walker"})
        assert registry.sweep(run_dir) == 0 and second.json_path.exists()
        monkeypatch.setattr(registry, "_PREDECESSOR_S", 0.0)
        with pytest.raises(registry.RegistryError, match="already exists"):
            registry.Claim(stem, "node walker")
        second.release()
        assert list(run_dir.glob("nodes/*")) == []


def test_second_node_of_a_name_is_refused(talker, run_dir):
    talker()
    wait_for(lambda: registry.list_nodes(run_dir))
    second = talker()
    assert second.wait(30) == 1
    assert "node talker already exists" in second.stderr.read()


def test_sensor_keeps_the_newest_and_reliable_everything(transport):
    publisher = transport.advertise("/numbers", "std_msgs/msg/String", SENSOR)
    newest, every = Inbox(transport, "/numbers", SENSOR), Inbox(transport, "/numbers", RELIABLE)
    wait_for(lambda: publisher.subscriber_count == 2)
    for i in range(20):
        publisher.send(serialize(String(data=str(i))))
    wait_for(lambda: newest.raw.stats.count == 20 and every.raw.stats.count == 20)
    assert newest.poll() == ["19"]
    assert every.poll() == [str(i) for i in range(20)]


def test_topic_that_is_a_prefix_of_another_is_separate(transport):
    a = transport.advertise("/map", "std_msgs/msg/String", SENSOR)
    b = transport.advertise("/map_updates", "std_msgs/msg/String", SENSOR)
    inbox = Inbox(transport, "/map")
    wait_for(lambda: a.subscriber_count == 1)
    b.send(serialize(String(data="no")))
    a.send(serialize(String(data="yes")))
    assert wait_for(inbox.poll) == ["yes"]
    assert b.subscriber_count == 0


def test_path_too_long_for_a_socket(tmp_path):
    long = tmp_path / ("x" * 100)
    transport = LocalTransport(long, "tester", time.time_ns)
    try:
        with pytest.raises(RegistryError, match="set INSTANT_IC_RUN_DIR to a shorter folder"):
            transport.advertise("/a", "std_msgs/msg/String", SENSOR)
    finally:
        transport.close()


def test_publish_checks_the_type(transport):
    node = Node[None](None, transport, _Clock(), name="tester")
    publisher: Publisher = node.publisher("/text", String)
    from instant_ic.msg import Bool, MessageError

    with pytest.raises(MessageError, match="/text carries std_msgs/msg/String, not std_msgs/msg/Bool"):
        publisher.publish(Bool(data=True))


class _Clock:
    def now_ns(self) -> int:
        return time.time_ns()


def test_every_node_takes_nice_and_checks_it(talker, run_dir):
    process = talker("-p", "nice:=3")
    wait_for(lambda: registry.list_nodes(run_dir))
    assert os.getpriority(os.PRIO_PROCESS, process.pid) == os.getpriority(os.PRIO_PROCESS, 0) + 3
    refused = talker("--name", "other", "-p", "nice:=-5")
    assert refused.wait(30) == 2
    assert "-p nice:=-5: nice must lie in 0..19 (got -5)" in refused.stderr.read()


def test_signal_while_the_loop_holds_its_lock_does_not_hang(run_dir):
    command = [sys.executable, str(INTERRUPTED), "--run-dir", str(run_dir)]
    done = subprocess.run(command, stderr=subprocess.PIPE, text=True, timeout=60)
    assert done.returncode == 0, done.stderr
    assert "left in order" in done.stderr
    assert list(run_dir.glob("topics/*/*.sock")) == []


def test_an_event_during_a_long_callback_does_not_keep_the_bus_thread_busy(bus, monkeypatch):
    transport = bus.node("reader")
    subscription = transport.subscribe("/x", BYTES, RELIABLE, transport.set)
    publisher = bus.publisher("/x")
    wait_for(lambda: publisher.subscriber_count)
    transport.wait(0.01)
    rounds: list[None] = []
    read = transport._read
    monkeypatch.setattr(transport, "_read", lambda *args, **names: (rounds.append(None), read(*args, **names)))
    publisher.send(b"first")  # the bus thread reads it and sets the event
    wait_for(lambda: transport._set)
    time.sleep(0.2)
    assert len(rounds) <= 6
    transport.wait(3600.0)  # ended by the event
    transport.clear()
    assert [bytes(received.payload) for received in subscription.take()] == [b"first"]


def test_messages_do_not_wake_a_patient_node_and_are_all_read_when_it_wakes(bus):
    transport = bus.node("reader")
    transport.patient = True
    transport.wait(0.0)  # until the first wait the bus thread reads
    subscription = transport.subscribe("/x", BYTES, RELIABLE, transport.set)
    publisher = bus.publisher("/x")
    wait_for(lambda: publisher.subscriber_count)
    sent = [b"%d" % number for number in range(20)]
    for payload in sent:
        publisher.send(payload)
    began = time.monotonic()
    transport.wait(0.3)
    assert time.monotonic() - began > 0.29
    assert [bytes(received.payload) for received in subscription.take()] == sent
    transport.clear()
    threading.Timer(0.05, transport.set).start()
    transport.wait(3600.0)  # ended by the event


def test_a_topic_whose_empty_folder_was_swept_is_heard_and_holds_up_no_other(bus, caplog):
    """Each start and end of a stack sweeps its run directory, also beside a reader that waits for the next stack."""
    swept, other = bus.reader("/swept"), bus.reader("/other")
    wait_for(lambda: (bus.run_dir / "topics" / "other").is_dir())
    registry.sweep(bus.run_dir)
    publishers = [bus.publisher("/other")]
    wait_for(lambda: publishers[0].subscriber_count, 10.0)
    publishers.append(bus.publisher("/swept"))
    wait_for(lambda: publishers[1].subscriber_count, 10.0)
    for publisher in publishers:
        publisher.send(b"heard")
    wait_for(lambda: swept.poll() and other.poll())
    assert not caplog.records


def test_a_fault_with_one_topic_holds_up_no_other(bus, monkeypatch):
    broken, other = bus.reader("/broken"), bus.reader("/other")
    monkeypatch.setattr(broken.raw, "discover", lambda: 1 / 0)
    publisher = bus.publisher("/other")
    wait_for(lambda: publisher.subscriber_count, 10.0)
    publisher.send(b"heard")
    wait_for(other.poll)


def test_a_program_that_seldom_waits_hears_each_message_at_once(run_dir: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """As a loop of another library does, which only takes what has come: not at the bus thread's next look."""
    out, reader = (LocalTransport(run_dir, name, time.time_ns) for name in ("talker", "reader"))
    try:
        publisher = out.advertise("/x", "std_msgs/msg/String", RELIABLE)
        subscription = reader.subscribe("/x", "std_msgs/msg/String", RELIABLE, lambda: None)
        wait_for(lambda: publisher.subscriber_count)
        for name in ("_LOOK_S", "_IDLE_S"):
            monkeypatch.setattr(f"instant_ic.bus.local_transport.{name}", 1000.0)
        wait_for(lambda: reader._next_look_s > time.monotonic() + 100)
        for number in range(5):
            reader.wait(0.0)
            publisher.send(serialize(String(str(number))))
            wait_for(subscription.take, 10)
    finally:
        for transport in (out, reader):
            transport.close()


def test_the_second_of_two_messages_ends_the_next_wait(run_dir: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """One wait reads the first; the next finds the second by itself, since no descriptor will report it."""
    out, reader = (LocalTransport(run_dir, name, time.time_ns) for name in ("talker", "reader"))
    try:
        publisher = out.advertise("/x", "std_msgs/msg/String", RELIABLE)
        subscription = reader.subscribe("/x", "std_msgs/msg/String", RELIABLE, reader.set)
        wait_for(lambda: publisher.subscriber_count)
        reader._left_s = time.monotonic() + 1000.0  # the bus thread does not read, from its next look on
        for name in ("_LOOK_S", "_IDLE_S"):
            monkeypatch.setattr(f"instant_ic.bus.local_transport.{name}", 1000.0)
        wait_for(lambda: reader._next_look_s > time.monotonic() + 100)
        for text in ("first", "second"):
            publisher.send(serialize(String(text)))
        time.sleep(0.1)  # both are in the socket
        reader.wait(10.0)
        assert len(subscription.take()) == 1
        reader.clear()
        started_s = time.monotonic()
        reader.wait(30.0)
        assert len(subscription.take()) == 1
        assert time.monotonic() - started_s < 20.0
    finally:
        for transport in (out, reader):
            transport.close()
