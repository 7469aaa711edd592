"""Conversion of the plain values of ``instant_ic.lidar`` to messages of the node ``vlp16_driver``."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from instant_ic.lidar.config import Vlp16DriverConfig
from instant_ic.lidar.feed import Packets
from instant_ic.lidar.stream import Revolution
from instant_ic.msg import VelodynePacket, VelodyneScan, header, scan_message, to_time


def packets_message(packets: Packets, revolution: Revolution, frame: str) -> Any:
    """Return the VelodyneScan with the packets of a revolution."""
    stamp = packets[0][1] if packets else revolution.stamp_ns
    data = [VelodynePacket(stamp=to_time(at), data=np.frombuffer(raw, np.uint8)) for raw, at in packets]
    return VelodyneScan(header=header(frame, stamp), packets=data)


def flat_scan_message(ranges: NDArray[np.float32], revolution: Revolution, config: Vlp16DriverConfig) -> Any:
    """Return the LaserScan with a revolution's flat scan, whose ranges are (beams,) in metres."""
    angles, limits = (-np.pi, 2.0 * np.pi / len(ranges)), (config.scan.range_min, config.scan.range_max)
    duration_s = (revolution.end_ns - revolution.stamp_ns) * 1e-9
    return scan_message(ranges, *angles, *limits, config.frame_id, revolution.end_ns, scan_time=duration_s)
