"""The LiDAR scaler against values worked out by hand and a room of known shape."""

import math

import numpy as np
import pytest

from instant_ic.depth.deskew import points_at
from instant_ic.depth.scaler import (
    DepthScaler,
    ScaleError,
    ScalerConfig,
    max_ratio_scale,
    median_ratio_scale,
    nearest_points,
    project_points,
    robust_line,
    solid_angle_quantile,
)
from instant_ic.geometry.poses import pose_matrix, transform_points
from instant_ic.geometry.projections import equirect_directions


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


def test_median_ratio_by_hand() -> None:
    depth = np.r_[np.full(21, 2.0), np.zeros(5)]
    ranges = np.r_[np.full(11, 3.0), np.full(10, 50.0), np.ones(5)]
    assert median_ratio_scale(depth, ranges) == pytest.approx(1.5)


def test_too_few_values_are_refused() -> None:
    with pytest.raises(ScaleError, match="only 19 usable values of range"):
        max_ratio_scale(np.ones(100), np.ones(19))
    with pytest.raises(ScaleError, match="only 0 usable values of depth"):
        max_ratio_scale(np.zeros(100), np.ones(100))


def test_projection_by_hand() -> None:
    # 8 x 4 pixels: forward lies between columns 3 and 4, left a quarter turn before, row 1.5 is the horizon.
    points = np.array([[2.0, 0, 0], [0, 3.0, 0], [0, -1.0, 0], [0, 0, 4.0]])
    u, v, range_m = project_points(points, 8, 4)
    np.testing.assert_allclose(u[:3], [3.5, 1.5, 5.5])
    np.testing.assert_allclose(v, [1.5, 1.5, 1.5, -0.5])
    np.testing.assert_allclose(range_m, [2, 3, 1, 4])


def test_nearest_point_of_a_pixel_wins() -> None:
    points = np.array([[5.0, 0.1, 0.1], [2.0, 0.04, 0.04], [0.0, -3.0, -0.1], [9.0, 0.1, 0.1]])
    rows, columns, range_m = nearest_points(points, 16, 8)
    found = {(int(r), int(c)): float(d) for r, c, d in zip(rows, columns, range_m, strict=True)}
    assert len(found) == 2
    assert min(found.values()) == pytest.approx(np.hypot(2.0, 0.04 * math.sqrt(2)), rel=1e-4)
    assert max(found.values()) == pytest.approx(np.linalg.norm([3.0, 0.1]))


def test_quantile_by_solid_angle() -> None:
    # Two rows at 60 degrees weigh cos 60 = 1/2 against those near the horizon; by hand for 3 rows (60, 0, -60):
    # weights 1/2, 1, 1/2 for depths 1, 2, 3: cumulated 1/4, 3/4, 1.
    depth = np.repeat([[1.0], [2.0], [3.0]], 12, axis=1)
    assert solid_angle_quantile(depth, 0.2) == 1.0
    assert solid_angle_quantile(depth, 0.5) == 2.0
    assert solid_angle_quantile(depth, 0.8) == 3.0


def test_robust_line_ignores_outliers() -> None:
    x = np.linspace(0, 10, 101)
    y = 2 * x + 1
    y[::7] = 100.0
    slope, offset = robust_line(x, y, iterations=100)
    assert slope == pytest.approx(2.0, abs=0.02)
    assert offset == pytest.approx(1.0, abs=0.1)


def test_depth_as_estimated_is_told_as_such_and_asks_no_points() -> None:
    depth = room_depth() * 3.0  # far from what the points say
    config = ScalerConfig(method="as_estimated", assumed_sigma=0.3)
    fit = DepthScaler(config).fit(depth, room_points(noise=0.0))
    assert (fit.ok, fit.scale, fit.points, fit.quality, fit.relative_sigma) == (True, 1.0, 0, 0.0, 0.3)
    np.testing.assert_array_equal(fit.depth_m, np.minimum(depth, 16.0).astype(np.float32))
    assert "LiDAR was not asked" in fit.message
    assert ScalerConfig().method != "as_estimated"
    assert not DepthScaler().fit(depth, np.zeros((0, 3))).ok
    with pytest.raises(ValueError, match="as_estimated needs output_kind metric"):
        ScalerConfig(method="as_estimated", output_kind="disparity")


@pytest.mark.parametrize("method", ["max_ratio", "median_ratio"])
@pytest.mark.parametrize("factor", [0.5, 1.7])
def test_room_gets_its_scale_back(method: str, factor: float) -> None:
    fit = DepthScaler(ScalerConfig(method=method)).fit(room_depth() / factor, room_points(noise=0.005))
    assert fit.ok
    assert fit.scale == pytest.approx(factor, rel=0.03)
    assert fit.quality > 0.97
    assert fit.relative_sigma < 0.04
    np.testing.assert_allclose(fit.depth_m, room_depth(), rtol=0.03)
    assert fit.depth_m.dtype == np.float32


def test_maximum_of_the_image_counts_what_the_lidar_cannot_see() -> None:
    depth = room_depth()
    depth[:16] = 50.0  # a high ceiling, far above the LiDAR's 15 degrees
    assert DepthScaler(ScalerConfig("max_ratio", "lidar")).fit(depth, room_points()).scale == pytest.approx(
        1.0, rel=0.03
    )
    assert DepthScaler(ScalerConfig("max_ratio", "image")).fit(depth, room_points()).scale < 0.2


def test_quality_is_the_share_within_fifteen_percent() -> None:
    points = room_points()
    far = points * np.where(np.arange(len(points)) % 4 == 0, 0.7, 1.0)[:, None]  # a quarter is nearer than depth says
    fit = DepthScaler(ScalerConfig(method="median_ratio")).fit(room_depth(256), far)
    assert fit.scale == pytest.approx(1.0, abs=0.01)
    # Where two points share a pixel the nearer, wrong one counts, so a little over a quarter disagrees.
    assert 0.60 < fit.quality < 0.76


def test_relative_depth_gets_scale_and_shift() -> None:
    truth = room_depth()
    fit = DepthScaler(ScalerConfig(output_kind="relative")).fit((truth - 0.5) / 4, room_points())
    assert fit.ok
    assert (fit.scale, fit.shift) == (pytest.approx(4.0, rel=0.03), pytest.approx(0.5, abs=0.08))


def test_disparity_becomes_metres() -> None:
    truth = room_depth()
    fit = DepthScaler(ScalerConfig(output_kind="disparity")).fit(3 / truth + 0.2, room_points())
    assert fit.ok
    # The LiDAR's band lacks the near floor and ceiling, so a line through it is a little off there.
    np.testing.assert_allclose(fit.depth_m, truth, rtol=0.05)


def test_inverted_relative_depth_is_refused() -> None:
    fit = DepthScaler(ScalerConfig(output_kind="relative")).fit(6 - room_depth().clip(max=5.9), room_points())
    assert not fit.ok
    assert "falls where the range grows" in fit.message


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
    noise = scaler.fit(rng.uniform(0.5, 8.0, depth.shape), points)
    assert not noise.ok
    assert "points agree" in noise.message

    assert "outside" in DepthScaler(ScalerConfig(max_scale=2.0)).fit(depth / 3, points).message


def test_unscaled_depth_of_other_kinds_is_unknown() -> None:
    fit = DepthScaler(ScalerConfig(output_kind="scale_invariant")).fit(room_depth(), np.empty((0, 3)))
    assert not fit.depth_m.any()


def test_points_that_are_not_finite_or_too_near_are_left_out() -> None:
    spoiled = np.vstack([room_points(), np.full((500, 3), np.nan), np.full((2000, 3), 0.1)])
    assert DepthScaler().fit(room_depth(), spoiled).scale == DepthScaler().fit(room_depth(), room_points()).scale


def test_shapes_and_configuration_are_checked() -> None:
    with pytest.raises(ValueError, match=r"points \(N, 3\)"):
        DepthScaler().fit(room_depth(), np.zeros((5, 4)))
    with pytest.raises(ValueError, match="method"):
        ScalerConfig(method="mean")
    with pytest.raises(ValueError, match="confidence"):
        ScalerConfig(confidence=99.5)


def test_deskew_undoes_motion() -> None:
    # The LiDAR drives along x at 1 m/s and turns at 0.5 rad/s; it measures fixed points, each at its own time.
    def camera_from_lidar(at_ns: int) -> np.ndarray:
        t = at_ns * 1e-9 - 100.0
        return pose_matrix(1.0 * t, 0.0, -0.6, yaw=0.5 * t)

    rng = np.random.default_rng(1)
    fixed = rng.uniform(-5, 5, (2000, 3))
    times = np.sort(rng.uniform(0, 0.1, 2000))
    seen = np.array(
        [
            transform_points(np.linalg.inv(camera_from_lidar(round((100 + t) * 1e9))), p[None])[0]
            for t, p in zip(times, fixed, strict=True)
        ]
    )
    moved = points_at(seen, times, 100_000_000_000, camera_from_lidar)
    assert np.abs(moved - fixed).max() < 0.02  # half a slice of 8 ms at 1 m/s and 0.5 rad/s over 8 m
    still = points_at(seen, np.zeros(2000), 100_000_000_000, camera_from_lidar)
    assert np.abs(still - fixed).max() > 0.1


def test_deskew_leaves_empty_and_broken_points_out() -> None:
    points = np.array([[np.nan, 0, 0], [1.0, 2.0, 3.0]])
    moved = points_at(points, np.zeros(2), 0, lambda _: np.eye(4))
    np.testing.assert_array_equal(moved, [[1.0, 2.0, 3.0]])
    assert points_at(np.empty((0, 3)), np.empty(0), 0, lambda _: np.eye(4)).shape == (0, 3)
