"""Messages of the node ``vlp16_driver`` from the plain values of ``instant_ic.lidar``."""

from __future__ import annotations

from typing import Any

import numpy as np

from instant_ic.lidar.config import Vlp16DriverConfig
from instant_ic.lidar.feed import Packets
from instant_ic.lidar.flatscan import FlatScan
from instant_ic.lidar.stream import Revolution
from instant_ic.msg import VelodynePacket, VelodyneScan, header, scan_message, to_time


def packets_message(packets: Packets, revolution: Revolution, frame: str) -> Any:
    """VelodyneScan of the packets of a revolution."""
    stamp = packets[0][1] if packets else revolution.stamp_ns
    data = [VelodynePacket(stamp=to_time(at), data=np.frombuffer(raw, np.uint8)) for raw, at in packets]
    return VelodyneScan(header=header(frame, stamp), packets=data)


def flat_scan_message(scan: FlatScan, revolution: Revolution, config: Vlp16DriverConfig) -> Any:
    """LaserScan of a revolution's flat scan."""
    angles, limits = (scan.angle_min, scan.angle_increment), (config.scan.range_min, config.scan.range_max)
    duration_s = (revolution.end_ns - revolution.stamp_ns) * 1e-9
    return scan_message(scan.ranges, *angles, *limits, config.frame_id, scan.stamp_ns, scan_time=duration_s)
