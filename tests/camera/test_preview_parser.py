"""The live preview's stream, whole and broken, in pieces of any size."""

import cv2
import numpy as np
import pytest
from fake_theta import jpeg, part
from hypothesis import example, given, settings
from hypothesis import strategies as st

from instant_ic.camera.preview import PreviewParser
from instant_ic.util.jpeg import JpegError, check_whole, jpeg_size

FRAMES = [jpeg(value) for value in (40, 80, 120, 160, 200)]
RICOH, RFC = "---osclivepreview---", "-----osclivepreview---"


def parse(stream: bytes, sizes: list[int] | None = None) -> tuple[list[bytes], PreviewParser]:
    parser = PreviewParser("---osclivepreview---")
    found: list[bytes] = []
    at = 0
    for size in sizes or []:
        found += parser.feed(stream[at : at + size])
        at += size
    return found + parser.feed(stream[at:]), parser


@pytest.mark.parametrize("boundary", [RICOH, RFC])
def test_both_boundary_forms_give_every_frame(boundary: str) -> None:
    found, parser = parse(b"".join(part(frame, boundary) for frame in FRAMES))
    assert found == FRAMES
    assert parser.bad_frames == 0


@given(st.lists(st.integers(1, 900), max_size=60))
def test_size_of_the_pieces_does_not_matter(sizes: list[int]) -> None:
    found, parser = parse(b"".join(part(frame) for frame in FRAMES), sizes)
    assert found == FRAMES
    assert parser.bad_frames == 0


@settings(max_examples=60)
@given(st.integers(1, len(FRAMES[1]) - 1), st.lists(st.integers(1, 500), max_size=40), st.sampled_from([RICOH, RFC]))
@example(len(FRAMES[1]) - 1, [], RFC)
def test_cut_frame_costs_only_itself(kept: int, sizes: list[int], boundary: str) -> None:
    stream = part(FRAMES[0], boundary) + part(FRAMES[1][:kept], boundary, length=len(FRAMES[1]))
    stream += b"".join(part(frame, boundary) for frame in FRAMES[2:])
    found, parser = parse(stream, sizes)
    assert found == [FRAMES[0], *FRAMES[2:]]
    assert parser.bad_frames == 1
    # Cut by a few bytes only, the frame's announced end lies within the next boundary: told by the missing end marker.
    assert "truncated" in parser.last_fault


@pytest.mark.parametrize("head", ["Content-type: image/jpeg", "Content-Length: 99999999999", "Content-Length: 0"])
def test_part_without_a_usable_length_is_skipped(head: str) -> None:
    bad = f"{RICOH}\r\n{head}\r\n\r\n".encode() + FRAMES[1] + b"\r\n"
    found, parser = parse(part(FRAMES[0]) + bad + part(FRAMES[2]))
    assert found == [FRAMES[0], FRAMES[2]]
    assert parser.bad_frames == 1


@settings(max_examples=100)
@given(st.binary(max_size=6000), st.lists(st.integers(1, 700), max_size=20))
def test_rubbish_neither_raises_nor_fills_the_memory(rubbish: bytes, sizes: list[int]) -> None:
    found, parser = parse(rubbish, sizes)
    assert found == [] or all(frame[:2] == b"\xff\xd8" for frame in found)
    assert parser.waiting <= max(4096, len(rubbish))


@pytest.mark.parametrize("progressive", [0, 1])
def test_size_by_the_header_is_that_of_the_decoded_picture(progressive: int) -> None:
    image = np.zeros((48, 96, 3), np.uint8)
    data = cv2.imencode(".jpg", image, [cv2.IMWRITE_JPEG_PROGRESSIVE, progressive])[1].tobytes()
    assert jpeg_size(data) == (96, 48)


@given(st.binary(max_size=400))
def test_size_of_anything_is_a_size_or_an_error(data: bytes) -> None:
    for candidate in (data, b"\xff\xd8" + data):
        try:
            width, height = jpeg_size(candidate)
        except JpegError:
            continue
        assert 0 <= width < 65536 and 0 <= height < 65536


def test_whole_jpegs_are_told_from_cut_ones() -> None:
    check_whole(FRAMES[0])
    with pytest.raises(JpegError, match="SOI"):
        check_whole(b"GIF89a")
    with pytest.raises(JpegError, match="truncated"):
        check_whole(FRAMES[0][:-5])
