"""``ic evaluate vspace``: figures by hand, sources against each other in a small corridor, errors."""

import dataclasses
import json
import math

import numpy as np
import pytest

from instant_ic.cli.main import main
from instant_ic.experiments import box_room, vspace, vspace_sources
from instant_ic.experiments.colour_only import ColourOnlyField, composite_gradient, density
from instant_ic.experiments.vspace import Report, Row, evaluate, path_poses, scores, start_pose
from instant_ic.experiments.vspace_sources import VspaceSettings
from instant_ic.geometry.poses import pose_matrix
from instant_ic.sim.worlds import corridor_world
from instant_ic.vspace import FieldConfig, TrainConfig, VirtualSpaceConfig

SMALL = VirtualSpaceConfig(
    device="cpu",
    panorama_width=256,
    field=FieldConfig(log2_table=12),
    train=TrainConfig(ray_columns=32, ray_rows=16, iterations=40),
)
FOV = math.pi / 2


@pytest.fixture(scope="module")
def world():
    return corridor_world(light_cell_m=0.5)


def test_straight_ends_before_the_obstacle(world):
    poses = path_poses(world, (0.0, 0.0, 0.0), "straight", np.arange(0, 5.01, 0.25))
    # The box's front is at 4 m, 0.3 m are kept clear.
    assert poses[-1][0, 3] == pytest.approx(3.5)
    assert [p[0, 3] for p in poses] == pytest.approx(np.arange(0, 3.51, 0.25))
    assert all(p[2, 3] == vspace.CAMERA_HEIGHT_M for p in poses)


def test_a_curve_keeps_its_distances_and_looks_along_itself(world):
    distances = np.arange(0, 3.01, 0.5)
    poses = path_poses(world, (0.0, 0.0, 0.0), "curve", distances)
    places = np.array([p[:2, 3] for p in poses])
    assert np.hypot(*places.T) == pytest.approx(distances, abs=1e-9)
    assert abs(places[-1, 1]) > 0.2
    for before, here, after in zip(poses, poses[1:], poses[2:], strict=False):
        along = after[:2, 3] - before[:2, 3]
        assert here[:2, 0] == pytest.approx(along / np.linalg.norm(along), abs=0.03)


def test_a_start_in_the_wall_is_refused(world):
    with pytest.raises(ValueError, match="m clear of everything"):
        start_pose(world, (0.0, 1.2, 0.0))
    with pytest.raises(ValueError, match="m clear of everything"):
        start_pose(world, (99.0, 0.0, 0.0))


def test_scores_by_hand():
    black, grey = np.zeros((32, 32, 3), np.uint8), np.full((32, 32, 3), 51, np.uint8)
    psnr, ssim = scores(black, grey)
    assert psnr == pytest.approx(10 * math.log10(255**2 / 51**2))  # 13.98 dB
    # Uniform pictures: (2 · 0 · 51 + C1) / (0² + 51² + C1), C1 = (0.01 · 255)²
    assert ssim == pytest.approx(6.5025 / (51**2 + 6.5025), rel=1e-4)
    assert scores(grey, grey) == (99.0, 1.0)


def rows(source, psnr, ssim):
    return [Row("straight", source, 0.25 * i, p, s, 1.0, 1.0) for i, (p, s) in enumerate(zip(psnr, ssim, strict=True))]


def test_means_and_verdict_by_hand():
    settings = VspaceSettings(paths=("straight",))
    report = Report("corridor", (0, 0, 0), settings, {})
    report.rows += rows("ours", (40, 30, 28), (1, 0.9, 0.8))
    report.rows += rows("panorama", (40, 20, 29), (1, 0.5, 0.4))
    report.rows += rows("no-depth", (20, 20, 20), (0.5, 0.5, 0.5))
    report.rows += rows("depth-warp", (40, 29, 27), (1, 0.8, 0.7))
    report.rows += rows("point-warp", (40, 28, 29.5), (1, 0.9, 0.7))
    assert report.means()["straight"]["ours"] == {"psnr_db": 29.0, "ssim": 0.85}  # the panorama's own place left out
    verdict = report.verdict()["straight"]
    assert verdict["beats panorama from 0.25 to 2 m"] == {"met": False, "not at_m": [0.5]}
    assert verdict["beats no-depth from 0.25 to 2 m"] == {"met": True, "not at_m": []}
    # Means 29/.85 against 28/.75 and 28.75/.8; cell by cell +1 and −1.5 dB against the better of the two.
    assert verdict["against the better warp"] == {"mean_db": 0.25, "worst_db": -1.5, "mean_ssim": 0.05, "met": False}
    json.dumps(report.figures())


@pytest.mark.parametrize(
    ("change", "words"),
    [
        ({"paths": ("zigzag",)}, "straight, curve"),
        ({"sources": ()}, "got none"),
        ({"seconds": 0.0}, "seconds"),
        ({"step_m": 0.0}, "step"),
        ({"keyframes": 9}, "keyframes"),
        ({"panorama_width": 100}, "multiple of 8"),
        ({"fov_deg": 180.0}, "field of view"),
    ],
)
def test_settings_that_make_no_sense_are_refused(change, words):
    with pytest.raises(ValueError, match=words):
        VspaceSettings(**change)


def test_the_scanned_world_has_the_same_shape_in_other_colours(world):
    from instant_ic.sim.render import EquirectRenderer

    pose = pose_matrix(z=1.2)
    now, then = (EquirectRenderer(w).render(pose, 128, 64) for w in (world, vspace_sources.scanned(world, seed=3)))
    assert np.allclose(now.depth_m, then.depth_m)
    difference = np.abs(now.rgb.astype(int) - then.rgb)
    assert 5 < difference.mean() < 60


def test_points_from_the_panoramas_own_place_are_its_picture():
    picture = box_room.panorama(np.eye(4), 128)
    drawn, seen = vspace_sources.point_warp(picture.rgb, picture.depth_m, np.eye(4), np.eye(4), 48, 27, FOV)
    assert seen > 0.95
    assert scores(drawn, box_room.perspective(np.eye(4), 48, 27, FOV).rgb)[0] > 20


def test_the_gradient_of_compositing_is_that_of_its_error():
    rng = np.random.default_rng(4)
    field = rng.normal(0, 0.7, (3, 5, 4)).astype(np.float64)
    step, target = rng.uniform(0.1, 1.0, (3, 5)), rng.uniform(-0.5, 0.5, (3, 3))
    step[:, -1] = 1e3

    def error(values):
        # The rendering sum of the paper, III.B, written out.
        total = 0.0
        for n in range(3):
            left, colour = 1.0, np.zeros(3)
            for i in range(5):
                alpha = 1 - math.exp(-math.exp(values[n, i, 3]) * step[n, i])
                colour += left * alpha * values[n, i, :3]
                left *= 1 - alpha
            total += float(((colour - target[n]) ** 2).sum())
        return total / 9

    found, gradient = composite_gradient(field, step, target)
    assert found == pytest.approx(error(field), rel=1e-5)
    for index in np.ndindex(field.shape):
        up, down = field.copy(), field.copy()
        up[index] += 1e-5
        down[index] -= 1e-5
        assert gradient[index] == pytest.approx((error(up) - error(down)) / 2e-5, abs=1e-5)
    assert density(np.array([0.0, 100.0], np.float32)).tolist() == pytest.approx([1, math.exp(6)])


def test_colours_alone_are_learnt_but_not_where_they_are():
    picture = box_room.panorama(np.eye(4), 64)
    field = ColourOnlyField(picture.rgb, np.eye(4), SMALL)
    before = field.train(iterations=1)
    assert field.train(iterations=25) > before + 3
    assert field.iterations == 26
    aside = pose_matrix(0.8, 0.3)
    view, truth = field.render(aside, 48, 27, FOV), box_room.perspective(aside, 48, 27, FOV)
    assert view.rgb.shape == (27, 48, 3)
    assert np.median(np.abs(view.depth_m / truth.depth_m - 1)) > 0.2


@pytest.fixture(scope="module")
def report(world):
    made = {"corridor": world, "corridor-free": corridor_world(light_cell_m=0.5, obstacle=False)}
    settings = VspaceSettings(
        paths=("straight",), sources=tuple(vspace_sources.SOURCES), seconds=0.2, times=(0.1, 0.2), size=(96, 54),
        panorama_width=256, step_m=1.0, reach_m=1.0,
    )  # fmt: skip
    words = []
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr("instant_ic.sim.worlds.make_world", made.__getitem__)
        return evaluate("corridor", settings, None, lambda *told: words.append(told), SMALL), words


def test_every_source_has_its_rows(report):
    report, words = report
    assert len(report.rows) == len(vspace_sources.SOURCES) * 2
    assert all(0 < row.psnr_db <= 99 and -1 <= row.ssim <= 1 and row.seconds >= 0 for row in report.rows)
    assert words[-1][1] == words[-1][2] == len(report.rows)
    assert {row.seconds for row in report.training} == {0.1, 0.2}
    assert {(row.source, row.distance_m) for row in report.training} == {
        (source, distance) for source in ("ours", "field") for distance in (0.0, 1.0)
    }
    psnr = report.table("psnr_db")["straight"]
    # At the panorama itself no depth is needed; away from it the panorama alone will not do.
    assert abs(psnr["panorama"][0.0] - psnr["depth-warp"][0.0]) < 1
    assert psnr["true-warp"][1.0] > psnr["panorama"][1.0] + 4
    assert psnr["ours"][1.0] > psnr["panorama"][1.0] + 3
    assert report.depth["straight"]["median_relative_error"] < 0.1


def test_plot_and_strip_are_written(report, tmp_path):
    from instant_ic.experiments.vspace_plot import save_plot, save_strip

    report, _ = report
    save_plot(tmp_path / "plot.png", report)
    save_strip(tmp_path / "strip.png", report)
    assert (tmp_path / "plot.png").stat().st_size > 10_000
    assert (tmp_path / "strip.png").stat().st_size > 10_000
    bare = dataclasses.replace(report, strips={})
    with pytest.raises(ValueError, match="end before"):
        save_strip(tmp_path / "none.png", bare)


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        (["--world", "nowhere.glb"], "nowhere.glb"),
        (["--world", "corridor", "--path", "up"], "straight, curve"),
        (["--world", "corridor", "--size", "big"], "640x360"),
        (["--world", "corridor", "--start", "1,2"], "X,Y,YAW"),
        (["--world", "corridor", "--times", "1,x"], "--times"),
        (["--world", "corridor", "--json", "/nowhere/at/all.json"], "does not exist"),
    ],
)
def test_mistakes_are_told_in_a_line(arguments, words, capsys):
    try:
        status = main(["evaluate", "vspace", *arguments])
    except SystemExit as end:  # argparse
        status = end.code
    assert status == 2
    assert words in capsys.readouterr().err
