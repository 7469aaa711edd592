"""The Foxglove bridge over a real WebSocket: what it shows, who gets in, and what no client can do to it."""

import socket
import stat
import threading
import time

import numpy as np
import pytest
from foxglove_client import Client, FoxgloveWorld, TalkerConfig, TalkerNode
from live_nodes import LiveNode, cdr, wait_for
from websockets.exceptions import ConnectionClosed, InvalidStatus

from instant_ic.bag.metadata import own_schema
from instant_ic.bridge import foxglove_protocol
from instant_ic.bus import LATCHED, RELIABLE, SENSOR, NodeError, registry
from instant_ic.experiments.stack import free_port
from instant_ic.msg import (
    ControlState,
    String,
    TFMessage,
    compressed_image_message,
    deserialize,
    message_type,
    transform_message,
)
from instant_ic.util.paths import sign_in_file
from instant_ic.util.web_access import is_loopback, refusal
from nodes.foxglove_bridge import FoxgloveBridgeConfig, FoxgloveBridgeNode

DRIVE = "/operator/cmd_vel"


@pytest.fixture
def world(tmp_path_factory):
    with FoxgloveWorld(tmp_path_factory.mktemp("r")) as world:
        yield world


@pytest.fixture(scope="module")
def shared_world(tmp_path_factory):
    """A bridge with a running node beside it, for tests that change neither."""
    with FoxgloveWorld(tmp_path_factory.mktemp("r")) as world:
        world.talker = world.running(TalkerNode, TalkerConfig(), "talker")
        world.bridge(allowed_hosts=("robot.example",), max_clients=100)
        yield world


# -- topics ------------------------------------------------------------------------------------------


def test_topics_are_offered_with_their_whole_definition_as_they_come_and_go(world):
    from rosbags.typesys import Stores, get_types_from_msg, get_typestore

    world.bridge(exclude=("/hidden",))
    talker = world.neighbour()
    talker.publisher("/hidden", String)
    state = talker.publisher("/ic/state", ControlState, LATCHED)
    client = world.client()
    channel = client.until(lambda: client.channels.get("/ic/state"), "the channel")
    name = "instant_ic_msgs/msg/ControlState"
    assert (channel["encoding"], channel["schemaName"], channel["schemaEncoding"]) == ("cdr", name, "ros2msg")
    # An independent parser knows the type by this text alone.
    store = get_typestore(Stores.EMPTY)
    store.register(get_types_from_msg(channel["schema"], name))
    assert {"instant_ic_msgs/msg/ControlState", "geometry_msgs/msg/Quaternion"} <= set(store.types)
    talker.node.drop(state)
    client.until(lambda: "/ic/state" not in client.channels, "the end of the channel")
    assert "/hidden" not in client.channels


def test_bytes_go_through_unchanged_with_their_time_and_only_while_somebody_watches(world):
    bridge = world.bridge()
    talker = world.neighbour()
    out = talker.publisher("/camera/image/compressed", message_type("CompressedImage"), SENSOR)
    wait_for(lambda: "/camera/image/compressed" in bridge.server.topics, "the topic")
    client = world.client()
    client.spin(0.2)
    assert out.subscriber_count == 0  # connected, but not watching
    client.subscribe("/camera/image/compressed", 7)
    wait_for(lambda: out.subscriber_count == 1, "the bridge's subscription")
    picture = compressed_image_message(np.arange(256, dtype=np.uint8), "camera", 5)
    before_ns = time.time_ns()
    out.publish(picture)
    client.until(lambda: client.messages, "the picture")
    number, log_time, payload = client.messages[0]
    assert (number, payload) == (7, cdr(picture))
    assert before_ns <= log_time <= time.time_ns()
    client.unsubscribe(7)
    wait_for(lambda: out.subscriber_count == 0, "the end of the subscription")
    client.subscribe("/camera/image/compressed", 8)
    wait_for(lambda: out.subscriber_count == 1, "the subscription again")
    client.close()  # as a browser's tab that is closed
    wait_for(lambda: out.subscriber_count == 0, "the end after the client has left")


def test_each_client_gets_the_latched_values_of_every_node_however_late_it_comes(world):
    """ROS 2: latched topics lost for late subscribers (rosbag2 1049, foxglove bridge)."""
    world.bridge()
    for name in ("camera", "velodyne"):
        message = TFMessage([transform_message(np.eye(4), "base_link", name, 1)])
        world.neighbour(name).publisher("/tf_static", TFMessage, LATCHED).publish(message)

    def frames(client):
        messages = [deserialize(data, "tf2_msgs/msg/TFMessage") for _, _, data in client.messages]
        return {transform.child_frame_id for message in messages for transform in message.transforms}

    for _ in range(2):
        client = world.client()
        client.subscribe("/tf_static")
        client.until(lambda client=client: frames(client) == {"camera", "velodyne"}, "both transforms")


def test_no_flood_of_old_messages_after_a_stall(world):
    """Foxglove bridge 329: a viewer that stood still was sent everything that it had missed."""
    bridge = world.bridge()
    out = world.neighbour().publisher("/numbers", String, RELIABLE)
    receiver = socket.create_connection(("127.0.0.1", bridge.server.port))
    receiver.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, 65536)
    client = world.client(sock=receiver, max_queue=1)
    client.subscribe("/numbers")
    wait_for(lambda: out.subscriber_count == 1, "the subscription")
    filler, sent = "x" * 400_000, 100
    for number in range(sent):  # 40 MB while the client reads nothing
        out.publish(String(f"{number} {filler}"))
        time.sleep(0.005)
    wait_for(lambda: bridge.server.count >= sent, "everything at the server")
    numbers = []

    def caught_up():
        while client.messages:
            numbers.append(int(deserialize(client.messages.popleft()[2], "std_msgs/msg/String").data.split()[0]))
        return numbers and numbers[-1] == sent - 1

    client.until(caught_up, "the newest message")
    # The server's queue and what the kernel's buffers held when it filled (4 MB by default), not the 100 sent.
    assert len(numbers) <= 32 + 16
    assert numbers == sorted(numbers)


# -- parameters --------------------------------------------------------------------------------------


def test_parameters_of_every_node_are_served(shared_world):
    client = shared_world.client()
    values = client.parameters()
    assert values["/talker.rate_hz"] == 2.0
    assert values["/talker.words"] == "hello"
    assert values["/talker.places"] == [1.0, 2.5]
    assert client.parameters("/talker.words") == {"/talker.words": "hello"}


def test_nothing_can_be_changed(shared_world):
    client = shared_world.client()
    assert client.info["capabilities"] == ["parameters"]
    attacks = [
        {"op": "setParameters", "parameters": [{"name": "/talker.rate_hz", "value": 5.0}], "id": "s"},
        {"op": "advertise", "channels": [{"id": 5, "topic": DRIVE, "encoding": "json", "schemaName": "Twist"}]},
    ]
    for attack in attacks:
        client.texts.clear()
        client.send(**attack)
        assert "is for viewing" in client.until(lambda: client.text("status"), "the refusal")["message"]
    client.socket.send(b"\x01\x05\x00\x00\x00" + b'{"linear": {"x": 0.2}, "angular": {"z": 0}}')
    client.until(lambda: "unknown binary message" in client.texts[-1].get("message", ""), "the refusal")
    assert DRIVE not in {topic.topic for topic in registry.list_topics(shared_world.run_dir)}
    assert shared_world.talker.config.rate_hz == 2.0


# -- who gets in -------------------------------------------------------------------------------------


@pytest.mark.parametrize("origin", ["https://evil.example", "null"])
def test_a_foreign_web_page_does_not_get_in(shared_world, origin):
    with pytest.raises(InvalidStatus) as refused:
        shared_world.client(origin=origin)
    assert refused.value.response.status_code == 403
    assert b"allowed_origins" in refused.value.response.body
    wait_for(lambda: origin in shared_world.live.told("door"), "the diagnosis")


@pytest.mark.parametrize("origin", [None, "https://app.foxglove.dev"])
def test_foxglove_and_programs_of_this_machine_get_in(shared_world, origin):
    assert shared_world.client(origin=origin).info["name"] == "Instant IC"


def test_a_name_that_points_here_does_not_get_in_unless_it_is_allowed(shared_world):
    """DNS rebinding: the page's own name resolves to this machine, and its Origin is the same as the Host."""
    port = shared_world.live.node.server.port

    def by_name(name):
        return shared_world.keep(Client(port, host=name, sock=socket.create_connection(("127.0.0.1", port))))

    with pytest.raises(InvalidStatus) as refused:
        by_name("evil.example")
    assert refused.value.response.status_code == 403
    assert b"allowed_hosts" in refused.value.response.body
    assert by_name("robot.example").info


def test_origin_and_host_rules():
    def of(origin, host, origins=("https://a.example",), hosts=("robot",)):
        return refusal(origin, host, origins, hosts)

    assert of(None, "127.0.0.1:8765") == of("https://a.example", "[::1]:80") == of(None, "robot:1") == ""
    assert of("http://[::1]:3000", "10.0.0.7") == of("https://b.example", "localhost", ("*",)) == ""
    for origin, host in [(None, None), (None, ""), (None, "robot.evil"), (None, "127.0.0.1.evil"), (None, "[::1")]:
        assert "Host" in of(origin, host)
    for origin in ["", "null", "http://127.0.0.1.evil", "http://[", "ftp://localhost", "https://A.example", "x" * 999]:
        assert "Origin" in of(origin, "localhost")
        assert len(of(origin, "localhost")) < 200
    assert [is_loopback(host) for host in ("127.3.2.1", "::1", "localhost")] == [True] * 3
    assert not is_loopback("0.0.0.0") and not is_loopback("robot")


def test_fault_every_local_user_sees_a_real_robot(world):
    bridge = world.bridge(simulated=False)
    file = sign_in_file(world.run_dir, "foxglove_bridge")
    assert stat.S_IMODE(file.stat().st_mode) == 0o600
    address, _, token = file.read_text().strip().partition("/?token=")
    assert address == f"ws://127.0.0.1:{bridge.server.port}" and len(token) > 20
    for query in ("", "?token=", "?token=" + token[:-1], "?Token=" + token):
        with pytest.raises(InvalidStatus) as refused:
            world.client(path="/" + query)
        assert refused.value.response.status_code == 401
    assert world.client(path=f"/?token={token}").info["name"] == "Instant IC"
    wait_for(lambda: "token is missing" in world.live.told("door"), "the diagnosis")
    assert token not in str(bridge.diagnoses())
    world.close()
    assert not file.exists()


def test_only_foxgloves_protocols_are_spoken_and_clients_are_limited(world):
    world.bridge(max_clients=1)
    with pytest.raises(InvalidStatus) as refused:
        world.client(protocol="chat")
    assert refused.value.response.status_code == 400
    assert world.client(protocol="foxglove.websocket.v1").socket.subprotocol == "foxglove.websocket.v1"
    with pytest.raises(InvalidStatus) as refused:
        world.client()
    assert refused.value.response.status_code == 503


@pytest.mark.parametrize(
    ("given", "told"),
    [
        ({}, ""),
        ({"simulated": False}, ""),  # with a token
        ({"host": "0.0.0.0"}, "unencrypted"),
        ({"simulated": False, "sign_in": "never"}, "can read everything"),
    ],
)
def test_default_is_this_machine_only_and_an_open_door_is_reported(world, given, told):
    assert FoxgloveBridgeConfig().host == "127.0.0.1"
    text = world.bridge(**given).diagnoses().get("access", (0, ""))[1]
    assert told in text and bool(told) is bool(text)


# -- what no client can do to it -----------------------------------------------------------------------


def test_a_stalled_loop_or_viewer_never_holds_the_node_up_and_what_is_dropped_is_counted(world, monkeypatch):
    """A stall of foxglove-sdk 0.30.3 hung its node for good; here the node only fills queues of a fixed size."""
    bridge = world.bridge()
    out = world.neighbour().publisher("/numbers", String, RELIABLE)
    client = world.client()
    client.subscribe("/numbers")
    wait_for(lambda: out.subscriber_count == 1, "the subscription")
    stalled, release = threading.Event(), threading.Event()

    def parse(data):
        stalled.set()
        release.wait(120)
        return "unadvertise", [], ""

    monkeypatch.setattr(foxglove_protocol, "parse", parse)
    client.socket.send("anything")
    try:
        assert stalled.wait(30)
        for number in range(100):
            out.publish(String(str(number)))
            wait_for(lambda n=number: bridge.server.count > n, "the message while the server stands still")
        assert bridge.server.dropped == 100 - 32
    finally:
        release.set()
    client.until(lambda: len(client.messages) == 32, "the newest messages")
    assert [deserialize(m[2], "std_msgs/msg/String").data for m in client.messages] == [str(n) for n in range(68, 100)]
    wait_for(lambda: bridge.diagnoses()["topics"][2]["dropped"] == 68, "the count in the diagnosis")


@pytest.mark.parametrize(
    "frame",
    [
        "not json",
        "[]",
        "{}",
        '{"op": 1}',
        '{"op": "subscribe"}',
        '{"op": "subscribe", "subscriptions": [1]}',
        '{"op": "subscribe", "subscriptions": [{"id": -1, "channelId": 1}]}',
        '{"op": "subscribe", "subscriptions": [{"id": 1, "channelId": 1e99}]}',
        '{"op": "subscribe", "subscriptions": [{"id": 1, "channelId": 99999}]}',
        '{"op": "unsubscribe", "subscriptionIds": [true]}',
        '{"op": "unsubscribe", "subscriptionIds": [NaN]}',
        '{"op": "getParameters", "parameterNames": 7}',
        "[" * 30_000,
        b"",
        b"\x09zz",
    ],
)
def test_frames_of_any_shape_are_answered_and_the_connection_goes_on(shared_world, frame):
    client = shared_world.client()
    client.socket.send(frame)
    client.until(lambda: client.text("status"), "the refusal")
    client.spin(0.05)
    assert client.parameters("/talker.words")


def test_a_frame_that_is_too_long_ends_the_connection(shared_world):
    client = shared_world.client()
    with pytest.raises(ConnectionClosed):
        client.socket.send("x" * 70_000)
        while True:
            client.socket.recv(30)


# -- start and end -------------------------------------------------------------------------------------


def test_a_port_in_use_is_reported(tmp_path_factory):
    port = free_port()
    with socket.socket() as other:
        other.bind(("127.0.0.1", port))
        other.listen()
        with pytest.raises(NodeError, match=rf"no server on 127\.0\.0\.1:{port}: .*in use.*set host or port"):
            LiveNode(
                tmp_path_factory.mktemp("r"), FoxgloveBridgeNode, FoxgloveBridgeConfig(port=port), "foxglove_bridge"
            )


def test_a_host_that_is_no_name_is_reported(tmp_path_factory):
    with pytest.raises(NodeError, match=r"no server on aaa.*set host or port"):
        LiveNode(
            tmp_path_factory.mktemp("r"), FoxgloveBridgeNode, FoxgloveBridgeConfig(host=70 * "a"), "foxglove_bridge"
        )


# -- against foxglove-sdk's own server -----------------------------------------------------------------


def conversation(client, talk):
    """Frames of a server in answer to the same words."""
    frames = [("serverInfo", sorted(client.info))]
    for step in talk:
        client.messages.clear()
        client.texts.clear()
        step(client)
        client.send(op="getParameters", parameterNames=["/none"], id="done")
        client.until(lambda: any(t.get("id") == "done" for t in client.texts), "the end of a step")
        frames.append([t for t in client.texts if t["op"] not in ("parameterValues", "status")])
        frames.append([t["level"] for t in client.texts if t["op"] == "status" and "none" not in t["message"]])
        frames.append([(number, time_ns, bytes(data)) for number, time_ns, data in client.messages])
    return frames


def test_frames_are_those_of_foxgloves_own_server(world):
    foxglove = pytest.importorskip("foxglove")
    import foxglove.websocket as sdk

    class Listener(sdk.ServerListener):
        def on_get_parameters(self, client, names, request_id=None):
            return []

    context = foxglove.Context()
    theirs = foxglove.start_server(
        name="Instant IC", host="127.0.0.1", port=0, capabilities=[sdk.Capability.Parameters],
        server_listener=Listener(), context=context,
    )  # fmt: skip
    bridge = world.bridge(topics=("/latched",))
    out = world.neighbour().publisher("/latched", String, LATCHED)
    out.publish(String("hello"))
    wait_for(lambda: "/latched" in bridge.server.topics, "the topic")
    try:
        definition = own_schema("std_msgs/msg/String").text.encode()
        schema = foxglove.Schema(name="std_msgs/msg/String", encoding="ros2msg", data=definition)
        channel = foxglove.Channel("/latched", message_encoding="cdr", schema=schema, context=context)
        answers = []
        for port in (theirs.port, bridge.server.port):
            client = world.keep(Client(port))
            offer = client.until(lambda c=client: c.channels.get("/latched"), "the channel")
            number = offer.pop("id")

            def subscribe(client, number=number, ours=port != theirs.port):
                client.send(op="subscribe", subscriptions=[{"id": 7, "channelId": number}])
                if not ours:
                    time.sleep(0.2)
                    channel.log(cdr(String("hello")), log_time=1)
                client.until(lambda: client.messages, "the message")
                subscription, time_ns, data = client.messages[0]
                assert time_ns > 0
                client.messages[0] = subscription, 1, data

            talk = [
                subscribe,
                lambda c, n=number: c.send(op="subscribe", subscriptions=[{"id": 8, "channelId": n}]),
                lambda c: c.send(op="subscribe", subscriptions=[{"id": 9, "channelId": 4_000_000}]),
                lambda c: c.send(op="unsubscribe", subscriptionIds=[7]),
                lambda c: c.send(op="unsubscribe", subscriptionIds=[7]),
                lambda c: c.send(op="nonsense"),
                lambda c: c.socket.send("not json"),
                lambda c: c.socket.send(b"\x09zz"),
            ]
            answers.append((offer, conversation(client, talk)))
        assert answers[0] == answers[1]
    finally:
        theirs.stop()
