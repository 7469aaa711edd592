"""The local 3D model in rooms whose truth is known by hand."""

import numpy as np
import pytest

from instant_ic.depth.chain import DepthChain, DepthScalerConfig
from instant_ic.depth.inputs import HeldImage
from instant_ic.depth.lidar_depth import LidarDepthConfig
from instant_ic.depth.sources import DepthSource, SourceConfig
from instant_ic.geometry.ply import write_ply
from instant_ic.geometry.poses import Matrix, pose_matrix
from instant_ic.geometry.projections import equirect_directions
from instant_ic.geometry.transforms import TransformBuffer, TransformError
from instant_ic.lidar.deskew import TimedPoints
from instant_ic.mapping import kernels
from instant_ic.mapping.local_model import LocalModel, LocalModelConfig
from instant_ic.mapping.mapper import CloudError, LocalMapper, LocalView, MapperConfig

S = 1_000_000_000
SIZE = (128, 256)
# A corridor 2.4 m wide and 2.7 m high, from x = -3 to 9, and a box 4 m from the origin: 0.5 x 0.5 x 0.8 m.
ROOM = (np.array([-3.0, -1.2, 0.0]), np.array([9.0, 1.2, 2.7]))
BOX = (np.array([4.0, -0.25, 0.0]), np.array([4.5, 0.25, 0.8]))
OMEGA, AZIMUTH = np.meshgrid(np.radians(np.arange(-15, 16, 2.0)), np.radians(np.arange(0, 360, 0.4)))
RAYS = np.stack([np.cos(OMEGA) * np.cos(AZIMUTH), np.cos(OMEGA) * np.sin(AZIMUTH), np.sin(OMEGA)], -1).reshape(-1, 3)


def cast(origin: np.ndarray, rays: np.ndarray, boxes: tuple = ()) -> np.ndarray:
    """Distances (N,) along unit rays (N, 3) to the corridor or a box, by slabs."""
    with np.errstate(divide="ignore", invalid="ignore"):
        low, high = ((bound - origin) / rays for bound in ROOM)
        reach = np.where(rays > 0, high, np.where(rays < 0, low, np.inf)).min(axis=1)
        for box in boxes:
            a, b = ((bound - origin) / rays for bound in box)
            near, far = np.minimum(a, b).max(axis=1), np.maximum(a, b).min(axis=1)
            reach = np.where((near < far) & (near > 0), np.minimum(reach, near), reach)
    return reach


def measured(x: float, boxes: tuple = (), seed: int = 0) -> tuple[np.ndarray, np.ndarray]:
    """Points (N, 3) and origin of a revolution at (x, 0), with 1 cm noise."""
    origin = np.array([x, 0.0, 0.6])
    reach = cast(origin, RAYS, boxes) + np.random.default_rng(seed).normal(0, 0.01, len(RAYS))
    return origin + RAYS * reach[:, None], origin


def driven(start: float, end: float, boxes: tuple = (), model: LocalModel | None = None) -> LocalModel:
    model = model or LocalModel()
    for number, x in enumerate(np.arange(start, end + 1e-6, 0.1)):
        model.add(*measured(x, boxes, number), advance_m=0.1)
    return model


def truth(pose: Matrix, boxes: tuple = ()) -> np.ndarray:
    rays = equirect_directions(SIZE[1], SIZE[0]).reshape(-1, 3).astype(float) @ pose[:3, :3].T
    return cast(pose[:3, 3], rays, boxes).reshape(SIZE)


AT_3M = pose_matrix(3.0, 0.0, 1.2)


@pytest.fixture(scope="module")
def approach() -> LocalModel:
    return driven(0.0, 3.0, (BOX,))


def test_the_corridor_behind_a_box_is_known_from_the_approach(approach: LocalModel) -> None:
    """1 m before the box no beam passes over it by more than 7 cm; from 3 m on they have."""
    true, found = truth(AT_3M, (BOX,)), approach.render(AT_3M, SIZE)
    assert (found.depth_m > 0).mean() > 0.99
    error = np.abs(found.depth_m / true - 1)
    assert np.median(error) < 0.005 and np.quantile(error, 0.95) < 0.05
    rays = equirect_directions(SIZE[1], SIZE[0])
    over = (np.abs(np.arctan2(rays[..., 1], rays[..., 0])) < 0.2) & (np.abs(rays[..., 2]) < 0.15)
    assert (true[over] > 5).all() and np.quantile(error[over], 0.9) < 0.05  # the far wall and the floor before it
    row, column = SIZE[0] // 2 + round(0.6 * SIZE[0] / np.pi), SIZE[1] // 2  # 34 degrees down: the box's front
    assert found.depth_m[row, column] == pytest.approx(true[row, column], rel=0.03)
    assert true[row, column] < 1.3


def test_the_structure_of_one_revolution_puts_a_pillar_there(approach: LocalModel) -> None:
    """The same columns of the image without the model, and with it in the fused source."""
    true, points = truth(AT_3M, (BOX,)), measured(3.0, (BOX,), 30)[0] - AT_3M[:3, 3]
    source = DepthSource(SourceConfig(source="lidar", lidar=LidarDepthConfig(ceiling_height_m=2.7)))
    up, ahead = np.array([0.0, 0.0, 1.0]), slice(SIZE[1] // 2 - 8, SIZE[1] // 2 + 8)
    alone = source.estimate(None, points, up, 1.2, SIZE)
    with_model = source.estimate(None, points, up, 1.2, SIZE, LocalView(approach, AT_3M))
    off_alone, off = (np.abs(one.depth_m[:, ahead] / true[:, ahead] - 1).mean() for one in (alone, with_model))
    assert off < 0.5 * off_alone and off < 0.04
    assert with_model.ok and np.isfinite(with_model.sigma).all() and "ceiling 1.5" in with_model.message


def test_the_ceiling_is_measured_and_a_wall_is_none(approach: LocalModel) -> None:
    assert approach.ceiling_m(AT_3M[:3, 3]) == pytest.approx(2.7, abs=0.03)
    near = LocalModel()
    near.add(*measured(0.0))
    # From -3 to 9 m the highest ring meets the ceiling beyond 7.8 m only.
    assert near.ceiling_m(np.array([0.0, 0.0, 1.2])) in (None, pytest.approx(2.7, abs=0.03))


def test_a_thing_ends_half_way_between_its_highest_point_and_the_lowest_beam_above() -> None:
    model, origin = LocalModel(LocalModelConfig(behind_m=0.0)), np.array([0.0, 0.0, 0.6])
    y = np.arange(-0.5, 0.5, 0.02)
    on = np.stack(np.meshgrid([2.0], y, np.arange(0.02, 0.6, 0.02)), -1).reshape(-1, 3)  # measured up to 0.6 m
    above = np.stack(np.meshgrid([4.0], 2 * y, np.arange(1.4, 2.0, 0.02)), -1).reshape(-1, 3)  # over it at 1 m and more
    for _ in range(4):
        model.add(np.vstack([on, above]), origin, stride=1)
    pose = pose_matrix(0.0, 0.0, 1.2)
    depth = model.render(pose, (512, 1024)).depth_m[:, 512]
    elevation = np.pi / 2 - (np.arange(512) + 0.5) * np.pi / 512
    of_thing = np.abs(depth * np.cos(elevation) - 2.0) < 0.05
    assert 1.2 + 2.0 * np.tan(elevation[of_thing].max()) == pytest.approx(0.8, abs=0.06)  # a voxel is 0.05 m


def test_what_hangs_ends_at_its_highest_point() -> None:
    """A shelf measured from 0.5 to 0.6 m; beams pass below it at 0.3 to 0.4 m, and above it at 1 m and more."""
    model, origin = LocalModel(LocalModelConfig(behind_m=0.0)), np.array([0.0, 0.0, 0.6])
    y = np.arange(-0.5, 0.5, 0.02)
    on = np.stack(np.meshgrid([2.0], y, np.arange(0.5, 0.6, 0.02)), -1).reshape(-1, 3)
    behind = np.stack(np.meshgrid([4.0], 2 * y, [*np.arange(0.02, 0.2, 0.02), *np.arange(1.4, 2.0, 0.02)]), -1)
    for _ in range(4):
        model.add(np.vstack([on, behind.reshape(-1, 3)]), origin, stride=1)
    depth = model.render(pose_matrix(0.0, 0.0, 1.2), (512, 1024)).depth_m[:, 512]
    elevation = np.pi / 2 - (np.arange(512) + 0.5) * np.pi / 512
    of_thing = np.abs(depth * np.cos(elevation) - 2.0) < 0.05
    assert 1.2 + 2.0 * np.tan(elevation[of_thing].max()) == pytest.approx(0.6, abs=0.06)  # half way: 0.8


def test_a_side_is_as_high_as_the_rest_of_the_thing() -> None:
    """Right of y = 0 measured up to 0.9 m, left of it up to 0.6 m; beams pass at 1 m and more above both."""
    model, origin = LocalModel(LocalModelConfig(behind_m=0.0)), np.array([0.0, 0.0, 0.6])
    y = np.arange(-0.5, 0.5, 0.02)
    on = np.stack(np.meshgrid([2.0], y, np.arange(0.02, 0.9, 0.02)), -1).reshape(-1, 3)
    on = on[(on[:, 1] < 0) | (on[:, 2] < 0.6)]
    above = np.stack(np.meshgrid([4.0], 2 * y, np.arange(1.4, 2.0, 0.02)), -1).reshape(-1, 3)
    for _ in range(4):
        model.add(np.vstack([on, above]), origin, stride=1)
    depth = model.render(pose_matrix(0.0, 0.0, 1.2), (512, 1024)).depth_m[:, 496]  # y = 0.2 m
    elevation = np.pi / 2 - (np.arange(512) + 0.5) * np.pi / 512
    of_thing = np.abs(depth * np.cos(elevation) - 2.01) < 0.05
    assert 1.2 + 2.0 * np.tan(elevation[of_thing].max()) == pytest.approx(0.9, abs=0.06)  # a voxel is 0.05 m


def test_a_wall_goes_on_over_a_window_and_the_sill_before_it_does_not() -> None:
    """The left wall is glass from 0.9 m on, without returns; its sill reaches 0.14 m into the corridor.

    Beside the robot the uppermost ring ends on the sill.
    """
    sill = (np.array([-3.0, 1.06, 0.85]), np.array([9.0, 1.2, 0.9]))
    model = LocalModel()
    for number, x in enumerate(np.arange(0.0, 3.01, 0.1)):
        points, origin = measured(x, (sill,), number)
        glass = (points[:, 1] > 1.15) & (points[:, 2] > 0.9) & (points[:, 2] < 2.65)
        model.add(points[~glass], origin, advance_m=0.1)
    true, found = truth(AT_3M, (sill,)), model.render(AT_3M, SIZE, 2.7)
    rays = equirect_directions(SIZE[1], SIZE[0])
    at = AT_3M[:3, 3] + true[..., None] * rays
    pane = (at[..., 1] > 1.19) & (at[..., 2] > 0.95) & (at[..., 2] < 2.5) & (at[..., 0] > 2.5) & (at[..., 0] < 7.0)
    assert pane.sum() > 300 and (found.kind[pane] == kernels.PANE).mean() > 0.8
    assert np.quantile(np.abs(found.depth_m / true - 1)[pane], 0.9) < 0.03  # the sill's plane: 0.12


def test_a_beam_along_a_surface_frees_nothing_and_one_across_it_does() -> None:
    """A side at y = -0.485 m, 1 m long, in 20 columns of 5 cm; voxels are solid from odds of 3 on, 12 at most."""
    model, x = LocalModel(LocalModelConfig(behind_m=0.0)), np.arange(2.005, 3.0, 0.01)
    side = np.stack(np.meshgrid(x, [-0.485], np.arange(0.125, 0.9, 0.05)), -1).reshape(-1, 3)
    for _ in range(3):
        model.add(side, np.array([2.5, -3.0, 0.825]), stride=1)

    def solid() -> list[float]:
        points = model.points()
        ours = (np.abs(points - [2.5, -0.485, 0.825]) < [0.5, 0.01, 0.01]).all(axis=1)
        return sorted(points[ours][:, 0].round(3).tolist())

    assert len(solid()) == 20
    # One centimetre beside the surface, in its voxels all along it, as a pose that is off by a centimetre has it.
    model.add(np.tile([6.0, -0.475, 0.825], (50, 1)), np.array([0.0, -0.475, 0.825]), stride=1)
    assert len(solid()) == 20
    # Through it: ten beams take 20 of the odds of one column.
    model.add(np.tile([2.525, 1.0, 0.825], (10, 1)), np.array([2.525, -2.0, 0.825]), stride=1)
    assert len(solid()) == 19 and not np.isclose(solid(), 2.525).any()


def test_what_has_gone_vanishes() -> None:
    """Somebody stands 2 m ahead for a second, then leaves; the robot stands."""
    person = (np.array([2.0, -0.2, 0.0]), np.array([2.3, 0.2, 1.7]))
    model, pose = LocalModel(), pose_matrix(0.0, 0.0, 1.2)
    for seed in range(5):
        model.add(*measured(0.0, (person,), seed))
    level = SIZE[0] // 2, SIZE[1] // 2
    assert model.render(pose, SIZE).depth_m[level] == pytest.approx(2.0, rel=0.03)
    for seed in range(7):  # the mapper takes one a second at rest
        model.add(*measured(0.0, (), seed), stride=1)
    low = SIZE[0] // 2 + round(np.arctan2(0.6, 2.0) * SIZE[0] / np.pi), SIZE[1] // 2  # at the LiDAR's height
    assert model.render(pose, SIZE).depth_m[low] == pytest.approx(truth(pose)[low], rel=0.03)


def test_what_lies_far_back_is_forgotten_and_memory_stays() -> None:
    model = LocalModel(LocalModelConfig(keep_m=2.0))
    model.add(*measured(0.0, (BOX,)))
    sizes = {name: value.nbytes for name, value in vars(model).items() if isinstance(value, np.ndarray)}
    assert sum(sizes.values()) < 40e6 and len(model.points()) > 1000
    for _ in range(3):  # nothing new, but the robot has come 3 m
        model.add(np.empty((0, 3)), np.array([0.0, 0.0, 0.6]), advance_m=1.0)
    assert len(model.points()) == 0 and (model.render(AT_3M, SIZE).kind != kernels.MEASURED).all()
    for x in np.arange(0.0, 300.0, 5.0):  # the window wraps many times
        points, origin = measured(0.0)
        model.add(points + [x, 0, 0], origin + [x, 0, 0], advance_m=5.0)
    assert sizes == {name: value.nbytes for name, value in vars(model).items() if isinstance(value, np.ndarray)}
    assert np.abs(model.points()[:, 0] - 295.0).max() < 12.1


@pytest.mark.parametrize("factor", [np.nan, 1e30])
def test_wild_points_do_no_harm(factor: float) -> None:
    model = LocalModel()
    points, origin = measured(0.0)
    with np.errstate(invalid="ignore"):
        model.add(np.vstack([points, points[::7] * factor]), origin)
    found = model.render(pose_matrix(0.0, 0.0, 1.2), SIZE)
    assert np.isfinite(found.depth_m).all() and ((found.depth_m > 0) == np.isfinite(found.sigma)).all()


def buffer(map_from_odom: Matrix | None = None) -> TransformBuffer:
    """Robot that stands until second 1, then drives along x at 0.5 m/s."""
    transforms = TransformBuffer()
    transforms.set("base_link", "velodyne", 0, pose_matrix(0, 0, 0.6), static=True)
    transforms.set("base_link", "camera", 0, pose_matrix(0, 0, 1.2), static=True)
    for k in range(200):
        transforms.set("odom", "base_link", k * S // 20, pose_matrix(0.5 * max(k / 20 - 1, 0.0), 0, 0))
    if map_from_odom is not None:
        transforms.set("map", "odom", 0, map_from_odom)
    return transforms


def feed(mapper: LocalMapper, start: int, end: int) -> None:
    """Revolutions of 0.1 s, numbers ``start`` to ``end``."""
    for k in range(start, end):
        x = 0.5 * max(k / 10 + 0.05 - 1, 0.0)
        points, origin = measured(x, (), k)
        mapper.revolution(
            TimedPoints("velodyne", k * S // 10, np.linspace(0, 0.1, len(RAYS)), lambda p=points, o=origin: p - o)
        )


def test_revolutions_are_taken_by_distance_and_once_a_second_at_rest() -> None:
    mapper = LocalMapper(buffer(), MapperConfig(every_m=0.1, every_s=1.0))
    feed(mapper, 0, 11)  # one second at rest
    assert mapper.model.revolutions == 1
    feed(mapper, 11, 41)  # 1.5 m in three seconds
    assert 13 <= mapper.model.revolutions <= 17


def test_a_small_correction_is_followed_and_a_jump_is_not_seen() -> None:
    transforms = buffer(pose_matrix(1.0, 2.0, 0.0, yaw=0.3))
    mapper = LocalMapper(transforms)
    feed(mapper, 0, 41)
    before = mapper.model.render(mapper.model_from_camera("camera", 4 * S), SIZE).depth_m
    transforms.set("map", "odom", S, pose_matrix(1.05, 2.0, 0.0, yaw=0.3))  # 5 cm: odometry had drifted
    small = mapper.model_from_camera("camera", 4 * S)
    np.testing.assert_allclose(small[:3, 3], [1.05 + 1.5 * np.cos(0.3), 2.0 + 1.5 * np.sin(0.3), 1.2], atol=1e-6)
    transforms.set("map", "odom", 2 * S, pose_matrix(6.05, -3.0, 0.0, yaw=-1.0))  # a loop closure
    np.testing.assert_allclose(mapper.model_from_camera("camera", 4 * S), small, atol=1e-6)
    transforms.set("map", "odom", 3 * S, pose_matrix(6.0, -3.0, 0.0, yaw=-1.0))
    mapper.model_from_camera("camera", 4 * S)
    assert before[SIZE[0] // 2, SIZE[1] // 2] == pytest.approx(7.5, rel=0.02)
    # The cloud is in the map as it is now: the far wall lies 7.5 m ahead of the robot there.
    ahead = np.array([np.cos(-1.0), np.sin(-1.0)])
    robot = np.array([6.0, -3.0]) + 1.5 * ahead
    along = (mapper.cloud()[:, :2] - robot) @ ahead
    assert np.quantile(along, 0.999) == pytest.approx(7.5, abs=0.15)


def test_odometry_that_slips_in_a_turn_does_not_turn_the_model() -> None:
    transforms = TransformBuffer()
    transforms.set("base_link", "velodyne", 0, pose_matrix(0, 0, 0.6), static=True)
    transforms.set("base_link", "camera", 0, pose_matrix(0, 0, 1.2), static=True)
    mapper = LocalMapper(transforms, MapperConfig(every_s=0.1))
    points, origin = measured(0.0, (), 0)
    for k in range(31):  # 0.8 rad/s, of which odometry sees nine tenths; SLAM knows better ten times a second
        true, seen = 0.08 * k, 0.072 * k
        transforms.set("odom", "base_link", k * S // 10, pose_matrix(yaw=seen))
        transforms.set("map", "odom", k * S // 10, pose_matrix(yaw=true - seen))
        turned = (points - origin) @ pose_matrix(yaw=true)[:3, :3]
        mapper.revolution(TimedPoints("velodyne", k * S // 10, np.zeros(len(RAYS)), lambda p=turned: p))
    pose = mapper.model_from_camera("camera", 2 * S)  # an image one second old
    np.testing.assert_allclose(pose, pose_matrix(0, 0, 1.2, yaw=1.6), atol=1e-9)
    # The next revolution is 1.1 s newer than that image: its correction is another by 5 degrees, and nothing jumped.
    transforms.set("odom", "base_link", 31 * S // 10, pose_matrix(yaw=2.232))
    transforms.set("map", "odom", 31 * S // 10, pose_matrix(yaw=0.248))
    for k in (31, 32):
        mapper.revolution(TimedPoints("velodyne", k * S // 10, np.zeros(len(RAYS)), lambda p=points - origin: p))
    np.testing.assert_allclose(mapper.model_from_camera("camera", 2 * S), pose, atol=1e-9)
    depth = DepthChain(DepthScalerConfig(), transforms, lambda *args, **values: None)
    np.testing.assert_allclose(depth.map_from_camera(HeldImage("camera", 2 * S)), pose, atol=1e-9)
    with pytest.raises(TransformError):
        depth.map_from_camera(HeldImage("nowhere", 2 * S))


def test_bad_revolutions_are_refused_with_the_reason() -> None:
    mapper = LocalMapper(buffer())
    feed(mapper, 0, 11)
    times = np.linspace(0, 0.1, 100)
    with pytest.raises(CloudError, match="a revolution of 0 points"):
        mapper.revolution(TimedPoints("velodyne", 11 * S // 10, np.empty(0), lambda: np.empty((0, 3))))
    mapper.revolution(TimedPoints("laser2", 15 * S // 10, times, lambda: np.zeros((100, 3))))
    with pytest.raises(TransformError, match="no path from laser2 to odom"):
        mapper.revolution(TimedPoints("velodyne", 25 * S // 10, times, lambda: np.full((100, 3), np.nan)))
    with pytest.raises(CloudError, match="without a finite point"):
        mapper.revolution(TimedPoints("velodyne", 35 * S // 10, times, lambda: np.zeros((99, 3))))
    with pytest.raises(CloudError, match="99 points with 100 times"):
        mapper.revolution(TimedPoints("velodyne", 45 * S // 10, times, lambda: np.zeros((100, 3))))
    assert mapper.model.revolutions == 1
    with pytest.raises(CloudError, match="time went back"):
        mapper.revolution(TimedPoints("velodyne", S, times, lambda: np.zeros((100, 3))))
    assert mapper.model.revolutions == 0 and len(mapper.cloud()) == 0


def test_ply_by_hand(tmp_path) -> None:
    write_ply(tmp_path / "a.ply", np.array([[1.0, 2.0, 3.0]]))
    head, _, body = (tmp_path / "a.ply").read_bytes().partition(b"end_header\n")
    assert b"element vertex 1\n" in head and np.frombuffer(body, "<f4").tolist() == [1.0, 2.0, 3.0]
