"""Decoding by hand and against velodyne_decoder, on recordings and on generated packets."""

import numpy as np
import pytest
import velodyne_decoder as oracle
from lidar_streams import DATA, random_stream

from instant_ic.lidar.capture import CaptureReader
from instant_ic.lidar.decode import decode_packets
from instant_ic.lidar.packets import (
    HOUR_US,
    LASER_ELEVATION_DEG,
    LASER_RING,
    LASER_VERTICAL_OFFSET_M,
    PACKET_DTYPE,
    PACKET_PERIOD_US,
    RETURN_DUAL,
    RETURN_STRONGEST,
    PacketError,
    decode_position_packet,
    encode_data_packet,
    encode_position_packet,
)

RECORDINGS = ("einride_recording", "mrpt_sample_velodyne_vlp16_gps", "btlad_my")


def unpack(payloads: list[bytes]) -> np.ndarray:
    return np.frombuffer(b"".join(payloads), np.uint8).reshape(-1, 1206)


def unpack_azimuths(payload: bytes) -> np.ndarray:
    return np.frombuffer(payload, PACKET_DTYPE)[0]["blocks"]["azimuth"].astype(int)


def decode_all(payloads: list[bytes], dual: bool = False) -> np.ndarray:
    times = np.arange(len(payloads)) * PACKET_PERIOD_US / (2 if dual else 1)
    return decode_packets(unpack(payloads), times, min_range=0.1, max_range=131.0).points


def oracle_points(payloads: list[bytes], dual: bool = False) -> np.ndarray:
    """(N, 8) of velodyne_decoder, its scans joined: x y z intensity time column ring return."""
    config = oracle.Config(model=oracle.Model.VLP16)
    config.min_range, config.max_range = 0.1, 131.0
    decoder = oracle.StreamDecoder(config)
    period_s = PACKET_PERIOD_US * 1e-6 / (2 if dual else 1)
    results = [decoder.decode(1000.0 + index * period_s, payload) for index, payload in enumerate(payloads)]
    results.append(decoder.finish())
    return np.concatenate([result[1] for result in results if result is not None])


def test_tables_of_the_manual() -> None:
    offsets_mm = [11.2, -0.7, 9.7, -2.2, 8.1, -3.7, 6.6, -5.1, 5.1, -6.6, 3.7, -8.1, 2.2, -9.7, 0.7, -11.2]
    np.testing.assert_allclose(LASER_VERTICAL_OFFSET_M * 1000.0, offsets_mm, atol=0.051)
    assert LASER_RING.tolist() == [0, 8, 1, 9, 2, 10, 3, 11, 4, 12, 5, 13, 6, 14, 7, 15]
    assert PACKET_DTYPE.itemsize == 1206


def test_one_ray_worked_out_by_hand() -> None:
    # Laser 15 (+15 degrees), second firing of block 3, 10 m; every block turns by exactly 0.48 degrees.
    distance = np.zeros((12, 2, 16), int)
    distance[3, 1, 15] = 5000
    reflectivity = np.full((12, 2, 16), 77)
    payload = encode_data_packet(8856 + 48 * np.arange(12), distance, reflectivity, 5)
    decoded = decode_packets(unpack([payload]), np.zeros(1))
    assert len(decoded.points) == 1
    point = decoded.points[0]
    # Fired 55.296 + 15 * 2.304 = 89.856 us into the block: 0.48 * 89.856 / 110.592 = 0.39 degrees after 90.00.
    azimuth, elevation = np.radians(90.0 + 0.39), np.radians(15.0)
    assert point["x"] == pytest.approx(10.0 * np.cos(elevation) * np.cos(azimuth), abs=1e-6)
    assert point["y"] == pytest.approx(-10.0 * np.cos(elevation) * np.sin(azimuth), abs=1e-6)
    assert point["z"] == pytest.approx(10.0 * np.sin(elevation) - 0.0112298, abs=1e-6)
    assert point["intensity"] == 77.0
    assert point["ring"] == 15
    assert point["time"] == pytest.approx((3 * 110.592 + 89.856) * 1e-6, rel=1e-6)
    assert decoded.duration_s == pytest.approx(12 * 110.592e-6)
    assert len(decoded.firing_azimuth) == 24


def test_range_limits_and_returns_that_are_too_close() -> None:
    distance = np.zeros((12, 2, 16), int)
    distance[0, 0, :4] = [199, 200, 5000, 5001]  # 0.398, 0.400, 10.000, 10.002 m
    payload = encode_data_packet(np.arange(12) * 40, distance, np.zeros((12, 2, 16), int), 5)
    decoded = decode_packets(unpack([payload]), np.zeros(1), min_range=0.4, max_range=10.0)
    assert decoded.points["ring"].tolist() == [8, 1]
    assert decoded.firing_too_close.tolist() == [True] + [False] * 23


@pytest.mark.parametrize("mode", [RETURN_STRONGEST, RETURN_DUAL])
def test_a_ray_without_a_return_is_no_point_at_any_minimum_range(mode: int) -> None:
    """With min_range 0 it was a point at the origin: 124 of 384."""
    distance = np.zeros((12, 2, 16), int)
    distance[:, :, ::3] = 1
    payload = encode_data_packet(np.repeat(np.arange(6) * 40, 2), distance, distance, 5, mode)
    for min_range in (0.0, 0.001, 0.002):
        decoded = decode_packets(unpack([payload]), np.zeros(1), min_range=min_range)
        assert len(decoded.points) == (12 * 2 * 6 if mode == RETURN_STRONGEST else 6 * 2 * 6)
        assert np.hypot(decoded.points["x"], decoded.points["y"]) == pytest.approx(0.002, rel=0.04)
        assert not decoded.firing_too_close.any()


def test_dual_return_gives_last_then_strongest_and_identical_pairs_once() -> None:
    distance = np.zeros((12, 2, 16), int)
    reflectivity = np.zeros((12, 2, 16), int)
    distance[0, 0, 0], distance[1, 0, 0] = 1000, 500  # last, strongest
    distance[0, 0, 1], distance[1, 0, 1] = 700, 700  # one return
    distance[3, 1, 2] = 900  # only in the odd block
    payload = encode_data_packet(np.repeat(np.arange(6) * 40, 2), distance, reflectivity, 5, RETURN_DUAL)
    points = decode_packets(unpack([payload]), np.zeros(1)).points
    slant = np.sqrt(points["x"].astype(float) ** 2 + points["y"].astype(float) ** 2)
    np.testing.assert_allclose(
        slant, np.cos(np.radians(LASER_ELEVATION_DEG[[0, 0, 1, 2]])) * [2.0, 1.0, 1.4, 1.8], atol=1e-6
    )
    # The second pair of blocks fires 110.592 us after the first; firing 1, laser 2.
    assert points["time"][3] == pytest.approx((110.592 + 55.296 + 2 * 2.304) * 1e-6, rel=1e-5)


@pytest.mark.parametrize("dual", [False, True])
@pytest.mark.parametrize("jitter", [0, 3])
def test_generated_packets_agree_with_velodyne_decoder(dual: bool, jitter: int) -> None:
    payloads = random_stream(250, dual, seed=jitter, jitter=jitter)
    compare(decode_all(payloads, dual), oracle_points(payloads, dual))


@pytest.mark.real_data
@pytest.mark.parametrize("name", RECORDINGS)
def test_recordings_agree_with_velodyne_decoder(name: str) -> None:
    path = DATA / f"{name}.pcap"
    if not path.exists():
        pytest.skip(f"{path} is not there")
    payloads = [datagram.payload for datagram in CaptureReader(path) if len(datagram.payload) == 1206]
    # Across the gap of a limited field of view the decoder interpolates azimuths; two packets of one recording.
    whole = [each for each in payloads if np.ptp(np.unwrap(unpack_azimuths(each), period=36000)) < 1200]
    assert len(payloads) - len(whole) == (2 if name == "btlad_my" else 0)
    compare(decode_all(whole), oracle_points(whole))


def compare(ours: np.ndarray, theirs: np.ndarray) -> None:
    assert len(ours) == len(theirs) > 1000
    xyz = np.stack([ours["x"], ours["y"], ours["z"]], axis=1)
    np.testing.assert_allclose(xyz, theirs[:, :3], rtol=0.0, atol=1e-5)
    np.testing.assert_array_equal(ours["intensity"], theirs[:, 3])
    np.testing.assert_array_equal(ours["ring"], theirs[:, 6])


def test_times_agree_with_velodyne_decoder() -> None:
    # One revolution of the oracle: its times count from the last packet, ours from the first.
    payloads = random_stream(70)
    theirs = oracle_points(payloads)[:, 4]
    ours = decode_all(payloads)["time"]
    np.testing.assert_allclose(ours - ours[0], theirs - theirs[0], atol=2e-6)


def test_position_packet_round_trip() -> None:
    sentence = "$GPRMC,225446.25,A,4916.45,N,12311.12,W,000.5,054.7,191194,020.3,E*68"
    position = decode_position_packet(encode_position_packet(1_234_567_890, 2, sentence))
    assert (position.timestamp_us, position.pps, position.nmea) == (1_234_567_890, 2, sentence)
    assert decode_position_packet(encode_position_packet(0)).nmea == ""
    late = bytearray(encode_position_packet(0))
    late[0xC6:0xCA] = (HOUR_US + 7).to_bytes(4, "little")
    assert decode_position_packet(bytes(late)).timestamp_us == 7
    with pytest.raises(PacketError, match="512"):
        decode_position_packet(b"\0" * 511)


@pytest.mark.real_data
def test_position_packets_of_a_real_sensor_agree_with_velodyne_decoder() -> None:
    path = DATA / "mrpt_sample_velodyne_vlp16_gps.pcap"
    if not path.exists():
        pytest.skip(f"{path} is not there")
    payloads = [datagram.payload for datagram in CaptureReader(path) if datagram.port == 8308]
    assert len(payloads) == 57
    for payload in payloads:
        ours, theirs = decode_position_packet(payload), oracle.TelemetryPacket(payload)
        assert ours.timestamp_us == theirs.usec_since_toh
        assert ours.pps == theirs.pps_status.value
        assert ours.nmea == theirs.nmea_sentence.strip()
        assert ours.nmea.startswith("$GPRMC")
