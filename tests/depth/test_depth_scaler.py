"""The LiDAR scaler against values worked out by hand and a room of known shape."""

import math

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from instant_ic.depth.scale_rules import (
    ScaleError,
    consensus_scale,
    max_ratio_scale,
    sector_factors,
)
from instant_ic.depth.scaler import DepthScaler, ScalerConfig
from instant_ic.depth.visibility import hidden, on_depth_edge, pixels_of
from instant_ic.geometry.poses import pose_matrix
from instant_ic.geometry.projections import equirect_directions
from instant_ic.geometry.transforms import TransformBuffer
from instant_ic.lidar.deskew import points_at


def box_range(directions: np.ndarray, low: tuple[float, ...], high: tuple[float, ...]) -> np.ndarray:
    """Range from the origin to the walls of a box around it."""
    with np.errstate(divide="ignore"):
        reach = np.where(directions > 0, np.asarray(high) / directions, np.asarray(low) / directions)
    reach[directions == 0] = np.inf
    return reach.min(axis=-1)


ROOM = ((-3.0, -2.0, -1.2), (5.0, 2.5, 1.4))  # around the camera


def room_depth(height: int = 64) -> np.ndarray:
    return box_range(equirect_directions(2 * height, height).astype(np.float64), *ROOM).astype(np.float32)


def room_points(noise: float = 0.0, seed: int = 0) -> np.ndarray:
    """16 rings of points as a LiDAR at the camera's place would measure them."""
    azimuth = np.radians(np.arange(0, 360, 0.5))
    elevation = np.radians(np.arange(-15, 16, 2.0))
    e, a = np.meshgrid(elevation, azimuth, indexing="ij")
    directions = np.stack([np.cos(e) * np.cos(a), np.cos(e) * np.sin(a), np.sin(e)], axis=-1).reshape(-1, 3)
    ranges = box_range(directions, *ROOM)
    ranges = ranges * (1 + noise * np.random.default_rng(seed).standard_normal(len(ranges)))
    return directions * ranges[:, None]


def test_max_ratio_by_hand() -> None:
    depth = np.arange(1.0, 201.0)  # 99.5 % quantile: 1 + 0.995 * 199 = 199.005
    ranges = np.append(np.arange(1.0, 401.0) / 2, [np.inf, np.nan, 0.0])  # 0.5 * (1 + 0.995 * 399) = 199.0025
    assert max_ratio_scale(depth, ranges) == pytest.approx(199.0025 / 199.005)
    assert max_ratio_scale(2 * depth, ranges, confidence=1.0) == pytest.approx(200 / 400)


def test_projection_by_hand() -> None:
    # 8 x 4 pixels: forward lies between columns 3 and 4, left a quarter turn before, row 1.5 is the horizon.
    points = np.array([[2.0, 0, 0], [0, 3.0, 0], [0, -1.0, 0], [0, 0, 4.0]])
    rows, columns, range_m = pixels_of(points, 8, 4)
    assert columns[:3].tolist() == [4, 2, 6] and rows.tolist() == [2, 2, 2, 0]
    np.testing.assert_allclose(range_m, [2, 3, 1, 4])


def test_depth_as_estimated_is_told_as_such_and_asks_no_points() -> None:
    depth = room_depth() * 3.0  # far from what the points say
    config = ScalerConfig(method="as_estimated", assumed_sigma=0.3)
    fit = DepthScaler(config).fit(depth, room_points(noise=0.0))
    assert (fit.ok, fit.scale, fit.points, fit.quality, fit.relative_sigma) == (True, 1.0, 0, 0.0, 0.3)
    np.testing.assert_array_equal(fit.depth_m, np.minimum(depth, 16.0).astype(np.float32))
    assert "not compared with the LiDAR" in fit.message
    assert ScalerConfig().method != "as_estimated"
    assert not DepthScaler().fit(depth, np.zeros((0, 3))).ok
    with pytest.raises(ValueError, match="as_estimated needs output_kind metric"):
        ScalerConfig(method="as_estimated", output_kind="scale_invariant")


@pytest.mark.parametrize("method", ["max_ratio", "ransac", "sector"])
def test_room_gets_its_scale_back(method: str) -> None:
    factor = 1.7
    fit = DepthScaler(ScalerConfig(method=method)).fit(room_depth() / factor, room_points(noise=0.005))
    assert fit.ok
    assert fit.scale == pytest.approx(factor, rel=0.03)
    assert fit.quality > 0.97
    assert fit.relative_sigma < 0.04
    np.testing.assert_allclose(fit.depth_m, room_depth(), rtol=0.03)
    assert fit.depth_m.dtype == np.float32


def test_consensus_is_the_scale_of_the_largest_crowd() -> None:
    # By hand: 40 pairs of ratio 2, 30 of 3, 30 of 9. The median is 3; most agree on 2, and 3 is its next rival.
    ratio = np.repeat([2.0, 3.0, 9.0], [40, 30, 30])
    found = consensus_scale(np.full(100, 0.5), 0.5 * ratio, tolerance=0.1)
    assert (found.scale, found.share) == (pytest.approx(2.0), pytest.approx(0.4))
    assert found.rival_scale in (pytest.approx(3.0), pytest.approx(9.0))
    assert found.rival_share == pytest.approx(0.3)
    assert consensus_scale(np.ones(50), np.full(50, 4.0)).rival_share == 0
    with pytest.raises(ScaleError, match="only 3 usable values of pairs"):
        consensus_scale(np.ones(3), np.ones(3))


def test_sector_factors_by_hand() -> None:
    # Four sectors of 90 degrees. The one around 45 degrees has 10 points of log ratio 0.2, trusted half: 0.1; the
    # others have none: 0. Kernel exp(-0.5 (k / 0.5)^2) for k = 0, 1, 2, 1: 1, e^-2, e^-8, e^-2, over their sum.
    azimuth = np.radians(np.linspace(30, 60, 10))
    centres, factors = sector_factors(azimuth, np.full(10, 0.2), 90.0, trust_points=10.0)
    np.testing.assert_allclose(np.degrees(centres), [-135, -45, 45, 135])
    total = 1 + 2 * math.exp(-2) + math.exp(-8)
    np.testing.assert_allclose(factors, 0.1 * np.exp([-8.0, -2.0, 0.0, -2.0]) / total)


def test_sectors_straighten_a_room_whose_left_is_estimated_too_near() -> None:
    truth = room_depth(128)
    azimuth = np.pi - (np.arange(256) + 0.5) * (2 * np.pi / 256)
    bent = truth / (1 + 0.12 * np.sin(azimuth)).astype(np.float32)
    near_horizon = slice(50, 78)  # the rows that the LiDAR sees
    one = DepthScaler(ScalerConfig(method="ransac")).fit(bent, room_points(noise=0.003))
    many = DepthScaler(ScalerConfig(method="sector")).fit(bent, room_points(noise=0.003))
    assert np.abs(one.depth_m / truth - 1)[near_horizon].max() > 0.1
    assert np.abs(many.depth_m / truth - 1)[near_horizon].max() < 0.03
    factor = many.depth_m / (many.scale * bent)
    np.testing.assert_allclose(factor[[0, -1]], 1.0, atol=0.005)  # one value at the poles
    assert many.quality >= one.quality
    # Where the LiDAR sees nothing the scale of the rest stays: no points on the left half.
    right = room_points()[room_points()[:, 1] < 0]
    half = DepthScaler(ScalerConfig(method="sector")).fit(truth, right)
    np.testing.assert_allclose(half.depth_m / (half.scale * truth), 1.0, atol=0.02)


def spoilt(points: np.ndarray, share: float) -> np.ndarray:
    """A share of the points at ranges that have nothing to do with the room."""
    rng = np.random.default_rng(4)
    wrong = rng.random(len(points)) < share
    factor = rng.uniform(0.3, 15.0, len(points)) / np.linalg.norm(points, axis=1)
    return points * np.where(wrong, factor, 1.0)[:, None]


def through_glass(low_deg: float, high_deg: float, factor: float = 2.5) -> np.ndarray:
    """The LiDAR sees through a pane between two azimuths, and half of its rays do not come back from there."""
    points = room_points(0.005)
    azimuth = np.degrees(np.arctan2(points[:, 1], points[:, 0]))
    pane = (azimuth > low_deg) & (azimuth < high_deg)
    points = points * np.where(pane, factor, 1.0)[:, None]
    return points[~pane | (np.arange(len(points)) % 2 == 0)]


def test_a_wall_of_glass_does_not_move_the_consensus_and_is_told() -> None:
    depth, points = room_depth(128), through_glass(-70, 70)
    for method in ("ransac", "sector"):
        fit = DepthScaler(ScalerConfig(method=method)).fit(depth, points)
        assert fit.ok
        assert fit.scale == pytest.approx(1.0, rel=0.01)
        assert "far behind the depth" in fit.message
        np.testing.assert_allclose(fit.depth_m, depth, rtol=0.02)


def test_two_scales_that_fit_as_well_are_not_trusted() -> None:
    points = room_points(0.002)
    half = points * np.where(points[:, 1] > 0, 1.8, 1.0)[:, None]  # a mirror along one side
    fit = DepthScaler(ScalerConfig(max_range_m=30.0)).fit(room_depth(128), half)
    assert not fit.ok
    assert fit.message.startswith("two scales fit")


def test_points_that_the_camera_does_not_see_are_found() -> None:
    # A table top 1 m ahead between elevations -45 and -35 degrees, seen in two rings 3 degrees apart, and the floor 2 m
    # away that the LiDAR sees beneath it: one point of the floor between the rings, one beside the table.
    def at(elevation_deg: float, azimuth_deg: float, range_m: float) -> list[float]:
        e, a = math.radians(elevation_deg), math.radians(azimuth_deg)
        return [range_m * math.cos(e) * math.cos(a), range_m * math.cos(e) * math.sin(a), range_m * math.sin(e)]

    top = [at(e, a, 1.0) for e in (-41.6, -38.4) for a in np.arange(-10, 10, 0.3)]
    cloud = np.array([*top, at(-40.0, 0.1, 2.0), at(-40.0, 30.0, 2.0)])
    found = hidden(cloud)
    assert not found[: len(top)].any()
    np.testing.assert_array_equal(found[-2:], [True, False])
    # One nearer point alone is an outlier, not something that hides.
    assert not hidden(np.array([at(0, 0, 5.0), at(0, 0.2, 1.0)])).any()
    assert hidden(np.empty((0, 3))).shape == (0,)


def test_points_on_edges_of_the_depth_are_found() -> None:
    depth = np.full((4, 8), 2.0)
    depth[:, 0] = 3.0  # its neighbours are columns 1 and, around the seam, 7
    depth[2, 4] = 0.0  # unknown is no edge
    columns = np.arange(8)
    np.testing.assert_array_equal(on_depth_edge(depth, np.full(8, 2), columns), np.isin(columns, (7, 0, 1)))


def test_reasons_of_a_fit_that_is_not_ok() -> None:
    scaler, depth, points = DepthScaler(), room_depth(), room_points()
    none = scaler.fit(depth, np.empty((0, 3)))
    assert (none.ok, none.scale, none.quality) == (False, 1.0, 0.0)
    assert "0 LiDAR points between" in none.message
    np.testing.assert_array_equal(none.depth_m, depth)

    narrow = points[(points[:, 0] > 0) & (np.abs(points[:, 1]) < 0.2 * points[:, 0])]
    assert "deg of azimuth" in scaler.fit(depth, narrow).message

    blind = scaler.fit(np.zeros_like(depth), points)
    assert "fall on known depth" in blind.message

    rng = np.random.default_rng(0)
    blocks = np.kron(rng.uniform(0.5, 8.0, (8, 16)), np.ones((8, 8)))
    assert not scaler.fit(blocks, points).ok
    noise = DepthScaler(ScalerConfig(min_quality=0.6)).fit(blocks, points)
    assert not noise.ok
    assert "points agree" in noise.message

    assert "outside" in DepthScaler(ScalerConfig(max_scale=2.0)).fit(depth / 3, points).message


def test_points_of_a_moving_robot_land_on_the_walls_of_the_pictures_moment() -> None:
    # Both sensors are tilted and beside the centre; the robot drives an arc of 0.5 m/s and 1 rad/s. Each ray is cast at
    # its own moment from the closed-form pose (scipy's rotations, no code of ours); odometry comes at 30 Hz, as from
    # the base. After the compensation every point must lie on a wall, seen from the camera's true pose 120 ms later.
    start_ns, picture_ns = 5_000_000_000, 5_220_000_000

    def world_from(mount: np.ndarray, rpy_deg: list[float], t: np.ndarray) -> tuple[Rotation, np.ndarray]:
        yaw, base = t, np.stack([0.5 * np.sin(t), 0.5 * (1 - np.cos(t)), 0 * t], axis=-1)
        turn = Rotation.from_rotvec(yaw[..., None] * np.array([0.0, 0.0, 1.0]))
        return turn * Rotation.from_euler("xyz", rpy_deg, degrees=True), base + turn.apply(mount)

    lidar, lidar_rpy = np.array([0.1, -0.05, 0.6]), [1.0, -2.0, 15.0]
    camera, camera_rpy = np.array([-0.08, 0.02, 1.2]), [-1.5, 0.5, -4.0]
    times = np.linspace(0.0, 0.1, 3600)
    azimuth, elevation = -2 * np.pi * times / 0.1, np.radians(np.arange(3600) % 16 * 2.0 - 15)
    local = np.stack(
        [np.cos(elevation) * np.cos(azimuth), np.cos(elevation) * np.sin(azimuth), np.sin(elevation)], axis=-1
    )
    turn, origin = world_from(lidar, lidar_rpy, times + start_ns * 1e-9)
    walls = (np.array([-3.0, -2.0, 0.0]), np.array([5.0, 2.5, 2.6]))
    rays = turn.apply(local)
    ranges = np.where(rays > 0, (walls[1] - origin) / rays, (walls[0] - origin) / rays).min(axis=1)

    buffer = TransformBuffer()
    for frame, xyz, rpy in (("velodyne", lidar, lidar_rpy), ("camera", camera, camera_rpy)):
        buffer.set("base_link", frame, 0, pose_matrix(*xyz, *np.radians(rpy)), static=True)
    for stamp in range(4_900_000_000, 5_400_000_000, 33_333_333):
        t = stamp * 1e-9
        buffer.set("odom", "base_link", stamp, pose_matrix(0.5 * math.sin(t), 0.5 * (1 - math.cos(t)), yaw=t))
    camera_from_odom = buffer.lookup("camera", "odom", picture_ns)
    moved = points_at(
        local * ranges[:, None], times, start_ns, lambda at: camera_from_odom @ buffer.lookup("odom", "velodyne", at)
    )

    turn, origin = world_from(camera, camera_rpy, np.array(picture_ns * 1e-9))
    in_world = turn.apply(moved) + origin
    off = np.minimum(np.abs(in_world - walls[0]), np.abs(in_world - walls[1])).min(axis=1)
    assert off.max() < 0.002
    # Without the compensation the same points miss the walls: the test sees what it is about.
    still = turn.apply(points_at(local * ranges[:, None], 0 * times, start_ns, lambda at: camera_from_odom
                                 @ buffer.lookup("odom", "velodyne", picture_ns))) + origin  # fmt: skip
    assert np.minimum(np.abs(still - walls[0]), np.abs(still - walls[1])).min(axis=1).max() > 0.2
