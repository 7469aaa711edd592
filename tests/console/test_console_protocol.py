"""Frames and messages of the page's WebSocket."""

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from instant_ic.console.protocol import (
    FrameKind,
    PageFrame,
    PageProtocolError,
    Parts,
    decode_frame,
    encode_frame,
    number,
    parse_text,
    whole,
)

values = st.one_of(st.none(), st.booleans(), st.integers(-(2**53), 2**53), st.text(max_size=8))


@settings(max_examples=30)
@given(
    st.sampled_from(FrameKind),
    st.integers(0, 2**32 - 1),
    st.dictionaries(st.text(max_size=6), values, max_size=4),
    st.binary(max_size=64),
)
def test_a_frame_comes_back_as_it_was(kind, sequence, header, payload):
    frame = PageFrame(kind, sequence, header, payload)
    assert decode_frame(encode_frame(frame)) == frame


def test_layout_of_a_frame_by_hand():
    # version 1, kind 2, 0, sequence 5, header of 7 bytes, all little endian
    expected = bytes([1, 2, 0, 0, 5, 0, 0, 0, 7, 0, 0, 0]) + b'{"a":1}' + b"JPEG"
    assert encode_frame(PageFrame(FrameKind.VIEW, 5, {"a": 1}, b"JPEG")) == expected


def test_pieces_make_the_frame_they_are_of_and_a_missing_one_is_told():
    whole = encode_frame(PageFrame(FrameKind.LAYERS, 7, {"a": 1}, b"layers"))

    def part(start, end):
        return PageFrame(FrameKind.PART, 1, {"start": start, "size": len(whole)}, whole[start:end])

    parts = Parts()
    assert parts.take(part(0, 9)) is None
    assert parts.take(part(0, 5)) is None  # a new frame takes the place of an unfinished one
    assert parts.take(part(5, 20)) is None
    with pytest.raises(PageProtocolError, match=r"part.start must be 20 \(got 21\)"):
        parts.take(part(21, 24))
    assert parts.take(part(20, len(whole))) == PageFrame(FrameKind.LAYERS, 7, {"a": 1}, b"layers")


@given(st.text(max_size=40))
def test_any_text_is_a_message_or_a_protocol_error(text):
    try:
        message = parse_text(text)
    except PageProtocolError:
        return
    assert isinstance(message["type"], str)


@pytest.mark.parametrize("value", ["NaN", "Infinity", "1e999", "true", '"1"', "null", "1" + "0" * 400, "[1]"])
def test_only_finite_numbers_pass(value):
    with pytest.raises(PageProtocolError, match=r"drive\.linear"):
        number(parse_text(f'{{"type":"drive","linear":{value}}}'), "linear")


def test_limits_of_numbers_and_whole_numbers():
    message = {"type": "look", "yaw": 7, "seq": 1.0, "minus": -1}
    assert number(message, "yaw", 0, 7) == 7.0
    with pytest.raises(PageProtocolError, match="in"):
        number(message, "yaw", -6.3, 6.3)
    for key in ("seq", "minus", "missing"):
        with pytest.raises(PageProtocolError, match=key):
            whole(message, key)
