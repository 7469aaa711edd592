"""A simulated VLP-16: UDP packets of rays with firing times and motion distortion."""

import contextlib
import math
import socket
from collections.abc import Callable
from dataclasses import dataclass
from datetime import UTC, datetime
from functools import reduce
from operator import xor
from typing import Annotated

import numba
import numpy as np
import numpy.typing as npt

from instant_ic.config.ranges import Checked, NotNegative, PositiveInt, Range
from instant_ic.config.robot import LIDAR_MOUNT, Mount
from instant_ic.geometry.poses import pose_matrix
from instant_ic.lidar import packets as wire
from instant_ic.sim.world import World

FloatArray = npt.NDArray[np.float64]
F32 = npt.NDArray[np.float32]
#: Revolutions per minute.
RPM = 600.0
#: Range in metres below which a surface gives no return.
MIN_RANGE_M = 0.2
#: Function that returns x, y, yaw (N, 3) of base_link at simulated times (N,) in seconds.
PoseAt = Callable[[FloatArray], FloatArray]


@dataclass(frozen=True)
class Vlp16Config(Checked):
    """Parameters of the simulated scanner.

    Attributes:
        enabled: whether the scanner is simulated.
        host: destination of the packets.
        data_port, position_port: destination UDP ports.
        range_noise: standard deviation of a range, metres.
        max_range: range in metres above which a surface gives no return.
        burst: number of packets sent together (1.33 ms each); larger bursts need less CPU.
    """

    enabled: bool = True
    host: str = "127.0.0.1"
    data_port: Annotated[int, Range(1, 65535)] = 2368
    position_port: Annotated[int, Range(1, 65535)] = 8308
    range_noise: NotNegative = 0.01
    max_range: Annotated[float, Range(above=MIN_RANGE_M, high=131)] = 100.0
    burst: PositiveInt = 8


@numba.njit(cache=True, nogil=True)
def _place_beams(
    beams: F32, azimuth_rad: FloatArray, pose: FloatArray, base_from_lidar: FloatArray, origins: F32, directions: F32
) -> None:
    """Write the world origins and directions (P · B, 3) of the beams of P packets.

    Args:
        beams: direction in the sensor's frame at azimuth 0, share of the packet's time, height over the origin, (B, 5).
        azimuth_rad: azimuth at the start of each packet, (P,).
        pose: x, y, yaw of base_link at the start of each packet and the end of the last one, (P + 1, 3).
        base_from_lidar: pose of the sensor on base_link, (4, 4).
        origins: result, (P · B, 3).
        directions: result, (P · B, 3).
    """
    mount = base_from_lidar.astype(np.float32)
    for p in range(azimuth_rad.shape[0]):
        c0, s0 = np.float32(math.cos(pose[p, 2])), np.float32(math.sin(pose[p, 2]))
        # A packet takes 1.3 ms, so the chord of the robot's arc is exact to a micrometre at 10 m.
        c1 = np.float32(math.cos(pose[p + 1, 2])) - c0
        s1 = np.float32(math.sin(pose[p + 1, 2])) - s0
        x0, y0 = np.float32(pose[p, 0]), np.float32(pose[p, 1])
        x1, y1 = np.float32(pose[p + 1, 0] - pose[p, 0]), np.float32(pose[p + 1, 1] - pose[p, 1])
        ca, sa = np.float32(math.cos(azimuth_rad[p])), np.float32(math.sin(azimuth_rad[p]))
        for j in range(beams.shape[0]):
            i = p * beams.shape[0] + j
            part = beams[j, 3]
            c, s = c0 + part * c1, s0 + part * s1
            bx = ca * beams[j, 0] + sa * beams[j, 1]
            by = ca * beams[j, 1] - sa * beams[j, 0]
            bz = beams[j, 2]
            x = mount[0, 0] * bx + mount[0, 1] * by + mount[0, 2] * bz
            y = mount[1, 0] * bx + mount[1, 1] * by + mount[1, 2] * bz
            directions[i, 0] = c * x - s * y
            directions[i, 1] = s * x + c * y
            directions[i, 2] = mount[2, 0] * bx + mount[2, 1] * by + mount[2, 2] * bz
            origins[i, 0] = x0 + part * x1 + c * mount[0, 3] - s * mount[1, 3]
            origins[i, 1] = y0 + part * y1 + s * mount[0, 3] + c * mount[1, 3]
            origins[i, 2] = mount[2, 3] + beams[j, 4]


@numba.njit(cache=True, nogil=True)
def _measure(
    range_m: F32,
    face: npt.NDArray[np.int32],
    directions: F32,
    noise_m: F32,
    limits_m: tuple[float, float],
    surfaces: tuple[npt.NDArray[np.int32], F32, F32],
    distance: npt.NDArray[np.uint16],
    reflectivity: npt.NDArray[np.uint8],
) -> None:
    """Write distance (N,), in units of 2 mm, and reflectivity (N,) of beams; both stay 0 without a return.

    Args:
        range_m: true ranges, (N,).
        face: faces that the beams hit, (N,).
        directions: unit directions of the beams, (N, 3).
        noise_m: noise of the ranges, (N,).
        limits_m: smallest and largest range that the sensor measures.
        surfaces: surface of each face (F,), and normals (S, 3) and reflectances (S,) of the surfaces.
        distance: result, (N,).
        reflectivity: result, (N,).
    """
    (min_m, max_m), (face_surface, normal, reflectance) = limits_m, surfaces
    for i in range(range_m.shape[0]):
        if range_m[i] < min_m or range_m[i] > max_m:
            continue
        s = face_surface[face[i]]
        units = (range_m[i] + noise_m[i]) / wire.DISTANCE_UNIT_M
        distance[i] = np.uint16(min(max(np.rint(units), 0.0), 65535.0))
        incidence = abs(
            normal[s, 0] * directions[i, 0] + normal[s, 1] * directions[i, 1] + normal[s, 2] * directions[i, 2]
        )
        reflectivity[i] = np.uint8(np.rint(reflectance[s] * (0.35 + 0.65 * incidence)))


class Vlp16:
    """Optics and clock of the scanner, which makes packets for intervals of simulated time.

    Args:
        pose_at: function that returns the pose of base_link at given times.
        epoch_ns: function that returns the epoch time of a simulated time, for the packets' time stamps.
        mount: pose of the sensor on base_link.
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
        self._reflectance = (
            100.0 * np.clip((world.textures.mean[world.texture] * world.tint).mean(axis=1), 0, 1)
        ).astype(np.float32)
        block = np.arange(wire.BLOCKS)[:, None, None] * wire.BLOCK_PERIOD_US
        firing = np.arange(wire.FIRINGS)[None, :, None] * wire.FIRING_PERIOD_US
        laser = np.arange(wire.LASERS)[None, None, :] * wire.LASER_PERIOD_US
        after_us = block + firing + laser
        # Azimuth is clockwise when viewed from above, 0 ahead (the sensor's x in ROS axes).
        turned = -np.radians(after_us * 1e-6 * RPM * 6.0)
        elevation = np.radians(wire.LASER_ELEVATION_DEG)
        #: Beams of a packet that begins at azimuth 0: direction in the sensor's frame, share of the packet's time, and
        #: height over the sensor's origin.
        beams = np.empty((wire.BLOCKS, wire.FIRINGS, wire.LASERS, 5), np.float32)
        beams[..., 0] = np.cos(elevation) * np.cos(turned)
        beams[..., 1] = np.cos(elevation) * np.sin(turned)
        beams[..., 2] = np.sin(elevation)
        beams[..., 3] = after_us / wire.PACKET_PERIOD_US
        beams[..., 4] = wire.LASER_VERTICAL_OFFSET_M
        self._beams = beams.reshape(-1, 5)

    @property
    def next_packet_end_s(self) -> float:
        """Time at which the last laser of the next packet fires."""
        return (self.packets + 1) * wire.PACKET_PERIOD_US * 1e-6

    def skip_to(self, time_s: float) -> int:
        """Skip the packets that begin before ``time_s`` and return their number."""
        target = math.ceil(time_s / (wire.PACKET_PERIOD_US * 1e-6))
        skipped = max(0, target - self.packets)
        self.packets += skipped
        return skipped

    def due(self, time_s: float) -> int:
        """Return the number of packets that are complete at ``time_s`` but not yet made."""
        return max(0, math.floor(time_s / (wire.PACKET_PERIOD_US * 1e-6)) - self.packets)

    def make(self, count: int) -> list[bytes]:
        """Make the next ``count`` data packets. The poses up to the end of the last packet must be known."""
        if count < 1:
            return []
        config, period_s = self.config, wire.PACKET_PERIOD_US * 1e-6
        times_s = np.asarray((self.packets + np.arange(count + 1)) * period_s, np.float64)
        self.packets += count
        azimuth_deg = times_s[:-1] * (RPM * 6.0) % 360.0
        size = count * len(self._beams)
        origins, directions = np.empty((size, 3), np.float32), np.empty((size, 3), np.float32)
        pose = np.asarray(self._pose_at(times_s), np.float64)
        _place_beams(
            self._beams,
            np.asarray(np.radians(azimuth_deg), np.float64),
            pose,
            self._base_from_lidar,
            origins,
            directions,
        )
        range_m, face = self._world.caster.cast(origins, directions)
        noise_m = np.float32(config.range_noise) * self._rng.standard_normal(size, np.float32)
        distance, reflectivity = np.zeros(size, np.uint16), np.zeros(size, np.uint8)
        _measure(
            range_m, face, directions, noise_m, (MIN_RANGE_M, config.max_range),
            (self._world.face_surface, self._world.normal, self._reflectance), distance, reflectivity,
        )  # fmt: skip

        out = np.zeros(count, wire.PACKET_DTYPE)
        blocks = out["blocks"]
        blocks["flag"] = wire.BLOCK_FLAG
        block_deg = azimuth_deg[:, None] + np.arange(wire.BLOCKS) * (wire.BLOCK_PERIOD_US * 1e-6 * RPM * 6.0)
        blocks["azimuth"] = np.rint(block_deg * 100.0).astype(np.int64) % 36000
        shape = (count, wire.BLOCKS, wire.FIRINGS, wire.LASERS)
        blocks["returns"]["distance"] = distance.reshape(shape)
        blocks["returns"]["reflectivity"] = reflectivity.reshape(shape)
        out["timestamp_us"] = [self._epoch_ns(second) // 1000 % wire.HOUR_US for second in times_s[:-1]]
        out["return_mode"] = wire.RETURN_STRONGEST
        out["product"] = wire.PRODUCT_VLP16
        data = out.tobytes()
        length = wire.DATA_PACKET_BYTES
        return [data[i * length : (i + 1) * length] for i in range(count)]

    def position_packet(self, time_s: float) -> bytes:
        """Make the position packet of a sensor whose clock is locked to GPS time."""
        now_ns = self._epoch_ns(time_s)
        moment = datetime.fromtimestamp(now_ns // 1_000_000_000, UTC)
        body = f"GPRMC,{moment:%H%M%S},A,0000.0000,N,00000.0000,E,000.0,000.0,{moment:%d%m%y},000.0,E"
        checksum = reduce(xor, body.encode("ascii"))
        return wire.encode_position_packet((now_ns // 1000) % wire.HOUR_US, 2, f"${body}*{checksum:02X}")


class Vlp16Server:
    """A sender of the scanner's packets over UDP as simulated time advances.

    Attributes:
        sent: number of data packets sent.
        skipped: number of data packets skipped because the machine was too slow.
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
        self._socket.close()

    def _send(self, payload: bytes, port: int) -> None:
        # Without a listener, the kernel reports the error of an earlier packet here. A real sensor ignores it.
        with contextlib.suppress(ConnectionRefusedError):
            self._socket.sendto(payload, (self._config.host, port))
