"""Real UDP sockets."""

import socket
import time
from typing import Any

import pytest

from instant_ic.lidar.receiver import PacketReceiver, ReceiverConfig, ReceiverError

LOCAL = ReceiverConfig(host="127.0.0.1", port=0, position_port=0)


def collect(receiver: PacketReceiver, count: int) -> list[tuple[bytes, bool]]:
    found: list[tuple[bytes, bool]] = []
    deadline = time.monotonic() + 20.0
    while len(found) < count and time.monotonic() < deadline:
        for stamp_ns, payload, is_data in receiver.read(timeout_s=1.0):
            assert abs(time.time_ns() - stamp_ns) < 20_000_000_000
            found.append((payload, is_data))
    return found


def test_takes_data_and_position_packets_with_kernel_stamps() -> None:
    with PacketReceiver(LOCAL) as receiver, socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as sensor:
        sensor.sendto(b"d" * 1206, ("127.0.0.1", receiver.port))
        sensor.sendto(b"p" * 512, ("127.0.0.1", receiver.position_port))
        assert sorted(collect(receiver, 2)) == [(b"d" * 1206, True), (b"p" * 512, False)]
        assert list(receiver.read(timeout_s=0.01)) == []


def test_packets_of_another_host_are_counted_and_dropped() -> None:
    config = ReceiverConfig(host="127.0.0.1", port=0, position_port=-1, sensor="127.0.0.2")
    with PacketReceiver(config) as receiver:
        with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as stranger:
            stranger.sendto(b"x", ("127.0.0.1", receiver.port))
        with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as sensor:
            sensor.bind(("127.0.0.2", 0))
            sensor.sendto(b"y", ("127.0.0.1", receiver.port))
        assert collect(receiver, 1) == [(b"y", True)]
        assert receiver.sources.foreign == 1


def test_taken_port_is_told_with_what_to_do() -> None:
    with PacketReceiver(LOCAL) as first:
        config = ReceiverConfig(host="127.0.0.1", port=first.port, position_port=-1)
        with pytest.raises(ReceiverError, match=r"cannot be bound .* 'ss -ulpn'"):
            PacketReceiver(config)


def test_flood_on_one_port_does_not_keep_the_other_waiting() -> None:
    config = ReceiverConfig(host="127.0.0.1", port=0, position_port=0, sensor="127.0.0.2")
    with PacketReceiver(config) as receiver, socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as stranger:
        target = ("127.0.0.1", receiver.port)
        for _ in range(100):
            stranger.sendto(b"x", target)
        sources = receiver.sources
        admit = sources.admit

        def flooded(*arguments: Any) -> bool:
            stranger.sendto(b"x", target)  # one more for each that is read: this port is never empty
            return admit(*arguments)

        sources.admit = flooded  # type: ignore[method-assign]
        assert list(receiver.read(timeout_s=1.0)) == []
        assert 0 < sources.foreign <= 512
