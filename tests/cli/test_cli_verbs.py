"""Behaviour that all commands of ``ic`` share; ``ic launch``, ``ic run`` and ``ic replay`` on the command line."""

import os
import re
import subprocess
import sys
from importlib import metadata
from pathlib import Path

import pytest

from instant_ic.cli.main import build_parser


@pytest.fixture(autouse=True)
def in_run_dir(tmp_path, monkeypatch):
    monkeypatch.setenv("INSTANT_IC_RUN_DIR", str(tmp_path / "r"))
    monkeypatch.chdir(tmp_path)


def test_the_version_is_printed(ic):
    assert ic("--version") == (0, f"ic {metadata.version('instant-ic')}\n", "")


def test_every_verb_has_help_with_an_example():
    def parsers(parser):
        yield parser
        for action in parser._actions:
            for child in (getattr(action, "choices", None) or {}).values() if action.dest == "==SUPPRESS==" else []:
                yield from parsers(child)

    found = {parser.prog: parser for parser in parsers(build_parser())}
    assert {"ic run", "ic launch", "ic node list", "ic topic pub", "ic bag record", "ic param set"} <= found.keys()
    for name, parser in found.items():
        children = [other for other in found if other.startswith(f"{name} ")]
        if not children and not name.startswith("ic depth"):
            assert "example" in parser.format_help() and len(parser.description) > 10, name


def test_help_loads_nothing_heavy():
    code = (
        "import sys; from instant_ic.cli.main import build_parser; build_parser(); "
        "print([m for m in ('numpy', 'torch', 'zmq', 'rosbags', 'onnxruntime', 'rich', 'cv2') if m in sys.modules])"
    )
    result = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True, timeout=60)
    assert result.stdout.strip() == "[]"


def test_launch_mistakes(ic):
    Path("bad.yaml").write_text("launch:\n- node: {exec: warp}\n- nod: {}\n")
    status, _, error = ic("launch", "bad.yaml")
    assert status == 2 and "ic: bad.yaml:2: unknown exec 'warp'" in error and "bad.yaml:3: unknown key 'nod'" in error
    assert ic("launch", "nowhere.yaml")[0] == 2
    assert ic("launch", "bad.yaml", "x=1")[0] == 2
    status, out, _ = ic("launch", "replay", "--show-args")
    assert status == 0 and re.search(r"bag +path +required +Folder", out) and re.search(r"start +float +0\.0 +Sec", out)


def test_run_tells_what_a_node_refuses():
    words = ("run", "bag_player", "-p", "rate:=-1", "-p", "bag:=x")
    command = [sys.executable, "-m", "instant_ic.cli.main", *words]  # a process: it installs signal handlers
    result = subprocess.run(command, capture_output=True, text=True, timeout=60)
    assert result.returncode == 2 and "rate must lie in 0.01..100" in result.stderr


def test_replay_mistakes(ic):
    assert "there is no node 'warp'" in ic("replay", "x", "--nodes", "warp", "-o", "y")[2]
    status, _, error = ic("replay", "x", "--nodes", "bag_player", "-o", "y", "-p", "rate:=1")
    assert status == 2 and "expected NODE.KEY:=VALUE" in error
    status, _, error = ic("replay", "x", "--nodes", "bag_player", "-o", "y")
    assert status == 1 and "bag x does not exist" in error


def test_a_full_disk_is_reported_in_a_line(ic, monkeypatch):
    def write(args):
        Path("/dev/full").write_text("figures")  # the error of a write has no file name

    monkeypatch.setattr("instant_ic.cli.commands.compile.run", write)
    status, _, error = ic("compile")
    assert (status, error) == (1, "ic: a file could not be written: No space left on device. Free some space.\n")


def test_usage_is_status_two(ic):
    for words in ((), ("warp",), ("topic",), ("topic", "hz"), ("topic", "hz", "/a", "--duration", "0")):
        assert ic(*words)[0] == 2, words


def test_pipe_that_is_closed_early(talker, monkeypatch):
    monkeypatch.setenv("INSTANT_IC_RUN_DIR", str(talker))
    command = f"{sys.executable} -m instant_ic.cli.main topic echo /scan --timeout 30 | head -n 1"
    result = subprocess.run(command, shell=True, capture_output=True, text=True, timeout=90, env=os.environ, check=True)
    assert result.stdout == "header:\n" and result.stderr == ""
