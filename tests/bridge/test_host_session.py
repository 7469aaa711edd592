"""The link's state machine over simulated links."""

import json
from dataclasses import replace

import pytest
from simulated_link import DIGEST, MS, Way, World

from instant_ic.bridge.host_protocol import VERSION, Announce, Bye, Data, Hello, HostNotice, Ping, decode
from instant_ic.bridge.host_session import SHARED_BURST, Announced, Arrived, ClockStepped, Ended, LinkTimes, Refused, Up
from instant_ic.bridge.host_topics import TopicRule
from instant_ic.msg import Bool, deserialize, serialize, twist_stamped, twist_values

COMMAND = TopicRule("/operator/cmd_vel", lane="command", max_age_s=0.25)
PICTURE = TopicRule("/camera/image/compressed", lane="bulk")
STATE = TopicRule("/ic/state")


def every(period_ms, action):
    """Calls ``action(now)`` each period of the simulation."""

    def each(now):
        if (now // MS) % period_ms == 0:
            action(now)

    return each


def test_greeting_and_messages_both_ways():
    world = World([PICTURE], [COMMAND])
    world.run(0.1)
    assert [e for _, e in world.events["robot"]] == [Up("station")]
    assert [e for _, e in world.events["station"]] == [Up("robot")]
    world.publish("robot", PICTURE.topic, b"p" * 300_000)
    world.publish("station", COMMAND.topic, b"c" * 60)
    world.run(0.1)
    ((_, picture),) = world.arrived("station")
    ((_, command),) = world.arrived("robot")
    assert bytes(picture.payload) == b"p" * 300_000 and picture.announce.topic == PICTURE.topic
    assert picture.announce.type_name == "std_msgs/msg/String" and picture.announce.origin == "node"
    assert bytes(command.payload) == b"c" * 60


def test_what_the_station_does_not_want_is_not_sent():
    world = World([PICTURE, STATE])
    world.connect(not_wanted={STATE.topic})
    world.run(0.05)
    world.publish("robot", STATE.topic, b"x")
    world.run(0.05)
    assert world.arrived("station") == [] and sum(world.sessions["robot"].outbox.sent) == 0


@pytest.mark.parametrize("ahead_s", [0.0, -120.0])
def test_clock_offset_and_publication_time_are_told_in_our_clock(ahead_s):
    ahead = int(ahead_s * 1e9)
    ways = [Way(delay_ns=20 * MS, jitter_ns=10 * MS, seed=s) for s in (1, 2)]
    world = World([STATE], down=ways[0], up=ways[1], station_ahead_ns=ahead, mono_ahead_ns=7_000_000_000)
    world.run(3.0)
    # Symmetric but for the jitter of 10 ms: the best of some 20 exchanges is wrong by far less than half of it.
    assert world.sessions["robot"].wall_offset_ns == pytest.approx(ahead, abs=3 * MS)
    assert world.sessions["station"].wall_offset_ns == pytest.approx(-ahead, abs=3 * MS)
    assert 40 * MS <= world.sessions["robot"].clock.min_rtt_ns <= 50 * MS
    sent_wall = world.clocks["robot"].wall_ns()
    world.publish("robot", STATE.topic, b"x")
    world.run(0.1)
    ((_, event),) = world.arrived("station")
    assert event.publish_ns == pytest.approx(sent_wall + ahead, abs=3 * MS)
    assert world.clocks["station"].mono_ns() - event.born_ns == pytest.approx(100 * MS, abs=3 * MS)


def test_step_of_the_other_clock_is_told_and_followed_at_once():
    world = World(station_ahead_ns=0)
    world.run(1.0)
    world.clocks["station"].wall_ahead += 1_500 * MS
    world.run(0.4)
    assert ClockStepped(1_500 * MS) in [e for _, e in world.events["robot"]]
    assert world.sessions["robot"].wall_offset_ns == pytest.approx(1_500 * MS, abs=2 * MS)


def test_age_of_a_command_does_not_depend_on_the_time_of_day():
    world = World(to_robot=[COMMAND], station_ahead_ns=86_400_000_000_000)
    world.run(0.5)
    world.publish("station", COMMAND.topic, b"go")
    world.run(0.05)
    assert len(world.arrived("robot")) == 1


def test_picture_after_a_stall_is_new():
    """Foxglove's bridge 329: a flood of stale messages after a stall. Here what comes after it is fresh."""
    down = Way(delay_ns=10 * MS, rate=2e6)
    world = World([PICTURE], down=down, times=LinkTimes(timeout_s=5.0))
    world.run(1.0)
    taken = {}

    def picture(now):
        index = len(taken)
        taken[index] = now
        world.publish("robot", PICTURE.topic, index.to_bytes(4, "little") + bytes(30_000))

    world.run(2.0, each=every(100, picture))
    down.stalled_until = world.now + 3_000 * MS
    world.run(6.0, each=every(100, picture))
    late = [
        (now - taken[int.from_bytes(event.payload[:4], "little")]) / MS
        for now, event in world.arrived("station")
        if now > down.stalled_until
    ]
    # What was on its way as the stall began (a window of 64 kB), not the 30 pictures of the stall.
    assert sum(age > 300 for age in late) <= 3, sorted(late)[-5:]
    assert len(late) > 25
    superseded = world.sessions["robot"].outbox.counts[PICTURE.topic].superseded
    assert 20 <= superseded <= 32  # the 30 pictures of the stall but the last


def test_commands_of_a_stall_are_dropped_and_counted():
    up = Way(delay_ns=10 * MS)
    world = World(to_robot=[COMMAND], up=up, times=LinkTimes(timeout_s=5.0))
    world.run(0.5)
    sent = []

    def command(now):
        sent.append(now)
        world.publish("station", COMMAND.topic, len(sent).to_bytes(4, "little") + bytes(60))

    world.run(1.0, each=every(50, command))
    up.stalled_until = world.now + 2_000 * MS
    world.run(4.0, each=every(50, command))
    world.run(0.1)
    arrivals = world.arrived("robot", COMMAND.topic)
    ages = [now - sent[int.from_bytes(e.payload[:4], "little") - 1] for now, e in arrivals]
    assert max(ages) <= 260 * MS
    counts = world.memories["robot"].counts_in[COMMAND.topic]
    out = world.sessions["station"].outbox.counts[COMMAND.topic]
    assert counts.expired > 5
    # Nothing is lost in silence: what did not arrive is told by one number or another.
    assert len(sent) == counts.messages + counts.expired + counts.lost + out.superseded + out.expired


@pytest.mark.parametrize("rate", [125e3])
def test_state_and_commands_do_not_wait_for_pictures_on_a_slow_link(rate):
    """1 and 10 Mbit/s, with far more pictures than fit."""
    rules = [PICTURE, STATE, TopicRule("/operator/cmd_vel", lane="command")]
    world = World(rules, down=Way(delay_ns=20 * MS, rate=rate), up=Way(delay_ns=20 * MS))
    world.run(0.5)
    born = {}

    def all_of_it(now):
        if (now // MS) % 33 == 0:
            world.publish("robot", PICTURE.topic, bytes(200_000))
        if (now // MS) % 50 == 0:
            for topic in (STATE.topic, "/operator/cmd_vel"):
                mark = len(born).to_bytes(4, "little")
                born[mark] = now
                world.publish("robot", topic, mark + bytes(200))

    world.run(20.0, each=all_of_it)
    worst = {}
    for topic in (STATE.topic, "/operator/cmd_vel"):
        ages = sorted(now - born[bytes(e.payload[:4])] for now, e in world.arrived("station", topic)[100:])
        worst[topic] = ages[int(len(ages) * 0.95)] / MS
        assert len(ages) > 150
    # Before it only what is on its way already: the window is at its least 8 kB (64 ms at 1 Mbit/s).
    assert worst["/operator/cmd_vel"] < 20 + 130, worst
    assert worst[STATE.topic] < 20 + 150, worst
    pictures = world.arrived("station", PICTURE.topic)
    used = sum(len(e.payload) for _, e in pictures) / 20.5 / rate
    assert used > 0.7, f"only {used:.0%} of the link is used"


def test_rate_limit_of_a_latched_topic_still_brings_the_last_value():
    rule = TopicRule("/map", rate_hz=1.0)
    world = World([rule])
    world.run(0.1)
    for index in range(5):
        world.publish("robot", rule.topic, bytes([index]), latched=True)
        world.run(0.05)
    world.run(2.0)
    assert [e.payload[0] for _, e in world.arrived("station")] == [0, 4]


def test_queue_of_a_reliable_topic_loses_nothing_and_tells_what_did_not_fit():
    rule = TopicRule("/rosout")
    down = Way(rate=1e5)
    world = World([rule], down=down, times=LinkTimes(timeout_s=60, ping_s=0.25))
    world.run(0.1)
    for index in range(900):
        world.publish("robot", rule.topic, index.to_bytes(2, "little") + bytes(98), queued=True)
    world.run(5.0)
    assert [int.from_bytes(e.payload[:2], "little") for _, e in world.arrived("station")] == list(range(900))
    for index in range(1500):
        world.publish("robot", rule.topic, index.to_bytes(2, "little") + bytes(98), queued=True)
    world.run(8.0)
    overflowed = world.sessions["robot"].outbox.counts[rule.topic].overflowed
    assert overflowed > 300
    assert world.memories["station"].counts_in[rule.topic].lost == overflowed
    assert len(world.arrived("station")) == 900 + 1500 - overflowed


def test_what_a_broken_link_swallowed_is_counted_as_lost():
    rule = TopicRule("/tf")
    world = World([rule], down=Way(delay_ns=20 * MS), up=Way(delay_ns=20 * MS))
    world.run(0.2)
    for _ in range(10):
        world.publish("robot", rule.topic, b"before", queued=True)
    world.run(0.1)
    for _ in range(7):
        world.publish("robot", rule.topic, b"in the air", queued=True)
    world.run(0.01)
    world.connect()
    for _ in range(5):
        world.publish("robot", rule.topic, b"nobody there", queued=True)
    world.run(0.2)
    world.publish("robot", rule.topic, b"after", queued=True)
    world.run(0.1)
    assert [bytes(e.payload) for _, e in world.arrived("station")] == [b"after"]
    assert world.memories["station"].counts_in[rule.topic].lost == 12


def test_new_link_does_not_bring_an_old_latched_value_as_news():
    """An emergency stop that was released before must not release one that somebody else has set since."""
    estop = TopicRule("/operator/estop", lane="command", shared=True)
    world = World([], [estop])
    world.run(0.1)
    world.publish("station", estop.topic, b"released", latched=True)
    world.run(0.1)
    assert [bytes(e.payload) for _, e in world.arrived("robot")] == [b"released"]

    def link_anew():
        world.connect()
        world.run(0.1)
        channel = world.channels[estop.topic, "node"]
        world.sessions["station"].offer(channel, last)

    last = world.items[-1]
    link_anew()
    world.run(0.1)
    assert world.arrived("robot") == []
    world.publish("station", estop.topic, b"set", latched=True)
    world.run(0.1)
    assert [bytes(e.payload) for _, e in world.arrived("robot")] == [b"set"]


def test_message_that_is_faster_than_the_clock_exchange_waits_for_it():
    """Without the other's clock its age would be wrong by as much as the clocks differ."""
    ahead = 5_000 * MS
    estop = TopicRule("/operator/estop", lane="command", shared=True)
    ways = [Way(delay_ns=30 * MS) for _ in range(2)]
    world = World([], [estop], down=ways[0], up=ways[1], station_ahead_ns=ahead)
    while not world.sessions["station"].up:
        world.run(0.001)
    said_ns = world.now
    world.publish("station", estop.topic, b"set", latched=True)
    world.run(0.2)
    ((_, arrived),) = world.arrived("robot")
    assert arrived.born_ns == pytest.approx(said_ns, abs=3 * MS)
    assert arrived.publish_ns == pytest.approx(world.clocks["robot"].epoch_ns() + said_ns, abs=3 * MS)


def test_step_of_our_own_clock_makes_no_message_older_than_the_last():
    estop = TopicRule("/operator/estop", lane="command", shared=True)
    world = World([], [estop])
    world.run(0.2)
    world.publish("station", estop.topic, b"before", latched=True)
    world.run(0.1)
    world.clocks["robot"].wall_ahead -= 3_600_000 * MS
    world.publish("station", estop.topic, b"after", latched=True)
    world.run(0.1)
    (_, before), (_, after) = world.arrived("robot")
    assert after.born_ns - before.born_ns == pytest.approx(100 * MS, abs=3 * MS)


def test_silence_ends_the_link_on_both_sides():
    down, up = Way(), Way()
    world = World([STATE], down=down, up=up, times=LinkTimes(ping_s=0.25, timeout_s=1.0))
    world.run(1.0)
    down.stalled_until = up.stalled_until = world.now + 10_000 * MS
    cut = world.now
    world.run(2.0)
    for who in ("robot", "station"):
        ((when, ended),) = [(t, e) for t, e in world.events[who] if isinstance(e, Ended)]
        assert ended.code == "timeout" and 0.7e9 < when - cut < 1.4e9


def test_other_version_is_told_to_both():
    world = World([STATE])
    session = world.sessions["robot"]
    hello = Hello(VERSION + 1, "station", "s", {})
    (ended,) = session.receive(hello.encode())
    assert ended.code == "version" and "install the same" in ended.reason
    (data,) = session.outgoing()
    assert decode(data) == Bye("version", ended.reason)


@pytest.mark.parametrize(
    "message",
    [
        Ping(1, 0, 0),
        Announce(1, "/scan", "n", "t", "d", "sensor"),
        Data(1, 1, 0, 0, 0, 1, 0, b"x"),
    ],
)
def test_nothing_is_taken_before_the_greeting(message):
    world = World([STATE])
    (ended,) = world.sessions["robot"].receive(message.encode())
    assert ended.code == "protocol" and "before the greeting" in ended.reason


def test_other_fields_of_a_type_are_refused_and_told_on_both_sides():
    world = World([STATE])
    world.run(0.1)
    world.sessions["station"].side = world.sessions["station"].side.__class__(
        "station", "station-1", world.rules["robot"], lambda name: "f" * 16
    )
    world.publish("robot", STATE.topic, b"x")
    world.run(0.1)
    world.publish("robot", STATE.topic, b"x")
    world.run(0.1)
    for who, here in (("station", True), ("robot", False)):
        (refused,) = [e for _, e in world.events[who] if isinstance(e, Refused)]
        assert refused.here is here and refused.topic == STATE.topic and "different fields" in refused.reason
    assert world.arrived("station") == []
    assert DIGEST != "f" * 16


def test_viewer_may_send_nothing():
    world = World([STATE], [COMMAND])
    robot = world.sessions["robot"]
    robot.may_send = False
    world.run(0.1)
    world.publish("station", COMMAND.topic, b"go")
    world.publish("robot", STATE.topic, b"x")
    world.run(0.1)
    assert world.arrived("robot") == [] and len(world.arrived("station")) == 1
    assert sum(world.sessions["station"].outbox.sent) == 0
    assert "may only watch robot (role viewer)" in world.sessions["station"].notices["role"]
    # Nor if it tries all the same.
    (refused,) = robot.receive(Announce(1, COMMAND.topic, "n", "std_msgs/msg/String", DIGEST, "sensor").encode())
    assert "viewer" in refused.reason
    assert robot.receive(Data(1, 1, 0, 0, 0, 2, 0, b"go").encode()) == []


def test_topic_that_is_not_on_the_list_is_refused_even_from_a_driver():
    """A station can never write /cmd_vel past the arbiter."""
    world = World([], [COMMAND])
    world.run(0.1)
    session = world.sessions["robot"]
    events = session.receive(Announce(9, "/cmd_vel", "evil", "std_msgs/msg/String", DIGEST, "sensor").encode())
    assert [e.here for e in events] == [True] and "not on the topic list" in events[0].reason
    assert session.receive(Data(9, 1, 0, 0, 0, 1, 0, b"x").encode()) == []
    assert session.up


def test_only_the_driving_host_is_taken_in_and_its_latched_values_come_with_the_lease():
    status, estop = TopicRule("/vspace/status"), TopicRule("/operator/estop", lane="command", shared=True)
    world = World([], [COMMAND, status, estop])
    world.sessions["robot"].drives = False
    world.run(0.1)
    for topic, latched in ((COMMAND.topic, False), (status.topic, True), (estop.topic, True)):
        world.publish("station", topic, topic.encode(), latched=latched)
    world.run(0.1)
    assert [e.announce.topic for _, e in world.arrived("robot")] == [estop.topic]
    assert world.memories["robot"].counts_in[COMMAND.topic].not_driving == 1
    events = world.sessions["robot"].set_drives(True)
    assert [e.announce.topic for e in events if isinstance(e, Announced)] == [COMMAND.topic, status.topic]
    assert [e.announce.topic for e in events if isinstance(e, Arrived)] == [status.topic]
    assert not any(isinstance(e, Arrived) for e in world.sessions["robot"].set_drives(True))


class Station:
    """A station that does not drive yet, at a robot's session: each command is a new one."""

    def __init__(self, kind):
        self.rule = COMMAND if kind == "TwistStamped" else replace(COMMAND, topic="/drive")
        self.world, self.kind = World([], [self.rule]), kind
        self.robot = self.world.sessions["robot"]
        self.robot.drives = False
        self.world.run(0.1)

    def command(self, v):
        """Sends a command; returns the speeds that the robot accepts."""
        message, before = twist_stamped(v, 0.0, self.world.now), len(self.world.arrived("robot"))
        payload = bytes(serialize(message if self.kind == "TwistStamped" else message.twist))
        self.world.publish("station", self.rule.topic, payload, kind=f"geometry_msgs/msg/{self.kind}")
        self.world.run(0.02)
        events = [event for _, event in self.world.arrived("robot")[before:]]
        return [twist_values(deserialize(bytes(event.payload), event.announce.type_name))[0] for event in events]

    def notice(self):
        return self.world.sessions["station"].notices.get("held", "")


@pytest.mark.parametrize("kind", ["TwistStamped", "Twist"])
def test_fault_a_held_key_drives_when_the_other_stations_link_ends(kind):
    station = Station(kind)
    assert station.command(0.2) == [] and station.notice() == ""
    station.robot.set_drives(True)
    for _ in range(30):
        station.world.run(0.1)
        assert station.command(0.2) == []
    assert station.notice() == "let go of the controls once: robot does not start under a held key"
    assert station.command(0.0) == [0.0] and station.notice() == ""
    assert station.command(0.2) == [0.2]


def test_station_drives_at_once_unless_it_has_just_commanded_in_vain():
    station = Station("TwistStamped")
    assert station.command(0.0) == []
    station.robot.set_drives(True)
    assert station.command(0.2) == [0.2]
    station.robot.set_drives(False)
    assert station.command(0.2) == [] and station.command(0.0) == []  # let go in vain too
    station.robot.set_drives(True)
    assert station.command(0.2) == [0.2]
    station.robot.set_drives(False)
    assert station.command(0.2) == []
    station.robot.set_drives(True)
    station.world.run(2.1)
    assert station.command(0.2) == [0.2] and station.notice() == ""


def test_fault_a_key_held_through_a_slow_network_drives_once_the_network_is_fast_again():
    station = Station("TwistStamped")
    assert station.command(0.2) == []
    station.world.ways["station"].delay_ns = 400 * MS  # every command is too old; the link stays up
    for _ in range(30):
        station.world.run(0.1)
        assert station.command(0.2) == []
    station.robot.set_drives(True)
    station.world.ways["station"].delay_ns = 0
    station.world.run(0.5)
    for _ in range(5):
        assert station.command(0.2) == []
    assert station.command(0.0) == [0.0] and station.command(0.2) == [0.2]


def test_fault_a_key_held_in_vain_drives_after_a_new_link_of_its_station():
    station = Station("TwistStamped")
    assert station.command(0.2) == []
    station.world.run(5.0)
    station.world.connect()  # whose host drives: the other one has left
    station.world.run(1.0)
    assert station.command(0.2) == [] and station.notice().startswith("let go of the controls once")
    assert station.command(0.0) == [0.0] and station.command(0.2) == [0.2]


def test_every_drivers_host_sets_the_emergency_stop_and_only_the_driving_one_releases_it():
    estop = TopicRule("/operator/estop", lane="command", shared=True)
    world = World([], [estop])
    robot = world.sessions["robot"]
    robot.drives = False
    world.run(0.1)
    robot.receive(Announce(9, estop.topic, "console", "std_msgs/msg/Bool", DIGEST, "latched").encode())

    def press(number, payload):
        born_ns = world.now - 1000 + number  # each is a new one
        events = robot.receive(
            Data(9, number, 1_700_000_000 * 1000 * MS, born_ns, born_ns, len(payload), 0, payload).encode()
        )
        return [bytes(event.payload) for event in events]

    stop, release = bytes(serialize(Bool(data=True))), bytes(serialize(Bool(data=False)))
    assert press(1, stop) == [stop]
    assert press(2, release) == []
    assert robot.set_drives(True) == []  # nor when the lease is handed to it later
    assert press(3, release) == [release]


@pytest.mark.parametrize(
    "frames",
    [
        [Data(7, 1, 0, 0, 0, 1, 0, b"x")],
        [
            Announce(1, STATE.topic, "n", "t", DIGEST, "sensor"),
            Data(1, 1, 0, 0, 0, 10, 0, b"01234"),
            Data(1, 1, 0, 0, 0, 10, 6, b"6789"),
        ],
        [Announce(1, STATE.topic, "n", "t", DIGEST, "sensor"), Data(1, 1, 0, 0, 0, 10, 5, b"56789")],
        [Announce(1, STATE.topic, "n", "t", DIGEST, "sensor"), Data(1, 1, 0, 0, 0, 1 << 31, 0, b"0")],
    ],
    ids=["unannounced", "hole", "no beginning", "two gigabytes"],
)
def test_chunks_that_do_not_fit_end_the_link(frames):
    world = World([STATE])
    world.run(0.1)
    session = world.sessions["station"]
    events = [event for frame in frames for event in session.receive(frame.encode())]
    assert isinstance(events[-1], Ended) and events[-1].code == "protocol"


def test_many_topics_share_the_link_in_turn():
    rules = [TopicRule(f"/camera{i}", lane="bulk") for i in range(4)]
    world = World(rules, down=Way(delay_ns=5 * MS, rate=1e6), up=Way(delay_ns=5 * MS))
    world.run(0.2)

    def each(now):
        for rule in rules:
            world.publish("robot", rule.topic, bytes(20_000))

    world.run(10.0, each=every(20, each))
    counts = [len(world.arrived("station", rule.topic)) for rule in rules]
    assert min(counts) > 80 and max(counts) - min(counts) <= 3


# -- what a peer can make grow (review, finding 18) ------------------------------------------------------


def linked(to_robot=(STATE,)):
    world = World(to_robot=list(to_robot))
    world.run(0.1)
    return world, world.sessions["robot"]


def announce(channel=1, topic=STATE.topic, origin="node", type_name="std_msgs/msg/String", qos="latched"):
    return Announce(channel, topic, origin, type_name, DIGEST, qos).encode()


@pytest.mark.parametrize(
    "names",
    [
        {"origin": "x" * 129},
        {"origin": ""},
        {"origin": "a\nWARNING forged"},
        {"topic": "/" + "x" * 60_000},
        {"type_name": "x" * 129},
        {"qos": "\x1b[2J"},
    ],
)
def test_names_that_are_too_long_or_no_names_end_the_link_with_a_clear_error(names):
    _, robot = linked()
    (ended,) = robot.receive(announce(**names))
    assert isinstance(ended, Ended) and ended.code == "protocol"
    assert f"Announce: {next(iter(names))}" in ended.reason and "1 to 128 letters" in ended.reason
    assert len(ended.reason) < 250 and ended.reason.isprintable()


def test_channels_of_one_link_are_limited_with_a_clear_error(monkeypatch):
    monkeypatch.setattr("instant_ic.bridge.host_session.MAX_CHANNELS", 10)
    _, robot = linked()
    for number in range(10):
        robot.receive(announce(number, origin=f"node{number}"))
    robot.receive(announce(3, origin="again"))  # the same number again replaces
    assert robot.ended is None and len(robot._incoming) == 10
    (ended,) = robot.receive(announce(10))
    assert "more than 10 channels are announced" in ended.reason


def test_publishers_that_are_remembered_over_many_links_are_limited(monkeypatch):
    monkeypatch.setattr("instant_ic.bridge.host_session.MAX_CHANNELS", 10)
    world = World(to_robot=[STATE])
    for link in range(5):
        world.connect()
        world.run(0.1)
        for number in range(8):
            world.publish("station", STATE.topic, b"x", latched=True, origin=f"node{link}_{number}")
        world.run(0.2)
        assert len(world.arrived("robot")) == 8
    memory = world.memories["robot"]
    assert len(memory.received) == len(memory.latched) == 10
    assert ("station-1", STATE.topic, "node4_7") in memory.received  # the newest are kept


def test_fault_a_host_that_does_not_drive_grows_the_memory_by_ever_new_publishers(monkeypatch):
    monkeypatch.setattr("instant_ic.bridge.host_session.MAX_CHANNELS", 10)
    world, robot = linked([COMMAND])
    robot.set_drives(False)
    payload, kind = bytes(serialize(twist_stamped(0.2, 0.0, 0))), "geometry_msgs/msg/TwistStamped"
    for number in range(100):  # the same channel again and again
        robot.receive(announce(1, COMMAND.topic, f"node{number}", kind, "sensor"))
        robot.receive(Data(1, 1, 0, world.now, world.now, len(payload), 0, payload).encode())
    assert robot.ended is None and len(robot.memory.held) == 10


def test_fault_a_host_that_does_not_drive_floods_the_shared_topics_and_its_stop_still_counts():
    beats, estop = TopicRule("/heartbeat", shared=True), TopicRule("/operator/estop", lane="command", shared=True)
    world, robot = linked([beats, estop])
    robot.drives = False
    robot.receive(announce(1, beats.topic, qos="reliable"))
    robot.receive(announce(2, estop.topic, type_name="std_msgs/msg/Bool"))

    def send(channel, number, payload):
        born_ns = world.now + number
        return robot.receive(Data(channel, number, 0, born_ns, born_ns, len(payload), 0, payload).encode())

    taken = sum(len(event.payload) for number in range(1, 1001) for event in send(1, number, bytes(60_000)))
    assert SHARED_BURST - 60_000 <= taken <= SHARED_BURST  # all at once; each would cost its readers milliseconds
    assert len(send(2, 1, bytes(serialize(Bool(data=True))))) == 1
    world.now += 10_000_000_000
    assert len(send(1, 2000, bytes(60_000))) == 1
    assert robot.up and robot.memory.counts_in[beats.topic].not_driving > 900


def test_fault_latched_values_of_a_host_that_does_not_drive_fill_the_memory(monkeypatch):
    monkeypatch.setattr("instant_ic.bridge.host_session.MAX_MESSAGE", 200_000)
    world, robot = linked()
    robot.drives = False
    for number in range(1, 100):
        robot.receive(announce(number, origin=f"node{number}"))
        robot.receive(Data(number, 1, 0, world.now, world.now, 50_000, 0, bytes(50_000)).encode())
    assert "250000 bytes of latched values before this host drives" in robot.ended.reason


@pytest.mark.parametrize("rate", [5e-324, -1.0, float("nan"), "x", None])
def test_fault_a_viewers_rate_ends_the_thread_of_the_link(rate):
    world = World([STATE])
    robot = world.sessions["robot"]
    robot.receive(Hello(VERSION, "viewer", "v", {STATE.topic: rate}).encode())
    world.publish("robot", STATE.topic, b"x", latched=True)  # raised OverflowError
    assert robot.ended.code == "protocol" and "must be a number >= 0" in robot.ended.reason


@pytest.mark.parametrize(
    "hello", [Hello(VERSION + 1, "é" * 30_000, "v", {}), Hello(VERSION, "v", "v", {"t": "é" * 30_000})]
)
def test_fault_a_viewers_long_words_end_the_thread_of_the_link(hello):
    robot = World([STATE]).sessions["robot"]
    (ended,) = robot.receive(bytes([Hello.KIND]) + json.dumps(vars(hello), ensure_ascii=False).encode())
    (goodbye,) = robot.outgoing()  # raised HostProtocolError: quoted in full, and longer in ASCII
    assert decode(goodbye).reason == ended.reason and len(ended.reason) <= 300


def test_notices_are_limited_in_number_and_length():
    _, robot = linked()
    for number in range(16):
        robot.receive(HostNotice(f"n{number}", "x" * 10_000 + "\n").encode())
    assert robot.ended is None and max(map(len, robot.notices.values())) <= 300
    (ended,) = robot.receive(HostNotice("one more", "x").encode())
    assert "more than 16 notices" in ended.reason and len(robot.notices) == 16
