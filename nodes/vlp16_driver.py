"""Converts the VLP-16's packets, from the network, a capture or a bag, to point clouds and flat scans."""

from __future__ import annotations

import threading
from collections.abc import Iterator
from dataclasses import dataclass, field
from typing import Any, Literal

import numpy as np

from instant_ic.bus import ERROR, OK, SENSOR, WARN, Node, NodeError, main
from instant_ic.config.ranges import Positive, check_ranges
from instant_ic.geometry.poses import pose2_from_matrix, pose_matrix
from instant_ic.geometry.transforms import TransformError
from instant_ic.lidar.capture import CaptureError, CaptureReader, Datagram
from instant_ic.lidar.config import DecoderConfig, FlatScanConfig
from instant_ic.lidar.flatscan import coverage, flat_scan, warm_up
from instant_ic.lidar.motion import MotionError, PlanarMotion
from instant_ic.lidar.packets import DATA_PACKET_BYTES, PacketError, decode_position_packet
from instant_ic.lidar.receiver import PacketReceiver, ReceiverConfig, ReceiverError
from instant_ic.lidar.sources import SourceGuard
from instant_ic.lidar.stream import PacketStream, Revolution
from instant_ic.msg import (
    LaserScan,
    PointCloud2,
    VelodynePacket,
    VelodyneScan,
    cloud_message,
    header,
    scan_message,
    stamp_ns,
    to_time,
)

_PPS = ("absent", "synchronising", "locked", "error")
_MAX_WAITING = 5
"""Revolutions that may wait for the node's thread; with more the machine is too slow for the sensor."""
_MOTION_SAMPLES = 13


@dataclass(frozen=True)
class Vlp16DriverConfig:
    """Parameters.

    Attributes:
        source: ``udp``, ``pcap``, or ``topic`` (packets of a bag from /lidar/packets).
        host: local address; 0.0.0.0 also takes broadcasts.
        port: port of data packets.
        position_port: port of position packets; -1: not received.
        sensor: the sensor's IPv4 address; empty: the first sender until the driver restarts.
        pcap: capture file, for source pcap.
        rate: playback rate of the capture; 1 is the recorded rate.
        loop: restart the capture at its end.
        frame_id: the sensor's frame.
        mount_xyz: sensor position on base_link, metres.
        mount_rpy_deg: sensor roll, pitch, yaw on base_link, degrees.
        silence_s: seconds without a packet that are an error.
        decoder: conversion of packets to points.
        scan: conversion of points to the flat scan.
    """

    source: Literal["udp", "pcap", "topic"] = "udp"
    host: str = "0.0.0.0"
    port: int = 2368
    position_port: int = 8308
    sensor: str = ""
    pcap: str = ""
    rate: Positive = 1.0
    loop: bool = False
    frame_id: str = "velodyne"
    mount_xyz: tuple[float, float, float] = (0.0, 0.0, 0.6)
    mount_rpy_deg: tuple[float, float, float] = (0.0, 0.0, 0.0)
    silence_s: Positive = 2.0
    decoder: DecoderConfig = field(default_factory=DecoderConfig)
    scan: FlatScanConfig = field(default_factory=FlatScanConfig)

    def __post_init__(self) -> None:
        check_ranges(self)
        if self.source == "pcap" and not self.pcap:
            raise ValueError("pcap must name a capture file where source is pcap (got '')")
        self.receiver()

    def receiver(self) -> ReceiverConfig:
        """The receiver's part of the parameters."""
        return ReceiverConfig(self.host, self.port, self.position_port, self.sensor)


class Vlp16DriverNode(Node[Vlp16DriverConfig]):
    name = "vlp16_driver"
    live_parameters = ("silence_s", "scan")

    def setup(self) -> None:
        """Create the topics, the mount and the packet source."""
        config = self.config
        warm_up()
        self.ending = threading.Event()
        self.thread: threading.Thread | None = None
        self.stream = PacketStream(config.decoder)
        self.sources = SourceGuard(config.sensor)
        self.doubtful = False
        self.withheld = 0
        self.raw: list[tuple[bytes, int]] = []
        self.waiting = 0
        self.skipped = 0
        self.partial = 0
        self.partial_told = 0
        self.told = (0, 0, 0)
        self.last_ns = self.clock.steady_ns()
        self.base_from_lidar = pose_matrix(*config.mount_xyz, *np.radians(config.mount_rpy_deg))
        self.tf_broadcast_static("base_link", config.frame_id, self.base_from_lidar)
        self.tf.frames()  # listens to odometry from here on
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
            self.receiver = PacketReceiver(config.receiver(), self.sources, self.clock.steady_ns)
            try:
                self.receiver.connect()
            except ReceiverError as error:
                raise NodeError(str(error)) from error
            self.thread = threading.Thread(target=self.receive, name="vlp16 receiver", daemon=True)
            self.thread.start()

    # -- sources -----------------------------------------------------------------------------------

    def receive(self) -> None:
        """Receive and decode until the node ends; runs on the receiver's own thread."""
        try:
            while not self.ending.is_set():
                for stamp, payload, is_data in self.receiver.read(timeout_s=0.2):
                    if is_data:
                        self.take(payload, stamp)
                    else:
                        self.call_soon(self.on_position, payload)
        except Exception as error:  # noqa: BLE001 - nothing else reports what ends a thread
            self.call_soon(self.fault, "receiver", error)
            self.call_soon(self.stop)

    def on_packets(self, message: Any) -> None:
        """Take the packets of a bag."""
        for packet in message.packets:
            self.take(packet.data.tobytes(), stamp_ns(packet))

    def open_capture(self) -> None:
        """Start the capture from its beginning."""
        try:
            self.capture = CaptureReader(self.config.pcap)
        except (CaptureError, OSError) as error:
            raise NodeError(f"pcap: {error}") from error
        self.datagrams: Iterator[Datagram] = iter(self.capture)
        self.next_datagram: Datagram | None = next(self.datagrams, None)
        if self.next_datagram is None:
            raise NodeError(f"{self.config.pcap}: holds no UDP datagram ({dict(self.capture.counters.skipped)})")
        self.first_ns = self.next_datagram.stamp_ns
        self.play_start_ns, self.play_start_steady_ns = self.clock.now_ns(), self.clock.steady_ns()

    def play(self) -> None:
        """Take the packets of the capture that are due."""
        elapsed_ns = (self.clock.steady_ns() - self.play_start_steady_ns) * self.config.rate
        while self.next_datagram is not None and self.next_datagram.stamp_ns - self.first_ns <= elapsed_ns:
            stamp, port, payload = self.next_datagram
            # Stamps keep the sensor's own rate at any playback rate; otherwise its clock would seem to drift.
            stamp = self.play_start_ns + stamp - self.first_ns
            if port == self.config.position_port and len(payload) != DATA_PACKET_BYTES:
                self.on_position(payload)
            else:
                self.take(payload, stamp)
            self.next_datagram = next(self.datagrams, None)
            if self.next_datagram is None:
                self.end_capture()

    def end_capture(self) -> None:
        """Handle the end of the capture."""
        last = self.stream.finish()
        if last is not None:
            self.hand_on(last)
        skipped = ", ".join(f"{count} x {reason}" for reason, count in self.capture.counters.skipped.items())
        text = f"{self.capture.counters.datagrams} datagrams played" + (f"; left out: {skipped}" if skipped else "")
        self.diagnose("capture", WARN if skipped else OK, text)
        self.log.info("%s: %s", self.config.pcap, text)
        if self.config.loop:
            self.open_capture()

    def take(self, payload: bytes, stamp: int) -> None:
        """Take one data packet, on whichever thread packets arrive."""
        self.last_ns = self.clock.steady_ns()
        counters = self.stream.counters
        taken, late = counters.packets, counters.late + counters.clock_resets
        revolution = self.stream.feed(payload, stamp)
        self.sources.count(counters.packets - taken, counters.late + counters.clock_resets - late, self.last_ns)
        doubtful, self.doubtful = self.doubtful, self.sources.doubt(self.last_ns) is not None
        if doubtful and not self.doubtful:
            # A forged packet may have moved the sensor's clock, and is part of the revolution so far.
            self.stream.restart()
            revolution = None
        if len(payload) == DATA_PACKET_BYTES:
            self.raw.append((payload, stamp))
        if revolution is not None:
            self.hand_on(revolution)

    def hand_on(self, revolution: Revolution) -> None:
        """Pass a revolution and its packets to the node's thread."""
        raw, self.raw = self.raw, []
        if self.thread is None:
            self.on_revolution(revolution, raw)
        elif self.waiting >= _MAX_WAITING:
            self.skipped += 1
        else:
            self.waiting += 1
            self.call_soon(self.on_received, revolution, raw)

    # -- results -----------------------------------------------------------------------------------

    def on_received(self, revolution: Revolution, raw: list[tuple[bytes, int]]) -> None:
        """Handle a revolution from the receiver's thread."""
        self.waiting -= 1
        self.on_revolution(revolution, raw)

    def on_revolution(self, revolution: Revolution, raw: list[tuple[bytes, int]]) -> None:
        """Publish packets, points and scan of one revolution."""
        config = self.config
        if self.packets is not None and (self.lockstep or self.packets.subscriber_count):
            self.packets.publish(
                VelodyneScan(
                    header=header(config.frame_id, raw[0][1] if raw else revolution.stamp_ns),
                    packets=[
                        VelodynePacket(stamp=to_time(stamp), data=np.frombuffer(payload, np.uint8))
                        for payload, stamp in raw
                    ],
                )
            )
        doubt = self.sources.doubt(self.clock.steady_ns())
        if doubt is not None:
            # Without a scan the robot stops; a forged one could drive it into a wall.
            self.withheld += 1
            self.diagnose("source", ERROR, doubt, withheld=self.withheld)
            return
        self.points.publish(cloud_message(revolution.points, config.frame_id, revolution.stamp_ns))
        if coverage(revolution) < config.scan.min_coverage:
            # Half blind: it would mislead map matching, and the scan itself does not show the fault to other nodes.
            self.partial += 1
            return
        motion = self.motion(revolution)
        try:
            scan = flat_scan(revolution, self.base_from_lidar, config.scan, motion)
        except MotionError as error:
            self.diagnose("motion", WARN, f"scan is not motion-compensated: {error}")
            scan = flat_scan(revolution, self.base_from_lidar, config.scan, None)
        self.scan.publish(
            scan_message(
                scan.ranges,
                scan.angle_min,
                scan.angle_increment,
                config.scan.range_min,
                config.scan.range_max,
                config.frame_id,
                scan.stamp_ns,
                scan_time=(revolution.end_ns - revolution.stamp_ns) * 1e-9,
            )
        )

    def motion(self, revolution: Revolution) -> PlanarMotion | None:
        """Poses of the base around a revolution from /tf; None where they are not published."""
        newest_ns = self.tf.newest_ns("base_link")
        if newest_ns is None:
            self.diagnose("motion", OK, "no odometry: the base is assumed to stand still")
            return None
        # Odometry of the last milliseconds has not arrived yet: the motion is extrapolated.
        stop_ns = min(revolution.end_ns, newest_ns)
        start_ns = min(revolution.stamp_ns, stop_ns - 50_000_000)
        stamps_ns = np.linspace(start_ns, stop_ns, _MOTION_SAMPLES).astype(np.int64)
        try:
            poses = [pose2_from_matrix(self.tf.lookup("odom", "base_link", int(stamp))) for stamp in stamps_ns]
        except TransformError as error:
            self.diagnose("motion", WARN, f"scan is not motion-compensated: {error}")
            return None
        self.diagnose("motion", OK, "scan is motion-compensated")
        return PlanarMotion(stamps_ns, np.array(poses))

    def on_position(self, payload: bytes) -> None:
        """Report the sensor's clock."""
        try:
            position = decode_position_packet(payload)
        except PacketError as error:
            self.diagnose("position", WARN, str(error))
            return
        pps = _PPS[position.pps] if position.pps < len(_PPS) else str(position.pps)
        self.diagnose("position", OK, f"pulse per second {pps}", nmea=position.nmea)

    def check(self) -> None:
        """Report silence and losses; each second."""
        counters = self.stream.counters
        silent_s = (self.clock.steady_ns() - self.last_ns) * 1e-9
        losses = (counters.missing, counters.bad, self.skipped)
        new = [now - before for now, before in zip(losses, self.told, strict=True)]
        self.told = losses
        values = {
            "packets": counters.packets,
            "revolutions": counters.revolutions,
            "missing": counters.missing,
            "late": counters.late,
            "bad": counters.bad,
            "clock_resets": counters.clock_resets + self.stream.clock.resets,
            "revolutions_skipped": self.skipped,
            "revolutions_partial": self.partial,
        }
        doubt = self.sources.doubt(self.clock.steady_ns())
        self.diagnose(
            "source",
            OK if doubt is None else ERROR,
            doubt or "one sender, in order",
            foreign=self.sources.foreign,
            withheld=self.withheld,
        )
        if silent_s > self.config.silence_s:
            self.diagnose("packets", ERROR, self.silence(silent_s), **values)
        elif not counters.packets:
            self.diagnose("packets", WARN, "no packet yet", **values)
        elif any(new):
            text = (
                f"in the last second {new[0]} packets missing, {new[1]} not from a VLP-16, {new[2]} revolutions skipped"
            )
            self.diagnose("packets", WARN, text, **values)
        else:
            partial, self.partial_told = self.partial - self.partial_told, self.partial
            text = (
                f"receiving packets; {partial} incomplete revolutions gave no scan" if partial else "receiving packets"
            )
            self.diagnose("packets", OK, text, **values)

    def silence(self, silent_s: float) -> str:
        """What to check when no packets arrive."""
        if self.config.source == "topic":
            return f"no /lidar/packets for {silent_s:.1f} s"
        if self.config.source == "pcap":
            return f"{self.config.pcap} has ended"
        return (
            f"no packet on UDP {self.config.host}:{self.receiver.port} for {silent_s:.1f} s: is the sensor on, does "
            "its destination address fit, is this host in its network (factory: 192.168.1.201), does a firewall "
            "block it, is net.ipv4.conf.*.rp_filter 0?"
        )

    def teardown(self) -> None:
        if hasattr(self, "ending"):
            self.ending.set()
        if getattr(self, "thread", None) is not None:
            assert self.thread is not None
            self.thread.join(2.0)
        if hasattr(self, "receiver"):
            self.receiver.close()


if __name__ == "__main__":
    main(Vlp16DriverNode)
