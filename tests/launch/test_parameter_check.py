"""What the nodes would refuse is told before anything starts, at its place, all at once; cheaply the second time."""

import json
from pathlib import Path

import pytest

from instant_ic.cli.main import main
from instant_ic.launch import parameters, read_launch_file
from instant_ic.launch.parameters import ParameterCheckError, check_parameters, check_parameters_quickly

STACK = """launch:
- node:
    exec: virtual_robot
    param:
    - from: params.yaml
    - {name: nice, value: 3}
    - {name: no_such, value: 1}
- node: {exec: vlp16_driver, name: lidar, param: [{name: port, value: high, type: str}, {name: nice, value: 99}]}
- node: {exec: vlp16_driver, name: other, args: --no-such-option 3}
- executable: {cmd: echo}
"""


@pytest.fixture
def stack(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "cache"))
    (tmp_path / "params.yaml").write_text("virtual_robot:\n  ros__parameters:\n    rate_hz: fast\n    nothing: 1\n")
    (tmp_path / "stack.yaml").write_text(STACK)
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
        (f"{stack}:9: ", "unknown arguments: --no-such-option 3", "node other"),
    ]
    assert len(found) == len(expected), found
    for start, middle, end in expected:
        assert any(text.startswith(start) and middle in text and end in text for text in found), (start, middle, found)


def test_nothing_starts_while_a_parameter_is_wrong(stack: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["launch", str(stack), "--run-dir", str(stack.parent / "r")]) == 2
    assert "unknown parameter 'no_such'" in capsys.readouterr().err
    assert not (stack.parent / "r").exists()


def test_what_is_known_to_be_good_is_not_checked_again(stack: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    checked: list[list[str]] = []

    def check(nodes: list[dict[str, str]], related: list[dict[str, str]]) -> list[tuple[str, str]]:
        checked.append([node["label"] for node in nodes])
        return [("other", "bad")] if "other" in checked[-1] else []

    monkeypatch.setattr(parameters, "_check_apart", check)
    nodes = read_launch_file(stack).nodes
    assert check_parameters_quickly(nodes) == ["bad"]
    assert check_parameters_quickly(nodes) == ["bad"]
    stack.with_name("params.yaml").write_text("virtual_robot:\n  ros__parameters: {rate_hz: 20}\n")
    check_parameters_quickly(nodes)
    monkeypatch.setattr(parameters, "_package_state", lambda: "another version")
    check_parameters_quickly(nodes[:2])
    check_parameters_quickly(nodes[:2])
    assert checked == [
        ["virtual_robot", "lidar", "other"],
        ["other"],  # only what is good is remembered
        ["virtual_robot", "other"],  # its parameter file is another now
        ["virtual_robot", "lidar"],  # the package is another now
    ]


@pytest.mark.parametrize("content", ["", "{}", "[1, null]", "\x00"])
def test_a_broken_cache_costs_time_and_nothing_else(stack: Path, content: str) -> None:
    cache = stack.with_name("cache.json")
    cache.write_text(content)
    found = check_parameters_quickly(read_launch_file(stack).nodes, cache)  # in a process of its own
    assert sorted(found) == sorted(check_parameters(read_launch_file(stack).nodes))
    assert json.loads(cache.read_text() or "[]") == []  # none of them is good


def test_a_cache_that_cannot_be_written(stack: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(parameters, "_check_apart", lambda nodes, related: [])
    assert check_parameters_quickly(read_launch_file(stack).nodes, Path("/proc/no/cache.json")) == []


def test_a_check_that_does_not_end_is_told(stack: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(parameters, "_CHECK_TIMEOUT_S", 0.01)
    with pytest.raises(ParameterCheckError, match="could not be checked within"):
        check_parameters_quickly(read_launch_file(stack).nodes)


@pytest.mark.parametrize(
    "words", [["F", "--check", "n:=one"], ["F", "n:=one", "--check"], ["--check", "F", "n:=one"], ["F", "--check"]]
)
def test_options_and_arguments_stand_in_any_order(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], words: list[str]
) -> None:
    file = tmp_path / "stack.yaml"
    file.write_text(
        "launch:\n- arg: {name: n, default: two}\n- executable: {cmd: echo, unless: $(equals $(var n) one)}\n"
    )
    assert main(["launch", *(str(file) if word == "F" else word for word in words)]) == 0
    assert f"{0 if 'n:=one' in words else 1} nodes, no errors" in capsys.readouterr().out


def test_a_recording_into_an_existing_folder_is_refused_before_the_start(
    stack: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    words = ["launch", "sim", "--run-dir", str(stack.parent / "r"), "recorder:=false"]
    (stack.parent / "drive").mkdir()
    assert main([*words, "record:=drive"]) == 2
    assert capsys.readouterr().err == (
        f"ic: {stack.parent / 'drive'} exists: record into a new folder (node bag_recorder)\n"
    )
    assert not (stack.parent / "r").exists()
    assert main([*words, "--check", "record:=new", "snapshots:=drive"]) == 0  # snapshots may share a folder
