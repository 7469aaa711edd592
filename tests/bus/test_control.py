"""The control channel: parameters and log level of a running node, asked and changed from another process."""

import json
import logging
import os
import select
import signal
import socket
import subprocess
import sys
import threading
import time
from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated

import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from instant_ic.bus import Node, ParameterError, control
from instant_ic.bus.clock import SystemClock
from instant_ic.bus.control import ControlError, ControlServer, NodeBusyError, NodeControl
from instant_ic.bus.local_transport import LocalTransport
from instant_ic.bus.lockstep import LockstepBus
from instant_ic.bus.node_report import set_log_level
from instant_ic.config.params import yaml_value
from instant_ic.config.ranges import Positive, Range, check_ranges
from instant_ic.msg import deserialize


@dataclass(frozen=True)
class Inner:
    """Group.

    Attributes:
        gain: how much.
        low: lower end.
        high: upper end.
    """

    gain: Annotated[float, Range(0, 1)] = 0.5
    low: float = 1.0
    high: float = 2.0

    def __post_init__(self):
        check_ranges(self)
        if self.low >= self.high:
            raise ValueError(f"low must be below high (got {self.low}, {self.high})")


@dataclass(frozen=True)
class TunedConfig:
    """Parameters.

    Attributes:
        rate_hz: how often.
        label: a word.
        places: three numbers.
        port: where it listens.
        inner: group.
    """

    rate_hz: Positive = 10.0
    label: str = "a"
    places: tuple[float, float, float] = (1.0, 2.0, 3.0)
    port: int = 80
    inner: Inner = field(default_factory=Inner)

    def __post_init__(self):
        check_ranges(self)


class Tuned(Node[TunedConfig]):
    name = "tuned"
    live_parameters = ("rate_hz", "label", "places", "inner")

    def reconfigure(self, config):
        if config.label == "forbidden":
            raise ValueError("label must not be 'forbidden'")
        super().reconfigure(config)
        self.reconfigured_on = threading.current_thread()


@pytest.fixture
def tuned(tmp_path_factory):
    """A node with its control channel, spinning on a thread of its own."""
    run_dir = tmp_path_factory.mktemp("r")
    clock = SystemClock()
    node = Tuned(TunedConfig(), LocalTransport(run_dir, "tuned", clock.now_ns), clock)
    server = ControlServer(node, run_dir / "nodes" / "tuned.sock")
    node.start()
    node.server = server
    node.thread = threading.Thread(target=node.spin)
    node.thread.start()
    yield node, NodeControl(run_dir, "tuned")
    node.stop()
    node.thread.join(10)
    server.close()
    node.close()
    assert not (run_dir / "nodes" / "tuned.sock").exists()


def test_describe_and_get(tuned):
    _, client = tuned
    infos = {info.name: info for info in client.describe()}
    assert list(infos) == [
        *("rate_hz", "label", "places", "port", "inner.gain", "inner.low", "inner.high", "use_sim_time", "nice")
    ]
    gain = infos["inner.gain"]
    assert (gain.type, gain.value, gain.default, gain.range, gain.live) == ("float", 0.5, 0.5, "0..1", True)
    assert gain.description == "how much."
    assert infos["rate_hz"].range == "> 0" and infos["places"].value == [1.0, 2.0, 3.0]
    assert not infos["port"].live and not infos["nice"].live and infos["nice"].range == "0..19"
    assert client.get()["inner.high"] == 2.0


def test_set_is_taken_on_the_nodes_thread_and_told(tuned):
    node, client = tuned
    heard = []
    node.on_registry_change = lambda: heard.append(node.describe()["params"]["inner"]["gain"])
    deadline = time.monotonic() + 20
    changed = client.set({"inner.gain": 1, "places": [4, 5, 6], "label": "a"})
    assert changed == {"inner.gain": 1.0, "places": [4.0, 5.0, 6.0]}  # label is as before
    assert node.config == TunedConfig(places=(4.0, 5.0, 6.0), inner=Inner(gain=1.0))
    assert node.reconfigured_on is node.thread
    while not heard and time.monotonic() < deadline:
        time.sleep(0.01)
    assert heard == [1.0]  # ic param, the bag's metadata and others read the registry


def test_fault_a_text_is_set_with_its_password_masked(tuned):
    """``***`` stood in the node instead of the token."""
    node, client = tuned
    for text in ("http://h/?token=secret", "rtsp://me:secret@h/live"):
        client.set({"label": text})
        assert node.config.label == text and "secret" not in client.get()["label"]


def test_a_value_typed_by_hand_is_read_by_the_type_of_its_parameter(tuned):
    node, client = tuned
    client.set({"label": yaml_value("0123", "label"), "inner.gain": yaml_value("5e-01", "inner.gain")})
    assert node.config.label == "0123" and node.config.inner.gain == 0.5
    client.request({"op": "set", "values": {"inner.gain": 0.25, "label": "1:30"}})
    assert node.config.label == "1:30" and node.config.inner.gain == 0.25


@pytest.mark.parametrize(
    ("values", "words"),
    [
        ({"inner.gain": 1.5}, r"tuned: inner.gain must lie in 0..1 \(got 1.5\)"),
        ({"inner.gian": 0.1}, "unknown parameter 'inner.gian'; did you mean 'inner.gain'"),
        ({"label": "b", "inner.low": 3.0}, r"low must be below high \(got 3.0, 2.0\)"),
        ({"label": "forbidden"}, "tuned: label must not be 'forbidden'"),
        ({"label": "b", "port": 81}, "port takes effect at start: restart the node"),
        ({"nice": 3}, "nice takes effect at start"),
    ],
)
def test_what_is_refused_changes_nothing(tuned, values, words):
    node, client = tuned
    with pytest.raises(ParameterError, match=words):
        client.set(values)
    assert node.config == TunedConfig()


def test_values_that_hold_already_need_no_restart(tuned):
    """A whole dump can be loaded back."""
    _, client = tuned
    assert client.set({**client.get(), "rate_hz": 20.0}) == {"rate_hz": 20.0}


def test_busy_node_still_answers_and_drops_the_change(tuned, monkeypatch):
    node, client = tuned
    monkeypatch.setattr(control, "_CHANGE_S", 0.2)
    entered, go_on = threading.Event(), threading.Event()

    def long_work():
        entered.set()
        go_on.wait(30)

    node.call_soon(long_work)
    assert entered.wait(10)
    assert client.get()["rate_hz"] == 10.0
    status = client.status()
    assert "long_work" in status["busy"] and status["busy_s"] > 0 and status["pid"] == os.getpid()
    with pytest.raises(NodeBusyError, match=r"tuned is busy \(.*long_work has been running for .*nothing was changed"):
        client.set({"rate_hz": 20.0})
    go_on.set()
    monkeypatch.setattr(control, "_CHANGE_S", 10.0)
    assert client.set({"label": "later"}) == {"label": "later"}
    assert node.config.rate_hz == 10.0  # the dropped change did not come after all


def test_command_that_has_started_is_not_reported_as_dropped(tuned, monkeypatch):
    node, client = tuned
    monkeypatch.setattr(control, "_CHANGE_S", 0.2)
    go_on = threading.Event()
    node.commands = {"slow": lambda: go_on.wait(30)}
    words = ""
    while "has started the change" not in words:
        with pytest.raises(ControlError) as caught:
            client.call("slow")
        words = str(caught.value)
        # On a busy machine the node may not have begun in time; then the command was dropped.
        assert "it may still take effect" in words or isinstance(caught.value, NodeBusyError)
    go_on.set()


def test_log_level(tuned):
    node, client = tuned
    heard = []
    node.subscribe_received("/rosout", lambda m: heard.append(deserialize(m.payload, m.type_name)))
    deadline = time.monotonic() + 20
    while not node.node_report.rosout.subscriber_count and time.monotonic() < deadline:
        time.sleep(0.01)
    try:
        set_log_level(node.node_name, "info")
        node.log.debug("unheard")
        assert client.log_level() == "info" and client.log_level("debug") == "debug"
        node.log.debug("heard")
        logging.getLogger("instant_ic.bus").debug("of the library")
        while len(heard) < 2 and time.monotonic() < deadline:
            time.sleep(0.01)
        assert [(m.msg, m.level, m.name) for m in heard] == [("heard", 10, "tuned"), ("of the library", 10, "tuned")]
        with pytest.raises(ControlError, match="level must be one of debug, info, warning, error"):
            client.log_level("loud")
    finally:
        set_log_level(node.node_name, "notset")


@pytest.mark.parametrize(
    ("line", "words"),
    [
        (b"\xff\xfe", "not JSON"),
        (b"[1]", "expected a JSON object"),
        (b"[" * 100_000, "not JSON"),
        (b'{"op": "explode"}', "unknown op 'explode' (known: describe, set, log_level, status, call)"),
        (b'{"op": "set", "values": [1]}', 'set needs "values"'),
        (b'{"op": "set", "values": {"inner": 3}}', "is a group"),
    ],
)
def test_malformed_requests_are_refused(tuned, line, words):
    _, client = tuned
    with socket.socket(socket.AF_UNIX) as raw:
        raw.settimeout(10)
        raw.connect(str(client.run_dir / "nodes" / "tuned.sock"))
        raw.sendall(line + b"\n")
        answer = json.loads(raw.makefile().readline())
    assert not answer["ok"] and words in answer["error"]
    assert client.get()["rate_hz"] == 10.0


json_values = st.recursive(
    st.none() | st.booleans() | st.integers() | st.floats() | st.text(max_size=8),
    lambda inner: st.lists(inner, max_size=3) | st.dictionaries(st.text(max_size=8), inner, max_size=3),
    max_leaves=8,
)
keys = (
    st.sampled_from(["rate_hz", "label", "places", "port", "inner", "inner.gain", "inner.gain.x", "nice", ""])
    | st.text()
)


@settings(suppress_health_check=[HealthCheck.function_scoped_fixture], max_examples=60, deadline=None)
@given(st.binary(max_size=40), st.dictionaries(keys, json_values, max_size=3))
def test_whatever_is_asked_is_answered(tuned, line, values):
    """Bytes of any kind, and values of any kind: an answer, and a configuration that its own checks accept."""
    node, _ = tuned
    assert isinstance(node.server.answer(line)["ok"], bool)
    answer = node.server.answer(json.dumps({"op": "set", "values": values}).encode())
    assert answer["ok"] or (answer["kind"] in ("parameter", "request") and answer["error"])
    node.config.__post_init__()
    node.config.inner.__post_init__()


def test_too_long_a_request_and_too_many_connections(tuned):
    _, client = tuned
    path = str(client.run_dir / "nodes" / "tuned.sock")
    with socket.socket(socket.AF_UNIX) as raw:
        raw.settimeout(10)
        raw.connect(path)
        with pytest.raises(OSError):  # the server hangs up somewhere on the way
            for _ in range(100):
                raw.sendall(b"x" * control.MAX_REQUEST_BYTES)
            assert raw.recv(1) == b""
            raise ConnectionResetError
    idle = [socket.socket(socket.AF_UNIX) for _ in range(control.MAX_CONNECTIONS + 1)]
    try:
        for raw in idle:
            raw.settimeout(10)
            raw.connect(path)
        # The connection above may have ended only now, so that it is not always the last one that is refused.
        refused = select.select(idle, [], [], 10)[0][0]
        answer = json.loads(refused.makefile().readline())
        assert not answer["ok"] and "more than 8 connections" in answer["error"]
    finally:
        for raw in idle:
            raw.close()


def test_no_node_and_old_socket(tuned, tmp_path_factory):
    _, client = tuned
    with pytest.raises(ControlError, match=r"node 'tund' does not run in .*\(running: none\)"):
        NodeControl(client.run_dir, "tund").get()  # the fixture's node claims no place in the registry
    run_dir = tmp_path_factory.mktemp("r")
    (run_dir / "nodes").mkdir()
    with socket.socket(socket.AF_UNIX) as dead:
        dead.bind(str(run_dir / "nodes" / "gone.sock"))
    with pytest.raises(ControlError, match="node 'gone' does not run"):
        NodeControl(run_dir, "gone").get()


def test_stopped_process_is_told(tmp_path_factory):
    """A process that is stopped (or hangs altogether) is an error with words, not a wait without end."""
    run_dir = tmp_path_factory.mktemp("r")
    program = str(Path(__file__).with_name("talker_node.py"))
    process = subprocess.Popen(
        [sys.executable, program, "--run-dir", str(run_dir)], stderr=subprocess.DEVNULL, stdout=subprocess.DEVNULL
    )
    try:
        name = None
        deadline = time.monotonic() + 40
        while name is None and time.monotonic() < deadline:
            time.sleep(0.05)
            name = next((path.stem for path in (run_dir / "nodes").glob("*.sock")), None)
        assert name is not None
        assert NodeControl(run_dir, name, 20).status()["pid"] == process.pid
        process.send_signal(signal.SIGSTOP)
        with pytest.raises(ControlError, match=f"node {name} did not answer within 0.3 s"):
            NodeControl(run_dir, name, 0.3).get()
        process.send_signal(signal.SIGCONT)
        assert NodeControl(run_dir, name, 20).status()["pid"] == process.pid
        process.send_signal(signal.SIGINT)
        assert process.wait(20) == 0
        assert not list((run_dir / "nodes").glob("*.sock"))
    finally:
        process.kill()
        process.wait()


def test_lockstep_node_takes_parameters_too():
    with LockstepBus() as bus:
        node = bus.add(Tuned)
        assert node.parameters.set({"inner": {"gain": 0.25}}) == {"inner.gain": 0.25}
        assert node.config.inner.gain == 0.25 and node.parameters.infos()[4].value == 0.25
