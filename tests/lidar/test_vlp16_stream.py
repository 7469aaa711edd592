"""Revolutions, gaps and clocks from a stream of packets."""

import itertools
from pathlib import Path

import numpy as np
import pytest
from lidar_streams import DATA, SECOND, retimed, wall_stream

from instant_ic.lidar.capture import CaptureReader
from instant_ic.lidar.clock import DeviceClock
from instant_ic.lidar.config import DecoderConfig
from instant_ic.lidar.feed import PacketFeed
from instant_ic.lidar.packets import DATA_PACKET_BYTES, HOUR_US, PACKET_PERIOD_US
from instant_ic.lidar.stream import PacketStream, Revolution

START = 1_700_000_000 * SECOND


def received(index: int, start_ns: int = START, period_us: float = PACKET_PERIOD_US) -> int:
    """When a packet arrives that is sent as soon as it is full."""
    return start_ns + round((index + 1) * period_us * 1000.0)


def feed(stream: PacketStream, payloads: list[bytes], skip: tuple[int, ...] = ()) -> list[Revolution]:
    found = [stream.feed(payload, received(index)) for index, payload in enumerate(payloads) if index not in skip]
    return [revolution for revolution in found if revolution is not None]


def test_revolutions_are_cut_at_the_angle_and_hold_every_firing_once() -> None:
    payloads = wall_stream(300, 5.0, azimuth_cdeg=20000)
    stream = PacketStream(DecoderConfig(cut_angle_deg=180.0))
    revolutions = feed(stream, payloads)
    last = stream.finish()
    assert last is not None
    assert [revolution.complete for revolution in revolutions] == [False, True, True, True]
    for revolution in revolutions[1:]:
        azimuth = np.degrees(revolution.firing_azimuth)
        assert 180.0 <= azimuth[0] < 180.4
        assert 179.4 < azimuth[-1] < 180.0 + 0.2  # cut between blocks: a block's second firing may pass it
        assert revolution.end_ns - revolution.stamp_ns == pytest.approx(0.1 * SECOND, rel=2e-3)
    assert sum(len(r.firing_time) for r in [*revolutions, last]) == 300 * 24
    assert sum(len(r.points) for r in [*revolutions, last]) == 300 * 384


def test_stamps_are_the_time_of_firing_on_the_hosts_clock() -> None:
    payloads = wall_stream(200, 5.0, start_us=1_000_000, azimuth_cdeg=18000)
    stream = PacketStream()
    revolutions = feed(stream, payloads)
    # Ends follow starts without a hole; the first firing of all was at START.
    assert revolutions[0].stamp_ns == pytest.approx(START, abs=2000)
    for before, after in itertools.pairwise(revolutions):
        assert after.stamp_ns == pytest.approx(before.end_ns, abs=2000)
    times = revolutions[1].points["time"]
    assert times[0] >= 0.0
    assert (np.diff(times) >= 0.0).all()
    assert times[-1] == pytest.approx(0.1, abs=5e-4)


def test_late_delivery_does_not_move_the_stamps() -> None:
    # Packets that wait up to 10 ms on their way, as in bursts; one in eight comes at once.
    payloads = wall_stream(200, 5.0)
    prompt, bursty = PacketStream(), PacketStream()
    expected = feed(prompt, payloads)
    found = []
    for index, payload in enumerate(payloads):
        revolution = bursty.feed(payload, received(index | 7))
        if revolution is not None:
            found.append(revolution)
    # The first packets have no other to judge by; from the first burst's end on the offset is right.
    assert len(found) == len(expected) == 2
    assert found[1].stamp_ns == pytest.approx(expected[1].stamp_ns, abs=20_000)


def test_missing_packets_are_found_by_the_sensors_clock_and_counted() -> None:
    payloads = wall_stream(230, 5.0)
    stream = PacketStream()
    revolutions = feed(stream, payloads, skip=(100, 101, 102, 180))
    assert stream.counters.missing == 4
    assert [revolution.complete for revolution in revolutions] == [False, False, False]
    assert stream.counters.packets == 226


def test_hour_of_the_sensors_clock_rolls_over_unseen() -> None:
    payloads = wall_stream(230, 5.0, start_us=HOUR_US - 100_000)
    stream = PacketStream()
    revolutions = feed(stream, payloads)
    assert (stream.counters.missing, stream.counters.late, stream.counters.clock_resets) == (0, 0, 0)
    assert len(revolutions) == 3
    assert revolutions[2].stamp_ns - revolutions[1].stamp_ns == pytest.approx(0.1 * SECOND, rel=2e-3)


def same(ours: list[Revolution], theirs: list[Revolution]) -> None:
    assert len(ours) == len(theirs)
    for a, b in zip(ours, theirs, strict=True):
        assert (a.stamp_ns, a.end_ns, a.complete) == (b.stamp_ns, b.end_ns, b.complete)
        np.testing.assert_array_equal(a.points, b.points)


@pytest.mark.parametrize("over_us", [0, 200_000])  # the sensor never wraps, or late
def test_time_of_the_hour_that_runs_past_3600_s_is_taken_modulo_the_hour(over_us: int) -> None:
    """Of 400 packets 324 were dropped, and no revolution was made until the sensor wrapped."""
    payloads = wall_stream(400, 5.0, start_us=HOUR_US - 100_000)
    beyond = [
        retimed(payload, us + HOUR_US) if index > 75 and (us < over_us or not over_us) else payload
        for index, payload in enumerate(payloads)
        for us in [int.from_bytes(payload[1200:1204], "little")]
    ]
    wrapped, stream = PacketStream(), PacketStream()
    same(feed(stream, beyond), feed(wrapped, payloads))
    assert (stream.counters.packets, stream.counters.bad, stream.counters.clock_resets) == (400, 0, 0)


def test_repeated_late_and_foreign_packets_are_dropped_and_counted() -> None:
    payloads = wall_stream(10, 5.0)
    stream = PacketStream()
    for index in (0, 1, 2, 2, 1, 3):
        stream.feed(payloads[index], received(index))
    stream.feed(b"\0" * 1206, received(4))
    stream.feed(b"\xff\xee", received(4))
    stream.feed(payloads[4][:702] + b"\xa0\x8c" + payloads[4][704:], received(4))  # the 8th block's azimuth is 360.00
    stream.feed(payloads[4][:-1] + b"\x24", received(4))
    assert (stream.counters.packets, stream.counters.late, stream.counters.bad) == (4, 2, 4)
    assert stream.counters.bad_reason == "product 0x24 is not a VLP-16"


@pytest.mark.parametrize("before_us", [900_000_000, 2_700_000_000])  # back by a quarter of an hour, by three
def test_sensor_that_was_switched_on_anew_starts_a_new_clock(before_us: int) -> None:
    payloads = wall_stream(120, 5.0, start_us=before_us) + wall_stream(160, 5.0, start_us=5)
    stream = PacketStream()
    revolutions = feed(stream, payloads)
    assert stream.counters.clock_resets == 1
    assert stream.counters.missing == 0
    assert revolutions[-1].complete
    assert revolutions[-1].stamp_ns == pytest.approx(START + (120 + 75.35) * PACKET_PERIOD_US * 1000, abs=2e6)


def test_standing_head_does_not_fill_the_memory() -> None:
    payload = wall_stream(1, 5.0)[0]
    stream = PacketStream()
    revolutions = []
    for index in range(1000):
        timed = payload[:1200] + round(index * PACKET_PERIOD_US).to_bytes(4, "little") + payload[1204:]
        revolution = stream.feed(timed, received(index))
        if revolution is not None:
            revolutions.append(revolution)
    assert len(revolutions) == 2
    assert not any(revolution.complete for revolution in revolutions)


def test_clock_follows_drift_and_jumps_of_the_host() -> None:
    clock = DeviceClock()
    rng = np.random.default_rng(3)
    device_us = 0
    host_ns = START
    for index in range(2000):
        device_us += 1327
        host_ns += round(1_327_000 * (1.0 + 20e-6))  # 20 ppm apart
        unrolled = clock.take(device_us, host_ns + round(rng.exponential(300_000)))
        if index > 100:
            assert abs(clock.host_ns(unrolled) - host_ns) < 500_000
    host_ns += 3600 * SECOND  # somebody sets the host's clock
    for _ in range(30):
        device_us += 1327
        host_ns += 1_327_000
        unrolled = clock.take(device_us, host_ns)
    assert clock.resets == 1
    assert abs(clock.host_ns(unrolled) - host_ns) < 1000


@pytest.mark.parametrize("set_ms", [150, 3_600_000, -300])
def test_stamps_follow_a_host_whose_clock_is_set(set_ms: int) -> None:
    """By less than 0.5 s too: stamps that lag misplace the scan as the robot turns, or let it count as stale."""
    found = PacketFeed(DecoderConfig(), "", 0)
    done = []
    for index, payload in enumerate(wall_stream(400, 5.0)):
        steady_ns = received(index)
        host_ns = steady_ns + (set_ms * 1_000_000 if index >= 150 else 0)
        waited_ns = 150_000_000 if 250 <= index < 260 else 0  # until this process takes it: no setting
        done.append(found.take(payload, host_ns, steady_ns + waited_ns))
    revolutions = [one[0] for one in done if one is not None]
    assert revolutions[-1].end_ns == pytest.approx(received(375) + set_ms * 1_000_000, abs=0.1 * SECOND)
    assert revolutions[-1].end_ns - revolutions[-2].end_ns == pytest.approx(0.1 * SECOND, rel=0.01)


def recorded(stream: PacketStream, path: Path) -> list[Revolution]:
    """All revolutions of a capture, the parts at its begin and end too."""
    packets = [(data, stamp) for stamp, _, data in CaptureReader(path) if len(data) == DATA_PACKET_BYTES]
    found = [stream.feed(payload, stamp_ns) for payload, stamp_ns in packets]
    return [revolution for revolution in (*found, stream.finish()) if revolution is not None]


@pytest.mark.real_data
def test_revolutions_of_a_recording() -> None:
    path = DATA / "einride_recording.pcap"
    if not path.exists():
        pytest.skip(f"{path} is not there")
    stream = PacketStream()
    revolutions = recorded(stream, path)
    # 1000 packets, about 600 rpm, no gaps: 13 whole revolutions.
    assert [r.complete for r in revolutions] == [False] + [True] * 13 + [False]
    durations = np.array([r.end_ns - r.stamp_ns for r in revolutions[1:-1]]) * 1e-9
    np.testing.assert_allclose(durations, 0.1, rtol=2e-3)
    assert sum(len(r.firing_time) for r in revolutions) == 24000
    assert stream.counters.missing == 0


@pytest.mark.real_data
def test_recording_of_a_sensor_limited_to_a_sector_misses_no_packet() -> None:
    """Real packets of a sensor set to 320 to 41 degrees, at 300 rpm: two of them span the rest."""
    path = DATA / "btlad_my.pcap"
    if not path.exists():
        pytest.skip(f"{path} is not there")
    stream = PacketStream()
    revolutions = recorded(stream, path)
    assert [revolution.complete for revolution in revolutions] == [False, True, False]
    assert (stream.counters.packets, stream.counters.missing) == (41, 0)
    for revolution in revolutions:
        ahead = (np.degrees(revolution.firing_azimuth) + 180.0) % 360.0 - 180.0
        assert ahead.min() >= -40.1 and ahead.max() <= 41.1
        assert (np.diff(revolution.points["time"]) >= 0.0).all()
    assert revolutions[1].end_ns - revolutions[1].stamp_ns == pytest.approx(0.045 * SECOND, rel=0.02)  # 81 degrees
    assert revolutions[2].stamp_ns - revolutions[1].stamp_ns == pytest.approx(0.2 * SECOND, rel=0.01)
