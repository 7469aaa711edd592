"""The depth nodes in lockstep: a robot in a box-shaped room."""

from pathlib import Path

import cv2
import numpy as np
import pytest
import torch

from instant_ic.bus import NodeError
from instant_ic.bus.lockstep import LockstepBus
from instant_ic.depth.export import export_model
from instant_ic.depth.keyframes import KeyframeConfig, KeyframeSelector
from instant_ic.depth.scaler import ScalerConfig
from instant_ic.depth.slicenet import SliceNet, SliceNetConfig
from instant_ic.geometry.poses import inverse, pose_matrix, transform_points
from instant_ic.geometry.projections import equirect_directions
from instant_ic.msg import (
    POINT_DTYPE,
    TFMessage,
    cloud_message,
    compressed_image_message,
    image_array,
    image_message,
    stamp_ns,
    transform_message,
)
from instant_ic.msg import (
    pose_matrix as message_pose,
)
from instant_ic.nodes.depth_estimator import DepthEstimatorConfig, DepthEstimatorNode
from instant_ic.nodes.depth_scaler import DepthScalerConfig, DepthScalerNode

S = 1_000_000_000
START = 1_700_000_000 * S
LOW, HIGH = np.array([-3.0, -2.0, 0.0]), np.array([5.0, 2.5, 2.6])  # the room in the map
BASE_FROM_CAMERA, BASE_FROM_LIDAR = pose_matrix(0, 0, 1.2), pose_matrix(0, 0, 0.6)
MAP_FROM_ODOM = pose_matrix(0.2, -0.1, 0.0, yaw=0.1)


def base_at(stamp: int) -> np.ndarray:
    """map_from_base: along x at 0.4 m/s, turning at 0.3 rad/s."""
    t = (stamp - START) / S
    return pose_matrix(0.4 * t, 0.1, 0.0, yaw=0.3 * t)


def ranges(origin: np.ndarray, directions: np.ndarray) -> np.ndarray:
    """Ranges (N,) from points (N, 3) along directions (N, 3) to the walls of the room."""
    with np.errstate(divide="ignore", invalid="ignore"):
        reach = np.where(directions > 0, (HIGH - origin) / directions, (LOW - origin) / directions)
    reach[directions == 0] = np.inf
    return reach.min(axis=-1)


def room_depth(map_from_camera: np.ndarray, height: int = 64) -> np.ndarray:
    directions = equirect_directions(2 * height, height).reshape(-1, 3) @ map_from_camera[:3, :3].T
    return ranges(map_from_camera[:3, 3], directions).reshape(height, 2 * height).astype(np.float32)


def revolution(start: int) -> np.ndarray:
    """A cloud as the moving LiDAR measures it: every point at its own time."""
    cloud = np.zeros(720 * 16, POINT_DTYPE)
    for column in range(720):
        time_s = column / 7200
        map_from_lidar = base_at(start + round(time_s * S)) @ BASE_FROM_LIDAR
        elevation = np.radians(np.arange(-15, 16, 2.0))
        azimuth = -2 * np.pi * column / 720
        local = np.stack(
            [np.cos(elevation) * np.cos(azimuth), np.cos(elevation) * np.sin(azimuth), np.sin(elevation)], axis=-1
        )
        reach = ranges(map_from_lidar[:3, 3], local @ map_from_lidar[:3, :3].T)
        part = cloud[column * 16 : (column + 1) * 16]
        part["x"], part["y"], part["z"] = (local * reach[:, None]).T
        part["time"] = time_s
    return cloud


def jpeg(seed: int, height: int = 64) -> bytes:
    noise = np.random.default_rng(seed).integers(0, 256, (height // 8, height // 4, 3), np.uint8)
    ok, data = cv2.imencode(".jpg", cv2.resize(noise, (2 * height, height)))
    assert ok
    return data.tobytes()


@pytest.fixture(scope="module")
def model_file(tmp_path_factory: pytest.TempPathFactory) -> Path:
    torch.manual_seed(0)
    config = SliceNetConfig(
        backbone="resnet18", height=64, width_multiplier=0.125, lstm_hidden=8, column_stride=2, decoder_floor=8
    )
    path = tmp_path_factory.mktemp("model") / "tiny.onnx"
    export_model(SliceNet(config), path, "tiny", "Apache-2.0", 16.0)
    return path


def publish_tf(bus: LockstepBus, stamp: int) -> None:
    odom_from_base = inverse(MAP_FROM_ODOM) @ base_at(stamp)
    bus.publish(
        "/tf",
        TFMessage(
            [
                transform_message(odom_from_base, "odom", "base_link", stamp),
                transform_message(MAP_FROM_ODOM, "map", "odom", stamp),
            ]
        ),
        stamp_ns=stamp,
    )


def drive(
    bus: LockstepBus, seconds: float, begin: int = START, factor: float = 2.0, lidar: bool = True, tf: bool = True
) -> None:
    """Publishes tf at 50 Hz, the LiDAR at 10 Hz, picture and its depth (in other units) at 2 Hz, 80 ms late."""
    static = [
        transform_message(BASE_FROM_CAMERA, "base_link", "camera", begin),
        transform_message(BASE_FROM_LIDAR, "base_link", "velodyne", begin),
    ]
    bus.publish("/tf_static", TFMessage(static), stamp_ns=begin, latched=True)
    for tick in range(round(seconds * 50) + 1):
        now = begin + tick * S // 50
        if tf:
            publish_tf(bus, now)
        if lidar and tick % 5 == 0 and tick >= 5:
            start = now - S // 10
            bus.publish("/lidar/points", cloud_message(revolution(start), "velodyne", start), stamp_ns=now)
        if tick % 25 == 10:
            bus.publish("/camera/image/compressed", compressed_image_message(jpeg(tick), "camera", now), stamp_ns=now)
        if tick % 25 == 14:
            stamp = now - 4 * S // 50
            depth = room_depth(base_at(stamp) @ BASE_FROM_CAMERA) / factor
            bus.publish("/depth/raw", image_message(depth.astype(np.float32), "32FC1", "camera", stamp), stamp_ns=now)


def level(node: DepthScalerNode | DepthEstimatorNode, name: str) -> tuple[int, str]:
    found = node.diagnoses()[name]
    return found[0], found[1]


def test_scaler_scales_and_makes_keyframes() -> None:
    with LockstepBus(START) as bus:
        node = bus.add(DepthScalerNode)
        drive(bus, 4.0)
        scaled, keyframes = bus.messages("/depth/scaled"), bus.messages("/keyframe")
        assert level(node, "scale")[0] == 0
    assert len(scaled) == 8
    for message in scaled:
        stamp = stamp_ns(message)
        truth = room_depth(base_at(stamp) @ BASE_FROM_CAMERA)
        # The rule compares 99.5 % quantiles of two samplings of the room; the factor 2 comes back within 3 %.
        np.testing.assert_allclose(image_array(message), truth, rtol=0.03)
        assert message.header.frame_id == "camera"
    # 0.4 m/s and 0.3 rad/s: 0.6 m every 1.5 s, 45 degrees only after 2.6 s. Pictures come every 0.5 s from 0.2 s.
    assert [(stamp_ns(k) - START) / S for k in keyframes] == [0.2, 1.7, 3.2]
    assert [k.id for k in keyframes] == [1, 2, 3]
    for k in keyframes:
        assert k.header.frame_id == "map" and k.fit and k.quality > 0.95
        assert k.scale == pytest.approx(2.0, rel=0.03)
        assert 0 < k.relative_sigma < 0.05
        np.testing.assert_allclose(message_pose(k.pose), base_at(stamp_ns(k)) @ BASE_FROM_CAMERA, atol=2e-3)
        assert bytes(k.panorama.data) == jpeg(round((stamp_ns(k) - START) / S * 50))
        np.testing.assert_allclose(image_array(k.depth), room_depth(base_at(stamp_ns(k)) @ BASE_FROM_CAMERA), rtol=0.03)


def test_motion_is_compensated() -> None:
    with LockstepBus(START) as bus:
        node = bus.add(DepthScalerNode)
        drive(bus, 1.0)
        stamp = START + S // 5
        points = node.points_in_camera("camera", stamp)
    assert points is not None
    in_map = transform_points(base_at(stamp) @ BASE_FROM_CAMERA, points)
    # Every point lies on a wall, floor or ceiling of the room again.
    to_wall = np.minimum(np.abs(in_map - LOW), np.abs(in_map - HIGH)).min(axis=1)
    assert np.quantile(to_wall, 0.99) < 0.01


def test_two_runs_are_the_same_bits(model_file: Path) -> None:
    def run() -> list[bytes]:
        with LockstepBus(START) as bus:
            bus.add(DepthEstimatorNode, DepthEstimatorConfig(model=str(model_file), threads=2))
            bus.add(DepthScalerNode, DepthScalerConfig(scaler=ScalerConfig(min_quality=0.0, max_scale=1e6)))
            drive(bus, 1.5)
            topics = ("/depth/raw", "/depth/scaled", "/keyframe")
            return [record.payload for topic in topics for record in bus.records(topic)]

    first = run()
    assert len(first) > 6
    assert first == run()


def test_no_lidar_is_told_and_no_keyframe_at_once() -> None:
    with LockstepBus(START) as bus:
        node = bus.add(DepthScalerNode)
        drive(bus, 1.0, lidar=False)
        assert bus.messages("/depth/scaled") == [] and bus.messages("/keyframe") == []
        assert level(node, "scale") == (1, "no LiDAR revolution within 0.3 s")


def test_depth_as_estimated_makes_keyframes_that_say_so() -> None:
    with LockstepBus(START) as bus:
        node = bus.add(DepthScalerNode, DepthScalerConfig(scaler=ScalerConfig(method="as_estimated")))
        drive(bus, 1.0, lidar=False)
        scaled, (keyframe,) = bus.messages("/depth/scaled"), bus.messages("/keyframe")
        assert level(node, "scale")[0] == 0
    truth = room_depth(base_at(START + S // 5) @ BASE_FROM_CAMERA)
    np.testing.assert_allclose(image_array(scaled[0]), truth / 2, rtol=1e-5)  # as it came, a factor of 2 too near
    assert keyframe.fit and keyframe.scale == 1.0 and keyframe.quality == 0.0
    assert keyframe.relative_sigma == pytest.approx(0.2)
    assert "LiDAR was not asked" in keyframe.message


def test_unfit_keyframe_goes_out_marked_after_waiting_and_a_fit_one_replaces_it() -> None:
    config = DepthScalerConfig(keyframes=KeyframeConfig(unfit_after_s=1.0))
    with LockstepBus(START) as bus:
        bus.add(DepthScalerNode, config)
        drive(bus, 1.5, lidar=False)
        (unfit,) = bus.messages("/keyframe")
        assert not unfit.fit and unfit.quality == 0.0 and unfit.scale == 1.0
        assert "no LiDAR revolution" in unfit.message
        assert stamp_ns(unfit) == START + 12 * S // 10  # due at 0.2 s, waited for 1 s
        drive(bus, 0.5, begin=START + 2 * S)
        assert [k.fit for k in bus.messages("/keyframe")] == [False, True]


def test_without_poses_nothing_is_made_up() -> None:
    with LockstepBus(START) as bus:
        node = bus.add(DepthScalerNode)
        drive(bus, 1.0, tf=False)
        assert bus.messages("/depth/scaled") == [] and bus.messages("/keyframe") == []
        assert "no path from odom to camera" in level(node, "scale")[1]
        assert "no pose" in level(node, "keyframe")[1]


def test_depth_without_its_picture_makes_no_keyframe() -> None:
    with LockstepBus(START) as bus:
        node = bus.add(DepthScalerNode)
        drive(bus, 0.25)
        stamp = START + S // 10  # a time with tf and LiDAR, but no picture
        depth = room_depth(base_at(stamp) @ BASE_FROM_CAMERA)
        bus.publish("/depth/raw", image_message(depth, "32FC1", "camera", stamp), stamp_ns=START + S // 4)
        assert len(bus.messages("/depth/scaled")) == 1
        assert bus.messages("/keyframe") == []
        assert "did not arrive" in level(node, "keyframe")[1]


def test_estimator_keeps_stamp_frame_and_rate(model_file: Path) -> None:
    with LockstepBus(START) as bus:
        node = bus.add(DepthEstimatorNode, DepthEstimatorConfig(model=str(model_file), max_rate_hz=2.0))
        stamps = [START + i * S // 10 for i in range(21)]
        for index, stamp in enumerate(stamps):
            message = compressed_image_message(jpeg(index, 128), "camera", stamp)
            bus.publish("/camera/image/compressed", message, stamp_ns=stamp + S // 20)
        depths = bus.messages("/depth/raw")
        assert level(node, "depth") == (0, "depth is 0.05 s old when it is published")
    assert [stamp_ns(d) for d in depths] == stamps[::5]
    assert all(d.header.frame_id == "camera" and d.encoding == "32FC1" for d in depths)
    assert image_array(depths[0]).shape == (64, 128)
    picture = cv2.imdecode(np.frombuffer(jpeg(5, 128), np.uint8), cv2.IMREAD_COLOR)[..., ::-1]
    np.testing.assert_array_equal(image_array(depths[1]), node.model.estimate(np.ascontiguousarray(picture)))


def test_estimator_tells_broken_pictures_and_old_depth(model_file: Path) -> None:
    with LockstepBus(START) as bus:
        node = bus.add(DepthEstimatorNode, DepthEstimatorConfig(model=str(model_file)))
        bus.publish(
            "/camera/image/compressed", compressed_image_message(b"\xff\xd8 cut", "camera", START), stamp_ns=START
        )
        assert level(node, "depth")[0] == 2
        assert bus.messages("/depth/raw") == []
        message = compressed_image_message(jpeg(0), "camera", START + S)
        bus.publish("/camera/image/compressed", message, stamp_ns=START + 3 * S)
        assert level(node, "depth") == (1, "depth is 2.00 s old when it is published")


def test_estimator_without_model_ends_in_plain_words(tmp_path: Path) -> None:
    with pytest.raises(NodeError, match="no manifest"), LockstepBus(START) as bus:
        bus.add(DepthEstimatorNode, DepthEstimatorConfig(model=str(tmp_path / "absent.onnx")))


def test_selector_by_hand() -> None:
    selector = KeyframeSelector(KeyframeConfig(distance_m=1.0, angle_deg=45.0, unfit_after_s=2.0))
    here = pose_matrix(0, 0, 1)
    assert selector.take(here, True, 0)
    assert not selector.take(pose_matrix(0.9, 0, 1), True, S)
    assert not selector.take(pose_matrix(0, 0, 1, yaw=np.radians(44)), True, S)
    assert selector.take(pose_matrix(0, 0, 1, yaw=np.radians(46)), True, S)
    assert selector.take(pose_matrix(1.01, 0, 1, yaw=np.radians(46)), True, S)
    away = pose_matrix(5, 0, 1)
    assert not selector.take(away, False, 10 * S)
    assert not selector.take(away, False, 11 * S)
    assert selector.take(away, False, 12 * S)
    assert not selector.take(away, False, 13 * S)
    assert selector.take(away, True, 14 * S)
    assert selector.count == 5
    selector.restart()
    assert selector.take(away, True, 15 * S)
    assert selector.count == 6


def test_shipped_configuration_is_the_default() -> None:
    from instant_ic.bus.params import build, load_file
    from instant_ic.paths import shipped_file

    path = shipped_file("config", "depth.yaml")
    assert build(DepthEstimatorConfig, load_file(path, "depth_estimator")) == DepthEstimatorConfig()
    assert build(DepthScalerConfig, load_file(path, "depth_scaler")) == DepthScalerConfig()
