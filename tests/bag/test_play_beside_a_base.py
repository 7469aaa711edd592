"""A bag holds what drove a robot: beside a running base it must not drive one again (review, finding 2)."""

import time

import pytest

from instant_ic.bag import BagWriter
from instant_ic.bus import SENSOR, NodeError, registry
from instant_ic.bus.clock import ManualClock
from instant_ic.bus.local_transport import LocalTransport
from instant_ic.cli import bag_run
from instant_ic.cli.main import main
from instant_ic.msg import Float32, TwistStamped, serialize, twist_stamped, type_name
from nodes.bag_player import BagPlayerConfig, BagPlayerNode

S = 1_000_000_000
DANGEROUS = (
    "/cmd_vel",
    "/nav/cmd_vel",
    "/operator/cmd_vel",
    "/operator/estop",
    "/robot/estop",
    "/ic/state",
    "/vbot/odom",
    "/initialpose",
    "/slam/integrity",
)


@pytest.fixture
def run_dir(tmp_path_factory):
    return registry.prepare(tmp_path_factory.mktemp("r"))


@pytest.fixture
def bag(tmp_path):
    """One harmless topic and all that a robot acts on."""

    def write(*topics):
        folder = tmp_path / f"bag{len(list(tmp_path.iterdir()))}"
        with BagWriter(folder) as writer:
            for topic in topics:
                message = Float32(1.0) if topic == "/played" else twist_stamped(0.3, 0.0, 1)
                kind = Float32 if topic == "/played" else TwistStamped
                writer.write(topic, type_name(kind), bytes(serialize(message)), 1_000 * S, SENSOR)
        return str(folder)

    return write


@pytest.fixture
def base(run_dir):
    """Puts a live base into the registry, under a name and in a namespace."""
    claims = []

    def start(name="crawler_base", namespace="", executable="crawler_base", command="/cmd_vel", publishes=()):
        claims.append(registry.Claim(run_dir / "nodes" / name, f"node {name}"))
        entry = {"name": name, "executable": executable, "pid": 1, "started_ns": 1, "params": {}}
        entry["publishes"] = dict.fromkeys(publishes, "any/msg/Type")
        claims[-1].write({**entry, "subscribes": {f"{namespace}{command}": "geometry_msgs/msg/TwistStamped"}})
        return claims[-1]

    yield start
    for claim in claims:
        claim.release()


@pytest.fixture
def player(run_dir):
    """A player as far as its setup, ended afterwards."""
    nodes = []

    def start(bag, namespace="", remaps=None, **parameters):
        clock = ManualClock()
        transport = LocalTransport(run_dir, f"bag_player{len(nodes)}", clock.now_ns)
        config = BagPlayerConfig(bag=bag, start_paused=True, delay_s=0.0, **parameters)
        node = BagPlayerNode(
            config, transport, clock, f"bag_player{len(nodes)}", use_sim_time=True, namespace=namespace, remaps=remaps
        )
        nodes.append(node)
        node.start()
        return node

    yield start
    for node in nodes:
        node.stop()
        node.close()


def topics(run_dir):
    return {info.topic for info in registry.list_topics(run_dir)} - {"/clock", "/rosout", "/diagnostics", "/heartbeat"}


@pytest.mark.parametrize("topic", ["/cmd_vel", "/operator/estop", "/slam/integrity"])
def test_what_a_robot_acts_on_is_not_played_beside_a_running_base(bag, base, player, run_dir, topic):
    base()
    with pytest.raises(NodeError) as refused:
        player(bag("/played", topic))
    words = str(refused.value)
    assert f": {topic} would reach the robot of crawler_base" in words and "--force" in words
    assert f"-x {topic}" in words and f"--remap {topic}:=/bag{topic}" in words
    assert topics(run_dir).isdisjoint({topic, "/played"})


def test_it_is_played_without_a_base_and_where_it_is_left_out_renamed_or_forced(bag, base, player, run_dir):
    all_of_it = bag("/played", *DANGEROUS)
    base("other", executable="grid_slam")
    player(all_of_it)
    base("renamed")
    player(all_of_it, exclude=DANGEROUS)
    player(bag("/cmd_vel"), remaps={"/cmd_vel": "/bag/cmd_vel"})
    assert "/bag/cmd_vel" in topics(run_dir)
    player(all_of_it, force=True)
    with pytest.raises(NodeError, match=r"/cmd_vel.*robot of renamed"):
        player(bag("/cmd_vel"))


def test_what_a_live_node_publishes_is_not_played_beside_a_running_base(bag, base, player):
    base()
    player(bag("/scan"))  # nobody else publishes it: one node is tried with a bag
    base("vlp16_driver", executable="vlp16_driver", publishes=("/scan", "/rosout"))
    with pytest.raises(NodeError, match=r"/scan would reach the robot"):
        player(bag("/scan"))
    player(bag("/rosout", "/played"))


@pytest.mark.parametrize("bridge", ["host_bridge", "zenoh_gateway"])
def test_a_bridge_passes_no_emergency_stop_release_of_a_bag_to_a_robot_elsewhere(bag, base, player, bridge):
    base("link", namespace="/robot1", executable=bridge, command="/operator/estop", publishes=("/scan",))
    player(bag("/operator/estop", "/scan"))  # not in the robot's namespace, or not sent on
    with pytest.raises(NodeError, match="/operator/estop would reach the robot of link"):
        player(bag("/played", "/operator/estop"), namespace="robot1")
    player(bag("/played", "/operator/estop"), namespace="robot1", force=True)


@pytest.mark.parametrize("topic", ["/view/shown"])
def test_a_bridge_passes_no_old_report_of_the_page_to_a_robot_elsewhere(bag, base, player, topic):
    base("link", executable="host_bridge", command=topic)
    with pytest.raises(NodeError, match=f"{topic} would reach the robot of link"):
        player(bag("/played", topic))


def test_a_renamed_player_does_not_take_itself_for_a_live_node(bag, base, player):
    base()
    node = player(bag("/played"))
    assert node.node_name != type(node).name
    node.check_base()


def test_namespaces_and_renamed_commands_count(bag, base, player):
    base(namespace="/robot1")
    with pytest.raises(NodeError, match="would reach the robot"):
        player(bag("/cmd_vel"))
    with pytest.raises(NodeError, match="would reach the robot"):
        player(bag("/operator/cmd_vel"), namespace="robot1")
    with pytest.raises(NodeError, match="would reach the robot"):
        player(bag("/played"), remaps={"/played": "/robot1/operator/cmd_vel"})
    base("second", command="/drive")
    with pytest.raises(NodeError, match="robot of second"):
        player(bag("/played"), remaps={"/played": "/drive"})
    player(bag("/cmd_vel"), namespace="bag")


def test_a_player_ends_when_a_base_starts_beside_it(bag, base, player):
    node = player(bag("/cmd_vel"))
    base()
    node.player.resume()
    deadline_s = time.monotonic() + 60
    while not node.stopping:
        assert time.monotonic() < deadline_s, "the player goes on"
        time.sleep(0.01)
    assert "would reach the robot of crawler_base" in node._failed and node.player.sent <= 1
    with pytest.raises(SystemExit):
        node.teardown()
    node._failed = ""


def test_ic_bag_play_refuses_and_force_is_handed_on(bag, base, run_dir, monkeypatch, caplog):
    base()
    monkeypatch.setenv("INSTANT_IC_RUN_DIR", str(run_dir))
    folder = bag("/played", "/cmd_vel")
    assert main(["bag", "play", folder]) == 1
    assert "would reach the robot of crawler_base" in caplog.text
    words = []
    monkeypatch.setattr(bag_run, "run_node", lambda node, given: words.extend(given) or 0)
    assert main(["bag", "play", folder, "--force"]) == 0
    assert "force:=true" in words
