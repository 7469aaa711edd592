"""Codec of the link, its topic list, its clock filter."""

import contextlib
import math

import pytest
from hypothesis import given
from hypothesis import strategies as st
from simulated_link import DIGEST, World

from instant_ic.bridge import host_protocol as protocol
from instant_ic.bridge.host_clock import ClockFilter
from instant_ic.bridge.host_flow import Channel, Item, Outbox, Window
from instant_ic.bridge.host_protocol import (
    Ack,
    Announce,
    Bye,
    Data,
    Hello,
    HostNotice,
    HostProtocolError,
    Ping,
    Pong,
    Refuse,
    Welcome,
    decode,
)
from instant_ic.bridge.host_topics import TopicRule, parse_rules

U16, U32 = st.integers(0, 2**16 - 1), st.integers(0, 2**32 - 1)
U64, I64 = st.integers(0, 2**64 - 1), st.integers(-(2**63), 2**63 - 1)
INT, TEXT = st.integers(-(2**70), 2**70), st.text(max_size=40)
WANTS = st.dictionaries(TEXT, st.floats(0, 1e5), max_size=5)


@st.composite
def data_messages(draw):
    chunk = draw(st.binary(max_size=300))
    offset = draw(st.integers(0, 2**31)) if chunk else 0
    total = offset + len(chunk) + (draw(st.integers(0, 2**20)) if chunk else 0)
    return Data(
        draw(U16), draw(U64), draw(I64), draw(I64), draw(I64), total, offset, chunk,
        draw(st.integers(0, 2)), draw(st.booleans()),
    )  # fmt: skip


MESSAGES = st.one_of(
    st.builds(Hello, st.just(protocol.VERSION), TEXT, TEXT, WANTS),
    st.builds(Welcome, st.just(protocol.VERSION), TEXT, TEXT, WANTS),
    st.builds(Bye, TEXT, TEXT),
    st.builds(Announce, INT, TEXT, TEXT, TEXT, TEXT, TEXT),
    st.builds(Refuse, INT, TEXT),
    st.builds(HostNotice, TEXT, TEXT),
    st.builds(Ping, U32, I64, I64),
    st.builds(Pong, U32, I64, I64, I64, I64),
    st.builds(Ack, I64, st.tuples(U64, U64, U64)),
    data_messages(),
)


@given(MESSAGES)
def test_what_is_encoded_is_decoded(message):
    assert decode(message.encode()) == message


@given(st.binary(max_size=200))
def test_any_bytes_are_a_message_or_an_error(data):
    try:
        message = decode(data)
    except HostProtocolError:
        return
    assert data[0] == message.KIND


@given(MESSAGES, st.data())
def test_a_cut_or_changed_message_is_a_message_or_an_error(message, data):
    frame = bytearray(message.encode())
    cut = data.draw(st.integers(0, len(frame)))
    if cut < len(frame):
        frame[cut] ^= data.draw(st.integers(1, 255))
    for damaged in (frame, frame[:cut]):
        with contextlib.suppress(HostProtocolError):
            decode(bytes(damaged))


def test_bytes_of_a_data_message_by_hand():
    message = Data(3, 7, 100, 200, 300, 10, 8, b"ab", lane=2, wall_time=True)
    expected = bytes([19, 0b101]) + (3).to_bytes(2, "little") + (10).to_bytes(4, "little") + (8).to_bytes(4, "little")
    expected += b"".join(n.to_bytes(8, "little") for n in (7, 100, 200, 300)) + b"ab"
    assert message.encode() == expected


@pytest.mark.parametrize(
    ("frame", "words"),
    [
        (b"", "unknown message"),
        (b"\x00rest", "unknown message"),
        (b"\x01not json", "not JSON"),
        (b"\x01[1]", "expected the fields"),
        (b'\x03{"code": "x"}', "expected the fields code, reason"),
        (b'\x03{"code": "x", "reason": 5}', "reason must be str"),
        (b'\x05{"channel": true, "reason": ""}', "channel must be int"),
        (b"\x10short", "bytes, 21 expected"),
        (b"\x13" + bytes(60), "impossible"),
        (b"\x01" + b"[" * 5000, "not JSON"),
    ],
)
def test_damaged_frames_say_what_is_wrong(frame, words):
    with pytest.raises(HostProtocolError, match=words):
        decode(frame)


def test_rules_by_line():
    rules = parse_rules(("/scan", "/lidar/points rate_hz=3 lane=bulk", "/estop lane=command max_age_s=0.5 shared=true"))
    assert rules["/scan"] == TopicRule("/scan", 0.0, "state", 0.0, False)
    assert rules["/lidar/points"] == TopicRule("/lidar/points", 3.0, "bulk")
    assert rules["/estop"] == TopicRule("/estop", 0.0, "command", 0.5, True)


@pytest.mark.parametrize(
    ("line", "words"),
    [
        ("", "empty line"),
        ("scan", "not a topic"),
        ("/scan rate", "'rate' is not one of rate_hz=, lane=, max_age_s=, shared="),
        ("/scan rate=5", "'rate=5' is not one of"),
        ("/scan rate_hz=fast", "rate_hz must be float"),
        ("/scan rate_hz=-1", "rate_hz must be >= 0"),
        ("/scan rate_hz=nan", "rate_hz must be >= 0"),
        ("/scan lane=express", "lane must be command, state, bulk"),
        ("/scan shared=yes", "shared must be bool"),
        ("/scan rate_hz=1 rate_hz=2", "once each"),
    ],
)
def test_wrong_lines_say_what_is_wrong(line, words):
    with pytest.raises(ValueError, match=words):
        parse_rules((line,))


@given(st.text(max_size=80) | st.from_regex(r"/[a-z]{1,5}( [a-z_]{1,9}=[a-z0-9.]{0,5}){0,3}", fullmatch=True))
def test_any_line_is_a_rule_or_an_error(line):
    try:
        rule = TopicRule.parse(line)
    except ValueError as error:
        assert str(error)
        return
    assert rule.topic == line.split()[0]


@pytest.mark.parametrize(
    ("own_hz", "wanted_hz", "expected"), [(5, 2, 20), (2, 5, 20), (0, 4, 40), (4, 0, 40), (0, 0, 100)]
)
@pytest.mark.parametrize("queued", [False, True])
def test_the_lower_of_both_rates_holds_and_thinning_is_no_loss(own_hz, wanted_hz, expected, queued):
    outbox = Outbox({"/tf": float(wanted_hz)})
    channel = Channel(1, TopicRule("/tf", rate_hz=own_hz), "n", "t", "d", "q", False, queued and not own_hz)
    sent = []
    for index in range(100):  # ten seconds of 10 Hz
        now = index * 100_000_000
        outbox.offer(channel, Item(b"x", now, now, index + 1), now)
        while (message := outbox.next(now)) is not None:
            if isinstance(message, Data):
                sent.append(message.sequence)
            outbox.acked(tuple(outbox.sent), 1_000_000, now)
    assert len(sent) == pytest.approx(expected, abs=1)
    assert sent == list(range(1, len(sent) + 1))
    assert outbox.counts["/tf"].thinned == 100 - len(sent)


def test_clock_exchange_by_hand():
    clock = ClockFilter()
    # We ask at 1000, it arrives at 5030 there, is answered at 5040, is back at 1050: 20 each way, 4010 ahead.
    sample = clock.add(1000, 5030, 5040, 1050)
    assert (sample.offset_ns, sample.rtt_ns) == (4010, 40)


def test_the_shortest_round_trip_counts_for_as_long_as_it_is_recent():
    clock = ClockFilter(window_s=10.0)
    clock.add(0, 1_000, 1_000, 2_000)  # round trip 2000, offset 0
    clock.add(1_000_000_000, 1_000_090_000, 1_000_090_000, 1_000_100_000)  # longer way there: offset 40 µs, wrong
    assert (clock.offset_ns, clock.min_rtt_ns) == (0, 2_000)
    assert clock.jitter_ns == pytest.approx(98_000 / math.sqrt(2))
    clock.add(11_000_000_000, 11_000_030_000, 11_000_030_000, 11_000_050_000)
    assert (clock.offset_ns, clock.min_rtt_ns) == (5_000, 50_000)


def test_stamps_that_cannot_be_are_left_out():
    clock = ClockFilter()
    assert clock.add(1000, 0, 2000, 1500) is None  # answered for longer than the whole took
    assert clock.add(1000, 10, 0, 1500) is None
    assert not clock.ready
    with pytest.raises(ValueError, match="no exchange"):
        _ = clock.offset_ns


def test_window_grows_without_a_queue_and_shrinks_with_one():
    window = Window(target_s=0.05, least=8192, most=1 << 20, start=65536)
    now = 0
    for _ in range(3):  # round trip of 20 ms, no queue: doubled by each window that arrives
        now += 20_000_000
        window.acked(int(window.size), 20_000_000, int(window.size), now)
    assert window.size == 65536 * 8
    window.acked(0, 120_000_000, int(window.size), now)  # one answer that is late may have met a busy process
    assert window.size == 65536 * 8
    window.acked(1000, 120_000_000, int(window.size), now)  # 100 ms of queue, twice the target: half
    assert window.size == 65536 * 4
    window.acked(1000, 120_000_000, int(window.size), now + 1)  # the same queue: once a round trip
    assert window.size == 65536 * 4
    for index in range(20):
        window.acked(1000, 520_000_000, int(window.size), now + index * 10**9)
    assert window.size == 8192 and window.chunk == 4096


@given(st.lists(st.one_of(MESSAGES.map(lambda message: message.encode()), st.binary(max_size=60)), max_size=8))
def test_no_message_of_a_linked_host_breaks_the_session(frames):
    """It is taken, refused, or ends the link; never an exception, which would end the links of all hosts."""
    world = World([TopicRule("/ic/state")], [TopicRule("/operator/cmd_vel", lane="command", max_age_s=0.25)])
    world.run(0.02)
    session = world.sessions["robot"]
    announce = Announce(1, "/operator/cmd_vel", "n", "std_msgs/msg/String", DIGEST, "sensor")
    for frame in (announce.encode(), *frames):
        session.receive(frame)
        for data in session.outgoing():
            decode(data)
        session.check()
        session.next_due_ns()
        assert session.ended is None or not session.up
