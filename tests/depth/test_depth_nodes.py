"""The depth nodes in lockstep: a robot in a box-shaped room."""

from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np
import pytest
import tiny_onnx
import torch

from instant_ic.bus import Node, NodeError
from instant_ic.bus.lockstep import LockstepBus
from instant_ic.depth.keyframes import KeyframeSelectionConfig, KeyframeSelector, decode_sigma, encode_sigma
from instant_ic.depth.lidar_depth import LidarDepthConfig
from instant_ic.depth.manifest import ModelManifest, manifest_path, save_manifest
from instant_ic.depth.scaler import ScalerConfig
from instant_ic.geometry.poses import inverse, pose_matrix
from instant_ic.geometry.projections import equirect_directions
from instant_ic.lidar.decode import POINT_DTYPE
from instant_ic.msg import (
    DepthModelInfo,
    PointCloud2,
    TFMessage,
    cloud_message,
    cloud_xyz,
    compressed_image_message,
    header,
    image_array,
    image_message,
    matrix_from_pose,
    stamp_ns,
    transform_message,
)
from instant_ic.training.completion import CompletionConfig, CompletionNet
from instant_ic.training.export import export_model
from nodes.depth_estimator import DepthEstimatorConfig, DepthEstimatorNode
from nodes.depth_scaler import DepthScalerConfig, DepthScalerNode

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
    """Ranges (N,) from points (N, 3) or (3,) along directions (N, 3) to the walls of the room."""
    with np.errstate(divide="ignore", invalid="ignore"):
        reach = np.where(directions > 0, (HIGH - origin) / directions, (LOW - origin) / directions)
    reach[directions == 0] = np.inf
    return reach.min(axis=-1)


def room_depth(map_from_camera: np.ndarray, height: int = 64) -> np.ndarray:
    directions = equirect_directions(2 * height, height).reshape(-1, 3) @ map_from_camera[:3, :3].T
    return ranges(map_from_camera[:3, 3], directions).reshape(height, 2 * height).astype(np.float32)


def revolution(start: int) -> np.ndarray:
    """A cloud as the moving LiDAR measures it: every point at its own time."""
    elevation = np.radians(np.arange(-15, 16, 2.0))
    azimuth = -2 * np.pi * np.arange(720)[:, None] / 720
    local = np.empty((720, 16, 3))
    local[..., 0], local[..., 1] = np.cos(elevation) * np.cos(azimuth), np.cos(elevation) * np.sin(azimuth)
    local[..., 2] = np.sin(elevation)
    time_s = np.arange(720) / 7200
    poses = np.stack([base_at(start + round(t * S)) @ BASE_FROM_LIDAR for t in time_s])
    rays = np.einsum("nij,nkj->nki", poses[:, :3, :3], local).reshape(-1, 3)
    reach = ranges(np.repeat(poses[:, :3, 3], 16, axis=0), rays)
    cloud = np.zeros(720 * 16, POINT_DTYPE)
    cloud["x"], cloud["y"], cloud["z"] = (local.reshape(-1, 3) * reach[:, None]).T
    cloud["time"] = np.repeat(time_s, 16)
    return cloud


def jpeg(seed: int, height: int = 64) -> bytes:
    noise = np.random.default_rng(seed).integers(0, 256, (height // 8, height // 4, 3), np.uint8)
    ok, data = cv2.imencode(".jpg", cv2.resize(noise, (2 * height, height)))
    assert ok
    return data.tobytes()


@pytest.fixture(scope="module")
def model_file(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A network whose depth is the red channel as it comes in."""
    path = tmp_path_factory.mktemp("model") / "tiny.onnx"
    nodes = tiny_onnx.channel("image", 0, "depth")
    tiny_onnx.write(path, {"image": (1, 3, 64, 128)}, {"depth": (1, 1, 64, 128)}, nodes, tiny_onnx.CHANNELS)
    save_manifest(ModelManifest("tiny.onnx", "tiny", "Apache-2.0", 64, 128), manifest_path(path))
    return path


def publish_tf(bus: LockstepBus, stamp: int, map_from_base: np.ndarray | None = None) -> None:
    odom_from_base = inverse(MAP_FROM_ODOM) @ (base_at(stamp) if map_from_base is None else map_from_base)
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
    bus: LockstepBus,
    seconds: float,
    begin: int = START,
    factor: float = 2.0,
    lidar: bool = True,
    tf: bool = True,
    network: bool = True,
    body: bool = False,
    base_from_floor: np.ndarray | None = None,
) -> None:
    """Publishes tf at 50 Hz, the LiDAR at 10 Hz, picture and its depth (in other units) at 2 Hz, 80 ms late.

    ``body``: the network sees a robot 0.3 m under the camera; ``base_from_floor``: the base is not where it is said.
    """
    lifted = np.eye(4) if base_from_floor is None else inverse(base_from_floor)
    static = [
        transform_message(lifted @ BASE_FROM_CAMERA, "base_link", "camera", begin),
        transform_message(lifted @ BASE_FROM_LIDAR, "base_link", "velodyne", begin),
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
        if tick % 25 == 14 and network:
            stamp = now - 4 * S // 50
            depth = room_depth(base_at(stamp) @ BASE_FROM_CAMERA) / factor
            if body:
                depth[-len(depth) // 6 :] = 0.3 / factor
            bus.publish("/depth/raw", image_message(depth.astype(np.float32), "32FC1", "camera", stamp), stamp_ns=now)


def level(node: DepthScalerNode | DepthEstimatorNode, name: str) -> tuple[int, str]:
    found = node.diagnoses()[name]
    return found[0], found[1]


def far_off(depth: np.ndarray, stamp: int) -> np.ndarray:
    """|relative error| of depth of the room, (H, W)."""
    truth = room_depth(base_at(stamp) @ BASE_FROM_CAMERA, len(depth))
    return np.abs(depth / truth - 1)


@dataclass(frozen=True)
class NoConfig:
    """No parameters."""


class Viewer(Node[NoConfig]):
    """Subscribes to the local model."""

    name = "viewer"

    def setup(self) -> None:
        self.subscribe("/map/local", PointCloud2, lambda message: None)


def test_the_local_model_grows_is_published_on_demand_and_starts_again() -> None:
    with LockstepBus(START) as bus:
        node = bus.add(DepthScalerNode)
        drive(bus, 3.0)
        assert not bus.messages("/map/local")  # nobody subscribes
        grown = node.chain.mapper.model.revolutions
        assert 5 <= grown <= 9  # 1.2 m, one in 0.15 m
        assert level(node, "local model") == (0, "growing")
        bus.add(Viewer)
        drive(bus, 4.2, START + 3 * S)
        clouds = bus.messages("/map/local")
        cloud = cloud_xyz(clouds[-1])
        assert len(clouds) in (1, 2, 3) and clouds[-1].header.frame_id == "map" and len(cloud) > 500
        off = np.minimum(np.abs(cloud - LOW), np.abs(cloud - HIGH)).min(axis=1)
        assert np.quantile(off, 0.95) < 0.06  # all on the walls, the floor or the ceiling
        node.on_cloud(cloud_message(np.zeros(5, [("x", "f4"), ("y", "f4"), ("z", "f4")]), "velodyne", START + 8 * S))
        assert level(node, "points") == (1, "/lidar/points cannot be used: no field of name time")
        node.on_cloud(cloud_message(np.zeros(5, POINT_DTYPE), "velodyne", START))
        assert level(node, "local model")[0] == 1 and "time went back" in level(node, "local model")[1]
        assert node.chain.mapper.model.revolutions == 0


def test_scaler_scales_and_makes_keyframes() -> None:
    with LockstepBus(START) as bus:
        node = bus.add(DepthScalerNode, DepthScalerConfig(source="fused"))
        drive(bus, 4.0)
        scaled, keyframes = bus.messages("/depth/scaled"), bus.messages("/keyframe")
        assert level(node, "scale")[0] == 0
        values = node.diagnoses()["scale"][2]
    assert values["source"] == "fused" and float(values["sigma"]) < 0.05
    assert len(scaled) == 8
    for message in scaled:
        # The network is the truth halved: the factor comes back, and nothing of the LiDAR's structure spoils it.
        error = far_off(image_array(message), stamp_ns(message))
        assert np.quantile(error, 0.95) < 0.03 and error.max() < 0.2
        assert message.header.frame_id == "camera"
    # 0.4 m/s and 0.3 rad/s: 0.6 m every 1.5 s, 45 degrees only after 2.6 s. Pictures come every 0.5 s from 0.2 s.
    assert [(stamp_ns(k) - START) / S for k in keyframes] == [0.2, 1.7, 3.2]
    assert [k.id for k in keyframes] == [1, 2, 3]
    for k in keyframes:
        assert k.header.frame_id == "map" and k.fit and k.quality > 0.95 and k.source == "fused"
        assert k.scale == pytest.approx(2.0, rel=0.03)
        assert 0 < k.relative_sigma < 0.05
        np.testing.assert_allclose(matrix_from_pose(k.pose), base_at(stamp_ns(k)) @ BASE_FROM_CAMERA, atol=2e-3)
        assert bytes(k.panorama.data) == jpeg(round((stamp_ns(k) - START) / S * 50))
        assert np.quantile(far_off(image_array(k.depth), stamp_ns(k)), 0.95) < 0.03
        sigma = decode_sigma(image_array(k.sigma))
        assert sigma.shape == image_array(k.depth).shape
        assert (np.isfinite(sigma) == (image_array(k.depth) > 0)).all()
        # The model's sigma has a value for each kind of pixel: the robot's body moves the median from one to the next.
        assert float(np.median(sigma)) == pytest.approx(k.relative_sigma, rel=0.3)


def test_lidar_alone_needs_no_network() -> None:
    with LockstepBus(START) as bus:
        config = LidarDepthConfig(ceiling_height_m=2.6)
        node = bus.add(DepthScalerNode, DepthScalerConfig(source="lidar", lidar=config, rows=128, max_rate_hz=1.0))
        drive(bus, 2.5, network=False)
        scaled, keyframes = bus.messages("/depth/scaled"), bus.messages("/keyframe")
        assert level(node, "scale")[0] == 0
    # Images at 0.2, 0.7, 1.2... s, depth where a keyframe is due; the ceiling's height is from the configuration.
    assert [(stamp_ns(m) - START) / S for m in scaled] == [0.2, 1.7]
    assert image_array(scaled[0]).shape == (128, 256)
    for message in scaled:
        assert np.quantile(far_off(image_array(message), stamp_ns(message)), 0.99) < 0.04
    assert keyframes[0].fit and keyframes[0].source == "lidar" and keyframes[0].scale == 1.0


@pytest.fixture(scope="module")
def completed(tmp_path_factory: pytest.TempPathFactory) -> DepthScalerConfig:
    """With a completion that puts everything at least an eighth farther, and is sure of it."""
    torch.manual_seed(0)
    model = CompletionNet(CompletionConfig(64, (8, 8, 8), 2))
    torch.nn.init.constant_(model.head.bias[:16], 2.4)  # times a sigma of 0.05 or more
    torch.nn.init.constant_(model.head.bias[16:], -1.0)
    path = tmp_path_factory.mktemp("completion") / "c.onnx"
    export_model(model.eval(), path, "c", "Apache-2.0", 40.0)
    return DepthScalerConfig(source="completed", completion=str(path), provider="cpu")


def test_completion_corrects_the_fused_depth(completed: DepthScalerConfig) -> None:
    depths, sigmas = [], []
    for config in (DepthScalerConfig(source="fused"), completed):
        with LockstepBus(START) as bus:
            node = bus.add(DepthScalerNode, config)
            drive(bus, 2.5)
            scaled, keyframes = bus.messages("/depth/scaled"), bus.messages("/keyframe")
            severity, text = level(node, "scale")
        assert severity == 0 and text.endswith("; completed") == (config.source == "completed")
        assert keyframes[0].fit and keyframes[0].source == config.source
        depths.append(image_array(scaled[0]))
        sigmas.append(decode_sigma(image_array(keyframes[0].sigma)))
    changed = depths[0] != depths[1]
    assert 0.1 < changed.mean() < 0.7  # floor and guesses, not what the LiDAR has measured and the robot itself
    assert np.log(depths[1] / depths[0])[changed].min() > 0.1
    assert np.median((sigmas[1] / sigmas[0])[changed]) == pytest.approx(np.exp(-1), rel=0.05)
    np.testing.assert_array_equal(sigmas[1][~changed], sigmas[0][~changed])


def test_no_depth_is_requested_while_a_completion_runs(
    completed: DepthScalerConfig, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Until its keyframe is taken every image would be due, and each request costs an inference."""
    monkeypatch.setattr("instant_ic.bus.node.Worker.submit", lambda self, item: setattr(self, "busy", True))
    with LockstepBus(START) as bus:
        node = bus.add(DepthScalerNode, completed)
        drive(bus, 0.5)  # an image, its revolution and its depth
        assert node.worker.busy
        before = len(bus.messages("/depth/request"))
        images(bus, [0.0, 0.0, 0.0], START + S)
        assert len(bus.messages("/depth/request")) == before
        node.worker.busy = False
        images(bus, [0.0], START + 2 * S)
        assert len(bus.messages("/depth/request")) == before + 1


def test_completion_without_a_model_is_refused(tmp_path: Path) -> None:
    with pytest.raises(ValueError, match="source completed needs a model"):
        DepthScalerConfig(completion="")
    with LockstepBus(START) as bus, pytest.raises(NodeError, match=r"absent\.yaml: no manifest"):
        bus.add(DepthScalerNode, DepthScalerConfig(completion=str(tmp_path / "absent.onnx")))


def images(bus: LockstepBus, x_m: list[float], begin: int, cloud: np.ndarray | None = None) -> list[int]:
    """Images at 5 Hz, each from its place on the x axis, after a revolution of the LiDAR; returns their stamps."""
    stamps = [begin + number * S // 5 for number in range(len(x_m))]
    for stamp, x in zip(stamps, x_m, strict=True):
        publish_tf(bus, stamp - S // 10, pose_matrix(x))
        publish_tf(bus, stamp, pose_matrix(x))
        if cloud is not None:
            bus.publish("/lidar/points", cloud_message(cloud, "velodyne", stamp - S // 10), stamp_ns=stamp)
        bus.publish("/camera/image/compressed", compressed_image_message(jpeg(1), "camera", stamp), stamp_ns=stamp)
    return stamps


def publish_mounts(bus: LockstepBus) -> None:
    mounts = [("camera", BASE_FROM_CAMERA), ("velodyne", BASE_FROM_LIDAR)]
    static = [transform_message(pose, "base_link", child, START) for child, pose in mounts]
    bus.publish("/tf_static", TFMessage(static), stamp_ns=START, latched=True)


def test_a_standing_robot_needs_one_depth_and_a_moving_one_at_once(model_file: Path) -> None:
    anything = ScalerConfig(min_quality=0.0, max_scale=1e6, max_rival=1.0)
    with LockstepBus(START) as bus:
        estimator = bus.add(DepthEstimatorNode, DepthEstimatorConfig(model=str(model_file), max_rate_hz=0.5))
        bus.add(DepthScalerNode, DepthScalerConfig(source="network", scaler=anything))
        publish_mounts(bus)
        cloud = revolution(START)
        images(bus, [0.0] * 20, START + S, cloud)
        assert [stamp_ns(m) - START for m in bus.messages("/depth/raw")] == [S]
        assert [k.id for k in bus.messages("/keyframe")] == [1]
        # 0.12 m an image: the fifth is the first at 0.6 m from the keyframe, and its own depth makes the next one.
        stamps = images(bus, [0.12 * n + 1e-6 for n in range(1, 8)], START + 6 * S, cloud)
        for topic in ("/depth/raw", "/depth/scaled", "/keyframe"):
            assert stamp_ns(bus.last(topic)) == stamps[4] and len(bus.messages(topic)) == 2, topic
        assert stamp_ns(bus.last("/depth/request")) == stamps[4]
        assert estimator.diagnoses()["depth"][0] == 0


def test_a_request_is_repeated_until_depth_arrives() -> None:
    with LockstepBus(START) as bus:
        bus.add(DepthScalerNode, DepthScalerConfig(scaler=ScalerConfig("as_estimated")))
        publish_mounts(bus)
        stamps = images(bus, [0.0] * 16, START)
        assert [stamp_ns(m) for m in bus.messages("/depth/request")] == [0, stamps[0], stamps[10]]
        depth = room_depth(BASE_FROM_CAMERA)
        bus.publish("/depth/raw", image_message(depth, "32FC1", "camera", stamps[10]), stamp_ns=stamps[15] + 1)
        assert [stamp_ns(k) for k in bus.messages("/keyframe")] == [stamps[10]]
        images(bus, [0.0] * 16, START + 4 * S)
        assert len(bus.messages("/depth/request")) == 3


def test_time_that_goes_back_makes_a_new_keyframe() -> None:
    with LockstepBus(START) as bus:
        bus.add(DepthScalerNode, DepthScalerConfig(scaler=ScalerConfig("as_estimated")))
        publish_mounts(bus)
        depth = room_depth(BASE_FROM_CAMERA)
        for begin in (START + 20 * S, START + 10 * S):
            (stamp,) = images(bus, [0.0], begin)
            bus.publish("/depth/raw", image_message(depth, "32FC1", "camera", stamp), stamp_ns=stamp)
        assert [stamp_ns(k) - START for k in bus.messages("/keyframe")] == [20 * S, 10 * S]


def test_a_silent_network_is_told() -> None:
    with LockstepBus(START) as bus:
        node = bus.add(DepthScalerNode)
        drive(bus, 12.7, network=False, lidar=False)
        severity, words = level(node, "scale")
    assert severity == 1 and "no /depth/raw for 12 s" in words and "source to lidar" in words


def test_the_models_own_word_of_its_output_counts() -> None:
    with LockstepBus(START) as bus:
        node = bus.add(DepthScalerNode, DepthScalerConfig(source="network"))
        info = DepthModelInfo(
            header=header("", START), name="any", licence="", output_kind="scale_invariant", provider="cpu"
        )
        bus.publish("/depth/model", info, stamp_ns=START, latched=True)
        drive(bus, 0.5)
        (message,) = bus.messages("/depth/scaled")
        assert level(node, "model") == (0, "any: scale_invariant depth")
    assert np.quantile(far_off(image_array(message), stamp_ns(message)), 0.95) < 0.03


def test_sigma_in_bytes_by_hand() -> None:
    sigma = np.array([[np.inf, 0.0, 0.002, 1.0, 7.0, np.nan]])
    code = encode_sigma(sigma)
    assert code.tolist() == [[0, 1, 1, 255, 255, 0]]
    np.testing.assert_allclose(decode_sigma(code), [[np.inf, 0.002, 0.002, 1.0, 1.0, np.inf]], rtol=1e-6)
    between = np.geomspace(0.002, 1.0, 77)[None]
    np.testing.assert_allclose(decode_sigma(encode_sigma(between)), between, rtol=0.0125)


@pytest.mark.parametrize("source", ["completed", "lidar"])
def test_no_lidar_is_told_and_no_keyframe_at_once(source: str) -> None:
    with LockstepBus(START) as bus:
        node = bus.add(DepthScalerNode, DepthScalerConfig(source=source))
        drive(bus, 1.0, network=source != "lidar", lidar=False)
        assert bus.messages("/depth/scaled") == [] and bus.messages("/keyframe") == []
        assert level(node, "scale") == (1, "no LiDAR revolution within 0.3 s")


def test_unfit_keyframe_goes_out_marked_after_waiting_and_a_fit_one_replaces_it(
    caplog: pytest.LogCaptureFixture,
) -> None:
    caplog.set_level("INFO")
    config = DepthScalerConfig(keyframes=KeyframeSelectionConfig(unfit_after_s=1.0))
    with LockstepBus(START) as bus:
        bus.add(DepthScalerNode, config)
        drive(bus, 1.5, lidar=False)
        (unfit,) = bus.messages("/keyframe")
        assert not unfit.fit and unfit.quality == 0.0 and unfit.scale == 1.0
        assert "no LiDAR revolution" in unfit.message
        assert stamp_ns(unfit) == START + 12 * S // 10  # due at 0.2 s, waited for 1 s
        drive(bus, 0.5, begin=START + 2 * S)
        assert [k.fit for k in bus.messages("/keyframe")] == [False, True]
    for number in (1, 2):
        assert sum(f"keyframe {number}: " in text for text in caplog.messages) == 1  # logged once each


def test_without_poses_nothing_is_made_up() -> None:
    with LockstepBus(START) as bus:
        node = bus.add(DepthScalerNode)
        drive(bus, 1.0, tf=False)
        assert bus.messages("/depth/scaled") == [] and bus.messages("/keyframe") == []
        assert "no path from camera to odom" in level(node, "scale")[1]
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
    np.testing.assert_array_equal(image_array(depths[1]), node.inference.model.estimate(np.ascontiguousarray(picture)))


def test_estimator_takes_what_is_requested(model_file: Path) -> None:
    def image(tick: int) -> None:
        stamp = START + tick * S // 5
        bus.publish("/camera/image/compressed", compressed_image_message(jpeg(1), "camera", stamp), stamp_ns=stamp)

    def request(tick: int) -> None:
        bus.publish("/depth/request", header("camera", START + tick * S // 5), latched=True)

    def estimated() -> list[int]:
        return [(stamp_ns(m) - START) * 5 // S for m in bus.messages("/depth/raw")]

    with LockstepBus(START) as bus:
        bus.add(DepthEstimatorNode, DepthEstimatorConfig(model=str(model_file), max_rate_hz=2.0))
        for tick in range(4):
            image(tick)
        assert estimated() == [0, 3]  # nobody has requested anything yet: as in the replay of an older bag
        request(2)  # a newer one has been estimated since
        for tick in range(4, 12):
            image(tick)
        assert estimated() == [0, 3]
        request(11)  # the newest image
        assert estimated() == [0, 3, 11]
        request(12)  # still to come, and earlier than the rate allows: a later one
        for tick in range(12, 20):
            image(tick)
        assert estimated() == [0, 3, 11, 14]


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


def test_selector_by_hand() -> None:
    selector = KeyframeSelector(KeyframeSelectionConfig(distance_m=1.0, angle_deg=45.0, unfit_after_s=2.0))
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
    assert not selector.due(away, 43 * S)
    assert selector.due(away, 44 * S)  # 30 s: what stands around may have moved
    assert not selector.due(away, 44 * S, fit=False)
    selector.restart()
    assert selector.take(away, True, 15 * S)
    assert selector.count == 6
