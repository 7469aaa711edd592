"""The node: a capture in lockstep, a bag's packets in lockstep, and UDP over real sockets."""

from __future__ import annotations

import contextlib
import dataclasses
import socket
import tempfile
import threading
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from lidar_streams import SECOND, limited_stream, pcap, udp_frame, wall_stream

from instant_ic.bus import ERROR, OK, RELIABLE, WARN, Node, NodeError
from instant_ic.bus.clock import SystemClock
from instant_ic.bus.local_transport import LocalTransport
from instant_ic.bus.lockstep import LockstepBus
from instant_ic.geometry.poses import matrix_from_pose2
from instant_ic.lidar.config import DecoderConfig, FlatScanConfig
from instant_ic.lidar.packets import PACKET_PERIOD_US, encode_position_packet
from instant_ic.lidar.sources import SourceGuard
from instant_ic.msg import (
    LaserScan,
    PointCloud2,
    TFMessage,
    VelodynePacket,
    VelodyneScan,
    cloud_array,
    header,
    stamp_ns,
    to_time,
    transform_matrix,
    transform_message,
)
from nodes.vlp16_driver import Vlp16DriverConfig, Vlp16DriverNode

RECORDED = 1_600_000_000 * SECOND
START = 1_700_000_000 * SECOND


@pytest.fixture
def capture(tmp_path: Path) -> Path:
    """0.4 s inside a round wall of 5 m, recorded long ago, with a position packet and a frame that is no IP."""
    frames = [
        (RECORDED + round((index + 1) * PACKET_PERIOD_US * 1000.0), udp_frame(payload))
        for index, payload in enumerate(wall_stream(302, 5.0, azimuth_cdeg=18100))
    ]
    frames.insert(100, (frames[100][0], udp_frame(encode_position_packet(5, 2, "$GPRMC,1,A"), port=8308)))
    frames.insert(50, (frames[50][0], b"\xff" * 60))
    path = tmp_path / "wall.pcap"
    path.write_bytes(pcap(frames, nano=True))
    return path


def played(capture: Path, **changes: Any) -> tuple[LockstepBus, Vlp16DriverNode]:
    bus = LockstepBus(start_ns=START)
    config = Vlp16DriverConfig(source="pcap", pcap=str(capture))
    return bus, bus.add(Vlp16DriverNode, dataclasses.replace(config, **changes))


def test_capture_gives_points_packets_scans_and_the_mount(capture: Path) -> None:
    bus, node = played(capture)
    bus.advance(0.5)
    clouds, scans, packets = (bus.messages(t) for t in ("/lidar/points", "/scan", "/lidar/packets"))
    assert len(clouds) == len(packets) == 5  # 0.4 s from just behind the cut on: 4 cuts and the rest
    assert len(scans) == 4  # the rest, 302 packets of 1.327 ms less 4 turns of 0.1 s, is 4 degrees: no scan
    assert sum(len(cloud_array(cloud)) for cloud in clouds) == 302 * 384
    assert sum(len(message.packets) for message in packets) == 302
    assert all(message.header.frame_id == "velodyne" for message in [*clouds, *scans])
    # Stamps are of now, not of the recording; the first firing was one packet before the first arrival.
    assert stamp_ns(clouds[0]) == pytest.approx(START - PACKET_PERIOD_US * 1000.0, abs=5000)
    scan = scans[2]
    assert stamp_ns(scan) == pytest.approx(stamp_ns(clouds[2]) + 0.1 * SECOND, abs=2e5)
    assert len(scan.ranges) == 720
    np.testing.assert_allclose(scan.ranges, 5.0, atol=2e-3)
    assert (scan.angle_min, scan.time_increment) == (pytest.approx(-np.pi), 0.0)
    mount = bus.last("/tf_static").transforms[0]
    assert (mount.header.frame_id, mount.child_frame_id) == ("base_link", "velodyne")
    assert transform_matrix(mount)[:3, 3].tolist() == [0.0, 0.0, 0.6]
    assert node.diagnoses()["capture"][:2] == (WARN, "303 datagrams played; left out: 1 x not IPv4")
    bus.advance(0.6)
    text = "receiving packets; 1 incomplete revolutions gave no scan"
    assert node.diagnoses()["packets"][:2] == (OK, text)
    assert node.diagnoses()["position"][:2] == (OK, "pulse per second locked")


def test_packets_of_a_bag_give_the_same_again_bit_for_bit(capture: Path) -> None:
    bus, _ = played(capture)
    bus.advance(0.5)
    again = LockstepBus(start_ns=START)
    again.add(Vlp16DriverNode, Vlp16DriverConfig(source="topic"))
    for record in bus.records("/lidar/packets"):
        again.publish_bytes("/lidar/packets", record.type_name, record.payload, record.stamp_ns)
    # The last, unfinished revolution ends with the capture, of which a bag of packets does not know; it gives no scan.
    for topic, unfinished in (("/lidar/points", 1), ("/scan", 0)):
        expected = [record.payload for record in bus.records(topic)]
        expected = expected[: len(expected) - unfinished]
        assert len(expected) == 4
        assert [record.payload for record in again.records(topic)] == expected


def test_fault_a_short_capture_that_loops_is_taken_for_a_sensor_that_repeats_itself(capture: Path) -> None:
    bus, node = played(capture, loop=True)
    bus.advance(2.0)
    assert len(bus.messages("/scan")) >= 14 and node.report.withheld == 0


@pytest.mark.parametrize(("min_coverage", "scans"), [(0.5, 4), (0.05, 5), (0.75, 3)])
def test_revolutions_that_are_cut_short_give_no_scan(tmp_path: Path, min_coverage: float, scans: int) -> None:
    # 287 packets of 1.327 ms are 3.81 turns at 600 rpm: a tenth up to the first cut, three whole ones, 0.71.
    stamps = [RECORDED + round((index + 1) * PACKET_PERIOD_US * 1000.0) for index in range(287)]
    stream = wall_stream(287, 5.0, azimuth_cdeg=14400)  # 36 degrees before the cut
    path = tmp_path / "cut.pcap"
    path.write_bytes(pcap([(s, udp_frame(p)) for s, p in zip(stamps, stream, strict=True)], nano=True))
    config = FlatScanConfig(min_coverage=min_coverage)
    bus, node = played(path, scan=config)
    bus.advance(0.5)
    clouds = len(bus.messages("/lidar/points"))
    assert len(bus.messages("/scan")) == scans
    assert node.report.partial == clouds - scans


def test_a_covered_sensor_gives_no_scan_so_that_the_robot_stops(tmp_path: Path) -> None:
    stamps = [RECORDED + round((index + 1) * PACKET_PERIOD_US * 1000.0) for index in range(600)]
    stream = wall_stream(302, 5.0) + wall_stream(298, 0.0, round(302 * PACKET_PERIOD_US), 18283)  # turning on evenly
    path = tmp_path / "covered.pcap"
    path.write_bytes(pcap([(s, udp_frame(p)) for s, p in zip(stamps, stream, strict=True)], nano=True))
    bus, node = played(path)
    bus.advance(0.35)
    seeing = len(bus.messages("/scan"))
    assert seeing == 3
    bus.advance(0.5)
    assert len(bus.messages("/scan")) <= seeing + 1  # the revolution in which it was covered
    node.check()
    level, text, _ = node.diagnoses()["packets"]
    assert level == ERROR and "Uncover the sensor" in text


def test_scan_is_motion_compensated_by_odometry(capture: Path) -> None:
    bus, node = played(capture)
    # 0.5 m/s ahead, told each 33 ms; the wall is round in the sensor's own view, so compensation dents it.
    for index in range(15):
        now_ns = START + index * SECOND // 30
        pose = matrix_from_pose2([0.5 * index / 30, 0.0, 0.0])
        bus.publish("/tf", TFMessage([transform_message(pose, "odom", "base_link", now_ns)]), now_ns)
    scan = bus.messages("/scan")[2]
    # Cut behind, clockwise: left (90 degrees) at 25 ms, ahead at 50 ms, right at 75 ms, behind at both ends.
    middle = 360
    assert scan.ranges[middle] == pytest.approx(5.0 - 0.5 * 0.050, abs=4e-3)  # ahead: seen 50 ms before the end
    assert scan.ranges[middle + 180] == pytest.approx(5.0, abs=4e-3)
    assert node.diagnoses()["motion"][:2] == (OK, "scan is motion-compensated")


def test_old_odometry_is_told_and_not_used(capture: Path) -> None:
    bus, node = played(capture)
    bus.publish("/tf", TFMessage([transform_message(np.eye(4), "odom", "base_link", START - 5 * SECOND)]), START)
    bus.advance(0.3)
    level, text, _ = node.diagnoses()["motion"]
    assert level == WARN and text.startswith("scan is not motion-compensated")
    np.testing.assert_allclose(bus.messages("/scan")[1].ranges, 5.0, atol=2e-3)


def limited(path: Path, view: tuple[float, float]) -> Path:
    """A capture of a sensor set to a field of view."""
    made = limited_stream(12.0, view, 600.0)
    stamps = [RECORDED + round(sent * SECOND) for sent in made.sent_s]
    path.write_bytes(pcap([(s, udp_frame(p)) for s, p in zip(stamps, made.payloads, strict=True)], nano=True))
    return path


def test_a_limited_field_of_view_gives_no_scan_and_says_why_until_it_is_configured(tmp_path: Path) -> None:
    path = limited(tmp_path / "half.pcap", (270.0, 90.0))
    bus, node = played(path)
    bus.advance(1.15)
    assert not bus.messages("/scan")
    level, text, _ = node.diagnoses()["view"]
    assert level == ERROR
    assert "270 to 90 degrees only" in text and "0 to 360 that the driver expects" in text
    assert "No scan" in text and "0 to 359 on its web page" in text
    level, text, values = node.diagnoses()["packets"]
    assert (level, values["missing"]) == (OK, 0)
    bus, node = played(path, decoder=DecoderConfig(fov_start_deg=270.0, fov_end_deg=90.0))
    bus.advance(1.15)
    scans = bus.messages("/scan")
    assert len(scans) >= 10
    assert np.diff([stamp_ns(scan) for scan in scans]) == pytest.approx(0.1 * SECOND, rel=0.02)
    angle = -np.pi + np.arange(720) * 2 * np.pi / 720
    ahead = np.abs(angle) < np.radians(89.0)
    np.testing.assert_allclose(np.asarray(scans[5].ranges)[ahead], 5.0, atol=0.04)  # the wall's slant range
    assert np.isnan(np.asarray(scans[5].ranges)[np.abs(angle) > np.radians(91.0)]).all()  # no ghost behind
    level, text, _ = node.diagnoses()["view"]
    assert level == WARN and "270 to 90 degrees only" in text and "does not see" in text


def test_capture_that_is_missing_or_none_is_told(tmp_path: Path) -> None:
    with pytest.raises(NodeError, match=r"nowhere\.pcap"):
        played(tmp_path / "nowhere.pcap")
    (tmp_path / "text.pcap").write_text("hello")
    with pytest.raises(NodeError, match="neither pcap nor pcapng"):
        played(tmp_path / "text.pcap")


@pytest.fixture
def run_dir() -> Iterator[Path]:
    """A run directory with a short name: pytest's own is too long for the path of a socket."""
    with tempfile.TemporaryDirectory(prefix="ic-") as path:
        yield Path(path)


class Probe(Node[Vlp16DriverConfig]):
    """Listens to the driver over real sockets."""

    name = "probe"

    def setup(self) -> None:
        self.scans: list[Any] = []
        self.clouds: list[Any] = []
        self.subscribe("/scan", LaserScan, self.scans.append, qos=RELIABLE)
        self.subscribe("/lidar/points", PointCloud2, self.clouds.append, qos=RELIABLE)


class Listened:
    """The driver, which takes packets from a real socket, and a node that listens to it."""

    def __init__(self, run_dir: Path, **changes: Any) -> None:
        clock = SystemClock()
        config = Vlp16DriverConfig(host="127.0.0.1", port=0, position_port=0, **changes)
        self.driver = Vlp16DriverNode(config, LocalTransport(run_dir, "vlp16_driver", clock.now_ns), clock)
        self.probe = Probe(config, LocalTransport(run_dir, "probe", clock.now_ns), clock)

    def spin_until(self, what: Callable[[], bool]) -> None:
        deadline = time.monotonic() + 60.0
        while not what() and time.monotonic() < deadline:
            self.driver.spin_once()
            self.probe.spin_once()
            time.sleep(0.0005)  # lets the receiver's thread run
        assert what()

    def send(self, sensor: socket.socket, payload: bytes) -> None:
        """Send a packet and wait until it is taken: how fast the machine takes them is not asserted."""
        counters = self.driver.feed.stream.counters
        count = counters.packets + 1
        sensor.sendto(payload, ("127.0.0.1", self.driver.receiver.port))
        self.spin_until(lambda: counters.packets >= count)


@contextlib.contextmanager
def listened(run_dir: Path, **changes: Any) -> Iterator[Listened]:
    """Both nodes, of which each topic is connected: from the first packet on, nothing that is published is missed."""
    pair = Listened(run_dir, **changes)
    driver, probe = pair.driver, pair.probe
    try:
        driver.start()
        probe.start()
        pair.spin_until(lambda: driver.scan.subscriber_count == driver.points.subscriber_count == 1)
        yield pair
    finally:
        probe.close()
        driver.close()


def test_udp_over_real_sockets(run_dir: Path) -> None:
    with listened(run_dir, silence_s=0.05) as pair:
        driver, probe = pair.driver, pair.probe
        with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as sensor:
            for payload in wall_stream(200, 3.0):  # 2.6 turns
                pair.send(sensor, payload)
        pair.spin_until(lambda: len(probe.scans) >= 2 and len(probe.clouds) >= 2)
        ranges = probe.scans[-1].ranges
        np.testing.assert_allclose(ranges[np.isfinite(ranges)], 3.0, atol=2e-3)
        assert np.isfinite(ranges).sum() > 300
        assert probe.clouds[-1].point_step == 22
        driver.receiver.close()  # packets that wait in the socket would end the silence
        driver.feed.last_ns -= SECOND
        driver.check()
        level, text, values = driver.diagnoses()["packets"]
        assert level == ERROR
        assert f"127.0.0.1:{driver.receiver.port}" in text and "rp_filter" in text
        assert values["packets"] == 200
    assert "vlp16 receiver" not in {thread.name for thread in threading.enumerate()}


def test_packets_of_a_second_address_ahead_of_the_sensor_withhold_the_scan(run_dir: Path) -> None:
    """A wall at 1.0 m became one at 20.0 m: 90 ms ahead, the stranger made every packet of the sensor late."""
    real, forged = wall_stream(300, 1.0), wall_stream(300, 20.0, start_us=90_000)
    with (
        listened(run_dir) as pair,
        socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as sensor,
        socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as stranger,
    ):
        driver, probe = pair.driver, pair.probe
        sensor.bind(("127.0.0.2", 0))
        stranger.bind(("127.0.0.3", 0))
        for index in range(200):
            pair.send(sensor, real[index])
        pair.spin_until(lambda: len(probe.scans) >= 2)
        pair.spin_until(lambda: driver.waiting == 0)
        before = len(probe.scans)
        for index in range(200, 300):
            stranger.sendto(forged[index], ("127.0.0.1", driver.receiver.port))
            pair.spin_until(lambda count=index - 199: driver.feed.sources.foreign >= count)  # type: ignore[misc]
            pair.send(sensor, real[index])
        pair.spin_until(lambda: driver.report.withheld >= 1)
        assert len(probe.scans) == before
        level, text, _ = driver.diagnoses()["source"]
        assert level == ERROR and "127.0.0.3" in text and "No scan" in text
        assert driver.feed.stream.counters.late == 0
        for scan in probe.scans:
            ranges = scan.ranges[np.isfinite(scan.ranges)]
            np.testing.assert_allclose(ranges, 1.0, atol=2e-3)


def test_forged_packets_with_the_sensors_address_withhold_points_and_scan(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(SourceGuard, "QUIET_S", 1.0)
    period_ns = PACKET_PERIOD_US * 1000.0
    frames = []
    real, forged = wall_stream(2450, 1.0), wall_stream(2450, 20.0, start_us=90_000)
    for index in range(2450):
        frames.append((RECORDED + round((index + 1) * period_ns), udp_frame(real[index])))
        if 450 <= index < 750:
            frames.append((RECORDED + round((index + 1.1) * period_ns), udp_frame(forged[index])))
    path = tmp_path / "forged.pcap"
    path.write_bytes(pcap(frames, nano=True))
    bus, node = played(path)
    bus.advance(1.0)
    level, text, _ = node.diagnoses()["source"]
    assert level == ERROR and "out of order" in text
    scans, clouds = len(bus.messages("/scan")), len(bus.messages("/lidar/points"))
    assert scans > 0
    bus.advance(0.9)  # the last forged packet was at 1.0 s; the doubt lasts 1 s
    assert (len(bus.messages("/scan")), len(bus.messages("/lidar/points"))) == (scans, clouds)
    bus.advance(1.3)
    assert node.diagnoses()["source"][0] == OK
    after = bus.messages("/scan")[scans:]
    assert len(after) > 3
    for scan in bus.messages("/scan"):
        ranges = scan.ranges[np.isfinite(scan.ranges)]
        np.testing.assert_allclose(ranges, 1.0, atol=2e-3)
    # The forged clock ran 90 ms ahead; the stamps of what follows are the sensor's again.
    assert stamp_ns(after[-1]) == pytest.approx(bus.records("/scan")[-1].stamp_ns, abs=2e7)


def test_a_sensor_that_repeats_one_revolution_gives_no_scan_and_no_points() -> None:
    bus = LockstepBus(start_ns=START)
    node = bus.add(Vlp16DriverNode, Vlp16DriverConfig(source="topic"))
    live, again = wall_stream(152, 5.0), wall_stream(76, 4.0)
    scans = 0
    for index in range(20 * 76):
        data = live[index] if index < 152 else again[index % 76]
        time_us = round(index * PACKET_PERIOD_US).to_bytes(4, "little")  # new stamps, old ranges
        bus.advance_to(START + round((index + 1) * PACKET_PERIOD_US * 1000.0))
        packet = VelodynePacket(
            stamp=to_time(bus.clock.now_ns()), data=np.frombuffer(data[:1200] + time_us + data[1204:], np.uint8)
        )
        bus.publish("/lidar/packets", VelodyneScan(header=header("velodyne", bus.clock.now_ns()), packets=[packet]))
        if index == 152 + 2 * 76:
            scans = len(bus.messages("/scan"))
    assert scans >= 3 and len(bus.messages("/scan")) <= scans + 1
    assert len(bus.messages("/lidar/points")) <= scans + 2
    node.check()
    level, text, values = node.diagnoses()["source"]
    assert level == ERROR and text.startswith("the sensor repeats the same revolution")
    assert values["withheld"] >= 15
