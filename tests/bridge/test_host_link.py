"""The link over real sockets: keys at the door, revoking, reconnecting, slow and broken networks."""

import contextlib
import logging
import socket
import threading
import time

import pytest
import zmq

from instant_ic.bridge.commands import COMMANDS
from instant_ic.bridge.host_connector import ConnectingLink
from instant_ic.bridge.host_keys import KeyStore, Peer
from instant_ic.bridge.host_link import HostLinkError, LinkProblem, Stranger, check_endpoint
from instant_ic.bridge.host_listener import ListeningLink
from instant_ic.bridge.host_session import Arrived, Ended, LinkTimes, Side, Up
from instant_ic.bridge.host_topics import TopicRule

STATE, PICTURE = TopicRule("/ic/state"), TopicRule("/camera", lane="bulk")
COMMAND = TopicRule("/operator/cmd_vel", lane="command", max_age_s=0.25)
ESTOP = TopicRule("/operator/estop", lane="command", shared=True)
SENSOR, LATCHED = ("sensor", False, False), ("latched", True, True)
TIMES = LinkTimes(ping_s=0.1, timeout_s=1.0)


def wait_for(condition, what, timeout_s=20.0):
    deadline = time.monotonic() + timeout_s
    while not (value := condition()):
        assert time.monotonic() < deadline, f"no {what} within {timeout_s} s"
        time.sleep(0.005)
    return value


def by_topic(*rules):
    return {rule.topic: rule for rule in rules}


class End:
    """One end of a link with what happened at it."""

    def __init__(self, link_class, *where, name, store, exports, imports, digest=lambda name: "same", times=TIMES):
        self.events = []
        self.times = []
        side = Side(name, f"{name}-{time.monotonic_ns()}", by_topic(*imports), digest)
        self.link = link_class(*where, side, by_topic(*exports), store, self.on_event, times)
        self.link.start()

    def on_event(self, peer, event):
        self.times.append(time.monotonic())
        self.events.append(event)

    def of(self, kind):
        return [event for event in self.events if isinstance(event, kind)]

    def payloads(self, topic):
        return [bytes(e.payload) for e in self.of(Arrived) if e.announce.topic == topic]

    def send(self, topic, payload, qos=SENSOR, origin="node"):
        self.link.offer(topic, origin, COMMANDS.get(topic, "std_msgs/msg/String"), qos, payload, time.time_ns())

    def said(self, words):
        return any(words in problem.text for problem in self.of(LinkProblem))


@pytest.fixture
def ends():
    made = []
    yield made
    for end in made:
        end.link.stop()


@pytest.fixture
def keys(tmp_path):
    stores = {}
    for name in ("robot", "station", "tablet"):
        stores[name] = KeyStore(tmp_path / name)
        stores[name].create(name)
    robot = stores["robot"].identity().public_key
    for name in ("station", "tablet"):
        stores[name].allow(Peer("robot", "driver", robot))
    allow(stores, "station")
    return stores


def allow(stores, name, role="driver"):
    stores["robot"].allow(Peer(name, role, stores[name].identity().public_key))


def robot(ends, keys, port=0, **options):
    end = End(
        ListeningLink, f"tcp://127.0.0.1:{port}", name="robot", store=keys["robot"],
        exports=[STATE, PICTURE], imports=[COMMAND, ESTOP], **options,
    )  # fmt: skip
    ends.append(end)
    return end


def station(ends, keys, port, name="station", peer=None, **options):
    end = End(
        ConnectingLink, f"tcp://127.0.0.1:{port}", peer or keys[name].peer("robot"), name=name, store=keys[name],
        exports=[COMMAND, ESTOP], imports=[STATE, PICTURE], **options,
    )  # fmt: skip
    ends.append(end)
    return end


def linked(*pair):
    wait_for(lambda: all(end.link.peers() for end in pair), "link")


def test_topics_both_ways_and_what_is_told_of_the_link(ends, keys):
    a = robot(ends, keys)
    b = station(ends, keys, a.link.port)
    linked(a, b)
    a.send("/camera", bytes(range(256)) * 4000)
    b.send("/operator/cmd_vel", b"go")
    wait_for(lambda: b.payloads("/camera") and a.payloads("/operator/cmd_vel"), "messages")
    assert b.payloads("/camera") == [bytes(range(256)) * 4000]
    wait_for(lambda: a.link.peers()[0].rtt_ms > 0, "clock")
    (peer,) = a.link.peers()
    assert (peer.name, peer.role, peer.address, peer.drives) == ("station", "driver", "127.0.0.1", True)
    assert abs(peer.offset_ms) <= max(peer.rtt_ms, 1.0)  # one machine has one clock
    out, into = b.link.counts()
    assert out["/operator/cmd_vel"].messages == 1 and into["/camera"].bytes == 1_024_000


def test_latched_value_reaches_who_comes_later_and_not_after_its_publisher_has_gone(ends, keys):
    a = robot(ends, keys)
    a.send("/ic/state", b"old", LATCHED)
    a.send("/ic/state", b"new", LATCHED)
    a.send("/ic/state", b"other publisher", LATCHED, origin="second")
    a.link.forget("/ic/state", "gone")
    b = station(ends, keys, a.link.port)
    wait_for(lambda: len(b.payloads("/ic/state")) == 2, "latched values")
    assert sorted(b.payloads("/ic/state")) == [b"new", b"other publisher"]
    a.link.forget("/ic/state", "second")
    allow(keys, "tablet")
    c = station(ends, keys, a.link.port, "tablet")
    wait_for(lambda: c.payloads("/ic/state"), "latched value")
    a.send("/camera", b"end")
    wait_for(lambda: c.payloads("/camera"), "picture")
    assert c.payloads("/ic/state") == [b"new"]


def test_a_stranger_gets_nothing_and_is_told_once(ends, keys):
    a = robot(ends, keys)
    c = station(ends, keys, a.link.port, "tablet")  # has a key, is not on the list
    a.send("/ic/state", b"secret", LATCHED)
    c.send("/operator/cmd_vel", b"go", LATCHED)
    wait_for(lambda: c.said("does not allow this host's key"), "words")
    wait_for(lambda: a.link.strangers >= 2, "second try")
    assert c.of(Up) == c.of(Arrived) == a.of(Arrived) == a.of(Up) == []
    mine = keys["tablet"].identity().fingerprint
    assert a.of(Stranger) == [Stranger("127.0.0.1", mine, 1)]
    assert c.said(mine) and c.said("ic keys allow tablet")
    allow(keys, "tablet")  # and now it is let in, without a restart of either
    linked(c)
    wait_for(lambda: c.payloads("/ic/state") == [b"secret"], "state")


def test_stranger_with_ever_new_keys_does_not_flood_the_log(ends, keys):
    a = robot(ends, keys)
    with a.link._lock:
        for index in range(3000):
            a.link._turn_away("10.0.0.9", index.to_bytes(32, "little"))
    assert a.link.strangers == 3000 and 10 <= len(a.of(Stranger)) <= 40
    assert len(a.link._reported) <= 1000


def test_revoked_host_is_cut_off_at_once(ends, keys):
    a = robot(ends, keys)
    b = station(ends, keys, a.link.port)
    linked(a, b)
    stop = threading.Event()

    def keep_sending():
        while not stop.wait(0.01):
            b.send("/operator/cmd_vel", b"go")
            a.send("/ic/state", b"s")

    thread = threading.Thread(target=keep_sending)
    thread.start()
    try:
        wait_for(lambda: len(a.of(Arrived)) > 10, "commands")
        keys["robot"].revoke("station")
        wait_for(lambda: any(e.code == "revoked" for e in a.of(Ended)), "end")
        heard, seen = len(a.of(Arrived)), len(b.of(Arrived))
        wait_for(lambda: b.said("does not allow this host's key"), "refusal")
        assert len(a.of(Arrived)) == heard and len(b.of(Arrived)) <= seen + 2  # what was in the air already
    finally:
        stop.set()
        thread.join()
    assert any(e.code == "revoked" and "no longer allows" in e.reason for e in b.of(Ended))


def test_another_robot_at_the_address_is_not_believed(ends, keys):
    a = robot(ends, keys)
    wrong = Peer("robot", "driver", keys["tablet"].identity().public_key)
    b = station(ends, keys, a.link.port, peer=wrong)
    wait_for(lambda: b.said("before it proves the key of robot"), "words")
    assert b.of(Up) == [] and a.of(Up) == []


def test_server_without_a_key_is_not_believed(ends, keys):
    with zmq.Context() as context, context.socket(zmq.ROUTER) as impostor:
        impostor.linger = 0
        port = impostor.bind_to_random_port("tcp://127.0.0.1")
        b = station(ends, keys, port)
        wait_for(lambda: b.said("before it proves the key of robot"), "words")
        b.link.stop()


def test_nobody_at_the_address_is_told_and_waited_for(ends, keys):
    with socket.create_server(("127.0.0.1", 0)) as taken:
        port = taken.getsockname()[1]
    b = station(ends, keys, port)
    wait_for(lambda: b.said("cannot be reached"), "words")
    a = robot(ends, keys, port)
    linked(a, b)
    assert b.of(LinkProblem)[-1].text == ""


def test_robot_that_starts_anew_is_met_again(ends, keys):
    a = robot(ends, keys)
    port = a.link.port
    b = station(ends, keys, port)
    linked(a, b)
    a.link.stop()
    wait_for(lambda: b.of(Ended), "goodbye")
    assert b.of(Ended)[0].code in ("closing", "gone")  # on a busy machine the connection may be faster than the word
    again = robot(ends, keys, port)
    linked(again, b)
    b.send("/operator/cmd_vel", b"go")
    wait_for(lambda: again.payloads("/operator/cmd_vel"), "command")


def test_command_that_was_old_before_it_reached_the_bridge_is_dropped(ends, keys):
    a = robot(ends, keys)
    b = station(ends, keys, a.link.port)
    linked(a, b)
    b.link.offer(COMMAND.topic, "late", COMMANDS[COMMAND.topic], SENSOR, b"old", time.time_ns() - 400_000_000)
    wait_for(lambda: b.link.counts()[0].get(COMMAND.topic) and b.link.counts()[0][COMMAND.topic].expired, "count")
    b.link.offer(COMMAND.topic, "simulated", COMMANDS[COMMAND.topic], SENSOR, b"new", 5_000_000_000, wall_time=False)
    wait_for(lambda: a.payloads(COMMAND.topic), "command by a simulated clock")
    assert a.payloads(COMMAND.topic) == [b"new"]
    assert a.of(Arrived)[-1].publish_ns == 5_000_000_000


def test_garbage_and_silence_at_the_door_harm_nobody(ends, keys):
    a = robot(ends, keys)
    b = station(ends, keys, a.link.port)
    linked(a, b)
    open_ones = []
    for garbage in (b"GET / HTTP/1.1\r\n\r\n" * 20, b"\xff" + bytes(8) + b"\x7f\x03" + bytes(200), b""):
        connection = socket.create_connection(("127.0.0.1", a.link.port))
        connection.sendall(garbage)
        open_ones.append(connection)
    b.send("/operator/cmd_vel", b"go")
    wait_for(lambda: a.payloads("/operator/cmd_vel"), "command")
    for connection in open_ones:  # also the silent one is let go of, after the time for a greeting
        connection.settimeout(15)
        with contextlib.suppress(ConnectionResetError):
            while connection.recv(4096):
                pass
        connection.close()
    assert a.link.peers() and len(a.of(Up)) == 1


def test_damaged_list_keeps_who_was_allowed_and_is_told(ends, keys):
    a = robot(ends, keys)
    b = station(ends, keys, a.link.port)
    linked(a, b)
    path = keys["robot"].allowed_path
    text = path.read_text()
    path.write_text(text + "tablet dri")
    wait_for(lambda: a.said("allowed:3"), "words")
    assert a.link.peers()
    path.write_text(text)
    wait_for(lambda: a.of(LinkProblem)[-1].text == "", "words taken back")
    path.unlink()
    wait_for(lambda: a.said("no host is allowed"), "words")
    wait_for(lambda: not a.link.peers(), "cut")


def test_port_that_is_taken_is_told(ends, keys):
    a = robot(ends, keys)
    with pytest.raises(HostLinkError, match="another bridge"):
        robot(ends, keys, a.link.port)


def test_host_without_a_key_is_told(tmp_path):
    with pytest.raises(HostLinkError, match="ic keys new"):
        ListeningLink("tcp://127.0.0.1:0", Side("x", "x", {}, str), {}, KeyStore(tmp_path / "none"), print)


@pytest.mark.parametrize(
    ("endpoint", "listening"),
    [
        ("127.0.0.1:7450", True),
        ("tcp://127.0.0.1", True),
        ("tcp://127.0.0.1:70000", True),
        ("tcp://robot:0", False),
        ("tcp://*:7450", False),
        ("ipc:///tmp/x", True),
        ("", False),
    ],
)
def test_addresses_that_are_none(endpoint, listening):
    with pytest.raises(HostLinkError, match="must look like tcp://"):
        check_endpoint(endpoint, listening)


def test_addresses():
    assert check_endpoint("tcp://0.0.0.0:0", True) == ("0.0.0.0", 0)
    assert check_endpoint("tcp://robot.local:7450", False) == ("robot.local", 7450)
    assert check_endpoint("tcp://[fe80::1%eth0]:7450", False) == ("[fe80::1%eth0]", 7450)


def test_nothing_secret_is_logged(ends, keys, caplog):
    caplog.set_level(logging.DEBUG)
    a = robot(ends, keys)
    b = station(ends, keys, a.link.port)
    linked(a, b)
    secrets = [line for store in keys.values() for line in store.identity_path.read_text().split()[2:]]
    assert len(secrets) == 3 and not any(secret in caplog.text for secret in secrets)
    assert all(secret not in repr(event) for secret in secrets for event in a.events + b.events)
