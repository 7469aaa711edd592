"""Evaluation of depth: the LiDAR's measurement of a truth, pairing of files, scores, and the command."""

import json
from pathlib import Path
from types import SimpleNamespace

import cv2
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays

from instant_ic.cli.main import main
from instant_ic.depth.files import DepthFileError, load_depth
from instant_ic.depth.metrics import depth_metrics
from instant_ic.experiments.depth import (
    DepthEvaluationError,
    DepthSettings,
    Evaluator,
    LidarSettings,
    pair,
    report,
)
from instant_ic.experiments.depth_lidar import RangeErrors, measure, measure_world
from instant_ic.geometry.poses import pose_matrix
from instant_ic.geometry.projections import equirect_directions
from instant_ic.sim.render import EquirectRenderer
from instant_ic.sim.worlds import random_world

CAMERA_M, LIDAR_M = 1.2, 0.6
SIZE = 64, 128


def box_room(size=SIZE, half_x=3.0, half_y=2.0, ceiling_m=2.7, camera_m=CAMERA_M):
    """True radial depth of an empty room, camera in its middle: the nearest of six planes in each direction."""
    x, y, z = np.moveaxis(equirect_directions(size[1], size[0]).astype(np.float64), -1, 0)
    up = np.where(z > 0, (ceiling_m - camera_m) / np.maximum(z, 1e-9), camera_m / np.maximum(-z, 1e-9))
    ahead, aside = half_x / np.maximum(np.abs(x), 1e-9), half_y / np.maximum(np.abs(y), 1e-9)
    return np.minimum(np.minimum(ahead, aside), up).astype(np.float32)


def test_measured_box_room_lies_on_its_planes_and_on_the_rings():
    points = measure(box_room((256, 512)), LIDAR_M, CAMERA_M, RangeErrors(0)).astype(np.float64)
    assert 0.9 * 16 * 512 < len(points) <= 16 * 512  # a closed room answers every beam
    x, y, z = points.T
    # Relative to the camera: walls at 3 and 2 m, floor at -1.2 m; the rings up to 15 deg from 0.6 m do not reach 2.7 m.
    off = np.min([np.abs(np.abs(x) - 3), np.abs(np.abs(y) - 2), np.abs(z + 1.2)], axis=0)
    assert off.max() < 1e-5
    from_lidar = points - [0, 0, LIDAR_M - CAMERA_M]
    elevation = np.degrees(np.arcsin(from_lidar[:, 2] / np.linalg.norm(from_lidar, axis=1)))
    assert np.abs(elevation - (2 * np.round((elevation + 15) / 2) - 15)).max() <= 0.5 * 180 / 256


def test_nothing_is_measured_behind_what_the_lidar_sees_or_through_the_unknown():
    depth = np.full((128, 256), 6.0, np.float32)
    # A board at 2 m, 8 to 40 deg under the horizon, right ahead.
    elevation = 90 - (np.arange(128) + 0.5) * 180 / 128
    rows = (elevation < -8) & (elevation > -40)
    depth[np.ix_(rows, np.arange(118, 138))] = 2.0
    depth[:, :20] = 0  # an open window behind
    points = measure(depth, 0.2, 1.2, RangeErrors(0))
    azimuth = np.degrees(np.arctan2(points[:, 1], points[:, 0]))
    ahead = np.abs(azimuth) < 12
    from_lidar = points - np.array([0, 0, -1.0])
    level = np.abs(from_lidar[:, 2]) < 0.1 * np.linalg.norm(from_lidar, axis=1)
    assert np.allclose(np.linalg.norm(points[ahead & level], axis=1), 2.0)
    assert not np.any((azimuth > 153) & (azimuth < 179))
    assert len(measure(np.zeros((16, 32)), 0.6, 1.2)) == 0


@settings(max_examples=25, deadline=None)
@given(
    arrays(np.float32, (8, 16), elements=st.floats(-1, 200, width=32) | st.sampled_from([np.nan, np.inf, 0])),
    st.floats(-3, 3),
)
def test_whatever_the_picture_points_are_finite_and_in_reach(depth, lidar_m):
    points = measure(depth, lidar_m, 1.0, RangeErrors(0))
    range_m = np.linalg.norm(points - np.array([0, 0, lidar_m - 1.0], np.float32), axis=1)
    assert np.isfinite(points).all()
    assert ((range_m > 0.399) & (range_m < 100.1)).all()


def test_noise_and_outliers_are_as_told():
    clean = np.full(20000, 5.0)
    noisy = RangeErrors(noise_m=0.02, seed=1).apply(clean)
    assert abs(noisy.std() - 0.02) < 0.001
    assert abs(noisy.mean() - 5) < 0.001
    wrong = RangeErrors(noise_m=0.0, outliers=0.05, seed=1).apply(clean)
    assert (wrong != 5).sum() == 1000
    assert 0.4 < (wrong[wrong != 5] < 5).mean() < 0.6
    assert wrong.min() >= 0.4
    assert wrong.max() <= 15
    assert np.array_equal(wrong, RangeErrors(noise_m=0.0, outliers=0.05, seed=1).apply(clean))
    for bad in ({"noise_m": -1}, {"outliers": 1.5}, {"noise_m": np.nan}):
        with pytest.raises(ValueError, match="must"):
            RangeErrors(**bad)


@pytest.mark.parametrize(("change", "words"), [({"lidar_height_m": np.nan}, "heights")])
def test_measure_refuses_nonsense(change, words):
    with pytest.raises(ValueError, match=words):
        measure(**({"depth_m": box_room(), "lidar_height_m": 0.6, "camera_height_m": 1.2} | change))
    with pytest.raises(ValueError, match=r"\(H, W\)"):
        measure(np.ones((4, 8, 3)), 0.6, 1.2)


def test_a_measured_picture_agrees_with_rays_in_the_world():
    renderer = EquirectRenderer(random_world(900_000))
    ((x, y, yaw),) = renderer.world.sample_free_poses(np.random.default_rng(5), 1)
    pose = pose_matrix(x, y, CAMERA_M, yaw=yaw)
    points = measure(renderer.render(pose, 256, 128).depth_m, LIDAR_M, CAMERA_M, RangeErrors(0))
    mount = np.array([0, 0, LIDAR_M - CAMERA_M])
    range_m = np.linalg.norm(points - mount, axis=1)
    rays = np.ascontiguousarray(((points - mount) / range_m[:, None]) @ pose[:3, :3].T, np.float32)
    origin = pose[:3, :3] @ mount + pose[:3, 3]
    true, _ = renderer.cast(np.ascontiguousarray(np.broadcast_to(origin, rays.shape), np.float32), rays)
    assert np.quantile(np.abs(range_m - true) / true, 0.95) < 0.02
    everything = measure_world(renderer, pose, LIDAR_M, CAMERA_M, RangeErrors(noise_m=0))
    assert 0.8 * len(everything) / 900 < len(points) / 256 <= 16


class KnownModel:
    """Stands in for a network: gives the depth it was told, whatever the picture."""

    def __init__(self, depth, kind="metric"):
        self.depth, self.provider = depth, "none"
        self.manifest = SimpleNamespace(output_kind=kind, name="known", prior_input="")

    def estimate(self, rgb):
        return self.depth.copy()


RGB = np.full((*SIZE, 3), 128, np.uint8)


def test_scores_before_and_after_scaling():
    truth = box_room((128, 256))
    model = KnownModel(0.5 * box_room((128, 256)))
    evaluator = Evaluator(DepthSettings("network", LidarSettings()), model)
    scored = evaluator.score("room", RGB, truth)
    # Half the depth everywhere: relative error and error of the scale 0.5, no pixel within 1.25; then mended.
    assert scored.before.mre == pytest.approx(0.5, abs=1e-6)
    assert scored.before.scale_error_median == pytest.approx(0.5, abs=1e-6)
    assert scored.before.delta1 == 0
    assert scored.fit["ok"]
    assert scored.fit["scale"] == pytest.approx(2, rel=0.01)
    assert scored.after.mre < 0.01
    assert scored.after.delta1 == pytest.approx(1)
    figures = report([scored.as_dict()] * 2, evaluator.settings, model)
    assert figures["after"]["mre"] == pytest.approx(scored.after.mre, abs=1e-5)
    assert figures["before"]["mre"] == pytest.approx(0.5, abs=1e-4)
    for key in ("mre", "mae_m", "rmse_m", "delta1", "delta2", "delta3", "scale_error_median"):
        assert key in figures["after"] and key in figures["images"][0]["after"]
    assert figures["fits_ok"] == 2
    json.dumps(figures, allow_nan=False)


def test_depth_up_to_a_factor_has_no_metres_before_scaling():
    truth = box_room((128, 256))
    scored = Evaluator(DepthSettings("network", LidarSettings()), KnownModel(0.4 * truth, "scale_invariant")).score(
        "room", RGB, truth
    )
    assert scored.before is None
    assert scored.after.mre < 0.02
    assert report([scored.as_dict()], DepthSettings("network", LidarSettings()), None)["before"] is None


def test_without_lidar_the_network_s_metres_count():
    truth, raw = box_room(), 1.1 * box_room()
    truth[:8] = 0
    scored = Evaluator(DepthSettings("network"), KnownModel(raw)).score("room", RGB, truth)
    assert scored.after == scored.before == depth_metrics(raw, truth)
    assert scored.after.pixels == 56 * 128
    assert scored.fit is None


def test_lidar_alone_needs_no_network():
    scored = Evaluator(DepthSettings("lidar", LidarSettings(outliers=0.05)), None).score(
        "room", RGB, box_room((128, 256))
    )
    assert scored.before is None
    assert scored.after.delta1 > 0.9
    assert 0 < scored.within_sigma <= 1


def test_completed_is_the_fused_depth_corrected():
    truth, model = box_room((128, 256)), KnownModel(box_room((128, 256)))
    completion = KnownModel(truth)
    completion.manifest.prior_input = "prior"
    completion.complete = lambda rgb, prior: (2 * truth, np.full(truth.shape, 1e-4, np.float32))
    scored = Evaluator(DepthSettings("completed", LidarSettings()), model, completion).score("room", RGB, truth)
    # An error of 1 where it is taken: floor and guesses, not the measured walls.
    assert 0.1 < scored.after.mre < 0.9 and scored.fit["message"].endswith("completed")


def test_what_cannot_be_scored_says_why():
    model = KnownModel(box_room())
    with pytest.raises(DepthEvaluationError, match="give a model of ic depth train"):
        Evaluator(DepthSettings("completed", LidarSettings()), model)
    with pytest.raises(DepthEvaluationError, match="--lidar"):
        DepthSettings("fused")
    with pytest.raises(DepthEvaluationError, match="above 0"):
        DepthSettings("network", camera_height_m=0)
    with pytest.raises(DepthEvaluationError, match="needs a model"):
        Evaluator(DepthSettings("network"), None)
    with pytest.raises(DepthEvaluationError, match="scale_invariant"):
        Evaluator(DepthSettings("network"), KnownModel(box_room(), "scale_invariant"))
    evaluator = Evaluator(DepthSettings("network", LidarSettings()), model)
    with pytest.raises(DepthEvaluationError, match=r"room: the image is 100 x 100"):
        evaluator.score("room", np.zeros((100, 100, 3), np.uint8), box_room())
    with pytest.raises(DepthEvaluationError, match=r"room: the true depth is 64 x 64"):
        evaluator.score("room", RGB, np.ones((64, 64)))
    with pytest.raises(DepthEvaluationError, match="room: the ground truth has no valid pixel"):
        evaluator.score("room", RGB, np.full(SIZE, np.nan))
    with pytest.raises(DepthEvaluationError, match="room: the simulated LiDAR needs"):
        evaluator.score("room", RGB, None)


def test_a_network_that_fits_nothing_is_not_ok_and_says_so():
    noise = np.random.default_rng(0).uniform(0.5, 12, (128, 256)).astype(np.float32)
    scored = Evaluator(DepthSettings("network", LidarSettings()), KnownModel(noise)).score(
        "room", RGB, box_room((128, 256))
    )
    assert not scored.fit["ok"]
    assert scored.fit["message"]


def test_images_and_depth_are_paired_in_their_order() -> None:
    images, truths = [Path("a.jpg"), Path("b_rgb.png")], [Path("gt/a.npy"), Path("gt/b_depth.png")]
    assert pair(images, truths) == list(zip(images, truths, strict=True))
    assert pair(images[:1], truths[1:]) == [(images[0], truths[1])]
    assert pair(images, []) == [(images[0], None), (images[1], None)]
    with pytest.raises(DepthEvaluationError, match="2 images and 1 depth files"):
        pair(images, truths[:1])
    with pytest.raises(DepthEvaluationError, match="different stems"):
        pair(images, truths[::-1])


def test_a_png_has_its_own_unit_and_unknown_values(tmp_path):
    path = tmp_path / "a.png"
    cv2.imwrite(str(path), np.array([[512, 1024], [0, 65535]], np.uint16))
    assert np.allclose(load_depth(path, 1 / 512), [[1, 2], [0, 0]])
    assert np.allclose(load_depth(path), [[0.512, 1.024], [0, 0]])
    cv2.imwrite(str(path), np.full((4, 8), 65535, np.uint16))
    with pytest.raises(DepthFileError, match=r"a.png: no known depth"):
        load_depth(path)
    np.save(tmp_path / "b.npy", np.full((4, 8), 70.0))
    assert np.all(load_depth(tmp_path / "b.npy", 1 / 512) == 70)


@pytest.fixture
def folder(tmp_path):
    truth = box_room()
    for name in ("a", "b"):
        cv2.imwrite(str(tmp_path / f"{name}.jpg"), RGB)
    cv2.imwrite(str(tmp_path / "a.png"), np.rint(1000 * truth).astype(np.uint16))
    np.savez(tmp_path / "b.npz", depth=truth)
    return tmp_path


def run(*words):
    return main(["evaluate", "depth", *map(str, words)])


def test_command_with_lidar_alone(folder, capsys):
    out = folder / "out"
    out.mkdir()
    words = (folder / "a.jpg", folder / "b.jpg", "--depth", folder / "a.png", folder / "b.npz", "--lidar")
    files = ("--json", out / "o.json", "--plot", out / "o.png")
    assert run(*words, "--source", "lidar", "--outliers", "0.05", *files) == 0
    figures = json.loads((out / "o.json").read_text())
    assert figures == json.loads(capsys.readouterr().out)
    assert [row["name"] for row in figures["images"]] == ["a.jpg", "b.jpg"]
    assert figures["after"]["delta1"] > 0.9
    assert figures["lidar"]["outliers"] == 0.05
    assert figures["errors"] == figures["unfit"] == []
    assert (out / "o.png").stat().st_size > 1000


def test_command_goes_on_after_a_bad_file_and_ends_with_an_error(folder, capsys):
    (folder / "c.jpg").write_bytes(b"no picture")
    np.save(folder / "c.npy", box_room())
    pictures = [folder / f"{name}.jpg" for name in "abc"]
    depth = [folder / name for name in ("a.png", "b.npz", "c.npy")]
    assert run(*pictures, "--depth", *depth, "--lidar", "--source", "lidar") == 1
    printed = capsys.readouterr()
    figures = json.loads(printed.out)
    assert [row["name"] for row in figures["images"]] == ["a.jpg", "b.jpg"]
    assert [row["name"] for row in figures["errors"]] == ["c.jpg"]
    assert "c.jpg: not a readable image" in printed.err


def test_command_without_truth_draws_only(folder):
    assert run(folder / "a.jpg", "--plot", folder / "o.png", "--json", folder / "o.json") == 0
    figures = json.loads((folder / "o.json").read_text())
    assert figures["after"] is None and figures["seconds"] > 0
    assert cv2.imread(str(folder / "o.png")).shape[1] < 1100  # image and prediction alone


@pytest.mark.parametrize(
    ("words", "message"),
    [
        (("--source", "fused"), "--lidar too"),
        (("--lidar",), "give --depth"),
        (("--json", "none/o.json"), "the folder none does not exist"),
        (("--model", "none.onnx"), "none"),
        (("--camera-height", "-1"), "above 0"),
        (("--png-unit", "0"), "must be > 0"),
        (("--plot", "o.gif"), "must end in .png"),
        (("--json", "."), ".: Is a directory"),
        (("--depth", "{}/a.png", "--lidar", "--outliers", "2"), "outliers must lie"),
        (("--depth", "{}/a.png", "--lidar", "--lidar-height", "-1"), "height must be above 0"),
        (("--depth", "none.npy"), "none.npy: cannot be read"),
    ],
)
def test_command_says_what_is_wrong_with_its_words(folder, capsys, words, message):
    assert run(folder / "a.jpg", *(word.format(folder) for word in words)) != 0
    assert message in capsys.readouterr().err
