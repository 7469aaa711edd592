"""Every verb of ``ic`` against a node in a process of its own."""

import os
import signal
import subprocess
import sys
import threading
import time
from collections.abc import Iterator
from importlib import metadata
from pathlib import Path

import pytest

from instant_ic.bus import registry
from instant_ic.cli.main import build_parser, main

TALKER = '''
"""Talks."""
from dataclasses import dataclass, field

import numpy as np

from instant_ic.bus import LATCHED, SENSOR, Node, main
from instant_ic.msg import Bool, scan_message, LaserScan


@dataclass(frozen=True)
class Inner:
    depth: int = 3


@dataclass(frozen=True)
class TalkerConfig:
    rate_hz: float = 50.0
    label: str = "hello"
    inner: Inner = field(default_factory=Inner)


class Talker(Node[TalkerConfig]):
    name = "talker"

    def setup(self) -> None:
        self.scans = self.publisher("/scan", LaserScan, qos=SENSOR)
        self.flag = self.publisher("/flag", Bool, qos=LATCHED)
        self.flag.publish(Bool(data=True))
        self.subscribe("/order", Bool, lambda message: None)
        self.timer(1 / self.config.rate_hz, self.tick)

    def tick(self) -> None:
        ranges = np.arange(40, dtype=np.float32)
        self.scans.publish(scan_message(ranges, -1.0, 0.05, 0.1, 30.0, "velodyne", self.clock.now_ns()))


if __name__ == "__main__":
    main(Talker)
'''


def wait_for(condition: object, what: str, seconds: float = 40.0) -> None:
    deadline_s = time.monotonic() + seconds
    while not condition():  # type: ignore[operator]
        assert time.monotonic() < deadline_s, f"waited {seconds} s for {what}"
        time.sleep(0.02)


@pytest.fixture(scope="module")
def run_dir(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Path]:
    """A run directory in which the talker runs."""
    folder = tmp_path_factory.mktemp("r")
    program = folder / "talker.py"
    program.write_text(TALKER)
    run_dir = folder / "run"
    process = subprocess.Popen(
        [sys.executable, str(program), "--run-dir", str(run_dir), "-p", "inner.depth:=7"],
        stderr=subprocess.DEVNULL,
    )
    try:
        wait_for(lambda: any(node.subscribes.get("/order") for node in registry.list_nodes(run_dir)), "the talker")
        yield run_dir
    finally:
        process.send_signal(signal.SIGINT)
        assert process.wait(timeout=20) == 0


@pytest.fixture(autouse=True)
def in_run_dir(run_dir: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("INSTANT_IC_RUN_DIR", str(run_dir))
    monkeypatch.chdir(tmp_path)


def ic(capsys: pytest.CaptureFixture[str], *words: str) -> tuple[int, str, str]:
    capsys.readouterr()
    try:
        status = main(words)
    except SystemExit as end:
        status = int(end.code or 0)
    captured = capsys.readouterr()
    return status, captured.out, captured.err


def test_the_version_is_printed(capsys):
    with pytest.raises(SystemExit) as end:
        main(["--version"])
    assert end.value.code == 0
    assert capsys.readouterr().out == f"ic {metadata.version('instant-ic')}\n"


def test_every_verb_has_help_with_an_example(capsys: pytest.CaptureFixture[str]) -> None:
    def parsers(parser: object) -> Iterator[object]:
        yield parser
        for action in parser._actions:  # type: ignore[attr-defined]
            for child in (getattr(action, "choices", None) or {}).values() if action.dest == "==SUPPRESS==" else []:
                yield from parsers(child)

    found = list(parsers(build_parser()))
    names = {parser.prog for parser in found}  # type: ignore[attr-defined]
    ours = {
        "ic": {
            "run",
            "launch",
            "node",
            "topic",
            "bag",
            "replay",
            "param",
            "doctor",
            "top",
            "log",
        },
        "ic node": {"list", "info"},
        "ic topic": {"list", "info", "echo", "hz", "bw", "delay", "pub", "find", "type"},
        "ic bag": {"record", "play", "info", "diff", "recover", "convert", "snapshot", "control"},
        "ic param": {"list", "get", "set", "describe", "dump", "load"},
    }
    wanted = {f"{prefix} {verb}" for prefix, verbs in ours.items() for verb in verbs}
    assert wanted <= names
    for parser in found:
        if parser.prog in wanted:  # type: ignore[attr-defined]
            text = parser.format_help()  # type: ignore[attr-defined]
            assert "example: ic" in text and len(parser.description) > 10, parser.prog  # type: ignore[attr-defined]


def test_help_loads_nothing_heavy() -> None:
    code = (
        "import sys; from instant_ic.cli.main import build_parser; build_parser(); "
        "print([m for m in ('numpy', 'torch', 'zmq', 'rosbags', 'onnxruntime', 'rich', 'cv2') if m in sys.modules])"
    )
    result = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True, timeout=60)
    assert result.stdout.strip() == "[]"


def ic_process(*words: str, interrupt_after: object = None) -> tuple[int, str, str]:
    """Runs ``ic`` in a process: what installs signal handlers must have the main thread."""
    process = subprocess.Popen(
        [sys.executable, "-m", "instant_ic.cli.main", *words],
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
    )
    if interrupt_after is not None:
        threading.Thread(target=_interrupt, args=(process, interrupt_after), daemon=True).start()
    out, error = process.communicate(timeout=90)
    return process.returncode, out, error


def _interrupt(process: subprocess.Popen[str], condition: object) -> None:
    wait_for(condition, "the moment to interrupt")
    process.send_signal(signal.SIGINT)


def test_launch_in_a_process_ends_in_time_and_leaves_nothing(
    run_dir: Path, tmp_path: Path, tmp_path_factory: pytest.TempPathFactory
) -> None:
    (tmp_path / "talker.py").write_text(TALKER)
    (tmp_path / "two.yaml").write_text(
        "launch:\n"
        "- arg: {name: rate, default: 20.0, description: how often}\n"
        "- node: {exec: talker.py, name: first, param: [{name: rate_hz, value: $(var rate)}],"
        " remap: [{from: /scan, to: /one}]}\n"
        "- node: {exec: talker.py, name: second, remap: [{from: /scan, to: /two}], namespace: side}\n"
    )
    other = tmp_path_factory.mktemp("r")  # short: sockets are bound in it
    process = subprocess.Popen(
        [sys.executable, "-m", "instant_ic.cli.main", "launch", "two.yaml", "rate:=30", "--run-dir", str(other)],
        stdout=subprocess.PIPE,
        stderr=subprocess.STDOUT,
        text=True,
    )
    assert process.stdout is not None
    lines: list[str] = []
    try:
        for line in process.stdout:
            lines.append(line)
            if "all 2 nodes are up" in line:
                break
        nodes = {node.name: node for node in registry.list_nodes(other)}
        assert nodes["first"].params["rate_hz"] == 30 and "/one" in nodes["first"].publishes
        assert "/side/two" in nodes["second"].publishes
        second = subprocess.run(
            [sys.executable, "-m", "instant_ic.cli.main", "launch", "two.yaml", "--run-dir", str(other)],
            capture_output=True,
            text=True,
            timeout=60,
            check=False,
        )
        assert second.returncode == 1 and f"a stack already runs in {other} (pid {process.pid}" in second.stderr
        began_s = time.monotonic()
        process.send_signal(signal.SIGINT)
        rest, _ = process.communicate(timeout=30)
        assert time.monotonic() - began_s < 25  # 5 s, and the patience of a busy machine
    finally:
        process.kill()
    assert process.returncode == 0, "".join(lines) + rest
    assert "stopping 2 nodes" in rest
    assert registry.list_nodes(other) == [] and registry.list_topics(other) == []
    for node in nodes.values():
        assert not Path(f"/proc/{node.pid}").exists()
    assert "running" in (other / "log" / "first.log").read_text()


def test_launch_mistakes(capsys: pytest.CaptureFixture[str], tmp_path: Path) -> None:
    Path("bad.yaml").write_text("launch:\n- node: {exec: warp}\n- nod: {}\n")
    status, _, error = ic(capsys, "launch", "bad.yaml")
    assert status == 2 and "ic: bad.yaml:2: unknown exec 'warp'" in error and "bad.yaml:3: unknown key 'nod'" in error
    assert ic(capsys, "launch", "nowhere.yaml")[0] == 2
    assert ic(capsys, "launch", "bad.yaml", "x=1")[0] == 2
    Path("player.yaml").write_text("launch:\n- node: {exec: bag_player, param: [{name: rat, value: 1}]}\n")
    status, _, error = ic(capsys, "launch", "player.yaml", "--check")
    assert status == 2 and "player.yaml:2: unknown parameter 'rat'; did you mean 'rate'?" in error
    status, out, _ = ic(capsys, "launch", "replay", "--show-args")
    assert status == 0 and "bag: path (required)" in out


def test_run_tells_what_a_node_refuses() -> None:
    status, _, error = ic_process("run", "bag_player", "-p", "bag:=nowhere")
    assert status == 1 and "bag nowhere does not exist" in error and "Traceback" not in error
    status, _, error = ic_process("run", "bag_player", "-p", "rate:=-1", "-p", "bag:=x")
    assert status == 2 and "rate must lie in 0.01..100" in error


def test_replay_mistakes(capsys: pytest.CaptureFixture[str]) -> None:
    assert "there is no node 'warp'" in ic(capsys, "replay", "x", "--nodes", "warp", "-o", "y")[2]
    status, _, error = ic(capsys, "replay", "x", "--nodes", "bag_player", "-o", "y", "-p", "rate:=1")
    assert status == 2 and "expected NODE.KEY:=VALUE" in error
    status, _, error = ic(capsys, "replay", "x", "--nodes", "bag_player", "-o", "y")
    assert status == 1 and "bag x does not exist" in error


def test_a_full_disk_is_reported_in_a_line(monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]) -> None:
    def write(args: object) -> None:
        Path("/dev/full").write_text("figures")  # the error of a write has no file name

    monkeypatch.setattr("instant_ic.cli.commands.compile.run", write)
    status, _, error = ic(capsys, "compile")
    assert (status, error) == (1, "ic: a file could not be written: No space left on device. Free some space.\n")


def test_usage_is_status_two(capsys: pytest.CaptureFixture[str]) -> None:
    for words in ((), ("warp",), ("topic",), ("topic", "hz"), ("topic", "hz", "/a", "--duration", "0")):
        assert ic(capsys, *words)[0] == 2, words


def test_pipe_that_is_closed_early() -> None:
    command = f"{sys.executable} -m instant_ic.cli.main topic echo /scan --timeout 30 | head -n 1"
    result = subprocess.run(command, shell=True, capture_output=True, text=True, timeout=90, env=os.environ, check=True)
    assert result.stdout == "header:\n" and result.stderr == ""
