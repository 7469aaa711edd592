"""Generated interiors: every kind can be stood in and repeats; seeds of the evaluations are refused."""

from dataclasses import replace

import numpy as np
import pytest

from instant_ic.experiments import depth_worlds
from instant_ic.geometry.poses import pose_matrix
from instant_ic.sim.render import EquirectRenderer
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


def test_rooms_are_reproducible_and_vary() -> None:
    recipe = RoomsConfig(worlds=2, poses=2, height=32, first_world=300_006)
    first, again = list(render_rooms(recipe)), list(render_rooms(recipe, worlds=[300_007]))
    assert [s.world for s in first] == [300_006, 300_006, 300_007, 300_007]
    np.testing.assert_array_equal(first[2].rgb, again[0].rgb)
    np.testing.assert_array_equal(first[3].depth_m, again[1].depth_m)
    heights = {round(float(s.depth_m[-1].mean()), 2) for s in first}
    assert len(heights) == 4 and min(heights) > 0.45 and max(heights) < 1.85


def test_worlds_of_the_evaluations_are_never_trained_on() -> None:
    assert FIRST_HELD_OUT == depth_worlds.FIRST_SEED
    recipe = RoomsConfig(first_world=FIRST_HELD_OUT - 400)
    with pytest.raises(ValueError, match="for evaluation"):
        replace(recipe, worlds=401)
    with pytest.raises(ValueError, match="interiors must be one of"):
        replace(recipe, interiors="caves")
