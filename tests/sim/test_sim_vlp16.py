"""The scanner's packets, decoded by velodyne_decoder, against ranges worked out by hand; captures sent again."""

import socket
import struct
from pathlib import Path

import numpy as np
import pytest
import velodyne_decoder
from sim_oracles import HIGH, LOW, box_range

from instant_ic.lidar import packets as wire
from instant_ic.sim.capture_replay import CaptureReplay
from instant_ic.sim.robot import RobotConfig
from instant_ic.sim.simulation import Simulation, SimulationConfig
from instant_ic.sim.vlp16 import Vlp16Config, Vlp16Server
from instant_ic.sim.world import World

START_NS = 1_700_000_000_000_000_000
QUIET = Vlp16Config(range_noise=0.0)
EXACT = RobotConfig(slip=0.0, turn_slip=0.0, encoder_noise_pulses=0.0)


def simulate(
    world: World, v: float, w: float, seconds: float, lidar: Vlp16Config = QUIET
) -> tuple[Simulation, list[bytes]]:
    simulation = Simulation(SimulationConfig(robot=EXACT, lidar=lidar), START_NS, world)
    simulation.drive(v, w)
    packets: list[bytes] = []
    for _ in range(round(seconds / 0.01)):
        simulation.step(0.01)
        packets += simulation.scan_packets()
    return simulation, packets


def decode(packets: list[bytes]) -> list[np.ndarray]:
    """Scans (structured arrays with x, y, z, time) by velodyne_decoder."""
    config = velodyne_decoder.Config(model=velodyne_decoder.Model.VLP16, min_range=0.1)
    decoder = velodyne_decoder.StreamDecoder(config)
    scans = []
    for number, packet in enumerate(packets):
        result = decoder.decode(START_NS * 1e-9 + number * 1.3271e-3, packet, as_pcl_structs=True)
        if result is not None:
            scans.append(result[1])
    return scans


def test_points_lie_on_the_walls(box_room: World) -> None:
    _, packets = simulate(box_room, 0.0, 0.0, 0.35)
    scan = decode(packets)[1]
    assert len(scan) > 28_000
    xyz = np.column_stack([scan["x"], scan["y"], scan["z"]]).astype(float)
    # The ray begins at the laser's own height over the sensor's origin, which is 0.6 m up.
    offset = np.asarray(sorted(zip(wire.LASER_ELEVATION_DEG, wire.LASER_VERTICAL_OFFSET_M, strict=True)))[
        scan["ring"], 1
    ]
    start = np.zeros_like(xyz)
    start[:, 2] = offset
    ray = xyz - start
    measured = np.linalg.norm(ray, axis=1)
    expected = box_range(start + (0, 0, 0.6), ray / measured[:, None])
    # 1 mm of rounding to 2 mm steps; azimuths are rounded to 0.01 degrees.
    assert np.abs(measured - expected).max() < 2.5e-3
    assert np.abs(measured - expected).mean() < 0.8e-3


def test_a_turning_sensor_sees_the_room_turned_until_its_own_motion_is_taken_out(box_room: World) -> None:
    simulation, packets = simulate(box_room, 0.0, 0.9, 1.2)
    scans = decode(packets)
    scan = scans[-2]
    xyz = np.column_stack([scan["x"], scan["y"], scan["z"]]).astype(float) + (0, 0, 0.6)
    # Time of each point since the start, by the packets' own clock: the decoder's times are relative to a scan's end.
    first = sum(len(s) for s in scans[:-2])
    times = firing_times(packets)[first : first + len(scan)]
    pose = simulation.poses_at(times)
    c, s = np.cos(pose[:, 2]), np.sin(pose[:, 2])
    world = np.column_stack(
        [pose[:, 0] + c * xyz[:, 0] - s * xyz[:, 1], pose[:, 1] + s * xyz[:, 0] + c * xyz[:, 1], xyz[:, 2]]
    )

    def off_walls(points: np.ndarray) -> np.ndarray:
        return np.minimum(np.abs(points - LOW), np.abs(points - HIGH)).min(axis=1)

    assert np.quantile(off_walls(world), 0.99) < 0.01
    # Taken as if the sensor had stood still, the revolution of 0.09 rad of turn does not fit.
    middle = simulation.poses_at([times.mean()])[0]
    c, s = np.cos(middle[2]), np.sin(middle[2])
    rigid = np.column_stack([c * xyz[:, 0] - s * xyz[:, 1], s * xyz[:, 0] + c * xyz[:, 1], xyz[:, 2]])
    assert np.quantile(off_walls(rigid), 0.9) > 0.04


def firing_times(packets: list[bytes]) -> np.ndarray:
    """Time (N,) in seconds since the start of every return of the packets, in firing order; all rays return here."""
    first_us = np.asarray([struct.unpack_from("<I", p, 1200)[0] for p in packets], np.int64)
    offsets = (
        np.arange(12)[:, None, None] * 110.592
        + np.arange(2)[None, :, None] * 55.296
        + np.arange(16)[None, None, :] * 2.304
    )
    start_us = START_NS // 1000 % 3_600_000_000
    return ((first_us - start_us)[:, None] + offsets.ravel()[None, :]).ravel() * 1e-6


def test_packets_keep_the_sensors_rhythm(box_room: World) -> None:
    _, packets = simulate(box_room, 0.0, 0.0, 1.0)
    # 753.5 packets a second (manual), all whole.
    assert len(packets) == 753
    assert {len(p) for p in packets} == {1206}
    stamps = np.asarray([struct.unpack_from("<I", p, 1200)[0] for p in packets], np.int64)
    assert np.abs(np.diff(stamps) - 1327.104).max() <= 1.0
    azimuth = np.asarray([[struct.unpack_from("<H", p, 100 * b + 2)[0] for b in range(12)] for p in packets]).ravel()
    # 10 Hz: 3600 degrees/s * 110.592 us = 0.398 degrees a block.
    assert set(np.diff(azimuth) % 36000) <= {39, 40}
    assert packets[0][1204:] == b"\x37\x22"


def test_noise_and_limits(box_room: World) -> None:
    _, packets = simulate(box_room, 0.0, 0.0, 0.1, Vlp16Config(range_noise=0.03, max_range=2.9))
    _, exact = simulate(box_room, 0.0, 0.0, 0.1)
    noisy, truth = (
        np.frombuffer(b"".join(p), wire.PACKET_DTYPE)["blocks"]["returns"]["distance"].astype(float) * 0.002
        for p in (packets, exact)
    )
    assert (noisy[truth > 2.91] == 0).all() and (truth > 2.91).any()
    seen = truth < 2.9
    assert (noisy - truth)[seen].std() == pytest.approx(0.03, rel=0.03)
    assert abs((noisy - truth)[seen].mean()) < 0.001


def test_position_packets_carry_the_time_of_day(box_room: World) -> None:
    simulation = Simulation(SimulationConfig(lidar=QUIET), START_NS, box_room)
    packet = wire.decode_position_packet(simulation.scanner.position_packet(2.5))
    # 1 700 000 000 s is 22:13:20 UTC; 2.5 s later the sentence says 22:13:22.
    assert packet.nmea.startswith("$GPRMC,221322,A,")
    assert packet.pps == 2
    assert packet.timestamp_us == (13 * 60 + 22.5) * 1e6
    body, checksum = packet.nmea[1:].split("*")
    total = 0
    for byte in body.encode():
        total ^= byte
    assert int(checksum, 16) == total


def listen() -> tuple[socket.socket, int]:
    receiver = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
    receiver.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, 4 << 20)
    receiver.bind(("127.0.0.1", 0))
    receiver.settimeout(10)
    return receiver, receiver.getsockname()[1]


def test_the_server_sends_bursts_and_leaves_out_what_is_too_late(box_room: World) -> None:
    data, port = listen()
    position, position_port = listen()
    config = Vlp16Config(range_noise=0.0, data_port=port, position_port=position_port, burst=8)
    simulation = Simulation(SimulationConfig(lidar=config), START_NS, box_room)
    server = Vlp16Server(simulation.scanner)
    try:
        simulation.step(0.010)  # 7 packets: not yet a burst
        server.pump(simulation.time_s)
        assert server.sent == 0
        simulation.step(0.001)
        server.pump(simulation.time_s)
        assert server.sent == 8
        received = [data.recv(2000) for _ in range(8)]
        assert {len(p) for p in received} == {1206}
        assert len(position.recv(2000)) == 512
        simulation.step(2.0)
        server.pump(simulation.time_s)
        # All but the last 0.1 s of two seconds are left out.
        assert server.skipped == pytest.approx(1.9 * 753.5, abs=10)
        assert server.sent - 8 == pytest.approx(75, abs=2)
    finally:
        server.close()
        data.close()
        position.close()


def write_pcap(path: Path, items: list[tuple[float, int, bytes]]) -> None:
    """Ethernet pcap of UDP datagrams (time, destination port, payload)."""
    with path.open("wb") as file:
        file.write(struct.pack("<IHHiIII", 0xA1B2C3D4, 2, 4, 0, 0, 65535, 1))
        for time_s, port, payload in items:
            udp = struct.pack(">HHHH", 2368, port, 8 + len(payload), 0) + payload
            ip = (
                struct.pack(">BBHHHBBH4s4s", 0x45, 0, 20 + len(udp), 0, 0, 64, 17, 0, b"\xc0\xa8\1\xc9", b"\xff" * 4)
                + udp
            )
            frame = b"\xff" * 6 + b"\x60\x76\x88" + b"\0" * 3 + b"\x08\x00" + ip
            file.write(struct.pack("<IIII", int(time_s), round(time_s % 1 * 1e6), len(frame), len(frame)) + frame)


def test_a_capture_is_sent_at_its_own_pace_and_untouched_and_again_with_noise(box_room: World, tmp_path: Path) -> None:
    _, packets = simulate(box_room, 0.0, 0.0, 0.02)
    path = tmp_path / "scan.pcap"
    position = wire.encode_position_packet(5, 0, "")
    write_pcap(
        path,
        [(100.0 + 0.1 * i, 2368, p) for i, p in enumerate(packets[:5])]
        + [(100.25, 8308, position), (100.3, 53, b"dns")],
    )
    data, port = listen()
    telemetry, telemetry_port = listen()
    replay = CaptureReplay(path, "127.0.0.1", port, telemetry_port)
    try:
        assert replay.duration_s == pytest.approx(0.4)
        replay.pump(0.0)
        assert replay.sent == 1
        replay.pump(0.22)
        assert replay.sent == 3
        replay.pump(0.26)
        assert replay.sent == 4 and telemetry.recv(2000) == position
        replay.pump(0.41)
        assert replay.sent == 6
        assert [data.recv(2000) for _ in range(5)] == packets[:5]
        replay.pump(0.60)  # second round began at 0.4 * 7 / 6 = 0.467
        again, first = (np.frombuffer(p, np.uint8).astype(int) for p in (data.recv(2000), packets[0]))
        assert replay.sent == 8
        # The driver would take the same data for those of a sensor that repeats itself. A unit of range is 2 mm.
        changed = np.flatnonzero(again - first)
        assert 100 < len(changed) < 284 and np.abs(again - first).max() == 1
        assert set(changed % 100 % 3) == {1} and changed.min() >= 4 and changed.max() < 1200
    finally:
        replay.close()
        data.close()
        telemetry.close()


def test_a_capture_without_packets_is_refused(tmp_path: Path) -> None:
    path = tmp_path / "dns.pcap"
    write_pcap(path, [(1.0, 53, b"dns")])
    with pytest.raises(ValueError, match="has no VLP-16 packets"):
        CaptureReplay(path, "127.0.0.1", 2368, 8308)
