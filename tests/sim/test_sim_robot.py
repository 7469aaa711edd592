"""Dynamics by hand, contact, determinism."""

import math

import numpy as np
import pytest

from instant_ic.sim.robot import RobotConfig, TrackedRobot
from instant_ic.sim.simulation import Simulation, SimulationConfig
from instant_ic.sim.vlp16 import Vlp16Config
from instant_ic.sim.world import World

EXACT = RobotConfig(slip=0.0, turn_slip=0.0, encoder_noise_pulses=0.0)


def robot_in(world: World, config: RobotConfig = EXACT, seed: int = 0) -> TrackedRobot:
    return TrackedRobot(config, world.occupied(0.03, 0.9, 0.01), (0.0, 0.0, 0.0), seed)


def drive(robot: TrackedRobot, left: float, right: float, seconds: float, dt: float = 0.01) -> None:
    pulses = robot.kinematics.motors_from_tracks([left, right])
    for _ in range(round(seconds / dt)):
        robot.step(pulses, dt)


def test_without_slip_the_encoders_tell_the_distance(box_room: World) -> None:
    robot = robot_in(box_room)
    drive(robot, 0.4, 0.4, 4.0)
    assert robot.pose[1:] == pytest.approx([0, 0])
    assert robot.encoder_pulses == pytest.approx([4000 * robot.pose[0]] * 2)
    assert robot.motor_speed_pps == pytest.approx([1600, 1600], abs=0.1)
    # 2 m/s² up to where the lag takes over: between the jump (1.6 m) and 0.2 + 0.06 s of it lost.
    assert 1.6 - 0.4 * (0.2 + 0.06) < robot.pose[0] < 1.6


def test_tracks_obey_the_acceleration_limit(box_room: World) -> None:
    robot = robot_in(box_room)
    speeds = [0.0]
    for _ in range(50):
        robot.step(robot.kinematics.motors_from_tracks([0.5, 0.5]), 0.01)
        speeds.append(float(robot.tracks[0]))
    assert np.diff(speeds).max() <= 2.0 * 0.01 + 1e-12


def test_turning_on_the_spot_follows_the_effective_width(box_room: World) -> None:
    robot = robot_in(box_room)
    drive(robot, -0.15, 0.15, 6.0)
    # 0.4 m tracks, multiplier 1.5: yaw rate 0.3 / 0.6 = 0.5 rad/s.
    assert robot.twist == pytest.approx([0, 0, 0.5], abs=1e-4)
    assert robot.pose[:2] == pytest.approx([0, 0], abs=1e-9)
    travelled = (robot.encoder_pulses[1] - robot.encoder_pulses[0]) / 4000
    assert robot.pose[2] == pytest.approx(travelled / 0.6)


def test_slip_loses_some_of_the_motion_by_seed(box_room: World) -> None:
    slipping = RobotConfig(slip=0.05, turn_slip=0.1)
    poses = []
    for seed in (1, 1, 2):
        robot = robot_in(box_room, slipping, seed)
        drive(robot, 0.3, 0.35, 3.0)
        poses.append(robot.pose)
    assert np.array_equal(poses[0], poses[1]) and not np.allclose(poses[0], poses[2], atol=1e-4)
    exact = robot_in(box_room)
    drive(exact, 0.3, 0.35, 3.0)
    assert 1e-3 < np.hypot(*(poses[0] - exact.pose)[:2]) < 0.15


def test_the_robot_stops_where_it_touches_and_can_back_off(box_room: World) -> None:
    robot = robot_in(box_room)
    drive(robot, 0.5, 0.5, 8.0)
    # The wall is at x = 3, the front 0.3 m ahead of base_link; cells are 1 cm.
    assert 2.68 < robot.pose[0] <= 2.70
    assert robot.contact and robot.contacts == 1
    assert robot.tracks == pytest.approx([0.5, 0.5], abs=1e-3), "the tracks go on under a robot that is held"
    drive(robot, -0.3, -0.3, 1.0)
    assert not robot.contact and robot.pose[0] < 2.6
    drive(robot, 0.5, 0.5, 3.0)
    assert robot.contacts == 2


def test_corners_touch_when_turning(box_room: World) -> None:
    # Half the diagonal is hypot(0.3, 0.25) = 0.39 m: 0.28 m from the wall the robot fits sideways, not aslant.
    robot = TrackedRobot(EXACT, box_room.occupied(0.03, 0.9, 0.01), (0.0, 1.72, 0.0), 0)
    drive(robot, -0.15, 0.15, 5.0)
    assert robot.contact
    # Highest point of the footprint: 0.3 sin(yaw) + 0.25 cos(yaw) = 0.28 gives yaw = 0.104.
    assert robot.pose[2] == pytest.approx(0.104, abs=0.05)


def test_no_start_inside_a_wall(box_room: World) -> None:
    with pytest.raises(ValueError, match="collides with the world"):
        TrackedRobot(EXACT, box_room.occupied(0.03, 0.9, 0.01), (2.9, 0.0, 0.0))


def test_the_watchdog_of_the_controller_stops_the_robot(corridor: World) -> None:
    simulation = Simulation(SimulationConfig(robot=EXACT), world=corridor)
    simulation.controller.timeout_s = 0.5
    simulation.drive(0.4, 0.0)
    simulation.step(3.0)
    # 0.5 s at up to 0.4 m/s, then it rolls out.
    assert 0.1 < simulation.robot.pose[0] < 0.3
    assert simulation.robot.tracks == pytest.approx([0, 0], abs=1e-6)
    assert simulation.controller.encoder == pytest.approx([4000 * simulation.robot.pose[0]] * 2)


def test_two_simulations_of_one_seed_are_the_same_bit_for_bit(corridor: World) -> None:
    def run(seed: int) -> tuple[np.ndarray, bytes]:
        config = SimulationConfig(seed=seed, lidar=Vlp16Config(range_noise=0.02))
        simulation = Simulation(config, start_ns=1_700_000_000_000_000_000, world=corridor)
        simulation.drive(0.3, 0.2)
        packets = b""
        for _ in range(20):
            simulation.step(0.02)
            packets += b"".join(simulation.scan_packets())
        return simulation.robot.pose, packets

    (pose, packets), (same_pose, same), (_, other) = run(3), run(3), run(4)
    assert np.array_equal(pose, same_pose) and packets == same
    assert packets != other and len(packets) == len(other)


def test_poses_between_steps_are_interpolated(corridor: World) -> None:
    simulation = Simulation(SimulationConfig(robot=EXACT), world=corridor)
    simulation.drive(0.4, 0.0)
    simulation.step(1.0)
    simulation.step(0.1)
    middle = simulation.poses_at([1.05])[0]
    assert middle[0] == pytest.approx(simulation.robot.pose[0] - 0.4 * 0.05, abs=1e-4)
    assert simulation.world_from_base()[0, 3] == simulation.robot.pose[0]
    assert math.isclose(simulation.world_from_base(1.05)[0, 3], middle[0])


def test_negative_time_is_refused(corridor: World) -> None:
    with pytest.raises(ValueError, match="dt_s"):
        Simulation(SimulationConfig(), world=corridor).step(-0.1)
    with pytest.raises(ValueError, match="start"):
        SimulationConfig(start=(1.0, 2.0))
