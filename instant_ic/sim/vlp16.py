"""VLP-16 as UDP packets: rays with firing times and motion distortion."""

import math
import socket
from collections.abc import Callable
from dataclasses import dataclass
from datetime import UTC, datetime
from typing import Annotated

import numpy as np
import numpy.typing as npt

from instant_ic.config.ranges import NotNegative, PositiveInt, Range, check_ranges, require
from instant_ic.config.robot import LIDAR_MOUNT, Mount
from instant_ic.geometry.poses import pose_matrix
from instant_ic.lidar import packets as wire
from instant_ic.sim.world import World

FloatArray = npt.NDArray[np.float64]
#: Returns x, y, yaw (N, 3) of base_link at simulated times (N,) in seconds.
PoseAt = Callable[[FloatArray], FloatArray]


@dataclass(frozen=True)
class Vlp16Config:
    """Parameters of the simulated scanner.

    Attributes:
        enabled: whether the scanner is simulated.
        host: destination of the packets.
        data_port, position_port: destination UDP ports.
        rpm: revolutions per minute, 300-1200.
        range_noise: standard deviation of a range, metres.
        min_range, max_range: limits of a return, metres; anything nearer or farther gives none.
        burst: packets sent together (1.33 ms each); larger bursts need less CPU.
    """

    enabled: bool = True
    host: str = "127.0.0.1"
    data_port: Annotated[int, Range(1, 65535)] = 2368
    position_port: Annotated[int, Range(1, 65535)] = 8308
    rpm: Annotated[float, Range(300, 1200)] = 600.0
    range_noise: NotNegative = 0.01
    min_range: NotNegative = 0.2
    max_range: Annotated[float, Range(above=0, high=131)] = 100.0
    burst: PositiveInt = 8

    def __post_init__(self) -> None:
        check_ranges(self)
        require(self, "min_range", self.min_range < self.max_range, "below max_range")


class Vlp16:
    """Optics and clock of the scanner: produces packets for intervals of simulated time.

    Args:
        config: parameters.
        world: the world to scan.
        pose_at: pose of base_link at given times.
        epoch_ns: epoch time of a simulated time, which gives the packets' microseconds past the hour.
        seed: seed of the noise.
        mount: pose on base_link.
    """

    def __init__(
        self,
        config: Vlp16Config,
        world: World,
        pose_at: PoseAt,
        epoch_ns: Callable[[float], int],
        seed: int = 0,
        mount: Mount = LIDAR_MOUNT,
    ) -> None:
        self.config = config
        self._base_from_lidar = pose_matrix(*mount.pose)
        self._world = world
        self._pose_at = pose_at
        self._epoch_ns = epoch_ns
        self._rng = np.random.default_rng([37, seed])
        self.packets = 0
        omega = np.radians(wire.LASER_ELEVATION_DEG)
        self._cos, self._sin = np.cos(omega), np.sin(omega)
        self._reflectance = (
            100.0 * np.clip((world.textures.mean[world.texture] * world.tint).mean(axis=1), 0, 1)
        ).astype(np.float32)
        block = np.arange(wire.BLOCKS)[:, None, None] * wire.BLOCK_PERIOD_US
        firing = np.arange(wire.FIRINGS)[None, :, None] * wire.FIRING_PERIOD_US
        laser = np.arange(wire.LASERS)[None, None, :] * wire.LASER_PERIOD_US
        self._firing_s = (block + firing + laser) * 1e-6

    @property
    def next_packet_end_s(self) -> float:
        """Time at which the last laser of the next packet fires."""
        return (self.packets + 1) * wire.PACKET_PERIOD_US * 1e-6

    def skip_to(self, time_s: float) -> int:
        """Skip the packets that begin before a time and return their number."""
        target = math.ceil(time_s / (wire.PACKET_PERIOD_US * 1e-6))
        skipped = max(0, target - self.packets)
        self.packets += skipped
        return skipped

    def due(self, time_s: float) -> int:
        """Number of packets that are complete at a time and not yet made."""
        return max(0, math.floor(time_s / (wire.PACKET_PERIOD_US * 1e-6)) - self.packets)

    def make(self, count: int) -> list[bytes]:
        """Make the next ``count`` data packets; the poses up to the end of the last one must be known."""
        if count < 1:
            return []
        config = self.config
        first_s = (self.packets + np.arange(count)) * (wire.PACKET_PERIOD_US * 1e-6)
        self.packets += count
        times = first_s[:, None, None, None] + self._firing_s
        degrees_per_s = config.rpm * 6.0
        # Azimuth is clockwise when viewed from above, 0 ahead (the sensor's x in ROS axes).
        alpha = np.radians((times * degrees_per_s) % 360.0)
        pose = self._pose_at(times.ravel()).reshape(*times.shape, 3)
        beams = np.stack([self._cos * np.cos(alpha), -self._cos * np.sin(alpha), self._sin + 0 * alpha], axis=-1)
        beams = beams @ self._base_from_lidar[:3, :3].T
        c, s = np.cos(pose[..., 2]), np.sin(pose[..., 2])
        directions = np.empty((*times.shape, 3), np.float32)
        directions[..., 0] = c * beams[..., 0] - s * beams[..., 1]
        directions[..., 1] = s * beams[..., 0] + c * beams[..., 1]
        directions[..., 2] = beams[..., 2]
        mx, my, mz = self._base_from_lidar[:3, 3]
        origins = np.empty_like(directions)
        origins[..., 0] = pose[..., 0] + c * mx - s * my
        origins[..., 1] = pose[..., 1] + s * mx + c * my
        origins[..., 2] = mz + wire.LASER_VERTICAL_OFFSET_M
        flat = directions.reshape(-1, 3)
        range_m, face = self._world.caster.cast(origins.reshape(-1, 3), flat)
        seen = (range_m >= config.min_range) & (range_m <= config.max_range)
        measured = np.where(seen, range_m, 0.0)
        if config.range_noise > 0:
            measured += np.where(seen, self._rng.normal(0, config.range_noise, len(measured)), 0.0)
        surface = self._world.face_surface[np.maximum(face, 0)]
        incidence = np.abs(np.einsum("ij,ij->i", self._world.normal[surface], flat))
        reflectivity = np.where(seen, self._reflectance[surface] * (0.35 + 0.65 * incidence), 0.0)

        out = np.zeros(count, wire.PACKET_DTYPE)
        blocks = out["blocks"]
        blocks["flag"] = wire.BLOCK_FLAG
        azimuth = np.rint(np.degrees(alpha[:, :, 0, 0]) * 100.0).astype(np.int64) % 36000
        blocks["azimuth"] = azimuth
        units = np.clip(np.rint(measured / wire.DISTANCE_UNIT_M), 0, 0xFFFF).astype(np.uint16)
        blocks["returns"]["distance"] = units.reshape(times.shape)
        blocks["returns"]["reflectivity"] = np.rint(reflectivity).astype(np.uint8).reshape(times.shape)
        out["timestamp_us"] = [self._epoch_ns(second) // 1000 % wire.HOUR_US for second in first_s]
        out["return_mode"] = wire.RETURN_STRONGEST
        out["product"] = wire.PRODUCT_VLP16
        data = out.tobytes()
        size = wire.DATA_PACKET_BYTES
        return [data[i * size : (i + 1) * size] for i in range(count)]

    def position_packet(self, time_s: float) -> bytes:
        """Position packet of a sensor whose clock is locked to GPS time."""
        now_ns = self._epoch_ns(time_s)
        moment = datetime.fromtimestamp(now_ns // 1_000_000_000, UTC)
        body = f"GPRMC,{moment:%H%M%S},A,0000.0000,N,00000.0000,E,000.0,000.0,{moment:%d%m%y},000.0,E"
        checksum = 0
        for character in body.encode("ascii"):
            checksum ^= character
        return wire.encode_position_packet((now_ns // 1000) % wire.HOUR_US, 2, f"${body}*{checksum:02X}")


class Vlp16Server:
    """Sends the scanner's packets over UDP as simulated time advances.

    Attributes:
        sent: data packets sent.
        skipped: data packets skipped because the machine was too slow.
    """

    POSITION_PERIOD_S = 0.1
    #: Lag above which packets are skipped, seconds.
    MOST_LAG_S = 0.5

    def __init__(self, scanner: Vlp16) -> None:
        self._scanner = scanner
        self._config = scanner.config
        self._socket = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
        self._socket.setsockopt(socket.SOL_SOCKET, socket.SO_BROADCAST, 1)
        self._next_position_s = 0.0
        self.sent = 0
        self.skipped = 0
        self.refused = 0

    def pump(self, time_s: float) -> None:
        """Send the packets that are complete at simulated time ``time_s``, in bursts."""
        due = self._scanner.due(time_s)
        if due * wire.PACKET_PERIOD_US * 1e-6 > self.MOST_LAG_S:
            self.skipped += self._scanner.skip_to(time_s - 0.1)
            due = self._scanner.due(time_s)
        if due >= self._config.burst:
            for packet in self._scanner.make(due):
                self._send(packet, self._config.data_port)
                self.sent += 1
        if time_s >= self._next_position_s:
            self._send(self._scanner.position_packet(time_s), self._config.position_port)
            self._next_position_s = time_s + self.POSITION_PERIOD_S

    def close(self) -> None:
        """Close the socket."""
        self._socket.close()

    def _send(self, payload: bytes, port: int) -> None:
        try:
            self._socket.sendto(payload, (self._config.host, port))
        except ConnectionRefusedError:
            # No listener yet: the kernel reports the error of an earlier packet. A real sensor ignores it too.
            self.refused += 1
