"""Converts VLP-16 packets from the network, a capture or a bag to point clouds and flat scans."""

from __future__ import annotations

from typing import Any

from instant_ic.adapters.lidar import flat_scan_message, packets_message
from instant_ic.bus import SENSOR, Node, NodeError, main
from instant_ic.geometry.poses import pose_matrix
from instant_ic.lidar.capture import CaptureError, CapturePlayer
from instant_ic.lidar.config import Vlp16DriverConfig
from instant_ic.lidar.cover import CoverWatch
from instant_ic.lidar.feed import PacketFeed, Packets
from instant_ic.lidar.flatscan import check_level, compensated_scan, warm_up
from instant_ic.lidar.motion import base_pose
from instant_ic.lidar.packets import DATA_PACKET_BYTES
from instant_ic.lidar.receiver import PacketReceiver, ReceiverError, SensorDatagram
from instant_ic.lidar.report import LidarReport
from instant_ic.lidar.stream import Revolution
from instant_ic.msg import LaserScan, PointCloud2, VelodyneScan, cloud_message, stamp_ns

_MAX_WAITING = 5
"""Number of revolutions that may wait for the node's thread. With more, the machine is too slow for the sensor."""


class Vlp16DriverNode(Node[Vlp16DriverConfig]):
    name = "vlp16_driver"
    live_parameters = ("silence_s", "scan")

    def setup(self) -> None:
        config = self.config
        warm_up()
        self.receiver: PacketReceiver | None = None
        self.feed = PacketFeed(config.decoder, config.sensor, self.clock.steady_ns())
        self.report = LidarReport(self.feed)
        self.cover = CoverWatch()
        self.waiting = 0
        self.base_from_lidar = pose_matrix(*config.lidar_mount.pose)
        try:
            check_level(self.base_from_lidar)
        except ValueError as error:
            raise NodeError(str(error)) from None
        self.transforms.broadcast_static("base_link", config.frame_id, self.base_from_lidar)
        self.tf.frames()  # starts listening to odometry
        self.points = self.publisher("/lidar/points", PointCloud2, qos=SENSOR)
        self.scan = self.publisher("/scan", LaserScan, qos=SENSOR)
        self.packets = self.publisher("/lidar/packets", VelodyneScan, qos=SENSOR) if config.source != "topic" else None
        self.timer(1.0, self.check)
        if config.source == "topic":
            self.subscribe("/lidar/packets", VelodyneScan, self.on_packets, qos=SENSOR)
        elif config.source == "pcap":
            self.open_capture()
            self.timer(0.01, self.play)
        elif self.lockstep:
            raise NodeError("source udp cannot run in lockstep: use source:=pcap or source:=topic")
        else:
            try:
                self.receiver = PacketReceiver(config, self.feed.sources, self.clock.steady_ns)
            except ReceiverError as error:
                raise NodeError(str(error)) from error
            self.receiver.start(self.on_datagram, self.on_fault)

    def on_fault(self, error: Exception) -> None:
        self.call_soon(self.callbacks.fault, "receiver", error)
        self.call_soon(self.stop)

    def on_packets(self, message: Any) -> None:
        for packet in message.packets:
            self.take(packet.data.tobytes(), stamp_ns(packet))

    def open_capture(self) -> None:
        """Start the capture from its beginning."""
        try:
            now_ns, steady_ns = self.clock.now_ns(), self.clock.steady_ns()
            self.player = CapturePlayer(self.config.pcap, now_ns, steady_ns)
        except (CaptureError, OSError) as error:
            raise NodeError(f"pcap: {error}") from error

    def play(self) -> None:
        if self.player.ended:
            return
        for stamp, port, payload in self.player.due(self.clock.steady_ns()):
            is_data = port != self.config.position_port or len(payload) == DATA_PACKET_BYTES
            self.on_datagram(SensorDatagram(stamp, payload, is_data))
        if not self.player.ended:
            return
        if (last := self.feed.finish()) is not None:
            self.hand_on(*last)
        found = self.player.diagnosis
        self.diagnose_all(found)
        self.log.info("%s: %s", self.config.pcap, found.text)
        if self.config.loop:
            self.report.capture_restarts()
            self.open_capture()

    def on_datagram(self, received: SensorDatagram) -> None:
        """Take a datagram on the thread on which it arrives."""
        if received.is_data:
            self.take(received.payload, received.stamp_ns)
        else:
            self.call_soon(self.diagnose_all, self.report.position(received.payload))

    def take(self, payload: bytes, stamp: int) -> None:
        """Take one data packet on the thread on which it arrives."""
        done = self.feed.take(payload, stamp, self.clock.steady_ns())
        if done is not None:
            self.hand_on(*done)

    def hand_on(self, revolution: Revolution, packets: Packets) -> None:
        """Pass a revolution and its packets to the node's thread."""
        if self.receiver is None:
            self.on_revolution(revolution, packets)
        elif self.waiting >= _MAX_WAITING:
            self.report.skipped += 1
        else:
            self.waiting += 1
            self.call_soon(self.on_revolution, revolution, packets)

    def on_revolution(self, revolution: Revolution, packets: Packets) -> None:
        config = self.config
        if self.receiver is not None:
            self.waiting -= 1
        if self.packets is not None and (self.lockstep or self.packets.subscriber_count):
            self.packets.publish(packets_message(packets, revolution, config.frame_id))
        if not self.report.trusts(revolution, self.clock.steady_ns()):
            self.diagnose_all(self.report.source(self.clock.steady_ns()))
            return
        self.points.publish(cloud_message(revolution.points, config.frame_id, revolution.stamp_ns))
        if self.report.covers(revolution, config.scan.min_coverage):
            ranges, state = compensated_scan(revolution, self.base_from_lidar, config.scan, self.tf)
            self.cover.update(revolution, base_pose(self.tf))
            self.diagnose_all(state, self.cover.diagnosis)
            self.scan.publish(flat_scan_message(self.cover.withhold(ranges), revolution, config))

    def check(self) -> None:
        """Report missing and lost data, each second."""
        config = self.config
        where = f"{config.host}:{self.receiver.port}" if self.receiver is not None else config.pcap
        self.diagnose_all(*self.report.check(self.clock.steady_ns(), config.silence_s, config.source, where))

    def teardown(self) -> None:
        if (receiver := getattr(self, "receiver", None)) is not None:
            receiver.close()


if __name__ == "__main__":
    main(Vlp16DriverNode)
