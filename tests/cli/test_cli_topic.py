"""``ic topic`` against a node in a process of its own."""

import json
import re
import time
from types import SimpleNamespace

import numpy as np
import pytest
from cli_helpers import talking, wait_until
from hypothesis import given
from hypothesis import strategies as st

from instant_ic.bus import RELIABLE
from instant_ic.bus.local_transport import LocalTransport
from instant_ic.cli.errors import UserError
from instant_ic.cli.message_input import build, parse
from instant_ic.cli.messages import describe, json_line
from instant_ic.cli.topic_watch import Rate, losses, size_text
from instant_ic.msg import Bool, deserialize, message_type, serialize, stamp_ns, typestore


@pytest.fixture(autouse=True)
def in_run_dir(talker, monkeypatch):
    monkeypatch.setenv("INSTANT_IC_RUN_DIR", str(talker))


def test_list(ic):
    topics = ic("topic", "list")[1].split()
    assert {"/scan", "/flag", "/heartbeat", "/order"} <= set(topics) and topics == sorted(topics)
    assert "/scan [sensor_msgs/msg/LaserScan]\n" in ic("topic", "list", "-t")[1]
    out = ic("topic", "list", "-v")[1]
    assert re.search(r"/scan +sensor_msgs/msg/LaserScan +talker \(sensor\) +- *\n", out)
    assert re.search(r"/order +geometry_msgs/msg/TwistStamped +- +talker *\n", out)


def test_run_dir_as_an_option(ic, tmp_path, monkeypatch, talker):
    monkeypatch.setenv("INSTANT_IC_RUN_DIR", str(tmp_path))
    assert ic("topic", "list")[:2] == (0, "")
    assert "/scan" in ic("--run-dir", str(talker), "topic", "list")[1]


def test_type_and_find(ic):
    assert ic("topic", "type", "scan")[:2] == (0, "sensor_msgs/msg/LaserScan\n")
    for name in ("sensor_msgs/msg/LaserScan", "sensor_msgs/LaserScan", "LaserScan"):
        assert ic("topic", "find", name)[:2] == (0, "/scan\n")
    assert ic("topic", "find", "other_msgs/LaserScan")[:2] == (0, "")
    assert "# frame" in ic("topic", "type", "LaserScan")[1]
    assert "did you mean 'LaserScan'?" in ic("topic", "type", "LaserScam")[2]
    status, _, error = ic("topic", "type", "/scam")
    assert status == 1 and "did you mean '/scan'?" in error


def test_info(ic):
    status, out, _ = ic("topic", "info", "scan")
    assert status == 0 and re.search(r"talker +publishes +sensor_msgs/msg/LaserScan +sensor +\d+", out)
    assert re.search(r"talker +subscribes +geometry_msgs/msg/TwistStamped +\d+", ic("topic", "info", "/order")[1])
    status, _, error = ic("topic", "info", "/scam")
    assert status == 1 and "no node publishes or subscribes to it (did you mean '/scan'?)" in error


def test_info_verbose_tells_rates_of_the_heartbeat(ic):
    publisher = r"nominal rate: 10 Hz\n(?:.*\n)*talker +publishes +.* +([\d.]+) Hz, newest ([\d.]+) s ago"
    found = wait_until(lambda: re.search(publisher, ic("topic", "info", "-v", "/scan")[1]), "a heartbeat in time")
    assert 0 < float(found[1]) < 60
    reader = r"talker +subscribes +.* +no message yet"
    wait_until(lambda: re.search(reader, ic("topic", "info", "-v", "/order")[1]), "a heartbeat in time")


def test_echo(ic):
    assert ic("topic", "echo", "/flag", "--once", "--timeout", "30")[:2] == (0, "data: true\n---\n")
    status, out, _ = ic("topic", "echo", "/scan", "-n", "2", "--timeout", "30")
    assert status == 0 and out.count("---") == 2 and "frame_id: hello" in out
    assert "ranges: [0.0, 1.0, 2.0, 3.0, 4.0, 5.0, '... 40 values']" in out
    out = ic("topic", "echo", "/scan", "--once", "--field", "ranges.3")[1]
    assert out == "3.0\n---\n"
    assert "39.0]" in ic("topic", "echo", "/scan", "--once", "--full")[1]
    message = json.loads(ic("topic", "echo", "/scan", "--once", "--json")[1])
    assert message["header"]["frame_id"] == "hello" and message["ranges"][39] == 39.0
    status, _, error = ic("topic", "echo", "/scan", "--once", "--field", "range")
    assert status == 2 and "no field 'range'" in error
    status, _, error = ic("topic", "echo", "/scam", "--timeout", "0.3")
    assert status == 1 and "/scam has no publisher (did you mean '/scan'?); waiting for it" in error
    status, _, error = ic("topic", "echo", "/heard", "--timeout", "0.3")
    assert status == 1 and "/heard has a publisher that sends nothing" in error
    status, out, error = ic("topic", "echo", "/flag", "-n", "2", "--timeout", "0.5")
    assert status == 1 and out.count("---") == 1 and error == "ic: only 1 message received in 0 s\n"


def test_hz_bw_and_delay(ic):
    status, out, _ = ic("topic", "hz", "/scan", "/flag", "--duration", "1.1")
    found = re.findall(r"/scan +average rate: ([\d.]+)  min: .*s max: .*s std dev: .*s window: (\d+)  lost: 0", out)
    assert status == 0 and 0 < float(found[-1][0]) < 60 and int(found[-1][1]) > 2
    assert re.search(r"/flag +too few messages yet", out)
    # CDR by hand: 4 + stamp 8 + frame_id 4 + 6, padded to 20, 7 floats 28, ranges 4 + 160, intensities 4, and 4 before.
    status, out, _ = ic("topic", "bw", "/scan", "--duration", "0.3")
    sizes = "size mean: 220 B min: 220 B max: 220 B"
    assert status == 0 and re.search(rf"[\d.]+ kB/s from \d+ messages  {sizes}", out), out
    status, out, _ = ic("topic", "delay", "/scan", "--duration", "0.3")
    found = re.findall(r"average delay: ([\d.]+)  min", out)
    assert status == 0 and 0.24 < float(found[-1]) < 30
    status, _, error = ic("topic", "delay", "/flag", "--duration", "30")
    assert status == 2 and "std_msgs/msg/Bool has no stamp" in error
    status, _, error = ic("topic", "hz", "/nothing", "--duration", "0.2")
    assert status == 1 and "/nothing has no publisher" in error


def test_pub_reaches_the_node(ic, talker):
    heard = []
    transport = LocalTransport(talker, "ears", time.time_ns)
    subscription = transport.subscribe("/heard", "std_msgs/msg/String", RELIABLE, lambda: None)
    deadline = time.monotonic() + 30
    try:
        values = "{header: auto, twist: {linear: {x: 0.25}}}"
        status, out, error = ic("topic", "pub", "/order", "TwistStamped", values, "-n", "3", "-r", "50")
        assert status == 0, error
        assert out.count("publishing #") == 3 and "    x: 0.25" in out
        while len(heard) < 3 and time.monotonic() < deadline:
            heard += [deserialize(r.payload, r.type_name).data for r in subscription.take()]
            time.sleep(0.01)
    finally:
        transport.close()
    assert len(heard) == 3
    value, stamp = heard[0].split()
    assert value == "0.25" and abs(int(stamp) - time.time()) < 60


@pytest.mark.parametrize(
    ("words", "told"),
    [
        (("/order", "TwistStamped", "{twist: {liner: {x: 1}}}"), "no field 'twist.liner' (did you mean 'linear'?)"),
        (("/order", "TwistStamped", "{twist: {linear: {x: fast}}}"), "twist.linear.x must be float64 (got 'fast')"),
        (("/order", "TwistStamped", "{twist: [1"), "the value is not YAML"),
        (("/order", "Twits", "{}"), "did you mean 'Twist'?"),
        (("/order", "Bool", "{data: true}"), "/order has type geometry_msgs/msg/TwistStamped in talker"),
        (("/flag", "Bool", "true"), "must be a mapping such as '{data: ...}' (got 'true')"),
        (("/operator/estop", "Bool", "{}"), "release the emergency stop where it was set"),
        (("/a-b", "Bool", "{data: true}"), "topic name '/a-b' is not legal"),
    ],
)
def test_pub_refuses_what_does_not_fit(ic, words, told):
    status, out, error = ic("topic", "pub", "--once", *words)
    assert status in (1, 2) and told in error and out == ""


def test_pub_waits_for_readers_only_so_long(ic):
    status, out, error = ic("topic", "pub", "--once", "--max-wait-time-secs", "0.2", "/lonely", "Bool", "{data: true}")
    assert status == 1 and out == "" and "/lonely: 0 of 1 subscribers within 0.2 s" in error


def test_pub_beside_the_writer_of_cmd_vel_is_refused(ic, tmp_path_factory, monkeypatch):
    """A second writer of /cmd_vel would drive the robot past the arbiter's checks."""
    run_dir = tmp_path_factory.mktemp("r")
    monkeypatch.setenv("INSTANT_IC_RUN_DIR", str(run_dir))
    pub = ("topic", "pub", "--once", "-w", "0", "/cmd_vel", "TwistStamped", "{twist: {linear: {x: 0.1}}}")
    status, out, error = ic(*pub)
    assert status == 0 and "/cmd_vel moves the robot" in error and "publishing #1" in out
    with talking(run_dir, "-p", "drives:=true"):
        status, out, error = ic(*pub)
        assert status == 2 and "/cmd_vel is published by talker, which keeps the robot safe" in error and out == ""
        status, out, error = ic(*pub, "--force")
        assert status == 0 and "beside talker" in error and "publishing #1" in out


# -- figures and messages, without a bus -----------------------------------------------------------


def test_rate_of_known_arrivals():
    """Arrivals at 0, 100, 200, 400 ms: mean gap 133.3 ms, so 7.5 Hz; standard deviation 47.14 ms."""
    rate = Rate(100)
    assert rate.line() == ""
    for ms in (0, 100, 200, 400):
        rate.add(SimpleNamespace(received_ns=ms * 1_000_000))
    assert rate.line() == "average rate: 7.500  min: 0.1000s max: 0.2000s std dev: 0.04714s window: 3"
    for ms in (1, 51):  # back in time: a bag that begins anew
        rate.add(SimpleNamespace(received_ns=ms * 1_000_000))
    assert rate.line().startswith("average rate: 20.000")


def test_texts_of_sizes_and_losses():
    assert [size_text(n) for n in (12, 1500, 2_500_000, 3e9)] == ["12 B", "1.50 kB", "2.50 MB", "3.00 GB"]
    assert losses({}) == "0" and losses({"b": 1, "a": 2}) == "3 (a 2, b 1)"


def test_every_type_can_be_built_empty_and_sent():
    names = list(typestore().types)
    assert len(names) > 150
    for name in names:
        payload = serialize(build(name, {}, 5_000_000_007))
        assert type(deserialize(payload, name)) is message_type(name)


def test_auto_and_now():
    stamped = build("TwistStamped", {"header": "auto"}, 5_000_000_007)
    assert stamp_ns(stamped) == 5_000_000_007 and stamped.header.frame_id == ""
    pose = build("PoseStamped", {"header": {"stamp": "now", "frame_id": "map"}}, 7)
    assert stamp_ns(pose) == 7 and pose.header.frame_id == "map" and pose.pose.orientation.w == 1.0


def test_arrays_are_of_the_types_that_the_message_has():
    scan = build("LaserScan", parse("{ranges: [1, 2.5, .inf, 1e-3]}", "LaserScan"), 0)
    assert scan.ranges.dtype == np.float32 and scan.ranges[3] == np.float32(1e-3)
    with pytest.raises(UserError, match=r"pose\.covariance must have 36 values"):
        build("Odometry", {"pose": {"covariance": [1, 2]}}, 0)
    path = build("Path", {"poses": [{"pose": {"position": {"x": 3}}}]}, 0)
    assert path.poses[0].pose.position.x == 3.0
    with pytest.raises(UserError, match=r"poses\[0\].pose.position.x must be float64 \(got \[\]\)"):
        build("Path", {"poses": [{"pose": {"position": {"x": []}}}]}, 0)


@given(st.integers(-(2**70), 2**70))
def test_integers_are_held_to_their_size(value):
    fits = 0 <= value <= 255
    try:
        assert build("UInt8", {"data": value}, 0).data == value and fits
    except UserError as error:
        assert not fits and "data must be uint8, 0..255" in str(error)


def test_messages_as_text():
    assert json_line(Bool(data=True)) == '{"data": true}'
    path = build("Path", {"header": {"frame_id": 'a,"b'}, "poses": [{}]}, 0)
    assert json.loads(json_line(path))["poses"][0]["pose"]["orientation"] == {"x": 0.0, "y": 0.0, "z": 0.0, "w": 1.0}
    assert describe(build("String", {"data": "x" * 30}, 0), most=2) == f"data: {'x' * 20}... 30 characters"
