"""`ic map save` against a stand-in for the node, over the real bus."""

from __future__ import annotations

import tempfile
import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path

import pytest

from instant_ic.bus import RELIABLE
from instant_ic.bus.topics import Publisher
from instant_ic.cli.main import main
from instant_ic.cli.observer import TopicObserver
from instant_ic.msg import String, deserialize, type_name


@pytest.fixture(autouse=True)
def run_dir(monkeypatch: pytest.MonkeyPatch) -> Path:
    folder = Path(tempfile.mkdtemp(prefix="ic-"))
    monkeypatch.setenv("INSTANT_IC_RUN_DIR", str(folder))
    return folder


@contextmanager
def stand_in(run_dir: Path, answer: Callable[[str], str]) -> Iterator[list[str]]:
    """Answers what comes on /slam/save until the end of the block; the requests are listed."""
    asked: list[str] = []
    ready, end = threading.Event(), threading.Event()

    def serve() -> None:
        with TopicObserver(["/slam/save"], run_dir=run_dir) as observer:
            out = Publisher(observer.transport.advertise("/slam/saved", type_name(String), RELIABLE))
            ready.set()
            while not end.is_set():
                for batch in observer.batches(0.2, 0.05):
                    for received in batch:
                        asked.append(str(deserialize(received.payload, received.type_name).data))
                        out.publish(String(data=answer(asked[-1])))

    thread = threading.Thread(target=serve, daemon=True)
    thread.start()
    assert ready.wait(10)
    try:
        yield asked
    finally:
        end.set()
        thread.join(10)


def test_the_node_is_asked_and_its_answer_shown(
    run_dir: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    with stand_in(run_dir, lambda name: f"saved: {name}.yaml") as asked:
        assert main(["map", "save", "floor"]) == 0
    assert asked == [str(tmp_path / "floor")]
    assert capsys.readouterr().out == f"saved: {tmp_path / 'floor'}.yaml\n"


def test_what_goes_wrong_is_told(run_dir: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    with stand_in(run_dir, lambda name: "error: the map is empty: nothing to save"):
        assert main(["map", "save", str(tmp_path / "m")]) == 1
    assert "the map is empty" in capsys.readouterr().err
    assert main(["map", "save", str(tmp_path / "m.yaml")]) == 2
    assert "must have no suffix" in capsys.readouterr().err
    assert main(["map", "save", "m", "--timeout", "0.3"]) == 1
    assert "grid_slam is not running" in capsys.readouterr().err
