"""The shipped launch files: every node's parameters are accepted, arguments arrive where they should."""

from pathlib import Path

import pytest
import yaml

from instant_ic.launch import find_launch_file, read_arguments, read_launch_file
from instant_ic.launch.parameters import check_parameters
from instant_ic.sim.real_time import SERIAL_LINK
from instant_ic.util import paths

NAMES = sorted(file.stem for file in paths.share_dir("launch").glob("*.yaml"))
NEEDED = {"replay": {"bag": "drive"}, "fleet_robot": {"robot_name": "robot4"}}
EVERYTHING = {
    "replay": {"bag": "drive", "record": "again", "nerf": "true"},
    "sim": {"panorama": "photo.jpg", "pcap": "drive.pcap", "record": "drive", "trust_depth": "true"},
    "robot": {"camera_url": "http://10.0.0.9", "lidar_port": "3000", "serial_port": "/dev/ttyUSB1", "record": "x"}
    | {"robot_name": "robot1", "foxglove": "true", "foxglove_port": "9999"},
    "full": {"serial_port": "/dev/ttyUSB1", "console_port": "9000", "record": "x"},
    "station": {"vspace_source": "mesh", "vspace_mesh": "/house.glb", "vspace_mesh_pose": "-4.7,2,0,90"}
    | {"console_port": "9000", "robot_name": "robot1", "router": "tcp/10.0.0.1:7447", "foxglove": "true"},
    "fleet_robot": {"robot_name": "robot4", "address": "127.0.0.5", "router": "tcp/10.0.0.1:7447"},
    "fleet": {"robot": "robot3", "vspace": "true", "router_port": "7448"},
}
PERCEPTION = {"grid_slam", "depth_estimator", "depth_scaler"}
ROBOT = {"theta_camera", "vlp16_driver", "crawler_base", "grid_slam", "virtual_robot", "navigator", "arbiter"}
STATION = {"depth_estimator", "depth_scaler", "nerf", "console", "operator_recorder"}


def nodes(name: str, **arguments: str) -> dict[str, str]:
    """Command line of each node, as one text."""
    given = {**NEEDED.get(name, {}), **arguments}
    description = read_launch_file(find_launch_file(name), given, Path("/run/here"))
    return {node.name: " ".join(node.command) for node in description.nodes}


@pytest.mark.parametrize("name", NAMES)
@pytest.mark.parametrize("given", [NEEDED, EVERYTHING], ids=["defaults", "everything"])
def test_every_node_accepts_its_parameters(name: str, given: dict[str, dict[str, str]]) -> None:
    description = read_launch_file(find_launch_file(name), given.get(name, {}))
    assert check_parameters(description.nodes) == []


@pytest.mark.parametrize("name", NAMES)
def test_every_argument_is_described(name: str) -> None:
    for argument in read_arguments(find_launch_file(name)):
        assert argument.description, argument.name


def test_which_nodes_run() -> None:
    assert set(nodes("robot")) == ROBOT
    assert set(nodes("station")) == STATION
    assert set(nodes("full")) == ROBOT | STATION
    assert set(nodes("sim")) == ROBOT | STATION | {"simulator"}
    assert set(nodes("full", recorder="false")) == (ROBOT | STATION) - {"operator_recorder"}
    without = {"console", "nerf", "operator_recorder"}
    assert set(nodes("sim", headless="true", vspace="false")) == (ROBOT | STATION | {"simulator"}) - without
    assert set(nodes("sim", snapshots="snaps")) == ROBOT | STATION | {"simulator", "snapshot_recorder"}
    assert set(nodes("sim", record="drive")) == ROBOT | STATION | {"simulator", "bag_recorder"}
    assert set(nodes("replay")) == PERCEPTION | {"bag_player"}
    assert set(nodes("replay", nerf="true", record="again")) == PERCEPTION | {"bag_player", "bag_recorder", "nerf"}


def test_the_pages_recorder_keeps_the_last_minute_and_writes_where_it_is_told() -> None:
    assert " path:=" not in nodes("full")["operator_recorder"]
    assert "/drives" in nodes("full", recordings="drives")["operator_recorder"]
    file = yaml.safe_load(paths.shipped_file("config", "console.yaml").read_text())["operator_recorder"]
    assert file["ros__parameters"]["snapshot"] is True and file["ros__parameters"]["snapshot_seconds"] == 60.0


def test_simulated_devices_and_drivers_meet() -> None:
    found = nodes("sim", camera_port="9001", lidar_port="9002", lidar_position_port="9003", console_port="9004")
    assert "camera.port:=9001" in found["simulator"] and "url:=http://127.0.0.1:9001" in found["theta_camera"]
    assert "lidar.data_port:=9002" in found["simulator"] and " port:=9002" in found["vlp16_driver"]
    assert "lidar.position_port:=9003" in found["simulator"] and "position_port:=9003" in found["vlp16_driver"]
    assert "host:=127.0.0.1" in found["vlp16_driver"]
    assert "roboclaw.port:=/run/here/dev/roboclaw" in found["crawler_base"]
    assert "server.port:=9004" in found["console"]
    assert SERIAL_LINK == "roboclaw"


def test_depth_is_taken_unchecked_only_where_it_is_asked_for() -> None:
    assert "scaler.method:=as_estimated" in nodes("sim", trust_depth="true")["depth_scaler"]
    assert "scaler.method:=as_estimated" in nodes("station", trust_depth="true")["depth_scaler"]
    for name in NAMES:
        assert "as_estimated" not in nodes(name).get("depth_scaler", "")
    assert all("trust_depth" not in {a.name for a in read_arguments(find_launch_file(n))} for n in ("robot", "full"))


def test_only_simulated_robots_are_driven_and_watched_without_a_token() -> None:
    for name in set(NAMES) - {"replay", "fleet_robot", "sim_robot"}:
        simulated = {node for node, command in nodes(name).items() if "server.access.simulated:=true" in command}
        assert simulated == ({"console"} if name in ("sim", "fleet") else set()), name
    assert "simulated" not in nodes("fleet", robot="robot4")["console"]  # none of the three
    assert "simulated" not in {argument.name for argument in read_arguments(find_launch_file("full"))}
    for name in ("sim", "robot", "station", "full"):
        assert ("simulated:=true" in nodes(name, foxglove="true")["foxglove_bridge"]) is (name == "sim")


def test_lidar_alone_starts_no_network() -> None:
    for name in ("station", "full", "sim", "replay"):
        with_network, without = nodes(name), nodes(name, depth_source="lidar")
        assert set(with_network) - set(without) == {"depth_estimator"}
        assert " source:=" not in with_network["depth_scaler"] and " source:=lidar" in without["depth_scaler"]
        assert " source:=network" in nodes(name, depth_source="network")["depth_scaler"]
    assert "depth_estimator" not in nodes("replay", depth_source="lidar")["bag_player"]


def test_a_scanned_place_as_the_virtual_space() -> None:
    given = {"vspace_source": "mesh", "vspace_mesh": "/scans/my house.glb", "vspace_mesh_pose": "-4.7,2,0,90"}
    for name in ("station", "sim"):
        assert "space." not in nodes(name)["nerf"]
        command = nodes(name, **given)["nerf"]
        assert "space.source:=mesh" in command and "space.mesh:=/scans/my house.glb" in command


def test_robot_leaves_to_the_configuration_what_is_not_given() -> None:
    found = nodes("robot")
    assert "url:=" not in found["theta_camera"] and "roboclaw.port" not in found["crawler_base"]
    assert "roboclaw.port:=/dev/ttyUSB1" in nodes("robot", serial_port="/dev/ttyUSB1")["crawler_base"]


def test_replay_runs_on_the_bags_clock() -> None:
    found = nodes("replay", nerf="true")
    assert all("use_sim_time:=true" in command for command in found.values())
    assert "wait_for:=[grid_slam, depth_estimator, depth_scaler, nerf]" in found["bag_player"]
    assert "wait_for:=[grid_slam, depth_estimator, depth_scaler]" in nodes("replay")["bag_player"]
