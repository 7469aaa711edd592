"""`ic map save` against a stand-in for the node, over its control socket."""

from __future__ import annotations

import threading
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path

import pytest

from instant_ic.bus import Node, registry
from instant_ic.bus.clock import SystemClock
from instant_ic.bus.control import ControlServer
from instant_ic.bus.local_transport import LocalTransport
from instant_ic.cli.main import main


@dataclass(frozen=True)
class NoParameters:
    pass


class StandIn(Node[NoParameters]):
    name = "grid_slam"


@pytest.fixture
def answered(tmp_path_factory: pytest.TempPathFactory, monkeypatch: pytest.MonkeyPatch) -> Iterator[Callable]:
    """Takes what the command ``save`` of the running node does."""
    run_dir, clock = tmp_path_factory.mktemp("r"), SystemClock()
    monkeypatch.setenv("INSTANT_IC_RUN_DIR", str(run_dir))
    node = StandIn(NoParameters(), LocalTransport(run_dir, "grid_slam", clock.now_ns), clock)
    server = ControlServer(node, run_dir / "nodes" / "grid_slam.sock")
    claim = registry.Claim(run_dir / "nodes" / "grid_slam", "node grid_slam")
    claim.write({**node.describe(), "started_ns": 0})
    node.start()
    thread = threading.Thread(target=node.spin)
    thread.start()
    yield lambda save: node.commands.update(save=save)
    node.stop()
    thread.join(10)
    server.close()
    node.close()
    claim.release()


def test_the_node_is_asked_and_its_answer_shown(
    answered: Callable, tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    answered(lambda path: [f"{path}.yaml", f"{path}.pgm"])
    assert main(["map", "save", "floor"]) == 0
    floor = tmp_path / "floor"
    assert capsys.readouterr().out == f"saved: {floor}.yaml, {floor}.pgm\n"


def test_what_goes_wrong_is_told(answered: Callable, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    def refuse(path: str) -> list[str]:
        raise ValueError("the map is empty: nothing to save")

    answered(refuse)
    assert main(["map", "save", str(tmp_path / "m")]) == 1
    assert "the map is empty" in capsys.readouterr().err
    assert main(["map", "save", str(tmp_path / "m.yaml")]) == 2
    assert "must have no suffix" in capsys.readouterr().err


def test_without_the_node_nothing_is_saved(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("INSTANT_IC_RUN_DIR", str(tmp_path))
    assert main(["map", "save", "m"]) == 1
    assert "grid_slam is not running" in capsys.readouterr().err
