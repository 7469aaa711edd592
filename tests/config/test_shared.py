"""Shared values: one `/**` section for all nodes, contradictions refused, the shipped files consistent."""

from pathlib import Path

import pytest

from instant_ic.bus.node_files import node_class
from instant_ic.cli.main import main
from instant_ic.config import params
from instant_ic.config.parameter_info import parameter_infos, plain
from instant_ic.launch import read_launch_file
from instant_ic.launch.parameters import check_parameters
from instant_ic.util import paths

SHARED = "/**:\n  ros__parameters:\n    limits: {max_linear_m_s: 0.3}\n"
STACK = """launch:
- set_parameters_from_file: {{filename: robot.yaml}}
- node: {{exec: virtual_robot, param: [{own}]}}
- node: {{exec: navigator}}
"""


def problems(tmp_path: Path, own: str = "", robot: str = SHARED, more: str = "", stack: str = STACK) -> list[str]:
    (tmp_path / "robot.yaml").write_text(robot)
    (tmp_path / "own.yaml").write_text(more)
    (tmp_path / "stack.yaml").write_text(stack.format(own=own))
    return check_parameters(read_launch_file(tmp_path / "stack.yaml").nodes)


OVERRIDE = "virtual_robot:\n  ros__parameters:\n    limits:\n      max_linear_m_s: 0.4\n"


def test_a_node_takes_the_shared_values_that_it_has(tmp_path: Path) -> None:
    assert problems(tmp_path, robot=SHARED + "    camera_mount: {xyz: [0, 0, 1]}\n    use_sim_time: true\n") == []
    values = params.load_file(tmp_path / "robot.yaml", "navigator")
    config = params.configure(node_class("navigator").config_class(), values)[0]
    assert config.limits.max_linear_m_s == 0.3 and not hasattr(config, "camera_mount")


def test_a_file_that_contradicts_a_shared_value_is_refused_with_both_places(tmp_path: Path) -> None:
    (found,) = problems(tmp_path, own="{from: own.yaml}", more=OVERRIDE)
    assert found.startswith(f"{tmp_path}/own.yaml:4: limits.max_linear_m_s 0.4 contradicts {tmp_path}/robot.yaml:3")
    assert "(node virtual_robot)" in found
    (found,) = problems(tmp_path, own="{from: own.yaml}", more=SHARED.replace("0.3", "0.4"))
    assert found.startswith(f"{tmp_path}/robot.yaml:3: limits.max_linear_m_s 0.3 contradicts {tmp_path}/own.yaml:3")


def test_an_equal_value_and_an_explicit_exception_are_accepted(tmp_path: Path) -> None:
    assert problems(tmp_path, own="{from: own.yaml}", more=OVERRIDE.replace("0.4", "0.3")) == []
    assert problems(tmp_path, own="{name: limits.max_linear_m_s, value: 0.4}") == []  # on the node's own entry
    assert problems(tmp_path, robot=SHARED + OVERRIDE) == []  # beside the shared value


def test_a_node_without_the_file_is_refused(tmp_path: Path) -> None:
    stack = "launch:\n- node: {{exec: virtual_robot, param: [{{from: robot.yaml}}]}}\n- node: {{exec: navigator}}\n"
    (found,) = problems(tmp_path, stack=stack)
    assert "stack.yaml:3: node navigator: limits.max_linear_m_s is 0.5, its default" in found


def test_a_shared_value_that_no_node_has_is_a_mistake(tmp_path: Path) -> None:
    (found,) = problems(tmp_path, robot=SHARED + "    foot_print: {length_m: 1}\n")
    assert found == f"{tmp_path}/robot.yaml:4: no node has a parameter 'foot_print.length_m'"


def test_shipped_files_have_no_mistakes_and_each_value_a_comment() -> None:
    names = paths.node_names()
    renamed = {"operator_recorder": "bag_recorder", "fleet_gateway": "zenoh_gateway"}
    wanted = {  # what is not the default of the code
        ("nerf", "space.geometry.body_below_deg"),
        ("nerf", "space.source"),
        *(("host_bridge", key) for key in ("to_station", "to_robot")),
        *(("operator_recorder", key) for key in ("path", "snapshot", "snapshot_seconds", "max_cache_mb", "exclude")),
        ("operator_recorder", "discovery_period_s"),
        *(("zenoh_gateway", key) for key in ("publish", "subscribe", "commands")),
        ("fleet_gateway", "subscribe"),
    }
    different, sections = set(), 0
    for file in paths.share_dir("config").glob("*.yaml"):
        if file.name in ("topics.yaml", "fleet_sim.yaml"):
            continue
        for section, values in params.load_sections(file).items():
            nodes = names if section == params.SHARED else [renamed.get(section, section)]
            infos = [{i.name: i.default for i in parameter_infos(node_class(n).config_class())} for n in nodes]
            sections += 1
            for key, value in values.items():
                different |= {(section, key) for known in infos if key in known and known[key] != plain(value.value)}
                line = file.read_text().splitlines()[int(value.where.rpartition(":")[2]) - 1]
                assert "#" in line or isinstance(value.value, list), value.where
    assert different == wanted and sections > 10


def test_show_names_the_origin_of_each_value(capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["config", "show", "vlp16_driver", "--launch", "robot", "lidar_port:=3000"]) == 0
    rows = {line.split()[0]: line.split()[1:] for line in capsys.readouterr().out.splitlines()[1:]}
    assert rows["port"][0] == "3000" and "launch/robot.yaml:" in rows["port"][1]
    assert "config/robot.yaml:" in rows["lidar_mount.xyz"][-1] and rows["silence_s"] == ["2.0", "default"]
    assert main(["config", "show", "vlp16_driver", "--changed"]) == 0
    assert len(capsys.readouterr().out.splitlines()) == 1
    assert main(["config", "show", "vlp17_driver"]) == 1
    assert "did you mean 'vlp16_driver'?" in capsys.readouterr().err
