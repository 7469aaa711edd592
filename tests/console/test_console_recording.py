"""Record, snapshot, bookmark and export: what the recorder is asked, and what the page is told when it cannot."""

import queue
import re
import threading

import pytest
from console_servers import DRIVE, WAIT_S, WATCH

from instant_ic.bus.control import ControlServer
from instant_ic.bus.lockstep import LockstepBus
from instant_ic.console import ConsoleClient
from instant_ic.console.config import ConsoleConfig
from instant_ic.console.recording import MOST_PENDING, RecorderError, RecordingDesk
from nodes.console import ConsoleNode


class FakeRecorder:
    def __init__(self):
        self.asked, self.state, self.error, self.refusal = [], "idle", "", ""

    def ask(self, command, **arguments):
        if self.refusal:
            raise RecorderError(self.refusal)
        if command == "status":
            recording = {
                "state": self.state, "path": "/d/rec_1", "seconds": 12.5, "bytes": 3_000_000, "messages": 9,
                "error": self.error, "free_bytes": 10**9,
            }  # fmt: skip
            return {"path": "/d", "error": "", "cached_s": 60.0, "recording": recording}
        self.asked.append((command, arguments))
        if command == "record":
            self.state = "recording"
        return {"path": "/d/rec_1"}


@pytest.fixture
def desk():
    """A desk, its recorder, and a wait for what it tells the page."""
    recorder, told = FakeRecorder(), queue.Queue()
    made = RecordingDesk(recorder.ask, told.put)
    yield made, recorder, lambda: told.get(timeout=WAIT_S)
    made.stop()
    assert not [thread for thread in threading.enumerate() if thread.name.startswith("recording desk")]


def test_a_recording_is_begun_told_and_ended(desk):
    made, recorder, report = desk
    made.poll()
    told = report()
    assert (told["recorder"], told["state"]) == ("ok", "idle")
    made.record(True)
    told = report()
    assert told["state"] == "recording"
    assert (told["path"], told["seconds"], told["bytes"], told["free_bytes"]) == ("/d/rec_1", 12.5, 3_000_000, 10**9)
    assert told["notice"] == {"number": 1, "text": "Recording to rec_1", "level": "ok"}
    made.record(False)
    made.snapshot()
    assert (report()["notice"]["number"], (told := report())["notice"]["number"]) == (2, 3)
    assert recorder.asked == [("record", {}), ("stop", {}), ("snapshot", {"reason": "operator"})]
    assert told["notice"]["text"] == "Saving the last minute: rec_1"


def test_a_missing_recorder_and_a_refusal_are_told_in_words_and_the_next_wish_counts(desk):
    made, recorder, report = desk
    recorder.refusal = "No recorder is running. Launch the station with recorder:=true."
    made.record(True)
    told = report()
    assert told["notice"] == {"number": 1, "text": recorder.refusal, "level": "error"}
    assert (told["recorder"], told["state"], told["text"]) == ("missing", "none", recorder.refusal)
    recorder.refusal = ""
    made.record(True)
    told = report()
    assert (told["notice"]["number"], told["notice"]["level"]) == (2, "ok")


def test_the_polls_of_a_recorder_that_hangs_displace_no_command():
    answers, reports = queue.Queue(), queue.Queue()

    def ask(command):
        answers.get(timeout=WAIT_S)
        return {"path": f"/d/{command}"}

    desk = RecordingDesk(ask, reports.put)
    for _ in range(2 * MOST_PENDING):
        desk.poll()
    desk.record(True)
    for _ in range(3):  # the first poll, the command, the status after it
        answers.put(None)
    notices = [reports.get(timeout=WAIT_S)["notice"]["text"] for _ in range(2)]
    desk.stop()
    assert notices == ["", "Recording to record"]


# ---- the node --------------------------------------------------------------------------------------


@pytest.fixture
def node():
    with LockstepBus(1_000_000_000) as bus:
        yield bus, bus.add(ConsoleNode, ConsoleConfig())


def test_a_bookmark_goes_to_the_bus_so_that_every_bag_has_it(node):
    bus, console = node
    console.on_recorder("bookmark", False)
    assert re.fullmatch(r"bookmark \d\d:\d\d:\d\d", bus.last("/operator/bookmark").data)


def test_the_recorder_is_asked_over_its_control_channel(node, tmp_path, monkeypatch):
    _, console = node
    with pytest.raises(RecorderError, match="recorder is not available"):
        console.ask_recorder("status")
    monkeypatch.setattr(ConsoleNode, "run_dir", tmp_path)
    (tmp_path / "nodes").mkdir()
    with pytest.raises(RecorderError, match=r"No recorder is running\. .* recorder:=true \(node operator_recorder\)"):
        console.ask_recorder("status")

    class Recorder:
        def __init__(self):
            self.node_name, self.run_state = "operator_recorder", "RUNNING"
            self.commands = {"status": lambda: {"path": "/d"}, "stop": lambda: int("nothing is being recorded")}

        def call_soon(self, function):
            threading.Thread(target=function).start()

    server = ControlServer(Recorder(), tmp_path / "nodes" / "operator_recorder.sock")
    try:
        assert console.ask_recorder("status") == {"path": "/d"}
        with pytest.raises(RecorderError, match=r"recorder: stop: .*nothing is being recorded"):
            console.ask_recorder("stop")
    finally:
        server.close()


# ---- the server ------------------------------------------------------------------------------------


async def test_drivers_record_and_watchers_may_not(serve, files):
    server = serve(access=files)
    async with (
        ConsoleClient(server.url, token=DRIVE) as driver,
        ConsoleClient(server.url, token=WATCH) as watcher,
    ):
        for message in ({"type": "record", "on": True}, {"type": "snapshot"}, {"type": "bookmark"}):
            await watcher.send(message)
        await watcher.wait_for(lambda c: c.refused == ["watch_only"] * 3, WAIT_S)
        assert server.backend.recorder == []
        await driver.send({"type": "record", "on": True})
        await driver.send({"type": "snapshot"})
        await driver.send({"type": "bookmark"})
        await driver.send({"type": "record", "on": False})
        await server.backend.wait(lambda b: len(b.recorder) == 4)
        assert server.backend.recorder == [
            ("record", True),
            ("snapshot", False),
            ("bookmark", False),
            ("record", False),
        ]
        for bad in ({"type": "record"}, {"type": "record", "on": 1}):
            await driver.send(bad)
        await driver.wait_for(lambda c: len(c.errors) == 2, WAIT_S)
