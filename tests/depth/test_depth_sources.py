"""Depth from the LiDAR alone and fused with a network's, in a room whose truth is known by hand."""

from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra import numpy as npst

from instant_ic.depth.completion import prior_channels
from instant_ic.depth.fusion import ceiling_height, correct
from instant_ic.depth.lidar_depth import (
    LidarDepthConfig,
    LidarStructure,
    Origin,
    level_from_camera,
    lonely,
    plane_height,
)
from instant_ic.depth.manifest import InferenceError
from instant_ic.depth.sources import SOURCES, DepthResult, DepthSource, SourceConfig, complete, without_body
from instant_ic.depth.visibility import nearest_points
from instant_ic.geometry.projections import equirect_directions
from instant_ic.lidar.capture import CaptureReader
from instant_ic.lidar.stream import PacketStream

DATA = Path(__file__).resolve().parents[2].parent / "shared" / "data"

SIZE = (96, 192)
UP = np.array([0.0, 0.0, 1.0])
LEVEL = np.eye(3)
CAMERA_M, LIDAR_M = 1.2, 0.6
# A room around the camera (its frame): 4 m and 5 m along x, 3.4 m and 2.5 m along y, ceiling 1.4 m over the camera.
ROOM = (np.array([-4.0, -2.5, -CAMERA_M]), np.array([5.0, 3.4, 1.4]))
HALL = (np.array([-9.0, -8.0, -CAMERA_M]), np.array([12.0, 8.0, 1.4]))
# A cupboard that stands in the room, 2 to 2.6 m ahead, as high as 0.5 m under the camera.
CUPBOARD = (np.array([2.0, -0.6, -CAMERA_M]), np.array([2.6, 0.6, -0.5]))


def cast(origin: np.ndarray, rays: np.ndarray, room=ROOM, box=None) -> np.ndarray:
    """Distances (N,) from a point inside the room along unit rays (N, 3) to its walls or the box."""
    with np.errstate(divide="ignore", invalid="ignore"):
        to_low, to_high = ((bound - origin) / rays for bound in room)
        reach = np.where(rays > 0, to_high, np.where(rays < 0, to_low, np.inf)).min(axis=1)
        if box is not None:
            a, b = ((bound - origin) / rays for bound in box)
            near, far = np.minimum(a, b).max(axis=1), np.maximum(a, b).min(axis=1)
            reach = np.where((near < far) & (near > 0), np.minimum(reach, near), reach)
    return reach


def truth(room=ROOM, box=None, turn=LEVEL) -> np.ndarray:
    rays = equirect_directions(SIZE[1], SIZE[0]).reshape(-1, 3).astype(float) @ turn.T
    return cast(np.zeros(3), rays, room, box).reshape(SIZE)


def revolution(room=ROOM, box=None, noise_m=0.0) -> np.ndarray:
    """(N, 3) points in the camera's frame: 16 rings, 720 azimuths, the LiDAR 0.6 m under the camera."""
    omega, azimuth = np.meshgrid(np.radians(np.arange(-15, 16, 2.0)), np.radians(np.arange(0, 360, 0.5)))
    flat = np.cos(omega)
    rays = np.stack([flat * np.cos(azimuth), flat * np.sin(azimuth), np.sin(omega)], axis=-1).reshape(-1, 3)
    mount = np.array([0.0, 0.0, LIDAR_M - CAMERA_M])
    reach = cast(mount, rays, room, box)
    reach = reach + np.random.default_rng(0).normal(0, 1, len(reach)) * noise_m
    return mount + rays * reach[:, None]


def error(depth: np.ndarray, true: np.ndarray) -> np.ndarray:
    return np.abs(depth / true - 1)


STRUCTURE = LidarStructure(LidarDepthConfig(ceiling_height_m=2.6))
POINTS = revolution()


def test_box_room_from_points_alone() -> None:
    built = STRUCTURE.estimate(POINTS, UP, CAMERA_M, SIZE)
    assert built.message == "" and built.points == 16 * 720
    off = error(built.depth_m, truth())
    # A pixel is 1.9 degrees: where wall and floor meet it shows either.
    assert np.quantile(off, 0.99) < 0.03 and off.max() < 0.2
    assert (built.depth_m > 0).all() and np.isfinite(built.sigma).all()
    # Straight down the floor, straight up the ceiling, ahead the wall.
    assert built.depth_m[-1].mean() == pytest.approx(1.2, rel=1e-3) and (built.origin[-1] == Origin.FLOOR).all()
    assert built.depth_m[0].mean() == pytest.approx(1.4, rel=1e-3) and (built.origin[0] == Origin.ASSUMED).all()
    assert built.depth_m[SIZE[0] // 2, SIZE[1] // 2] == pytest.approx(5.0, rel=0.01)


def test_uncertainty_grows_away_from_the_points() -> None:
    built = STRUCTURE.estimate(POINTS, UP, CAMERA_M, SIZE)
    median = {each: float(np.median(built.sigma[built.origin == each])) for each in np.unique(built.origin)}
    assert median[Origin.BEAM] < median[Origin.UP] < median[Origin.ASSUMED]
    column = built.sigma[:, SIZE[1] // 2][built.origin[:, SIZE[1] // 2] == Origin.UP]
    assert (np.diff(column) <= 0).all()  # from the top of the wall down to the uppermost point


def test_floor_and_ceiling_are_found_where_the_rings_reach_them() -> None:
    built = LidarStructure().estimate(revolution(HALL, noise_m=0.02), UP, None, SIZE)
    assert built.camera_height_m == pytest.approx(1.2, abs=0.03)
    assert built.ceiling_height_m == pytest.approx(1.4, abs=0.03)
    assert np.quantile(error(built.depth_m, truth(HALL)), 0.95) < 0.06


def test_without_any_floor_it_is_as_low_as_the_lowest_points() -> None:
    small = (np.array([-1.5, -1.5, -CAMERA_M]), np.array([1.5, 1.5, 1.4]))  # no ring reaches floor or ceiling
    points = revolution(small)
    built = LidarStructure().estimate(points, UP, None, SIZE)
    lowest = 0.6 + 1.5 * np.sqrt(2) * np.tan(np.radians(15))  # in the corners
    assert built.camera_height_m is None and built.depth_m[-1].mean() == pytest.approx(lowest, rel=0.05)
    assert (built.origin[-1] == Origin.ASSUMED).all() and built.sigma[-1].min() > 0.1


@pytest.mark.real_data
def test_a_real_revolution_tells_the_ranges_that_it_was_not_shown() -> None:
    path = DATA / "vlp16" / "einride_recording.pcap"
    if not path.exists():
        pytest.skip(f"{path} is not there")
    stream = PacketStream()
    fed = (stream.feed(payload, stamp_ns) for stamp_ns, _, payload in CaptureReader(path))
    revolution = next(each for each in fed if each is not None and each.complete)
    points = revolution.xyz.astype(np.float64) - [0, 0, 0.6]
    # Every fourth sector of three degrees is kept back.
    kept_back = (np.degrees(np.arctan2(points[:, 1], points[:, 0])) // 3) % 4 == 0
    built = LidarStructure().estimate(points[~kept_back], UP, None)
    rows, columns, range_m = nearest_points(points[kept_back], 512, 256)
    depth, sigma = built.depth_m[rows, columns], built.sigma[rows, columns]
    off = np.abs(depth / range_m - 1)
    # A cluttered room; 0.011 (median) and 0.91 were measured.
    assert (depth > 0).mean() > 0.95 and np.median(off) < 0.03
    assert (off < 0.25).mean() > 0.85 and 0.5 < (off < sigma).mean() < 0.85


def test_a_cupboard_is_kept_as_seen_and_the_wall_over_it() -> None:
    built = STRUCTURE.estimate(revolution(box=CUPBOARD), UP, CAMERA_M, SIZE)
    true = truth(box=CUPBOARD)
    front = (true < 2.3) & (np.abs(np.arange(SIZE[1]) - SIZE[1] / 2) < 6)
    front &= np.abs(np.arange(SIZE[0])[:, None] - SIZE[0] * 0.64) < 4
    assert front.sum() > 20 and np.median(error(built.depth_m, true)[front]) < 0.02
    ahead = built.depth_m[: SIZE[0] // 2, SIZE[1] // 2]
    assert np.quantile(error(ahead, true[: SIZE[0] // 2, SIZE[1] // 2]), 0.9) < 0.03


def test_an_open_side_is_unknown_and_a_narrow_gap_is_bridged() -> None:
    azimuth = np.degrees(np.arctan2(POINTS[:, 1], POINTS[:, 0]))
    built = STRUCTURE.estimate(POINTS[np.abs(azimuth) > 30], UP, CAMERA_M, SIZE)
    middle = built.depth_m[:, SIZE[1] // 2]
    assert (middle[: SIZE[0] // 2] == 0).all() and not np.isfinite(built.sigma[0, SIZE[1] // 2])
    assert middle[-1] == pytest.approx(1.2, rel=1e-3)  # what the robot stands on
    bridged = STRUCTURE.estimate(POINTS[np.abs(azimuth) > 3], UP, CAMERA_M, SIZE)
    assert bridged.depth_m[SIZE[0] // 2, SIZE[1] // 2] == pytest.approx(5.0, rel=0.03)


def test_no_floor_begins_above_a_wall_of_unknown_height() -> None:
    """All walls are glass from 0.8 m on, 0.4 m under the camera, and give no return there."""
    built = STRUCTURE.estimate(POINTS[POINTS[:, 2] < -0.4], UP, CAMERA_M, SIZE)
    true, rays = truth(), equirect_directions(SIZE[1], SIZE[0])
    height = true * rays[..., 2]
    wall, glass = (height > -1.0) & (height < -0.5), (height > -0.3) & (rays[..., 2] < 0)
    assert (error(built.depth_m, true)[wall] < 0.05).mean() > 0.95
    # Where the uppermost ring ends on the wall, the wall goes on; nothing lies behind it.
    known = glass & (built.depth_m > 0)
    assert (built.depth_m[known] < 1.1 * true[known]).all() and (built.origin[glass] != Origin.FLOOR).all()


def test_what_is_not_to_be_trusted_says_why() -> None:
    assert "20 LiDAR points" in STRUCTURE.estimate(POINTS[:20], UP, CAMERA_M, SIZE).message
    azimuth = np.degrees(np.arctan2(POINTS[:, 1], POINTS[:, 0]))
    narrow = STRUCTURE.estimate(POINTS[np.abs(azimuth) < 30], UP, CAMERA_M, SIZE)
    assert "deg of azimuth; 90 are needed" in narrow.message
    low = STRUCTURE.estimate(POINTS, UP, 0.7, SIZE)
    assert "lie under the floor (0.70 m under the camera)" in low.message
    with pytest.raises(ValueError, match=r"points must be \(N, 3\)"):
        STRUCTURE.estimate(POINTS[:, :2], UP)
    with pytest.raises(ValueError, match="upside down"):
        STRUCTURE.estimate(POINTS, -UP)
    with pytest.raises(ValueError, match="three finite numbers"):
        STRUCTURE.estimate(POINTS, np.full(3, np.nan))
    with pytest.raises(ValueError, match="min_range_m must be below max_range_m"):
        LidarDepthConfig(min_range_m=3, max_range_m=2)


@settings(max_examples=25, deadline=None)
@given(
    npst.arrays(np.float64, (400, 3), elements=st.floats(-30, 30, width=32) | st.just(np.nan) | st.just(np.inf)),
    st.floats(0.3, 2.0) | st.none(),
)
def test_any_points_give_finite_depth_or_none(points: np.ndarray, height: float | None) -> None:
    built = LidarStructure().estimate(points, UP, height, (32, 64))
    assert np.isfinite(built.depth_m).all() and (built.depth_m >= 0).all()
    assert ((built.depth_m > 0) == np.isfinite(built.sigma)).all() and (built.sigma > 0).all()


@settings(max_examples=15, deadline=None)
@given(
    npst.arrays(np.float32, (34, 70), elements=st.floats(0, 20, width=32) | st.just(0.0)),
    st.integers(0, 2**32 - 1),
)
def test_any_network_is_fused_to_finite_depth(raw: np.ndarray, seed: int) -> None:
    """Whatever the network says, of any size: no NaN, nothing negative, an uncertainty wherever there is depth."""
    rng = np.random.default_rng(seed)
    points = POINTS[rng.random(len(POINTS)) < rng.uniform(0.05, 1)]
    found = DepthSource().estimate(raw, points, UP, CAMERA_M)
    assert found.depth_m.shape == raw.shape and np.isfinite(found.depth_m).all() and (found.depth_m >= 0).all()
    assert found.message and (found.sigma > 0).all()
    if found.ok:
        assert ((found.depth_m > 0) == np.isfinite(found.sigma)).all()


def test_level_from_camera_by_hand() -> None:
    np.testing.assert_allclose(level_from_camera(np.array([0, 0, 5.0])), np.eye(3), atol=1e-12)
    tilted = level_from_camera(np.array([np.sin(0.3), 0, np.cos(0.3)]))
    np.testing.assert_allclose(tilted @ [np.sin(0.3), 0, np.cos(0.3)], UP, atol=1e-12)
    np.testing.assert_allclose(tilted @ [0, 1, 0], [0, 1, 0], atol=1e-12)  # the smallest turn: about y alone


def test_plane_height_by_hand() -> None:
    # In each of 30 columns: two points on a table (0.7 m under the camera), one of the floor, wall points at 4 m.
    across = np.tile([1.0, 1.5, 3.0, 3.5, 4.0, 4.0, 4.0], 30)
    z = np.tile([-0.7, -0.7, -1.2, -1.2, -1.0, -0.5, 0.3], 30)
    columns = np.repeat(np.arange(30), 7)
    lower = z < -0.2
    assert plane_height(z[lower], across[lower], columns[lower]) == pytest.approx(-1.2)
    wall = across == 4.0
    assert plane_height(z[wall], across[wall], columns[wall]) is None


def test_lonely_points_by_hand() -> None:
    measured = np.zeros((20, 40))
    measured[10, :] = 3.0
    measured[10, 20] = 2.0
    rows, columns = np.nonzero(measured)
    assert np.flatnonzero(lonely(measured, rows, columns)).tolist() == [20]
    sparse = np.where(np.arange(40) % 8 == 0, measured, 0)  # nothing is near anything: nobody can tell
    rows, columns = np.nonzero(sparse)
    assert not lonely(sparse, rows, columns).any()


def test_ceiling_height_by_hand() -> None:
    rise = equirect_directions(64, 32)[..., 2]
    depth = np.where(rise > 0.3, 1.5 / np.maximum(rise, 0.1), 4.0)
    assert ceiling_height(depth, rise) == pytest.approx(1.5, rel=0.02)
    assert ceiling_height(np.zeros_like(depth), rise) is None
    assert ceiling_height(np.full_like(depth, 30.0), rise) is None  # the sky of a wrong network


def test_a_wall_that_the_network_sees_too_near_is_put_right() -> None:
    true = truth()
    azimuth = np.pi - (np.arange(SIZE[1]) + 0.5) * (2 * np.pi / SIZE[1])
    factor = np.where(np.abs(azimuth) < 0.6, 0.75, 1.0)
    measured = STRUCTURE.ranges(POINTS, SIZE)
    found = correct((true * factor).astype(np.float32), measured)
    middle = slice(SIZE[0] // 3, 2 * SIZE[0] // 3), np.abs(azimuth) < 0.35
    assert np.abs(found.depth_m[middle] / true[middle] - 1).max() < 0.06
    assert found.sigma < 0.05 and found.wrong.max() < 0.3
    assert (correct(np.zeros(SIZE, np.float32), measured).depth_m == 0).all()


def raw_of(true: np.ndarray) -> np.ndarray:
    """A network that is half a factor and smoothly wrong by up to 8 %."""
    wave = 1 + 0.08 * np.sin(np.linspace(0, 4 * np.pi, SIZE[1]))
    return (true / 2 * wave).astype(np.float32)


@pytest.mark.parametrize("source", SOURCES)
def test_each_source_in_the_room(source: str) -> None:
    config = SourceConfig(source=source, lidar=LidarDepthConfig(ceiling_height_m=2.6))
    raw = None if source == "lidar" else raw_of(truth())
    found = DepthSource(config).estimate(raw, POINTS, UP, CAMERA_M, size=SIZE)
    assert found.ok and found.source == source and found.depth_m.shape == SIZE
    assert found.depth_m.dtype == found.sigma.dtype == np.float32
    off = error(found.depth_m, truth())
    assert off.mean() < {"network": 0.06, "lidar": 0.02, "fused": 0.02, "completed": 0.02}[source]
    assert 0.9 < found.quality <= 1 and 0 < found.relative_sigma < 0.1 and found.points > 3000
    if source in ("network", "fused"):
        assert found.scale == pytest.approx(2, rel=0.08)


def test_fused_takes_from_the_network_what_the_lidar_cannot_know() -> None:
    """A high ceiling, and a side without any return."""
    tall = (ROOM[0], np.array([5.0, 3.4, 2.9]))
    points = revolution(tall)
    azimuth = np.degrees(np.arctan2(points[:, 1], points[:, 0]))
    found = DepthSource().estimate(raw_of(truth(tall)), points[np.abs(azimuth) > 30], UP, CAMERA_M)
    off = error(found.depth_m, truth(tall))
    assert found.ok and off[:5].max() < 0.08  # the ceiling straight up
    assert off[SIZE[0] // 2 - 5 : SIZE[0] // 2 + 5, SIZE[1] // 2].max() < 0.2
    ahead, aside = found.sigma[SIZE[0] // 2, SIZE[1] // 2], found.sigma[SIZE[0] // 2, SIZE[1] // 4]
    assert ahead > 2 * aside  # where only the network knows


@pytest.mark.parametrize("source", ["fused", "lidar"])
def test_unfit_with_the_reason(source: str) -> None:
    config = SourceConfig(source=source)
    raw = raw_of(truth())
    few = DepthSource(config).estimate(raw, POINTS[:100], UP, CAMERA_M)
    assert not few.ok and few.message.count("100 LiDAR points") == 1
    low = DepthSource(config).estimate(raw, POINTS, UP, 0.7)
    assert not low.ok and "under the floor" in low.message
    none = DepthSource(config).refuse(raw if source == "fused" else None, "no LiDAR", SIZE)
    assert not none.ok and none.message == "no LiDAR" and none.depth_m.shape == SIZE


def test_another_places_picture_is_not_fused() -> None:
    """Half of the points agree with one scale, half with another: picture and LiDAR do not belong together."""
    true = truth()
    raw = np.where(np.arange(SIZE[1]) < SIZE[1] // 2, true, true / 2.4).astype(np.float32)
    found = DepthSource().estimate(raw, POINTS, UP, CAMERA_M)
    assert not found.ok and "two scales fit" in found.message
    # What is told besides is the LiDAR's.
    assert np.median(error(found.depth_m, true)) < 0.02


def test_the_robot_under_the_camera_becomes_floor() -> None:
    result = DepthSource(SourceConfig(source="network")).estimate(raw_of(truth()), POINTS, UP, CAMERA_M)
    rise = equirect_directions(SIZE[1], SIZE[0])[..., 2]
    body = rise < np.sin(np.radians(-60))
    masked = without_body(result, UP, CAMERA_M, -60.0)
    np.testing.assert_allclose(masked.depth_m[body], truth()[body], rtol=1e-4)
    assert (masked.depth_m[~body] == result.depth_m[~body]).all()
    unknown = without_body(result, UP, None, -60.0)
    assert (unknown.depth_m[body] == 0).all() and np.isinf(unknown.sigma[body]).all()
    assert without_body(result, UP, CAMERA_M, -90.0) is result


def test_a_wrong_network_makes_nothing_worse_than_the_lidar_alone() -> None:
    """A network that is smoothly wrong by a third overrides nothing that was measured or follows from it."""
    waves = np.random.default_rng(0).uniform(0, 2 * np.pi, 3)
    azimuth, row = np.linspace(0, 2 * np.pi, SIZE[1], endpoint=False), np.linspace(0, np.pi, SIZE[0])[:, None]
    wrong = 0.35 * np.sin(2 * azimuth + waves[0]) * np.sin(2 * row + waves[1]) + 0.15 * np.sin(5 * azimuth + waves[2])
    points = revolution(HALL, noise_m=0.02)  # rings reach floor and ceiling
    true = truth(HALL)
    alone = DepthSource(SourceConfig(source="lidar")).estimate(None, points, UP, CAMERA_M, SIZE)
    fused = DepthSource().estimate((true * np.exp(wrong)).astype(np.float32), points, UP, CAMERA_M)
    known = alone.depth_m > 0
    assert known.mean() > 0.99
    np.testing.assert_array_equal(fused.depth_m[known], alone.depth_m[known])


def with_prior(points=POINTS, room=ROOM) -> DepthResult:
    return DepthSource(SourceConfig(source="completed")).estimate(raw_of(truth(room)), points, UP, CAMERA_M)


def test_prior_by_hand() -> None:
    """Elevations of 4 rows: 67.5, 22.5, -22.5 and -67.5 degrees; a floor 1.2 m below."""
    depth, sigma = np.full((4, 8), 2.0), np.full((4, 8), 0.1)
    depth[0], sigma[0] = 0.0, np.inf
    ranges_m = np.zeros((4, 8))
    ranges_m[2, :3] = 2.05, 2.07, 2.0  # agrees within 2 cm and 2 %: 6.1 cm; not; agrees
    depth[3, 0] = 50.0  # too far to count
    network = np.full((4, 8), 3.0)
    network[1] = 41.0  # too far to count
    prior = prior_channels(depth, sigma, ranges_m, UP, CAMERA_M, network)
    assert prior.shape == (6, 4, 8) and prior.dtype == np.float32
    np.testing.assert_array_equal(prior[0, :, 0], [0.0, 2.0, 2.0, 0.0])
    np.testing.assert_allclose(prior[1, :, 0], [0.0, 0.1, 0.1, 0.0])
    assert prior[2].sum() == 2 and prior[2, 2, 0] == prior[2, 2, 2] == 1
    np.testing.assert_allclose(prior[3, :, 0], np.sin(np.radians([67.5, 22.5, -22.5, -67.5])), rtol=1e-6)
    np.testing.assert_allclose(prior[4, :, 0], [0.0, 0.0, 1.2 / 0.38268, 1.2 / 0.92388], rtol=1e-4)
    np.testing.assert_array_equal(prior[5, :, 0], [3.0, 0.0, 3.0, 3.0])
    assert not prior_channels(depth, sigma, ranges_m, UP, None, network)[4].any()


def test_where_a_completion_is_taken() -> None:
    result = with_prior()
    assert result.prior is not None
    result.prior.measured[:], result.prior.free_m[:] = False, 0
    result.sigma[:] = 0.1
    old = result.depth_m.copy()
    found, doubt = old.copy(), np.full(SIZE, 0.2)
    rows = slice(40, 48)
    wide, slight, narrow, measured, robot, passed, unknown, unsure = (slice(at, at + 8) for at in range(10, 170, 20))
    narrow = slice(narrow.start, narrow.start + 6)
    found[rows, wide] *= 1.2
    found[rows, slight] *= 1.08
    found[rows, narrow] *= 1.5
    found[rows, measured] *= 1.5
    found[rows, robot] *= 1.5
    found[rows, passed] *= 0.5
    found[rows, unknown] = np.nan
    found[rows, unsure] *= 1.5
    found[rows, -4:] *= 1.5  # over the seam
    found[rows, :4] *= 1.5
    doubt[rows, unsure] = np.nan
    result.prior.measured[rows, measured] = True
    result.prior.robot[rows, robot] = True
    result.prior.free_m[rows, passed] = 1.5 * old[rows, passed]
    got = complete(result, lambda channels: (found, doubt))
    change = np.ones(SIZE)
    change[rows, wide], change[rows, passed], change[rows, -4:], change[rows, :4] = 1.2, 1.5, 1.5, 1.5
    np.testing.assert_allclose(got.depth_m, change * old, rtol=1e-5)
    np.testing.assert_allclose(got.sigma, np.where(change == 1, 0.1, 0.2), rtol=1e-6)
    assert got.prior is None and got.message.endswith("completed") and got.source == "completed"


@pytest.mark.parametrize("error", [InferenceError("out of memory"), ValueError("no panorama")])
def test_failed_completion_leaves_the_fused_depth(error: Exception) -> None:
    def fails(channels):
        raise error

    before = with_prior()
    found = complete(before, fails)
    np.testing.assert_array_equal(found.depth_m, before.depth_m)
    assert found.ok and str(error) in found.message and found.prior is None
    small = complete(before, lambda channels: (np.ones((8, 16)), np.ones((8, 16))))
    assert "the completion is (8, 16), the depth (96, 192)" in small.message
