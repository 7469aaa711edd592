"""Generated interiors: every kind can be stood in and repeats; seeds of the evaluations are refused."""

from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from instant_ic.geometry.poses import pose_matrix
from instant_ic.sim.render import EquirectRenderer
from instant_ic.sim.worlds import random_world
from instant_ic.training.dataset import DatasetError, open_rendered, save_sample
from instant_ic.training.interiors import KINDS, interior_world
from instant_ic.training.rooms import FIRST_HELD_OUT, RoomsConfig, render_rooms


@pytest.mark.parametrize("kind", KINDS)
def test_each_kind_is_a_closed_place_to_stand_in(kind: str) -> None:
    world = interior_world(7, kind, light_cell_m=1.0, rays=4)
    ((x, y, yaw),) = world.sample_free_poses(np.random.default_rng(0), 1, 0.3)
    frame = EquirectRenderer(world).render(pose_matrix(x, y, 1.2, yaw=yaw), 64, 32)
    assert (frame.depth_m > 0.1).all()  # no look out of the world, nothing over the lens
    assert frame.depth_m[-1].mean() == pytest.approx(1.2, abs=0.05)
    assert 30 < frame.rgb.mean() < 252 and frame.rgb.std() > 5


def test_kinds_are_drawn_by_their_shares_and_unknown_ones_refused() -> None:
    assert sum(KINDS.values()) == pytest.approx(1)
    with pytest.raises(ValueError, match="unknown kind 'cave'"):
        interior_world(1, "cave")


@pytest.fixture(scope="module", autouse=True)
def plain_rooms() -> Iterator[None]:
    """Render plain random rooms, whose light takes less time."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr("instant_ic.training.interiors.interior_world", random_world)
        yield


@pytest.fixture(scope="module")
def rendered(tmp_path_factory: pytest.TempPathFactory) -> tuple[RoomsConfig, Path]:
    """Two panoramas of a world for training and of a held-out one, whose seed is a multiple of twelve."""
    folder = tmp_path_factory.mktemp("p")
    recipe = RoomsConfig(worlds=2, poses=2, height=64, first_world=300_000)
    paths = list(render_rooms(recipe, folder, [300_000, 300_001]))
    assert [path.name for path in paths] == ["300000-0.npz", "300000-1.npz", "300001-0.npz", "300001-1.npz"]
    return recipe, folder


def test_rooms_are_reproducible_and_vary(rendered: tuple[RoomsConfig, Path], tmp_path: Path) -> None:
    recipe, folder = rendered
    again = list(render_rooms(recipe, tmp_path, [300_001]))[-1]
    with np.load(folder / again.name) as old, np.load(again) as new:
        for name in ("rgb", "depth_m", "priors"):
            np.testing.assert_array_equal(old[name], new[name])
    samples = [sample for part in open_rendered(folder, (64, 128)) for sample in part]
    heights = {round(float(sample.depth_m[-1].mean()), 2) for sample in samples}
    assert len(heights) == 4 and min(heights) > 0.45 and max(heights) < 1.85
    assert not list(render_rooms(recipe, folder, [300_000, 300_001]))  # they are there


def test_a_rendered_folder_holds_out_worlds(rendered: tuple[RoomsConfig, Path]) -> None:
    training, held = open_rendered(rendered[1], (64, 128))
    assert {sample.world for sample in training} == {300_001} and {sample.world for sample in held} == {300_000}
    sample = held[0]
    assert sample.prior.shape == (6, 64, 128) and sample.rgb.dtype == np.uint8
    error = np.abs(sample.prior[0] - sample.depth_m)[sample.prior[2] > 0] / sample.depth_m[sample.prior[2] > 0]
    assert np.median(error) < 0.06


def test_a_rendered_folder_says_what_is_wrong(tmp_path: Path) -> None:
    with pytest.raises(DatasetError, match="no rendered panoramas: run ic depth render"):
        open_rendered(tmp_path, (64, 128))
    prior = np.zeros((6, 64, 128))
    save_sample(tmp_path / "5-0.npz", np.zeros((64, 128, 3), np.uint8), prior[0], [prior])
    save_sample(tmp_path / "5-1.npz", np.zeros((64, 128, 3), np.uint8), prior[0], [])  # no prior fitted
    with pytest.raises(DatasetError, match=r"5-0\.npz: 64 x 128, the network takes 256 x 512"):
        open_rendered(tmp_path, (256, 512))
    with pytest.raises(DatasetError, match="render 12 or more"):
        open_rendered(tmp_path, (64, 128))
    (tmp_path / "6-0.npz").write_bytes(b"damaged")
    with pytest.raises(DatasetError, match=r"6-0\.npz: damaged"):
        open_rendered(tmp_path, (64, 128))


def test_worlds_of_the_evaluations_are_never_trained_on() -> None:
    recipe = RoomsConfig(first_world=FIRST_HELD_OUT - 400)
    with pytest.raises(ValueError, match="for evaluation"):
        replace(recipe, worlds=401)
