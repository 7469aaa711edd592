"""The emergency stop survives restarts of console and arbiter in any order, and a run that broke off."""

from __future__ import annotations

import os
import stat
import tempfile
from collections.abc import Iterator
from itertools import permutations
from pathlib import Path

import numpy as np
import pytest

from instant_ic.bus import ERROR, LATCHED
from instant_ic.bus.lockstep import LockstepBus
from instant_ic.cli.main import main
from instant_ic.console import ConsoleServer
from instant_ic.msg import (
    Bool,
    ControlState,
    MessageError,
    odometry_message,
    serialize,
    twist_stamped,
    twist_values,
    type_name,
)
from instant_ic.util import estop_state
from instant_ic.util.estop_state import KeptStop, RunMark
from nodes.arbiter import ArbiterNode
from nodes.console import ConsoleNode

S = 1_000_000_000


class Robot:
    """Arbiter and console on a lockstep bus with a run directory; each can be killed and started again."""

    def __init__(self, run_dir: Path) -> None:
        self.bus = LockstepBus(start_ns=1_000 * S, run_dir=run_dir)
        self.nodes: dict[str, ArbiterNode | ConsoleNode] = {}
        self.start("arbiter")
        self.start("console")

    def start(self, name: str) -> None:
        self.nodes[name] = self.bus.add(ArbiterNode if name == "arbiter" else ConsoleNode)
        self.bus.advance(0.1)

    def kill(self, name: str) -> None:
        self.bus.kill(self.nodes.pop(name))

    @property
    def console(self) -> ConsoleNode:
        node = self.nodes["console"]
        assert isinstance(node, ConsoleNode)
        return node

    def release(self) -> None:
        """The operator has, or takes, the robot's lease, and releases the stop."""
        self.console.on_drive(0.0, 0.0)
        self.console.on_estop(False)

    def stopped(self) -> bool:
        """Whether the arbiter says so, and sends nothing but zeros under a commanding operator."""
        now_ns = self.bus.clock.now_ns()
        self.bus.publish("/operator/cmd_vel", twist_stamped(0.3, 0.0, now_ns), publisher="console")
        self.bus.advance(0.2)
        state: ControlState = self.bus.last("/ic/state")
        assert twist_values(self.bus.last("/cmd_vel")) == (0.0, 0.0)
        return bool(state.estop) and state.mode == ControlState.STOPPED


@pytest.fixture
def run_dir(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    monkeypatch.setattr(ConsoleServer, "start", lambda self: None)
    return tmp_path


@pytest.fixture
def robot(run_dir: Path) -> Iterator[Robot]:
    made = Robot(run_dir)
    yield made
    made.bus.close()


ORDERS = [
    *(("kill " + name, "start " + name) for name in ("arbiter", "console")),
    *(
        order
        for order in permutations(("kill arbiter", "kill console", "start arbiter", "start console"))
        if all(order.index(f"kill {name}") < order.index(f"start {name}") for name in ("arbiter", "console"))
    ),
]


@pytest.mark.parametrize("order", ORDERS, ids=", ".join)
def test_a_pressed_emergency_stop_survives_restarts(robot: Robot, order: tuple[str, ...]) -> None:
    robot.console.on_estop(True)
    robot.bus.advance(0.1)
    assert robot.stopped()
    for step in order:
        does, name = step.split()
        getattr(robot, does)(name)
    assert robot.stopped()
    # Released by hand it is over, and a further restart brings it not back.
    robot.release()
    robot.bus.advance(0.1)
    assert not robot.bus.last("/ic/state").estop
    robot.kill("arbiter")
    robot.start("arbiter")
    assert not robot.bus.last("/ic/state").estop


def test_a_console_that_starts_with_a_latched_release_ends_no_stop(
    robot: Robot, caplog: pytest.LogCaptureFixture
) -> None:
    released_ns = robot.bus.clock.now_ns()
    robot.bus.advance(1.0)
    robot.console.on_estop(True)
    robot.bus.advance(0.1)
    robot.kill("console")
    robot.kill("arbiter")
    robot.start("arbiter")
    release = bytes(serialize(Bool(data=False)))
    robot.bus.route("/operator/estop", type_name(Bool), release, "second_console", LATCHED, released_ns)
    robot.bus.advance(0.1)
    assert robot.stopped()
    refusals = [record for record in caplog.records if record.levelname == "WARNING" and "release" in record.message]
    assert refusals and "second_console" in refusals[-1].message


def test_a_release_from_before_the_clock_was_set_back_ends_no_stop_after_a_restart(run_dir: Path) -> None:
    """The press is stamped 990 s, since the clock was set back before it; the release before that is stamped 995 s."""
    estop_state.write(run_dir, KeptStop("crawler_base", 990 * S))
    robot = Robot(run_dir)
    release = bytes(serialize(Bool(data=False)))
    robot.bus.route("/operator/estop", type_name(Bool), release, "console", LATCHED, 995 * S)
    robot.bus.advance(0.1)
    assert robot.stopped()
    robot.release()
    robot.bus.advance(0.1)
    assert not robot.bus.last("/ic/state").estop
    robot.bus.close()


def test_a_press_is_kept_even_if_the_arbiter_cannot_step(robot: Robot, run_dir: Path) -> None:
    vbot = odometry_message(np.eye(4), 0.0, 0.0, "map", "vbot_base_link", robot.bus.clock.now_ns())
    vbot.pose.pose.orientation.w = 0.0  # no rotation
    with pytest.raises(MessageError):
        robot.bus.publish("/vbot/odom", vbot)
        robot.bus.advance(0.2)
    with pytest.raises(MessageError):
        robot.bus.publish("/operator/estop", Bool(data=True), publisher="console")
    assert estop_state.read(run_dir) is not None


def test_the_robots_own_button_stays_latched_over_a_restart_of_the_arbiter(robot: Robot) -> None:
    robot.bus.publish("/robot/estop", Bool(data=True), publisher="crawler_base")
    robot.release()
    assert robot.stopped()  # no release while it is pressed
    robot.bus.publish("/robot/estop", Bool(data=False), publisher="crawler_base")
    assert robot.stopped()
    robot.kill("arbiter")
    robot.start("arbiter")
    assert robot.stopped()
    robot.release()
    robot.bus.advance(0.1)
    assert not robot.bus.last("/ic/state").estop


def test_after_a_run_that_broke_off_the_robot_starts_stopped_and_says_why(run_dir: Path) -> None:
    RunMark(run_dir).__enter__()  # and the launcher was killed
    with RunMark(run_dir):
        robot = Robot(run_dir)
        assert robot.stopped()
        why = "The last run did not end cleanly. Release the emergency stop to continue."
        assert robot.bus.last("/ic/state").reason == why
        robot.release()
        robot.bus.advance(0.1)
        assert not robot.bus.last("/ic/state").estop
        robot.bus.close()
    with RunMark(run_dir):  # that one ended cleanly
        assert estop_state.read(run_dir) is None


def test_a_clean_end_keeps_a_pressed_stop_and_makes_none(run_dir: Path) -> None:
    with RunMark(run_dir):
        estop_state.write(run_dir, KeptStop("console", 5))
    with RunMark(run_dir):
        assert estop_state.read(run_dir) == KeptStop("console", 5)
        estop_state.write(run_dir, None)
    with RunMark(run_dir):
        assert estop_state.read(run_dir) is None


def test_a_press_stamped_by_a_clock_that_was_ahead_can_be_released(run_dir: Path) -> None:
    estop_state.write(run_dir, KeptStop("launch", 9_000 * S))
    robot = Robot(run_dir)
    assert robot.stopped()
    robot.release()
    robot.bus.advance(0.1)
    assert not robot.bus.last("/ic/state").estop
    robot.bus.close()


def test_the_files_are_private_replaced_whole_and_a_damaged_one_means_stopped(tmp_path: Path) -> None:
    file = tmp_path / "estop.json"
    estop_state.write(tmp_path, KeptStop("console", 5))
    assert stat.S_IMODE(file.stat().st_mode) == 0o600
    assert sorted(path.name for path in tmp_path.iterdir()) == ["estop.json"]
    endless = b'{"publisher": "console", "pressed_ns": 1e999, "why": ""}'
    for damage in (b"", b"{", b"[]", b'{"publisher": 1}', b"\xff\xfe", endless, b"[" * 100_000):
        file.write_bytes(damage)
        kept = estop_state.read(tmp_path)
        assert kept is not None and "cannot be read" in kept.why
    target = tmp_path / "target"
    target.write_text("whole")
    (tmp_path / "estop.part").symlink_to(target)
    estop_state.write(tmp_path, KeptStop("console", 6))
    assert target.read_text() == "whole"


def test_a_stop_whose_state_cannot_be_written_holds_and_is_an_error(robot: Robot, run_dir: Path) -> None:
    (run_dir / f".estop.json.{os.getpid()}.part").mkdir()  # in the way of the file, for root too
    robot.console.on_estop(True)
    robot.bus.advance(1.0)
    assert robot.stopped()
    level, text, _ = robot.nodes["arbiter"].diagnoses()["estop"]
    assert level == ERROR
    assert "state cannot be kept" in text and "Free the disk, or set INSTANT_IC_RUN_DIR" in text
    assert not (run_dir / "estop.json").exists()
    robot.console.on_estop(False)
    robot.bus.advance(0.1)
    assert not robot.bus.last("/ic/state").estop


TOUCHER = """
from pathlib import Path
from instant_ic.bus import Node
from instant_ic.control.freshness import TimeoutConfig

class Toucher(Node[TimeoutConfig]):
    name = "toucher"

if __name__ == "__main__":
    Path("{started}").touch()
"""
"""A node that only notes that it was started, and ends."""


def test_a_stack_whose_state_cannot_be_written_is_not_started(
    tmp_path: Path, capfd: pytest.CaptureFixture[str]
) -> None:
    launch, started = tmp_path / "stack.yaml", tmp_path / "started"
    node = tmp_path / "toucher.py"
    node.write_text(TOUCHER.format(started=started))
    launch.write_text(f"launch:\n- node: {{exec: {node}, name: toucher}}\n")
    with tempfile.TemporaryDirectory() as run_dir:  # short enough for the names of sockets
        words = ["launch", str(launch), "--run-dir", run_dir, "--plain"]
        assert main(words) == 0 and started.exists()
        started.unlink()
        (Path(run_dir) / f".run.json.{os.getpid()}.part").mkdir()  # in the way of the file, for root too
        assert main(words) == 1
    assert "Free the disk, or set INSTANT_IC_RUN_DIR" in capfd.readouterr().err
    assert not started.exists()


def test_the_default_run_directory_keeps_its_state_where_a_power_cut_leaves_it(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("XDG_RUNTIME_DIR", str(tmp_path / "runtime"))
    monkeypatch.setenv("XDG_STATE_HOME", str(tmp_path / "state"))
    default = tmp_path / "runtime" / "instant_ic"
    assert estop_state.state_dir(default) == tmp_path / "state" / "instant_ic"
    assert estop_state.state_dir(default / "robot1") == tmp_path / "state" / "instant_ic" / "robot1"
    assert estop_state.state_dir(tmp_path / "chosen") == tmp_path / "chosen"
    estop_state.write(default / "robot1", KeptStop("console", os.getpid()))
    assert estop_state.read(default) is None
    assert estop_state.read(default / "robot1") == KeptStop("console", os.getpid())
