"""Simulated calibration recordings, made in this process, with known camera pose."""

from __future__ import annotations

import math
from pathlib import Path
from typing import Any

import numpy as np
from scipy.spatial.transform import Rotation

from instant_ic.bag import BagWriter
from instant_ic.bus import LATCHED, SENSOR, QoS
from instant_ic.geometry.poses import Matrix, inverse, pose_matrix
from instant_ic.lidar.stream import PacketStream
from instant_ic.msg import TFMessage, cloud_message, compressed_image_message, serialize, transform_message, type_name
from instant_ic.sim.simulation import Simulation, SimulationConfig

START_NS = 1_760_000_000_000_000_000
BASE_FROM_LIDAR = pose_matrix(z=0.6)
BASE_FROM_CAMERA = pose_matrix(z=1.2)
_STEP_S = 0.02
_TURN_S = 0.15
"""Longer than one revolution plus the rest of the previous one."""


def perturbed(pose: Matrix, distance_m: float, angle_deg: float, seed: int) -> Matrix:
    """Pose (4, 4) shifted by a distance and rotated by an angle about its own centre, both in random directions."""
    rng = np.random.default_rng([53, seed])
    shift, axis = (vector / np.linalg.norm(vector) for vector in rng.normal(size=(2, 3)))
    change = np.eye(4)
    change[:3, :3] = Rotation.from_rotvec(math.radians(angle_deg) * axis).as_matrix()
    change[:3, 3] = distance_m * shift
    return np.asarray(pose @ change)


def record(
    path: Path,
    base_from_camera: Matrix,
    world: str = "corridor",
    images: int = 20,
    size: tuple[int, int] = (1024, 512),
    period_s: float = 0.8,
    twist: tuple[float, float] = (0.2, 0.5),
    start: tuple[float, ...] = (),
) -> Matrix:
    """Drive an arc in a simulated world and write a bag with images, revolutions, odometry and mounts.

    The mounts in the bag are the default ones, whatever the camera's true pose. Odometry is the true pose at 30 Hz.
    Only the LiDAR revolutions around each image are written. Images and revolutions have different stamps, and each ray
    has its own.

    Args:
        path: folder of the bag.
        base_from_camera: (4, 4), true pose of the camera.
        world: as for ``make_world``.
        images: number of images.
        size: width and height of an image.
        period_s: time between images.
        twist: m/s and rad/s; (0, 0) stands still.
        start: x, y, yaw of the robot; empty: the world's own.

    Returns:
        The true ``camera_from_lidar`` (4, 4).
    """
    import cv2

    simulation = Simulation(SimulationConfig(world=world, start=start), start_ns=START_NS)
    with BagWriter(path, compressed=True) as bag:

        def write(topic: str, message: Any, stamp_ns: int, qos: QoS = SENSOR) -> None:
            bag.write(topic, type_name(message), bytes(serialize(message)), stamp_ns, qos)

        mounts = (("velodyne", BASE_FROM_LIDAR), ("camera", BASE_FROM_CAMERA))
        static = [transform_message(pose, "base_link", frame, START_NS) for frame, pose in mounts]
        write("/tf_static", TFMessage(transforms=static), START_NS, LATCHED)
        simulation.drive(*twist)
        next_s, taken, scan_until_s = 0.5, 0, 0.0
        stream: PacketStream | None = None
        while taken < images or simulation.time_s < scan_until_s:
            simulation.step(_STEP_S)
            now_s, now_ns = simulation.time_s, simulation.epoch_ns(simulation.time_s)
            pose = transform_message(simulation.world_from_base(), "odom", "base_link", now_ns)
            write("/tf", TFMessage(transforms=[pose]), now_ns)
            if stream is None and now_s > next_s - _TURN_S:
                simulation.scanner.skip_to(now_s - _TURN_S)
                stream, scan_until_s = PacketStream(), next_s + 0.1
            if taken < images and now_s >= next_s:
                frame = simulation.renderer.render(simulation.world_from_base() @ base_from_camera, *size)
                _, jpeg = cv2.imencode(".jpg", frame.rgb[..., ::-1], [cv2.IMWRITE_JPEG_QUALITY, 92])
                write("/camera/image/compressed", compressed_image_message(jpeg.tobytes(), "camera", now_ns), now_ns)
                taken, next_s = taken + 1, next_s + period_s
            if stream is None:
                continue
            first_s = simulation.scanner.next_packet_end_s
            for number, packet in enumerate(simulation.scan_packets()):
                stamp = simulation.epoch_ns(first_s + number * 1.327104e-3)
                revolution = stream.feed(packet, stamp)
                if revolution is not None and revolution.complete:
                    write("/lidar/points", cloud_message(revolution.points, "velodyne", revolution.stamp_ns), now_ns)
            stream = None if now_s >= scan_until_s else stream
    return inverse(base_from_camera) @ BASE_FROM_LIDAR
