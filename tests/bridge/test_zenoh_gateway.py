"""The gateway between our bus and Zenoh: against raw Zenoh sessions, an independent client, and itself."""

import itertools
import os
import time

import pytest
from live_nodes import LiveNode, Neighbour, cdr, wait_for

from instant_ic.bridge.zenoh_format import SENDER_SIZE, Attachment, data_key
from instant_ic.bridge.zenoh_outgoing import Outgoing, RosPublisher
from instant_ic.bridge.zenoh_session import (
    CLIENT_DEFAULTS,
    ROUTER_DEFAULTS,
    RosNode,
    RosSession,
    ZenohError,
    load_config,
    open_zenoh,
)
from instant_ic.bus import LATCHED, RELIABLE, SENSOR, NodeError, registry
from instant_ic.control.robot_lease import Verdict
from instant_ic.experiments.stack import free_port
from instant_ic.msg import (
    Bool,
    String,
    TFMessage,
    deserialize,
    transform_message,
    twist_stamped,
    twist_values,
    type_hash,
)
from nodes.zenoh_gateway import ZenohGatewayConfig, ZenohGatewayNode

zenoh = pytest.importorskip("zenoh")
pytestmark = pytest.mark.xdist_group("zenoh")
STRING = "std_msgs/msg/String"
TWIST = "geometry_msgs/msg/TwistStamped"
COMMANDS = ("/operator/cmd_vel", "/operator/estop")
LOOPBACK = {"mode": "client", "insecure_loopback_commands": True}


@pytest.fixture(scope="module")
def router():
    """Endpoint of a router that runs for all tests of this file."""
    endpoint = f"tcp/127.0.0.1:{free_port()}"
    session = open_zenoh(load_config("", (), (endpoint,), ROUTER_DEFAULTS))
    yield endpoint
    session.close()


@pytest.fixture
def world(router, tmp_path_factory, monkeypatch):
    """Makes gateways, neighbours on the bus and sessions, each in the run directory of its name, and ends them all."""
    for module in ("incoming", "outgoing"):
        monkeypatch.setattr(f"instant_ic.bridge.zenoh_{module}.GRACE_S", 0.3)
    open_things = []
    run_dirs = {}

    class World:
        endpoint = router

        def run_dir(self, name):
            return run_dirs.setdefault(name, tmp_path_factory.mktemp("r"))

        def keep(self, thing):
            open_things.append(thing)
            return thing

        def gateway(self, where, **parameters):
            # A client opens half a second sooner than a peer.
            config = ZenohGatewayConfig(connect=(router,), **{"mode": "client", **parameters})
            return self.keep(LiveNode(self.run_dir(where), ZenohGatewayNode, config, "zenoh_gateway"))

        def neighbour(self, where, name="talker"):
            return self.keep(Neighbour(self.run_dir(where), name))

        def session(self):
            return self.keep(RosSession(load_config("", (router,), defaults=CLIENT_DEFAULTS)))

        def topics(self, where):
            return {info.topic for info in registry.list_topics(self.run_dir(where))}

    yield World()
    for thing in reversed(open_things):
        thing.close()


@pytest.fixture
def sdk(world):
    """zenoh-ros2-sdk on the same router."""
    from zenoh_ros2_sdk.session import ZenohSession

    host, port = world.endpoint.removeprefix("tcp/").split(":")
    ZenohSession._instance = None
    ZenohSession.get_instance(host, int(port))
    yield {"router_ip": host, "router_port": int(port)}
    ZenohSession.get_instance().close()


def publish_until(publisher, message, condition, what):
    """Publishes again and again: a reader that has just appeared misses the first."""

    def once():
        publisher.publish(message)
        time.sleep(0.02)
        return condition()

    return wait_for(once, what)


# -- out ---------------------------------------------------------------------------------------------


def test_message_goes_out_byte_for_byte_under_rmw_zenohs_key_with_its_attachment(world):
    world.gateway("robot", namespace="robot1", publish=("/chat*",))
    out = world.neighbour("robot").publisher("/chatter", String)
    listener = world.session()
    samples = []
    listener.zenoh.declare_subscriber("0/robot1/**", samples.append)
    message = String("hello")
    before_ns = time.time_ns()
    publish_until(out, message, lambda: len(samples) >= 3, "samples")
    assert {str(s.key_expr) for s in samples} == {data_key(0, "/robot1/chatter", STRING, type_hash(STRING))}
    assert {s.payload.to_bytes() for s in samples} == {cdr(message)}
    attachments = [Attachment.unpack(s.attachment.to_bytes()) for s in samples]
    first = attachments[0].sequence
    assert [a.sequence for a in attachments] == list(range(first, first + len(samples)))
    assert len({a.gid for a in attachments}) == 1
    assert all(before_ns <= a.source_ns <= time.time_ns() for a in attachments)


def test_each_node_that_publishes_stands_in_the_ros_graph_until_it_ends(world):
    tokens = {}
    world.session().watch(lambda token, alive: tokens.update({token: alive}))
    gateway = world.gateway("robot", namespace="robot1", publish=("/chatter", "/latched"))
    talker = world.neighbour("robot", "talker")
    talker.publisher("/chatter", String, SENSOR)
    talker.publisher("/latched", String, LATCHED)
    wait_for(lambda: sum(t.kind == "MP" for t in tokens) == 2, "tokens of both publishers")
    by_topic = {t.topic: t for t in tokens if t.kind == "MP"}
    assert by_topic["/robot1/chatter"].qos == SENSOR
    assert by_topic["/robot1/latched"].qos == LATCHED
    assert {(t.namespace, t.node) for t in tokens if t.kind == "NN"} == {
        ("/robot1", "talker"),
        ("/robot1", "zenoh_gateway"),
    }
    node = next(t for t in tokens if t.kind == "NN" and t.node == "talker")
    assert {t.node_id for t in by_topic.values()} == {node.node_id} and node.entity_id == node.node_id
    talker.node.drop(talker.node.publishers[0])
    wait_for(lambda: not tokens[by_topic["/robot1/chatter"]], "the end of one token")
    assert tokens[by_topic["/robot1/latched"]] and tokens[node]
    gateway.close()
    wait_for(lambda: not any(tokens.values()), "the end of all tokens")


def test_independent_client_sees_our_topics_types_and_messages(world, sdk):
    from zenoh_ros2_sdk import ROS2Subscriber
    from zenoh_ros2_sdk.discovery import get_topic_info, get_topic_names_and_types

    world.gateway("robot", mode="peer", namespace="robot1", publish=("/chatter", "/scan"))
    talker = world.neighbour("robot")
    out = talker.publisher("/chatter", String)
    talker.node.publisher_raw("/scan", "sensor_msgs/msg/LaserScan", SENSOR)
    wanted = {("/robot1/chatter", STRING), ("/robot1/scan", "sensor_msgs/msg/LaserScan")}

    def seen():
        listed = get_topic_names_and_types(0, timeout=5.0, **sdk)
        topics = {(topic, name) for topic, names in listed for name in names}
        return wanted <= topics

    wait_for(seen, "our topics in the client's list")
    info = wait_for(lambda: get_topic_info("/robot1/chatter", 0, timeout=5.0, verbose=True, **sdk), "the topic's info")
    (publisher,) = info.publishers
    assert (publisher.node_name, publisher.node_namespace.strip("/")) == ("talker", "robot1")
    assert publisher.type_hash == type_hash(STRING)
    texts = []
    subscriber = ROS2Subscriber(
        "/robot1/chatter", STRING, lambda m: texts.append(m.data), msg_definition="string data\n", domain_id=0, **sdk
    )
    try:
        assert subscriber.type_hash == type_hash(STRING)  # computed by the client from the definition
        publish_until(out, String("hello"), lambda: texts, "message at the client")
    finally:
        subscriber.close()
    assert set(texts) == {"hello"}


def static(child):
    import numpy as np

    return TFMessage([transform_message(np.eye(4), "base_link", child, 1)])


def test_late_joiners_get_the_latched_values_of_every_node(world):
    """ROS 2: latched topics lost on their way (rosbag2 1049)."""
    world.gateway("robot", namespace="robot1", publish=("/tf_static",))
    for name in ("camera", "velodyne"):
        world.neighbour("robot", name).publisher("/tf_static", TFMessage, LATCHED).publish(static(name))
    robot = world.session()
    tokens = []
    robot.watch(lambda token, alive: tokens.append(token))
    wait_for(lambda: sum(t.kind == "MP" for t in tokens) == 2, "both publishers")
    # At the station both come by one gateway, which can keep one value: it holds the transforms of both.
    world.gateway("station", namespace="robot1", subscribe=("/tf_static",))
    early = world.neighbour("station", "early")
    frames = lambda heard: {t.child_frame_id for t in deserialize(heard[-1].payload, heard[-1].type_name).transforms}  # noqa: E731
    heard = early.listen("/tf_static", LATCHED)
    early.wait(lambda: heard and frames(heard) == {"camera", "velodyne"}, "both transforms")
    late = world.neighbour("station", "late")
    heard = late.listen("/tf_static", LATCHED)
    late.wait(lambda: heard and frames(heard) == {"camera", "velodyne"}, "both transforms, late")


def test_static_transforms_without_end_are_refused(world, monkeypatch):
    monkeypatch.setattr("instant_ic.bridge.zenoh_incoming.MAX_FRAMES", 2)
    world.gateway("robot", namespace="robot1", publish=("/tf_static",))
    publisher = world.neighbour("robot", "camera").publisher("/tf_static", TFMessage, LATCHED)
    station = world.gateway("station", namespace="robot1", subscribe=("/tf_static",))
    children = itertools.count()

    def refused():
        publisher.publish(static(f"frame{next(children)}"))
        return station.told("in /tf_static")

    wait_for(refused, "the refusal")
    assert "refused: more than 2 static transforms" in station.told("in /tf_static")


# -- in ----------------------------------------------------------------------------------------------


def test_independent_clients_messages_come_in_byte_for_byte(world, sdk):
    from zenoh_ros2_sdk import ROS2Publisher

    world.gateway("robot", namespace="robot1", subscribe=("/chat*",))
    listener = world.neighbour("robot", "listener")
    heard = listener.listen("/chatter")
    publisher = ROS2Publisher("/robot1/chatter", STRING, msg_definition="string data\n", domain_id=0, **sdk)
    try:
        before_ns = time.time_ns()
        listener.wait(lambda: publisher.publish(data="from ROS") or heard, "message on the bus")
    finally:
        publisher.close()
    assert heard[0].payload == cdr(String("from ROS"))
    assert heard[0].type_name == STRING
    assert before_ns - 1_000_000 <= heard[0].publish_ns <= time.time_ns()  # the client's own time of publication
    wait_for(lambda: "/chatter" not in world.topics("robot"), "the end of the topic")


def test_gaps_are_counted_and_reported(world):
    gateway = world.gateway("station", subscribe=("/robot1/chatter",))
    robot = world.session()
    token = RosNode(robot, "/robot1", "talker").endpoint("MP", "/robot1/chatter", STRING, type_hash(STRING))
    key = data_key(0, "/robot1/chatter", STRING, type_hash(STRING))
    publisher = robot.zenoh.declare_publisher(key)
    one, other = os.urandom(16), os.urandom(16)
    wait_for(lambda: publisher.matching_status.matching, "the gateway's subscription")
    for gid, sequence in [(one, 1), (other, 7), (one, 2), (one, 5), (one, 5), (other, 8), (one, 6), (other, 10)]:
        publisher.put(cdr(String("x")), attachment=Attachment(sequence, 1, gid).pack())
    publisher.put(cdr(String("no attachment")))
    publisher.put(cdr(String("cut")), attachment=b"123")
    wait_for(lambda: gateway.node.incoming.malformed() == 2, "the refused ones")
    assert gateway.node.incoming.lost() == {"/robot1/chatter": 3} and token is not None
    assert gateway.node.incoming.count == 7  # the repeated one is not handed on
    wait_for(lambda: "lost: /robot1/chatter 3" in gateway.told("topics"), "the words")


def test_what_came_in_does_not_go_out_again(world):
    gateway = world.gateway("robot", publish=("/chatter",), subscribe=("/chatter",))
    outside = world.session()
    publisher = RosPublisher(RosNode(outside, "/", "ros_node"), "/chatter", STRING, type_hash(STRING))
    samples = []
    outside.zenoh.declare_subscriber("0/chatter/**", samples.append, allowed_origin=zenoh.Locality.REMOTE)
    listener = world.neighbour("robot", "listener")
    heard = listener.listen("/chatter")
    listener.wait(lambda: publisher.put(cdr(String("in")), 1) or len(heard) >= 3, "messages on the bus")
    listener.spin(0.5)
    assert gateway.node.outgoing.count == 0 and samples == []
    own = world.neighbour("robot", "talker").publisher("/chatter", String)
    publish_until(own, String("out"), lambda: samples, "our own message outside")
    assert {s.payload.to_bytes() for s in samples} == {cdr(String("out"))}


def test_another_definition_of_a_type_is_told_and_kept_out(world):
    gateway = world.gateway("robot", subscribe=("/chatter", "/odd"))
    outside = RosNode(world.session(), "/", "ros_node")
    other_hash = "RIHS01_" + "0" * 64
    publishers = [
        RosPublisher(outside, "/chatter", STRING, other_hash),
        RosPublisher(outside, "/odd", "their_msgs/msg/Odd", other_hash),
    ]
    wait_for(lambda: "there sends" in gateway.told("in /chatter"), "words about the definition")
    wait_for(lambda: "(unknown)" in gateway.told("in /odd"), "words about the type")
    assert len(publishers) == 2 and not {"/chatter", "/odd"} & world.topics("robot")


# -- commands ----------------------------------------------------------------------------------------


def stop_publisher(node):
    kind = "std_msgs/msg/Bool"
    return RosPublisher(node, "/robot1/operator/estop", kind, type_hash(kind), LATCHED)


@pytest.fixture
def operator(world):
    """A robot that takes commands, and somebody outside who sends them with times and senders as told."""
    gateway = world.gateway("robot", namespace="robot1", commands=COMMANDS, **LOOPBACK)
    listener = world.neighbour("robot", "listener")
    driven, stops = listener.listen("/operator/cmd_vel", SENSOR), listener.listen("/operator/estop", LATCHED)
    outside = RosNode(world.session(), "/robot1", "station")
    drive = RosPublisher(outside, "/robot1/operator/cmd_vel", TWIST, type_hash(TWIST))
    stop = stop_publisher(outside)

    def command(v, w=0.0, age_s=0.0):
        drive.put(cdr(twist_stamped(v, w, time.time_ns())), time.time_ns() - int(age_s * 1e9))
        return True

    listener.wait(lambda: command(0.1) and driven, "a command on the bus")
    return gateway, listener, driven, stops, command, stop, drive


def test_fresh_commands_come_in_and_old_or_mad_ones_do_not(operator):
    gateway, listener, driven, _, command, _, drive = operator
    listener.spin(0.3)  # what the fixture sent is through
    for send, words in [
        (lambda: command(0.3, age_s=1.0), "s old, at most 0.3 s allowed"),
        (lambda: command(0.3, age_s=-5.0), "s ahead: set the clocks"),
        (lambda: command(float("nan")), "not finite"),
        (lambda: command(50.0), "beyond"),
    ]:
        driven.clear()
        send()
        wait_for(lambda words=words: words in gateway.told("in /operator/cmd_vel"), words)
        listener.spin(0.1)
        assert driven == []
    listener.wait(lambda: command(0.25) and driven, "a fresh command")
    message = deserialize(driven[-1].payload, TWIST)
    assert twist_values(message) == (0.25, 0.0)
    assert message.header.frame_id == f"{drive.gid[:SENDER_SIZE].hex()}/base_link"  # who sent it, and what it claims
    wait_for(lambda: gateway.told("in /operator/cmd_vel") == "commands are accepted", "all clear")
    refused = dict(gateway.node.gate.refused)
    refused.pop(Verdict.NO_SENDER, None)  # what the fixture sent before the graph knew it
    assert refused == {Verdict.OLD: 1, Verdict.FUTURE: 1, Verdict.NOT_FINITE: 1, Verdict.TOO_FAST: 1}


def test_second_driver_is_refused_until_the_first_is_silent(operator, world):
    gateway, listener, driven, _, command, _, _ = operator
    node = RosNode(world.session(), "/", "other_station")
    second = RosPublisher(node, "/robot1/operator/cmd_vel", TWIST, type_hash(TWIST))

    def both():
        command(0.1)
        second.put(cdr(twist_stamped(-0.1, 0.0, time.time_ns())), time.time_ns())
        return "while" in gateway.told("in /operator/cmd_vel") and gateway.node.gate.refused[Verdict.NOT_DRIVER] > 2

    listener.wait(both, "refusals of the second driver")
    assert all(twist_values(deserialize(m.payload, TWIST))[0] > 0 for m in driven)

    def alone():
        if gateway.node.gate.refused[Verdict.HELD] > 2:  # held from before: it lets go once
            second.put(cdr(twist_stamped(0.0, 0.0, time.time_ns())), time.time_ns())
        second.put(cdr(twist_stamped(-0.1, 0.0, time.time_ns())), time.time_ns())
        return driven and twist_values(deserialize(driven[-1].payload, TWIST))[0] < 0

    listener.wait(alone, "the second driver's command after the first one's silence")


def test_a_stop_comes_in_however_old_it_is_and_only_a_fresh_release_does(operator):
    gateway, listener, _, stops, command, stop, _ = operator
    hour = 3_600_000_000_000
    stop.put(cdr(Bool(True)), time.time_ns() - hour)
    listener.wait(lambda: stops and deserialize(stops[-1].payload, "std_msgs/msg/Bool").data, "the stop")
    stop.put(cdr(Bool(False)), time.time_ns() - hour)
    wait_for(lambda: "command refused" in gateway.told("in /operator/estop"), "refusal of the old release")
    assert deserialize(stops[-1].payload, "std_msgs/msg/Bool").data

    def release():
        command(0.0)  # the driver is there
        stop.put(cdr(Bool(False)), time.time_ns())
        return not deserialize(stops[-1].payload, "std_msgs/msg/Bool").data

    listener.wait(release, "the fresh release")


def test_nobody_but_the_driver_releases_the_emergency_stop_and_everybody_presses_it(operator, world):
    gateway, listener, _, stops, command, stop, _ = operator
    stranger = stop_publisher(RosNode(world.session(), "/robot1", "stranger"))

    def stopped():
        return bool(stops) and deserialize(stops[-1].payload, "std_msgs/msg/Bool").data

    listener.wait(lambda: stranger.put(cdr(Bool(True)), time.time_ns()) or stopped(), "the stranger's stop")

    def refused():
        command(0.0)
        stranger.put(cdr(Bool(False)), time.time_ns())
        return gateway.node.gate.refused[Verdict.RELEASE] >= 3

    listener.wait(refused, "refusals of the stranger's release")
    listener.spin(0.2)
    assert stopped()
    listener.wait(lambda: command(0.0) and (stop.put(cdr(Bool(False)), time.time_ns()) or not stopped()), "the release")


@pytest.mark.parametrize("loopback", [False, True])
def test_without_tls_no_command_comes_in_but_the_pressing_of_the_emergency_stop(world, loopback):
    """Loopback is allowed only where the parameter says so and no link can leave the machine: a peer's can."""
    gateway = world.gateway(
        "robot",
        mode="peer",
        namespace="robot1",
        commands=COMMANDS,
        subscribe=("/*",),
        insecure_loopback_commands=loopback,
    )
    assert "only emergency stops are accepted as commands" in gateway.told("commands")
    assert gateway.node.diagnoses()["commands"][0] == 2
    listener = world.neighbour("robot", "listener")
    driven, stops = listener.listen("/operator/cmd_vel", SENSOR), listener.listen("/operator/estop", LATCHED)
    stranger = RosNode(world.session(), "/robot1", "stranger")
    stop = stop_publisher(stranger)
    drive = RosPublisher(stranger, "/robot1/operator/cmd_vel", TWIST, type_hash(TWIST))

    def press():
        drive.put(cdr(twist_stamped(0.3, 0.0, time.time_ns())), time.time_ns())
        stop.put(cdr(Bool(True)), time.time_ns())
        return stops

    listener.wait(press, "the stop")
    stop.put(cdr(Bool(False)), time.time_ns())
    wait_for(lambda: gateway.node.gate.refused[Verdict.INSECURE], "the refusal of the release")
    listener.spin(0.2)
    assert driven == [] and "/operator/cmd_vel" not in world.topics("robot")
    assert deserialize(stops[-1].payload, "std_msgs/msg/Bool").data


def test_names_that_others_make_are_limited(world, monkeypatch):
    monkeypatch.setattr("instant_ic.bridge.zenoh_incoming.MAX_TOPICS", 5)
    monkeypatch.setattr("instant_ic.bridge.zenoh_incoming.MAX_PUBLISHERS", 5)
    gateway = world.gateway("robot", namespace="robot1", subscribe=("/*",))
    outside = RosNode(world.session(), "/robot1", "stranger")
    kept = [
        RosPublisher(outside, f"/robot1/{'x' * length}{number}", STRING, type_hash(STRING))
        for length, number in [(300, 0), *((1, number) for number in range(20))]
    ]
    wait_for(lambda: "at most 5 topics" in gateway.told("names"), "the refusal")
    wait_for(lambda: len(gateway.node.incoming.topics) == 5, "the topics that are taken")
    assert all(len(topic) < 10 for topic in gateway.node.incoming.topics) and len(kept) == 21
    topic = gateway.node.incoming.topics[0]
    raw = outside.session.zenoh.declare_publisher(data_key(0, f"/robot1{topic}", STRING, type_hash(STRING)))
    wait_for(lambda: raw.matching_status.matching, "the gateway's subscription")
    for sequence in (1, 3):
        for number in range(20):
            raw.put(cdr(String("x")), attachment=Attachment(sequence, 1, bytes([number] * 16)).pack())
    # The router knows the subscription a moment before the gateway has stored it.
    wait_for(lambda: gateway.node.incoming.count >= 40, "all messages")
    assert gateway.node.incoming.lost() == {}  # whose gaps are counted is limited too


def test_robot_is_told_to_stand_when_the_last_driver_leaves(operator):
    _, listener, driven, _, command, _, drive = operator
    listener.wait(lambda: command(0.3) and len(driven) > 3, "driving")
    drive.close()
    listener.wait(lambda: twist_values(deserialize(driven[-1].payload, TWIST)) == (0.0, 0.0), "a zero command")


def test_commands_do_not_come_in_where_they_are_not_configured(world):
    gateway = world.gateway("robot", namespace="robot1", subscribe=("/*", "/operator/*"))
    outside = RosNode(world.session(), "/robot1", "station")
    drive = RosPublisher(outside, "/robot1/operator/cmd_vel", TWIST, type_hash(TWIST))
    chat = RosPublisher(outside, "/robot1/chatter", STRING, type_hash(STRING))
    wait_for(lambda: "/chatter" in world.topics("robot"), "the harmless topic")

    def sent():  # again and again: the gateway's subscription may not have reached the publisher yet
        drive.put(cdr(twist_stamped(0.3, 0.0, time.time_ns())), time.time_ns())
        chat.put(cdr(String("x")), time.time_ns())
        return gateway.node.incoming.count

    wait_for(sent, "the harmless message")
    assert world.topics("robot") & {"/operator/cmd_vel", "/cmd_vel"} == set()


# -- a fleet, links, configuration ---------------------------------------------------------------------


def test_two_robots_and_a_station_do_not_mix(world):
    out = {}
    for name in ("robot1", "robot2"):
        world.gateway(name, namespace=name, publish=("/chatter",))
        out[name] = world.neighbour(name).publisher("/chatter", String)
    world.gateway("station", namespace="robot2", subscribe=("/chatter",))
    world.keep(
        LiveNode(
            world.run_dir("station"),
            ZenohGatewayNode,
            ZenohGatewayConfig(mode="client", connect=(world.endpoint,), subscribe=("/robot*/chatter",)),
            "fleet_gateway",
        )
    )
    listener = world.neighbour("station", "listener")
    chosen, first, second = (listener.listen(t) for t in ("/chatter", "/robot1/chatter", "/robot2/chatter"))

    def all_heard():
        for name, publisher in out.items():
            publisher.publish(String(name))
        return chosen and first and second

    listener.wait(all_heard, "messages of both robots")
    said = [{deserialize(m.payload, STRING).data for m in messages} for messages in (chosen, first, second)]
    assert said == [{"robot2"}, {"robot1"}, {"robot2"}]


def test_a_client_waits_for_its_router_and_finds_it(tmp_path_factory, monkeypatch):
    """A Zenoh client cannot be opened without its router, and by its configuration may wait for it for ever."""
    monkeypatch.setattr("instant_ic.bridge.zenoh_session.CONNECT_TIMEOUT_MS", 200)
    monkeypatch.setattr("nodes.zenoh_gateway.RETRY_S", 0.2)
    endpoint = f"tcp/127.0.0.1:{free_port()}"
    config = ZenohGatewayConfig(mode="client", connect=(endpoint,), publish=("/chatter",))
    gateway = LiveNode(tmp_path_factory.mktemp("r"), ZenohGatewayNode, config, "zenoh_gateway")
    try:
        wait_for(lambda: "trying again" in gateway.told("link"), "words about the router")
        router = open_zenoh(load_config("", (), (endpoint,), ROUTER_DEFAULTS))
        try:
            wait_for(lambda: "1 routers" in gateway.told("link"), "the router")
        finally:
            router.close()
        wait_for(lambda: "no router answers" in gateway.told("link"), "words about the router's end")
    finally:
        gateway.close()


def test_a_session_whose_topics_cannot_be_set_up_is_closed_and_opened_again(world, monkeypatch):
    sessions = []

    def outgoing(node, own, *arguments):
        sessions.append(own.session)
        if len(sessions) == 1:
            raise registry.RegistryError("no space left for sockets")
        return Outgoing(node, own, *arguments)

    monkeypatch.setattr("nodes.zenoh_gateway.Outgoing", outgoing)
    monkeypatch.setattr("nodes.zenoh_gateway.RETRY_S", 0.2)
    gateway = world.gateway("robot", commands=COMMANDS, insecure_loopback_commands=True)
    wait_for(lambda: "no space left for sockets; trying again" in gateway.told("link"), "the reason")
    wait_for(lambda: "messages out" in gateway.told("topics"), "counts of the second session")
    wait_for(lambda: "1 routers" in gateway.told("link"), "the second session's link")
    assert not any("AttributeError" in text for _, text, _ in gateway.node.diagnoses().values())
    assert sessions[0].zenoh.is_closed() and not sessions[1].zenoh.is_closed()


@pytest.mark.parametrize(
    ("parameters", "words"),
    [
        ({"namespace": "/robot 1"}, "namespace '/robot 1' must look like robot1"),
        ({"domain": 300}, "domain must lie in 0..232"),
        ({"commands": ("/cmd_vel",)}, r"commands may only hold /operator/cmd_vel, /operator/estop \(got /cmd_vel\)"),
        ({"publish": ("/scan every=2",)}, "'/scan every=2' must be /TOPIC"),
        ({"publish": ("scan",)}, "'scan' must be /TOPIC"),
        ({"subscribe": ("chatter",)}, "'chatter' must be /TOPIC"),
        ({"subscribe": ("/operator/cmd_vel",)}, "/operator/cmd_vel moves a robot"),
        ({"subscribe": ("/robot1/cmd_vel",)}, "/robot1/cmd_vel moves a robot"),
    ],
)
def test_wrong_parameters_are_named(parameters, words):
    with pytest.raises(ValueError, match=words):
        ZenohGatewayConfig(**parameters)


def test_wrong_files_types_and_endpoints_are_named(tmp_path, tmp_path_factory):
    broken = tmp_path / "broken.json5"
    broken.write_text('{mode: "sideways"}')
    with pytest.raises(ZenohError, match=r"broken\.json5: not a Zenoh configuration"):
        load_config(str(broken))
    with pytest.raises(ZenohError, match=r"No such file .*missing\.json5"):
        load_config(str(tmp_path / "missing.json5"))
    with pytest.raises(ZenohError, match="connect/endpoints"):
        load_config("", ("localhost",))
    with pytest.raises(NodeError, match=r"nothing\.json5 does not exist"):
        LiveNode(
            tmp_path_factory.mktemp("r"), ZenohGatewayNode, ZenohGatewayConfig(session_file="nothing.json5"), "gateway"
        )


def test_rate_limit_thins_and_counts_what_it_leaves_out(world):
    gateway = world.gateway("robot", publish=("/fast rate_hz=5", "/*"))
    talker = world.neighbour("robot")
    fast, all_of_it = talker.publisher("/fast", String), talker.publisher("/all", String)
    samples = []

    def heard(sample):
        topic = str(sample.key_expr).split("/")[1]
        if b"burst" in sample.payload.to_bytes():
            samples.append(topic)
        else:
            linked.add(topic)

    linked = set()
    world.session().zenoh.declare_subscriber("0/*/**", heard)
    publish_until(fast, String("x"), lambda: "fast" in linked, "the link of /fast")
    publish_until(all_of_it, String("x"), lambda: "all" in linked, "the link of /all")
    started = time.monotonic()
    for _ in range(40):
        fast.publish(String("burst"))
        all_of_it.publish(String("burst"))
        time.sleep(0.025)
    wait_for(lambda: samples.count("all") == 40, "everything of the other topic")
    passed, took_s = samples.count("fast"), time.monotonic() - started
    # However late the machine is: one for each period, one for the first and one that came late in its period.
    assert 1 <= passed <= 5 * took_s + 2
    assert gateway.node.outgoing.thinned >= 40 - passed


def test_reliable_topics_lose_nothing_on_the_way_through_two_gateways(world):
    world.gateway("robot", namespace="robot1", publish=("/numbers",))
    world.gateway("station", namespace="robot1", subscribe=("/numbers",))
    out = world.neighbour("robot").publisher("/numbers", String, RELIABLE)
    listener = world.neighbour("station", "listener")
    heard = listener.listen("/numbers")
    listener.wait(lambda: out.publish(String("first")) or heard, "the link")
    for number in range(100):
        out.publish(String(str(number)))
        listener.spin(0.002)
    listener.wait(lambda: len(heard) and deserialize(heard[-1].payload, STRING).data == "99", "the last one")
    texts = [deserialize(m.payload, STRING).data for m in heard]
    assert [t for t in texts if t != "first"] == [str(n) for n in range(100)]
