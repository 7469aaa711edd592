"""The shipped Zenoh files: as they stand, and with their TLS and access-control parts over real links."""

import re
import shutil
import subprocess
import time
from pathlib import Path

import pytest
from live_nodes import LiveNode, Neighbour, wait_for

from instant_ic.bridge.zenoh_outgoing import RosPublisher
from instant_ic.bridge.zenoh_security import beyond_loopback, insecurity
from instant_ic.bridge.zenoh_session import (
    CLIENT_DEFAULTS,
    SESSION_DEFAULTS,
    RosNode,
    RosSession,
    ZenohError,
    load_config,
    open_zenoh,
)
from instant_ic.bus import LATCHED
from instant_ic.bus.registry import list_topics
from instant_ic.config.params import load_file
from instant_ic.experiments.stack import free_port
from instant_ic.msg import String, deserialize, serialize, twist_stamped, type_hash
from instant_ic.util import paths
from nodes.zenoh_gateway import ZenohGatewayConfig, ZenohGatewayNode
from nodes.zenoh_router import ZenohRouterConfig, ZenohRouterNode

zenoh = pytest.importorskip("zenoh")
pytestmark = pytest.mark.xdist_group("zenoh")
STRING = "std_msgs/msg/String"
FILES = ("zenoh_router.json5", "zenoh_robot.json5", "zenoh_station.json5")


def with_tls(name: str) -> str:
    """A shipped file as its first lines say: without the lines that end in "// open", and without the marks."""
    lines = paths.shipped_file("config", name).read_text().splitlines()
    kept = [line for line in lines if not line.rstrip().endswith("// open")]
    return "\n".join(re.sub(r"^//:", "", line) for line in kept)


@pytest.mark.parametrize("name", FILES)
def test_shipped_files_are_zenoh_configurations_with_and_without_tls(name):
    plain = load_config(name)
    secure = zenoh.Config.from_json5(with_tls(name))
    for config in (plain, secure):
        assert config.get_json("scouting/multicast/enabled") == "false"
        assert config.get_json("timestamping/enabled").count("true") == 3
    assert "tls/" in secure.get_json("listen/endpoints") + secure.get_json("connect/endpoints")


def test_gateways_meet_at_a_router_node_by_the_shipped_files(tmp_path_factory):
    endpoint = f"tcp/127.0.0.1:{free_port()}"
    things = []

    def start(node_class, config, name, run_dir):
        things.append(LiveNode(run_dir, node_class, config, name))
        return things[-1]

    robot, station = tmp_path_factory.mktemp("r"), tmp_path_factory.mktemp("r")
    try:
        router = start(ZenohRouterNode, ZenohRouterConfig((endpoint,), "zenoh_router.json5"), "zenoh_router", station)
        for where, name, lists in [
            (robot, "robot", {"publish": ("/x",)}),
            (station, "station", {"subscribe": ("/x",)}),
        ]:
            config = ZenohGatewayConfig("robot1", connect=(endpoint,), session_file=f"zenoh_{name}.json5", **lists)
            start(ZenohGatewayNode, config, "zenoh_gateway", where)
        talker = Neighbour(robot, "talker")
        things.append(talker)
        talker.publisher("/x", String, LATCHED).publish(String("hello"))
        listener = Neighbour(station, "listener")
        things.append(listener)
        heard = listener.listen("/x", LATCHED)
        listener.wait(lambda: heard, "the message")
        assert deserialize(heard[0].payload, STRING).data == "hello"
        wait_for(lambda: "2 peers" in router.told("link"), "both at the router")
    finally:
        for thing in reversed(things):
            thing.close()


# -- when commands may come in -------------------------------------------------------------------------

MTLS = 'root_ca_certificate: "ca.pem", connect_certificate: "a.pem", connect_private_key: "a.key", enable_mtls: true'
QUIET = "scouting: {multicast: {enabled: false}}"


def session_file(mode="client", connect='"tls/r.example:7447"', listen="", tls=MTLS, more=QUIET):
    return zenoh.Config.from_json5(
        f"""{{mode: "{mode}", connect: {{endpoints: [{connect}]}}, listen: {{endpoints: [{listen}]}},
        transport: {{link: {{tls: {{{tls}}}}}}}, {more}}}"""
    )


def test_a_session_with_certificates_on_both_sides_may_carry_commands():
    assert insecurity(session_file()) == ""
    assert insecurity(session_file(connect='"quic/[2001:db8::1]:7447", "tls/r:1"')) == ""
    assert insecurity(zenoh.Config.from_json5(with_tls("zenoh_robot.json5"))) == ""
    both = MTLS + ', listen_certificate: "b.pem", listen_private_key: "b.key"'
    assert insecurity(session_file(listen='"tls/[::]:7448"', tls=both)) == ""
    assert (
        insecurity(session_file("peer", more="scouting: {multicast: {enabled: false}, gossip: {enabled: false}}")) == ""
    )


@pytest.mark.parametrize(
    ("config", "words"),
    [
        ({"connect": '"tcp/r.example:7447"'}, "tcp/r.example:7447 is not encrypted"),
        ({"connect": '"tls/r:7447", "tcp/127.0.0.1:7447"'}, "tcp/127.0.0.1:7447 is not encrypted"),
        ({"connect": '"tls/r:7447#enable_mtls=false"'}, "has its own settings"),
        ({"connect": ""}, "no endpoint"),
        ({"listen": '"tcp/[::]:7448"'}, "tcp/[::]:7448 is not encrypted"),
        ({"listen": '"tls/[::]:7448"'}, "no listen_certificate, listen_private_key"),
        ({"tls": MTLS.replace("true", "false")}, "enable_mtls is not true"),
        ({"tls": MTLS.replace(", enable_mtls: true", "")}, "enable_mtls is not true"),
        ({"tls": MTLS.replace('root_ca_certificate: "ca.pem", ', "")}, "no root_ca_certificate"),
        ({"tls": MTLS + ", verify_name_on_connect: false"}, "verify_name_on_connect"),
        ({"more": "scouting: {multicast: {enabled: true}}"}, "multicast"),
        ({"more": "scouting: {}"}, "multicast"),
        ({"more": QUIET + ", adminspace: {enabled: true, permissions: {write: true}}"}, "adminspace"),
        ({"mode": "peer"}, 'set mode: "client"'),
    ],
)
def test_any_other_session_may_not_and_the_reason_names_the_setting(config, words):
    assert words in insecurity(session_file(**config))


def test_the_shipped_files_without_tls_and_the_defaults_may_not():
    for name in ("zenoh_robot.json5", "zenoh_station.json5"):
        assert insecurity(load_config(name))
    for defaults in (CLIENT_DEFAULTS, SESSION_DEFAULTS):
        assert insecurity(load_config("", ("tls/r.example:7447",), defaults=defaults))


@pytest.mark.parametrize(
    ("endpoint", "stays"),
    [
        ("tcp/127.0.0.1:7447", True),
        ("tcp/[::1]:7447", True),
        ("tcp/localhost:7447", True),
        ("tcp/10.0.0.1:7447", False),
        ("tcp/0.0.0.0:7447", False),
        ("tcp/127.0.0.1.evil.example:7447", False),
        ("udp/127.0.0.1:7447", False),
        ("tcp/127.0.0.1:7447#bind=10.0.0.1", False),
    ],
)
def test_only_a_session_that_stays_within_the_machine_may_do_without(endpoint, stays):
    assert (beyond_loopback(load_config("", (endpoint,), defaults=CLIENT_DEFAULTS)) == "") is stays
    assert beyond_loopback(load_config("", (endpoint,), defaults=SESSION_DEFAULTS))  # a peer: its router names others


def test_the_simulated_fleet_carries_commands_and_a_robot_that_is_started_alike_elsewhere_does_not():
    parameters = load_file(paths.shipped_file("config", "fleet_sim.yaml"), "zenoh_gateway")
    assert parameters["insecure_loopback_commands"].value is True
    assert ZenohGatewayConfig().insecure_loopback_commands is False


# -- TLS and access control ----------------------------------------------------------------------------


def openssl(folder: Path, *words: str) -> None:
    subprocess.run(["openssl", *words], cwd=folder, check=True, capture_output=True, timeout=60)


@pytest.fixture(scope="module")
def certificates(tmp_path_factory):
    """An authority, and certificates by it of a router, two robots and a station, as docs/fleet.md makes them."""
    if shutil.which("openssl") is None:
        pytest.skip("openssl is not installed, and the certificates are made with it")
    folder = tmp_path_factory.mktemp("tls")
    curve = ("-newkey", "ec", "-pkeyopt", "ec_paramgen_curve:P-256", "-nodes")
    openssl(
        folder, "req", "-x509", *curve, "-days", "2", "-subj", "/CN=fleet", "-keyout", "ca.key", "-out", "ca.pem",
        "-addext", "keyUsage=critical,keyCertSign",
    )  # fmt: skip
    (folder / "names.txt").write_text("subjectAltName=DNS:localhost,IP:127.0.0.1\n")
    for name in ("router", "robot1", "robot2", "station"):
        openssl(folder, "req", *curve, "-subj", f"/CN={name}", "-keyout", f"{name}.key", "-out", f"{name}.csr")
        openssl(
            folder, "x509", "-req", "-in", f"{name}.csr", "-CA", "ca.pem", "-CAkey", "ca.key", "-CAcreateserial",
            "-days", "2", "-extfile", "names.txt", "-out", f"{name}.pem",
        )  # fmt: skip
    return folder


@pytest.fixture
def secure(certificates):
    """Makes sessions by the shipped files with TLS; the router runs."""
    port = free_port()
    opened = []

    def config(name: str, who: str):
        text = with_tls(name).replace("/etc/zenoh", str(certificates)).replace("robot1.pem", f"{who}.pem")
        text = text.replace("robot1.key", f"{who}.key").replace("router.example:7447", f"127.0.0.1:{port}")
        return zenoh.Config.from_json5(text.replace("tls/[::]:7447", f"tls/127.0.0.1:{port}"))

    class Secure:
        endpoint = f"127.0.0.1:{port}"

        def session(self, name, who):
            opened.append(RosSession(config(f"zenoh_{name}.json5", who)))
            return opened[-1]

        def keep(self, thing):
            opened.append(thing)
            return thing

    opened.append(open_zenoh(config("zenoh_router.json5", "robot1")))
    yield Secure()
    for thing in reversed(opened):
        thing.close()


def put_until(publisher, condition, what, timeout_s=30.0):
    def once():
        publisher.put(bytes(serialize(String("x"))), time.time_ns())
        time.sleep(0.02)
        return condition()

    return wait_for(once, what, timeout_s)


def test_access_control_lets_a_robot_into_its_own_namespace_and_a_station_everywhere(secure):
    robot, other, station = (secure.session(*who) for who in (
        ("robot", "robot1"), ("robot", "robot2"), ("station", "station"),
    ))  # fmt: skip
    graph = {}
    station.watch(lambda token, alive: graph.update({token: alive}))
    heard = []
    hash_ = type_hash(STRING)
    for topic in ("robot1/x", "robot2/x"):
        station.zenoh.declare_subscriber(f"0/{topic}/**", lambda s: heard.append(str(s.key_expr)))
    own = RosPublisher(RosNode(robot, "/robot1", "node"), "/robot1/x", STRING, hash_)
    foreign = RosPublisher(RosNode(robot, "/robot2", "spoof"), "/robot2/x", STRING, hash_)
    stranger = RosPublisher(RosNode(other, "/robot2", "node"), "/robot2/x", STRING, hash_)
    put_until(own, lambda: heard, "robot1's message at the station")
    for _ in range(20):
        foreign.put(b"x", 1)
        stranger.put(b"x", 1)  # a certificate of the fleet, but no rule
    put_until(own, lambda: len(heard) > 5, "more of robot1's messages")
    assert {key.split("/")[1] for key in heard} == {"robot1"}
    wait_for(lambda: any(t.topic == "/robot1/x" for t in graph), "robot1's topic in the graph")
    assert {t.namespace for t in graph} == {"/robot1"}
    # Commands: the station reaches the robot.
    back = []
    robot.zenoh.declare_subscriber("0/robot1/operator/**", back.append)
    command = RosPublisher(RosNode(station, "/robot1", "console"), "/robot1/operator/x", STRING, hash_)
    put_until(command, lambda: back, "the station's command at the robot")


def test_latched_values_reach_late_stations_through_access_control(secure, certificates, tmp_path_factory):
    robot = secure.session("robot", "robot1")
    publisher = RosPublisher(RosNode(robot, "/robot1", "slam"), "/robot1/map", STRING, type_hash(STRING), LATCHED)
    publisher.put(bytes(serialize(String("the map"))), time.time_ns())
    wait_for(lambda: robot.links()[0], "the router")
    text = with_tls("zenoh_station.json5").replace("/etc/zenoh", str(certificates))
    file = tmp_path_factory.mktemp("c") / "station.json5"
    file.write_text(text.replace("router.example:7447", secure.endpoint))
    run_dir = tmp_path_factory.mktemp("r")
    config = ZenohGatewayConfig("robot1", session_file=str(file), subscribe=("/map",))
    secure.keep(LiveNode(run_dir, ZenohGatewayNode, config, "zenoh_gateway"))
    listener = secure.keep(Neighbour(run_dir, "listener"))
    heard = listener.listen("/map", LATCHED)
    listener.wait(lambda: heard, "the latched value")
    assert deserialize(heard[0].payload, STRING).data == "the map"
    assert "/map" in {info.topic for info in list_topics(run_dir)}


def test_commands_come_in_over_tls_with_certificates(secure, certificates, tmp_path_factory):
    text = with_tls("zenoh_robot.json5").replace("/etc/zenoh", str(certificates))
    file = tmp_path_factory.mktemp("c") / "robot.json5"
    file.write_text(text.replace("router.example:7447", secure.endpoint))
    run_dir = tmp_path_factory.mktemp("r")
    config = ZenohGatewayConfig("robot1", session_file=str(file), commands=("/operator/cmd_vel", "/operator/estop"))
    gateway = secure.keep(LiveNode(run_dir, ZenohGatewayNode, config, "zenoh_gateway"))
    wait_for(lambda: "accepted over TLS" in gateway.told("commands"), "the diagnosis")
    listener = secure.keep(Neighbour(run_dir, "listener"))
    driven = listener.listen("/operator/cmd_vel")
    name = "geometry_msgs/msg/TwistStamped"
    station = RosNode(secure.session("station", "station"), "/robot1", "console")
    drive = RosPublisher(station, "/robot1/operator/cmd_vel", name, type_hash(name))

    def command():
        drive.put(bytes(serialize(twist_stamped(0.1, 0.0, time.time_ns()))), time.time_ns())
        return driven

    listener.wait(command, "the command")


def test_without_a_certificate_nobody_gets_in(secure, certificates, tmp_path):
    text = with_tls("zenoh_robot.json5").replace("router.example:7447", secure.endpoint)
    text = text.replace("/etc/zenoh/ca.pem", str(certificates / "ca.pem"))
    text = "\n".join(line for line in text.splitlines() if "connect_" not in line and "enable_mtls" not in line)
    inside = secure.session("robot", "robot1")
    wait_for(lambda: inside.links()[0], "the router, for the robot with a certificate")
    with pytest.raises(ZenohError, match="Unable to connect"):
        RosSession(zenoh.Config.from_json5(text))
