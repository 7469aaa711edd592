"""Who gets into the Foxglove bridge, what nobody may do through it, and what no client can do to it."""

import contextlib
import json
import socket
import stat
import struct
import threading
import time
from dataclasses import dataclass, field

import pytest
from foxglove_client import Client, FoxgloveWorld
from live_nodes import wait_for
from websockets.exceptions import ConnectionClosed, InvalidStatus

from instant_ic.bag.metadata import own_schema
from instant_ic.bridge import foxglove_server
from instant_ic.bridge.parameter_guard import never_set
from instant_ic.bus import LATCHED, OK, RELIABLE
from instant_ic.bus.control import NodeControl
from instant_ic.bus.node import Node
from instant_ic.bus.node_files import node_class
from instant_ic.msg import String, deserialize
from instant_ic.util.paths import node_names, sign_in_file
from instant_ic.util.web_access import is_loopback, refusal
from nodes import foxglove_bridge

DRIVE, STOP = "/operator/cmd_vel", "/operator/estop"


@pytest.fixture
def world(tmp_path_factory):
    with FoxgloveWorld(tmp_path_factory.mktemp("r")) as world:
        yield world


# -- who gets in -------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    "origin", ["https://evil.example", "http://evil.example:8765", "null", "https://app.foxglove.dev.evil.example"]
)
def test_a_foreign_web_page_does_not_get_in(world, origin):
    bridge = world.bridge()
    with pytest.raises(InvalidStatus) as refused:
        world.client(origin=origin)
    assert refused.value.response.status_code == 403
    assert b"allowed_origins" in refused.value.response.body
    wait_for(lambda: origin in bridge.diagnoses().get("door", (0, "", {}))[1], "the diagnosis")


def test_a_refusal_is_a_warning_only_for_a_while(world, monkeypatch):
    monkeypatch.setattr(foxglove_bridge, "REFUSED_S", 0.0)
    bridge = world.bridge()
    with pytest.raises(InvalidStatus):
        world.client(origin="https://evil.example")
    wait_for(lambda: bridge.diagnoses().get("door") == (OK, "nobody refused lately", {"requests": 1}), "the diagnosis")


@pytest.mark.parametrize("origin", [None, "https://app.foxglove.dev", "file://", "http://localhost:3000"])
def test_foxglove_and_programs_of_this_machine_get_in(world, origin):
    world.bridge()
    assert world.client(origin=origin).info["name"] == "Instant IC"


def test_a_name_that_points_here_does_not_get_in_unless_it_is_allowed(world):
    """DNS rebinding: the page's own name resolves to this machine, and its Origin is the same as the Host."""
    bridge = world.bridge(allowed_hosts=("robot.example",))

    def by_name(name):
        here = socket.create_connection(("127.0.0.1", bridge.server.port))
        return world.keep(Client(bridge.server.port, host=name, sock=here))

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
    assert [is_loopback(host) for host in ("127.3.2.1", "::1", "localhost", "0.0.0.0", "robot")] == [True] * 3 + [
        False
    ] * 2


def test_fault_every_local_user_sees_and_drives_a_real_robot(world):
    bridge = world.bridge(simulated=False, accept_operator=True)
    file = sign_in_file(world.run_dir, "foxglove_bridge")
    assert stat.S_IMODE(file.stat().st_mode) == 0o600
    address, _, token = file.read_text().strip().partition("/?token=")
    assert address == f"ws://127.0.0.1:{bridge.server.port}" and len(token) > 20
    for query in ("", "?token=", "?token=" + token[:-1], "?Token=" + token):
        with pytest.raises(InvalidStatus) as refused:
            world.client(path="/" + query)
        assert refused.value.response.status_code == 401
    assert world.client(path=f"/?token={token}").info["name"] == "Instant IC"
    wait_for(lambda: "no token" in bridge.diagnoses().get("door", (0, "", {}))[1], "the diagnosis")
    assert token not in str(bridge.diagnoses())
    world.close()
    assert not file.exists()


def test_only_foxgloves_protocols_are_spoken(world):
    world.bridge()
    assert world.client(protocol="foxglove.websocket.v1").socket.subprotocol == "foxglove.websocket.v1"
    with pytest.raises(InvalidStatus) as refused:
        world.client(protocol="chat")
    assert refused.value.response.status_code == 400


def closed(connection):
    """Waits until the other side has closed a connection."""
    connection.settimeout(60)
    with contextlib.suppress(ConnectionResetError):
        while connection.recv(4096):
            pass
    connection.close()


def test_clients_and_connections_beyond_the_limit_are_ended(world, monkeypatch):
    monkeypatch.setattr(foxglove_server, "_HANDSHAKE_S", 600.0)
    bridge = world.bridge(max_clients=1)
    first = world.client()
    with pytest.raises(InvalidStatus) as refused:
        world.client()
    assert refused.value.response.status_code == 503
    kept = []
    while len(kept) < 40 and bridge.server.refused < 2:  # 16 beside the client's
        kept.append(socket.create_connection(("127.0.0.1", bridge.server.port)))
        time.sleep(0.02)
    wait_for(lambda: bridge.server.refused >= 2, "the refusal of a connection")
    assert len(kept) <= 40
    closed(kept.pop())
    first.send(op="nonsense")
    first.until(lambda: first.text("status"), "an answer to the client that was there before")
    for connection in kept:
        connection.close()


def test_connections_that_ask_for_nothing_are_ended(world, monkeypatch):
    monkeypatch.setattr(foxglove_server, "_HANDSHAKE_S", 0.2)
    bridge = world.bridge()
    idle = [socket.create_connection(("127.0.0.1", bridge.server.port)) for _ in range(3)]
    idle[0].sendall(b"GET / HTTP/1.1\r\nHost: local")  # half a request
    idle[1].sendall(b"GET / HTTP/1.1\r\nHost: localhost\r\n\r\n")  # answered, and kept open for more
    for connection in idle:
        closed(connection)


# -- what nobody may do ------------------------------------------------------------------------------


@dataclass(frozen=True)
class Monitor:
    """Attributes:
    enabled: whether it stops the robot.
    """

    enabled: bool = True


@dataclass(frozen=True)
class SafetyConfig:
    """Attributes:
    collision_monitor: stops the robot.
    timeout_s: of commands.
    rate_hz: harmless.
    """

    collision_monitor: Monitor = field(default_factory=Monitor)
    timeout_s: float = 0.3
    rate_hz: float = 2.0


class ArbiterNode(Node[SafetyConfig]):
    name = "arbiter"
    live_parameters = ("*",)


class OtherNode(Node[SafetyConfig]):
    name = "other"
    live_parameters = ("*",)


@pytest.mark.parametrize(("name", "kind"), [("arbiter", ArbiterNode), ("renamed", ArbiterNode), ("other", OtherNode)])
def test_safety_parameters_cannot_be_set_even_where_parameters_can(world, name, kind):
    node = world.running(kind, SafetyConfig(), name)
    world.bridge(set_parameters=True)
    client = world.client()
    attacks = [
        [{"name": f"/{name}.collision_monitor.enabled", "value": False}],
        [{"name": f"/{name}.timeout_s", "value": 60.0}],
        [{"name": f"/{name}.TIMEOUT_S", "value": 60.0}],
        [{"name": f"/{name}.collision_monitor", "value": {"enabled": False}}],
        [{"name": f"/{name}.", "value": {"timeout_s": 60.0}}],
        [{"name": f"/{name}", "value": {"timeout_s": 60.0}}],
        [{"name": f"/../nodes/{name}.rate_hz", "value": 9.0}],
        [{"name": f"/{name}.rate_hz", "value": 9.0}, {"name": f"/{name}.timeout_s", "value": 60.0}],
        [{"name": f"/{name}.timeout_s"}],
    ]
    for parameters in attacks:
        client.texts.clear()
        client.send(op="setParameters", parameters=parameters, id="attack")
        client.until(lambda: client.text("parameterValues"), "the answer")
        assert client.text("status")["level"] == 2, parameters
        assert node.config == SafetyConfig(), parameters
    client.texts.clear()
    client.send(op="setParameters", parameters=[{"name": f"/{name}.rate_hz", "value": 9.0}], id="harmless")
    client.until(lambda: client.text("parameterValues"), "the answer")
    assert node.config.rate_hz == (9.0 if kind is OtherNode else 2.0)


HARMLESS = {
    "bag_recorder": ("duration_s", "snapshot_after_s"),
    "depth_estimator": ("max_rate_hz",),
    "depth_scaler": (
        *("source", "scaler", "lidar", "keyframes", "mapping", "max_rate_hz", "rows"),
        *("body_elevation_deg", "map_frame", "odom_frame", "base_frame"),
    ),
    "nerf": ("render_fps", "train_ms_per_frame", "max_view_pixels", "jpeg_quality"),
}
"""Live parameters that a bridge may set, if it may set any: none of them decides whether or how the robot moves."""


def test_every_live_parameter_is_a_safety_parameter_or_known_to_be_harmless():
    """A new live parameter, or a node of a new name, has to be put on one side or the other."""
    found = {}
    for name in node_names():
        settable = [key for key in node_class(name).live_parameters if not never_set(name, key)]
        if settable:
            found[name] = tuple(settable)
    assert found == HARMLESS


def test_nobody_but_the_driver_releases_the_emergency_stop_and_everybody_presses_it(world):
    world.bridge(accept_operator=True)
    listener = world.neighbour("listener")
    stops = listener.listen(STOP, LATCHED)
    driver, other = world.client(), world.client()
    for client in (driver, other):
        client.advertise(STOP, "std_msgs/Bool", number=1)
        client.advertise(DRIVE, "geometry_msgs/Twist", number=2)

    def last():
        return deserialize(stops[-1].payload, "std_msgs/msg/Bool").data if stops else None

    other.publish(b'{"data": true}', 1)
    listener.wait(lambda: last() is True, "the stop by one who does not drive")
    for client in (driver, other):  # nobody drives
        client.texts.clear()
        client.publish(b'{"data": false}', 1)
        assert "only the driver" in client.until(lambda c=client: c.text("status"), "the refusal")["message"]

    def release():
        driver.publish(b'{"linear": {"x": 0}, "angular": {"z": 0}}', 2)
        other.publish(b'{"data": false}', 1)
        driver.publish(b'{"data": false}', 1)
        return last() is False

    listener.wait(release, "the release by the driver")
    listener.spin(0.2)
    driver.close()
    other.texts.clear()
    other.publish(b'{"data": true}', 1)
    listener.wait(lambda: last() is True, "the stop again")
    other.publish(b'{"data": false}', 1)
    listener.spin(0.3)
    assert last() is True


# -- what no client can do to it -----------------------------------------------------------------------


def test_a_stalled_loop_or_viewer_never_holds_the_node_up_and_what_is_dropped_is_counted(world):
    """What hung foxglove-sdk 0.30.3 for good: here the node only fills queues of a fixed size."""
    bridge = world.bridge()
    out = world.neighbour().publisher("/numbers", String, RELIABLE)
    client = world.client()
    client.subscribe("/numbers")
    wait_for(lambda: out.subscriber_count == 1, "the subscription")
    release = threading.Event()
    bridge.server._loop.call_soon_threadsafe(release.wait, 120)
    try:
        for number in range(100):
            out.publish(String(str(number)))
            wait_for(
                lambda n=number: bridge.server.count > n, "the message at the bridge while its server stands still"
            )
        assert bridge.server.dropped == 100 - 32
    finally:
        release.set()
    client.until(lambda: len(client.messages) == 32, "the newest messages")
    assert [deserialize(m[2], "std_msgs/msg/String").data for m in client.messages] == [str(n) for n in range(68, 100)]
    wait_for(lambda: bridge.diagnoses()["topics"][2]["dropped"] == 68, "the count in the diagnosis")


@pytest.mark.parametrize("frames", ["pings", "texts"])
def test_a_flood_ends_its_own_connection_alone(world, frames):
    world.bridge()
    quiet, loud = world.client(), world.client()
    with pytest.raises(ConnectionClosed):
        for _ in range(100_000):
            loud.socket.ping() if frames == "pings" else loud.send(op="unsubscribe", subscriptionIds=[])
    quiet.send(op="nonsense")
    assert "unknown op" in quiet.until(lambda: quiet.text("status"), "an answer")["message"]


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
        '{"op": "getParameters", "parameterNames": "x"}',
        '{"op": "getParameters", "parameterNames": ["/a/../x.y"], "id": "r"}',
        '{"op": "getParameters", "parameterNames": [], "id": 7}',
        '{"op": "setParameters", "parameters": [{"value": 1}]}',
        '{"op": "advertise", "channels": [{"id": 1}]}',
        '{"op": "advertise", "channels": [{"id": 1, "topic": 2, "encoding": "json", "schemaName": "x"}]}',
        '{"op": "unadvertise", "channelIds": {}}',
        "[" * 30_000,
        b"",
        b"\x09zz",
        struct.pack("<BI", 1, 44) + b"x",
    ],
)
def test_frames_of_any_shape_are_answered_and_the_connection_goes_on(world, frame):
    world.bridge(accept_operator=True)
    client = world.client()
    client.socket.send(frame)
    client.until(lambda: client.text("status"), "the refusal")
    assert client.parameters() == {}


def test_parameters_of_nodes_that_do_not_run_cost_no_look_for_them(world, monkeypatch):
    world.bridge()
    client = world.client()
    monkeypatch.setattr(NodeControl, "get", lambda control: pytest.fail(f"{control.node} was asked"))
    client.send(op="getParameters", parameterNames=[f"/nobody{number}.x" for number in range(500)], id="all")
    client.until(lambda: client.text("parameterValues"), "the answer")
    assert len([t for t in client.texts if "does not run" in t.get("message", "")]) == 500


def test_a_frame_that_is_too_long_ends_the_connection(world):
    world.bridge()
    client = world.client()
    with pytest.raises(ConnectionClosed):
        client.socket.send("x" * 70_000)
        while True:
            client.socket.recv(30)


def test_channels_of_one_client_are_limited(world):
    world.bridge(accept_operator=True)
    client = world.client()
    for number in range(17):
        client.advertise(DRIVE, "geometry_msgs/Twist", number=number)
    assert "more than 16 channels" in client.until(lambda: client.text("status"), "the refusal")["message"]


def test_a_client_that_reads_no_answers_is_let_go(world, monkeypatch):
    monkeypatch.setattr(foxglove_server, "_MAX_TEXTS", 10)
    bridge = world.bridge()
    client = world.client()
    server = bridge.server
    server._loop.call_soon_threadsafe(lambda: [server._tell_client(1, "x", 2) for _ in range(11)])
    with pytest.raises(ConnectionClosed):
        while True:
            client.socket.recv(30)
    wait_for(lambda: not server._clients, "the end of the client")


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
    capabilities = [sdk.Capability.Parameters, sdk.Capability.ConnectionGraph]
    theirs = foxglove.start_server(
        name="Instant IC", host="127.0.0.1", port=0, capabilities=capabilities, server_listener=Listener(),
        context=context,
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
                    channel.log(bytes(cdr_of("hello")), log_time=1)
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


def cdr_of(text):
    from live_nodes import cdr

    return cdr(String(text))


def test_the_graph_changes_by_differences_as_foxgloves_own_server_sends_them():
    from instant_ic.bridge.foxglove_protocol import Graph, graph_update

    empty, full = Graph({}, {}), Graph({"/x": ["t"]}, {"/y": ["e"]})
    assert graph_update(empty, empty) is None
    # As recorded of foxglove-sdk 0.30.3: set /x and /y, then take /y away.
    assert json.loads(graph_update(empty, full)) == {
        "op": "connectionGraphUpdate",
        "publishedTopics": [{"name": "/x", "publisherIds": ["t"]}],
        "subscribedTopics": [{"name": "/y", "subscriberIds": ["e"]}],
        "advertisedServices": [],
        "removedTopics": [],
        "removedServices": [],
    }
    assert json.loads(graph_update(full, Graph({"/x": ["t"]}, {}))) == {
        "op": "connectionGraphUpdate",
        "publishedTopics": [],
        "subscribedTopics": [],
        "advertisedServices": [],
        "removedTopics": ["/y"],
        "removedServices": [],
    }
    both = json.loads(graph_update(Graph({"/x": ["t"]}, {"/x": ["e"]}), Graph({"/x": ["t"]}, {})))
    assert both["subscribedTopics"] == [{"name": "/x", "subscriberIds": []}] and both["removedTopics"] == []
