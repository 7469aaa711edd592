"""SLAM on the simulated crawler: a round trip on slipping tracks, with the scans and encoders of the simulator.

The robot of `instant_ic.sim` drives to waypoints and back, controlled by its true pose; its tracks lose a random share
of their motion. Scans are taken in the VLP-16's plane at 0°, 10 per second; odometry comes from the encoders alone.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from instant_ic.experiments.slam import LogResult, run_log, trajectory_errors
from instant_ic.experiments.slam_logs import LogEntry
from instant_ic.geometry.motion import along_arc
from instant_ic.geometry.poses import relative2, wrap_angle
from instant_ic.sim.robot import RobotConfig, TrackedRobot
from instant_ic.sim.world import World
from instant_ic.slam import Scan
from instant_ic.slam.scan import FloatArray

BEAMS = 720
RANGE_NOISE_M = 0.015
LIDAR_HEIGHT_M = 0.6
RANGE_MAX_M = 30.0
STEP_S = 0.02
SCAN_STEPS = 5
SPEED, TURN_SPEED = 0.5, 0.8

ROUTE = ((0.0, 0.0), (3.0, 0.7), (5.0, 0.7), (10.8, 0.0), (10.8, 8.5), (10.8, 0.0), (5.0, 0.7), (3.0, 0.7), (0.0, 0.0))
"""Along the simulator's corridor, past the obstacle, around the corner and back."""


@dataclass(frozen=True)
class RoundTrip:
    """A drive in the simulator: scans with odometry, true poses (n, 3) in the frame of the first pose, and metres."""

    entries: list[LogEntry]
    truth: FloatArray
    driven_m: float


def round_trip(
    world: World, slip: float = 0.2, seed: int = 0, rounds: int = 2, route: Sequence[tuple[float, float]] = ROUTE
) -> RoundTrip:
    """Drive ``route`` ``rounds`` times with tracks that lose a share ``slip`` (1σ, 0..0.5) of their motion.

    Raises:
        ValueError: the robot hit something.
    """
    config = RobotConfig(slip=slip, turn_slip=slip)
    start = (*route[0], math.atan2(route[1][1] - route[0][1], route[1][0] - route[0][0]))
    robot = TrackedRobot(config, world.occupied(), start, seed)
    kinematics = robot.kinematics
    rng = np.random.default_rng([37, seed])
    angles = np.asarray(-math.pi + 2 * math.pi / BEAMS * np.arange(BEAMS), dtype=np.float64)
    entries: list[LogEntry] = []
    truth: list[FloatArray] = []
    odometry = np.zeros(3)
    pulses = robot.encoder_pulses
    driven, steps = 0.0, 0
    targets = [point for _ in range(rounds) for point in route[1:]]
    while targets or steps % SCAN_STEPS:
        v, w = _steer(robot.pose, targets)
        if steps % SCAN_STEPS == 0:
            now = robot.encoder_pulses
            left, right = kinematics.tracks_from_motors(now - pulses)
            pulses = now
            forward, _, turn = kinematics.twist_from_tracks(np.array([left, right]))
            x, y, yaw = odometry.tolist()
            odometry = np.array(along_arc(x, y, yaw, forward, turn))
            entries.append(_entry(world, np.asarray(robot.pose, dtype=np.float64), angles, odometry, len(entries), rng))
            truth.append(np.asarray(robot.pose, dtype=np.float64).copy())
        robot.step(kinematics.motors_from_tracks(kinematics.tracks_from_twist(v, w)), STEP_S)
        if robot.contact:
            raise ValueError(f"the simulated robot hit an obstacle at {robot.pose[:2].round(2)}")
        driven += abs(float(robot.twist[0])) * STEP_S
        steps += 1
    origin = truth[0]
    return RoundTrip(entries, np.array([relative2(origin, pose) for pose in truth]), driven)


def _steer(pose: NDArray[np.floating], targets: list[tuple[float, float]]) -> tuple[float, float]:
    """Return speed and yaw rate to the first of ``targets``, and remove the targets already reached."""
    while targets and math.hypot(targets[0][0] - pose[0], targets[0][1] - pose[1]) < 0.15:
        targets.pop(0)
    if not targets:
        return 0.0, 0.0
    error = wrap_angle(math.atan2(targets[0][1] - pose[1], targets[0][0] - pose[0]) - float(pose[2]))
    return SPEED * max(0.0, 1.0 - abs(error) / 0.5), float(np.clip(2.0 * error, -TURN_SPEED, TURN_SPEED))


def _entry(
    world: World, pose: FloatArray, angles: FloatArray, odometry: FloatArray, index: int, rng: np.random.Generator
) -> LogEntry:
    directions = np.column_stack([np.cos(angles + pose[2]), np.sin(angles + pose[2]), np.zeros(BEAMS)])
    origin = np.array([pose[0], pose[1], LIDAR_HEIGHT_M], dtype=np.float32)
    hits, _ = world.caster.cast(origin, directions.astype(np.float32))
    ranges = hits.astype(np.float64) + RANGE_NOISE_M * rng.standard_normal(BEAMS)
    ranges[ranges > RANGE_MAX_M] = np.inf
    scan = Scan(ranges, float(angles[0]), 2 * math.pi / BEAMS, 0.3, RANGE_MAX_M, (index + 1) * 100_000_000)
    return LogEntry(scan, odometry, np.zeros(3))


def evaluate_round_trip(trip: RoundTrip, use_wheel_odom: bool = True) -> tuple[dict[str, object], LogResult]:
    """Run SLAM on the trip and compare with ground truth: figures for JSON, and the run itself."""
    result = run_log(trip.entries, use_wheel_odom=use_wheel_odom)
    final_m, final_deg = trajectory_errors(result.trajectory[:, 1:], trip.truth)
    online_m, online_deg = trajectory_errors(result.online[:, 1:], trip.truth)
    wheels = np.array([entry.odom_pose for entry in trip.entries])
    wheels_m, wheels_deg = trajectory_errors(wheels, trip.truth)
    return {
        "driven_m": trip.driven_m,
        "end_error_m": float(online_m[-1]),
        "end_error_deg": float(online_deg[-1]),
        "max_error_m": float(online_m.max()),
        "max_error_deg": float(online_deg.max()),
        "final_mean_error_m": float(final_m.mean()),
        "final_mean_error_deg": float(final_deg.mean()),
        "wheels_end_error_m": float(wheels_m[-1]),
        "wheels_end_error_deg": float(wheels_deg[-1]),
        "turn_factor": result.slam.turn_factor.value,
        **result.report(),
    }, result
