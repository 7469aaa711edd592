"""Views of the sources: paths and scores by hand, sources against each other in a small corridor, errors."""

import math

import numpy as np
import pytest
import torch

from instant_ic.experiments import vspace, vspace_sources
from instant_ic.experiments.colour_only import ColourOnlyField, composite
from instant_ic.experiments.vspace import compare, converge, scores
from instant_ic.experiments.vspace_sources import VspaceSettings
from instant_ic.experiments.worlds import CAMERA_HEIGHT_M, path_poses
from instant_ic.geometry.poses import pose_matrix
from instant_ic.sim.worlds import corridor_world
from instant_ic.vspace import FieldConfig, TrainConfig, VirtualSpaceConfig
from tests import box_room

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
    assert all(p[2, 3] == CAMERA_HEIGHT_M for p in poses)


def test_a_curve_keeps_its_distances_and_looks_along_itself(world):
    distances = np.arange(0, 3.01, 0.5)
    poses = path_poses(world, (0.0, 0.0, 0.0), "curve", distances)
    places = np.array([p[:2, 3] for p in poses])
    assert np.hypot(*places.T) == pytest.approx(distances, abs=1e-9)
    assert abs(places[-1, 1]) > 0.2
    for before, here, after in zip(poses, poses[1:], poses[2:], strict=False):
        along = after[:2, 3] - before[:2, 3]
        assert here[:2, 0] == pytest.approx(along / np.linalg.norm(along), abs=0.03)


def test_scores_by_hand():
    black, grey = np.zeros((32, 32, 3), np.uint8), np.full((32, 32, 3), 51, np.uint8)
    psnr, ssim = scores(black, grey)
    assert psnr == pytest.approx(10 * math.log10(255**2 / 51**2))  # 13.98 dB
    # Uniform pictures: (2 · 0 · 51 + C1) / (0² + 51² + C1), C1 = (0.01 · 255)²
    assert ssim == pytest.approx(6.5025 / (51**2 + 6.5025), rel=1e-4)
    assert scores(grey, grey) == (99.0, 1.0)


def test_samples_are_composited_by_what_is_left_of_the_light():
    field = torch.tensor([[[0.2, 0.0, 0.4, 0.0], [0.1, 0.1, 0.1, 9.0]]])
    colour, weight = composite(field, torch.tensor([[math.log(2.0), 1e3]]))
    assert weight[0].tolist() == pytest.approx([0.5, 0.5])  # a density of 1 over ln 2 m keeps half of the light
    assert colour[0].tolist() == pytest.approx([0.15, 0.05, 0.25])


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


SETTINGS = VspaceSettings(
    sources=("ours", "no-depth", "panorama", "depth-warp", "exact-fill", "paper", "mesh"),
    seconds=0.2, size=(96, 54), panorama_width=256, step_m=1.0, reach_m=1.0,
)  # fmt: skip


@pytest.fixture
def two_worlds(world, monkeypatch):
    made = {"corridor": world, "corridor-free": corridor_world(light_cell_m=0.5, obstacle=False)}
    monkeypatch.setattr("instant_ic.sim.worlds.make_world", made.__getitem__)
    monkeypatch.setattr(vspace, "make_world", made.__getitem__)


def test_every_source_has_its_rows(two_worlds):
    found = compare("corridor", SETTINGS, SMALL)
    assert len(found.rows) == len(SETTINGS.sources) * 2 * 2
    assert all(0 < row.psnr_db <= 99 and -1 <= row.ssim <= 1 and row.seconds >= 0 for row in found.rows)
    psnr = {(row.source, row.distance_m): row.psnr_db for row in found.rows if row.path == "straight"}
    # At the panorama itself no depth is needed; away from it the panorama alone will not do.
    assert abs(psnr["panorama", 0.0] - psnr["depth-warp", 0.0]) < 1
    assert psnr["ours", 1.0] > psnr["panorama", 1.0] + 3
    assert psnr["exact-fill", 1.0] > psnr["ours", 1.0]
    assert found.depth["median_relative_error"] < 0.1
    assert set(found.strips["straight"][1.0]) == {"truth", *SETTINGS.sources}


def test_training_times_are_measured_at_the_panorama_and_ahead(two_worlds):
    rows = converge("corridor", SETTINGS, (0.2, 0.1), SMALL)
    assert [(row.source, row.distance_m) for row in rows[:4]] == [
        ("ours", 0.0), ("ours", 1.0), ("field", 0.0), ("field", 1.0),
    ]  # fmt: skip
    assert {row.seconds for row in rows} == {0.1, 0.2} and {row.source for row in rows} == {"ours", "field", "paper"}


def test_six_faces_show_the_panorama():
    image = box_room.panorama(np.eye(4), 128).rgb
    # Only the resampling is lost.
    assert scores(vspace_sources.through_cube(image), image)[0] > 28
