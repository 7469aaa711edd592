"""Captures: all forms of pcap, pcapng, and every way in which they can be broken."""

from pathlib import Path

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from lidar_streams import DATA, SECOND, pcap, pcapng, udp_frame

from instant_ic.lidar.capture import CaptureError, CaptureReader, Datagram

STAMP = 1_546_303_466 * SECOND + 123_456_789
FRAMES = [(STAMP, udp_frame(b"first")), (STAMP + SECOND, udp_frame(b"second", port=8308))]


def read(tmp_path: Path, data: bytes) -> tuple[list[Datagram], CaptureReader]:
    path = tmp_path / "capture"
    path.write_bytes(data)
    reader = CaptureReader(path)
    return list(reader), reader


@pytest.mark.parametrize("order", ["<", ">"])
@pytest.mark.parametrize(("nano", "stamp"), [(False, STAMP // 1000 * 1000), (True, STAMP)])
def test_pcap_in_both_endiannesses_and_both_resolutions(tmp_path: Path, order: str, nano: bool, stamp: int) -> None:
    datagrams, reader = read(tmp_path, pcap(FRAMES, order, nano))
    assert datagrams == [(stamp, 2368, b"first"), (stamp + SECOND, 8308, b"second")]
    assert reader.datagrams == 2


@pytest.mark.parametrize("order", ["<", ">"])
@pytest.mark.parametrize(
    ("resolution", "stamp"), [(None, STAMP // 1000 * 1000), (9, STAMP), (3, STAMP // 10**6 * 10**6)]
)
def test_pcapng(tmp_path: Path, order: str, resolution: int | None, stamp: int) -> None:
    datagrams, _ = read(tmp_path, pcapng(FRAMES, order, resolution))
    assert datagrams == [(stamp, 2368, b"first"), (stamp + SECOND, 8308, b"second")]


def test_vlan_tags_and_other_link_types(tmp_path: Path) -> None:
    tagged, _ = read(tmp_path, pcap([(STAMP, udp_frame(b"tagged", vlan=True))]))
    assert tagged[0].payload == b"tagged"
    raw, _ = read(tmp_path, pcap([(STAMP, udp_frame(b"raw")[14:])], link=101))
    assert raw[0].payload == b"raw"
    cooked, _ = read(tmp_path, pcap([(STAMP, b"\0" * 14 + b"\x08\x00" + udp_frame(b"cooked")[14:])], link=113))
    assert cooked[0].payload == b"cooked"


def test_what_is_no_datagram_is_counted_by_reason(tmp_path: Path) -> None:
    whole = udp_frame(b"payload")
    tcp = bytearray(whole)
    tcp[23] = 6
    fragment = bytearray(whole)
    fragment[21] = 1
    arp = whole[:12] + b"\x08\x06" + b"\0" * 46
    frames = [
        (STAMP, bytes(tcp)),
        (STAMP, bytes(fragment)),
        (STAMP, arp),
        (STAMP, b"\xff"),
        (STAMP, whole[:-3]),
        (STAMP, whole),
    ]
    data = pcap(frames)
    datagrams, reader = read(tmp_path, data + b"\0" * 7)
    assert [datagram.payload for datagram in datagrams] == [b"payload"]
    assert reader.skipped == {
        "not UDP": 1,
        "IP fragment": 1,
        "not IPv4": 2,
        "cut datagram": 1,
        "cut record": 1,
    }
    assert [datagram.payload for datagram in reader] == [b"payload"]  # it can be read again
    assert reader.datagrams == 1


def test_file_that_is_no_capture_is_refused_in_words(tmp_path: Path) -> None:
    with pytest.raises(CaptureError, match=r"neither pcap nor pcapng: it starts with 47 49 46 38"):
        read(tmp_path, b"GIF89a")
    with pytest.raises(CaptureError, match="nothing"):
        read(tmp_path, b"")


@settings(max_examples=40)
@given(cut=st.integers(0, 400), flips=st.lists(st.tuples(st.integers(0, 399), st.integers(0, 255)), max_size=8))
@pytest.mark.parametrize("make", [pcap, pcapng])
def test_damaged_captures_never_raise(tmp_path_factory: pytest.TempPathFactory, make, cut: int, flips) -> None:  # type: ignore[no-untyped-def]
    data = bytearray(make(FRAMES))
    for at, value in flips:
        if 4 <= at < len(data):
            data[at] = value
    path = tmp_path_factory.getbasetemp() / "damaged"
    path.write_bytes(bytes(data[: max(4, cut)]))
    reader = CaptureReader(path)
    assert len(list(reader)) == reader.datagrams


@pytest.mark.real_data
def test_malformed_capture_of_a_real_sensor() -> None:
    path = DATA / "btlad_my.pcap"
    if not path.exists():
        pytest.skip(f"{path} is not there")
    reader = CaptureReader(path)
    sizes = [len(datagram.payload) for datagram in reader]
    assert (sizes.count(1206), sizes.count(512)) == (41, 36)
    assert reader.skipped == {"not IPv4": 1, "cut record": 1}
