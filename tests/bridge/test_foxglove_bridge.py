"""The Foxglove bridge over a real WebSocket, by a client that speaks Foxglove's protocol (ws-protocol, spec.md)."""

import contextlib
import json
import socket
import time

import numpy as np
import pytest
from foxglove_client import FoxgloveWorld, TalkerConfig, TalkerNode
from live_nodes import LiveNode, cdr, wait_for
from websockets.exceptions import ConnectionClosed

from instant_ic.bus import LATCHED, RELIABLE, SENSOR, NodeError, registry
from instant_ic.control.robot_lease import RELEASED, Verdict
from instant_ic.experiments.stack import free_port
from instant_ic.msg import (
    Bool,
    Clock,
    ControlState,
    String,
    TFMessage,
    compressed_image_message,
    deserialize,
    message_type,
    stamp_ns,
    to_time,
    transform_message,
    twist_message,
    twist_stamped,
    twist_values,
)
from nodes.foxglove_bridge import FoxgloveBridgeConfig, FoxgloveBridgeNode

DRIVE, STOP = "/operator/cmd_vel", "/operator/estop"


@pytest.fixture
def world(tmp_path_factory):
    with FoxgloveWorld(tmp_path_factory.mktemp("r")) as world:
        yield world


# -- topics ------------------------------------------------------------------------------------------


def test_topics_are_offered_with_their_whole_definition_as_they_come_and_go(world):
    world.bridge(exclude=("/hidden",))
    talker = world.neighbour()
    talker.publisher("/hidden", String)
    state = talker.publisher("/ic/state", ControlState, LATCHED)
    client = world.client()
    channel = client.until(lambda: client.channels.get("/ic/state"), "the channel")
    assert (channel["encoding"], channel["schemaName"], channel["schemaEncoding"]) == (
        "cdr",
        "instant_ic_msgs/msg/ControlState",
        "ros2msg",
    )
    assert "uint8 VIRTUAL=1" in channel["schema"] and "MSG: geometry_msgs/Quaternion" in channel["schema"]
    # An independent parser reads bytes of ours by this text alone.
    from rosbags.typesys import Stores, get_types_from_msg, get_typestore

    store = get_typestore(Stores.EMPTY)
    store.register(get_types_from_msg(channel["schema"], channel["schemaName"]))
    message = ControlState(**{**empty_state().__dict__, "mode": 2, "reason": "why"})
    assert store.deserialize_cdr(cdr(message), channel["schemaName"]).reason == "why"
    talker.node.drop(state)
    client.until(lambda: "/ic/state" not in client.channels, "the end of the channel")
    assert "/hidden" not in client.channels


def empty_state():
    from instant_ic.geometry.poses import matrix_from_pose2
    from instant_ic.msg import header, pose_message

    pose = pose_message(matrix_from_pose2(np.zeros(3)))
    still = twist_message()
    return ControlState(
        header("map", 0),
        0,
        "",
        False,
        False,
        0,
        pose,
        pose,
        pose,
        still,
        still,
        0.0,
        0.0,
        0.0,
        0,
        0,
        pose,
        still,
        0.5,
        0,
        "",
    )


def test_bytes_go_through_unchanged_with_their_time_and_only_while_somebody_watches(world):
    bridge = world.bridge()
    talker = world.neighbour()
    out = talker.publisher("/camera/image/compressed", message_type("CompressedImage"), SENSOR)
    wait_for(lambda: "/camera/image/compressed" in bridge.server.topics, "the topic")
    assert out.subscriber_count == 0
    client = world.client()
    client.spin(0.3)
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
    client.close()  # without a word, as a browser's tab that is closed
    wait_for(lambda: out.subscriber_count == 0, "the end after the client has left")


def static(child):
    return TFMessage([transform_message(np.eye(4), "base_link", child, 1)])


def test_each_client_gets_the_latched_values_of_every_node_however_late_it_comes(world):
    """ROS 2: latched topics lost for late subscribers (rosbag2 1049, foxglove bridge)."""
    world.bridge()
    for name in ("camera", "velodyne"):
        world.neighbour(name).publisher("/tf_static", TFMessage, LATCHED).publish(static(name))

    def frames(client):
        return {
            t.child_frame_id
            for _, _, data in client.messages
            for t in deserialize(data, "tf2_msgs/msg/TFMessage").transforms
        }

    for _ in range(2):
        client = world.client()
        client.subscribe("/tf_static")
        client.until(lambda client=client: frames(client) == {"camera", "velodyne"}, "both transforms")


def test_no_flood_of_old_messages_after_a_stall(world):
    """Foxglove bridge 329: a viewer that stood still was sent everything that it had missed."""
    bridge = world.bridge()
    talker = world.neighbour()
    out = talker.publisher("/numbers", String, RELIABLE)
    receiver = socket.create_connection(("127.0.0.1", bridge.server.port))
    receiver.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, 65536)
    client = world.client(sock=receiver, max_queue=1)
    client.subscribe("/numbers")
    wait_for(lambda: out.subscriber_count == 1, "the subscription")
    filler = "x" * 400_000
    sent = 200
    for number in range(sent):  # 80 MB while the client reads nothing
        out.publish(String(f"{number} {filler}"))
        time.sleep(0.005)
    wait_for(lambda: bridge.server.count >= sent, "everything at the server")
    numbers = []

    def caught_up():
        while client.messages:
            numbers.append(int(deserialize(client.messages.popleft()[2], "std_msgs/msg/String").data.split()[0]))
        return numbers and numbers[-1] == sent - 1

    client.until(caught_up, "the newest message")
    # The server's queue and what the kernel's buffers held when it filled (4 MB by default), not the 200 sent.
    assert len(numbers) <= 32 + 16
    assert numbers == sorted(numbers)


def test_a_topic_that_changes_its_type_is_offered_anew(world):
    world.bridge()
    talker = world.neighbour()
    first = talker.publisher("/x", String)
    client = world.client()
    assert client.subscribe("/x")["schemaName"] == "std_msgs/msg/String"
    talker.node.drop(first)
    out = talker.publisher("/x", Bool)
    client.until(lambda: client.channels.get("/x", {}).get("schemaName") == "std_msgs/msg/Bool", "the other type")
    client.subscribe("/x", 2)
    wait_for(lambda: out.subscriber_count == 1, "the subscription")
    out.publish(Bool(True))
    client.until(lambda: client.messages, "the message")
    assert client.messages[0][2] == cdr(Bool(True))


def test_graph_of_nodes_and_topics(world):
    world.bridge()
    world.neighbour("talker").publisher("/chatter", String)
    claim = registry.Claim(world.run_dir / "nodes" / "ears", "node ears")
    try:
        entry = {"name": "ears", "executable": "m", "pid": 1, "started_ns": 1, "params": {}}
        claim.write({**entry, "publishes": {}, "subscribes": {"/chatter": "any"}})
        client = world.client()
        client.send(op="subscribeConnectionGraph")

        def seen():
            updates = [t for t in client.texts if t["op"] == "connectionGraphUpdate"]
            published = {p["name"]: p["publisherIds"] for u in updates for p in u["publishedTopics"]}
            subscribed = {s["name"]: s["subscriberIds"] for u in updates for s in u["subscribedTopics"]}
            return published.get("/chatter") == ["talker"] and subscribed.get("/chatter") == ["ears"]

        client.until(seen, "the graph")
    finally:
        claim.release()


def test_simulated_time_is_told_also_before_topics_flow(world):
    world.bridge(sim_time=True)
    clock = world.neighbour("player").publisher("/clock", Clock)
    client = world.client()
    assert "time" in client.info["capabilities"]
    client.until(lambda: "/clock" in client.channels, "topics before the first /clock")
    client.until(lambda: clock.publish(Clock(to_time(7_000_000_000))) or client.times, "the time")
    assert set(client.times) == {7_000_000_000}


# -- parameters --------------------------------------------------------------------------------------


@pytest.fixture
def talker(world):
    return world.running(TalkerNode, TalkerConfig(), "talker")


def test_parameters_of_every_node_are_served_and_changed_where_the_node_allows_it(world, talker):
    bridge = world.bridge(set_parameters=True)
    client = world.client()
    wait_for(lambda: "talker" in bridge.server.parameters.nodes, "the node")
    values = client.parameters()
    assert values["/talker.rate_hz"] == 2.0
    assert values["/talker.words"] == "hello"
    assert values["/talker.places"] == [1.0, 2.5]
    assert client.parameters("/talker.words") == {"/talker.words": "hello"}

    client.texts.clear()
    wanted = [{"name": "/talker.rate_hz", "value": 5, "type": "float64"}, {"name": "/talker.places", "value": [3.5]}]
    client.send(op="setParameters", parameters=wanted, id="s")
    answer = client.until(lambda: client.text("parameterValues"), "the new values")
    assert {p["name"]: p["value"] for p in answer["parameters"]} == {"/talker.rate_hz": 5.0, "/talker.places": [3.5]}
    assert (talker.config.rate_hz, talker.config.places) == (5.0, (3.5,))

    for name, value, words in [("/talker.rate_hz", -1.0, "must be > 0"), ("/talker.words", "bye", "restart")]:
        client.texts.clear()
        client.send(op="setParameters", parameters=[{"name": name, "value": value}], id="t")
        refusal = client.until(lambda: client.text("status"), "the refusal")
        assert refusal["level"] == 2 and words in refusal["message"]
    assert (talker.config.rate_hz, talker.config.words) == (5.0, "hello")


def test_a_node_that_is_not_there_is_told(world):
    world.bridge()
    client = world.client()
    client.parameters("/nobody.rate_hz")
    status = client.until(lambda: client.text("status"), "words")
    assert "nobody" in status["message"] and "does not run" in status["message"]


# -- commands ----------------------------------------------------------------------------------------


def test_nobody_can_publish_unless_it_is_configured(world):
    world.bridge()
    client = world.client()
    assert "clientPublish" not in client.info["capabilities"]
    client.advertise(DRIVE, "geometry_msgs/Twist")
    client.publish(json.dumps({"linear": {"x": 0.2}, "angular": {"z": 0.0}}).encode())
    client.spin(0.5)
    assert DRIVE not in {t.topic for t in registry.list_topics(world.run_dir)}


@pytest.fixture
def driving(world):
    """The bridge with commands allowed, a client, and what arrives on the bus."""
    bridge = world.bridge(accept_operator=True)
    listener = world.neighbour("listener")
    drives, stops = listener.listen(DRIVE, RELIABLE), listener.listen(STOP, LATCHED)
    client = world.client()
    client.until(lambda: DRIVE in client.channels, "the bridge's own topic")
    listener.spin(0.3)
    return bridge, client, listener, drives, stops


def last_drive(drives):
    return twist_values(deserialize(drives[-1].payload, "TwistStamped"))


def test_commands_in_either_encoding_reach_the_bus_stamped(driving):
    _, client, listener, drives, stops = driving
    client.advertise(DRIVE, "geometry_msgs/msg/Twist", "json", 1)
    client.publish(json.dumps({"linear": {"x": 0.2, "y": 0, "z": 0}, "angular": {"z": -0.3}}).encode(), 1)
    listener.wait(lambda: len(drives) == 1, "the JSON command")
    assert last_drive(drives) == (0.2, -0.3)
    assert abs(stamp_ns(deserialize(drives[-1].payload, "TwistStamped")) - time.time_ns()) < 30e9
    client.advertise(DRIVE, "geometry_msgs/msg/TwistStamped", "cdr", 2)
    command = twist_stamped(0.1, 0.4, time.time_ns(), "console/page 1")  # its frame is the client's claim
    client.publish(cdr(command), 2)
    listener.wait(lambda: len(drives) == 2, "the CDR command")
    command.header.frame_id = "client 1"
    assert drives[-1].payload == cdr(command)
    client.advertise(STOP, "std_msgs/msg/Bool", "json", 3)
    client.publish(b'{"data": true}', 3)
    listener.wait(lambda: stops, "the stop")
    assert deserialize(stops[-1].payload, "std_msgs/msg/Bool").data is True


@pytest.mark.parametrize(
    ("name", "content", "words"),
    [
        ("Twist", b'{"linear": {"x": 1e999}, "angular": {"z": 0}}', "not finite"),
        ("Twist", b'{"linear": {"x": 30}, "angular": {"z": 0}}', "beyond 2 m/s"),
        ("Twist", b'{"linear": 3}', "TypeError"),
        ("Twist", b"[1, 2]", "not a JSON object"),
        ("Twist", b"\xff", "UnicodeDecodeError"),
        ("Twist", b'{"linear":' + b"[" * 20_000, "nested too deeply"),
        (
            "TwistStamped",
            b'{"header": {"stamp": {"sec": 1, "nanosec": 0}}, "twist": {"linear": {"x": 0.1}, "angular": {"z": 0}}}',
            "s old",
        ),
    ],
)
def test_bad_commands_are_refused_told_and_counted(driving, name, content, words):
    bridge, client, listener, drives, _ = driving
    client.advertise(DRIVE, f"geometry_msgs/msg/{name}")
    client.publish(content)
    status = client.until(lambda: client.text("status"), "the refusal")
    assert "refused" in status["message"] and words in status["message"]
    wait_for(lambda: words in bridge.diagnoses().get("commands", (0, "", {}))[1], "the diagnosis")
    listener.spin(0.2)
    assert drives == []


def test_other_topics_and_types_are_not_taken(driving):
    _, client, listener, drives, _ = driving
    wrong = [("/cmd_vel", "geometry_msgs/Twist"), (DRIVE, "std_msgs/String"), ("/nav/cmd_vel", "Twist")]
    for number, (topic, name) in enumerate(wrong):
        client.texts.clear()
        client.advertise(topic, name, number=number)
        status = client.until(lambda: client.text("status"), "the refusal")
        assert f"{topic} {name} json is not accepted; only /operator/cmd_vel" in status["message"]
        client.publish(b'{"linear": {"x": 0.1}, "angular": {"z": 0}}', number)
    listener.spin(0.2)
    assert drives == []


def test_robot_is_told_to_stand_when_its_driver_leaves_and_a_second_one_waits(driving, world):
    bridge, client, listener, drives, _ = driving
    command = b'{"linear": {"x": 0.2}, "angular": {"z": 0}}'
    client.advertise(DRIVE, "geometry_msgs/Twist")
    client.publish(command)
    listener.wait(lambda: drives, "the command")
    second = world.client()
    second.advertise(DRIVE, "geometry_msgs/Twist")
    second.publish(b'{"linear": {"x": -0.2}, "angular": {"z": 0}}')
    assert "may not drive while" in second.until(lambda: second.text("status"), "the refusal")["message"]
    assert last_drive(drives) == (0.2, 0.0)
    with contextlib.suppress(ConnectionClosed):
        client.close()
    listener.wait(lambda: last_drive(drives) == (0.0, 0.0), "a zero command")
    frames = [deserialize(drive.payload, "TwistStamped").header.frame_id for drive in drives]
    assert frames == ["client 1", "client 1" + RELEASED]
    second.publish(b'{"linear": {"x": -0.2}, "angular": {"z": 0}}')
    second.until(lambda: bridge.gate.refused == {Verdict.NOT_DRIVER: 1, Verdict.HELD: 1}, "the refusal of a held key")
    assert last_drive(drives) == (0.0, 0.0)
    second.publish(b'{"linear": {"x": 0}, "angular": {"z": 0}}')
    second.publish(b'{"linear": {"x": -0.2}, "angular": {"z": 0}}')
    listener.wait(lambda: last_drive(drives) == (-0.2, 0.0), "the second driver's command")


# -- start -------------------------------------------------------------------------------------------


def test_a_port_in_use_and_wrong_files_are_told(tmp_path_factory):
    port = free_port()
    with socket.socket() as other:
        other.bind(("127.0.0.1", port))
        other.listen()
        with pytest.raises(NodeError, match=rf"no server on 127\.0\.0\.1:{port}: .*in use.*set host or port"):
            LiveNode(
                tmp_path_factory.mktemp("r"), FoxgloveBridgeNode, FoxgloveBridgeConfig(port=port), "foxglove_bridge"
            )
    config = FoxgloveBridgeConfig(port=0, tls_cert="/nowhere/cert.pem", tls_key="/nowhere/key.pem")
    with pytest.raises(NodeError, match=r"/nowhere/cert\.pem: cannot be read"):
        LiveNode(tmp_path_factory.mktemp("r"), FoxgloveBridgeNode, config, "foxglove_bridge")
    with pytest.raises(ValueError, match="tls_cert and tls_key go together"):
        FoxgloveBridgeConfig(tls_cert="a")


@pytest.mark.parametrize(
    ("given", "told"),
    [
        ({}, ""),
        ({"simulated": False}, ""),  # with a token
        ({"host": "0.0.0.0"}, "unencrypted"),
        ({"simulated": False, "sign_in": "never"}, "can read everything"),
        (
            {"host": "0.0.0.0", "sign_in": "never", "accept_operator": True, "set_parameters": True},
            "can drive the robot",
        ),
    ],
)
def test_default_is_this_machine_only_and_an_open_door_is_told(world, given, told):
    assert FoxgloveBridgeConfig().host == "127.0.0.1"
    text = world.bridge(**given).diagnoses().get("access", (0, ""))[1]
    assert told in text and bool(told) is bool(text)


def test_parameters_are_read_only_by_default(world, talker):
    bridge = world.bridge()
    client = world.client()
    wait_for(lambda: "talker" in bridge.server.parameters.nodes, "the node")
    client.texts.clear()
    client.send(op="setParameters", parameters=[{"name": "/talker.rate_hz", "value": 5.0}], id="s")
    assert "read-only" in client.until(lambda: client.text("status"), "the refusal")["message"]
    answer = client.until(lambda: client.text("parameterValues"), "the present value")
    assert [p["value"] for p in answer["parameters"]] == [2.0] and talker.config.rate_hz == 2.0


def test_nothing_is_left_after_the_end(world):
    node = world.bridge()
    world.live.close()
    assert registry.list_topics(world.run_dir) == []
    with pytest.raises(OSError, match="refused"):
        socket.create_connection(("127.0.0.1", node.server.port), 2)
