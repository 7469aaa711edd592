"""``ic param``, ``ic node`` and ``ic log level`` against a node in a process of its own."""

import os
import re
import signal
import subprocess
import sys

import pytest
import yaml
from cli_helpers import TALKER, talking, wait_until

from instant_ic.bus import registry
from instant_ic.bus.control import NodeControl


@pytest.fixture(autouse=True)
def in_run_dir(talker, monkeypatch):
    monkeypatch.setenv("INSTANT_IC_RUN_DIR", str(talker))


def test_list_and_get(ic):
    keys = ["drives", "inner.depth", "inner.share", "label", "late_s", "nice", "rate_hz", "sleep_s", "use_sim_time"]
    assert ic("param", "list", "talker")[:2] == (0, "talker:\n" + "".join(f"  {key}\n" for key in keys))
    assert "  inner.depth: 7\n" in ic("param", "list", "-v")[1]
    assert ic("param", "get", "talker", "inner.depth")[:2] == (0, "7\n")
    assert ic("param", "get", "/talker", "inner")[:2] == (0, "inner.depth: 7\ninner.share: 0.5\n")
    status, _, error = ic("param", "get", "talker", "inner.dept")
    assert status == 1 and "did you mean 'inner.depth'?" in error
    status, _, error = ic("param", "get", "talkr", "inner.depth")
    assert status == 1 and "node 'talkr' is not running" in error and "did you mean 'talker'?" in error


def test_list_changed_shows_both_values(ic):
    status, out, _ = ic("param", "list", "talker", "--changed")
    assert status == 0 and "  inner.depth: 7 (default 3)\n" in out and "inner.share" not in out


def test_describe(ic):
    status, out, _ = ic("param", "describe", "talker", "inner.share", "rate_hz")
    assert status == 0
    assert out == (
        "Parameter name: inner.share\n  Type: float, 0..1\n  Value: 0.5\n  Live: yes\n  Description: how much of it.\n"
        "Parameter name: rate_hz\n  Type: float, > 0\n  Value: 50.0\n  Live: no, takes effect at start\n"
        "  Description: scans a second.\n"
    )
    assert "Value: 7 (default 3)" in ic("param", "describe", "talker", "inner")[1]
    assert ic("param", "describe", "talker")[1].count("Parameter name: ") == 9


def test_set_is_seen_in_what_the_node_does_and_tells(ic):
    assert ic("param", "set", "talker", "label", "bonjour", "inner.share", "0.75")[:2] == (
        0,
        "label: bonjour\ninner.share: 0.75\n",
    )
    wait_until(lambda: "bonjour" in ic("topic", "echo", "/scan", "--once", "--field", "header.frame_id")[1], "bonjour")
    wait_until(lambda: ic("param", "get", "talker", "label")[1] == "bonjour\n", "the registry")
    assert "nothing to change" in ic("param", "set", "talker", "label", "bonjour")[1]
    ic("param", "set", "talker", "label", "hello", "inner.share", "0.5")
    for words, told in (
        (("rate_hz", "20"), "rate_hz takes effect at start: restart the node"),
        (("inner.share", "2"), "talker: inner.share must lie in 0..1 (got 2)"),
        (("inner.share", "much"), "inner.share must be float (got 'much')"),
        (("labell", "x"), "unknown parameter 'labell'; did you mean 'label'?"),
        (("label",), "label: a value is missing"),
        (("label", "[a"), "label [a: the value is not YAML"),
    ):
        status, out, error = ic("param", "set", "talker", *words)
        assert status == 2 and told in error and out == "", (words, error)
    assert NodeControl(registry_dir(), "talker").get()["label"] == "hello"


def registry_dir():
    from instant_ic.util import paths

    return paths.run_dir()


def test_dump_and_load(ic, tmp_path):
    file = tmp_path / "talker.yaml"
    file.write_text(ic("param", "dump", "talker")[1])
    content = yaml.safe_load(file.read_text())["talker"]["ros__parameters"]
    assert content["inner"] == {"depth": 7, "share": 0.5} and content["use_sim_time"] is False
    assert "nothing to change" in ic("param", "load", "talker", str(file))[1]
    file.write_text(file.read_text().replace("share: 0.5", "share: 0.25"))
    assert ic("param", "load", "talker", str(file))[:2] == (0, "inner.share: 0.25\n")
    file.write_text("/**:\n  ros__parameters:\n    inner:\n      share: 0.5\n      depth: 8\n")
    status, _, error = ic("param", "load", "talker", str(file))
    assert status == 2 and "inner.depth takes effect at start" in error
    file.write_text("other:\n  ros__parameters: {label: x}\n")
    status, _, error = ic("param", "load", "talker", str(file))
    assert status == 2 and "has no parameters for talker" in error
    assert ic("param", "set", "talker", "inner.share", "0.5")[0] == 0
    # What was dumped starts a node with the same parameters.
    file.write_text(ic("param", "dump", "talker")[1])
    run_dir = tmp_path / "r"
    with talking(run_dir, "--params-file", str(file)):
        assert NodeControl(run_dir, "talker").get() == NodeControl(registry_dir(), "talker").get()


def test_node_list_and_info(ic, talker):
    assert ic("node", "list")[:2] == (0, "talker\n")
    assert re.search(r"\ntalker +\d+ +\d+  \S", ic("node", "list", "-v")[1])
    scan = r"/scan +publishes +sensor_msgs/msg/LaserScan +[\d.]+ Hz"
    wait_until(lambda: re.search(scan, ic("node", "info", "talker")[1]), "a heartbeat with rates")
    status, out, _ = ic("node", "info", "talker")
    assert status == 0 and "state: running\n" in out and re.search(r"process: \d+ % of a core, \d+ MB\n", out)
    assert re.search(r"threads: \d+", out)
    assert re.search(r"/order +subscribes +geometry_msgs/msg/TwistStamped +no message yet", out)
    status, _, error = ic("node", "info", "nobody")
    assert status == 1 and "node 'nobody' is not running" in error and "running: talker" in error


def test_nobody_runs_here_but_in_a_folder_of_it(ic, talker, tmp_path, monkeypatch):
    """A fleet's robots have run directories inside the launcher's: whoever looks there is told where to look."""
    monkeypatch.setenv("INSTANT_IC_RUN_DIR", str(talker.parent))
    for words in (("node", "list"), ("param", "list"), ("param", "get", "x", "y"), ("top",)):
        status, out, error = ic(*words)
        assert status == (words == ("node", "list")) ^ 1 and out == ""
        assert f"no node is running in {talker.parent}; nodes are running in" in error and f"{talker}" in error, words
    monkeypatch.setenv("INSTANT_IC_RUN_DIR", str(tmp_path))
    assert ic("node", "list") == (0, "", f"ic: no node is running in {tmp_path}\n")


def test_busy_node_is_told_and_nothing_is_changed(ic, tmp_path_factory, monkeypatch):
    run_dir = tmp_path_factory.mktemp("r")
    monkeypatch.setenv("INSTANT_IC_RUN_DIR", str(run_dir))
    with talking(run_dir, "-p", "sleep_s:=600.0") as process:
        assert ic("topic", "pub", "--once", "/sleep", "Bool", "{data: true}")[0] == 0
        wait_until(lambda: NodeControl(run_dir, "talker").status()["busy"] == "callback of /sleep", "the long callback")
        status, out, error = ic("param", "set", "talker", "label", "x")
        assert status == 1 and out == "" and re.search(r"talker is busy \(callback of /sleep has been running", error)
        assert ic("param", "get", "talker", "label")[1] == "hello\n"
        assert re.search(r"● busy .*in callback of /sleep for \d+ s", ic("top")[1])
        process.kill()  # its callback would hold up the end


def test_dora_2152_own_file_leaves_at_once_whatever_threads_are_left(tmp_path_factory):
    """``ic run my_node.py``: a thread that a library left behind does not keep the process (dora 2152)."""
    run_dir = tmp_path_factory.mktemp("r")
    file = run_dir / "my_node.py"
    text = TALKER.read_text().replace(
        "    def setup(self) -> None:\n",
        "    def setup(self) -> None:\n        import threading\n"
        "        threading.Thread(target=lambda: time.sleep(600)).start()\n",
    )
    assert "sleep(600)" in text
    file.write_text(text)
    process = subprocess.Popen(
        [sys.executable, "-m", "instant_ic.cli.main", "run", str(file), "--run-dir", str(run_dir), "-p", "label:=mine"],
        stderr=subprocess.PIPE,
        text=True,
    )
    try:
        wait_until(lambda: any(n.subscribes.get("/sleep") for n in registry.list_nodes(run_dir)), "the node")
        assert registry.list_nodes(run_dir)[0].params["label"] == "mine"
        process.send_signal(signal.SIGINT)
        _, error = process.communicate(timeout=20)
    finally:
        process.kill()
    assert process.returncode == 0 and "stopping" in error
    assert registry.list_nodes(run_dir) == []


def test_run_mistakes(ic, tmp_path):
    status, _, error = ic("run", "warp_drive")
    assert status == 2 and "there is no node 'warp_drive'; the nodes are" in error and "bag_player" in error
    status, _, error = ic("run", "grid_slm")
    assert status == 2 and "did you mean 'grid_slam'?" in error
    assert "nowhere.py does not exist" in ic("run", "nowhere.py")[2]
    file = tmp_path / "none.py"
    file.write_text("x = 1\n")
    status, _, error = ic("run", str(file))
    assert status == 2 and "must define one node class (it has: none)" in error


@pytest.mark.parametrize(
    ("line", "expected"),
    [
        ("ic topic echo /sc", {"/scan "}),
        ("ic param get talker inner.", {"inner.depth", "inner.share"}),
        ("ic launch sim console_", {"console_port:="}),
    ],
)
def test_completion(line, expected, tmp_path):
    """As the shell asks: argcomplete's protocol, and nothing heavy loaded on the way."""
    found_file = tmp_path / "found"
    code = (
        "import sys; from instant_ic.cli.main import main\n"
        "import os; real = os._exit\n"
        "def leave(status):\n"
        "    heavy = [m for m in ('numpy', 'numba', 'torch', 'rosbags', 'zmq', 'rich', 'cv2') if m in sys.modules]\n"
        "    os.write(2, ('heavy: %s' % heavy).encode()); real(status)\n"
        "os._exit = leave\nmain()"
    )
    environment = {
        **os.environ,
        "_ARGCOMPLETE": "1",
        "COMP_LINE": line,
        "COMP_POINT": str(len(line)),
        "_ARGCOMPLETE_STDOUT_FILENAME": str(found_file),
        "IFS": "\v",
    }
    result = subprocess.run(
        [sys.executable, "-c", code], env=environment, capture_output=True, text=True, timeout=60, check=False
    )
    assert set(found_file.read_text().split("\v")) == expected, result.stderr
    assert "heavy: []" in result.stderr
