"""What the nodes would refuse is told before anything starts, at its place, all at once."""

import os
import time
from collections.abc import Callable
from pathlib import Path

import pytest

from instant_ic.cli.main import main
from instant_ic.launch import find_launch_file, parameters, read_launch_file
from instant_ic.launch.parameters import (
    ParameterCheckError,
    check_parameters,
    check_parameters_apart,
    existing_bags,
)

STACK = """launch:
- node:
    exec: virtual_robot
    param:
    - from: params.yaml
    - {name: nice, value: 3}
    - {name: no_such, value: 1}
- node: {exec: vlp16_driver, name: lidar, param: [{name: port, value: high, type: str}, {name: nice, value: 99}]}
- node: {exec: vlp16_driver, name: other, remap: [{from: scan, to: ""}]}
- node: {exec: own.py}
"""


@pytest.fixture
def stack(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    monkeypatch.chdir(tmp_path)
    (tmp_path / "params.yaml").write_text("virtual_robot:\n  ros__parameters:\n    rate_hz: fast\n    nothing: 1\n")
    (tmp_path / "stack.yaml").write_text(STACK)
    (tmp_path / "own.py").touch()
    return tmp_path / "stack.yaml"


def test_every_mistake_is_told_at_the_place_where_it_stands(stack: Path) -> None:
    found = check_parameters(read_launch_file(stack).nodes)
    params = stack.with_name("params.yaml")
    expected = [
        (f"{params}:3: ", "rate_hz", "(node virtual_robot)"),
        (f"{params}:4: ", "unknown parameter 'nothing'", "(node virtual_robot)"),
        ("stack.yaml:7: ", "unknown parameter 'no_such'", "(node virtual_robot)"),
        ("stack.yaml:8: ", "port must be int (got 'high')", "(node lidar)"),
        ("stack.yaml:8: ", "nice", "(node lidar)"),
        (f"{stack}:9: ", "expected from:=to", "node other"),
    ]
    assert len(found) == len(expected), found
    for start, middle, end in expected:
        assert any(text.startswith(start) and middle in text and end in text for text in found), (start, middle, found)


def test_nothing_starts_while_a_parameter_is_wrong(stack: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["launch", str(stack), "--run-dir", str(stack.parent / "r")]) == 2
    assert "unknown parameter 'no_such'" in capsys.readouterr().err
    assert not (stack.parent / "r").exists()


@pytest.mark.parametrize(
    ("check", "message"),
    [(lambda nodes: time.sleep(60), "could not be checked within 0 s"), (lambda nodes: os._exit(3), "crashed")],
)
def test_a_check_that_does_not_end_is_reported(
    stack: Path, monkeypatch: pytest.MonkeyPatch, check: Callable[[object], object], message: str
) -> None:
    """A module may wait for something while it is imported, or be built for another CPU."""
    monkeypatch.setattr(parameters, "CHECK_TIMEOUT_S", 0.2 if "within" in message else 60.0)
    monkeypatch.setattr(parameters, "check_parameters", check)
    with pytest.raises(ParameterCheckError, match=message):
        check_parameters_apart(read_launch_file(stack).nodes)


@pytest.mark.parametrize(
    "words", [["F", "--check", "n:=one"], ["F", "n:=one", "--check"], ["--check", "F", "n:=one"], ["F", "--check"]]
)
def test_options_and_arguments_stand_in_any_order(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], words: list[str]
) -> None:
    file = tmp_path / "stack.yaml"
    (tmp_path / "own.py").touch()
    file.write_text("launch:\n- arg: {name: n, default: two}\n- node: {exec: own.py, unless: $(eval n == 'one')}\n")
    assert main(["launch", *(str(file) if word == "F" else word for word in words)]) == 0
    assert f"{0 if 'n:=one' in words else 1} nodes, no errors" in capsys.readouterr().out


def test_a_recording_into_an_existing_folder_is_a_mistake(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    (tmp_path / "drive").mkdir()

    def problems(**arguments: str) -> list[str]:
        return existing_bags(read_launch_file(find_launch_file("sim"), {"recorder": "false", **arguments}).nodes)

    assert problems(record="drive") == [f"{tmp_path / 'drive'} exists: record into a new folder (node bag_recorder)"]
    assert problems(record="new", snapshots="drive") == []  # snapshots may share a folder
