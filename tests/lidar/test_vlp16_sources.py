"""Whose packets are believed: forged and doubled senders withhold the scan (issue: a wall at 1 m became 20 m)."""

import pytest
from lidar_streams import SECOND, wall_stream

from instant_ic.lidar.packets import HOUR_US, PACKET_PERIOD_US
from instant_ic.lidar.sources import SourceGuard
from instant_ic.lidar.stream import PacketStream

SENSOR, STRANGER = "192.168.1.201", "192.168.1.66"
QUIET_NS = round(SourceGuard.QUIET_S * SECOND)


def admit(guard: SourceGuard, sender: tuple[str, int], now_ns: int, is_data: bool = True) -> bool:
    return guard.admit(sender, is_data, True, now_ns)


def test_first_sender_is_kept_and_a_second_one_withholds_until_it_is_quiet() -> None:
    guard = SourceGuard()
    assert admit(guard, (SENSOR, 2368), 0)
    assert guard.doubt(0) is None
    assert not admit(guard, (STRANGER, 2368), SECOND)
    doubt = guard.doubt(SECOND)
    assert doubt is not None and f"{STRANGER}:2368" in doubt and SENSOR in doubt and "`sensor`" in doubt
    assert admit(guard, (SENSOR, 2368), SECOND)
    assert guard.doubt(SECOND + QUIET_NS - 1) is not None
    assert guard.doubt(SECOND + QUIET_NS) is None
    assert guard.foreign == 1


def test_stranger_who_was_first_never_gives_way_to_the_sensor_unseen() -> None:
    guard = SourceGuard()
    admit(guard, (STRANGER, 2368), 0)
    for second in range(1, 60):  # the stranger is long silent, the sensor goes on
        assert not admit(guard, (SENSOR, 2368), second * SECOND)
        assert guard.doubt(second * SECOND) is not None


def test_configured_address_drops_the_others_without_stopping_the_robot() -> None:
    guard = SourceGuard(SENSOR)
    assert not admit(guard, (STRANGER, 2368), 0)
    assert admit(guard, (SENSOR, 2368), 0)
    assert guard.doubt(0) is None
    assert guard.foreign == 1


@pytest.mark.parametrize("sensor", ["", SENSOR])
def test_same_address_with_another_port_is_a_second_sender_while_the_first_is_heard(sensor: str) -> None:
    guard = SourceGuard(sensor)
    admit(guard, (SENSOR, 2368), 0)
    assert not admit(guard, (SENSOR, 40000), SECOND)
    assert guard.doubt(SECOND) is not None


def test_datagrams_that_are_no_packets_neither_lock_nor_withhold() -> None:
    guard = SourceGuard()
    assert guard.admit((STRANGER, 5), True, False, 0)  # for the stream to count
    assert admit(guard, (SENSOR, 2368), 0)
    assert not guard.admit((STRANGER, 5), True, False, 1)
    assert guard.doubt(1) is None


def fed(stream: PacketStream, guard: SourceGuard, payload: bytes, now_ns: int) -> None:
    counters = stream.counters
    before = counters.packets, counters.late + counters.clock_resets
    stream.feed(payload, now_ns)
    after = counters.packets, counters.late + counters.clock_resets
    guard.count(after[0] - before[0], after[1] - before[1], now_ns)


@pytest.mark.parametrize("ahead_us", [90_000, 700_000, HOUR_US - 90_000, 0, 663])
def test_forged_sender_with_the_sensors_own_address_is_found_by_the_order_of_packets(ahead_us: int) -> None:
    real = wall_stream(150, 1.0, start_us=5_000_000)
    forged = wall_stream(150, 20.0, start_us=(5_000_000 + ahead_us) % HOUR_US)
    stream, guard = PacketStream(), SourceGuard(SENSOR)
    for index in range(75):
        fed(stream, guard, real[index], index)
    assert guard.doubt(75) is None
    for index in range(75, 85):
        fed(stream, guard, forged[index], index)
        fed(stream, guard, real[index], index)
    assert guard.doubt(85) is not None


def test_a_few_packets_out_of_order_are_tolerated_and_a_few_per_cent_are_not() -> None:
    def doubt(every: int) -> str | None:
        guard = SourceGuard()
        for index in range(7540):  # 10 s
            guard.count(1, int(index % every == 0), 0)
        return guard.doubt(0)

    assert doubt(every=50) is None  # 2 %
    assert doubt(every=25) is not None  # 4 %


def test_clock_that_is_reset_once_does_not_withhold() -> None:
    stream, guard = PacketStream(), SourceGuard()
    for index, payload in enumerate(wall_stream(100, 5.0, start_us=900_000_000) + wall_stream(100, 5.0)):
        fed(stream, guard, payload, round(index * PACKET_PERIOD_US * 1000))
    assert stream.counters.clock_resets == 1
    assert guard.doubt(0) is None
