"""A sensor with a limited field of view, against what its head did: azimuth and time of each ray, turns, losses."""

import numpy as np
import pytest
from lidar_streams import SECOND, Limited, limited_stream

from instant_ic.lidar.config import DecoderConfig
from instant_ic.lidar.flatscan import coverage
from instant_ic.lidar.head import Sector
from instant_ic.lidar.stream import PacketStream, Revolution

START = 1_700_000_000 * SECOND
CASES = [  # field of view and speed
    ((270.0, 90.0), 600.0), ((45.0, 315.0), 1200.0), ((0.0, 359.0), 300.0), ((170.0, 190.0), 600.0),
    ((100.0, 111.0), 600.0), ((0.0, 360.0), 600.0),
]  # fmt: skip


def feed(stream: PacketStream, made: Limited, lost: frozenset[int] = frozenset()) -> list[Revolution]:
    found = [
        stream.feed(payload, START + round(made.sent_s[index] * SECOND))
        for index, payload in enumerate(made.payloads)
        if index not in lost
    ]
    return [revolution for revolution in found if revolution is not None]


def passages(made: Limited, cut_deg: float, lost: frozenset[int] = frozenset()) -> int:
    """How often the head passes the cut angle from one block that arrives to the next one, after the first packet."""
    blocks = np.delete(made.block_deg, sorted(lost), axis=0).reshape(-1)[made.block_deg.shape[1] - 1 :]
    return int((np.diff(np.floor((blocks - cut_deg) / 360.0)) > 0).sum())


def check_rays(revolutions: list[Revolution], made: Limited, lost: frozenset[int] = frozenset()) -> None:
    """Every ray that arrives gives one point, where and when the ray was: no point lies in the blocked sector."""
    azimuth = np.delete(made.azimuth_deg, sorted(lost), axis=0).reshape(-1)
    time_s = np.delete(made.time_s, sorted(lost), axis=0).reshape(-1)
    points = np.concatenate([revolution.points for revolution in revolutions])
    assert len(points) == len(azimuth)
    found = np.degrees(np.arctan2(-points["y"].astype(float), points["x"].astype(float)))
    assert np.abs((found - azimuth + 180.0) % 360.0 - 180.0).max() < 0.03
    stamps = np.concatenate([(r.stamp_ns - START) * 1e-9 + r.points["time"].astype(float) for r in revolutions])
    late = np.abs(stamps - time_s)
    # The rays after a gap in the last packet of a revolution are timed by the turn rate alone: 1 % of a gap.
    assert late.max() < 3e-3 and np.quantile(late, 0.9) < 2e-4
    assert all((np.diff(revolution.points["time"]) >= 0.0).all() for revolution in revolutions)


@pytest.mark.parametrize("dual", [False, True])
@pytest.mark.parametrize(("view", "rpm"), CASES)
def test_every_field_of_view_gives_one_revolution_a_turn_and_each_ray_where_it_was(
    view: tuple[float, float], rpm: float, dual: bool
) -> None:
    made = limited_stream(5.3, view, rpm, dual)
    for cut_deg in (180.0, 0.0, 271.0):
        stream = PacketStream(DecoderConfig(cut_angle_deg=cut_deg, fov_start_deg=view[0], fov_end_deg=view[1]))
        revolutions = feed(stream, made)
        assert len(revolutions) == passages(made, cut_deg) in (4, 5, 6)
        assert all(revolution.complete for revolution in revolutions[1:])
        assert all(coverage(revolution, stream.config.blocked) > 0.99 for revolution in revolutions[1:])
        counters = stream.counters
        assert (counters.missing, counters.late, counters.bad, counters.clock_resets) == (0, 0, 0, 0)
        last = stream.finish()
        check_rays(revolutions if last is None else [*revolutions, last], made)


@pytest.mark.parametrize(("view", "rpm"), CASES)
def test_a_field_of_view_that_nobody_configured_is_learned_from_the_packets(
    view: tuple[float, float], rpm: float
) -> None:
    made = limited_stream(8.0, view, rpm)
    stream = PacketStream()
    missing = []
    for index, payload in enumerate(made.payloads):
        stream.feed(payload, START + round(made.sent_s[index] * SECOND))
        missing.append(stream.counters.missing)
    assert missing[-1] == missing[len(missing) * 3 // 8]
    blocked_deg = (view[0] - view[1]) % 360.0
    if blocked_deg <= 1.0:
        return
    found = stream.head.blocked
    assert found is not None
    assert found.resembles(Sector(round(view[1] * 100.0), round(blocked_deg * 100.0)))


@pytest.mark.parametrize("view", [(270.0, 90.0), (45.0, 315.0), (0.0, 360.0)])
def test_lost_packets_are_counted_at_the_gap_too(view: tuple[float, float]) -> None:
    made = limited_stream(9.0, view, 600.0)
    rng = np.random.default_rng(0)
    turn = (made.block_deg[:, 0] - made.block_deg[0, 0]) / 360.0
    spans = np.flatnonzero(np.ptp(made.block_deg, axis=1) > 10.0)
    candidates = np.flatnonzero((turn > 3.0) & (turn < 8.0))
    lost = frozenset(
        int(index) for index in [*rng.choice(candidates, len(candidates) // 20), *spans[(spans > candidates[0])][:2]]
    ) - {len(made.payloads) - 1}
    stream = PacketStream()
    revolutions = feed(stream, made, lost)
    assert stream.counters.missing == len(lost)
    assert len(revolutions) == passages(made, 180.0, lost)
    last = stream.finish()
    check_rays(revolutions if last is None else [*revolutions, last], made, lost)


def test_a_gap_that_always_falls_between_two_packets_is_learned() -> None:
    """912 blocks a turn, 456 of them sent: exactly 38 packets."""
    rpm = 60.0 / (912 * 110.592e-6)
    made = limited_stream(8.0, (270.0, 90.0), rpm, start_deg=270.1)
    assert np.ptp(made.block_deg, axis=1).max() < 5.0
    stream = PacketStream()
    revolutions = feed(stream, made)
    assert [revolution.complete for revolution in revolutions[-4:]] == [True] * 4
    assert len(revolutions) == passages(made, 180.0)
    configured = PacketStream(DecoderConfig(fov_start_deg=270.0, fov_end_deg=90.0))
    feed(configured, made)
    assert configured.counters.missing == 0


def test_a_sensor_that_is_set_back_to_all_around_is_noticed() -> None:
    limited, whole = limited_stream(3.0, (270.0, 90.0), 600.0), limited_stream(6.0, (0.0, 360.0), 600.0)
    stream = PacketStream()
    feed(stream, limited)
    assert stream.head.blocked is not None
    begin = int(np.searchsorted(whole.time_s[:, 0], limited.sent_s[-1]))
    for index in range(begin, len(whole.payloads)):
        revolution = stream.feed(whole.payloads[index], START + round(whole.sent_s[index] * SECOND))
    assert stream.head.blocked is None
    assert stream.counters.missing < 80  # less than a turn
    assert revolution is None or revolution.complete
