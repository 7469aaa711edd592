"""The bridge's node between two run directories of one machine: two hosts, as far as the bus can tell."""

import time
from dataclasses import dataclass, replace

import pytest
from live_nodes import LiveNode, Neighbour, wait_for
from simulated_link import World

from instant_ic.bridge import host_listener
from instant_ic.bridge.host_bus import ImportedTopics
from instant_ic.bridge.host_keys import KeyStore, Peer
from instant_ic.bridge.host_protocol import Announce
from instant_ic.bridge.host_report import judge_clock
from instant_ic.bridge.host_session import Announced, Arrived, LinkTimes
from instant_ic.bridge.host_topics import TopicRule
from instant_ic.bus import ERROR, LATCHED, OK, RELIABLE, SENSOR, WARN, Node, NodeError, ParameterError, registry
from instant_ic.bus.lockstep import LockstepBus
from instant_ic.config import params
from instant_ic.msg import (
    Bool,
    DiagnosticArray,
    DiagnosticStatus,
    Log,
    String,
    TFMessage,
    TwistStamped,
    deserialize,
    header,
    serialize,
    twist_stamped,
)
from nodes.host_bridge import HostBridgeConfig, HostBridgeNode

TO_STATION = ("/picture lane=bulk", "/state", "/tf_static", "/log shared=true", "/queue")
TO_ROBOT = (
    "/operator/cmd_vel lane=command max_age_s=0.25",
    "/operator/estop lane=command shared=true",
    "/log shared=true",
)
TIMES = LinkTimes(ping_s=0.1, timeout_s=2.0)


class Hosts:
    """Run directories and key folders of some hosts, and what runs on them."""

    def __init__(self, make):
        self.folder = make("r")
        self.running = []
        self.stores = {}
        self.port = 0

    def host(self, name, role="driver"):
        store = self.stores[name] = KeyStore(self.folder / f"k_{name}")
        public = store.create(name).public_key
        if name != "robot":
            self.stores["robot"].allow(Peer(name, role, public))
            store.allow(Peer("robot", "driver", self.stores["robot"].identity().public_key))
        return self.folder / name[0]

    def bridge(self, host, name="host_bridge", **config):
        ends = {"listen": "tcp://127.0.0.1:0"} if host == "robot" else {"connect": f"tcp://127.0.0.1:{self.port}"}
        config = {
            **ends, "keys": str(self.stores[host].folder), "to_station": TO_STATION, "to_robot": TO_ROBOT,
            "link": TIMES, **config,
        }  # fmt: skip
        run_dir = self.folder / host[0]
        live = LiveNode(run_dir, HostBridgeNode, HostBridgeConfig(**config), name)
        claim = registry.Claim(run_dir / "nodes" / name, name)
        claim.write({**live.node.describe(), "started_ns": time.time_ns()})
        self.running += [live, _Released(claim)]
        if host == "robot" and "connect" not in config:
            self.port = live.node.link.port
        return live

    def neighbour(self, host, name):
        neighbour = Neighbour(self.folder / host[0], name)
        self.running.append(neighbour)
        return neighbour


class _Released:
    def __init__(self, claim):
        self.close = claim.release


@pytest.fixture
def hosts(tmp_path_factory):
    hosts = Hosts(tmp_path_factory.mktemp)
    yield hosts
    for each in reversed(hosts.running):
        each.close()


def pair(hosts, **station):
    hosts.host("robot")
    hosts.host("station")
    a = hosts.bridge("robot")
    b = hosts.bridge("station", **station)
    wait_for(lambda: a.told("link").startswith("linked") and b.told("link").startswith("linked"), "link")
    return a, b


def texts(messages):
    return [deserialize(m.payload, m.type_name).data for m in messages]


def test_type_qos_and_publication_time_travel_with_a_topic(hosts):
    _, b = pair(hosts)
    near, far = hosts.neighbour("robot", "talker"), hosts.neighbour("station", "listener")
    got = {topic: far.listen(topic) for topic in ("/picture", "/state", "/queue")}
    outs = {
        "/picture": near.publisher("/picture", String, SENSOR),
        "/state": near.publisher("/state", Bool, LATCHED),
        "/queue": near.publisher("/queue", String, RELIABLE),
    }
    outs["/state"].publish(Bool(data=True))
    far.wait(lambda: got["/state"], "latched value")
    # A reader finds a new publisher within 0.1 s: here each has two, the bridge's and the one behind it.
    far_outs = wait_for(
        lambda: len(found := [p for p in b.node.publishers if p.topic in got]) == 3 and found,
        "publishers at the station",
    )
    wait_for(lambda: all(p.subscriber_count for p in (*outs.values(), *far_outs)), "readers")
    stamp = time.time_ns() - 300_000_000
    for index in range(500):
        outs["/queue"].publish_bytes(serialize(String(data=str(index))), stamp + index)
    outs["/picture"].publish(String(data="p" * 700_000))
    far.wait(lambda: got["/picture"] and len(got["/queue"]) == 500, "messages")
    assert texts(got["/queue"]) == [str(index) for index in range(500)]
    # Not the time of arrival, 300 ms later. One machine has one clock: half of a round trip may be wrong.
    assert all(abs(m.publish_ns - stamp - i) < 100_000_000 for i, m in enumerate(got["/queue"]))
    assert {m.publisher for m in got["/queue"]} == {"host_bridge"}
    topics = {info.topic: info for info in registry.list_topics(hosts.folder / "s")}
    told = {name: (topics[name].type_name, topics[name].publishers[0].qos) for name in outs}
    assert told == {
        "/picture": ("std_msgs/msg/String", "sensor"),
        "/state": ("std_msgs/msg/Bool", "latched"),
        "/queue": ("std_msgs/msg/String", "reliable"),
    }


def test_late_reader_gets_the_latched_values_of_every_publisher(hosts):
    """Two drivers send their mounts on /tf_static; a node that starts later must know both."""
    pair(hosts)
    early = hosts.neighbour("station", "early")
    heard = early.listen("/tf_static", LATCHED)
    for name in ("camera", "lidar"):
        near = hosts.neighbour("robot", name)
        near.publisher("/tf_static", TFMessage, LATCHED).publish(TFMessage([_mount(name)]))
    early.wait(lambda: len(heard) >= 2, "both at the early reader")
    late = hosts.neighbour("station", "late")
    seen = late.listen("/tf_static", LATCHED)

    def children():
        return {t.child_frame_id for m in seen for t in deserialize(m.payload, m.type_name).transforms}

    late.wait(lambda: children() == {"camera", "lidar"}, "both at the late reader")


def _mount(child):
    from instant_ic.geometry.poses import matrix_from_pose2
    from instant_ic.msg import transform_message

    return transform_message(matrix_from_pose2((0.0, 0.0, 0.0)), "base_link", child, 1)


def test_no_echo_with_a_topic_both_ways_and_two_bridges_on_a_host(hosts):
    hosts.host("robot")
    hosts.host("station")
    hosts.host("tablet")
    a = hosts.bridge("robot")
    bridges = [hosts.bridge("station"), hosts.bridge("tablet")]
    wait_for(lambda: len(a.node.link.peers()) == 2, "both stations")
    # A second pair of bridges between the same two run directories closes the ring.
    hosts.host("ring")
    ring = hosts.bridge("station", name="second_bridge", keys=str(hosts.stores["ring"].folder))
    wait_for(lambda: ring.told("link").startswith("linked"), "ring")
    ears = {host: hosts.neighbour(host, f"ear_{host}") for host in ("robot", "station", "tablet")}
    heard = {host: ear.listen("/log") for host, ear in ears.items()}
    outs = {host: ear.publisher("/log", String, RELIABLE) for host, ear in ears.items() if host != "tablet"}

    def alive():
        for ear in ears.values():
            ear.node.spin_once()
        said = {host: texts(messages) for host, messages in heard.items()}
        own = "tick 0" in said["robot"] and "tock 0" in said["station"]
        return own and "tock 0" in said["robot"] and said["station"].count("tick 0") > 1 and "tick 0" in said["tablet"]

    deadline = time.monotonic() + 30
    while not alive():
        outs["robot"].publish(String(data="tick 0"))
        outs["station"].publish(String(data="tock 0"))
        assert time.monotonic() < deadline
        time.sleep(0.05)
    for messages in heard.values():
        messages.clear()
    for index in range(1, 4):
        outs["robot"].publish(String(data=f"tick {index}"))
        outs["station"].publish(String(data=f"tock {index}"))

    def everybody_heard():
        alive()
        return all(
            f"{word} {index}" in texts(heard[host])
            for host in ("robot", "station")
            for word in ("tick", "tock")
            for index in (1, 2, 3)
        )

    wait_for(everybody_heard, "words")
    deadline = time.monotonic() + 0.7
    while time.monotonic() < deadline:
        alive()
        time.sleep(0.01)
    # The ring has two links from station to robot, so each host may hear the other's words twice; an echo never ends.
    for host, own, other in (("robot", "tick", "tock"), ("station", "tock", "tick")):
        said = [text for text in texts(heard[host]) if not text.endswith(" 0")]
        for index in range(1, 4):
            assert said.count(f"{own} {index}") == 1, said
            assert 1 <= said.count(f"{other} {index}") <= 2, said
    assert bridges


def test_command_reaches_the_robot_and_an_old_one_does_not(hosts):
    a, _ = pair(hosts)
    wheel, hand = hosts.neighbour("robot", "wheel"), hosts.neighbour("station", "hand")
    commands = wheel.listen("/operator/cmd_vel")
    out = hand.publisher("/operator/cmd_vel", TwistStamped, SENSOR)

    def drive():
        out.publish(twist_stamped(0.3, 0.0, time.time_ns()))
        time.sleep(0.02)
        return commands

    wheel.wait(drive, "command")
    assert a.node.link.driver == "station"


def test_other_type_on_a_topic_is_refused_and_told(hosts, monkeypatch):
    from nodes import host_bridge

    hosts.host("robot")
    hosts.host("station")
    a = hosts.bridge("robot")
    monkeypatch.setattr(host_bridge, "type_hash", lambda name: "RIHS01_of_another_release")
    b = hosts.bridge("station")
    wait_for(lambda: a.told("link").startswith("linked"), "link")
    near, far = hosts.neighbour("robot", "talker"), hosts.neighbour("station", "listener")
    got = far.listen("/state")
    near.publisher("/state", Bool, LATCHED).publish(Bool(data=True))
    wait_for(lambda: all("different fields" in side.told("topic /state") for side in (a, b)), "words")
    assert a.node.diagnoses()["topic /state"][0] == ERROR
    far.spin(0.2)
    assert got == []


def test_diagnoses_tell_link_clock_topics_and_door(hosts):
    a, b = pair(hosts, max_offset_ms=0.0001)
    wait_for(lambda: "of this one" in b.told("clock of robot") or "this one" in b.told("clock of robot"), "clock")
    _, _, values = b.node.diagnoses()["clock of robot"]
    assert set(values) == {"offset_ms", "rtt_ms", "jitter_ms"}
    assert abs(values["offset_ms"]) <= values["rtt_ms"] / 2 + 1  # one machine, one clock
    assert a.told("link").startswith("linked with station (127.0.0.1, ") and a.told("link").endswith("; station drives")
    assert a.told("door") == "no host refused recently"
    hand = hosts.neighbour("station", "hand")
    out = hand.publisher("/operator/estop", Bool, LATCHED)
    out.publish(Bool(data=True))
    wait_for(lambda: a.node.diagnoses()["topics"][2].get("in /operator/estop", "").startswith("1 messages"), "numbers")
    b.close()
    wait_for(lambda: "station ends" in a.told("link"), "words of the end")
    assert a.node.diagnoses()["link"][0] == WARN


@pytest.mark.parametrize(
    ("offset_ms", "rtt_ms", "level", "text"),
    [
        (-340.0, 20.0, WARN, "340.0 ms behind this one, more than 50 ms: run chrony on both (sudo apt install chrony)"),
        (61.0, 20.0, WARN, "61.0 ms ahead of this one, more than 50 ms: run chrony on both (sudo apt install chrony)"),
        (59.0, 20.0, OK, "59.0 ms ahead of this one"),  # 10 ms of it are not certain
        (-0.2, 0.3, OK, "0.2 ms behind this one"),
    ],
)
def test_clock_that_is_wrong_is_a_warning_with_what_to_do(offset_ms, rtt_ms, level, text):
    assert judge_clock(offset_ms, rtt_ms, 50.0) == (level, text)


@dataclass(frozen=True)
class NoConfig:
    pass


class Importer(Node[NoConfig]):
    name = "importer"

    def setup(self):
        self.holder = ""
        rules = {"/operator/estop": TopicRule("/operator/estop", lane="command", shared=True)}
        rules["/operator/cmd_vel"] = TopicRule("/operator/cmd_vel", lane="command")
        trouble = lambda topic, text: pytest.fail(text)  # noqa: E731
        self.incoming = ImportedTopics(self, rules, trouble, lambda: self.holder)


@pytest.mark.parametrize("release_ms", [100, 999, 1000])
@pytest.mark.parametrize("stop_first", [True, False])
def test_of_two_hosts_words_within_a_second_the_stop_holds_in_either_order(stop_first, release_ms):
    """A restarted bridge hears the latched values of all stations in any order; the stop is of 1000 ms."""
    bus = LockstepBus()
    importer = bus.add(Importer)
    words = [
        Arrived(Announce(1, "/operator/estop", origin, Bool.__msgtype__, "", "latched"), payload, born_ns, born_ns)
        for origin, payload, born_ns in (
            ("tablet", bytes(serialize(Bool(data=True))), 1_000_000_000),
            ("station", bytes(serialize(Bool(data=False))), release_ms * 1_000_000),
            ("broken", b"\x00", 1_000_000_000),
        )
    ]
    importer.incoming.open(words[0].announce)
    bus.advance(0.1)
    for word in words[:2] if stop_first else words[1::-1]:
        importer.incoming.take(word.announce.origin, word)
    assert bus.last("/operator/estop").data is True
    importer.incoming.take("station", replace(words[1], born_ns=2_000_000_000))
    assert bus.last("/operator/estop").data is False  # the latest word
    importer.incoming.take("broken", replace(words[2], born_ns=2_000_000_001))  # unreadable: the subscriber reports it
    assert bus.records("/operator/estop")[-1].payload == b"\x00"


def test_a_hosts_own_stop_is_released_at_once_and_another_hosts_only_a_second_later(caplog):
    bus = LockstepBus()
    importer = bus.add(Importer)

    def hear(host, pressed, at_ms):
        """Two hosts whose nodes have one name."""
        word = Announce(1, "/operator/estop", "console", Bool.__msgtype__, "", "latched")
        born_ns = at_ms * 1_000_000
        importer.incoming.take(host, Arrived(word, bytes(serialize(Bool(data=pressed))), born_ns, born_ns))
        bus.advance(0.1)
        return bus.last("/operator/estop").data

    assert hear("station", True, 10_000) is True
    assert hear("station", False, 10_001) is False
    assert hear("tablet", True, 20_000) is True
    assert hear("station", True, 20_500) is True
    assert hear("station", False, 20_999) is True  # the tablet's stop holds
    assert "dropped /operator/estop of station" in caplog.text
    assert hear("station", False, 21_000) is False
    assert hear("tablet", True, 19_999) is False  # and comes again too late
    for number in range(100):
        hear(f"host {number}", True, 30_000 + number)
    assert len(importer.incoming._topics["/operator/estop"].stops) == 2
    assert hear("host 99", False, 31_097) is True  # the stop of host 98 holds
    assert hear("host 98", False, 31_098) is True  # that of host 99
    assert hear("host 99", False, 31_098) is False


def command_of(origin, claims, speed=0.1):
    word = Announce(1, "/operator/cmd_vel", origin, TwistStamped.__msgtype__, "", "sensor")
    return Arrived(word, bytes(serialize(twist_stamped(speed, 0.0, 5, claims))), 5, 5)


def test_a_command_names_host_node_and_page_whatever_it_claims_to_be():
    bus = LockstepBus()
    importer = bus.add(Importer)
    importer.incoming.open(command_of("console", "").announce)
    bus.advance(0.1)
    for peer, origin, claims in [
        ("station", "console", "page 1"),
        ("tablet", "console", "page 1"),
        ("station", "console2", "page 1"),
        ("tablet", "console", "station/console/page 1"),
    ]:
        importer.incoming.take(peer, command_of(origin, claims))
    bus.advance(0.1)
    assert [message.header.frame_id for message in bus.messages("/operator/cmd_vel")] == [
        "station/console/page 1",
        "tablet/console/page 1",
        "station/console2/page 1",
        "tablet/console/station_console_page 1",
    ]


def test_of_two_stations_only_the_one_that_drives_the_robot_releases_the_stop(caplog):
    bus = LockstepBus()
    importer = bus.add(Importer)
    word = Announce(1, "/operator/estop", "console", Bool.__msgtype__, "", "latched")

    def hear(host, pressed, at_s, origin="console"):
        born_ns = at_s * 1_000_000_000
        arrived = Arrived(replace(word, origin=origin), bytes(serialize(Bool(data=pressed))), born_ns, born_ns)
        importer.incoming.take(host, arrived)
        bus.advance(0.1)
        return bus.last("/operator/estop").data

    importer.holder = "importer/station/console/page 1"
    assert hear("station", True, 10)
    assert hear("tablet", False, 20) and hear("station", False, 21, "console2")
    assert "only importer/station/console/page 1 may release" in caplog.text
    assert not hear("station", False, 22)
    assert hear("tablet", True, 30)
    importer.holder = "console/page 1"  # an operator at the robot: the arbiter refuses the release, and says so
    assert not hear("tablet", False, 40)


@pytest.mark.parametrize("topic", ["/operator/estop", "/view/shown"])
def test_fault_a_host_that_does_not_drive_gives_a_topic_another_type(topic):
    """The first type would hold until the bridge restarts, and refuse every other host's messages."""
    bus = LockstepBus()
    rule = TopicRule(topic, shared=topic == "/operator/estop")
    importer = bus.add(Importer)
    importer.incoming._rules[topic] = rule

    def station(drives, kind, payload):
        world = World(to_robot=[rule])
        robot = world.sessions["robot"]
        robot.drives = False
        world.run(0.1)
        world.publish("station", topic, payload, latched=True, kind=kind)
        world.run(0.1)
        arrived = [event for _, event in world.events["robot"]]
        for event in [*arrived, *(robot.set_drives(True) if drives else ())]:
            if isinstance(event, Announced):
                importer.incoming.open(event.announce)
            elif isinstance(event, Arrived):
                importer.incoming.take("station", event)
        bus.advance(0.1)

    station(False, String.__msgtype__, bytes(serialize(String(data="x"))))
    station(True, Bool.__msgtype__, bytes(serialize(Bool(data=True))))
    assert bus.last(topic).data is True


def test_fault_a_hosts_outdated_stops_fill_the_log(caplog):
    bus = LockstepBus()
    importer = bus.add(Importer)
    began_s = time.monotonic()
    for number in range(1000):
        word = Announce(1, "/operator/estop", "node", Bool.__msgtype__, "", "latched")
        born_ns = 10_000_000_000 if number == 0 else number
        importer.incoming.take("tablet", Arrived(word, bytes(serialize(Bool(data=True))), born_ns, born_ns))
    assert 1 <= caplog.text.count("outdated") <= 1 + (time.monotonic() - began_s)


class Collector(Node[NoConfig]):
    name = "collector"

    def setup(self):
        self.troubles = []
        rules = {"/state": TopicRule("/state")}
        self.incoming = ImportedTopics(self, rules, lambda topic, text: self.troubles.append((topic, text)))


def test_latched_values_that_a_peer_makes_are_limited_with_a_clear_error():
    bus = LockstepBus()
    collector = bus.add(Collector)
    for number in range(100):
        announce = Announce(number, "/state", f"node{number}", Bool.__msgtype__, "", "latched")
        collector.incoming.take("robot", Arrived(announce, bytes(serialize(Bool(data=True))), number, number))
    last = collector.incoming._topics["/state"].last
    assert list(last) == [f"node{number}" for number in range(36, 100)]  # the newest 64
    assert collector.troubles[0] == ("/state", "more than 64 nodes publish it: the value of node0 was dropped")


def test_another_type_on_a_topic_of_the_bridge_itself_is_refused():
    bus = LockstepBus()
    collector = bus.add(Collector)
    collector.publisher("/own", Bool)
    announce = Announce(1, "/own", "arbiter", String.__msgtype__, "", "reliable")
    collector.incoming.take("robot", Arrived(announce, bytes(serialize(String(data="x"))), 1, 1))
    bus.advance(0.1)
    assert collector.troubles == [("/own", "the other host sends std_msgs/msg/String, not std_msgs/msg/Bool: refused")]
    assert bus.last("/own") is None


def test_topics_of_no_list_that_a_peer_names_share_one_diagnosis(hosts):
    hosts.host("robot")
    robot = hosts.bridge("robot").node
    before = set(robot.diagnoses())
    for number in range(100):
        robot.report.trouble(f"/x{number}", "refused here: it is not on the topic list of robot")
    robot.report.trouble("/operator/cmd_vel", "refused here: different fields")
    assert set(robot.diagnoses()) - before == {"topic of no list", "topic /operator/cmd_vel"}
    assert robot.diagnoses()["topic of no list"][1].startswith("/x99: refused")


def test_the_latest_emergency_stop_holds_whoever_comes_back_first(hosts):
    hosts.host("robot")
    hosts.host("station")
    hosts.host("tablet")
    a = hosts.bridge("robot", driver="station")  # only the driving host may release
    stations = {name: hosts.bridge(name) for name in ("station", "tablet")}
    hands = {name: hosts.neighbour(name, f"hand_{name}") for name in stations}
    outs = {name: hand.publisher("/operator/estop", Bool, LATCHED) for name, hand in hands.items()}
    ear = hosts.neighbour("robot", "ear")
    heard = ear.listen("/operator/estop", LATCHED)

    def stops():
        return [deserialize(m.payload, m.type_name).data for m in heard]

    wait_for(lambda: len(a.node.link.peers()) == 2, "both stations")
    outs["station"].publish(Bool(data=True))
    ear.wait(lambda: stops() == [True], "stop")
    outs["station"].publish(Bool(data=False))
    ear.wait(lambda: stops() == [True, False], "release")
    outs["tablet"].publish(Bool(data=True))
    ear.wait(lambda: stops() == [True, False, True], "the other's stop")
    # The first station's link breaks and comes back: its old release is no news.
    broken_s = time.monotonic()
    with a.node.link._lock:
        host_listener._shut(next(c for c in a.node.link._connections() if c.peer.name == "station"))

    def back():
        up_s = [peer.up_s for peer in a.node.link.peers() if peer.name == "station"]
        return up_s and up_s[0] < time.monotonic() - broken_s

    wait_for(back, "station with a new link")
    ear.spin(0.5)
    assert stops() == [True, False, True]
    # A node that listens from now on gets the stop, and nobody a release.
    late = hosts.neighbour("robot", "late").listen("/operator/estop", LATCHED)
    hosts.running[-1].wait(lambda: late, "stop at the late reader")
    ear.spin(0.5)
    hosts.running[-1].spin(0.1)
    assert texts(late) == [True] and stops() == [True, False, True]
    # The robot's bridge starts anew and is told by both, in whichever order: the latest holds.
    port = a.node.link.port
    a.close()
    again = hosts.bridge("robot", name="second_bridge", listen=f"tcp://127.0.0.1:{port}")
    wait_for(lambda: len(again.node.link.peers()) == 2, "both stations at the new bridge")
    ear.wait(lambda: len(stops()) > 3 and stops()[-1], "stop from the new bridge")
    ear.spin(0.5)
    assert stops()[-1] is True


def test_fault_a_robots_diagnostics_and_log_do_not_reach_the_station(hosts):
    """The bridge publishes on these topics itself, and a node has one publisher a topic."""
    topics = {"/diagnostics": DiagnosticArray, "/rosout": Log}
    hosts.host("robot")
    hosts.host("station")
    hosts.bridge("robot", to_station=tuple(topics))
    hosts.bridge("station", to_station=tuple(topics))
    near, far = hosts.neighbour("robot", "arbiter"), hosts.neighbour("station", "page")
    outs = {topic: near.publisher(topic, kind) for topic, kind in topics.items()}
    heard = {topic: far.listen(topic) for topic in topics}
    messages = {
        "/diagnostics": DiagnosticArray(header("", 1), [DiagnosticStatus(0, "arbiter: all", "well", "", [])]),
        "/rosout": Log(header("", 1).stamp, 20, "arbiter", "well", "", "", 0),
    }

    def arrived():
        for topic, out in outs.items():
            out.publish(messages[topic])
        return all(any(m.payload == bytes(serialize(messages[t])) for m in heard[t]) for t in topics)

    far.wait(arrived, "the robot's words")


@pytest.mark.parametrize(
    ("values", "words"),
    [
        ({}, "one of listen"),
        ({"listen": "tcp://0.0.0.0:1", "connect": "tcp://a:1"}, "not both"),
        ({"listen": "0.0.0.0:7450"}, "listen: .* must look like tcp://0.0.0.0:7450"),
        ({"connect": "tcp://robot"}, "connect: .* must look like tcp://192.168.1.20:7450"),
        ({"listen": "tcp://0.0.0.0:1"}, "to_station and to_robot are empty"),
        ({"listen": "tcp://0.0.0.0:1", "to_robot": ["/scan rat=3"]}, "to_robot: /scan: 'rat=3' is not one of"),
        ({"listen": "tcp://0.0.0.0:1", "link.ping_s": 9.0}, "ping_s must lie in 0.02..5"),
        ({"listen": "tcp://0.0.0.0:1", "link.ping_s": 0.8}, "timeout_s must be at least two ping_s"),
        ({"listen": "tcp://0.0.0.0:1", "max_offset_ms": -1.0}, "max_offset_ms must be > 0"),
    ],
)
def test_wrong_parameters_say_what_to_do(values, words):
    with pytest.raises(ParameterError, match=words):
        params.build(HostBridgeConfig, {key: params.Value(value, "-p") for key, value in values.items()})


def test_missing_keys_end_the_start_with_words(hosts):
    hosts.host("robot")
    with pytest.raises(NodeError, match="ic keys new"):
        hosts.bridge("robot", keys=str(hosts.folder / "nothing"))
    hosts.stores["lonely"] = KeyStore(hosts.folder / "k_lonely")
    hosts.stores["lonely"].create("lonely")
    with pytest.raises(NodeError, match="ic keys allow NAME KEY"):
        hosts.bridge("lonely", connect="tcp://127.0.0.1:1")


def test_shipped_lists_are_whole():
    """Every topic that a node of one side reads and a node of the other writes is on the list."""
    import re

    from instant_ic.bridge.host_topics import parse_rules
    from instant_ic.util import paths

    values = params.load_file(paths.shipped_file("config", "bridge.yaml"), "host_bridge")
    config = params.build(HostBridgeConfig, {**values, "listen": params.Value("tcp://0.0.0.0:7450", "test")})
    text = (paths.share_dir("launch").parent / "docs" / "reference.md").read_text()
    takes, gives = {}, {}
    for part in text.split("\n## ")[1:]:
        name = part.split("\n")[0]
        for found, word in ((takes, "Takes"), (gives, "Gives")):
            line = re.search(rf"^{word}: (.*)$", part, re.M)
            found[name] = set(re.findall(r"`(/[\w/]+)`", line[1])) if line else set()
    sides = {
        side: set(re.findall(r"exec: (?:\$\(var )?(\w+)", paths.shipped_file("launch", f"{side}.yaml").read_text()))
        - {"host_bridge", "bag_recorder"}
        for side in ("robot", "station")
    }
    assert {"arbiter", "crawler_base"} <= sides["robot"] and {"console", "nerf"} <= sides["station"]
    for giver, taker, listed in (
        ("robot", "station", parse_rules(config.to_station)),
        ("station", "robot", parse_rules(config.to_robot)),
    ):
        given = set().union(*(gives.get(node, set()) for node in sides[giver]))
        taken = set().union(*(takes.get(node, set()) for node in sides[taker]))
        missing = {
            t
            for t in given & taken - set().union(*(gives.get(node, set()) for node in sides[taker]))
            if t not in listed
        }
        assert not missing, f"{giver} gives and {taker} takes {missing}"
    assert "/cmd_vel" not in parse_rules(config.to_robot)
