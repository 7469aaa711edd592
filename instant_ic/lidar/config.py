"""Parameters of the VLP-16: decoding, the flat scan, the node."""

from dataclasses import dataclass, field
from typing import Annotated, Literal

from instant_ic.config.ranges import Plausible, Range, check_ranges
from instant_ic.config.robot import LIDAR_MOUNT, Mount
from instant_ic.lidar.head import TURN_CDEG, Sector
from instant_ic.lidar.receiver import ReceiverConfig

Azimuth = Annotated[float, Range(0, 360)]


@dataclass(frozen=True)
class DecoderConfig:
    """Parameters of decoding packets into revolutions.

    Attributes:
        cut_angle_deg: azimuth at which a revolution ends, clockwise from ahead, degrees.
        min_range: smallest range of a return, metres; nearer ones are dropped as too close.
        max_range: largest range of a return, metres; farther ones are dropped.
        fov_start_deg: start of the field of view that the sensor is set to, clockwise from ahead, degrees.
        fov_end_deg: end of that field of view, degrees; a view from 0 to 359 or 360 is the whole circle.
    """

    cut_angle_deg: Annotated[float, Range(0, below=360)] = 180.0
    min_range: Annotated[float, Plausible(0, 2)] = 0.4
    max_range: Annotated[float, Plausible(5, 131.07)] = 130.0
    fov_start_deg: Azimuth = 0.0
    fov_end_deg: Azimuth = 360.0

    def __post_init__(self) -> None:
        check_ranges(self)
        if self.fov_start_deg == self.fov_end_deg:
            raise ValueError(f"fov_start_deg and fov_end_deg must differ (got {self.fov_start_deg} for both)")

    @property
    def blocked(self) -> Sector | None:
        """The sector outside the configured field of view; None for the whole circle."""
        width = round((self.fov_start_deg - self.fov_end_deg) % 360.0 * 100.0)
        return Sector(round(self.fov_end_deg * 100.0) % TURN_CDEG, width) if width > 100 else None


@dataclass(frozen=True)
class FlatScanConfig:
    """Parameters of the flat scan: one range per direction from a revolution.

    Attributes:
        min_height: height under which points are no obstacles, metres above the ground (z of base_link).
        max_height: height above which the robot passes under points, metres above the ground.
        beams: number of directions over 360 degrees.
        range_min: smallest range of the scan, metres; nearer points count as too close (-inf).
        range_max: largest range of the scan, metres; farther points are left out.
        min_coverage: share of the circle, 0-1, that a revolution must have measured to give a scan.
    """

    min_height: Annotated[float, Plausible(-1, 0.5)] = 0.10
    max_height: Annotated[float, Plausible(0.2, 5)] = 1.30
    beams: Annotated[int, Plausible(90, 7200)] = 720
    range_min: Annotated[float, Plausible(0, 2)] = 0.4
    range_max: Annotated[float, Plausible(5, 150)] = 100.0
    min_coverage: Annotated[float, Plausible(0.05, 1)] = 0.75

    def __post_init__(self) -> None:
        check_ranges(self)
        if not self.min_height < self.max_height:
            raise ValueError(f"min_height must be below max_height (got {self.min_height}, {self.max_height})")


@dataclass(frozen=True)
class Vlp16DriverConfig(ReceiverConfig):
    """Parameters of the node ``vlp16_driver``, in addition to those of the receiver.

    Attributes:
        source: ``udp``, ``pcap``, or ``topic`` (packets of a bag from /lidar/packets).
        pcap: capture file, for source pcap.
        loop: start the capture again at its end.
        frame_id: the sensor's frame.
        lidar_mount: the sensor's pose on base_link.
        silence_s: seconds without a packet after which the driver reports an error.
        decoder: conversion of packets to points.
        scan: conversion of points to the flat scan.
    """

    source: Literal["udp", "pcap", "topic"] = "udp"
    pcap: str = ""
    loop: bool = False
    frame_id: str = "velodyne"
    lidar_mount: Mount = LIDAR_MOUNT
    silence_s: Annotated[float, Plausible(0.05, 60)] = 2.0
    decoder: DecoderConfig = field(default_factory=DecoderConfig)
    scan: FlatScanConfig = field(default_factory=FlatScanConfig)

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.source == "pcap" and not self.pcap:
            raise ValueError("pcap must name a capture file if source is pcap (got '')")
