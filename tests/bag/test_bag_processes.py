"""Recorder and player as processes: killed, asked for snapshots, paused and stepped from another terminal."""

import contextlib
import io
import json
import os
import signal
import subprocess
import sys
import threading
import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from pathlib import Path

import pytest

from instant_ic.bag import BagReader, BagWriter
from instant_ic.bag.recover import recover
from instant_ic.bus import LATCHED, SENSOR, Publisher
from instant_ic.bus.control import NodeControl
from instant_ic.cli.main import main
from instant_ic.experiments.stack import StackObserver, observer
from instant_ic.msg import Bool, Clock, Float32, deserialize, serialize

pytestmark = [pytest.mark.system, pytest.mark.timeout(120)]
BOOL, FLOAT = "std_msgs/msg/Bool", "std_msgs/msg/Float32"
S = 1_000_000_000


def wait_for(condition: Callable[[], object], what: str, seconds: float = 40.0) -> None:
    deadline_s = time.monotonic() + seconds
    while not condition():
        assert time.monotonic() < deadline_s, f"waited {seconds:g} s for {what}"
        time.sleep(0.02)


@dataclass
class Talker:
    """Publishes ``/count`` at 100 Hz and ``/operator/estop`` on demand, in a run directory of its own."""

    run_dir: Path
    node: StackObserver
    count: Publisher
    estop: Publisher
    stop: threading.Event = field(default_factory=threading.Event)
    sent: int = 0

    def run(self) -> None:
        while not self.stop.wait(0.01):
            self.count.publish(Float32(data=float(self.sent)))
            self.sent += 1

    def ic(self, *words: str | Path) -> "subprocess.CompletedProcess[str]":
        """One short command, in this process: a start of Python for each would take most of these tests' time."""
        out, error = io.StringIO(), io.StringIO()
        before = os.environ.get("INSTANT_IC_RUN_DIR")
        os.environ["INSTANT_IC_RUN_DIR"] = str(self.run_dir)
        try:
            with contextlib.redirect_stdout(out), contextlib.redirect_stderr(error):
                done = main([str(word) for word in words])
        finally:
            del os.environ["INSTANT_IC_RUN_DIR"]
            if before is not None:
                os.environ["INSTANT_IC_RUN_DIR"] = before
        return subprocess.CompletedProcess(words, done, out.getvalue(), error.getvalue())

    def start(self, *words: str | Path) -> "subprocess.Popen[str]":
        return subprocess.Popen(
            [sys.executable, "-m", "instant_ic.cli.main", *map(str, words)],
            stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True, stdin=subprocess.DEVNULL, env=self.environment,
        )  # fmt: skip

    @property
    def environment(self) -> dict[str, str]:
        return {**os.environ, "INSTANT_IC_RUN_DIR": str(self.run_dir)}


@pytest.fixture(scope="module")
def talker(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Talker]:
    run_dir = tmp_path_factory.mktemp("r") / "run"
    with observer(run_dir) as node:
        count, estop = node.publisher("/count", Float32), node.publisher("/operator/estop", Bool, LATCHED)
        made = Talker(run_dir, node, count, estop)
        made.estop.publish(Bool(data=False))
        thread = threading.Thread(target=made.run)
        thread.start()
        yield made
        made.stop.set()
        thread.join(10)


def end(process: "subprocess.Popen[str]", how: int = signal.SIGINT) -> str:
    process.send_signal(how)
    try:
        return process.communicate(timeout=40)[0]
    finally:
        process.kill()


def status(talker: Talker) -> dict[str, object]:
    done = talker.ic("bag", "control", "status")
    return json.loads(done.stdout) if done.returncode == 0 else {}


def test_killed_recorder_loses_at_most_what_it_had_not_flushed(talker: Talker, tmp_path: Path) -> None:
    process = talker.start("bag", "record", "-o", tmp_path / "bag", "/count", "-d", "1")
    try:
        wait_for(lambda: (tmp_path / "bag" / "bag_2.mcap").exists(), "three files")
        before = talker.sent
        wait_for(lambda: talker.sent > before + 130, "more than a second")
    finally:
        end(process, signal.SIGKILL)
    with BagReader(tmp_path / "bag") as reader:  # the complete files open as they are
        complete = [deserialize(m.payload, m.type_name).data for m in reader.messages()]
        assert reader.unlisted
    recover(tmp_path / "bag", tmp_path / "saved")
    with BagReader(tmp_path / "saved") as reader:
        saved = [deserialize(m.payload, m.type_name).data for m in reader.messages()]
    assert saved == [saved[0] + i for i in range(len(saved))]  # no gap, and no message twice
    assert complete == saved[: len(complete)] and len(complete) >= 20 and saved[-1] >= before - 100


def test_snapshots_on_demand_and_at_an_emergency_stop(talker: Talker, tmp_path: Path) -> None:
    folder = tmp_path / "snaps"
    process = talker.start(
        "bag", "record", "-o", folder, "--snapshot", "--snapshot-seconds", "1.5", "--snapshot-after", "0.5"
    )
    try:
        wait_for(lambda: float(str(status(talker).get("cached_s", 0))) >= 1.0, "1 s in memory")
        done = talker.ic("bag", "snapshot", "door stuck")
        assert done.returncode == 0 and "door_stuck" in done.stdout and "messages" in done.stdout, done.stderr
        talker.estop.publish(Bool(data=True))
        pressed_ns = time.time_ns()
        begun = talker.ic("bag", "control", "record")
        assert begun.returncode == 0 and str(folder / "rec_") in begun.stdout, begun.stderr
        again = talker.ic("bag", "control", "record")
        assert again.returncode == 1 and "is being recorded already" in again.stderr
        wait_for(lambda: status(talker)["recording"]["messages"] > 40, "a recording beside it")  # of all topics
        assert talker.ic("bag", "control", "stop").returncode == 0
        wait_for(lambda: status(talker)["recording"]["state"] == "idle", "its end")
        wait_for(lambda: list(folder.glob("*_estop/metadata.yaml")), "the snapshot of the stop")
        # Seconds since the messages arrived. Those between their stamps depend on the machine.
        assert 0.0 < status(talker)["cached_s"] <= 1.5
    finally:
        text = end(process)
        talker.estop.publish(Bool(data=False))
    assert process.returncode == 0, text
    (asked,), (stopped,), (recorded,) = folder.glob("*_door_stuck"), folder.glob("*_estop"), folder.glob("rec_*")
    with BagReader(recorded) as reader:
        # Latched before the recording began; the recorder may have read the value before it a moment earlier.
        stops = [deserialize(m.payload, m.type_name).data for m in reader.messages({"/operator/estop"})]
        assert stops in ([True], [False, True])
        values = [deserialize(m.payload, m.type_name).data for m in reader.messages({"/count"})]
        assert len(values) >= 20 and values == [values[0] + i for i in range(len(values))]
    with BagReader(asked) as reader:
        topics = {t.topic: t for t in reader.topics}
        # The latched value of long before is in it.
        assert topics["/operator/estop"].count >= 1 and topics["/operator/estop"].qos.name == "latched"
        values = [deserialize(m.payload, m.type_name).data for m in reader.messages({"/count"})]
        assert len(values) > 1 and values == [values[0] + i for i in range(len(values))]
        assert f"{sum(t.count for t in topics.values())} messages" in done.stdout  # as the command said
    with BagReader(stopped) as reader:
        stops = [(m.stamp_ns, deserialize(m.payload, m.type_name).data) for m in reader.messages({"/operator/estop"})]
        assert [value for _, value in stops] == [False, True] and abs(stops[1][0] - pressed_ns) < 2 * S
        # And what came of it, as far as a busy machine sent anything in that time.
        assert any(m.stamp_ns > stops[1][0] for m in reader.messages({"/count"}))


def test_player_is_steered_from_another_terminal(talker: Talker, tmp_path: Path) -> None:
    with BagWriter(tmp_path / "bag") as writer:
        for index in range(100):
            payload = bytes(serialize(Float32(data=float(index))))
            writer.write("/played", FLOAT, payload, 1_000 * S + index * S // 10, SENSOR)
    got: list[float] = []
    clock: list[int] = []
    listener = talker.node.subscribe("/played", Float32, lambda m: got.append(m.data))
    ticks = talker.node.subscribe("/clock", Clock, lambda m: clock.append(m.clock.sec * S + m.clock.nanosec))
    process = talker.start("bag", "play", tmp_path / "bag", "--start-paused")

    def seen() -> list[float]:
        talker.node.spin_once()
        return got

    try:
        wait_for(lambda: not seen() and len(clock) > 5, "the clock of a paused player")
        assert set(clock) == {1_000 * S} and not got  # never 0, and it stands
        assert talker.ic("bag", "control", "step").returncode == 0
        wait_for(lambda: seen() == [0.0], "the first message")
        assert talker.ic("bag", "control", "step", "2").returncode == 0
        wait_for(lambda: len(seen()) >= 2 and got[-1] == 2.0, "the third message")
        assert status(talker)["state"] == "paused" and status(talker)["sent"] == 3
        bad = talker.ic("bag", "control", "rate", "0")
        assert bad.returncode == 1 and "rate must lie in" in bad.stderr
        assert talker.ic("bag", "control", "rate", "3").returncode == 0
        assert status(talker)["rate"] == 3.0
        name = f"bag_player_{process.pid}"  # and as any other parameter
        assert NodeControl(talker.run_dir, name).set({"rate": 50.0}) == {"rate": 50.0}
        assert status(talker)["rate"] == 50.0
        assert talker.ic("bag", "control", "resume").returncode == 0
        wait_for(lambda: 99.0 in seen(), "the last message")
        assert process.wait(40) == 0
    finally:
        process.kill()
        text = process.communicate(timeout=10)[0]
    assert got == sorted(got) and got[-1] == 99.0, text
    assert clock[-1] == 1_009 * S + 9 * S // 10
    talker.node.drop(listener)
    talker.node.drop(ticks)
