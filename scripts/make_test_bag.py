#!/usr/bin/env python3
"""Make the small bag that the tests replay: a slow drive through the simulated corridor, with device-level messages.

Everything runs in one process and in simulated time: the simulator's world and sensors, the real base driver on the
emulated motor controller, packets and images as the devices send them. Calls on the same machine give the same bag.

Usage: python scripts/make_test_bag.py tests/data/corridor_drive
"""

from __future__ import annotations

import argparse
import math
import sys
from pathlib import Path
from typing import Any

import cv2
import numpy as np

from instant_ic.bag import BagReader, BagWriter
from instant_ic.bus import LATCHED, SENSOR, QoS
from instant_ic.bus.lockstep import LockstepBus, Record
from instant_ic.experiments.teleop_stack import EmulatedPort
from instant_ic.geometry.poses import pose_matrix
from instant_ic.lidar.stream import PacketStream
from instant_ic.msg import (
    CompressedImage,
    TFMessage,
    VelodynePacket,
    VelodyneScan,
    compressed_image_message,
    header,
    odometry_message,
    serialize,
    to_time,
    transform_message,
    twist_stamped,
    type_name,
)
from instant_ic.sim.simulation import Simulation, SimulationConfig
from nodes.crawler_base import CrawlerBaseConfig, CrawlerBaseNode

START_NS = 1_760_000_000_000_000_000
STEP_S = 0.002
FIRST_SCAN_S = 0.2
"""By this time the base has connected and publishes odometry."""
CAMERA_PERIOD_S = 0.5
CAMERA_LATENCY_S = 0.2
TRUTH_PERIOD_S = 1.0 / 30.0
STANDING_S = 0.6
"""The robot stands still at first, so that the map starts at a known pose."""


def twist(time_s: float, seconds: float) -> tuple[float, float]:
    """Return the commanded twist: drive ahead in a gentle S curve, then stop."""
    if time_s < STANDING_S or time_s > seconds - 0.6:
        return 0.0, 0.0
    return 0.3, 0.25 * math.sin(2 * math.pi * (time_s - STANDING_S) / (seconds - STANDING_S))


def make(path: Path, seconds: float, quality: int) -> None:
    """Simulate the drive and write the bag."""
    simulation = Simulation(SimulationConfig(), start_ns=START_NS)
    with BagWriter(path, compressed=True) as writer:

        def write(topic: str, message: Any, stamp_ns: int, qos: QoS = SENSOR) -> None:
            writer.write(topic, type_name(message), bytes(serialize(message)), stamp_ns, qos)

        def record(entry: Record) -> None:
            if entry.topic in ("/wheel/odom", "/tf"):
                writer.write(entry.topic, entry.type_name, entry.payload, entry.stamp_ns, entry.qos)

        write("/tf_static", mounts(simulation), START_NS, LATCHED)
        with LockstepBus(start_ns=START_NS, keep=False, on_record=record) as bus:
            bus.add(CrawlerBaseNode, CrawlerBaseConfig(), open_port=lambda _: EmulatedPort(simulation.controller))
            lidar = _Lidar(simulation)
            picture: tuple[int, CompressedImage] | None = None
            next_picture_s, next_truth_s, next_command_s = CAMERA_PERIOD_S, 0.0, 0.0
            for step in range(1, round(seconds / STEP_S) + 1):
                time_s = step * STEP_S
                now_ns = simulation.epoch_ns(time_s)
                simulation.step(STEP_S)
                if time_s >= next_command_s:
                    next_command_s += 0.05
                    bus.publish("/cmd_vel", twist_stamped(*twist(time_s, seconds), now_ns), now_ns)
                bus.advance_to(now_ns)
                if time_s >= next_truth_s:
                    next_truth_s += TRUTH_PERIOD_S
                    v, _, w = simulation.robot.twist
                    truth = odometry_message(simulation.world_from_base(), v, w, "world", "base_link", now_ns)
                    write("/ground_truth/odom", truth, now_ns)
                for scan, stamp_ns in lidar.due(time_s):
                    if time_s > FIRST_SCAN_S:
                        write("/lidar/packets", scan, stamp_ns)
                if time_s >= next_picture_s:
                    next_picture_s += CAMERA_PERIOD_S
                    rgb = simulation.panorama(1024, 512).rgb
                    _, jpeg = cv2.imencode(".jpg", rgb[..., ::-1], [cv2.IMWRITE_JPEG_QUALITY, quality])
                    due_ns = now_ns + round(CAMERA_LATENCY_S * 1e9)
                    picture = due_ns, compressed_image_message(jpeg.tobytes(), "camera", now_ns)
                if picture is not None and now_ns >= picture[0]:
                    write("/camera/image/compressed", picture[1], picture[0])
                    picture = None


def mounts(simulation: Simulation) -> TFMessage:
    """Return the sensor mounts as the drivers publish them."""
    mounts = (("camera", simulation.config.camera_mount), ("velodyne", simulation.config.lidar_mount))
    return TFMessage(
        transforms=[
            transform_message(pose_matrix(*mount.pose), "base_link", frame, START_NS) for frame, mount in mounts
        ]
    )


class _Lidar:
    """Collects LiDAR packets into one message per revolution, as the driver does."""

    def __init__(self, simulation: Simulation) -> None:
        self._simulation = simulation
        self._stream = PacketStream()
        self._waiting: list[VelodynePacket] = []
        self._first_ns = 0

    def due(self, time_s: float) -> list[tuple[VelodyneScan, int]]:
        """Yield messages whose last packet is complete, each with the stamp of that packet."""
        done = []
        simulation = self._simulation
        while simulation.scanner.due(time_s) > 0:
            stamp_ns = simulation.epoch_ns(simulation.scanner.next_packet_end_s)
            (payload,) = simulation.scan_packets(1)
            self._first_ns = stamp_ns if not self._waiting else self._first_ns
            self._waiting.append(VelodynePacket(stamp=to_time(stamp_ns), data=np.frombuffer(payload, np.uint8)))
            if self._stream.feed(payload, stamp_ns) is not None:
                packets, self._waiting = self._waiting, []
                done.append((VelodyneScan(header=header("velodyne", self._first_ns), packets=packets), stamp_ns))
        return done


def main() -> int:
    """Write the bag."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("bag", type=Path, help="output folder")
    parser.add_argument("--seconds", type=float, default=5.0)
    parser.add_argument("--quality", type=int, default=80, help="JPEG quality (default: %(default)s)")
    args = parser.parse_args()
    make(args.bag, args.seconds, args.quality)
    with BagReader(args.bag) as reader:
        for topic in reader.topics:
            sys.stdout.write(f"{topic.topic}: {topic.count}\n")
    size = sum(file.stat().st_size for file in args.bag.iterdir())
    sys.stdout.write(f"{args.bag}: {size / 1e6:.2f} MB\n")
    return 0


if __name__ == "__main__":
    sys.exit(main())
