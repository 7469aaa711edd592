"""``ic depth adapt``: labels, what is left out, when a model counts as better, and a whole run on a small drive."""

from pathlib import Path

import cv2
import numpy as np
import pytest
import torch

from instant_ic.bag.writer import BagWriter
from instant_ic.bus import LATCHED, SENSOR
from instant_ic.cli.main import main
from instant_ic.depth.manifest import ModelManifest, save_manifest
from instant_ic.depth.model import DepthModel
from instant_ic.geometry.poses import pose_matrix
from instant_ic.geometry.projections import rays_of
from instant_ic.lidar.decode import POINT_DTYPE
from instant_ic.mapping.kernels import FLOOR, MEASURED
from instant_ic.mapping.local_model import LocalDepth
from instant_ic.msg import (
    TFMessage,
    cloud_message,
    compressed_image_message,
    serialize,
    transform_message,
    type_name,
)
from instant_ic.training import adaptation, drive
from instant_ic.training.adaptation import gain, in_sector, split
from instant_ic.training.completion import CompletionConfig, CompletionNet
from instant_ic.training.drive import DriveError, Keyframe, label_of, read_drive
from instant_ic.training.export import export_model, load_exported
from tests.depth.tiny_onnx import CHANNELS, channel, write

S = 1_000_000_000
SIZE = (64, 128)
LOW, HIGH = np.array([-3.0, -2.0, 0.0]), np.array([6.0, 2.5, 2.8])


def room_m(origin: np.ndarray, rays: np.ndarray) -> np.ndarray:
    """Range of rays (..., 3) from a place in an empty room."""
    with np.errstate(divide="ignore", invalid="ignore"):
        return np.where(rays > 0, (HIGH - origin) / rays, (LOW - origin) / rays).min(axis=-1)


def write_drive(path: Path, without: str = "", metres: float = 3.7) -> Path:
    """A straight drive through the room; the brightness of the images is the depth, 20 m are white."""
    elevation, azimuth = np.meshgrid(np.radians(np.arange(-15, 16, 2)), np.radians(np.arange(0.5, 360, 1.0)))
    beams = np.stack((np.cos(elevation) * np.cos(azimuth), np.cos(elevation) * np.sin(azimuth), np.sin(elevation)), -1)
    beams = beams.reshape(-1, 3)
    with BagWriter(path) as bag:

        def put(topic: str, message: object, stamp: int) -> None:
            if topic != without:
                qos = LATCHED if topic == "/tf_static" else SENSOR
                bag.write(topic, type_name(message), bytes(serialize(message)), stamp, qos)

        mounts = [transform_message(pose_matrix(0, 0, z), "base_link", name, S)
                  for name, z in (("velodyne", 0.6), ("camera", 1.2))]  # fmt: skip
        put("/tf_static", TFMessage(mounts), S)
        for number in range(round(metres / 0.1) + 1):
            x, stamp = 0.1 * number, S + number * S // 5
            put("/tf", TFMessage([transform_message(pose_matrix(x, 0, 0), "odom", "base_link", stamp)]), stamp)
            cloud = np.zeros(len(beams), POINT_DTYPE)
            xyz = beams * room_m(np.array([x, 0, 0.6]), beams)[:, None]
            cloud["x"], cloud["y"], cloud["z"] = xyz.T
            put("/lidar/points", cloud_message(cloud, "velodyne", stamp), stamp)
            depth = room_m(np.array([x, 0, 1.2]), rays_of((128, 256)))
            grey = np.repeat(np.clip(depth / 20 * 255, 0, 255).astype(np.uint8)[..., None], 3, -1)
            jpeg = cv2.imencode(".jpg", grey, [cv2.IMWRITE_JPEG_QUALITY, 98])[1].tobytes()
            put("/camera/image/compressed", compressed_image_message(jpeg, "camera", stamp), stamp)
    return path


def network(path: Path) -> Path:
    """A network that reads the depth from the image."""
    size = {"image": (1, 3, *SIZE)}, {"depth": (1, 1, *SIZE)}
    write(path, *size, channel("image", 0, "depth"), CHANNELS)
    save_manifest(
        ModelManifest(path.name, "reader", "none", *SIZE, input_scale=1 / 255, output_scale=20.0),
        path.with_suffix(".yaml"),
    )
    return path


def completion(path: Path, bias: float) -> Path:
    """A completion that moves its prior by a share of its sigma everywhere."""
    torch.manual_seed(0)
    model = CompletionNet(CompletionConfig(SIZE[0], (8, 8, 8), 2))
    with torch.no_grad():
        model.head.bias[:16] = bias
    export_model(model.eval(), path, "start", "Apache-2.0", 40.0, half_weights=True)
    return path


@pytest.fixture
def short(monkeypatch: pytest.MonkeyPatch) -> None:
    """A drive of 3.7 m has three stretches."""
    for module, values in (
        (drive, {"EVERY_M": 0.19, "LATER_M": 1.0}),
        (adaptation, {"STRETCH_M": 1.2, "LEFT_OUT_M": 0.4, "MARGIN_M": 0.15}),
    ):
        for name, value in values.items():
            monkeypatch.setattr(module, name, value)


def keyframe(x: float, label_m: float = 2.0, yaw: float = 0.0) -> Keyframe:
    label = np.full((8, 16), label_m, np.float16)
    return Keyframe(np.zeros((8, 16, 3), np.uint8), np.zeros((6, 8, 16), np.float16), label,
                    pose_matrix(x, 0, 1.2, yaw=yaw), x, 0)  # fmt: skip


def test_a_label_is_measured_was_not_free_before_and_had_nothing_in_front_of_it() -> None:
    size = (32, 64)
    kind = np.full(size, MEASURED, np.uint8)
    depth = np.full(size, 3.0, np.float32)
    depth[:, 50:60] = 4.0
    later = LocalDepth(depth, np.zeros(size, np.float32), kind, np.zeros(size, np.float32))
    free, ranges, fixed = np.zeros(size, np.float32), np.zeros(size, np.float32), np.zeros(size, bool)
    kind[0, 0] = FLOOR
    fixed[31] = True
    free[1, 0], free[2, 0] = 3.5, 3.1  # 3 m is 14 and 3 % nearer
    ranges[5:10, 20:40:2] = 3.0
    ranges[7, 30] = 2.0  # one stray point among many
    ranges[20:26, 10:20] = 2.0  # somebody stood there
    label = label_of(later, free, ranges, fixed)
    assert label[0, 0] == 0 and label[1, 0] == 0 and (label[31] == 0).all()
    assert label[2, 0] == 3.0 and label[7, 30] == 3.0 and label[12, 45] == 3.0
    assert np.flatnonzero(label[12] == 0).tolist() == [48, 49, 50, 51, 58, 59, 60, 61]  # depth edges
    assert (label[20:26, 10:20] == 0).all()


def test_the_last_metres_of_each_stretch_and_what_is_near_them_are_left_out() -> None:
    """Stretches of 5 m, of which 1.5 m are left out, and 0.5 m before and after them are used for nothing."""
    parts = split([keyframe(x) for x in np.arange(0.05, 15, 0.3)])
    assert {one.stretch for one in parts.places} == {0, 1, 2}
    assert all(one.keyframe.path_m % 5 >= 3.5 for one in parts.places) and len(parts.places) == 15
    assert all(0.4 < one.path_m % 5 < 3.2 or one.path_m < 0.4 for one, _ in parts.training)


def test_the_sector_is_a_direction_of_the_map_and_has_no_training_label() -> None:
    """60 degrees around x are 2.7 of 16 columns: the middle two of an image that looks along x."""
    ahead, left = in_sector(keyframe(0.0)), in_sector(keyframe(0.0, yaw=np.pi / 2))
    assert np.flatnonzero(ahead.any(axis=0)).tolist() == [7, 8]
    assert np.flatnonzero(left.any(axis=0)).tolist() == [11, 12]  # x is now to the right
    parts = split([keyframe(x) for x in np.arange(0.05, 15, 0.3)])
    assert all(((label > 0) == ~ahead).all() for _, label in parts.training)
    assert all(((one.label_m > 0) == ahead).all() for one in parts.sector)


def test_a_drive_that_is_too_short_is_refused() -> None:
    with pytest.raises(DriveError, match=r"45 keyframes over 13.2 m give 2 stretches.*3 are needed. Record 15 m"):
        split([keyframe(x) for x in np.arange(0.05, 13.4, 0.3)])


@pytest.mark.parametrize(("gains", "better"), [((0.1, 0.2, 0.3), True), ((0.0, 0.2, 0.4), False),
                                               ((-0.1, -0.1, -0.1), False)])  # fmt: skip
def test_better_is_better_by_more_than_the_stretches_differ(gains: tuple[float, ...], better: bool) -> None:
    """Three stretches: the 95 % quantile of Student's t with 2 degrees of freedom is 2.920."""
    part = [adaptation.LeftOut(keyframe(0.0), np.ones((8, 16)), number) for number in (0, 0, 1, 2)]
    start, prior = np.full(4, 0.1), np.array([0.4, 0.2, 0.2, 0.1])
    adapted = (start + 0.005) * np.exp(-np.array([gains[0], gains[0], gains[1], gains[2]])) - 0.005
    found = gain(part, prior, start, adapted)
    spread = float(np.std(gains, ddof=1))
    assert found.margin == pytest.approx(2.920 * spread / np.sqrt(3), rel=1e-3, abs=1e-12)
    assert found.prior == pytest.approx((0.3 + 0.2 + 0.1) / 3) and found.better == better
    assert found.gain == pytest.approx(np.mean(gains)) and found.start == pytest.approx(0.1)


def test_an_exported_network_loads_back_equal(tmp_path: Path) -> None:
    """Also with batch norms that are not the identity; float16 weights differ by 2^-11."""
    torch.manual_seed(4)
    model = CompletionNet(CompletionConfig(64, (8, 12, 16), 3))
    torch.nn.init.normal_(model.head.weight, std=0.2)
    for one in model.modules():
        if isinstance(one, torch.nn.BatchNorm2d):
            for tensor, low, high in ((one.weight, 0.5, 1.5), (one.bias, -0.5, 0.5), (one.running_mean, -0.5, 0.5),
                                      (one.running_var, 0.5, 2.0)):  # fmt: skip
                torch.nn.init.uniform_(tensor, low, high)
    model.eval()
    image, prior = torch.rand(1, 3, 64, 128), torch.rand(1, 6, 64, 128)
    prior[:, 2] = 0
    export_model(model, tmp_path / "c.onnx", "c", "Apache-2.0", 30.0, half_weights=True, brightness=150.0)
    loaded, manifest = load_exported(tmp_path / "c.onnx")
    assert loaded.config == model.config and (manifest.max_range_m, manifest.brightness) == (30.0, 150.0)
    with torch.inference_mode():
        for mine, other in zip(loaded(image, prior), model(image, prior), strict=True):
            torch.testing.assert_close(mine, other, rtol=2e-2, atol=2e-2)
    # To the file itself it is equal, on an image whose bytes are as bright as it wants them.
    picture = np.full((64, 128, 3), 150, np.uint8)
    depth, sigma = DepthModel.load(tmp_path / "c.onnx", 1, "cpu").complete(picture, prior[0].numpy())
    with torch.inference_mode():
        mine = loaded(torch.full_like(image, 150 / 255), prior)
    np.testing.assert_allclose(mine[0][0].clamp(0.1, 30.0), depth, rtol=1e-4)
    np.testing.assert_allclose(mine[1][0], sigma, rtol=1e-4)


def test_labels_of_a_drive_are_the_true_depth(tmp_path: Path, short: None) -> None:
    found = read_drive(
        write_drive(tmp_path / "b", metres=2.4), DepthModel.load(network(tmp_path / "n.onnx"), 1, "cpu"), SIZE
    )
    assert len(found) == 13 and found[10].path_m == pytest.approx(2.0, abs=0.02)
    for one in found[::5]:
        origin = one.model_from_camera[:3, 3]
        truth = room_m(origin, rays_of(SIZE))
        known = one.label_m > 0
        assert known.mean() > 0.03 and np.median(np.abs(one.label_m[known] / truth[known] - 1)) < 0.01
        assert (one.prior[2] > 0).any() and one.rgb.shape == (*SIZE, 3)


def test_a_wrong_start_is_corrected_and_a_right_one_is_not_replaced(
    tmp_path: Path, short: None, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr("instant_ic.cli.depth_adapt.MOST_EPOCHS", 20)
    monkeypatch.setattr(adaptation, "CONFIDENCE", 0.5)  # margin 0: three short stretches of one room prove nothing
    bag, out = write_drive(tmp_path / "b"), tmp_path / "mine.onnx"
    words = ["depth", "adapt", str(bag), "--network", str(network(tmp_path / "n.onnx")), "-o", str(out)]
    wrong = completion(tmp_path / "wrong.onnx", 1.5)
    assert main([*words, "--start", str(wrong), "--learning-rate", "0.01"]) == 0
    said = capsys.readouterr().out
    assert "places left out: prior 0.0" in said and f"wrote {out}" in said
    adapted, manifest = load_exported(out)
    assert manifest.name == "mine" and float(adapted.head.bias[:16].mean().detach()) < 1.5
    out.unlink()
    assert main([*words, "--start", str(completion(tmp_path / "right.onnx", 0.0)), "--learning-rate", "1.0"]) == 1
    assert "is not written" in capsys.readouterr().out and not out.exists()


def test_wrong_input_is_named(tmp_path: Path, short: None, capsys: pytest.CaptureFixture[str]) -> None:
    start, raw = completion(tmp_path / "c.onnx", 0.0), network(tmp_path / "n.onnx")

    def said(bag: Path, start: Path = start, raw: Path = raw, status: int = 1) -> str:
        words = ["--start", str(start), "--network", str(raw), "-o", str(tmp_path / "mine.onnx")]
        assert main(["depth", "adapt", str(bag), *words]) == status
        assert not (tmp_path / "mine.onnx").exists()
        return capsys.readouterr().err

    for topic, text in (
        ("/camera/image/compressed", "no /camera/image/compressed (CompressedImage)"),
        ("/lidar/points", "no /lidar/points or /lidar/packets"),
        ("/tf", "none of"),
    ):
        bag = write_drive(tmp_path / topic.replace("/", "_"), topic, metres=0.5)
        assert text in said(bag), topic
    brief = write_drive(tmp_path / "brief", metres=1.0)
    assert "the drive is too short" in said(brief)
    assert "takes the image alone" in said(brief, start=raw)
    assert "a completion; give a network that takes the image alone" in said(brief, raw=start, status=2)
    assert "absent does not exist" in said(tmp_path / "absent")
